"""The Brownian pixel against closed forms of a drifting walk, a slow reference, and DVS-Voltmeter's law."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from evnlos.cameras import BrownianPixel, EventStream, simulate_events
from evnlos.errors import ConfigError
from evnlos.types import Events

NOISY = BrownianPixel.voltmeter(1.0, 20.0, 0.01, 1e-15, 0.0, 0.001)
"""sigma = 1.833e-3 thresholds per sqrt(us) at 100 DN, practically no drift: 3.361 Hz."""


def constant(level: float, seconds: float, frames: int, pixels: int = 1600) -> tuple[np.ndarray, np.ndarray]:
    return np.full((frames + 1, 1, pixels), level), np.linspace(0.0, seconds, frames + 1)


def sent(light: np.ndarray, times, pixel: BrownianPixel, seed: int = 0) -> Events:
    """Return the events of light in single precision, as walls send it: no kernel is compiled for another."""
    return simulate_events(light.astype(np.float32), times, pixel, seed=seed)


def rates(events, seconds: float, pixels: int = 1600) -> tuple[float, float]:
    return float(events.p.sum()) / pixels / seconds, float((~events.p).sum()) / pixels / seconds


def first_exits(events, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return time in seconds and polarity of each pixel's first event."""
    _, first = np.unique(events.x, return_index=True)
    assert len(first) == pixels
    return events.t_us[first] * 1e-6, events.p[first]


def drift_and_noise(pixel: BrownianPixel, light: float) -> tuple[float, float]:
    """Return the leak's drift, log units per s, and the noise, log units per sqrt(s), in constant light, DN."""
    drift = pixel.threshold_on * (pixel.leak_rate_hz + pixel.leak_rate_per_dn_hz * light)
    return drift, pixel.photon_noise * math.sqrt(light) / (light + pixel.dark_dn) + pixel.dark_noise


def reference(pixel: BrownianPixel, level: float, seconds: float, step_s: float, runs: int, seed: int):
    """Return first exit times and polarities of the equation in constant light, by small steps alone."""
    draw = np.random.default_rng(seed)
    drift, noise = drift_and_noise(pixel, level)
    x, time = np.zeros(runs), np.full(runs, np.nan)
    on = np.zeros(runs, bool)
    for k in range(round(seconds / step_s)):
        x += drift * step_s + noise * math.sqrt(step_s) * draw.normal(size=runs)
        out = np.isnan(time) & ((x >= pixel.threshold_on) | (x <= -pixel.threshold_off))
        time[out], on[out] = (k + 1) * step_s, x[out] > 0
    return time, on


@pytest.mark.parametrize(("drift", "seconds"), [(0.0, 40.0), (1.0, 40.0), (-2.0, 10.0)])
@pytest.mark.parametrize("frames", [1, 100])
def test_exit_of_a_drifting_walk_has_its_closed_forms(drift, seconds, frames) -> None:
    """P(ON first) = 1 / (1 + e^-c); E[T] = tanh(c / 2) / mu; E[e^-lT] a ratio of two cosh."""
    sigma, count = 1.0, 20_000  # log units per sqrt(s); thresholds are 1
    pixel = replace(
        NOISY, dark_noise=sigma, photon_noise=0.0, leak_rate_hz=max(drift, 0.0), initial_phase="rest"
    )
    times = np.linspace(0.0, seconds, frames + 1)
    light = 20.0 * np.exp(min(drift, 0.0) * (times - seconds)) - 20.0  # ln(L + k) falls along a line
    events = sent(np.repeat(light[:, None, None], count, axis=2), times, pixel, seed=3)
    when, on = first_exits(events, count)
    c = 2 * drift / sigma**2
    likely = 1 / (1 + math.exp(-c))
    assert abs(on.mean() - likely) < 4 * math.sqrt(likely * (1 - likely) / count)
    mean = math.tanh(c / 2) / drift if drift else 1 / sigma**2
    assert abs(when.mean() - mean) < 4 * when.std() / math.sqrt(count)
    for rate in (0.5, 3.0):
        laplace = math.cosh(drift / sigma**2) / math.cosh(math.sqrt(drift**2 + 2 * rate * sigma**2) / sigma**2)
        found = np.exp(-rate * when)
        assert abs(found.mean() - laplace) < 4 * found.std() / math.sqrt(count)


