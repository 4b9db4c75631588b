"""The likelihood of a whole sequence: unbiased on simulated sensors, near the bound, its intervals cover."""

import shutil
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from evnlos.analysis import SequenceAnalysisSettings, check_sampling, event_information
from evnlos.calibration import write_event_errors
from evnlos.cameras import CircuitPixel, EventPixel, FrameCamera, PixelMaps, PixelSettings, simulate_events
from evnlos.cameras.pixels.arrays import pixel_thresholds
from evnlos.cli import main
from evnlos.config import save_yaml, to_dict
from evnlos.data import NlosDataset, Sampling, Simulation, capture_samples, read_capture, simulate
from evnlos.errors import ConfigError, DataError, UnknownNameError
from evnlos.inverse import (
    AboutErrors,
    EventErrors,
    EventRecord,
    EventSolver,
    EventStatistic,
    FrameTerm,
    LikelihoodSettings,
    PatternPrior,
    SequenceEstimate,
    SequenceLight,
    estimate_sequence,
    event_images,
    gains_by_errors,
    handwritten_prior,
    record_of,
    root_of,
    sequence_light,
)
from evnlos.live.packet import Chunk
from evnlos.live.run import ImagesSoFar
from evnlos.metrics import psnr
from evnlos.models import SequenceConfig, Weights
from evnlos.scene import HandwritingGlyphs, Scene, Target
from evnlos.setups import RadiometricSetup, SensorSize
from evnlos.types import Events, Plane

COUNT = 24
PIXEL = EventPixel(0.12, 0.14, 0.02, 60.0, 0.02, 0.05)
NOISY = replace(PIXEL, shot_noise_rate_hz=0.2)
DIM = CircuitPixel(0.16, 0.2, 0.02, 3e-15, follower_a=3e-12, noise_factor=1.5, poles=1)
SETUP = RadiometricSetup(cell_m=0.01, gain=0.8, ambient=0.08, sensor=SensorSize(20, 32), pixel=PIXEL)
BENCH = SequenceAnalysisSettings(positions=20, counts=(20,), cells=8, crossing_noise=0.04)
SEQUENCES, TO_REACH_THE_BOUND = 6, 32
EXACT = 0.003  # the error of a crossing in a pixel that has none, interpolation included


@cache
def prior() -> PatternPrior:
    """Smooth random targets: the light stays above 0 for nearly all that the prior holds."""
    y, x = np.mgrid[0:8, 0:8].reshape(2, -1)
    distance = np.hypot(y[:, None] - y, x[:, None] - x)
    values, axes = np.linalg.eigh(0.16 * np.exp(-((distance / 1.2) ** 2)))
    patterns = axes[:, ::-1][:, :COUNT] * np.sqrt(values[::-1][:COUNT])
    return PatternPrior(Plane(8, 8, 0.01), np.full(64, 0.5), patterns, 0.0)


@cache
def light() -> SequenceLight:
    return sequence_light(SETUP, prior(), BENCH.motion.position_m, (0.0, BENCH.duration_s))


def test_the_light_is_right_on_sensors_of_any_ratio() -> None:
    """The light path is computed for fewer pixels, of another ratio than the sensor's, and interpolated."""
    target_plane = Plane(16, 16, 0.005)
    known = handwritten_prior(target_plane, 100)
    one = Target("E", np.clip(known.image(np.zeros(100)), 0, 1).astype(np.float32))
    for shape in ((120, 100), (60, 160)):
        setup = RadiometricSetup(cell_m=0.005, ambient=0.1, sensor=SensorSize(*shape))
        times = np.array([0.0, 4.0, 8.0])
        scene = Scene(one, BENCH.motion, 8.0)
        made = sequence_light(setup, known, scene.motion.position_m, (0.0, 8.0))
        rows = [
            made.at(made(np.zeros(100)), np.arange(len(made.left)), np.full(len(made.left), t)) for t in times
        ]
        seen = setup.observe(scene).irradiance(times).double().numpy().reshape(3, -1)
        assert np.linalg.norm(np.array(rows) - seen) / np.linalg.norm(seen - 0.1) < 0.01, shape


def truth(seed: int) -> np.ndarray:
    return np.random.default_rng([seed, 9]).standard_normal(COUNT)


