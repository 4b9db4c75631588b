"""What do filters of events leave of the scene and of the noise, next to those of other packages?

Makes streams whose every event has a label: a scene (simulated without noise) with background activity, hot
pixels or the events of flickering lamps mixed in. Prints the share of the scene's events that stay (recall),
the share of what stays that is the scene's (precision), and millions of events per second of processor time.
Filters with a window are compared at equal work: each at the window that takes 90 % of the noise away. Rivals
are optional: those that cannot be imported (pip install eventcv dv-processing) are left out.

    python benchmarks/cleaning.py
    python benchmarks/cleaning.py --write benchmarks/results/cleaning.md
"""

from __future__ import annotations

import argparse
import datetime
import importlib.util
import os
import time
from collections.abc import Callable
from pathlib import Path

for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from evnlos.cameras import EventPixel, simulate_events  # noqa: E402
from evnlos.events import CleanOptions, clean_events, keep_supported  # noqa: E402
from evnlos.types import Events  # noqa: E402
from machine import machine  # noqa: E402

WIDTH, HEIGHT, SECONDS = 240, 180, 4.0
WINDOWS_MS = np.geomspace(0.25, 512, 16)
Kept = NDArray[np.bool_]
Filter = Callable[[Events], Kept]


def edges() -> Events:
    """Sharp texture that moves by 60 pixels a second."""
    draw = np.random.default_rng(0)
    texture = np.kron(draw.choice([60.0, 90.0, 140.0], (HEIGHT // 12, 2 * WIDTH // 12)), np.ones((12, 12)))
    times = np.arange(0, SECONDS, 0.01)
    at = 60 * times
    whole, part = at.astype(int), (at % 1)[:, None, None]
    light = np.stack([texture[:, k : k + WIDTH + 1] for k in whole])
    light = (1 - part) * light[..., :-1] + part * light[..., 1:]
    return simulate_events(light.astype(np.float32), times, EventPixel(0.15, 0.18, 0.02, 100, 0, 0), seed=1)


def wall() -> Events:
    """Light that wanders over a relay wall: no edge anywhere, a tenth of the contrast."""
    times = np.arange(0, SECONDS, 0.02)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    spot = np.exp(-((x - 20 - 50 * times[:, None, None]) ** 2 + (y - 90) ** 2) / (2 * 25**2))
    light = 60 * (1 + 0.9 * spot)
    return simulate_events(light.astype(np.float32), times, EventPixel(0.1, 0.12, 0.02, 50, 0, 0), seed=1)


def background(rate_hz: float, seed: int = 2) -> Events:
    """Poisson events of every pixel."""
    draw = np.random.default_rng(seed)
    count = draw.poisson(rate_hz * WIDTH * HEIGHT * SECONDS)
    return Events(
        np.sort(draw.integers(0, int(SECONDS * 1e6), count)),
        draw.integers(0, WIDTH, count),
        draw.integers(0, HEIGHT, count),
        draw.random(count) < 0.5,
        WIDTH,
        HEIGHT,
    )


def hot_pixels(count: int = 40, seed: int = 3) -> Events:
    """Pixels that fire 30 to 1000 times a second."""
    draw = np.random.default_rng(seed)
    rates = np.geomspace(30, 1000, count)
    pixel = np.repeat(draw.choice(WIDTH * HEIGHT, count, replace=False), (rates * SECONDS).astype(int))
    t_us = draw.integers(0, int(SECONDS * 1e6), len(pixel))
    order = np.argsort(t_us)
    pixel = pixel[order]
    return Events(t_us[order], pixel % WIDTH, pixel // WIDTH, np.ones(len(pixel), bool), WIDTH, HEIGHT)


def flicker(contrast: float, hertz: float = 100.3) -> Events:
    """An uneven patch of 40 x 30 pixels whose lamps ripple, seen by pixels with mismatch and jitter."""
    times = np.arange(0, SECONDS, 1 / (24 * hertz))
    level = np.broadcast_to(np.linspace(60, 120, 40), (30, 40))
    light = level * (1 + contrast * np.sin(2 * np.pi * hertz * times))[:, None, None]
    pixel = EventPixel(0.1, 0.12, 0.02, 300, 0, 0, jitter_s=1e-4)
    events = simulate_events(light.astype(np.float32), times, pixel, seed=4)
    return Events(events.t_us, events.x + np.uint16(100), events.y + np.uint16(75), events.p, WIDTH, HEIGHT)


def labelled(scene: Events, noise: Events) -> tuple[Events, Kept]:
    """Return both as one stream, no two events of one pixel at one instant, and which are the scene's."""
    columns = {n: np.concatenate([c, noise.columns()[n]]) for n, c in scene.columns().items()}
    is_scene = np.arange(len(columns["t_us"])) < len(scene)
    order = np.argsort(keys(columns["t_us"], columns["x"], columns["y"]), kind="stable")
    key = keys(*(columns[n][order] for n in ("t_us", "x", "y")))
    order = order[np.concatenate([[True], key[1:] != key[:-1]])]
    return Events(**{n: c[order] for n, c in columns.items()}, width=WIDTH, height=HEIGHT), is_scene[order]


def keys(t_us: NDArray, x: NDArray, y: NDArray) -> NDArray[np.int64]:
    """Return one number an event."""
    return (t_us.astype(np.int64) * HEIGHT + y) * WIDTH + x


def found(events: Events, t_us: NDArray, x: NDArray, y: NDArray) -> Kept:
    """Return which events of a stream are among those that a filter returned."""
    return np.isin(keys(events.t_us, events.x, events.y), keys(t_us, x, y))


def ours(window_ms: float, sides: int = 2) -> Filter:
    """Return the filter of this package."""

    def run(events: Events) -> Kept:
        kept = keep_supported(events, round(1e3 * window_ms), sides)
        return found(events, kept.t_us, kept.x, kept.y)

    return run


def cleaned(options: CleanOptions) -> Filter:
    """Return `clean_events` with these options."""

    def run(events: Events) -> Kept:
        kept, _ = clean_events(events, options)
        return found(events, kept.t_us, kept.x, kept.y)

    return run


def eventcv(call: Callable) -> Filter:
    """Return a filter of EventCV's streams."""
    import eventcv as ecv

    def run(events: Events) -> Kept:
        table = np.stack([events.x, events.y, events.t_us, events.p], axis=1).astype(np.int64)
        stream = ecv.from_numpy(table, sensor_size=(WIDTH, HEIGHT), time_unit="us")
        kept = np.asarray(call(stream).numpy())
        return found(events, kept[:, 2], kept[:, 0], kept[:, 1])

    return run


_STORES: dict[int, object] = {}


def dv(make: Callable) -> Filter:
    """Return a filter of dv-processing's."""
    import dv_processing

    def run(events: Events) -> Kept:
        store = _STORES.get(id(events))
        if store is None:
            _STORES.clear()
            store = _STORES[id(events)] = dv_processing.EventStore()
            for t, x, y, p in zip(
                *(events.columns()[n].tolist() for n in ("t_us", "x", "y", "p")), strict=True
            ):
                store.push_back(t, x, y, p)
        one = make((WIDTH, HEIGHT))
        one.accept(store)
        kept = one.generateEvents().numpy()
        return found(events, kept["timestamp"], kept["x"], kept["y"])

    return run


def windowed() -> dict[str, Callable[[float], Filter]]:
    """Return the filters with a window, by name; each takes milliseconds."""
    filters: dict[str, Callable[[float], Filter]] = {
        "evnlos clean --background-ms": ours,
        "evnlos clean, --background-sides 3": lambda ms: ours(ms, 3),
    }
    if importlib.util.find_spec("eventcv"):
        for shape in ("block", "cross"):
            filters[f"EventCV background_activity_filter, {shape}"] = lambda ms, shape=shape: eventcv(
                lambda stream: stream.background_activity_filter(round(1e3 * ms), neighbourhood=shape)
            )
    if importlib.util.find_spec("dv_processing"):
        from dv_processing import noise

        def us(ms: float) -> datetime.timedelta:
            return datetime.timedelta(microseconds=round(1e3 * ms))

        filters["dv-processing BackgroundActivityNoiseFilter"] = lambda ms: dv(
            lambda size: noise.BackgroundActivityNoiseFilter(size, us(ms))
        )
        filters["dv-processing FastDecayNoiseFilter"] = lambda ms: dv(
            lambda size: noise.FastDecayNoiseFilter(size, us(ms))
        )
        filters["dv-processing KNoiseFilter"] = lambda ms: dv(lambda size: noise.KNoiseFilter(size, us(ms)))
    return filters


def score(kept: Kept, is_scene: Kept) -> tuple[float, float, float]:
    """Return recall and precision of the scene, and the share of the noise that is gone."""
    recall = kept[is_scene].mean()
    precision = is_scene[kept].mean() if kept.any() else 0.0
    return float(recall), float(precision), float(1 - kept[~is_scene].mean())


def row(noise: str, name: str, setting: str, scores: tuple[float, float, float]) -> str:
    """Return a line of the table."""
    recall, precision, gone = scores
    return f"| {noise} | {name} | {setting} | {gone:.3f} | {recall:.3f} | {precision:.3f} |"


def at_equal_work(make: Callable[[float], Filter], events: Events, is_scene: Kept) -> tuple[str, tuple]:
    """Return the scores at the window that takes 90 % of the noise away, interpolated, and the window."""
    scores = np.array([score(make(ms)(events), is_scene) for ms in WINDOWS_MS])
    gone = np.minimum.accumulate(scores[:, 2])
    if not gone[-1] <= 0.9 <= gone[0]:
        best = int(np.argmin(abs(gone - 0.9)))
        return f"{WINDOWS_MS[best]:.2g} ms (90 % is not reached)", tuple(scores[best])
    window = float(np.exp(np.interp(-0.9, -gone, np.log(WINDOWS_MS))))
    return f"{window:.2g} ms", score(make(window)(events), is_scene)


def speeds(events: Events) -> list[str]:
    """Return the speed of each background filter; what turns arrays into its stream is not counted."""
    import timeit

    lines, keep = [], {"evnlos": lambda: keep_supported(events, 5000)}
    if importlib.util.find_spec("eventcv"):
        import eventcv as ecv

        table = np.stack([events.x, events.y, events.t_us, events.p], axis=1).astype(np.int64)
        stream = ecv.from_numpy(table, sensor_size=(WIDTH, HEIGHT), time_unit="us")
        keep["EventCV"] = lambda: stream.background_activity_filter(5000)
    if importlib.util.find_spec("dv_processing"):
        import dv_processing

        dv(lambda size: dv_processing.noise.BackgroundActivityNoiseFilter(size))(events)
        store = _STORES[id(events)]

        def filtered() -> object:
            one = dv_processing.noise.BackgroundActivityNoiseFilter(
                (WIDTH, HEIGHT), datetime.timedelta(milliseconds=5)
            )
            one.accept(store)
            return one.generateEvents()

        keep["dv-processing"] = filtered
    rounds = {name: [] for name in keep}
    for _ in range(5):
        for name, call in keep.items():
            rounds[name].append(len(events) / 1e6 / timeit.timeit(call, number=1, timer=time.process_time))
    for name, rates in rounds.items():
        ratio = np.median(np.array(rounds["evnlos"]) / np.array(rates))
        lines.append(f"| {name} | {np.median(rates):.1f} | {ratio:.2f} |")
    return lines


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", type=Path, help="also write the tables to this file")
    arguments = parser.parse_args()
    scenes = {"edges": edges(), "wall": wall()}
    head = ["| noise | filter | setting | noise gone | scene kept | precision |", "|---|---|---|---|---|---|"]
    lines = ["# Cleaning", "", machine("eventcv", "dv-processing"), ""]
    for title, scene in scenes.items():
        rate = len(scene) / SECONDS / WIDTH / HEIGHT
        lines += [f"## {title}: {len(scene):,} events, {rate:.2f} per pixel per second", "", *head]
        for rate_hz in (0.3, 3.0):
            events, is_scene = labelled(scene, background(rate_hz))
            for name, make in windowed().items():
                setting, scores = at_equal_work(make, events, is_scene)
                lines.append(row(f"{rate_hz} Hz per pixel", name, setting, scores))
                print(lines[-1], flush=True)
        events, is_scene = labelled(scene, hot_pixels())
        tools: dict[str, tuple[str, Filter]] = {
            "evnlos clean --hot-factor": ("10", cleaned(CleanOptions(flicker_hz=None))),
        }
        if importlib.util.find_spec("eventcv"):
            tools["EventCV hot_pixel_filter"] = ("n_std 3", eventcv(lambda stream: stream.hot_pixel_filter()))
        for name, (setting, one) in tools.items():
            lines.append(row("40 hot pixels", name, setting, score(one(events), is_scene)))
        for contrast in (0.15, 0.3):
            events, is_scene = labelled(scene, flicker(contrast))
            combs: dict[str, tuple[str, Filter]] = {
                "evnlos clean --flicker": ("auto", cleaned(CleanOptions(hot_pixel_factor=None))),
            }
            if importlib.util.find_spec("dv_processing"):
                from dv_processing import noise

                for low, high in ((90.0, 110.0), (50.0, 200.0)):
                    cut = dv(lambda size, low=low, high=high: noise.BandCutFilter(size, low, high))
                    combs[f"dv-processing BandCutFilter {low:g} to {high:g} Hz"] = ("", cut)
            for name, (setting, one) in combs.items():
                ripple = f"lamps, {100 * contrast:.0f} % ripple, {np.count_nonzero(~is_scene):,} events"
                lines.append(row(ripple, name, setting, score(one(events), is_scene)))
                print(lines[-1], flush=True)
        lines.append("")
    events, _ = labelled(scenes["edges"], background(3.0))
    lines += [f"## Speed: {len(events):,} events, window 5 ms", ""]
    lines += ["| filter | million events/s | evnlos is faster by |", "|---|---|---|", *speeds(events)]
    text = "\n".join(lines) + "\n"
    print(text)
    if arguments.write:
        arguments.write.write_text(text)


if __name__ == "__main__":
    main()