def test_unequal_thresholds_have_their_closed_form() -> None:
    """P(ON first) = (1 - e^(c b)) / (e^(-c a) - e^(c b)) for thresholds a and -b."""
    a, b, drift, count = 0.3, 0.12, 0.5, 20_000
    pixel = BrownianPixel(a, b, 0.0, 20.0, drift / a, 0.0, 0.0, 0.3, initial_phase="rest")
    frames, times = constant(50.0, 20.0, 7, count)
    _, on = first_exits(sent(frames, times, pixel, seed=9), count)
    c = 2 * drift / 0.3**2
    likely = (1 - math.exp(c * b)) / (math.exp(-c * a) - math.exp(c * b))
    assert abs(on.mean() - likely) < 4 * math.sqrt(likely * (1 - likely) / count)


def test_leak_intervals_are_inverse_gaussian() -> None:
    """Interval 1 / mu, coefficient of variation sigma / sqrt(mu): 0.0137 for a DAVIS346 at 250 DN."""
    frames, times = constant(250.0, 30.0, 300)
    events = sent(frames, times, BrownianPixel(), seed=2)
    drift, noise = (value / 0.18993 for value in drift_and_noise(BrownianPixel(), 250.0))
    order = np.lexsort((events.t_us, events.x))
    gaps = np.diff(events.t_us[order])[np.diff(events.x[order].astype(int)) == 0] * 1e-6
    assert events.p.all()
    assert abs(gaps.mean() * drift - 1) < 1e-3
    assert abs(gaps.std() / gaps.mean() / (noise / math.sqrt(drift)) - 1) < 0.02
    assert abs(gaps.std() / gaps.mean() - 0.0137) < 0.0003


@pytest.mark.parametrize("frames", [1, 16, 4000])
def test_noise_alone_has_its_rate_whatever_the_frame_distance(frames) -> None:
    """The published code gives 1.2 to 2.8 Hz for frames every 1000 to 0.25 ms; the law gives 3.361 Hz."""
    light, times = constant(100.0, 4.0, frames)
    on, off = rates(sent(light, times, NOISY, seed=frames), 4.0)
    count = (on + off) * 1600 * 4.0
    assert abs(on + off - 3.361) < 4 * 3.361 / math.sqrt(count)
    assert abs(on / (on + off) - 0.5) < 2 / math.sqrt(count)


def test_a_slow_reference_finds_the_same_first_exits() -> None:
    """Small steps see a barrier late by 0.583 sigma sqrt(step): 1 ms steps against thresholds moved by that."""
    pixel = BrownianPixel(0.2, 0.3, 0.0, 20.0, 0.4, 0.01, 0.9, 0.05, initial_phase="rest")
    _, noise = drift_and_noise(pixel, 60.0)
    shift = 0.5826 * noise * math.sqrt(1e-3)
    moved = replace(pixel, threshold_on=0.2 - shift, threshold_off=0.3 - shift)
    moved = replace(moved, leak_rate_hz=0.4 * 0.2 / moved.threshold_on)
    moved = replace(moved, leak_rate_per_dn_hz=0.01 * 0.2 / moved.threshold_on)
    time, on = reference(moved, 60.0, 30.0, 1e-3, 3000, 4)
    assert not np.isnan(time).any()
    frames, times = constant(60.0, 30.0, 40, 12_000)
    found, found_on = first_exits(sent(frames, times, pixel, seed=1), 12_000)
    error = math.hypot(time.std() / math.sqrt(3000), found.std() / math.sqrt(12_000))
    assert abs(time.mean() - found.mean()) < 4 * error
    assert abs(on.mean() - found_on.mean()) < 4 * math.sqrt(0.25 / 3000 + 0.25 / 12_000)


@pytest.mark.parametrize("level", [5.0, 100.0])
@pytest.mark.parametrize("noise", [0.002, 0.4])
def test_rest_stays_at_rest(level, noise) -> None:
    """In constant light the first second looks like the last."""
    pixel = BrownianPixel(0.2, 0.15, 0.0, 20.0, 0.3, 0.01, 0.01, noise)
    frames, times = constant(level, 12.0, 240, 6000)
    events = sent(frames, times, pixel, seed=5)
    for on in (True, False):
        counts = np.histogram(events.t_us[events.p == on], np.arange(13) * 1_000_000)[0].astype(float)
        if counts.sum() < 500:
            continue
        assert abs(counts[0] - counts[6:].mean()) < 5 * math.sqrt(counts[6:].mean() * 7 / 6) + 5
    assert len(events) > 1000