def simulated(seed: int, pixel: PixelSettings = PIXEL) -> Events:
    """The events of one of the project's own pixels, with mismatch, filter, leak and noise."""
    frames = 255 * np.maximum(light()(truth(seed)), 1e-3).T.reshape(-1, *light().shape)
    return simulate_events(frames.astype(np.float32), light().times_s, pixel, seed=seed)


def recorded(seed: int, pixel: PixelSettings = PIXEL) -> EventRecord:
    law = pixel.crossing_law(40.0)
    assert law is not None
    return record_of(simulated(seed, pixel), law, (0.0, BENCH.duration_s), 0.4)


def photographed(seed: int, camera: FrameCamera, known: bool) -> FrameTerm:
    times = light().times_s[4::4]
    frames = camera.expose(np.maximum(light()(truth(seed))[:, 4::4], 0.0).T.reshape(-1, *light().shape), seed)
    levels = frames.reshape(len(times), -1) / camera.white
    return FrameTerm(light(), levels, times, camera, known)


@cache
def estimated(seed: int, least_noise: float = EXACT, pixel: PixelSettings = PIXEL) -> SequenceEstimate:
    settings = LikelihoodSettings(least_noise=least_noise)
    law, record = pixel.crossing_law(40.0), recorded(seed, pixel)
    return estimate_sequence(light(), prior(), law, record, settings=settings)


def error(found: SequenceEstimate, seed: int) -> float:
    return float(np.square(found.image - prior().image(truth(seed))).mean())


@pytest.mark.parametrize(
    ("pixel", "least_noise", "behind_db"),
    [(PIXEL, EXACT, 0.5), (PIXEL, 0.04, 0.0), (NOISY, EXACT, 0.5), (DIM, 0.04, 0.5)],
    ids=["true error", "assumed error", "many noise events", "slow noise"],
)
def test_events_reach_the_bound_and_their_intervals_cover(
    pixel: PixelSettings, least_noise: float, behind_db: float
) -> None:
    """With the error that crossings have, and with a larger one that is assumed, which is too cautious.

    The mean error of so many sequences is itself known to 0.3 to 0.4 dB.
    """
    law, bench = pixel.crossing_law(40.0), replace(BENCH, crossing_noise=least_noise)
    assert law is not None
    bound, reached, expected, away = [], [], [], []
    for seed in range(TO_REACH_THE_BOUND):
        bound.append(prior().error(event_information(light(), truth(seed), law, bench, seed=seed)[0][0, 0]))
        found = estimated(seed, least_noise, pixel)
        reached.append(error(found, seed))
        expected.append(found.expected_error)
        away.append(np.abs(found.image - prior().image(truth(seed))) / found.deviation)
    over, beyond = (10 * np.log10(np.mean(reached) / np.mean(one)) for one in (bound, expected))
    covered = float(np.mean(np.array(away) < 1.645))
    print(f"{over:.2f} dB over the bound, {beyond:.2f} dB over what is expected, {covered:.0%} covered")
    assert over < behind_db
    assert 0.87 < covered < 0.96
    assert -1.25 < beyond < 0.45


def test_nothing_is_biased() -> None:
    """Neither contrast nor thresholds drift, and the few events without cause are found."""
    pairs = [(estimated(s).z, truth(s)) for s in range(SEQUENCES)]
    contrast = sum(float(z @ true) for z, true in pairs) / sum(float(z @ z) for z, _ in pairs)
    assert contrast == pytest.approx(1.0, abs=0.06)  # of the truth on the estimate: shrinkage is no bias
    factors = np.array([estimated(s).thresholds for s in range(SEQUENCES)])
    np.testing.assert_allclose(factors.mean(axis=0), 1.0, atol=0.03)
    assert abs(np.mean([estimated(s).leak for s in range(SEQUENCES)])) < 2e-3
    assert 0.0 < np.mean([estimated(s).noise_share for s in range(SEQUENCES)]) < 0.1


