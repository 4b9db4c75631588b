"""`evnlos pixel fit`: an event pixel from recordings under known light, and what these do not tell."""

import json
import math
from dataclasses import replace
from pathlib import Path
from statistics import NormalDist

import numpy as np
import pytest

from evnlos.calibration import (
    CANDIDATES,
    MISMATCH,
    KnownLight,
    LitFile,
    LitRecording,
    Manifest,
    PixelFitSettings,
    Surface,
    doubts_of,
    fit_candidate,
    fit_known_light,
    panels_of,
    pixel_at,
    read_lit_events,
    read_manifest,
    refractory_of,
    simulated_events,
    tick_of,
    value_of,
    waveform,
)
from evnlos.cameras import (
    BrownianPixel,
    EventPixel,
    PixelMaps,
    PixelSettings,
    load_pixel,
    load_pixel_maps,
    simulate_events,
)
from evnlos.cameras.pixels.arrays import pixel_thresholds
from evnlos.cli import main
from evnlos.cli.main import command_of
from evnlos.config import load_yaml, save_yaml, to_dict
from evnlos.data import Simulation
from evnlos.errors import ConfigError, DataError
from evnlos.events import read_events, write_events
from evnlos.setups import RadiometricSetup, SensorSize
from evnlos.types import Events

QUICK = PixelFitSettings(("continuous",), pixels=80, ensemble=16, simulations=36, checks=12)
LIGHTS = (
    (KnownLight("sine", 60.0, 2.0, 0.7), 2.0),
    (KnownLight("sine", 60.0, 20.0, 0.7), 0.3),
    (KnownLight("static", 5.0), 5.0),
    (KnownLight("static", 120.0), 5.0),
)
TRUTHS = {
    "continuous": EventPixel(0.2, 0.27, 0.02, 60.0, 0.2, 1.0),
    "brownian": BrownianPixel(0.2, 0.25, 0.015, 10.0, 0.2, 0.005, 0.3, 0.0),
}


def recorded(pixel: PixelSettings, seed: int, pixels: int = 80) -> list[LitRecording]:
    """Return what a row of pixels records under `LIGHTS`."""
    found = []
    for light, seconds in LIGHTS:
        times, level = waveform(light, seconds)
        lit = np.repeat(level[:, None].astype(np.float32), pixels, axis=1)[:, None]
        found.append(LitRecording(np.ascontiguousarray(lit), times, Events.empty(pixels, 1), known=light))
    events = simulated_events(found, pixel, seed)
    return [replace(one, events=sent) for one, sent in zip(found, events, strict=True)]


@pytest.mark.parametrize("name", TRUTHS)
def test_simulated_truth_comes_back_within_its_intervals(name: str) -> None:
    """Two draws: of some 14 intervals at 95 %, one in twenty may miss, and few miss by much."""
    truth, missed = TRUTHS[name], 0
    for seed in (1, 2):
        fit = fit_candidate(name, panels_of(recorded(truth, seed)), replace(QUICK, seed=seed))
        for one in fit.estimates:
            if one.name == MISMATCH or one.state == "not identified":
                continue
            value = getattr(truth, one.name)
            missed += not (one.low if one.state == "identified" else 0.0) <= value <= one.high
        assert fit.pixel.threshold_on == pytest.approx(truth.threshold_on, rel=0.05)
        assert fit.pixel.threshold_off == pytest.approx(truth.threshold_off, rel=0.05)
    assert missed <= 3


