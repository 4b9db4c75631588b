"""How many nanoseconds does a pixel-step cost, beside EventCV and v2e on the same frames and the same core?

    python benchmarks/event_pixel.py                       # ours and EventCV (pip install eventcv)
    python benchmarks/event_pixel.py --v2e ~/v2e           # and a checkout of v2e
    python benchmarks/event_pixel.py --write benchmarks/results/event_pixel.md

CPU time, all noise on, the building of the event arrays included, interleaved runs, medians. Threads are
limited to one except where the table says otherwise; compilation is left out by a short run before.

The second table is the paper's scene, 8 s: ours renders it and makes its events; the others are given frames
of it in steps of 1 ms, 8-bit, whose rendering is not counted, and run `--steps` of the 8000 steps.
"""

from __future__ import annotations

import argparse
import cProfile
import logging
import os
import pstats
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike

from evnlos.cameras import EventCamera, EventPixel, simulate_events
from evnlos.cameras.pixel import Mode
from evnlos.data.simulations import paper
from evnlos.scene import Scene
from evnlos.types import Events, Irradiance, derive_seed
from machine import machine

PAPER = EventPixel()
STEP_S = 1e-3
SCENE_S = 8.0
MIDDLE_S = 4.0
Results = dict[str, tuple[float, float, int]]
"""CPU seconds, wall seconds and events of each run."""


class Wall:
    """An image of soft lights that slides over the sensor: rows are interpolated."""

    def __init__(self, height: int, width: int, speed_px_s: float) -> None:
        self.shape, self.speed_px_s = (height, width), speed_px_s
        y, x = np.mgrid[:height, : 2 * width + 2].astype(np.float32)
        picture = np.full((height, 2 * width + 2), 0.12, np.float32)
        draw = np.random.default_rng(0)
        for _ in range(24):
            cx, cy, size = draw.uniform(0, 2 * width), draw.uniform(0, height), draw.uniform(15, 60)
            picture += 0.35 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * size**2)).astype(np.float32)
        self._picture = torch.tensor(np.clip(picture, 0, 1))

    def irradiance(self, t_s: ArrayLike) -> torch.Tensor:
        """Return the view at the instants, [T, H, W]."""
        height, width = self.shape
        times = np.asarray(t_s)
        frames = torch.empty(len(times), height, width)
        for n, time_s in enumerate(times):
            shift = width - self.speed_px_s * time_s
            whole = int(np.floor(shift))
            left, right = (
                self._picture[:, whole : whole + width],
                self._picture[:, whole + 1 : whole + 1 + width],
            )
            torch.lerp(left, right, float(shift - whole), out=frames[n])
        return frames