@pytest.mark.parametrize("from_truth", [False, True])
def test_many_noise_events_are_told_from_signals(from_truth: bool) -> None:
    """Where three events of ten are noise, an event must not confirm itself by its own say on its threshold."""
    noisy = replace(PIXEL, shot_noise_rate_hz=0.2)
    law, settings = noisy.crossing_law(40.0), LikelihoodSettings(least_noise=EXACT)
    found, reached, away = [], [], []
    for seed in range(4):
        start = truth(seed) if from_truth else None
        one = estimate_sequence(light(), prior(), law, recorded(seed, noisy), settings=settings, start=start)
        found.append(one)
        reached.append(error(one, seed))
        away.append(np.abs(one.image - prior().image(truth(seed))) / one.deviation)
    assert np.mean([one.noise_share for one in found]) > 0.25
    assert 10 * np.log10(np.mean(reached) / np.mean([one.expected_error for one in found])) < 0.5
    assert 0.86 < np.mean(np.array(away) < 1.645) < 0.94


def test_noise_that_carries_crossings_ahead_is_no_contrast() -> None:
    """A turn of the light then needs less than a threshold; who does not know it is further from the truth."""
    law, errors, covered = DIM.crossing_law(40.0), {}, {}
    assert 0.02 < law.ahead < 0.06
    for ahead in (0.0, law.ahead):
        known = replace(law, ahead=ahead)
        ones = [estimate_sequence(light(), prior(), known, recorded(seed, DIM)) for seed in range(12)]
        away = [np.abs(one.image - prior().image(truth(s))) / one.deviation for s, one in enumerate(ones)]
        errors[ahead] = np.array([error(one, s) for s, one in enumerate(ones)])
        covered[ahead] = np.mean(np.array(away) < 1.645)
    gains = 10 * np.log10(errors[0.0] / errors[law.ahead])
    assert gains.mean() > 0.5 and gains.mean() > 3 * gains.std() / np.sqrt(len(gains))
    assert covered[law.ahead] > max(covered[0.0], 0.8)


def test_it_stays_at_the_truth() -> None:
    """Started there it ends where it ends from the prior's mean, as near to the truth as the bound allows."""
    errors, expected = [], []
    for seed in range(SEQUENCES):
        found = estimate_sequence(
            light(),
            prior(),
            PIXEL.crossing_law(40.0),
            recorded(seed),
            settings=LikelihoodSettings(least_noise=EXACT),
            start=truth(seed),
        )
        assert error(found, seed) < 1.5 * error(estimated(seed), seed)
        errors.append(error(found, seed))
        expected.append(found.expected_error)
    assert np.mean(errors) < 1.33 * np.mean(expected)


def test_a_pixel_without_noise_shows_nearly_everything() -> None:
    ideal = EventPixel(0.12, 0.14, 0.0, 0.0, 0.0, 0.0, initial_phase="rest")
    settings = LikelihoodSettings(least_noise=EXACT)
    found = estimate_sequence(light(), prior(), ideal.crossing_law(), recorded(0, ideal), settings=settings)
    assert found.noise == pytest.approx(0.003, rel=0.1)
    assert error(found, 0) < 2.0 * found.expected_error < 0.02 * np.square(prior().patterns).sum() / 64


def test_frames_are_the_textbook_estimate() -> None:
    """Against dense algebra over all samples, with the pattern's offsets in the covariance."""
    camera = FrameCamera(prnu=0.0, dsnu_e=60.0, full_well_e=4000.0, read_noise_e=8.0, pattern_seed=3)
    times = light().times_s[4::20]
    chosen = np.arange(0, 640, 40)
    part = replace(light(), left=light().left[chosen], still=light().still[chosen], shape=(1, len(chosen)))
    frames = camera.expose(part(truth(1))[:, 4::20].T.reshape(-1, 1, len(chosen)), 1)
    levels = frames.reshape(len(times), -1) / camera.white
    term = FrameTerm(part, levels, times, camera, False)
    mean = torch.from_numpy(levels.mean(axis=0))
    pixel, at = np.tile(np.arange(len(chosen)), len(times)), np.repeat(times, len(chosen))
    rows, still = part.rows(pixel, at), part.at(part(np.zeros(COUNT)), pixel, at)
    covariance = np.diag(np.tile(camera.noise_variance(mean).numpy(), len(times)))
    covariance += np.where(pixel[:, None] == pixel, camera.pattern_variance(mean).numpy()[pixel], 0.0)
    weighed = np.linalg.solve(covariance, np.column_stack([rows, levels.ravel() - still]))
    np.testing.assert_allclose(term.normal.information, rows.T @ weighed[:, :-1], rtol=1e-4, atol=1e-2)
    found = estimate_sequence(part, prior(), frames=term)
    expected = np.linalg.solve(np.eye(COUNT) + rows.T @ weighed[:, :-1], rows.T @ weighed[:, -1])
    np.testing.assert_allclose(found.z, expected, atol=1e-4)


