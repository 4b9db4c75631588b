"""How long does one reconstruction take, from events and frame to picture, beside the network alone?

    python benchmarks/reconstruct.py                 # default network, two threads
    python benchmarks/reconstruct.py --threads 1 --weights RUN

One position of a capture at 160 x 100: the time surface of the events since the position before, both maps
brought to 96 x 64, and the network, as a graph (`Reconstructor`) and layer by layer. Wall time, medians; the
first runs are left out.
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np
import torch

from event_pixel import machine
from evnlos.config import to_dict
from evnlos.dataset import CHANNELS, PARADIGMS, Sampling, network_input
from evnlos.dataset.sampling import make_samples
from evnlos.evaluation import Reconstructor
from evnlos.model import ResidualUNet, UNetConfig, Weights, infer, load_weights
from evnlos.types import Events


def events_of_a_position(count: int, seed: int) -> Events:
    """Return events of 0.2 s on a 160 x 100 sensor."""
    draw = np.random.default_rng(seed)
    columns = (draw.integers(0, n, count).astype(np.uint16) for n in (160, 100))
    return Events(np.sort(draw.integers(1, 200_000, count)), *columns, draw.random(count) < 0.5, 160, 100)


def main() -> None:
    """Time the parts and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--events", type=int, default=20_000, help="events of one position")
    parser.add_argument("--weights", help="weights or run; default: an untrained network of the default size")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    frame = np.random.default_rng(1).integers(0, 256, (1, 100, 160)).astype(np.uint8)
    edges = np.array([0, 200_000])
    print(machine())
    print(f"{args.events} events a position, {args.threads} threads")
    print("| paradigm | surface and maps, ms | network, ms | together, ms | network layer by layer, ms |")
    print("|---|---|---|---|---|")
    for paradigm in [load_weights(args.weights).paradigm] if args.weights else PARADIGMS:
        if args.weights:
            weights = load_weights(args.weights)
        else:
            network = ResidualUNet(CHANNELS[paradigm], UNetConfig()).eval()
            weights = Weights(network, paradigm, to_dict(Sampling()), [])
        see = Reconstructor(weights)
        parts: list[tuple[float, float, float]] = []
        for n in range(args.rounds + 5):
            events = events_of_a_position(args.events, n)
            began = time.perf_counter()
            samples = make_samples(frame, 255.0, events, edges, Sampling())
            mapped = time.perf_counter()
            see(samples.frame[0], samples.surface[0])
            seen = time.perf_counter()
            infer(weights.network, network_input(samples.frame, samples.surface, paradigm))
            parts.append((mapped - began, seen - mapped, time.perf_counter() - seen))
        maps, net, slow = (1e3 * statistics.median(part) for part in zip(*parts[5:], strict=True))
        print(f"| {paradigm} | {maps:.2f} | {net:.2f} | {maps + net:.2f} | {slow:.2f} |")


if __name__ == "__main__":
    main()
