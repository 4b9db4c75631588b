"""The photoreceptor with currents: stated bandwidths and noise, a slow reference, pairs of noise events."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

from evnlos.cameras import BrownianPixel, CircuitPixel, simulate_events
from evnlos.errors import ConfigError
from evnlos.types import Events

PLAIN = CircuitPixel(threshold_sigma=0.0, leak_rate_hz=0.0)
CURRENTS = (1e-15, 1e-14, 1e-13, 1e-12, 1e-11)


@pytest.mark.parametrize(
    ("current", "hertz", "rms"),
    list(zip(CURRENTS, (1.7, 16.6, 83, 106, 106), (0.041, 0.039, 0.026, 0.011, 0.0047), strict=True)),
)
def test_bandwidth_and_noise_at_stated_currents(current, hertz, rms) -> None:
    """Linear noise theory of the published equations, worked out elsewhere: corner to 3 %, rms to a digit."""
    assert PLAIN.bandwidth_hz(current) == pytest.approx(hertz, rel=0.03)
    assert PLAIN.noise_rms(current) == pytest.approx(rms, rel=0.03)


def dn(current: float) -> float:
    """Return the light that makes a current, the dark current included."""
    return (current - PLAIN.dark_current_a) / PLAIN.photocurrent_a_per_dn


def sent(light: np.ndarray, times, pixel: CircuitPixel, seed: int = 0) -> Events:
    """Return the events of light in single precision, as walls send it: no kernel is compiled for another."""
    return simulate_events(light.astype(np.float32), times, pixel, seed=seed)


def static(current: float, seconds: float, pixels: int, frames: int = 20) -> tuple[np.ndarray, np.ndarray]:
    return np.full((frames + 1, 1, pixels), dn(current)), np.linspace(0.0, seconds, frames + 1)


def small_steps(pixel: CircuitPixel, current: float, seconds: float, runs: int, seed: int) -> int:
    """Return how many events the noise of `runs` pixels makes: the equations in steps of 20 us."""
    m, _, noise = (part[0] if part.ndim == 3 else part for part in pixel.matrices(np.array([current])))
    settled = solve_continuous_lyapunov(m, -noise)
    decay = expm(2e-5 * m)
    kick = np.linalg.cholesky(settled - decay @ settled @ decay.T + 1e-15 * np.eye(3))
    draw = np.random.default_rng(seed)
    state = np.linalg.cholesky(settled) @ draw.normal(size=(3, runs))
    reference, events = state[2].copy(), 0  # as after a reset: without leak its phase stays what it is
    for _ in range(round(seconds / 2e-5)):
        state = decay @ state + kick @ draw.normal(size=(3, runs))
        on, off = state[2] - reference >= pixel.threshold_on, state[2] - reference <= -pixel.threshold_off
        reference += pixel.threshold_on * on - pixel.threshold_off * off
        events += int(on.sum() + off.sum())
    return events


@pytest.mark.parametrize("threshold", [0.1, 0.15])
def test_noise_rates_are_those_of_small_steps(threshold) -> None:
    pixel = replace(PLAIN, threshold_on=threshold, threshold_off=threshold)
    frames, times = static(1e-14, 2.0, 400)
    found = len(sent(frames, times, pixel, seed=1)) / 800
    expected = small_steps(pixel, 1e-14, 1.0, 800, 2) / 800
    assert expected > 0.9
    # events come in pairs, and pixels keep their phase: their number varies more than a Poisson count
    assert abs(found - expected) < 4 * math.sqrt(4 * (found + expected) / 800)


@pytest.mark.parametrize(
    ("current", "threshold", "hertz", "pixels"),
    [(1e-15, 0.15, 0.40, 150), (1e-14, 0.15, 1.4, 100), (1e-14, 0.2, 0.06, 500), (1e-13, 0.15, 0.04, 500)],
)
def test_noise_events_come_at_stated_rates(current, threshold, hertz, pixels) -> None:
    """Rates that were found with the equations elsewhere, by small steps from a reset: to a third."""
    pixel = replace(PLAIN, threshold_on=threshold, threshold_off=threshold)
    frames, times = static(current, 8.0, pixels, 8)
    rate = len(sent(frames, times, pixel, seed=3)) / (8 * pixels)
    assert rate == pytest.approx(hertz, rel=1 / 3)


def per_second(pixel: CircuitPixel, current: float, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of events of each pixel in the first second and in seconds 9 to 11."""
    frames, times = static(current, 11.0, pixels, 11)
    events = sent(frames, times, pixel, seed=5)
    parts = (0, 1), (9, 11)
    return tuple(
        np.bincount(events.x[(events.t_us >= a * 1e6) & (events.t_us < b * 1e6)], minlength=pixels) / (b - a)
        for a, b in parts
    )  # type: ignore[return-value]