def test_both_know_no_less_than_either() -> None:
    camera = FrameCamera(full_well_e=3000.0, read_noise_e=30.0)
    pairs = []
    for seed in range(4):
        term = photographed(seed, camera, False)
        frames = estimate_sequence(light(), prior(), frames=term)
        both = estimate_sequence(
            light(),
            prior(),
            PIXEL.crossing_law(40.0),
            recorded(seed),
            term,
            LikelihoodSettings(least_noise=EXACT),
        )
        assert both.expected_error < min(frames.expected_error, 1.02 * estimated(seed).expected_error)
        pairs.append([error(one, seed) for one in (both, frames, estimated(seed))])
    both_error, *alone = np.mean(pairs, axis=0)
    assert both_error < 1.05 * min(alone)


def test_the_result_does_not_depend_on_blocks() -> None:
    settings = LikelihoodSettings(block=37, least_noise=EXACT)
    found = estimate_sequence(light(), prior(), PIXEL.crossing_law(40.0), recorded(0), settings=settings)
    np.testing.assert_allclose(found.z, estimated(0).z, atol=1e-5)


def test_a_sensor_that_was_measured_tells_more() -> None:
    """Thresholds that are known to a tenth of the mismatch bring what is estimated nearer to the truth."""
    shape, squares, hits = light().shape, np.zeros(2), list[float]()
    for seed in range(3):
        pixel = replace(PIXEL, pattern_seed=seed + 20)
        law, events = pixel.crossing_law(40.0), simulated(seed, pixel)
        assert law is not None
        draw, err = np.random.default_rng(seed), np.full(shape, 0.002)
        true = pixel_thresholds(pixel, shape, 0, None)
        on, off = (one.reshape(shape) + draw.normal(0, 0.002, shape) for one in true)
        known = replace(law, known=PixelMaps(on, off, err, err, np.zeros(shape, np.bool_)))
        for k, each in enumerate((law, known)):
            record = record_of(events, each, (0.0, BENCH.duration_s), 0.4)
            found = estimate_sequence(
                light(), prior(), each, record, settings=LikelihoodSettings(least_noise=EXACT)
            )
            squares[k] += error(found, seed)
        away = np.abs(found.image - prior().image(truth(seed)))
        hits.append(float((away <= 1.645 * found.deviation).mean()))
    assert squares[1] < 0.5 * squares[0]
    assert np.mean(hits) > 0.85


def test_what_is_known_of_thresholds_and_hot_pixels() -> None:
    """Maps of nothing known change nothing; hot pixels are gone; no threshold is surer than the rest allows."""
    law, shape, events = PIXEL.crossing_law(40.0), light().shape, simulated(0)
    assert law is not None
    on, off, err = (np.full(shape, one) for one in (law.threshold_on, law.threshold_off, law.threshold_sigma))
    maps = PixelMaps(on, off, err, err, np.zeros(shape, np.bool_))
    settings, span = LikelihoodSettings(least_noise=EXACT), (0.0, BENCH.duration_s)
    alike = replace(law, known=maps)
    found = estimate_sequence(light(), prior(), alike, record_of(events, alike, span, 0.4), settings=settings)
    np.testing.assert_allclose(found.z, estimated(0).z, atol=1e-9)
    hot = np.random.default_rng(3).random(shape) < 0.2
    without = record_of(events, replace(law, known=replace(maps, hot=hot)), span, 0.4)
    whole = recorded(0)
    expected = whole.of_pixels(~hot.ravel()[whole.pixel])
    for name in ("pixel", "t_s", "sign", "origin"):
        np.testing.assert_array_equal(getattr(without, name), getattr(expected, name))
    sure = replace(law, known=replace(maps, error_on=np.full(shape, 0.005), error_off=np.full(shape, 0.05)))
    mean, deviation = sure.doubted(0.012).thresholds(hot.size)
    assert mean.reshape(-1, 2) == pytest.approx(np.tile([law.threshold_off, law.threshold_on], (hot.size, 1)))
    assert deviation.reshape(-1, 2) == pytest.approx(np.tile([0.05, 0.013], (hot.size, 1)))


