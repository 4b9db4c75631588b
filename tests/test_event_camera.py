"""The event camera on a wall in continuous time: its own steps against fine ones, memory, laws, bad input."""

import importlib
import tracemalloc
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from numba.core.dispatcher import Dispatcher
from numba.types import unliteral

from evnlos import EventCamera, EventPixel, EvnlosError, simulate_events
from evnlos.cameras import BrownianPixel, CircuitPixel, V2ePixel
from evnlos.errors import DataError
from evnlos.optics import SlidingWall, View
from evnlos.scene import LineMotion
from evnlos.types import Plane

CLEAN = EventPixel(0.15, 0.15, 0.0, 15.0, 0.0, 0.0, 0.0, initial_phase="rest")


@dataclass(frozen=True)
class Spot:
    """A Gaussian spot that crosses the image at a constant speed."""

    shape: tuple[int, int] = (12, 40)
    speed_px_s: float = 10.0
    scale: float = 0.6
    broken: float = 0.0

    def irradiance(self, t_s) -> torch.Tensor:
        t = torch.as_tensor(np.asarray(t_s), dtype=torch.float64)
        y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in self.shape), indexing="ij")
        centre = 5.0 + self.speed_px_s * t.reshape(-1, 1, 1)
        light = 0.1 + self.scale * torch.exp(-((x - centre) ** 2 + (y - 5.5) ** 2) / (2 * 3.0**2))
        return (light + self.broken).float().reshape(*t.shape, *self.shape)


def by_pixel(events) -> dict:
    found: dict = {}
    for t, x, y, p in zip(
        events.t_us.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True
    ):
        found.setdefault((x, y, p), []).append(t)
    return found


def test_its_own_steps_agree_with_steps_of_a_tenth_of_a_millisecond() -> None:
    own = EventCamera(CLEAN).record(Spot(), 0.0, 3.0)
    fine = EventCamera(CLEAN, time_step_s=1e-4).record(Spot(), 0.0, 3.0)
    assert len(own) > 2000
    assert abs(len(own) - len(fine)) <= 0.002 * len(fine)
    mine, theirs = by_pixel(own), by_pixel(fine)
    errors = [
        a - b
        for key in mine.keys() & theirs.keys()
        if len(mine[key]) == len(theirs[key])
        for a, b in zip(mine[key], theirs[key], strict=True)
    ]
    assert len(errors) > 0.98 * len(fine)
    assert np.sqrt(np.mean(np.square(errors))) < 1000  # microseconds


def test_a_recording_is_the_simulation_of_its_frames() -> None:
    times = np.arange(0, 301) * 0.01
    frames = Spot().irradiance(times).numpy() * 255
    recorded = EventCamera(CLEAN, time_step_s=0.01, mode="v2e").record(Spot(), 0.0, 3.0, seed=4)
    assert recorded == simulate_events(frames, times, CLEAN, mode="v2e", seed=4)
    assert EventCamera(CLEAN, time_step_s=0.01).record(Spot(), 0.0, 3.0) == simulate_events(
        frames, times, CLEAN
    )


NOISY = EventPixel(0.15, 0.12, 0.03, 60.0, 0.5, 2.0, 0.0)
TARGET_PLANE = Plane(60, 70, 0.001)


def sliding_wall(direction: tuple[float, float], image: torch.Tensor | None = None) -> SlidingWall:
    x, y = torch.as_tensor(TARGET_PLANE.x_m), torch.as_tensor(TARGET_PLANE.y_m)[:, None]
    spot = torch.exp(-(x**2 + (y - 0.01) ** 2) / (2 * 0.006**2)) + 0.4 * (torch.abs(x + y) < 0.004)
    motion = LineMotion((-0.03, 0.0), 0.08, direction)
    view = View.affine((45, 70), 700.0)
    return SlidingWall(
        spot.float() if image is None else image, TARGET_PLANE, view, motion, gain=0.7, ambient=0.1
    )


@pytest.mark.parametrize("mode", ["exact", "v2e"])
@pytest.mark.parametrize("refractory_s", [0.0, 2e-3])
@pytest.mark.parametrize("direction", [(1.0, 0.0), (1.0, 0.4)])
def test_a_wall_in_strips_gives_the_events_of_its_frames(mode, refractory_s: float, direction) -> None:
    """150 steps: two whole blocks of strips and a part; 3150 pixels: one whole tile and a part."""
    pixel, wall = replace(NOISY, refractory_s=refractory_s), sliding_wall(direction)
    assert (wall.strips([0.0, 1.0]) is None) == (direction[1] != 0)
    times_s = np.arange(151) * 4e-3
    frames = wall.irradiance(times_s).numpy() * np.float32(255)
    expected = simulate_events(frames, times_s, pixel, mode=mode, seed=3)
    assert len(expected) > 3000
    camera = EventCamera(pixel, time_step_s=4e-3, mode=mode)
    for threads in (1, 2):
        assert camera.record(wall, 0.0, 0.6, seed=3, threads=threads) == expected


@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
def test_a_broken_wall_is_refused_strip_by_strip(broken: float) -> None:
    """The target comes into view after the first image, which is dark."""
    target = torch.zeros(TARGET_PLANE.shape)
    target[30, 30] = broken
    view, motion = View.affine((45, 70), 700.0), LineMotion((-0.3, 0.0), 0.2)
    wall = SlidingWall(target, TARGET_PLANE, view, motion)
    assert not wall.irradiance(0.0).any()
    with pytest.raises(DataError, match="NaN or infinity"):
        EventCamera(CLEAN, time_step_s=0.05).record(wall, 0.0, 2.0)