@pytest.mark.parametrize("poles", [1, 3])
@pytest.mark.parametrize(
    ("current", "on", "off", "leak", "sigma"),
    [
        (1e-14, 0.15, 0.15, 0.0, 0.0),
        (1e-14, 0.15, 0.15, 0.1, 0.02),
        (3e-15, 0.1, 0.1, 0.1, 0.02),
        (1e-14, 0.2, 0.2, 0.5, 0.0),
        (1e-14, 0.19, 0.23, 0.1, 0.012),
        (5e-14, 0.15, 0.15, 0.1, 0.02),
        (1e-12, 0.2, 0.2, 0.5, 0.02),
    ],
)
def test_noise_is_as_frequent_at_first_as_later(poles, current, on, off, leak, sigma) -> None:
    """The first second against the tenth and eleventh: noise and leak of pixels that have run for long."""
    pixel, pixels = CircuitPixel(on, off, sigma, leak_rate_hz=leak, poles=poles), 3000 if poles == 1 else 250
    first, later = per_second(pixel, current, pixels)
    error = math.sqrt((first.var() + later.var()) / pixels)
    assert later.sum() > 10
    assert abs(first.mean() - later.mean()) < 4 * error


def test_noise_is_rare_at_first_where_references_start_at_rest() -> None:
    """As a choice: all references at the settled level, where both thresholds are far."""
    settled = replace(POLE, threshold_on=0.15, threshold_off=0.15, leak_rate_hz=0.1)
    rest, random = (
        per_second(replace(settled, initial_phase=phase), 1e-14, 1000)[0] for phase in ("rest", "random")
    )
    assert 3 * rest.mean() < random.mean()
    assert CircuitPixel().initial_phase == "random"


@pytest.mark.parametrize("pause", [5e-4, 5e-3, 0.05])
def test_with_a_refractory_period_noise_begins_within_a_fifth(pause) -> None:
    """What the noise does in a refractory period moves the reference, too: the law of that is approximate."""
    pixel = replace(POLE, threshold_on=0.15, threshold_off=0.15, leak_rate_hz=0.1, refractory_s=pause)
    first, later = per_second(pixel, 1e-14, 3000)
    assert first.mean() == pytest.approx(later.mean(), rel=0.2)


def test_noise_carries_crossings_ahead_as_its_law_says() -> None:
    """Noise that is drawn anew each time constant, light that nears a threshold by 0.5 log units a second."""
    for current in (3e-15, 1e-14, 1e-13):
        law, rms = PLAIN.crossing_law(dn(current)), PLAIN.noise_rms(current)
        step = 0.5 / (2 * math.pi * PLAIN.bandwidth_hz(current))
        count = math.ceil(14 * rms / step)
        away = step * (count / 2 - np.arange(count))  # from 7 rms below the threshold to 7 above
        met = np.random.default_rng(1).normal(scale=rms, size=(4000, count)) >= away
        assert law.ahead == pytest.approx(np.median(away[met.argmax(axis=1)]), abs=0.1 * rms + step)


def test_bright_pixels_make_no_noise_events() -> None:
    pixel = replace(PLAIN, threshold_on=0.15, threshold_off=0.15)
    frames, times = static(1e-12, 4.0, 150)
    assert len(sent(frames, times, pixel, seed=1)) == 0


def alternating(events) -> tuple[float, int]:
    """Return the share of successive events of one pixel that differ in sign, and their number."""
    order = np.lexsort((events.t_us, events.x))
    same = np.diff(events.x[order].astype(int)) == 0
    turned = np.diff(events.p[order].astype(int)) != 0
    return float(turned[same].mean()), int(same.sum())


@pytest.mark.parametrize("poles", [1, 3])
@pytest.mark.parametrize(("ratio", "stated"), [(2, 0.82), (3, 0.96), (4, 0.997)])
def test_noise_events_come_in_pairs_of_either_sign(poles, ratio, stated) -> None:
    """An event of rare noise is followed by its opposite: shares found elsewhere, by threshold over rms."""
    threshold = ratio * PLAIN.noise_rms(1e-14)
    frames, times = static(1e-14, 8.0, 1000 if poles == 1 else 150, 8)
    pixel = replace(PLAIN, threshold_on=threshold, threshold_off=threshold, poles=poles)
    share, count = alternating(sent(frames, times, pixel, seed=2))
    assert count > 500
    assert share == pytest.approx(stated, abs=0.025)