def test_what_is_refused() -> None:
    with pytest.raises(ConfigError, match="neither frames nor events"):
        estimate_sequence(light(), prior())
    with pytest.raises(ConfigError, match="without the law"):
        estimate_sequence(light(), prior(), record=recorded(0))
    with pytest.raises(ConfigError, match="positive"):
        LikelihoodSettings(gap_s=0.0)
    with pytest.raises(DataError, match="one row a frame"):
        FrameTerm(light(), np.zeros((2, 3)), np.zeros(2), FrameCamera(), True)


def test_the_command_says_what_it_cannot_do(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["invert", "shot", "--setup", "main-near", "--from", "events", "--positions", "3"])
    assert "--from takes whole sequences" in capsys.readouterr().err


@pytest.mark.parametrize("pixel", [PIXEL, NOISY, DIM], ids=["few noise events", "many", "slow noise"])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_fast_estimate_is_that_of_the_slow_one(pixel: PixelSettings, seed: int) -> None:
    law = pixel.crossing_law(40.0)
    assert law is not None
    solver, unknown = EventSolver(light(), law), np.zeros(COUNT + 1)
    record = recorded(seed, pixel)
    slow = estimate_sequence(light(), prior(), law, record)
    shares = np.minimum(np.arange(12) / 9, 1.0)
    solver.improve(record, unknown, 0.25 ** (1 - shares) * 0.04**shares)
    fast = solver(simulated(seed, pixel))
    for z in (unknown[:COUNT], fast.z):  # from all pixels, and from a ninth of them first
        away = prior().image(z) - slow.image
        assert np.sqrt((away**2).mean()) < 0.35 * np.sqrt(slow.expected_error)
    own = np.eye(COUNT)
    weak, strong = fast.solutions((1.0, 10.0))
    assert np.allclose(weak, np.linalg.solve(fast.information + own, fast.score))
    assert np.linalg.norm(strong) < np.linalg.norm(weak)
    expected = np.trace(np.linalg.inv(fast.information + own)) / np.trace(slow.covariance)
    assert 0.8 < expected < 1.25


def test_what_events_say_so_far_knows_nothing_of_later_ones() -> None:
    """It says ever more, from an instant before the first event on, and at the end what all of them say."""
    law = PIXEL.crossing_law(40.0)
    assert law is not None
    solver, events, end = EventSolver(light(), law), simulated(0), float(light().times_s[-1])
    (whole,) = solver.so_far(events, np.array([end]))
    np.testing.assert_array_equal(whole.score, solver(events).score)
    first_s = 1e-6 * float(events.t_us[0])
    instants = np.array([0.5 * first_s, 0.2 * end, 0.5 * end, end])
    found = list(solver.so_far(events, instants))
    cut = events.between(0, round(5e5 * end) + 1)
    for early, again in zip(found, solver.so_far(cut, instants[:-1]), strict=False):
        np.testing.assert_array_equal(early.z, again.z)
    told = [np.linalg.slogdet(np.eye(COUNT) + one.information)[1] for one in found]
    assert all(before < after for before, after in pairwise(told)) and told[0] < 0.05 * told[-1]
    away = prior().image(found[-1].z) - prior().image(whole.z)  # by another way
    assert np.sqrt((away**2).mean()) < 0.1 * np.sqrt(
        prior().variance(np.linalg.inv(found[-1].information)).mean()
    )


@pytest.mark.parametrize(("stride", "rank"), [(1, 200), (3, 200), (4, 2)])
def test_the_light_of_some_rows_and_columns_is_that_of_all(stride: int, rank: int) -> None:
    z, whole = np.random.default_rng(stride).normal(size=COUNT), light()
    part = whole.every(stride, rank)
    cut = replace(whole, left=whole.left[:, :rank], right=whole.right[:, :rank])(z).reshape(*whole.shape, -1)
    assert part.shape == cut[::stride, ::stride].shape[:2]
    np.testing.assert_allclose(part(z), cut[::stride, ::stride].reshape(len(part.left), -1), atol=1e-12)


