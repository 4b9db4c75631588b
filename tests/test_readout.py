"""The readout stage behind a pixel, against a slow queue and its invariants; lamps that ripple."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from evnlos.cameras import (
    BrownianPixel,
    EventCamera,
    EventPixel,
    EventStream,
    FlickeringWall,
    ReadoutPixel,
    V2ePixel,
    simulate_events,
)
from evnlos.errors import ConfigError

QUIET = EventPixel(0.1, 0.1, 0.02, 0.0, 0.0, 0.0, initial_phase="rest")
TIMES_S = np.linspace(0.0, 0.02, 41)


def flashes(seed: int = 1, height: int = 12, width: int = 20) -> np.ndarray:
    """Light that jumps everywhere at once now and then: bursts for the arbiter."""
    draw = np.random.default_rng(seed)
    jumps = draw.normal(0.0, 0.4, (len(TIMES_S), 1, 1)) * (np.arange(len(TIMES_S)) % 8 == 1)[:, None, None]
    own = draw.normal(0.0, 0.03, (len(TIMES_S), height, width))
    return 60.0 * np.exp((jumps + own).cumsum(0))


def slow_queue(events, settings: ReadoutPixel) -> tuple[list[tuple], int]:
    """Return (time, pixel, polarity) of the events that a plain queue grants, and how many it loses."""
    arrivals = [
        (int(t), int(y) * events.width + int(x), bool(p))
        for t, x, y, p in zip(events.t_us, events.x, events.y, events.p, strict=True)
    ]
    waiting: list[tuple] = []
    done, lost, free, last = [], 0, -np.inf, events.height - 1
    stop = TIMES_S[-1] * 1e6
    while True:
        now = free if waiting else max(free, arrivals[0][0] if arrivals else np.inf)
        if now > stop:
            return done, lost + sum(any(a[1] == w[1] for w in waiting) for a in arrivals)
        while arrivals and arrivals[0][0] <= now:
            event = arrivals.pop(0)
            if any(event[1] == other[1] for other in waiting) or len(waiting) >= (settings.queue or np.inf):
                lost += 1
            else:
                waiting.append(event)
        if not waiting:
            continue
        chosen = waiting[:1]
        if settings.arbiter == "row":
            rows = sorted(
                {event[1] // events.width for event in waiting}, key=lambda r: (r - last - 1) % events.height
            )
            last = rows[0]
            chosen = [event for event in waiting if event[1] // events.width == last]
        waiting = [event for event in waiting if event not in chosen]
        done += [(int(np.floor(now)), pixel, on) for _, pixel, on in chosen]
        free = now + settings.setup_s * 1e6 + len(chosen) * settings.event_s * 1e6


@pytest.mark.parametrize("arbiter", ["row", "event"])
@pytest.mark.parametrize("queue", [0, 25])
def test_the_slow_queue_grants_the_same_events(arbiter, queue) -> None:
    settings = ReadoutPixel(QUIET, arbiter, 3e-6 if arbiter == "row" else 0.0, 2e-6, queue)
    frames = flashes()
    asking = simulate_events(frames, TIMES_S, QUIET, seed=4)
    read = simulate_events(frames, TIMES_S, settings, seed=4)
    expected, lost = slow_queue(asking, settings)
    found = sorted(
        zip(read.t_us.tolist(), (read.y.astype(int) * 20 + read.x).tolist(), read.p.tolist(), strict=True)
    )
    assert lost > 0
    assert len(read) > 500
    assert found == sorted(expected)


def test_a_bus_without_delay_changes_nothing() -> None:
    frames = flashes()
    for pixel in (QUIET, EventPixel(), BrownianPixel()):
        instant = ReadoutPixel(pixel, "row", 0.0, 0.0)
        assert simulate_events(frames, TIMES_S, instant, seed=2) == simulate_events(
            frames, TIMES_S, pixel, seed=2
        )


def test_a_light_load_leaves_the_counts_and_delays_little() -> None:
    frames = np.full((41, 12, 20), 60.0) * np.exp(np.linspace(0, 0.5, 41))[:, None, None]
    pixel = replace(QUIET, initial_phase="random")
    asking = simulate_events(frames, TIMES_S, pixel, seed=3)
    read = simulate_events(frames, TIMES_S, ReadoutPixel(pixel, "event", 0.0, 1e-7), seed=3)
    assert abs(len(read) - len(asking)) <= 1
    count = min(len(read), len(asking))
    assert np.abs(read.t_us[:count] - asking.t_us[:count]).max() < 20


def test_rows_are_read_whole_in_turn_and_stamped_with_one_time() -> None:
    frames = np.full((3, 8, 30), 50.0)
    frames[1:] *= 1.3
    pixel = replace(QUIET, threshold_sigma=0.0, threshold_on=0.2, threshold_off=0.2)
    events = simulate_events(frames, [0.0, 0.001, 0.002], ReadoutPixel(pixel, "row", 10e-6, 1e-6))
    assert len(events) == 8 * 30
    stamps = [np.unique(events.t_us[events.y == row]) for row in range(8)]
    assert all(len(one) == 1 for one in stamps)
    assert np.diff(np.concatenate(stamps)).tolist() == [40] * 7  # 10 us and 30 events of 1 us


def test_the_rate_is_capped() -> None:
    times = np.linspace(0.0, 0.2, 401)
    frames = 60.0 * np.exp(0.5 * np.sin(2 * np.pi * 40 * times))[:, None, None] * np.ones((1, 30, 40))
    pixel = replace(QUIET, threshold_sigma=0.02, initial_phase="random")
    free = simulate_events(frames, times, pixel, seed=1)
    capped = simulate_events(frames, times, ReadoutPixel(pixel, event_s=0.0, max_rate_hz=2e5), seed=1)
    assert len(free) > 3 * 2e5 * 0.2
    assert 0.75 * 2e5 * 0.2 < len(capped) < 1.25 * 2e5 * 0.2


def test_dead_pixels_are_silent_and_hot_ones_keep_their_rate() -> None:
    frames = np.repeat(flashes(2, 30, 40)[:1], 11, axis=0)
    settings = ReadoutPixel(
        QUIET, hot_pixel_fraction=0.05, hot_pixel_rate_hz=50.0, dead_pixel_fraction=0.1, pattern_seed=4
    )
    one, other = (simulate_events(frames, np.linspace(0, 2, 11), settings, seed=seed) for seed in (1, 2))
    assert one != other
    places = [set(zip(e.x.tolist(), e.y.tolist(), strict=True)) for e in (one, other)]
    assert places[0] == places[1]
    assert len(one) / len(places[0]) / 2 == pytest.approx(50.0, rel=0.1)
    busy = simulate_events(flashes(2, 30, 40), TIMES_S, replace(settings, hot_pixel_fraction=0.0), seed=1)
    silent = 1200 - len(set(zip(busy.x.tolist(), busy.y.tolist(), strict=True)))
    assert 80 < silent < 165


def test_stamps_are_ticks_and_jitter_has_its_spread() -> None:
    frames = flashes()
    plain = simulate_events(frames, TIMES_S, QUIET, seed=5)
    ticked = simulate_events(frames, TIMES_S, ReadoutPixel(QUIET, event_s=0.0, tick_s=50e-6), seed=5)
    assert np.all(ticked.t_us % 50 == 0)
    assert np.array_equal(np.sort(plain.t_us // 50 * 50), ticked.t_us)
    jittered = simulate_events(frames, TIMES_S, ReadoutPixel(QUIET, event_s=0.0, jitter_s=2e-5), seed=5)
    assert len(jittered) == len(plain)
    assert np.all(np.diff(jittered.t_us) >= 0)
    alone = np.bincount(plain.y.astype(int) * 20 + plain.x, minlength=240) == 1
    where = [e.y.astype(int) * 20 + e.x for e in (plain, jittered)]
    first = {int(w): int(t) for w, t in zip(where[0], plain.t_us, strict=True) if alone[w]}
    moved = [t - first[w] for w, t in zip(where[1].tolist(), jittered.t_us.tolist(), strict=True) if w in first]
    if len(moved) > 30:
        assert np.std(moved) == pytest.approx(20.0, rel=0.4)


@pytest.mark.parametrize("block", [1, 7, 41])
def test_blocks_change_nothing(block) -> None:
    settings = ReadoutPixel(QUIET, "row", 3e-6, 2e-6, 60, 4e5, 10e-6, 0.0, 0.1, 300.0, 0.05, pattern_seed=1)
    frames = flashes()
    stream = EventStream(settings, (12, 20), seed=8)
    for first in range(0, len(frames), block):
        stream.push(frames[first : first + block], TIMES_S[first : first + block])
    events = stream.finish()
    assert len(events) > 300
    assert events == simulate_events(frames, TIMES_S, settings, seed=8)


@pytest.mark.parametrize(
    "wrong",
    [{"pixel": ReadoutPixel()}, {"pixel": EventPixel(jitter_s=1e-4)}, {"arbiter": "column"}, {"event_s": -1.0}],
)
def test_wrong_settings_are_refused(wrong) -> None:
    with pytest.raises(ConfigError):
        ReadoutPixel(**wrong)
    with pytest.raises(ConfigError):
        simulate_events(np.ones((2, 1, 1)), [0, 1], ReadoutPixel(V2ePixel()))


@dataclass(frozen=True)
class Flat:
    shape: tuple[int, int] = (3, 4)
    speed_px_s: float = 0.0

    def irradiance(self, t_s) -> torch.Tensor:
        return torch.full((len(np.atleast_1d(t_s)), 3, 4), 0.5)


def test_a_rippling_lamp_makes_as_many_events_as_its_contrast_says() -> None:
    """2 ln((1 + c) / (1 - c)) / theta events a cycle and pixel, less the fractions of a threshold."""
    pixel = EventPixel(0.02, 0.02, 0.0, 0.0, 0.0, 0.0, initial_phase="rest")
    for contrast in (0.2, 0.5):
        events = EventCamera(pixel).record(FlickeringWall(Flat(), contrast, 100.0), 0.0, 0.2)
        cycle = len(events.between(100_000, 200_000)) / 12 / 10
        swing = np.log((1 + contrast) / (1 - contrast))
        assert abs(cycle - 2 * swing / 0.02) <= 2
    with pytest.raises(ConfigError, match="contrast"):
        FlickeringWall(Flat(), 1.5)