def test_a_place_beside_the_likeliest_is_told_by_how_far_simulations_scatter() -> None:
    """Of twenty numbers that say little more than three do, a wrong place misses by far less than twenty."""
    draw = np.random.default_rng(3)
    slope, mixing = draw.standard_normal((3, 20)), draw.standard_normal((12, 20))
    error = 0.01 * mixing.T @ mixing + 1e-4 * np.eye(20)
    stated = error + 0.05 * np.diag(np.diag(error))  # as a floor under what scatters makes it
    root = np.linalg.cholesky(error)
    design = 0.1 * draw.standard_normal((120, 3))
    made = design @ slope + draw.standard_normal((120, 20)) @ root.T
    surface = Surface.fitted(design, made, np.zeros(3), 0.1**2 * np.eye(3))
    recorded, aside = draw.standard_normal((12, 20)) @ root.T, 0.3 * draw.standard_normal((12, 20))
    right = [surface.posterior(one, stated, draw)[1] for one in recorded]
    wrong = [surface.posterior(one, stated, draw)[1] for one in recorded + aside]  # what no number explains
    assert np.median(right) < 1 and max(right) < 2
    assert min(wrong) > 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A manifest and recordings of a small sensor with a refractory period."""
    path = tmp_path_factory.mktemp("recordings")
    truth = EventPixel(0.2, 0.26, 0.02, 80.0, 0.15, 0.8, 1e-3, pattern_seed=4)
    listed = []
    for k, (light, seconds) in enumerate(
        ((KnownLight("square", 70.0, 4.0, 0.85), 1.5), (KnownLight("static", 8.0), 5.0))
    ):
        times, level = waveform(light, seconds)
        frames = np.repeat(level.astype(np.float32), 24 * 24).reshape(len(times), 24, 24)
        write_events(path / f"r{k}.npz", simulate_events(frames, times, truth, seed=k))
        listed.append(LitFile(f"r{k}.npz", light))
    save_yaml(Manifest(tuple(listed)), path / "pixel_fit.yaml")
    return path


def known_of_each_pixel(out: Path) -> None:
    """The thresholds are those of the sensor, with the errors that are stated: nobody has to shrink them."""
    sensor = EventPixel(0.2, 0.26, 0.02, 80.0, 0.15, 0.8, 1e-3, pattern_seed=4)
    maps, shape = load_pixel_maps(out / "pixel.yaml"), (24, 24)
    assert maps is not None and not maps.hot.any()
    both = zip((maps.on, maps.off), (maps.error_on, maps.error_off), strict=True)
    for (mean, error), true in zip(both, pixel_thresholds(sensor, shape, 0, None), strict=True):
        away = mean.ravel() - true
        assert away.std() == pytest.approx(np.sqrt(np.square(error).mean()), rel=0.25)
        assert away.std() < 0.6 * true.std()
        assert np.polyfit(mean.ravel(), true, 1)[0] == pytest.approx(1.0, abs=0.12)
    # of what is not known a draw, which is the drawn sensor where nothing is known
    drawn = pixel_thresholds(sensor, shape, 0, maps)
    normal = (pixel_thresholds(sensor, shape, 0, None)[0] - 0.2) / 0.02
    assert drawn[0] == pytest.approx(maps.on.ravel() + maps.error_on.ravel() * normal)
    on, off, error = (np.full(shape, value) for value in (0.2, 0.26, 0.02))
    unknown = PixelMaps(on, off, error, error, np.zeros(shape, np.bool_))
    frames, times = np.linspace(20, 200, 8)[:, None, None] * np.ones((8, *shape)), np.arange(8) / 50
    plain = simulate_events(frames, times, sensor, seed=3)
    assert simulate_events(frames, times, sensor, seed=3, thresholds=unknown) == plain
    with pytest.raises(ConfigError, match="the sensor is 6 x 6"):
        simulate_events(frames[:, :6, :6], times, sensor, thresholds=maps)


def seen_by_the_same_sensor(out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`evnlos events` takes the thresholds for a video of the sensor's size, unless flags say others."""
    np.save(tmp_path / "seen.npy", np.linspace(20, 200, 8)[:, None, None] * np.ones((8, 24, 24)))
    words = ["events", str(tmp_path / "seen.npy"), "--fps", "50", "--json", "--force"]
    words += ["--pixel", str(out / "pixel.yaml"), "--out", str(tmp_path / "seen.npz")]
    for more, known, note in (
        ([], True, ""),
        (["--pixel.pattern-seed", "3"], False, ""),
        (["--scale", "12x12"], False, "thresholds are drawn"),
    ):
        capsys.readouterr()
        main([*words, *more])
        shown = capsys.readouterr()
        assert json.loads(shown.out)["measured_thresholds"] is known and note in shown.err