def test_the_surface_shows_the_target(tmp_path: Path) -> None:
    """Through simulation, shards and a network: what is stored is the target, twice, where it was."""
    glyphs = HandwritingGlyphs(writers=1, characters="EH")
    setup = replace(SETUP, gain=1.6)
    config = Simulation(glyphs=glyphs, duration_s=8.0, positions=8, setup=setup, validation=0.0)
    save_yaml(to_dict(config), tmp_path / "setup.yaml")
    sampling = Sampling(surface="likelihood", setup=str(tmp_path / "setup.yaml"))
    dataset = simulate(replace(config, sampling=sampling), tmp_path / "made")
    samples = NlosDataset(dataset, "train", "event")
    rows = sampling.scored
    truth = samples.truth[:, rows].float()
    for image in samples.inputs[:, :, rows].float().unbind(1):
        own = psnr(image, truth).mean()
        assert (
            own > psnr(truth.flip(0), truth).mean() + 1
            and own > psnr(torch.zeros_like(truth), truth).mean() + 1
        )
    network = SequenceConfig(width=4, depth=1, rank=8).build("event", sampling)
    assert network.embedding.rank == 0 and network.embedding.images == 2
    fused = SequenceConfig(width=4, depth=1, rank=8, ridge_multipliers=(0.1, 1.0)).build("fusion", sampling)
    assert fused.embedding.images == 4 and fused.embedding(torch.rand(1, 3, 64, 96)).shape == (1, 4, 64, 96)


def test_the_clock_of_a_recording_does_not_matter(tmp_path: Path) -> None:
    save_yaml(to_dict(Simulation(setup=SETUP)), tmp_path / "setup.yaml")
    events, edges = simulated(0), np.arange(0, 8_000_001, 1_000_000)
    late_us = 3_217_004
    later = replace(events, t_us=events.t_us + late_us)
    moved = replace(BENCH.motion, start_s=late_us * 1e-6)
    setup, canvas = str(tmp_path / "setup.yaml"), Sampling().canvas
    first = event_images(events, edges, BENCH.motion, setup, canvas)
    assert first.shape == (8, 2, 64, 96) and first.any()
    np.testing.assert_array_equal(event_images(later, edges + late_us, moved, setup, canvas), first)


def test_the_surface_so_far_is_that_of_the_events_so_far(tmp_path: Path) -> None:
    save_yaml(to_dict(Simulation(setup=SETUP)), tmp_path / "setup.yaml")
    events, edges = simulated(0), np.arange(0, 8_000_001, 500_000)
    given = edges, BENCH.motion, str(tmp_path / "setup.yaml"), Sampling().canvas
    found = event_images(events, *given, so_far=True)
    early = event_images(events.between(0, int(edges[5]) + 1), *given, so_far=True)
    np.testing.assert_array_equal(found[:5], early[:5])
    assert not np.allclose(found[5], early[5])
    whole = event_images(events, *given)
    scale = np.square(whole[-1]).mean()
    assert np.square(found[-1] - whole[-1]).mean() < 1e-3 * scale < np.square(found[1] - whole[1]).mean()


def test_a_live_image_of_all_so_far_is_that_of_their_surface(tmp_path: Path) -> None:
    save_yaml(to_dict(Simulation(setup=SETUP)), tmp_path / "setup.yaml")
    events, edges = simulated(0), np.array([0, 8_000_000])
    sampling = Sampling(surface="likelihood", setup=str(tmp_path / "setup.yaml"))
    network = SequenceConfig(width=4, depth=1, rank=8).build("event", sampling).eval()
    surface = event_images(events, edges, BENCH.motion, sampling.setup, sampling.canvas, so_far=True)
    at = BENCH.motion.position_m(edges[1:] * 1e-6)
    inputs = network.modality.inputs(np.zeros((1, 64, 96)), surface)
    expected = network.seeing(replace(sampling, surface="so-far")).infer(inputs, at)[0].numpy()
    running = ImagesSoFar(Weights(network), BENCH.motion, (0, 8_000_000), events.shape)
    assert running.after([Chunk(events.between(0, 0), 0, 0.0, 0.0)]) is None
    for parts in (1, 3):  # of a replay that begins again
        for first, stop in pairwise(np.linspace(0, 8_000_001, parts + 1).astype(int).tolist()):
            found = running.after([Chunk(events.between(first, stop), stop - 1, 0.0, 0.0, restart=first == 0)])
        assert found is not None and found[1] == 8_000_000
        assert np.square(found[0] - expected).mean() < 1e-3 * np.square(expected).mean()


