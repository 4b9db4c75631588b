"""The way of a GPU, from the light to the maps: stage by stage against the CPU's, and on a pretended device."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from evnlos.cameras import EventCamera, EventPixel, FrameCamera, V2ePixel, simulate_batch
from evnlos.cameras.on_device import capture_tensors, record_tensors
from evnlos.cameras.pixels.torch_noise import electrons
from evnlos.cameras.random_numbers import fill_electrons
from evnlos.cameras.streams import EventTensors
from evnlos.data import NlosDataset, Sampling, SensorSize, Simulation, live_dataset, simulate
from evnlos.data.live import bytes_of_a_wall, simulate_objects_on, time_surface_tensors
from evnlos.data.simulate import simulate_object
from evnlos.errors import ConfigError, DataError
from evnlos.events import time_surface
from evnlos.models import UNetConfig, load_weights
from evnlos.optics import SlidingWall, View
from evnlos.optics.wall import slide
from evnlos.scene import HandwritingGlyphs, LineMotion, PathMotion
from evnlos.setups import PaperSetup, RadiometricSetup
from evnlos.training import Training, train
from evnlos.training.source import ProcessGroup, SimulatedSource
from evnlos.types import Plane
from pretend_device import PRETENDED, PretendedDevice
from test_event_pixel_v2e import PIXELS, _video

WALLS = {
    "affine": PaperSetup(tpsf_length_m=0.004, pitch_m=1e-3, gain=2.0, rotation_deg=5.0),
    "oblique": PaperSetup(tpsf_length_m=0.004, pitch_m=1e-3, gain=2.0, camera_angle_deg=10.0),
    "metal": RadiometricSetup(cell_m=0.01),
    "post": RadiometricSetup(cell_m=0.01, post_width_m=0.016, lamp_m=(0.1, 0.0, 0.1)),
}


@pytest.fixture(scope="module")
def small() -> Simulation:
    """One writer, four positions of a sequence of a second, a small sensor."""
    return Simulation(
        glyphs=HandwritingGlyphs(characters="AT", writers=1),
        setup=replace(WALLS["affine"], sensor=SensorSize(20, 32), pixel=V2ePixel(), time_step_s=0.02),
        sampling=Sampling(height=16, width=24, pitch_m=0.01, scored_rows=12),
        duration_s=1.0,
        positions=4,
        validation=0.0,
    )


def stream_of(seed: int, count: int, height: int = 9, width: int = 13) -> EventTensors:
    """Random events in order, many at one time and many at one pixel."""
    draw = np.random.default_rng(seed)
    time_us = np.sort(draw.integers(0, 400, count) * 50)
    pixel, on = draw.integers(0, height * width, count), draw.integers(0, 2, count).astype(bool)
    order = np.lexsort((on, pixel, time_us))
    columns = (torch.from_numpy(column[order]) for column in (time_us, pixel, on))
    return EventTensors(*columns, height, width)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("mode", "radius"), [("sae", 1), ("context", 0), ("context", 2), ("hots", 1), ("hots", 3)]
)
def test_surfaces_are_those_of_the_walk_through_the_events(mode, radius, seed) -> None:
    events = stream_of(seed, 3000)
    edges = [4000, 7000, 7050, 16_000]  # events lie before the first and after the last
    ours = time_surface_tensors(events, edges, 3000.0, mode, radius=radius)
    theirs = time_surface(events.to_events(), edges, 3000.0, mode, radius=radius)
    assert theirs.max() > 0.5
    np.testing.assert_allclose(ours.numpy(), theirs, rtol=2e-6, atol=1e-7)


@pytest.mark.parametrize("mode", ["sae", "context", "hots"])
def test_no_events_make_a_blank_surface(mode) -> None:
    surface = time_surface_tensors(stream_of(0, 0), [0, 10, 20], 5.0, mode)
    assert surface.shape == (2, 2, 9, 13)
    assert not surface.any()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"tau_us": 0.0}, "tau_us is 0.0"),
        ({"radius": 65}, "radius is 65"),
        ({"mode": "tos"}, "mode is 'tos'"),
        ({"edges_us": [5, 5]}, "edges must ascend"),
    ],
)
def test_wrong_surfaces_are_refused(given, words) -> None:
    with pytest.raises(DataError, match=words):
        time_surface_tensors(**{"events": stream_of(0, 5), "edges_us": [0, 10], "tau_us": 1.0, **given})


@pytest.mark.parametrize("number", [0, 7])
def test_electrons_are_those_of_the_compiled_loop(number) -> None:
    draw = np.random.default_rng(number)
    mean = np.concatenate([10.0 ** draw.uniform(-2, 5, 4000), [0.0, 63.999, 64.0]])
    offset = draw.normal(0.0, 3.0, len(mean))
    expected = np.empty_like(mean)
    fill_electrons(mean, offset, 6.0, np.uint64(2**63 + 5), np.uint64(number), expected)
    rows = torch.from_numpy(mean).expand(3, -1)
    made = electrons(rows, torch.from_numpy(offset), 6.0, 2**63 + 5, number - 1 if number else 0).numpy()
    made = made[1 if number else 0]
    np.testing.assert_allclose(made, expected, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize(
    "camera", [FrameCamera(), FrameCamera(pattern_seed=None, bit_depth=12, exposure_s=0.0)]
)
def test_frames_are_those_of_the_frame_camera(small, camera) -> None:
    wall = wall_of(small)
    times_s = np.array([0.2, 0.5, 0.85])
    made = capture_tensors(camera, wall, times_s, seed=3)
    assert made.dtype == torch.float32
    np.testing.assert_array_equal(made.numpy(), camera.capture(wall, times_s, seed=3))


@pytest.mark.parametrize(
    "motion", [LineMotion(speed_m_s=0.06), LineMotion(speed_m_s=0.06, direction=(1.0, 0.3))]
)
def test_a_sliding_wall_renders_many_frames_as_it_renders_one(motion, monkeypatch) -> None:
    torch.manual_seed(0)
    view = View.affine((11, 17), 90.0, rotation_rad=0.2 * motion.direction[1])
    image = torch.rand(24, 24)
    wall = SlidingWall(image, Plane(24, 24, 0.005), view, motion, gain=0.7, ambient=0.05)
    times_s = np.linspace(-30.0, 30.0, 41)  # it comes from beyond one border and leaves by the other
    frames = [
        wall._shifted(*place).clamp(min=0) * 0.7 + wall.ambient for place in motion.position_m(times_s).tolist()
    ]
    monkeypatch.setattr("evnlos.optics.wall._TOGETHER_PX", 11 * 17 * 9)
    image = torch.empty(41, 11, 17)
    wall._slide(motion.position_m(times_s), image)
    torch.testing.assert_close(image, torch.stack(frames), rtol=1e-6, atol=1e-7)
    assert image.std() > 0.01
    wall._slide(np.zeros((0, 2)), torch.empty(0, 11, 17))


def test_windows_far_from_the_band_are_dark() -> None:
    frames = slide(torch.ones(2, 5), torch.tensor([-(10**9), -1, 10**9]), torch.full((3, 4), 0.25), 4)
    assert frames[:, 0].tolist() == [[0.0] * 4, [0.75, 1.0, 1.0, 0.75], [0.0] * 4]


def wall_of(config: Simulation, device: str = "cpu"):
    """Return the wall of the first object."""
    from evnlos.scene import Scene

    target = config.glyphs.target(config.glyphs.objects()[0], 5)
    scene = Scene(target, config.motion, config.duration_s)
    return config.setup.observe(scene, device)


@pytest.mark.parametrize("refractory_s", [0.0, 0.03])
def test_light_that_is_rendered_in_blocks_gives_the_events_of_whole_clips(small, refractory_s) -> None:
    wall, times_s = wall_of(small), np.linspace(0.0, 1.0, 101)
    pixel = EventPixel(threshold_on=0.05, threshold_off=0.05, refractory_s=refractory_s)
    (expected,) = simulate_batch(
        255.0 * wall.irradiance(times_s)[None], times_s, pixel, [9], dtype=torch.float64
    )
    assert len(expected) > 500
    assert record_tensors([wall], times_s, [pixel], [9])[0].to_events() == expected


class _BadWall:
    shape, speed_px_s = (4, 6), 1.0

    def __init__(self, value: float) -> None:
        self.value = value

    def irradiance(self, t_s) -> torch.Tensor:
        image = torch.ones(np.shape(t_s)[0], 4, 6)
        image[np.asarray(t_s) > 0.5, 2, 3] = self.value
        return image


@pytest.mark.parametrize(
    ("value", "words"), [(float("nan"), "NaN"), (-1.0, "negative"), (float("inf"), "infinity")]
)
def test_light_that_no_wall_has_is_refused(value, words) -> None:
    with pytest.raises(DataError, match=words):
        record_tensors([_BadWall(value)], np.linspace(0.0, 1.0, 101), [EventPixel()], [0])
    with pytest.raises(DataError, match=words):
        capture_tensors(FrameCamera(), _BadWall(value), [0.2, 0.9])


def test_clips_with_pixels_of_their_own_give_the_events_of_each_alone(small) -> None:
    pixels = [
        EventPixel(0.05, 0.06, 0.01, cutoff_hz=5.0, leak_rate_hz=0.0, shot_noise_rate_hz=0.0),
        EventPixel(0.08, 0.05, 0.0, cutoff_hz=200.0, leak_rate_hz=2.0, shot_noise_rate_hz=0.0),
        EventPixel(0.10, 0.11, 0.03, cutoff_hz=40.0, leak_rate_hz=0.0, shot_noise_rate_hz=5.0),
    ]
    walls = [wall_of(replace(small, setup=replace(small.setup, gain=gain))) for gain in (1.0, 2.0, 3.0)]
    times_s = np.linspace(0.0, 2.0, 101)
    together = record_tensors(walls, times_s, pixels, [7, 8, 9])
    for number, events in enumerate(together):
        light = 255.0 * walls[number].irradiance(times_s)[None]
        (alone,) = simulate_batch(light, times_s, pixels[number], [7 + number])
        assert len(alone) > 200
        assert events.to_events() == alone


@pytest.mark.parametrize(
    ("walls", "pixels", "words"),
    [
        (1, [EventPixel(), EventPixel()], "1 walls, 2 pixels"),
        (2, [EventPixel(), EventPixel(cutoff_hz=0.0)], "their pixels in kind"),
        (2, [EventPixel(), EventPixel(refractory_s=0.01)], "their pixels in kind"),
        (0, [], "give one of each"),
    ],
)
def test_clips_that_cannot_run_together_are_refused(small, walls, pixels, words) -> None:
    with pytest.raises(ConfigError, match=words):
        record_tensors([wall_of(small)] * walls, [0.0, 1.0], pixels, [0] * len(pixels))


def test_pixels_that_the_stepped_mode_lacks_are_refused(small) -> None:
    wall = wall_of(small)
    with pytest.raises(ConfigError, match="no hot pixels"):
        record_tensors([wall], np.linspace(0.0, 1.0, 11), [EventPixel(hot_pixel_fraction=0.1)], [0])
    with pytest.raises(DataError, match="at least 2"):
        record_tensors([wall], np.zeros(1), [EventPixel()], [0])


# On a pretended device: nothing is made in the wrong place, and nothing large comes back.


def test_the_pretended_device_refuses_what_a_gpu_refuses() -> None:
    with PretendedDevice() as mode:
        there, here = torch.arange(6.0, device=PRETENDED), torch.ones(6)
        with pytest.raises(RuntimeError, match="main memory"):
            _ = there + here
        with pytest.raises(RuntimeError):
            there.numpy()
        assert mode.crossings == 0
        assert (there + here.to(PRETENDED)).tolist() == [1, 2, 3, 4, 5, 6]
        assert mode.crossings == 6
        assert mode.uploads == 6


@pytest.mark.parametrize(
    ("kind", "surface"), [*((kind, "sae") for kind in WALLS), ("affine", "context"), ("affine", "hots")]
)
def test_an_object_is_simulated_where_it_is_asked_for(small, kind, surface) -> None:
    config = replace(
        small, setup=WALLS[kind].with_cameras_of(small.setup), sampling=replace(small.sampling, surface=surface)
    )
    name = config.glyphs.objects()[0]
    expected = simulate_objects_on(config, [name], "cpu")[0]
    assert expected.surface.max() > 0.1
    with PretendedDevice() as mode:
        made = simulate_objects_on(config, [name], PRETENDED)[0]
        crossings = mode.crossings
        assert {part.device for part in made} == {PRETENDED}
        for part, truth in zip(made, expected, strict=True):
            torch.testing.assert_close(part.cpu(), truth, rtol=1e-6, atol=1e-6)
    # how many thresholds the busiest pixel crossed in each of 100 steps, and a few counts
    assert crossings < 100 + 100


@pytest.mark.parametrize("kind", WALLS)
def test_more_steps_do_not_bring_more_from_main_memory(small, kind) -> None:
    config = replace(small, setup=WALLS[kind].with_cameras_of(small.setup))
    uploads = []
    for step_s in (0.04, 0.02):
        stepped = replace(config, setup=replace(config.setup, time_step_s=step_s))
        with PretendedDevice() as mode:
            simulate_objects_on(stepped, config.glyphs.objects()[:1], PRETENDED)
            uploads.append(mode.uploads)
    # of each of the 25 instants more: time stamp, place and four weights, and what its noise spends
    assert uploads[1] - uploads[0] <= 25 * 16


@pytest.mark.parametrize(
    "vary", [{}, {"setup.pixel.cutoff_hz": (10.0, 80.0)}, {"setup.pixel.refractory_s": (0.01, 0.03)}]
)
def test_an_object_does_not_depend_on_those_beside_it(small, vary) -> None:
    config = replace(small, vary={"setup.pixel.threshold_on": (0.05, 0.2), "setup.gain": (1.0, 3.0), **vary})
    names = list(reversed(config.glyphs.objects()))
    together = simulate_objects_on(config, names, "cpu")
    assert len(together) == 2
    for name, made in zip(names, together, strict=True):
        (alone,) = simulate_objects_on(config, [name], "cpu")
        assert all(torch.equal(one, other) for one, other in zip(made, alone, strict=True))


def test_what_a_gpu_lacks_is_refused_before_the_work(small) -> None:
    config = small.with_setup(pixel=EventPixel())
    with pytest.raises(ConfigError, match="no torch backend"):
        simulate_objects_on(config, config.glyphs.objects(), "cpu")
    assert simulate_objects_on(small, [], "cpu") == []


def test_few_large_walls_are_held_at_a_time() -> None:
    full = SensorSize(600, 960)
    assert bytes_of_a_wall(Simulation(setup=PaperSetup(sensor=full))) < 1 << 24
    assert 1 << 32 < bytes_of_a_wall(Simulation(setup=RadiometricSetup(sensor=full))) < 1 << 34


@pytest.mark.parametrize("pixel", [V2ePixel(leak_rate_hz=0.3, shot_noise_rate_hz=1.0), V2ePixel(cutoff_hz=0.0)])
def test_the_same_settings_give_the_same_samples_with_and_without_the_torch_backend(small, pixel) -> None:
    """What a GPU simulates is what the CPU's kernels simulate: one YAML file, one physics."""
    config = replace(small, setup=replace(replace(small.setup, gain=2.0), pixel=pixel))
    for name in config.glyphs.objects():
        samples, events = simulate_object(config, name)
        (made,) = simulate_objects_on(config, [name], "cpu")
        assert len(events) > 1000
        np.testing.assert_allclose(made.surface.numpy(), samples.surface, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(made.frame.numpy(), samples.frame, atol=1e-6)
        np.testing.assert_array_equal(made.truth.numpy(), samples.truth)


def test_events_of_a_wall_are_those_of_the_compiled_loops(small) -> None:
    wall, pixel = wall_of(small), V2ePixel(0.05, 0.06, 0.01, 40.0, 0.3, 2.0)
    expected = EventCamera(pixel, time_step_s=0.01).record(wall, 0.0, 2.0, seed=4)
    instants = np.append(0.0, EventCamera(pixel, time_step_s=0.01).fixed_instants(0.0, 2.0))
    (made,) = record_tensors([wall], instants, [pixel], [4])
    assert len(expected) > 1000
    assert made.to_events() == expected


def test_beside_a_gpu_the_settings_alone_say_what_is_simulated(small) -> None:
    live = live_dataset(small)
    assert live._uses(PRETENDED)
    assert live.note(PRETENDED) == ""
    continuous = live_dataset(replace(small, setup=replace(small.setup, pixel=EventPixel(), time_step_s=None)))
    assert not continuous._uses(PRETENDED)
    assert "no torch backend" in continuous.note(PRETENDED)
    assert continuous.note(torch.device("cpu")) == ""
    assert live_dataset(small, where="cpu").note(PRETENDED) == ""


def test_a_target_may_move_along_any_path(small) -> None:
    path = PathMotion((0.0, 1.0, 2.0), ((0.0, 0.0), (0.02, 0.01), (0.03, -0.01)))
    name = small.glyphs.objects()[0]
    config = replace(small, motion=path)
    expected = simulate_objects_on(config, [name], "cpu")[0]
    with PretendedDevice():
        made = simulate_objects_on(config, [name], PRETENDED)[0]
        torch.testing.assert_close(made.surface.cpu(), expected.surface, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", PIXELS)
def test_every_pixel_runs_on_a_device(name) -> None:
    frames, times_s = _video(1, steps=40, height=6, width=50)
    clips = torch.from_numpy(np.clip(frames, 0, 255).astype(np.float32))[None]
    expected = simulate_batch(clips, times_s, PIXELS[name], [5])
    with PretendedDevice():
        assert simulate_batch(clips.to(PRETENDED), times_s, PIXELS[name], [5]) == expected


@pytest.mark.parametrize("modality", ["frame", "event", "fusion"])
def test_a_training_is_fed_on_its_device(small, modality) -> None:
    source = SimulatedSource(live_dataset(small), modality, 3, 0, ProcessGroup(0, 1, PRETENDED))
    with PretendedDevice():
        first, again = (list(source.batches(1)) for _ in range(2))
        assert len(first) == source.steps == 3
        for one, other in zip(first, again, strict=True):
            assert one.seen.device == one.truth.device == PRETENDED
            assert torch.equal(one.seen.cpu(), other.seen.cpu())
        inputs, truth, names = source.subset(4)
        assert inputs.device.type == truth.device.type == "cpu"
        assert len(inputs) == len(truth) == len(names) == 4


def test_a_gpu_may_be_fed_by_the_cpu(small) -> None:
    name = small.glyphs.objects()[0]
    ((expected, _),) = live_dataset(small).stream([name], 0, "fusion", torch.device("cpu"))
    with PretendedDevice():
        ((seen, truth),) = live_dataset(small, where="cpu").stream([name], 0, "fusion", PRETENDED)
        assert seen.device == truth.device == PRETENDED
        assert torch.equal(seen.cpu(), expected)


# On a GPU, where there is one.


@pytest.fixture(scope="module")
def gpu() -> torch.device:
    """The GPU, or a skip."""
    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    return torch.device("cuda")


@pytest.mark.parametrize(
    ("kind", "surface"), [*((kind, "sae") for kind in WALLS), ("affine", "context"), ("affine", "hots")]
)
def test_cuda_simulates_what_the_cpu_simulates(gpu, small, kind, surface) -> None:
    """Light differs in its last bits: single digital numbers of a frame, single events of a surface."""
    config = replace(
        small, setup=WALLS[kind].with_cameras_of(small.setup), sampling=replace(small.sampling, surface=surface)
    )
    names = config.glyphs.objects()
    expected, made, again = (simulate_objects_on(config, names, where) for where in ("cpu", gpu, gpu))
    for there, here, repeated in zip(made, expected, again, strict=True):
        assert {part.device.type for part in there} == {"cuda"}
        assert all(torch.equal(one, other) for one, other in zip(there, repeated, strict=True))
        frame, seen, truth = (part.cpu() for part in there)
        assert (frame - here.frame).abs().max() < 1.01 / 255
        assert ((frame - here.frame).abs() > 1e-6).float().mean() < 0.01
        assert here.surface.max() > 0.1
        assert ((seen - here.surface).abs() > 1e-4).float().mean() < 0.01
        torch.testing.assert_close(truth, here.truth, rtol=0, atol=0)


@pytest.mark.parametrize("name", PIXELS)
def test_cuda_pixels_send_the_events_of_the_cpu(gpu, name) -> None:
    """Exponential and logarithm of a GPU differ in their last bit, which moves single events by a step."""
    frames, times_s = _video(1, steps=40, height=6, width=50)
    clips = torch.from_numpy(np.clip(frames, 0, 255).astype(np.float32))[None]
    (expected,) = simulate_batch(clips, times_s, PIXELS[name], [5])
    (made,) = simulate_batch(clips.to(gpu), times_s, PIXELS[name], [5])

    def counts(events) -> np.ndarray:
        return np.histogramdd((events.y, events.x, events.p), (range(7), range(51), range(3)))[0]

    assert len(expected) > 50
    assert np.abs(counts(made) - counts(expected)).sum() <= 0.01 * len(expected)


@pytest.mark.parametrize("modality", ["frame", "event", "fusion"])
def test_a_training_on_cuda_is_fed_there(gpu, small, modality) -> None:
    source = SimulatedSource(live_dataset(small), modality, 3, 0, ProcessGroup(0, 1, gpu))
    first, again = (list(source.batches(1)) for _ in range(2))
    assert len(first) == source.steps == 3
    for one, other in zip(first, again, strict=True):
        assert one.seen.device.type == one.truth.device.type == "cuda"
        assert torch.equal(one.seen, other.seen)


def test_a_training_on_cuda_ends_where_that_of_the_cpu_does(gpu, small, tmp_path, monkeypatch) -> None:
    config = replace(small, glyphs=replace(small.glyphs, characters="ABCDEFGH"), validation=0.25)
    data = simulate(config, tmp_path / "set", workers=1)
    settings = Training(epochs=2, batch_size=4, precision="float32", network=UNetConfig(width=8))
    there = train(data, settings, tmp_path / "there")
    with monkeypatch.context() as patched:
        patched.setattr(torch.cuda, "is_available", lambda: False)
        here = train(data, settings, tmp_path / "here")
        samples = NlosDataset(data, "all", settings.modality)
        images = load_weights(tmp_path / "there").network.infer(
            samples.inputs, samples.position_m, samples.names
        )
    assert there.records[-1]["loss"] == pytest.approx(here.records[-1]["loss"], rel=1e-2)
    assert images.device.type == "cpu" and images.isfinite().all()
