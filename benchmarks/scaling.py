"""Does a simulation's cost grow in proportion to its size: objects, pixels, duration, events, processes?

    python benchmarks/scaling.py
    python benchmarks/scaling.py --write benchmarks/results/scaling.md --figure docs/figures/scaling.png

Handwriting on a 100 x 160 sensor for 2 s, 10 positions; one of these is changed at a time. CPU seconds of one
process with one thread, the least of `--repeat` runs, compilation left out; a straight line, fixed cost and
cost a unit, is laid through them. For processes it is the wall time of the last two thirds of the shards,
which means something on idle cores only. The last table is the CPU time of an object of two presets, times a
million, spread over a hundred nodes.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from evnlos.cameras import EventPixel
from evnlos.data import SensorSize, Simulation, simulate, simulate_object
from evnlos.data.simulations import default, paper
from evnlos.machine import one_thread
from evnlos.plot.figures import new_figure
from evnlos.scene import HandwritingGlyphs
from evnlos.setups import PaperSetup
from machine import machine

OBJECTS, NODES = 1_000_000, 100
BASE = Simulation(
    glyphs=HandwritingGlyphs(characters="ABCEFHLT", writers=2),
    setup=PaperSetup(
        field_of_view_m=0.585,
        gain=2.0,
        pixel=EventPixel(leak_rate_hz=0.0, shot_noise_rate_hz=0.0, initial_phase="rest"),
    ),
    duration_s=2.0,
    positions=10,
    validation=0.0,
)


@dataclass(frozen=True)
class Sweep:
    """Costs for several sizes of one thing."""

    what: str
    unit: str
    sizes: list[float]
    seconds: list[float]

    def line(self) -> tuple[float, float, float]:
        """Return seconds that are always spent, seconds per unit, and the line's largest relative miss."""
        size, seconds = np.array(self.sizes), np.array(self.seconds)
        each, fixed = np.polyfit(size, seconds, 1, w=1 / seconds)
        return float(fixed), float(each), float(np.max(np.abs((fixed + each * size) / seconds - 1)))


def cpu_seconds(work: Callable[[], object], repeat: int) -> float:
    """Return the least CPU time of some runs."""
    spent = []
    for _ in range(repeat):
        began = time.process_time()
        work()
        spent.append(time.process_time() - began)
    return min(spent)


def one_object(config: Simulation, repeat: int) -> float:
    name = config.glyphs.objects()[0]
    return cpu_seconds(lambda: simulate_object(config, name), repeat)


def dataset_seconds(count: int) -> float:
    """Return the CPU time of a dataset of `count` objects on disk, made by this process."""
    config = replace(BASE, glyphs=HandwritingGlyphs(characters="A", writers=count))
    with tempfile.TemporaryDirectory() as folder:
        return cpu_seconds(lambda: simulate(config, Path(folder) / "d"), 1)