def test_the_surface_is_refused_without_setup_or_motion() -> None:
    events, edges = simulated(0), np.array([0, 4_000_000, 8_000_000])
    canvas = Sampling().canvas
    with pytest.raises(ConfigError, match="setup is empty"):
        event_images(events, edges, BENCH.motion, "", canvas)
    with pytest.raises(DataError, match="motion is unknown"):
        event_images(events, edges, None, "near", canvas)
    with pytest.raises(UnknownNameError, match=r"'near'.*is not there: give the folder"):
        event_images(events, edges, BENCH.motion, "near", canvas)


def test_what_samples_and_weights_must_share(tmp_path: Path) -> None:
    """A setup that was moved is the same one; a network of frames is not asked how events were shown."""
    for name, setup in (("here", SETUP), ("there", SETUP), ("other", replace(SETUP, gain=0.9))):
        (tmp_path / name).mkdir()
        save_yaml(to_dict(Simulation(setup=setup)), tmp_path / name / "setup.yaml")
    made = {
        name: Sampling(surface="likelihood", setup=str(tmp_path / name)) for name in ("here", "there", "other")
    }
    plan = SequenceConfig(width=4, depth=1, rank=8)
    sees = {modality: Weights(plan.build(modality, made["here"])) for modality in ("event", "frame")}
    for same in (
        made["here"],
        made["there"],
        replace(made["here"], setup=str(tmp_path / "here" / "setup.yaml")),
        replace(made["there"], surface="corrected"),
    ):
        check_sampling(sees["event"], same)
    for another in (made["other"], replace(made["here"], setup=str(tmp_path / "gone")), Sampling()):
        with pytest.raises(DataError, match="make them alike"):
            check_sampling(sees["event"], another)
    words = r"of surface sae, and these have surface likelihood; .* made with --sampling\.surface sae, or"
    with pytest.raises(DataError, match=words):
        check_sampling(Weights(plan.build("event", Sampling())), made["here"])
    with pytest.raises(DataError, match=r"and these have surface sae, setup none; .*--sampling\.setup \S*here"):
        check_sampling(sees["event"], Sampling())
    for fits in (made["other"], Sampling(surface="hots", tau_s=0.1)):
        check_sampling(sees["frame"], fits)
    with pytest.raises(DataError, match="make them alike"):
        check_sampling(sees["frame"], Sampling(height=48))


def errors_of(draw: np.random.Generator, captures: int, drift: float) -> tuple[EventErrors, np.ndarray]:
    """Return errors of captures about information A [12, 12]: noise, and along two axes what is no noise."""
    half = draw.normal(size=(12, 12)) + 4 * np.eye(12)
    root = root_of(half @ half.T)
    scores = draw.normal(size=(captures, 12)) @ root
    scores[:, 0] += 20 * drift
    scores[:, 1] += 20 * drift * draw.normal(size=captures)
    about = AboutErrors(tuple(f"c{k}" for k in range(captures)))
    roots, light = torch.tensor(root).float().repeat(captures, 1, 1), torch.full((captures,), 0.1)
    return EventErrors(about, torch.tensor(scores @ np.linalg.inv(root)).float(), roots, light), root @ root


@pytest.mark.parametrize("drift", [0.0, 1.0])
def test_what_captures_show_of_errors_helps_the_next(drift: float) -> None:
    plain, corrected = [], []
    for seed in range(40):
        draw = np.random.default_rng(seed)
        errors, a = errors_of(draw, 15, drift)
        z = draw.normal(size=12)
        own = root_of(a) @ errors.errors[3].double().numpy()  # the fourth is the next: it does not count itself
        score = a @ z + own
        statistic = EventStatistic(z, a, score)
        without = EventErrors(
            AboutErrors(errors.about.captures[:3] + errors.about.captures[4:]),
            *(part[[k for k in range(15) if k != 3]] for part in (errors.errors, errors.roots, errors.light)),
        )
        found = errors.corrected(statistic, "c3")
        np.testing.assert_allclose(found.score, without.corrected(statistic, "new").score, rtol=1e-6, atol=1e-9)
        plain.append(np.square(statistic.solutions((1.0,))[0] - z).mean())
        corrected.append(np.square(found.solutions((1.0,))[0] - z).mean())
    gain = np.mean(corrected) / np.mean(plain)
    assert gain < 0.7 if drift else gain < 1.05