def test_a_sensor_that_was_measured_is_known_to_the_inversion(
    tiny_captures: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shape, fitted = (48, 72), tmp_path / "fit"
    fitted.mkdir()
    pixel = EventPixel(0.21, 0.24, 0.04, 40.0, 0.05, 0.08)
    save_yaml(pixel, fitted / "pixel.yaml")
    setup = RadiometricSetup(cell_m=0.01, gain=0.7, ambient=0.06, sensor=SensorSize(*shape))
    save_yaml(to_dict(Simulation(setup=setup)), tmp_path / "setup.yaml")

    def measured(
        on: float, error: float, hot: int, size: tuple[int, int] = shape, folder: Path = fitted
    ) -> None:
        names = "threshold_on", "threshold_off", "error_on", "error_off"
        maps = {name: np.full(size, value) for name, value in zip(names, (on, 0.24, error, error), strict=True)}
        flags = np.zeros(size, np.bool_)
        flags.ravel()[:hot] = True
        np.savez(folder / "pixel_maps.npz", **maps, hot=flags)

    def inverted(*words: str) -> np.ndarray:
        given = [str(tiny_captures[0]), "--setup", str(tmp_path / "setup.yaml"), "--from", "events"]
        out = ["--out", str(tmp_path / "found.png"), "--force", "--json"]
        main(["invert", *given, *out, *words])
        capsys.readouterr()
        return np.load(tmp_path / "found.npz")[tiny_captures[0].name]

    known = "--pixel", str(fitted / "pixel.yaml")
    plain = inverted(*known)
    assert np.abs(plain - inverted()).max() > 0.01  # the setup's own pixel is another
    measured(0.21, 0.04, 0)
    assert inverted(*known) == pytest.approx(plain, abs=1e-6)  # nothing is known of any pixel
    measured(0.3, 0.04, 0)
    other = inverted(*known)
    assert np.abs(other - plain).max() > 0.01
    measured(0.21, 0.04, 800)
    assert np.abs(inverted(*known) - plain).max() > 0.001
    own = inverted()
    measured(0.3, 0.04, 0, folder=tmp_path)  # as in the folder of a calibrated setup
    assert np.abs(inverted() - own).max() > 0.01
    for size, word in (((24, 72), "48"), ((72, 48), "48")):
        measured(0.21, 0.04, 0, size)
        with pytest.raises(SystemExit):
            inverted(*known)
        told = capsys.readouterr().err
        assert f"are of {size[1]} x {size[0]} pixels, the event camera has 72 x {word}" in told
    with pytest.raises(SystemExit):
        inverted(*known, "--from", "frames")
    assert "--from events or both" in capsys.readouterr().err
    (fitted / "pixel_maps.npz").write_bytes(b"no archive")
    with pytest.raises(DataError, match="holds no thresholds of a sensor"):
        load_pixel_maps(fitted)
    np.savez(fitted / "pixel_maps.npz", hot=np.zeros(shape))
    with pytest.raises(DataError, match="holds no thresholds of a sensor"):
        load_pixel_maps(fitted)
    assert load_pixel_maps("davis346") is None and load_pixel_maps(tmp_path / "none") is None


def test_the_command_writes_a_pixel_that_other_commands_take(folder, tmp_path, capsys) -> None:
    out = tmp_path / "fit"
    words = [
        "--models",
        "continuous",
        "--pixels",
        "80",
        "--ensemble",
        "16",
        "--simulations",
        "36",
        "--checks",
        "12",
    ]
    main(["pixel", "fit", str(folder / "pixel_fit.yaml"), "--out", str(out), *words])
    shown = capsys.readouterr().out
    assert "threshold_on" in shown and "predictive checks" in shown
    values = json.loads((out / "pixel_fit.json").read_text())
    found = {one["name"]: one for one in values["estimates"]}
    assert found["refractory_s"]["value"] == pytest.approx(1e-3, abs=3e-6)
    assert found["threshold_on"]["value"] == pytest.approx(0.2, rel=0.06)
    assert {one["name"] for one in values["checks"]} >= {"ON / OFF", "share of alternating pairs"}
    maps = np.load(out / "pixel_maps.npz")
    assert maps["threshold_on"].shape == (24, 24) and (maps["error_on"] > 0).all()
    assert set(values["maps"]["state"]) <= {"identified", "not identified"}
    known_of_each_pixel(out)
    seen_by_the_same_sensor(out, tmp_path, capsys)
    pixel = load_yaml(PixelSettings, out / "pixel.yaml")
    assert pixel == load_pixel(str(out / "pixel.yaml"))
    assert (
        getattr(pixel, "pixel", pixel).initial_phase == "random"
    )  # that of the simulations it was fitted with
    np.save(tmp_path / "video.npy", np.linspace(20, 200, 8)[:, None, None] * np.ones((8, 6, 6)))
    main(["events", str(tmp_path / "video.npy"), "--fps", "50", "--pixel", str(out / "pixel.yaml"),
          "--out", str(tmp_path / "e.npz")])  # fmt: skip
    assert (tmp_path / "e.npz").exists()
    with pytest.raises(SystemExit) as stop:
        main(["pixel", "fit", str(folder / "pixel_fit.yaml"), "--out", str(out), *words])
    assert stop.value.code == 2 and "--force" in capsys.readouterr().err


def test_a_pixel_that_describes_no_sensor_is_not_recommended(shared_data, tmp_path, capsys) -> None:
    """The light of this recording moves; nothing is constant about it."""
    path = shared_data / "recordings" / "faery_dvs.es"
    if not path.is_file():
        pytest.skip(f"no {path.name}")
    words = ["--models", "continuous", "--pixels", "80", "--ensemble", "12", "--simulations", "30"]
    with pytest.raises(SystemExit) as stop:
        main(["pixel", "fit", str(path), "--light", "static", "60", "--out", str(tmp_path / "fit"), *words])
    shown = capsys.readouterr()
    assert stop.value.code == 1 and "does not describe this sensor" in shown.err
    assert "events of it:" not in shown.out and (tmp_path / "fit" / "pixel.yaml").exists()
    assert not json.loads((tmp_path / "fit" / "pixel_fit.json").read_text())["describes_the_sensor"]


def test_the_settings_of_other_commands_take_the_pixel(tmp_path) -> None:
    from evnlos.calibration import Calibration
    from evnlos.data import Simulation

    save_yaml(BrownianPixel(0.21, 0.22), tmp_path / "pixel.yaml")
    word = str(tmp_path / "pixel.yaml")
    assert command_of("simulate").with_pixel(Simulation(), word).pixel == BrownianPixel(0.21, 0.22)
    kept = command_of("calibrate").with_pixel(Calibration(), word)
    assert kept.start.pixel == BrownianPixel(0.21, 0.22) and not kept.events


def test_unknown_light_identifies_no_threshold(folder) -> None:
    found = fit_known_light(Manifest((LitFile(str(folder / "r0.npz")),)))
    assert found.pixel is None and found.refractory.state == "identified"
    assert any("not identified" in line for line in found.warnings)


def test_the_scale_of_a_number_and_its_inverse() -> None:
    for start, free in CANDIDATES.values():
        u = np.linspace(-1, 1, len(free))
        pixel = pixel_at(start, free, u)
        for k, one in enumerate(free):
            value = float(value_of(one, u[k]))
            low, high, at = (math.log(n) if one.log else n for n in (one.low, one.high, value))
            assert NormalDist().inv_cdf((at - low) / (high - low)) == pytest.approx(u[k], abs=1e-9)
            if one.name != MISMATCH:
                assert getattr(pixel, one.name) == pytest.approx(value)


def test_time_stamps_on_a_grid_are_no_refractory_period() -> None:
    draw = np.random.default_rng(0)
    times = np.sort(draw.integers(0, 2000, 20_000)) * 1000
    place = draw.integers(0, 8, (2, 20_000))
    events = Events(times, place[0], place[1], draw.random(20_000) < 0.5, 8, 8)
    assert tick_of(events) == 1000
    assert refractory_of([events]).state != "identified"


def test_a_sensor_s_scan_is_no_refractory_period(shared_data) -> None:
    """Intervals on a comb tell how often a sensor is read; the free ones above a pile, that it was blind."""
    draw, pixels = np.random.default_rng(0), 60

    def events_of(intervals: np.ndarray) -> Events:
        times = np.cumsum(np.round(intervals).astype(np.int64), axis=1).ravel()
        order = np.argsort(times, kind="stable")
        x = np.repeat(np.arange(pixels), intervals.shape[1])[order]
        return Events(times[order], x, 0 * x, np.ones(len(x), bool), pixels, 1)

    free = 200 + np.where(draw.random((pixels, 80)) < 0.4, 0, draw.exponential(500, (pixels, 80)))
    assert refractory_of([events_of(free)]).state == "identified"
    scanned = 195.0 * draw.geometric(0.3, (pixels, 80)) + draw.integers(-1, 2, (pixels, 80))
    assert refractory_of([events_of(scanned)]).state == "at most"
    recordings = sorted((shared_data / "recordings").glob("*"))
    if not recordings:
        pytest.skip("no recordings")
    for path in recordings:
        if path.suffix not in (".npz", ".json"):  # those say what is in the others
            assert refractory_of([read_events(path)]).state != "identified", path.name


def test_light_that_moves_is_not_called_constant() -> None:
    times = np.sort(np.random.default_rng(0).integers(0, 500_000, 4000))
    events = Events(times, times % 8, times % 7, times % 2 == 0, 8, 8)
    still = KnownLight("static", 10.0)
    from evnlos.calibration import LitEvents

    assert any("not" in line for line in doubts_of(LitEvents("a", events, still, 2.0, np.ones((8, 8), bool))))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("sinus", "3"), "give one of"),
        (("sine", "3"), "1 values"),
        (("sine", "3", "x"), "not all are numbers"),
        (("sine", "3", "1.5"), "contrast is 1.5"),
        (("edge", "1", "100"), "above or below 1"),
        (("static", "-1"), "level is -1"),
    ],
)
def test_wrong_light_is_one_line(words, said) -> None:
    with pytest.raises(ConfigError, match=said):
        KnownLight.of(words)


