"""The photoreceptor with currents: stated bandwidths and noise, a slow reference, pairs of noise events."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

from evnlos.cameras import BrownianPixel, CircuitPixel, simulate_events
from evnlos.errors import ConfigError

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
    reference, events = np.zeros(runs), 0
    for _ in range(round(seconds / 2e-5)):
        state = decay @ state + kick @ draw.normal(size=(3, runs))
        on, off = state[2] - reference >= pixel.threshold_on, state[2] - reference <= -pixel.threshold_off
        reference += pixel.threshold_on * on - pixel.threshold_off * off
        events += int(on.sum() + off.sum())
    return events


def test_noise_rates_are_those_of_small_steps() -> None:
    pixel = replace(PLAIN, threshold_on=0.1, threshold_off=0.1)
    frames, times = static(1e-14, 2.0, 200)
    found = len(simulate_events(frames, times, pixel, seed=1)) / 400
    expected = small_steps(pixel, 1e-14, 1.0, 400, 2) / 400
    assert expected > 3
    # events come in pairs, so that their number varies twice as much as a Poisson count
    assert abs(found - expected) < 4 * math.sqrt(2 * (found + expected) / 400)


def test_bright_pixels_make_no_noise_events() -> None:
    pixel = replace(PLAIN, threshold_on=0.15, threshold_off=0.15)
    frames, times = static(1e-12, 4.0, 150)
    assert len(simulate_events(frames, times, pixel, seed=1)) == 0


def alternating(events) -> tuple[float, int]:
    """Return the share of successive events of one pixel that differ in sign, and their number."""
    order = np.lexsort((events.t_us, events.x))
    same = np.diff(events.x[order].astype(int)) == 0
    turned = np.diff(events.p[order].astype(int)) != 0
    return float(turned[same].mean()), int(same.sum())


def test_noise_events_come_in_pairs_of_either_sign() -> None:
    """An event of rare noise is followed by its opposite, the next pair begins with either sign: 3 in 4 turn.

    Of a walk without memory, one in two does.
    """
    frames, times = static(1e-14, 3.0, 150)
    pixel = replace(PLAIN, threshold_on=0.1, threshold_off=0.1)
    share, count = alternating(simulate_events(frames, times, pixel, seed=2))
    assert count > 500
    assert share == pytest.approx(0.77, abs=0.05)
    walk = BrownianPixel(0.1, 0.1, 0.0, 20.0, 0.0, 0.0, 0.0, 0.3)
    share, count = alternating(simulate_events(frames, times, walk, seed=2))
    assert count > 500
    assert share == pytest.approx(0.5, abs=0.05)


def test_a_stretch_cut_into_frames_is_the_same_noise() -> None:
    pixel = replace(PLAIN, threshold_on=0.1, threshold_off=0.1)
    counts = []
    for frames in (1, 100):
        light, times = static(1e-14, 2.0, 100, frames)
        counts.append(len(simulate_events(light, times, pixel, seed=3)))
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
    events = simulate_events(light[:, None, None], times, pixel)
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
        latency.append(int(simulate_events(light, [0.0, 1e-5, 0.5], pixel).t_us[0]))
    assert latency[0] > 4 * latency[1] > 8 * latency[2] > 0


def test_after_an_event_a_pixel_rests() -> None:
    times = np.linspace(0.0, 1.0, 101)
    light = dn(1e-12) * np.exp(2.0 * np.sin(2 * np.pi * 2 * times))[:, None, None] * np.ones((1, 1, 50))
    for refractory in (0.0, 0.02):
        events = simulate_events(light, times, replace(PLAIN, refractory_s=refractory), seed=1)
        gaps = [np.diff(events.t_us[events.x == x]).min() for x in range(50)]
        assert min(gaps) * 1e-6 >= refractory - 2e-6
        assert len(events) > 200


@pytest.mark.parametrize("name", ["dark_current_a", "kappa", "threshold_on", "noise_factor", "initial_phase"])
def test_wrong_settings_are_refused(name) -> None:
    with pytest.raises(ConfigError, match=name):
        CircuitPixel(**{name: -1.0})
