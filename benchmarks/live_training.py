"""What does a training cost that simulates its samples itself, beside one that reads shards?

    python benchmarks/live_training.py --results benchmarks/results   # trains on a GPU where there is one

The default simulation: 160 x 100 pixels, 8 s, 40 positions; the default network. Samples that an epoch sees in
a second, after an epoch to warm up: from shards, and from so many processes that simulate.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import torch

from evnlos.data import Simulation, live_dataset, open_dataset, simulate
from evnlos.machine import cores
from evnlos.scene import HandwritingGlyphs
from evnlos.training import Training, train
from machine import machine


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--writers", type=int, default=2, help="writers, 36 objects each (default: 2)")
    parser.add_argument("--results", type=Path, help="folder to write live_training.md to")
    options = parser.parse_args()
    if options.writers < 1:
        parser.error("--writers is at least 1")
    config = Simulation(glyphs=HandwritingGlyphs(writers=options.writers), validation=0.0)
    samples = len(config.glyphs.objects()) * config.positions
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    lines = list[str]()

    def tell(*more: str) -> None:
        print(*more, sep="\n", flush=True)
        lines.extend(more)

    tell("# Training on samples simulated meanwhile", "", *(__doc__ or "").split("\n\n")[2:])
    tell(f"{machine('torch')}; {device}", "", "| samples | per second |", "|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        simulate(config, Path(folder, "set"), workers=0)
        sources = {"from shards": open_dataset(Path(folder, "set"))}
        for workers in sorted({1, cores()}):
            sources[f"simulated, processes: {workers}"] = live_dataset(config, workers)
        for number, (name, data) in enumerate(sources.items()):
            records = train(data, Training(epochs=2), Path(folder, f"{number}")).records
            tell(f"| {name} | {samples / records[-1]['seconds']:.0f} |")
    if options.results is not None:
        (options.results / "live_training.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