def test_wrong_input_is_one_line(folder, tmp_path) -> None:
    with pytest.raises(ConfigError, match="leave --light out"):
        read_manifest(folder / "pixel_fit.yaml", KnownLight("static"))
    with pytest.raises(ConfigError, match="lists no recordings"):
        Manifest(())
    with pytest.raises(ConfigError, match="leaves the"):
        read_lit_events(LitFile(str(folder / "r0.npz"), KnownLight("static"), box=(20, 0, 10, 4)))
    with pytest.raises(DataError, match="register the frames"):
        np.save(tmp_path / "small.npy", np.full((5, 8, 8), 90.0))
        read_lit_events(
            LitFile(str(folder / "r0.npz"), KnownLight("frames", frames=str(tmp_path / "small.npy"), fps=5.0))
        )
    with pytest.raises(ConfigError, match="no model 'v2e'"):
        PixelFitSettings(("v2e",))
    write_events(tmp_path / "few.npz", Events([1, 5000], [0, 1], [0, 1], [1, 0], 40, 40))
    with pytest.raises(DataError, match="100 or more"):
        fit_known_light(Manifest((LitFile(str(tmp_path / "few.npz"), KnownLight("static")),)), QUICK)


@pytest.mark.parametrize("name", ["faery_dvs.es", "expelliarmus_evt2_sample.raw", "faery_evt2.raw"])
def test_real_recordings_without_known_light(shared_data, name: str) -> None:
    path = shared_data / "recordings" / name
    found = fit_known_light(Manifest((LitFile(str(path)),)), QUICK)
    assert found.pixel is None and found.refractory.state != "identified"
    assert not any("flicker" in line for line in found.warnings)


