"""A continuous pixel with a true logarithm: five decades of light, an exposure of its own, a slow reference."""

from dataclasses import replace

import numpy as np
import pytest

from event_pixel_reference import reference_exact
from evnlos.cameras import EventCamera, EventPixel, simulate_events
from evnlos.errors import ConfigError

QUIET = EventPixel(0.2, 0.2, 0.0, 0.0, 0.0, 0.0, logarithm="true", initial_phase="rest")


@pytest.mark.parametrize("dark_dn", [0.0025, 0.5])
def test_events_come_at_the_log_light_over_a_hundred_decibels(dark_dn) -> None:
    times = np.linspace(0.0, 10.0, 2001)
    light = 0.003 * 10 ** (0.5 * times)  # to 300 DN
    events = simulate_events(light[:, None, None], times, replace(QUIET, dark_dn=dark_dn))
    range_log = np.log((light[-1] + dark_dn) / (light[0] + dark_dn))
    levels = (light[0] + dark_dn) * np.exp(0.2 * np.arange(1, int(range_log / 0.2) + 1)) - dark_dn
    assert len(events) == len(levels) > 30
    assert np.abs(events.t_us - np.interp(levels, light, times) * 1e6).max() <= 1
    assert events.p.all()


def walk(seed: int, steps: int = 60, pixels: int = 24) -> np.ndarray:
    """Light that wanders over four decades, [T, 1, N] in DN."""
    draw = np.random.default_rng(seed)
    logs = draw.normal(0.0, 0.08, (steps, 1, pixels)).cumsum(0) + draw.uniform(-5.0, 4.0, (1, 1, pixels))
    return np.exp(logs)


@pytest.mark.parametrize("cutoff_hz", [0.0, 40.0])
@pytest.mark.parametrize("phase", ["random", "rest"])
def test_the_slow_reference_finds_the_same_events(cutoff_hz, phase) -> None:
    pixel = EventPixel(
        0.15, 0.12, 0.02, cutoff_hz, 0.3, 0.0, initial_phase=phase, logarithm="true", exposure=3.0,
        dark_dn=0.02, cutoff_floor_dn=2.0,
    )  # fmt: skip
    frames, times = walk(4), np.linspace(0.0, 0.6, 60)
    events = simulate_events(frames, times, pixel, seed=6)
    expected = sorted(reference_exact(frames, times, pixel, seed=6))
    assert abs(len(events) - len(expected)) <= 1
    assert len(events) > 70
    found = sorted(zip(events.x.tolist(), (events.t_us * 1e-6).tolist(), events.p.tolist(), strict=True))
    truth = sorted((pixel, time, sign > 0) for time, pixel, sign in expected)
    if len(found) == len(truth):
        assert [(x, p) for x, _, p in found] == [(x, p) for x, _, p in truth]
        errors = [abs(one[1] - other[1]) for one, other in zip(found, truth, strict=True)]
        assert np.quantile(errors, 0.98) < 1e-4


def test_an_exposure_is_a_factor_of_the_light() -> None:
    frames, times = walk(1), np.linspace(0.0, 0.6, 60)
    for logarithm in ("true", "lin-log"):
        pixel = EventPixel(cutoff_hz=30.0, logarithm=logarithm, dark_dn=0.1, shot_noise_rate_hz=2.0)
        longer = simulate_events(frames, times, replace(pixel, exposure=8.0), seed=2)
        assert longer == simulate_events(8.0 * frames, times, pixel, seed=2)
        assert longer != simulate_events(frames, times, pixel, seed=2)


def test_dim_light_makes_as_many_events_as_bright_light() -> None:
    """v2e's pixel goes blind at 3 % of the light because it is linear below 20 DN; a photoreceptor does not."""
    frames, times = 60.0 * walk(3, pixels=400) ** 0.3, np.linspace(0.0, 0.6, 60)
    counts = {
        logarithm: [
            len(simulate_events(share * frames, times, replace(QUIET, logarithm=logarithm)))
            for share in (1.0, 0.03)
        ]
        for logarithm in ("true", "lin-log")
    }
    bright, dim = counts["true"]
    assert abs(dim - bright) < 0.02 * bright
    assert counts["lin-log"][1] < 0.5 * counts["lin-log"][0]


def test_the_camera_chooses_its_steps_by_the_pixels_own_logarithm() -> None:
    class Edge:
        """Dim light that doubles and halves a few times a second."""

        shape, speed_px_s = (4, 5), 0.0

        def irradiance(self, t_s):
            import torch

            level = 1e-3 * np.exp(0.7 * np.sin(2 * np.pi * 3 * np.asarray(t_s)))
            return torch.from_numpy(level)[:, None, None].expand(-1, 4, 5).float()

    fine = EventCamera(QUIET, time_step_s=1e-4).record(Edge(), 0.0, 1.0)
    chosen = EventCamera(QUIET).record(Edge(), 0.0, 1.0)
    assert len(fine) == len(chosen) > 200
    assert np.abs(fine.t_us - chosen.t_us).max() < 2000


def test_v2e_has_one_logarithm() -> None:
    for change in ({"logarithm": "true"}, {"exposure": 2.0}, {"cutoff_floor_dn": 5.0}):
        with pytest.raises(ConfigError, match="logarithm, exposure"):
            simulate_events(np.ones((2, 1, 1)), [0, 1], EventPixel(**change), mode="v2e")
    with pytest.raises(ConfigError, match="logarithm"):
        EventPixel(logarithm="log")  # type: ignore[arg-type]
