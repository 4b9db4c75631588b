"""What does one object of the paper's dataset cost: render, events, frames and maps, at full resolution?

    python benchmarks/paper_object.py --write benchmarks/results/paper_object.md

One sequence of `--preset paper`: 960 x 600 pixels, 8 s, 40 positions; CPU seconds of one thread, the least of
`--repeat` rounds in which all ways take turns, compilation left out. The ways differ in the event camera alone:
steps that it chooses itself, and fixed steps of 1 ms, frame by frame (`mode="v2e"`) or in continuous time, with
the wall rendered strip by strip for the pixels at work or, as a reference, in whole images. What frames and
maps cost depends on the memory that the events left: differences there are no one's.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import time
from dataclasses import replace
from pathlib import Path

import torch
from numpy.typing import ArrayLike

from evnlos.cameras import EventCamera
from evnlos.data import Simulation, make_samples
from evnlos.data.sampling import edges_from
from evnlos.data.simulations import paper
from evnlos.machine import one_thread
from evnlos.scene import Scene
from evnlos.types import Irradiance
from machine import machine

PARTS = ("events", "frames", "maps")


class WholeImages:
    """A wall that can be rendered in whole images only."""

    def __init__(self, wall: Irradiance) -> None:
        self._wall, self.shape, self.speed_px_s = wall, wall.shape, wall.speed_px_s

    def irradiance(self, t_s: ArrayLike) -> torch.Tensor:
        return self._wall.irradiance(t_s)


def one_object(config: Simulation, camera: EventCamera, whole: bool = False) -> tuple[list[float], int]:
    """Make one object's samples; return CPU seconds of each part, and the number of events."""
    began = time.process_time()
    names = config.glyphs.objects()
    target = config.glyphs.target(names[len(names) // 2], 1)
    scene = Scene(target, config.motion, config.duration_s)
    wall = config.setup.observe(scene)
    events = camera.record(WholeImages(wall) if whole else wall, 0.0, config.duration_s, seed=2, threads=1)
    seen = time.process_time()
    times_s = scene.position_times_s(config.positions)
    frames = config.frame_camera.capture(wall, times_s, seed=3)
    captured = time.process_time()
    edges_us, peak = edges_from(times_s), 2**config.frame_camera.bit_depth - 1
    make_samples(frames, peak, events, edges_us, config.sampling, motion=scene.motion, target=target)
    return [seen - began, captured - seen, time.process_time() - captured], len(events)


def page(config: Simulation, repeat: int) -> str:
    """Measure, and return the tables as Markdown."""
    adaptive, exact = EventCamera(config.pixel), EventCamera(config.pixel, time_step_s=1e-3)
    stepped = replace(exact, mode="v2e")
    ways = {
        "steps chosen by the camera": (adaptive, False),
        "1 ms, frame by frame (v2e)": (stepped, False),
        "1 ms, frame by frame (v2e), whole images": (stepped, True),
        "1 ms, continuous time": (exact, False),
    }
    for camera, whole in ways.values():
        one_object(config, camera, whole)
    best: dict[str, tuple[list[float], int]] = {}
    for _ in range(repeat):
        for way, (camera, whole) in ways.items():
            found = one_object(config, camera, whole)
            best[way] = min(best.get(way, found), found, key=lambda result: sum(result[0]))
    least, count = sum(next(iter(best.values()))[0]), len(config.glyphs.objects())
    lines = ["# One object of the paper's dataset", "", *(__doc__ or "").split("\n\n")[2:], machine(), ""]
    lines += [
        "| event camera | " + " | ".join(f"{part}, CPU s" for part in PARTS) + " | all | times | events |"
    ]
    lines += ["|---" * (len(PARTS) + 4) + "|"]
    for way, (spent, events) in best.items():
        cells = " | ".join(f"{seconds:.2f}" for seconds in spent)
        lines.append(f"| {way} | {cells} | {sum(spent):.2f} | {sum(spent) / least:.1f} | {events:,} |")
    lines += [
        "",
        f"All {count} objects of the preset with steps chosen by the camera: "
        f"{count * least / 60:.0f} minutes of CPU.",
    ]
    profile = cProfile.Profile(time.process_time)
    profile.runcall(one_object, config, adaptive)
    rows = [(key[2], row[0], row[2]) for key, row in pstats.Stats(profile).stats.items()]  # type: ignore[attr-defined]
    total = sum(own for _, _, own in rows)
    lines += ["", "Steps chosen by the camera, by a profile of one run:", ""]
    lines += ["| function | calls | CPU s | share |", "|---|---|---|---|"]
    for name, calls, own in sorted(rows, key=lambda row: -row[2])[:12]:
        lines.append(f"| `{name.strip('<>{}')}` | {calls} | {own:.2f} | {own / total:.0%} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=3, help="rounds (default: 3)")
    parser.add_argument("--write", type=Path, help="file for the tables")
    options = parser.parse_args()
    one_thread()
    text = page(paper(), options.repeat)
    print(text)
    if options.write:
        options.write.write_text(text)