RECORDINGS = (
    "aedat2_davis346.aedat", "aedat31_davis346.aedat", "ecf_evt3_sample.h5", "ecf_gaps.h5", "ecf_masks.h5",
    "ecf_partial.h5", "ecf_random.h5", "ecf_rows.h5", "expelliarmus_evt2_sample.raw",
    "expelliarmus_evt3_sample.raw", "faery_dvs.es", "faery_evt2.raw", "ros1_evt3_640x480.bag",
    "ros2_evt3_640x480.db3", "ros2_evt3_zstd.mcap", "ros2_libcaer_cmp_346x260.mcap",
    "ros2_libcaer_dvxplorer.db3",
)  # fmt: skip
PHYSICS = {
    "threshold_on": (0.01, 2.0), "threshold_off": (0.01, 2.0), "threshold_sigma": (0.0, 1.0),
    MISMATCH: (0.0, 1.0), "refractory_s": (0.0, 1.0), "cutoff_hz": (0.1, 1e5), "leak_rate_hz": (0.0, 100.0),
    "shot_noise_rate_hz": (0.0, 1e3),
}  # fmt: skip
"""Between what a number of an event pixel lies: log units, shares of a threshold, s, Hz."""


def fitted_without_embarrassment(path, light: tuple[str, ...], out, capsys, pixels: str) -> bool:
    """Return whether a recording was fitted: else it was refused in one line; what is said holds water."""
    if not path.is_file():
        pytest.skip(f"no {path.name}")
    words = [
        "--models",
        "continuous",
        "--pixels",
        pixels,
        "--ensemble",
        "12",
        "--simulations",
        "30",
        "--checks",
        "10",
    ]
    try:
        main(["pixel", "fit", str(path), "--light", *light, "--out", str(out), *words])
        code = 0
    except SystemExit as stop:
        code = stop.code
    said = capsys.readouterr().err
    if code == 2:
        assert not out.exists()
        lines = [line for line in said.splitlines() if not line.startswith(("read:", "fit "))]
        assert len(lines) == 1 and " error: " in lines[0]
        return False
    values = json.loads((out / "pixel_fit.json").read_text())
    assert code == (0 if light == ("unknown",) or values["describes_the_sensor"] else 1)
    assert (out / "pixel.yaml").exists() == (values["model"] is not None)
    ranges = {one.name: one for one in CANDIDATES["continuous"][1]}
    for one in values["estimates"] + [each for found in values["all_estimates"].values() for each in found]:
        if one["state"] == "not identified":
            continue
        least, most = PHYSICS[one["name"]]
        assert least <= one["low"] <= one["value"] <= one["high"] <= most, one
        if one["state"] == "identified" and one["name"] in ranges:
            free = ranges[one["name"]]
            low, high = (
                math.log(one[end] / free.low) / math.log(free.high / free.low) for end in ("low", "high")
            )
            assert 0.04 < low < high < 0.96, one  # the ends of what was searched say nothing
    for seen in values["recordings"].values():
        assert seen["seconds"] > 0 and all(math.isfinite(value) for value in seen.values())
    return True


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_real_recording_embarrasses_nobody(shared_data, name: str, tmp_path, capsys) -> None:
    """Whatever light is stated: unknown, its own frames, or a constant one that it did not have."""
    path = shared_data / "recordings" / name
    assert fitted_without_embarrassment(path, ("unknown",), tmp_path / "unknown", capsys, "48")
    assert not fitted_without_embarrassment(path, ("frames",), tmp_path / "frames", capsys, "48")
    if name != "faery_dvs.es":  # of which a test above fits it
        fitted_without_embarrassment(path, ("static", "60"), tmp_path / "static", capsys, "48")


def test_many_pixels_of_real_recordings_embarrass_nobody(shared_data, tmp_path, capsys) -> None:
    fitted = [
        name
        for name in RECORDINGS
        if fitted_without_embarrassment(
            shared_data / "recordings" / name, ("static", "60"), tmp_path / name, capsys, "480"
        )
    ]
    assert len(fitted) > 4


def test_the_scatter_of_pixels_knows_that_they_share_a_phase() -> None:
    """Where a sine begins is told by all pixels' events: the harmonics' means scatter as the pixels say."""
    recordings = [one for one in recorded(TRUTHS["continuous"], 1) if one.known.kind == "sine"][1:]
    panels = panels_of(recordings)
    about = panels.statistics.mean(axis=0)
    drawn = [panels.simulate(TRUTHS["continuous"], seed) for seed in range(160)]
    means = np.array([panels.scale.of(one) for one in drawn])
    stated = np.mean([panels.scale.covariance(one, about) for one in drawn], axis=0)
    whitened = np.linalg.solve(np.linalg.cholesky(stated[-4:, -4:] + 1e-6 * np.eye(4)), means[:, -4:].T)
    assert np.linalg.eigvalsh(np.cov(whitened)).max() < 2.2  # of one phase for each pixel: 4 to 7