def test_few_captures_change_nothing_of_what_events_say() -> None:
    errors, a = errors_of(np.random.default_rng(0), 4, 1.0)
    statistic = EventStatistic(np.zeros(12), a, np.ones(12))
    assert errors.corrected(statistic, "c2") is statistic
    assert errors.corrected(statistic, "another") is not statistic
    with pytest.raises(DataError, match="of 2 captures"):
        EventErrors(AboutErrors(("a", "b")), errors.errors, errors.roots, errors.light)


@pytest.mark.parametrize("drift", [0.0, 1.0])
def test_the_gain_of_errors_is_that_of_captures_left_out(drift: float) -> None:
    """Noise alone is no gain, what comes back is one; what a capture itself shows does not count."""
    prior, gains = PatternPrior(Plane(4, 4, 0.02), np.full(16, 0.5), np.eye(16)[:, :12] / 8, 0.0), []
    for seed in range(40):
        draw = np.random.default_rng(seed)
        errors, a = errors_of(draw, 15, drift)
        hidden = draw.normal(size=(15, 12))
        scores = hidden @ a + errors.errors.double().numpy() @ root_of(a)
        statistics = [EventStatistic(z, a, score) for z, score in zip(hidden, scores, strict=True)]
        gains.append(errors.gain_db(statistics, prior, [prior.image(z) for z in hidden]))
    assert np.mean(gains) > 1.0 if drift else abs(np.mean(gains)) < 0.25


def test_a_setup_keeps_the_errors_that_captures_show(tiny_captures: list[Path], tmp_path: Path) -> None:
    setup = RadiometricSetup(cell_m=0.01, gain=0.7, ambient=0.06, sensor=SensorSize(48, 72))
    save_yaml(to_dict(Simulation(setup=setup)), tmp_path / "setup.yaml")
    another = replace(read_capture(tiny_captures[0]), name="another_A")
    sampling = Sampling(surface="corrected", setup=str(tmp_path))
    before = capture_samples(another, replace(sampling, surface="likelihood")).surface
    # Four captures: each has three others, which change nothing, so nothing is gained; an older file goes.
    names, file = tuple(folder.name for folder in tiny_captures), tmp_path / "events.safetensors"
    file.write_bytes(b"of an earlier calibration")
    few = write_event_errors(tmp_path, tiny_captures, names)
    assert few is not None and few.about.gain_db == 0 and not gains_by_errors(tmp_path)
    file.unlink()
    with pytest.raises(DataError, match=r"has no events\.safetensors.* give --sampling\.surface likelihood"):
        capture_samples(another, sampling)
    # With a twin each, they know their own errors.
    twins = [shutil.copytree(folder, tmp_path / f"twin_{folder.name}") for folder in tiny_captures]
    said, both = list[str](), [*tiny_captures, *twins]
    errors = write_event_errors(
        tmp_path,
        both,
        [folder.name for folder in both],
        lambda step: said.append(f"{step.done} of {step.total}"),
    )
    assert errors is not None and errors.about.gain_db > 1.5 and file.is_file()
    assert errors.about.captures == tuple(folder.name for folder in both) and gains_by_errors(tmp_path)
    assert said[0] == "0 of 8" and said[-1] == "8 of 8" and torch.isfinite(errors.errors).all()
    after = capture_samples(another, sampling).surface
    assert np.abs(after - before).max() > 0.01
    # By its own name it does not count, and others correct it otherwise.
    own = capture_samples(read_capture(tiny_captures[0]), sampling).surface
    assert np.abs(own - after).max() > 0.001 and np.abs(own - before).max() > 0.01
    assert write_event_errors(tmp_path / "none", tiny_captures, ()) is None and not (tmp_path / "none").exists()