def test_events_of_noise_without_a_memory_do_not_alternate() -> None:
    frames, times = static(1e-14, 3.0, 150)
    walk = BrownianPixel(0.1, 0.1, 0.0, 20.0, 0.0, 0.0, 0.0, 0.3)
    share, count = alternating(sent(frames, times, walk, seed=2))
    assert count > 500
    assert share == pytest.approx(0.5, abs=0.05)


def test_a_stretch_cut_into_frames_is_the_same_noise() -> None:
    pixel = replace(PLAIN, threshold_on=0.1, threshold_off=0.1)
    counts = []
    for frames in (1, 100):
        light, times = static(1e-14, 2.0, 100, frames)
        counts.append(len(sent(light, times, pixel, seed=3)))
    assert abs(counts[0] - counts[1]) < 5 * math.sqrt(2 * sum(counts) / 2)


def slow(
    pixel: CircuitPixel, light: np.ndarray, times: np.ndarray, step: float = 2e-6
) -> list[tuple[float, int]]:
    """Return a noiseless pixel's events, the matrices taken anew at each of very small steps."""
    events, now = [], times[0]
    x = math.log1p(light[0] * pixel.photocurrent_a_per_dn / pixel.dark_current_a)
    _, rest, _ = pixel.matrices(np.array([pixel.dark_current_a]))
    state, reference = rest * x, x
    for k in range(len(times) - 1):
        logs = np.log1p(light[k : k + 2] * pixel.photocurrent_a_per_dn / pixel.dark_current_a)
        count = round((times[k + 1] - times[k]) / step)
        for j in range(count):
            x = logs[0] + (j + 0.5) / count * (logs[1] - logs[0])
            if j % 50 == 0:
                m = pixel.matrices(np.array([pixel.dark_current_a * math.exp(x)]))[0][0]
                decay = expm(m * step)
            state = rest * x + decay @ (state - rest * x)
            now += step
            while abs(state[2] - reference) >= pixel.threshold_on:
                sign = 1 if state[2] > reference else -1
                reference += sign * pixel.threshold_on
                events.append((now, sign))
    return events


def test_without_noise_a_slow_reference_finds_the_same_events() -> None:
    pixel = replace(PLAIN, noise_factor=0.0)
    times = np.linspace(0.0, 0.08, 17)
    light = dn(3e-14) * np.exp(1.2 * np.sin(2 * np.pi * 15 * times))
    events = sent(light[:, None, None], times, pixel)
    expected = slow(pixel, light, times)
    assert len(events) == len(expected) > 8
    assert events.p.tolist() == [sign > 0 for _, sign in expected]
    assert np.abs(events.t_us * 1e-6 - [time for time, _ in expected]).max() < 2.5e-4


def test_dim_pixels_lag_behind_bright_ones() -> None:
    """The first event after a step of light by two comes the later, the dimmer it is."""
    latency = []
    for current in (2e-15, 2e-14, 2e-13):
        light = np.array([dn(current), dn(2 * current), dn(2 * current)])[:, None, None]
        pixel = replace(PLAIN, noise_factor=0.0)
        latency.append(int(sent(light, [0.0, 1e-5, 0.5], pixel).t_us[0]))
    assert latency[0] > 4 * latency[1] > 8 * latency[2] > 0


def test_after_an_event_a_pixel_rests() -> None:
    times = np.linspace(0.0, 1.0, 101)
    light = dn(1e-12) * np.exp(2.0 * np.sin(2 * np.pi * 2 * times))[:, None, None] * np.ones((1, 1, 50))
    for refractory in (0.0, 0.02):
        events = sent(light, times, replace(PLAIN, refractory_s=refractory), seed=1)
        gaps = [np.diff(events.t_us[events.x == x]).min() for x in range(50)]
        assert min(gaps) * 1e-6 >= refractory - 2e-6
        assert len(events) > 200


def pole_of(pixel: CircuitPixel, current: float) -> tuple[float, float, float]:
    """Return mean lag [s], noise [rms, log units] and its correlation time [s], from sums over small steps."""
    m, rest, noise = (np.asarray(part).squeeze() for part in pixel.matrices(np.array([current])))
    step = 1e-4
    decay, settled = expm(step * m), solve_continuous_lyapunov(m, -noise)
    response, echo, lag, memory = rest, settled, 0.0, 0.0
    for _ in range(4_000):
        lag, memory = lag + step * response[2], memory + step * echo[2, 2]
        response, echo = decay @ response, decay @ echo
    memory = memory / settled[2, 2] - step / 2 if settled[2, 2] > 0 else 1.0
    return lag - step / 2 * rest[2], math.sqrt(settled[2, 2]), memory


