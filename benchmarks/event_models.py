"""What does each event model cost, beside today's continuous pixel and beside DVS-Voltmeter's published code?

    python benchmarks/event_models.py [--voltmeter PATH] [--results benchmarks/results]

A soft edge that moves over 128 x 96 pixels for 0.5 s, a frame every millisecond; one thread, processor time,
the models in turns, medians of the rounds, after a run to compile. PATH is a checkout of DVS-Voltmeter (MIT),
run unchanged with its DVS346 parameters; without it the Brownian pixel is measured alone. No public
implementation of `circuit` for the CPU was at hand; its figure stands alone.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from evnlos.cameras import BrownianPixel, CircuitPixel, EventPixel, ReadoutPixel, simulate_events
from machine import machine

HEIGHT, WIDTH, STEPS = 96, 128, 500
ROUNDS = 5


def video() -> tuple[np.ndarray, np.ndarray]:
    """Return frames in DN [T, H, W] and their times in seconds."""
    times = np.arange(STEPS + 1) * 1e-3
    x = np.arange(WIDTH)
    edge = 40.0 + 100.0 / (1.0 + np.exp((x - 200.0 * times[:, None]) / 2.0))
    return np.repeat(edge[:, None], HEIGHT, axis=1).astype(np.float32), times


def models() -> dict[str, Callable[[np.ndarray, np.ndarray], int]]:
    """Return what is measured, by name; each returns a number of events."""
    continuous = EventPixel()
    settings = {
        "continuous, v2e's logarithm": continuous,
        "continuous, true logarithm": replace(continuous, logarithm="true"),
        "brownian": BrownianPixel(),
        "circuit": CircuitPixel(),
        "circuit, one pole": CircuitPixel(poles=1),
        "readout (row) behind continuous": ReadoutPixel(continuous, "row", 5e-7, 2e-8),
    }

    def run(pixel):
        return lambda frames, times: len(simulate_events(frames, times, pixel, threads=1))

    return {name: run(pixel) for name, pixel in settings.items()}


def voltmeter(path: str) -> Callable[[np.ndarray, np.ndarray], int]:
    """Return DVS-Voltmeter's own code as a function of the frames."""
    sys.path.insert(0, path)
    from src.config import cfg  # type: ignore[import-not-found]
    from src.simulator import EventSim  # type: ignore[import-not-found]

    cfg.SENSOR.CAMERA_TYPE = "DVS346"
    cfg.SENSOR.K = [5.265, 20.0, 0.0001, 1e-7, 5e-9, 1e-5]

    def run(frames: np.ndarray, times: np.ndarray) -> int:
        torch.manual_seed(0)
        simulator = EventSim(cfg=cfg, output_folder="", video_name="")
        found = (
            simulator.generate_events(frame.astype(np.float64), int(t * 1e6))
            for frame, t in zip(frames, times, strict=True)
        )
        return sum(len(events) for events in found if events is not None)

    return run


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voltmeter", help="checkout of DVS-Voltmeter")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help=f"rounds (default: {ROUNDS})")
    parser.add_argument("--results", type=Path, help="folder to write event_models.md to")
    options = parser.parse_args()
    torch.set_num_threads(1)
    frames, times = video()
    measured = models()
    if options.voltmeter:
        measured["DVS-Voltmeter's code"] = voltmeter(options.voltmeter)
    counts = {name: run(frames[:3], times[:3]) for name, run in measured.items()}  # compiles
    spent: dict[str, list[float]] = {name: [] for name in measured}
    for _ in range(options.rounds):
        for name, run in measured.items():
            start = time.process_time()
            counts[name] = run(frames, times)
            spent[name].append(time.process_time() - start)
    unit = 1e9 / (HEIGHT * WIDTH * STEPS)
    base = statistics.median(spent["continuous, v2e's logarithm"])
    lines = ["# Cost of the event models", "", *(__doc__ or "").split("\n\n")[2:], f"{machine()}", ""]
    lines += [
        "| model | ns per pixel and step | times today's continuous pixel | events |",
        "|---|---|---|---|",
    ]
    for name, seconds in spent.items():
        middle = statistics.median(seconds)
        lines.append(f"| {name} | {unit * middle:.2f} | {middle / base:.2f} | {counts[name]:,} |")
    print("\n".join(lines))
    if options.results is not None:
        (options.results / "event_models.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
