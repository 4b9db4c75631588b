"""How fast do events become maps, next to other Python packages, on one thread?

Times each representation of one stream on 1280 x 720, interleaved with the rivals that can be imported (pip
install evutils tonic), and prints millions of events per second of processor time (median of the rounds) and
ratios (median within a round). Rivals get their own kind of array, made beforehand, and return float32 as we
do; the voxel grid of evutils counts into the nearest bin, ours shares each vote between two.

    python benchmarks/representations.py
    python benchmarks/representations.py --events 3000000 --stream blob
    python benchmarks/representations.py --write benchmarks/results/representations.md
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
import warnings
from collections.abc import Callable
from pathlib import Path

for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

from evnlos.events import event_histogram, time_surface, voxel_grid  # noqa: E402
from evnlos.types import Events  # noqa: E402
from machine import machine  # noqa: E402

WIDTH, HEIGHT = 1280, 720
TAU_US = 50_000.0
Run = Callable[[], object]


def uniform(count: int, seed: int = 0) -> Events:
    """Return events anywhere, a second long: the worst case for caches."""
    draw = np.random.default_rng(seed)
    t_us = np.sort(draw.integers(0, 1_000_000, count))
    x, y = draw.integers(0, WIDTH, count), draw.integers(0, HEIGHT, count)
    return Events(t_us, x, y, draw.integers(0, 2, count).astype(bool), width=WIDTH, height=HEIGHT)


def blob(count: int, seed: int = 0) -> Events:
    """Return events of a moving blob on top of noise, a second long."""
    draw = np.random.default_rng(seed)
    t_us = np.sort(draw.integers(0, 1_000_000, count))
    middle = 200 + 800 * t_us / 1e6
    near = draw.random(count) < 0.7
    x = np.where(near, np.clip(draw.normal(middle, 60), 0, WIDTH - 1), draw.integers(0, WIDTH, count)).astype(
        int
    )
    y = np.where(
        near, np.clip(draw.normal(360, 90, count), 0, HEIGHT - 1), draw.integers(0, HEIGHT, count)
    ).astype(int)
    return Events(t_us, x, y, draw.integers(0, 2, count).astype(bool), width=WIDTH, height=HEIGHT)


def rivals(events: Events) -> dict[str, dict[str, Run]]:
    """Return, by representation, the rivals that can be imported."""
    runs: dict[str, dict[str, Run]] = {"histogram": {}, "sae": {}, "voxel": {}}
    start, stop = int(events.t_us[0]), int(events.t_us[-1])
    try:
        from evutils import dense
        from evutils.types import EventArray

        array = EventArray(t=events.t_us, x=events.x, y=events.y, p=events.p.astype(np.uint8))
        runs["histogram"]["evutils"] = lambda: dense.histogram(array, WIDTH, HEIGHT, dtype=np.float32)
        runs["sae"]["evutils"] = lambda: dense.timesurface(array, WIDTH, HEIGHT, tau=int(TAU_US))
        span = stop - start + 1
        runs["voxel"]["evutils"] = lambda: dense.voxel_histogram(
            array, WIDTH, HEIGHT, n_bins=10, dt=span, dtype=np.float32
        )
    except (ImportError, TypeError) as error:
        print(f"    evutils left out: {error}")
    try:
        from tonic import transforms

        dtype = np.dtype([("x", "<i2"), ("y", "<i2"), ("t", "<i8"), ("p", "<i2")])
        rows = np.empty(len(events), dtype)
        for name, column in (("x", events.x), ("y", events.y), ("t", events.t_us), ("p", events.p)):
            rows[name] = column
        size = (WIDTH, HEIGHT, 2)
        frame = transforms.ToFrame(sensor_size=size, n_time_bins=1)
        voxel = transforms.ToVoxelGrid(sensor_size=size, n_time_bins=10)
        surface = transforms.ToTimesurface(sensor_size=size, dt=stop - start + 1, tau=TAU_US)
        runs["histogram"]["tonic"] = lambda: frame(rows)
        runs["sae"]["tonic"] = lambda: surface(rows)
        runs["voxel"]["tonic"] = lambda: voxel(rows.copy())  # it rewrites the polarity of its input
    except (ImportError, TypeError) as error:
        print(f"    tonic left out: {error}")
    return runs


def measure(runs: dict[str, Run], rounds: int) -> dict[str, list[float]]:
    """Return the processor times of each, in seconds, after one round that compiles; failures are left out."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(rounds + 1):
        for name in list(times):
            start = time.process_time()
            try:
                runs[name]()
            except Exception as error:
                print(f"    {name}: {type(error).__name__}: {str(error)[:100]}")
                del times[name]
                continue
            if turn:
                times[name].append(time.process_time() - start)
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--events", type=int, default=10_000_000)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--stream", choices=("uniform", "blob"), default="uniform")
    parser.add_argument("--write", help="file for the table")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    events = {"uniform": uniform, "blob": blob}[arguments.stream](arguments.events)
    edges = np.array([events.t_us[0] - 1, events.t_us[-1]])
    theirs = rivals(events)
    sae: Run = lambda: time_surface(events, edges, TAU_US)  # noqa: E731
    ours: dict[str, Run] = {
        "histogram": lambda: event_histogram(events),
        "sae": sae,
        "voxel": lambda: voxel_grid(events, 10),
    }
    for radius in (1, 2, 3, 5):
        title = f"context, radius {radius}"
        ours[title] = lambda radius=radius: time_surface(events, edges, TAU_US, "context", radius=radius)
        theirs[title] = {"our sae": sae}
    names = ["evnlos", *dict.fromkeys(name for runs in theirs.values() for name in runs if name != "our sae")]
    lines = [
        "# Representations",
        "",
        f"{len(events):,} {arguments.stream} events on {WIDTH} x {HEIGHT}, one thread, processor time, medians "
        f"of {arguments.rounds} interleaved rounds; millions of events per second.",
        "",
        machine("numpy", "evutils", "tonic"),
        "",
        f"| map | {' | '.join(names)} | ratios |\n|---|{'---|' * len(names)}---|",
    ]
    print("\n".join(lines))
    for title, run in ours.items():
        times = measure({"evnlos": run, **theirs.get(title, {})}, arguments.rounds)
        speeds = {name: len(events) / statistics.median(taken) / 1e6 for name, taken in times.items()}
        ratios = [f"{ratio(times['evnlos'], times[name]):.3g} x {name}" for name in times if name != "evnlos"]
        cells = " | ".join(f"{speeds[name]:.1f}" if name in speeds else "-" for name in names)
        lines.append(f"| {title} | {cells} | {', '.join(ratios)} |")
        print(lines[-1], flush=True)
    if arguments.write:
        Path(arguments.write).write_text("\n".join(lines) + "\n")


def ratio(ours: list[float], theirs: list[float]) -> float:
    """Return how many times faster ours is: the median over the rounds."""
    return statistics.median(b / a for a, b in zip(ours, theirs, strict=True))


if __name__ == "__main__":
    main()