def one_pole(
    pixel: CircuitPixel, light: np.ndarray, times: np.ndarray, steps: int, runs: int, seed: int
) -> list:
    """Return (time, run, sign) of events of `runs` pixels of one pole: a loop over `steps` in each interval."""
    draw, logs = (
        np.random.default_rng(seed),
        np.log1p(light * pixel.photocurrent_a_per_dn / pixel.dark_current_a),
    )
    lag, events = np.zeros(runs), []
    noise = pole_of(pixel, pixel.dark_current_a * math.exp(logs[0]))[1] * draw.normal(size=runs)
    before = logs[0] + noise
    reference = before.copy()
    for k in range(len(times) - 1):
        delay, rms, memory = pole_of(pixel, pixel.dark_current_a * math.exp((logs[k] + logs[k + 1]) / 2))
        h, change = (times[k + 1] - times[k]) / steps, (logs[k + 1] - logs[k]) / steps
        for n in range(steps):
            lag = math.exp(-h / delay) * lag - delay / h * (1 - math.exp(-h / delay)) * change
            keep = math.exp(-h / memory)
            noise = keep * noise + rms * math.sqrt(1 - keep**2) * draw.normal(size=runs)
            now = logs[k] + (n + 1) * change + lag + noise
            for i in np.nonzero(np.abs(now - reference) >= pixel.threshold_on)[0]:
                sign = int(np.sign(now[i] - reference[i]))
                while abs(now[i] - reference[i]) >= pixel.threshold_on:
                    reference[i] += sign * pixel.threshold_on
                    share = (reference[i] - before[i]) / (now[i] - before[i])
                    events.append((times[k] + (n + min(max(share, 0.0), 1.0)) * h, i, sign))
            before = now
    return events


POLE = replace(PLAIN, poles=1)


def test_without_noise_one_pole_follows_its_slow_reference() -> None:
    pixel = replace(POLE, noise_factor=0.0)
    times = np.linspace(0.0, 0.3, 101)
    light = dn(3e-14) * np.exp(1.2 * np.sin(2 * np.pi * 8 * times))
    events = sent(light[:, None, None], times, pixel)
    expected = one_pole(pixel, light, times, 2, 1, 0)
    assert len(events) == len(expected) > 15
    assert events.p.tolist() == [sign > 0 for _, _, sign in expected]
    # the table's currents are 2 % apart
    assert np.abs(events.t_us * 1e-6 - [time for time, _, _ in expected]).max() < 2e-4


def test_noise_of_one_pole_is_that_of_its_slow_reference() -> None:
    pixel = replace(POLE, threshold_on=0.1, threshold_off=0.1)
    frames, times = static(1e-14, 1.5, 300, 50)
    found = sent(frames, times, pixel, seed=4)
    steps = math.ceil(0.03 / (0.0258 * pixel.follower_f / pixel.follower_a))
    expected = one_pole(pixel, frames[:, 0, 0], times, steps, 300, 5)
    assert len(expected) > 1000
    assert abs(len(found) - len(expected)) < 4 * math.sqrt(2 * (len(found) + len(expected)))
    assert np.mean(found.p) == pytest.approx(0.5, abs=0.05)


def test_one_pole_sends_about_what_three_equations_do() -> None:
    """Noise of dim pixels within a sixth, and as many events of a slow swing within a twentieth."""
    for current in (3e-15, 1e-14):
        frames, times = static(current, 3.0, 100, 100)
        pixel = replace(PLAIN, threshold_on=0.08, threshold_off=0.08)
        one, three = (len(sent(frames, times, replace(pixel, poles=n), seed=1)) for n in (1, 3))
        assert three > 300 and one == pytest.approx(three, rel=1 / 6)
    times = np.linspace(0.0, 2.0, 201)
    light = (dn(3e-14) * np.exp(0.8 * np.sin(2 * np.pi * times)))[:, None, None] * np.ones((1, 1, 40))
    one, three = (len(sent(light, times, replace(PLAIN, poles=n), seed=1)) for n in (1, 3))
    assert three > 500 and one == pytest.approx(three, rel=0.05)


def test_after_an_event_a_pixel_of_one_pole_rests() -> None:
    times = np.linspace(0.0, 1.0, 101)
    light = dn(1e-12) * np.exp(2.0 * np.sin(2 * np.pi * 2 * times))[:, None, None] * np.ones((1, 1, 50))
    events = sent(light, times, replace(POLE, refractory_s=0.02), seed=1)
    assert min(np.diff(events.t_us[events.x == x]).min() for x in range(50)) >= 19_998
    assert len(events) > 200


@pytest.mark.parametrize(
    "name", ["dark_current_a", "kappa", "threshold_on", "noise_factor", "poles", "initial_phase"]
)
def test_wrong_settings_are_refused(name) -> None:
    with pytest.raises(ConfigError, match=name):
        replace(PLAIN, **{name: -1.0})
