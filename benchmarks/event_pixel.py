"""How many nanoseconds does a pixel-step cost, beside EventCV and v2e on the same frames and the same core?

    python benchmarks/event_pixel.py                       # ours and EventCV (pip install eventcv)
    python benchmarks/event_pixel.py --v2e ~/v2e           # and a checkout of v2e
    python benchmarks/event_pixel.py --write benchmarks/results/event_pixel.md

CPU time, all noise on, the building of the event arrays included, interleaved runs, medians. Threads are
limited to one except where the table says otherwise; compilation is left out by a short run before.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch

from evnlos.sensor import EventCamera, EventPixel, simulate_events

PAPER = EventPixel()
STEP_S = 1e-3


class Wall:
    """A picture of soft lights that slides over the sensor: rows are interpolated."""

    def __init__(self, height: int, width: int, speed_px_s: float) -> None:
        self.shape, self.speed_px_s = (height, width), speed_px_s
        y, x = np.mgrid[:height, : 2 * width + 2].astype(np.float32)
        picture = np.full((height, 2 * width + 2), 0.12, np.float32)
        draw = np.random.default_rng(0)
        for _ in range(24):
            cx, cy, size = draw.uniform(0, 2 * width), draw.uniform(0, height), draw.uniform(15, 60)
            picture += 0.35 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * size**2)).astype(np.float32)
        self._picture = torch.tensor(np.clip(picture, 0, 1))

    def irradiance(self, t_s: object) -> torch.Tensor:
        """Return the view at the instants, [T, H, W]."""
        height, width = self.shape
        frames = torch.empty(len(t_s), height, width)
        for n, time_s in enumerate(np.asarray(t_s)):
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
    from v2ecore.emulator import EventEmulator

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


def interleaved(
    runs: dict[str, Callable[[int], int]], steps: int, rounds: int
) -> dict[str, tuple[float, float, int]]:
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


def machine() -> str:
    """Return the processor, the number of cores and the versions that matter."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = dict(line.split(":", 1) for line in info.read_text().splitlines() if ":" in line)
        fields = {key.strip(): value.strip() for key, value in lines.items()}
        name = (
            f"{fields.get('model name', name)} (family {fields.get('cpu family')}, model {fields.get('model')})"
        )
    import numba

    return f"{name}, {os.cpu_count()} cores; Python {platform.python_version()}, numba {numba.__version__}"


def picture(path: str) -> None:
    """Draw the time stamps of one row of pixels in both modes, as a vector graphic."""
    wall = Wall(200, 300, 4000.0)
    times = np.arange(31) * STEP_S
    light = (255 * wall.irradiance(times)).numpy()
    pixel = EventPixel(threshold_sigma=0, cutoff_hz=200, leak_rate_hz=0, shot_noise_rate_hz=0)
    marks = ['<text x="10" y="14">mode="v2e"</text><text x="10" y="254">mode="exact"</text>']
    for top, mode in ((20, "v2e"), (260, "exact")):
        events = simulate_events(light, times, pixel, mode=mode)
        kept = (events.y == 100) & (events.t_us > 8_000) & (events.t_us <= 18_000)
        marks.append(f'<rect x="10" y="{top}" width="620" height="200" fill="none" stroke="#888"/>')
        for time_us, x, on in zip(events.t_us[kept], events.x[kept], events.p[kept], strict=True):
            across, down = 10 + 2.06 * x, top + 200 - (time_us - 8_000) / 50
            marks.append(f'<circle cx="{across:.1f}" cy="{down:.1f}" r="1" fill="{"#c22" if on else "#22c"}"/>')
    marks.append('<text x="10" y="480">column 0 to 299 across, 10 ms upwards; red ON, blue OFF</text>')
    head = '<svg xmlns="http://www.w3.org/2000/svg" width="640" height="490" font-family="sans-serif" '
    Path(path).write_text(
        head + 'font-size="12">' + '<rect width="640" height="490" fill="#fff"/>' + "".join(marks) + "</svg>\n"
    )


def main() -> None:
    """Run the contest and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--v2e", help="checkout of v2e")
    parser.add_argument("--size", type=int, nargs=2, default=(600, 960), metavar=("H", "W"))
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--write", help="write the table to this file as well")
    parser.add_argument("--picture", help="only draw the time stamps of both modes into this SVG file")
    args = parser.parse_args()
    if args.picture:
        picture(args.picture)
        return
    torch.set_num_threads(1)
    height, width = args.size
    light, times = video(height, width, args.steps)
    gray = np.rint(light).astype(np.uint8)

    def ours(frames: np.ndarray, mode: str, threads: int = 1) -> Callable[[int], int]:
        return lambda n: len(simulate_events(frames[:n], times[:n], PAPER, mode=mode, threads=threads))

    runs = {
        'evnlos, mode="v2e", 8-bit': ours(gray, "v2e"),
        'evnlos, mode="v2e", float': ours(light, "v2e"),
        'evnlos, mode="exact", float': ours(light, "exact"),
    }
    try:
        runs["EventCV"] = eventcv_run(gray.astype(np.float32))
    except ImportError:
        print("EventCV is not installed (pip install eventcv): left out")
    if args.v2e:
        runs["v2e"] = v2e_run(args.v2e, gray, times)
    results = interleaved(runs, args.steps, args.rounds)
    pixel_steps = height * width * args.steps
    base = results['evnlos, mode="v2e", 8-bit'][0]
    lines = [
        "# Cost of a pixel-step",
        "",
        f"{width} x {height}, {args.steps} steps of 1 ms, the paper's settings, all noise on, one thread.",
        "",
        machine(),
        "",
        "| simulator | ns a pixel-step | events | times our 8-bit v2e mode |",
        "|---|---|---|---|",
    ]
    for name, (cpu, _, events) in results.items():
        lines.append(f"| {name} | {1e9 * cpu / pixel_steps:.2f} | {events:,} | {cpu / base:.1f} |")
    scaled = interleaved({str(n): ours(gray, "v2e", n) for n in (1, 2)}, args.steps, args.rounds)
    lines += [
        "",
        f"Two threads: {scaled['1'][1] / scaled['2'][1]:.2f} times as fast as one (wall time); a loop that "
        f"only computes, at the same moment: {spin_scaling():.2f}. Only a figure near 2 for the loop "
        "says that two cores were free.",
    ]
    wall, seconds = Wall(height, width, width / 16), 8.0
    EventCamera(PAPER).record(wall, 0.0, 0.05, threads=1)
    cpu = time.process_time()
    events = EventCamera(PAPER).record(wall, 0.0, seconds, threads=1)
    cpu = time.process_time() - cpu
    frames = int(seconds / STEP_S)
    lines += [
        f"Rendering and events of {seconds:g} s of a sliding wall, steps chosen by the camera: {cpu:.2f} s CPU "
        f"for {len(events):,} events: {1e9 * cpu / (height * width * frames):.3f} ns a pixel and millisecond.",
        "Memory above the input, 500 steps, the events included: {:.0f} MB for {:,} events.".format(
            *memory_above_input_mb(height, width, 500)
        ),
    ]
    text = "\n".join(lines) + "\n"
    print(text)
    if args.write:
        Path(args.write).write_text(text)


if __name__ == "__main__":
    main()