def video(height: int, width: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return frames in DN, float32 [T, H, W], and their times."""
    times = np.arange(steps + 1) * STEP_S
    return (255 * Wall(height, width, width / 16).irradiance(times)).numpy(), times


def long_video(height: int, width: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return 8-bit frames [T, H, W] and their times, without room for float ones."""
    wall, times = Wall(height, width, width / 16), np.arange(steps + 1) * STEP_S
    frames = np.empty((steps + 1, height, width), np.uint8)
    for k in range(len(frames)):
        frames[k] = 255 * wall.irradiance(times[k : k + 1])[0].numpy()
    return frames, times


def scene_wall(height: int, width: int) -> Irradiance:
    """Return the wall of the first letter of the `paper` preset: 8 cm at 2 cm/s, handwriting."""
    config = paper()
    target = config.glyphs.target(config.glyphs.objects()[0], derive_seed(config.seed, "glyph"))
    return config.setup.resized((height, width)).observe(Scene(target, config.motion, SCENE_S))


def scene_events(height: int, width: int, seconds: float = SCENE_S) -> Events:
    """Make the letter, its wall and the events of its sequence from nothing, with steps that the camera
    chooses.
    """
    return EventCamera(PAPER).record(scene_wall(height, width), 0.0, seconds, threads=1)


def scene_video(height: int, width: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return 8-bit frames [T, H, W] of the middle of the scene and their times, which start at 0."""
    wall, times = scene_wall(height, width), np.arange(steps + 1) * STEP_S
    frames = np.empty((steps + 1, height, width), np.uint8)
    for frame, time_s in zip(frames, times, strict=True):
        frame[:] = np.rint(255 * wall.irradiance(MIDDLE_S + time_s).numpy())
    return frames, times


def eventcv_run(frames: np.ndarray) -> Callable[[int], int]:
    """Return a run of EventCV on the same light: it takes sRGB values apart, so they are put together first."""
    os.environ["RAYON_NUM_THREADS"] = "1"  # before the import: its pool is made there
    import eventcv

    light = frames / 255.0
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055).astype(np.float32)

    def run(count: int) -> int:
        events = eventcv.simulate(
            encoded[:count],
            fps=1 / STEP_S,
            pos_thres=0.15,
            neg_thres=0.15,
            sigma_thres=0.03,
            cutoff_hz=15.0,
            leak_rate_hz=0.01,
            shot_noise_rate_hz=0.0015,
            refractory_us=0,
            upsample="off",
        )
        return len(events)

    return run


def v2e_run(folder: str, frames: np.ndarray, times: np.ndarray) -> Callable[[int], int]:
    """Return a run of a checkout of v2e on the same frames."""
    sys.path.insert(0, str(Path(folder).expanduser()))
    from v2ecore.emulator import EventEmulator  # type: ignore[import-not-found]

    logging.getLogger("v2ecore").setLevel(logging.ERROR)  # it warns of every frame without events

    def run(count: int) -> int:
        emulator = EventEmulator(
            pos_thres=0.15,
            neg_thres=0.15,
            sigma_thres=0.03,
            cutoff_hz=15.0,
            leak_rate_hz=0.01,
            shot_noise_rate_hz=0.0015,
            refractory_period_s=0.0,
            seed=1,
            device="cpu",
        )
        blocks = [
            emulator.generate_events(frame, t) for frame, t in zip(frames[:count], times[:count], strict=True)
        ]
        blocks = [block for block in blocks if block is not None]
        return len(np.concatenate(blocks)) if blocks else 0

    return run


def interleaved(runs: dict[str, Callable[[int], int]], steps: int, rounds: int) -> Results:
    """Return median CPU seconds, median wall seconds and events of each run, taken in turns."""
    spent = {name: ([], []) for name in runs}
    events = {}
    for run in runs.values():
        run(4)
    for _ in range(rounds):
        for name, run in runs.items():
            cpu, wall = time.process_time(), time.perf_counter()
            events[name] = run(steps + 1)
            spent[name][0].append(time.process_time() - cpu)
            spent[name][1].append(time.perf_counter() - wall)
    return {name: (statistics.median(c), statistics.median(w), events[name]) for name, (c, w) in spent.items()}


def table(results: Results, unit: str, scale: Callable[[str], float]) -> list[str]:
    """Return the rows of a table: cost in `unit`, events, and how many times as much the rivals cost.

    Args:
        results: What each run took.
        unit: What the second column shows.
        scale: Factor from a run's CPU seconds to that unit, given the run's name.
    """
    cost = {name: cpu * scale(name) for name, (cpu, _, _) in results.items()}
    rivals = [name for name in ("v2e", "EventCV") if name in results]
    lines = [
        f"| simulator | {unit} | events |" + "".join(f" {rival} / this |" for rival in rivals),
        "|---|---|---|" + "---|" * len(rivals),
    ]
    for name, (_, _, events) in results.items():
        ratios = "".join(f" {cost[rival] / cost[name]:.1f} |" for rival in rivals)
        lines.append(f"| {name} | {cost[name]:.2f} | {events:,} |" + ratios)
    return lines


def rival_runs(v2e: str | None, gray: np.ndarray, times: np.ndarray) -> dict[str, Callable[[int], int]]:
    """Return the runs of the other simulators that are present, on 8-bit frames."""
    runs = {}
    try:
        runs["EventCV"] = eventcv_run(gray.astype(np.float32))
    except ImportError:
        print("EventCV is not installed (pip install eventcv): left out")
    if v2e:
        runs["v2e"] = v2e_run(v2e, gray, times)
    return runs


def scene_part(height: int, width: int, steps: int, rounds: int, v2e: str | None) -> list[str]:
    """Return the table of the paper's scene, and where our time goes in it."""
    gray, times = scene_video(height, width, steps)
    whole, given = "evnlos, rendering and events", 'evnlos, mode="v2e", given frames'
    runs = {
        # the short run before the contest has few steps and compiles
        whole: lambda n: len(scene_events(height, width, SCENE_S if n > steps else 0.1)),
        given: lambda n: len(simulate_events(gray[:n], times[:n], PAPER, mode="v2e", threads=1)),
        **rival_runs(v2e, gray, times),
    }
    results = interleaved(runs, steps, rounds)
    share = SCENE_S / (steps * STEP_S)
    profile = cProfile.Profile()
    profile.runcall(scene_events, height, width)
    stats = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    total = sum(own for _, _, own, _, _ in stats.values())

    def spent(*names: str, inside: bool = False) -> str:
        taken = sum(row[3] if inside else row[2] for key, row in stats.items() if key[2] in names)
        return f"{taken / total:.0%}"

    return [
        "",
        f"## The paper's scene, {SCENE_S:g} s",
        "",
        f"A handwritten letter of 8 cm at 2 cm/s, {width} x {height}. First row: the letter, its wall, all "
        'frames and all events, mode="exact", steps chosen by the camera. Other rows: 8-bit frames of the same '
        f"wall in steps of 1 ms, their rendering not counted; {steps} of the {SCENE_S / STEP_S:.0f} steps were "
        f"run, from {MIDDLE_S:g} s on with pixels at rest. Their seconds are scaled to all steps, their events "
        "are not.",
        "",
        *table(results, f"CPU s for {SCENE_S:g} s", lambda name: 1.0 if name == whole else share),
        "",
        f"Our time, by a profile of one run: pixel kernel {spent('run_tiles')}, rendering "
        f"{spent('irradiance', inside=True)}, scaling to DN {spent('_render')}, error probes "
        f"{spent('_worst_miss')}, order of the events "
        f"{spent('_counting_sort', 'settle_ties', '_coordinates', 'join', '<genexpr>')}.",
    ]


def memory_above_input_mb(height: int, width: int, steps: int) -> tuple[float, int]:
    """Return the peak memory above the input of a run in a process of its own in MB, and its events."""
    code = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from event_pixel import PAPER, STEP_S, Wall, np, simulate_events
wall = Wall({height}, {width}, {width / 16})
simulate_events(np.full((3, 8, 8), 9, np.uint8), [0, 1, 2], PAPER, mode="v2e", threads=1)
frames = np.empty(({steps + 1}, {height}, {width}), np.uint8)
for k in range(len(frames)):
    frames[k] = 255 * wall.irradiance([k * STEP_S])[0].numpy()
def status(key):
    return int(next(line for line in open("/proc/self/status") if line.startswith(key)).split()[1])
open("/proc/self/clear_refs", "w").write("5")
before = status("VmRSS")
events = simulate_events(frames, np.arange(len(frames)) * STEP_S, PAPER, mode="v2e", threads=1)
print((status("VmHWM") - before) / 1024, len(events))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    megabytes, events = done.stdout.split()
    return float(megabytes), int(events)


def spin_scaling() -> float:
    """Return how much faster two threads are than one on a loop without memory."""
    import numba

    @numba.njit(nogil=True)
    def spin(count: int) -> float:
        total = 0.0
        for n in range(count):
            total += np.sin(n)
        return total

    spin(1)
    spent = []
    for threads in (1, 2):
        start = time.perf_counter()
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(spin, [5_000_000] * 4))
        spent.append(time.perf_counter() - start)
    return spent[0] / spent[1]


def main() -> None:
    """Run the contest and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--v2e", help="checkout of v2e")
    parser.add_argument("--size", type=int, nargs=2, default=(600, 960), metavar=("H", "W"))
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--write", help="write the table to this file as well")
    args = parser.parse_args()
    torch.set_num_threads(1)
    height, width = args.size
    light, times = video(height, width, args.steps)
    gray = np.rint(light).astype(np.uint8)

    def ours(frames: np.ndarray, mode: Mode, threads: int = 1) -> Callable[[int], int]:
        return lambda n: len(simulate_events(frames[:n], times[:n], PAPER, mode=mode, threads=threads))

    runs = {
        'evnlos, mode="v2e", 8-bit': ours(gray, "v2e"),
        'evnlos, mode="v2e", float': ours(light, "v2e"),
        'evnlos, mode="exact", float': ours(light, "exact"),
    }
    results = interleaved({**runs, **rival_runs(args.v2e, gray, times)}, args.steps, args.rounds)
    pixel_steps = height * width * args.steps
    lines = [
        "# Cost of a pixel-step",
        "",
        f"{width} x {height}, {args.steps} steps of 1 ms, the paper's settings, all noise on, one thread.",
        "",
        machine(),
        "",
        *table(results, "ns per pixel-step", lambda _: 1e9 / pixel_steps),
    ]
    del light, gray
    gray, times = long_video(height, width, 500)
    scaled = interleaved({str(n): ours(gray, "v2e", n) for n in (1, 2)}, 500, args.rounds)
    lines += [
        "",
        f"Two threads, 500 steps: {scaled['1'][1] / scaled['2'][1]:.2f} times as fast as one (wall time); a "
        f"loop that only computes, at the same moment: {spin_scaling():.2f}. Only a figure near 2 for the loop "
        "says that two cores were free.",
        "Memory above the input, 500 steps, the events included: {:.0f} MB for {:,} events.".format(
            *memory_above_input_mb(height, width, 500)
        ),
    ]
    del runs, gray
    lines += scene_part(height, width, args.steps, args.rounds, args.v2e)
    text = "\n".join(lines) + "\n"
    print(text)
    if args.write:
        Path(args.write).write_text(text)


if __name__ == "__main__":
    main()
