"""What does a training cost that simulates its samples itself, stage by stage, beside one that reads shards?

    python benchmarks/live_training.py --results benchmarks/results   # on the GPU where there is one

The default simulation: 160 x 100 pixels, 8 s, 40 positions; the default network, one epoch. The stages are
those of a GPU (`simulate_objects_on`, v2e's pixels in steps of 2 ms), also where the device is the CPU; a
training on the CPU uses `simulate_object` instead, by default in one process. Wall time, after a group and an
epoch to warm up. "By processes" is a process of `simulate_object` for each core, which feed the training.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from evnlos.cameras import V2ePixel
from evnlos.data import Simulation, live_dataset, open_dataset, simulate, simulate_object
from evnlos.data import live as on_device
from evnlos.scene import HandwritingGlyphs
from evnlos.setups import PaperSetup
from evnlos.training import Training, train
from machine import machine

STEP_S = 0.002
STAGES = {
    (import_module("evnlos.cameras.on_device"), "record_tensors"): "render, event pixels",
    (on_device, "capture_tensors"): "frames",
    (on_device, "time_surface_tensors"): "surfaces",
    (on_device, "_reduced"): "maps",
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
    """Return seconds per object of each stage on a device, and of all; one group warms it up."""
    spent: dict[str, float] = defaultdict(float)
    groups = [names[first : first + together] for first in range(0, len(names) - together + 1, together)]
    on_device.simulate_objects_on(config, groups[0], device)
    before = {place: getattr(*place) for place in STAGES}
    for place, stage in STAGES.items():
        setattr(*place, watched(before[place], device, spent, stage))
    start = clock(device)
    for group in groups[1:]:
        on_device.simulate_objects_on(config, group, device)
    total = clock(device) - start
    for place, function in before.items():
        setattr(*place, function)
    spent["targets, optics, truth"] = total - sum(spent.values())
    count = together * (len(groups) - 1)
    return {stage: seconds / count for stage, seconds in (*spent.items(), ("all", total))}


def throughput(config: Simulation, together: int) -> Iterator[tuple[str, float]]:
    """Yield samples a second of an epoch that reads shards, and of one that simulates, each after one more."""
    samples = len(config.glyphs.objects()) * config.positions
    with tempfile.TemporaryDirectory() as folder:
        simulate(config, Path(folder, "set"), workers=0)
        live = replace(live_dataset(config), together=together)
        by_processes = live_dataset(config, workers=0, where="cpu")
        sources = {"shards": open_dataset(Path(folder, "set")), "simulated": live, "by processes": by_processes}
        for kind, data in sources.items():
            records = train(data, Training(epochs=2), Path(folder, kind)).records
            yield kind, samples / records[-1]["seconds"]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--groups", type=int, default=2, help="groups of objects measured (default: 2)")
    parser.add_argument("--together", type=int, default=16, help="objects simulated at a time (default: 16)")
    parser.add_argument("--results", type=Path, help="folder to write live_training.md to")
    options = parser.parse_args()
    if min(options.groups, options.together) < 1:
        parser.error("--groups and --together are at least 1")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    count = options.together * (options.groups + 1)
    writers = -(-count // len(HandwritingGlyphs(writers=1).objects()))
    glyphs = HandwritingGlyphs(writers=writers)
    config = Simulation(glyphs=glyphs, setup=PaperSetup(pixel=V2ePixel(), time_step_s=STEP_S), validation=0.0)
    names = config.glyphs.objects()[:count]
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else "no GPU"
    lines = list[str]()

    def tell(*more: str) -> None:
        print(*more, sep="\n", flush=True)
        lines.extend(more)

    tell("# Training on samples simulated meanwhile", "", *(__doc__ or "").split("\n\n")[2:])
    tell(f"{machine('torch')}; {where}; {options.together} objects at a time", "")
    tell("| stage | ms per object | share |", "|---|---|---|")
    spent = stages(config, names, device, options.together)
    tell(*(f"| {stage} | {1e3 * s:.1f} | {100 * s / spent['all']:.0f} % |" for stage, s in spent.items()))
    few = names[: 1 + min(8, count - 1)]
    simulate_object(config, few[0])
    start = time.perf_counter()
    for name in few[1:]:
        simulate_object(config, name)
    alone = (time.perf_counter() - start) / max(1, len(few) - 1)
    tell(f"| `simulate_object`, one process | {1e3 * alone:.1f} | |", "")
    tell("| training, second epoch | samples/s |", "|---|---|")
    for kind, speed in throughput(config, options.together):
        tell(f"| {kind} | {speed:.0f} |")
    if options.results is not None:
        (options.results / "live_training.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