class Flicker(SlidingWall):
    """A wall that is not what its strips say."""

    def irradiance(self, t_s) -> torch.Tensor:
        factor = 1 + 0.5 * np.sin(30 * np.asarray(t_s))
        return super().irradiance(t_s) * torch.as_tensor(factor, dtype=torch.float32)[..., None, None]


def test_a_subclass_with_its_own_light_is_asked_for_it() -> None:
    wall = sliding_wall((1.0, 0.0))
    wall.__class__ = Flicker
    times_s = np.arange(51) * 0.01
    frames = wall.irradiance(times_s).numpy() * np.float32(255)
    recorded = EventCamera(CLEAN, time_step_s=0.01).record(wall, 0.0, 0.5)
    assert recorded == simulate_events(frames, times_s, CLEAN)


class Short(SlidingWall):
    """A wall that forgets some instants."""

    def strips(self, t_s):
        return super().strips(np.asarray(t_s)[:-1])


def test_strips_of_another_length_are_refused() -> None:
    wall = sliding_wall((1.0, 0.0))
    wall.__class__ = Short
    with pytest.raises(DataError, match="one time in seconds per frame"):
        EventCamera(CLEAN, time_step_s=0.01).record(wall, 0.0, 0.5)


def test_steps_below_the_precision_of_the_times_are_refused() -> None:
    with pytest.raises(DataError, match="times must ascend"):
        EventCamera(CLEAN, time_step_s=1e-8).record(sliding_wall((1.0, 0.0)), 1e9, 1e9 + 1e-6)


def test_a_wall_in_double_precision_gives_the_events_of_its_frames() -> None:
    wall = sliding_wall(
        (1.0, 0.0), torch.rand(TARGET_PLANE.shape, dtype=torch.float64, generator=torch.manual_seed(0))
    )
    times_s = np.arange(101) * 4e-3
    expected = simulate_events(wall.irradiance(times_s).numpy() * np.float32(255), times_s, NOISY, seed=1)
    assert EventCamera(NOISY, time_step_s=4e-3).record(wall, 0.0, 0.4, seed=1) == expected


def test_whole_numbers_are_thresholds_too() -> None:
    whole = EventCamera(EventPixel(1, 1, 0.03)).record(Spot(scale=5.0), 0.0, 1.0)
    assert len(whole) > 0
    assert whole == EventCamera(EventPixel(1.0, 1.0, 0.03)).record(Spot(scale=5.0), 0.0, 1.0)


def test_a_wall_at_rest_gives_no_signal() -> None:
    assert len(EventCamera(CLEAN).record(Spot(speed_px_s=0.0), 0.0, 5.0)) == 0
    noisy = EventPixel(0.15, 0.15, 0.03, 15.0, 0.1, 1.0, 0.0)
    assert len(EventCamera(noisy).record(Spot(speed_px_s=0.0), 0.0, 5.0)) > 100


def test_the_seed_decides_the_noise_and_threads_do_not() -> None:
    camera = EventCamera(EventPixel(shot_noise_rate_hz=2.0, leak_rate_hz=0.5))
    first = camera.record(Spot(), 0.0, 1.0, seed=1, threads=1)
    assert first == camera.record(Spot(), 0.0, 1.0, seed=1, threads=2)
    assert first != camera.record(Spot(), 0.0, 1.0, seed=2, threads=1)


def test_memory_is_that_of_a_chunk_and_the_events() -> None:
    wall = Spot(shape=(200, 320), speed_px_s=100.0)
    EventCamera(CLEAN, time_step_s=0.05).record(wall, 0.0, 0.1)
    tracemalloc.start()
    EventCamera(CLEAN, time_step_s=0.005).record(
        wall, 0.0, 2.0
    )  # 400 steps: 102 MB of frames, 205 MB of doubles
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6


@pytest.mark.parametrize(
    ("wall", "times", "says"),
    [
        (Spot(), (1.0, 1.0), "last after the first"),
        (Spot(), (0.0, float("nan")), "finite"),
        (Spot(broken=float("nan")), (0.0, 1.0), "NaN"),
        (Spot(broken=-1.0), (0.0, 1.0), "negative"),
        (Spot(speed_px_s=float("inf")), (0.0, 1.0), "speed"),
        (Spot(speed_px_s=1e9), (0.0, 1.0), "steps"),
    ],
)
def test_bad_input(wall, times, says: str) -> None:
    with pytest.raises(EvnlosError, match=says):
        EventCamera(CLEAN).record(wall, *times)


@pytest.mark.parametrize("settings", [{"tolerance": 0.0}, {"time_step_s": -1.0}, {"mode": "v2e"}])
def test_bad_settings(settings: dict) -> None:
    with pytest.raises(EvnlosError):
        EventCamera(CLEAN, **settings)


@pytest.mark.parametrize(
    ("name", "pixel"),
    [
        ("continuous", EventPixel()),
        ("v2e", V2ePixel()),
        ("brownian", BrownianPixel()),
        ("circuit", CircuitPixel()),
    ],
)
def test_no_loop_is_compiled_a_second_time_for_a_counter_that_begins_at_zero(name, pixel) -> None:
    """Numba compiles what a loop calls twice where a literal is passed first: half of a first call's time.

    What a cache on the disk holds is not compiled, so this sees least where all is there already.
    """
    frames = np.random.default_rng(0).uniform(20, 200, (6, 5, 7)).astype(np.float32)
    simulate_events(frames, 0.01 * np.arange(6), pixel)
    module = importlib.import_module(f"evnlos.cameras.pixels.{name}")
    compiled = {key: one.signatures for key, one in vars(module).items() if isinstance(one, Dispatcher)}
    assert any(compiled.values())
    plain = {key: [tuple(map(unliteral, types)) for types in found] for key, found in compiled.items()}
    assert [key for key, found in plain.items() if len(set(found)) < len(found)] == []