def test_on_and_off_swap_when_the_light_is_turned_around() -> None:
    pixel = BrownianPixel(0.2, 0.2, 0.0, 20.0, 0.0, 0.0, 0.0, 0.5, initial_phase="rest")
    times = np.linspace(0.0, 1.0, 51)
    rise = 80.0 * np.exp(1.5 * times) - 20.0
    counts = []
    for light in (rise, rise[::-1]):
        events = sent(np.repeat(light[:, None, None], 4000, axis=2), times, pixel, seed=7)
        counts.append((int(events.p.sum()), int((~events.p).sum())))
    (on, off), (back_on, back_off) = counts
    assert on > 5 * off > 100
    assert abs(on - back_off) < 5 * math.sqrt(2 * on)
    assert abs(off - back_on) < 5 * math.sqrt(2 * off)


@pytest.mark.parametrize("name", ["threshold_on", "dark_dn", "dark_noise", "initial_phase", "increments"])
def test_wrong_settings_are_refused(name) -> None:
    with pytest.raises(ConfigError, match=name):
        BrownianPixel(**{name: -1.0})


def test_without_noise_it_is_an_integrator_of_log_light() -> None:
    pixel = BrownianPixel(0.2, 0.2, 0.0, 20.0, 0.0, 0.0, 0.0, 0.0, initial_phase="rest")
    light = 80.0 * np.exp([0.0, 0.9, 0.9, -0.1]) - 20.0
    events = sent(light[:, None, None], [0.0, 0.9, 2.0, 3.0], pixel)
    assert (events.t_us // 1000).tolist() == [200, 400, 600, 800, 2300, 2500, 2700, 2900]
    assert events.p.tolist() == [True] * 4 + [False] * 4


# DVS-Voltmeter's law, drawn by an independent program


@pytest.mark.parametrize("clip", ["grey", "strong_noise", "blob", "sine"])
def test_the_law_of_dvs_voltmeter(shared_data, clip) -> None:
    """Counts of ON and OFF a pixel and times of the k-th event, within the standard errors of both programs."""
    folder = shared_data / "voltmeter"
    about = json.loads((folder / "meta.json").read_text())["clips"][clip]
    stored = np.load(folder / f"{clip}.npz")
    times = stored["t_us"] * 1e-6
    if "light" in stored:
        frames = stored["light"][:, :].T[:, stored["patch"]]
    else:
        frames = np.broadcast_to(stored["frames"], (len(times), *stored["frames"].shape[1:]))
    pixel = replace(BrownianPixel.voltmeter(*about["k"]), initial_phase="rest", increments="linear")
    runs, height, width = 4, *frames.shape[1:]
    region = stored["patch"] if "patch" in stored else stored["region"]
    counts = np.zeros((runs, 2, height, width))
    first = np.full((runs, height, width), np.nan)
    for run in range(runs):
        stream = EventStream(pixel, (height, width), seed=100 + run)
        for k in range(0, len(times), 100):
            stream.push(np.ascontiguousarray(frames[k : k + 100]), times[k : k + 100])
        events = stream.finish()
        np.add.at(counts[run], (events.p.astype(int), events.y, events.x), 1)
        flat, index = np.unique(events.y.astype(int) * width + events.x, return_index=True)
        first[run].ravel()[flat] = events.t_us[index]
    compared = 0
    for number, law in enumerate(about["statistics"]["law"]["regions"]):
        mine = region == number
        for sign, name in ((1, "on"), (0, "off")):
            found = counts[:, sign][:, mine]
            # pixels of one column share their light and differ by noise alone: errors from run to run
            error = math.hypot(law[name]["se"], math.sqrt(law[name]["var"] / found.size))
            slack = 4 / (law["pixels"] * law["runs"]) + 4 / found.size
            assert abs(found.mean() - law[name]["mean_per_pixel"]) < 4 * error + slack, (number, name)
            compared += law[name]["mean_per_pixel"] > 0
        if law["kth_event_us"] and law["kth_event_us"][0]["n"] == law["pixels"] * law["runs"]:
            theirs, ours = law["kth_event_us"][0], first[:, mine]
            error = theirs["sd"] * math.sqrt(1 / theirs["n"] + 1 / ours.size) if clip != "blob" else np.inf
            assert abs(np.mean(ours) - theirs["mean"]) < 4 * error + 1
    assert compared >= 4
