"""What does a training cost that simulates its samples itself, stage by stage, beside one that reads shards?

    python benchmarks/live_training.py                  # on the GPU where there is one, else on the CPU
    python benchmarks/live_training.py --device cpu --objects 36 --results benchmarks/results

The default simulation: 160 x 100 pixels, 8 s, 40 positions; the default network, one epoch. The stages are
those of a GPU (`simulate_objects_on`, steps of 2 ms), also where the device is the CPU; a training on the CPU
uses `simulate_object` instead. Wall time; the first object of each kind is left out.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from evnlos.dataset import Simulation, live_dataset, on_device, open_dataset, simulate, simulate_object
from evnlos.scene import HandwritingGlyphs
from evnlos.training import Training, train
from machine import machine

STEP_S = 0.002
STAGES = {
    "record_tensors": "render, event pixels",
    "capture_tensors": "frames",
    "time_surface_tensors": "surfaces",
    "_reduced": "maps",
}


def clock(device: torch.device) -> float:
    """Return the time once the device has done what it was asked."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def watched(function: Callable, device: torch.device, spent: dict[str, float], stage: str) -> Callable:
    """Return the function with its time added to a stage."""

    def timed(*args: Any, **kwargs: Any) -> Any:
        start = clock(device)
        result = function(*args, **kwargs)
        spent[stage] += clock(device) - start
        return result

    return timed


def stages(config: Simulation, names: list[str], device: torch.device, together: int) -> dict[str, float]:
    """Return seconds an object of each stage on a device, and of all; the first object is left out."""
    spent: dict[str, float] = defaultdict(float)
    on_device.simulate_objects_on(config, names[:1], device, STEP_S)
    before = {name: getattr(on_device, name) for name in STAGES}
    for name, stage in STAGES.items():
        setattr(on_device, name, watched(before[name], device, spent, stage))
    start = clock(device)
    for first in range(1, len(names), together):
        on_device.simulate_objects_on(config, names[first : first + together], device, STEP_S)
    total = clock(device) - start
    for name, function in before.items():
        setattr(on_device, name, function)
    spent["glyph, optics, truth"] = total - sum(spent.values())
    return {stage: seconds / (len(names) - 1) for stage, seconds in (*spent.items(), ("all", total))}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--objects", type=int, default=36, help="objects simulated (default: 36)")
    parser.add_argument("--together", type=int, default=16, help="objects simulated at a time (default: 16)")
    parser.add_argument("--results", type=Path, help="folder to write live_training.md to")
    options = parser.parse_args()
    device = torch.device(options.device)
    glyphs = HandwritingGlyphs(writers=max(1, -(-options.objects // 36)))
    config = Simulation(glyphs=glyphs, validation=0.0)
    names = glyphs.objects()[: options.objects]
    spent = stages(config, names, device, options.together)
    lines = [
        f"{machine('torch')}; device {device}; {options.together} objects at a time",
        "",
        "| stage | ms an object | share |",
        "|---|---|---|",
    ]
    lines += [f"| {stage} | {1e3 * s:.1f} | {100 * s / spent['all']:.0f} % |" for stage, s in spent.items()]
    simulate_object(config, names[0])
    start = time.perf_counter()
    for name in names[1:5]:
        simulate_object(config, name)
    lines.append(f"| `simulate_object`, one process | {1e3 * (time.perf_counter() - start) / 4:.1f} | |")
    lines += ["", "| training, one epoch | samples/s |", "|---|---|"]
    settings = Training(epochs=1)
    with tempfile.TemporaryDirectory() as folder:
        list(simulate(config, Path(folder, "set"), workers=0))
        for kind, data in (("shards", open_dataset(Path(folder, "set"))), ("simulated", live_dataset(config))):
            record = list(train(data, settings, Path(folder, kind)))[-1]
            samples = len(glyphs.objects()) * config.positions
            lines.append(f"| {kind} | {samples / record['seconds']:.0f} |")
    print("\n".join(lines))
    if options.results is not None:
        (options.results / "live_training.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