def objects_a_second(workers: int, count: int = 600) -> float:
    """Return how many objects that many processes finish in a second, once a third of them is done."""
    config = replace(BASE, glyphs=HandwritingGlyphs(characters="A", writers=count))
    with tempfile.TemporaryDirectory() as folder:
        moments = []
        simulate(config, Path(folder) / "d", workers, progress=lambda _: moments.append(time.perf_counter()))
    return (count - count // 3) / (moments[-1] - moments[count // 3])


def sweeps(repeat: int) -> list[Sweep]:
    """Measure what one process does."""
    found = []
    counts = [2, 4, 8, 16]
    seconds = [dataset_seconds(count) for count in counts]
    found.append(Sweep("objects", "objects", [float(count) for count in counts], seconds))
    sides = [(50, 80), (100, 160), (200, 320), (400, 640)]
    seconds = [
        one_object(replace(BASE, setup=replace(BASE.setup, sensor=SensorSize(*side))), repeat) for side in sides
    ]
    found.append(Sweep("resolution", "pixels", [float(math.prod(side)) for side in sides], seconds))
    spans = [1.0, 2.0, 4.0, 8.0]
    seconds = [one_object(replace(BASE, duration_s=span), repeat) for span in spans]
    found.append(Sweep("duration", "s", spans, seconds))
    events, seconds = [], []
    for threshold in (0.4, 0.2, 0.1, 0.05):
        pixel = replace(BASE.pixel, threshold_on=threshold, threshold_off=threshold)
        config = replace(BASE, setup=replace(BASE.setup, sensor=SensorSize(200, 320), pixel=pixel))
        events.append(float(len(simulate_object(config, config.glyphs.objects()[0])[1])))
        seconds.append(one_object(config, repeat))
    found.append(Sweep("event rate", "events", events, seconds))
    return found


def page(found: list[Sweep], rates: dict[int, float], cores: int) -> str:
    """Return the tables as Markdown."""
    lines = ["# How the cost of a simulation grows", "", f"`python {' '.join(sys.argv)}`", ""]
    lines += [f"{machine()}; one thread a process"]
    lines += [f"Load average of the machine at the end: {os.getloadavg()[0]:.1f}.", ""]
    lines += [
        "| what grows | sizes | CPU s | line through them | largest miss of the line |",
        "|---|---|---|---|---|",
    ]
    for sweep in found:
        sizes = ", ".join(f"{size:,.0f}" for size in sweep.sizes)
        seconds = ", ".join(f"{value:.2f}" for value in sweep.seconds)
        fixed, each, miss = sweep.line()
        line = f"{fixed:.2f} s + {each * 1e6:,.4g} us per unit"
        lines.append(f"| {sweep.what} ({sweep.unit}) | {sizes} | {seconds} | {line} | {100 * miss:.0f} % |")
    lines += ["", "| processes | objects per second | times one |", "|---|---|---|"]
    lines += [f"| {count} | {rate:.2f} | {rate / rates[1]:.2f} |" for count, rate in rates.items()]
    lines += [
        "",
        f"## A million objects on {NODES} nodes",
        "",
        f"Nodes of {cores} cores of this speed, all busy.",
    ]
    lines += ["", "| preset | CPU s per object | CPU hours | wall time |", "|---|---|---|---|"]
    for name, config in (("default", default()), ("paper", paper())):
        cost = one_object(config, 2)
        hours = OBJECTS * cost / 3600
        lines.append(f"| {name} | {cost:.2f} | {hours:,.0f} | {hours / NODES / cores:.2f} h |")
    return "\n".join(lines) + "\n"


def draw(found: list[Sweep], path: Path) -> None:
    """Draw CPU time over size and the line through it."""
    figure = new_figure((3.0 * len(found), 2.8))
    for axes, sweep in zip(figure.subplots(1, len(found), squeeze=False)[0], found, strict=True):
        fixed, each, miss = sweep.line()
        ends = np.array([0.0, sweep.sizes[-1]])
        axes.plot(ends, fixed + each * ends, color="0.7", label=f"line, misses by {100 * miss:.0f} %")
        axes.plot(sweep.sizes, sweep.seconds, "o")
        axes.set_xlabel(sweep.unit)
        axes.set_ylim(0)
        axes.set_title(sweep.what, fontsize=10)
        axes.legend(fontsize=8)
    figure.axes[0].set_ylabel("CPU seconds")
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=7, help="runs of each size")
    parser.add_argument("--node-cores", type=int, default=64, help="cores of a node in the estimate")
    parser.add_argument("--write", type=Path, help="file for the tables")
    parser.add_argument("--figure", type=Path, help="image of the sweeps")
    arguments = parser.parse_args()
    one_thread()
    simulate_object(BASE, BASE.glyphs.objects()[0])  # compiles
    measured = sweeps(arguments.repeat)
    most = os.cpu_count() or 1
    rates = {count: objects_a_second(count) for count in (1, 2, 4, 8, 16, 32, 64) if count <= most}
    text = page(measured, rates, arguments.node_cores)
    print(text)
    if arguments.write:
        arguments.write.write_text(text)
    if arguments.figure:
        draw(measured, arguments.figure)
