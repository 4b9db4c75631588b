"""How long does one reconstruction take, from events and frame to image, beside the network alone?

    python benchmarks/reconstruct.py                 # default network, two threads
    python benchmarks/reconstruct.py --threads 1 --weights RUN
    python benchmarks/reconstruct.py --weights near-frame-sequence
    python benchmarks/reconstruct.py --weights near-frame-sequence --capture captures/near_A

One position of a capture at 160 x 100: the time surface of the events since the position before, both maps
brought to 96 x 64, and the network, as a graph (`StreamingReconstructor`) and layer by layer. Of weights that
see whole sequences: a sequence of 40 positions, all times divided by 40. Wall time, medians; first runs are
left out. With a capture, below it: all that `evnlos reconstruct` does with it, from the start of Python to the
last file, beside what its positions take of that.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from evnlos.analysis import reconstruct
from evnlos.data import STANDARD_MODALITIES, Sampling
from evnlos.data.sampling import make_samples
from evnlos.live import StreamingReconstructor
from evnlos.models import UNetConfig, Weights, load_weights
from evnlos.scene import LineMotion
from evnlos.types import Events
from machine import machine


def events_of_a_position(count: int, seed: int) -> Events:
    """Return events of 0.2 s on a 160 x 100 sensor."""
    draw = np.random.default_rng(seed)
    columns = (draw.integers(0, n, count).astype(np.uint16) for n in (160, 100))
    return Events(np.sort(draw.integers(1, 200_000, count)), *columns, draw.random(count) < 0.5, 160, 100)


def untrained(modality: str) -> Weights:
    """Return a network of the default size with random weights."""
    return Weights(UNetConfig().build(modality, Sampling()).eval())


def whole_sequences(weights: Weights, events_each: int, rounds: int) -> float:
    """Time sequences of 40 positions, print a row, a position's share, and return that in ms."""
    draw, positions = np.random.default_rng(1), 40
    frames = draw.integers(0, 256, (positions, 100, 160)).astype(np.uint8)
    each = [events_of_a_position(events_each, n) for n in range(positions)]
    stamps = np.concatenate([one.t_us + 200_000 * n for n, one in enumerate(each)])
    columns = (np.concatenate([getattr(one, name) for one in each]) for name in ("x", "y", "p"))
    events = Events(stamps, *columns, 160, 100)
    edges = np.arange(positions + 1) * 200_000
    motion, sampling = LineMotion(), weights.sampling
    parts: list[tuple[float, float]] = []
    for _ in range(max(3, rounds // 8) + 1):
        began = time.perf_counter()
        samples = make_samples(frames, 255.0, events, edges, sampling, motion=motion)
        mapped = time.perf_counter()
        reconstruct(weights, samples.frame, samples.surface, samples.position_m)
        parts.append((mapped - began, time.perf_counter() - mapped))
    maps, net = (1e3 * statistics.median(part) / positions for part in zip(*parts[1:], strict=True))
    print(f"| {weights.modality.name}, whole sequence | {maps:.2f} | {net:.2f} | {maps + net:.2f} | |")
    return maps + net


def whole_command(capture: Path, weights: str, a_position_ms: float) -> None:
    """Time `evnlos reconstruct` as a user runs it, and print where it goes."""
    took: list[float] = []
    for _ in range(3):  # the first may compile
        with tempfile.TemporaryDirectory() as folder:
            words = [str(capture), "--weights", weights, "--out", f"{folder}/out", "--json"]
            began = time.perf_counter()
            done = subprocess.run(
                [sys.executable, "-m", "evnlos", "reconstruct", *words],
                check=True,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
            took.append(time.perf_counter() - began)
    positions, whole = json.loads(done.stdout)["positions"], min(took[1:])
    inner = positions * a_position_ms / 1e3
    print(
        f"evnlos reconstruct {capture.name}: {whole:.1f} s, {inner:.2f} s of it surface, maps and network of "
        f"{positions} positions; the rest starts Python, reads the capture, renders the light of the setup, "
        "and draws and explains the result"
    )


def main() -> None:
    """Time the parts and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--events", type=int, default=20_000, help="events of one position")
    parser.add_argument("--weights", help="weights or run; default: an untrained network of the default size")
    parser.add_argument("--capture", type=Path, help="with weights of whole sequences: time the command, too")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    frame = np.random.default_rng(1).integers(0, 256, (1, 100, 160)).astype(np.uint8)
    edges = np.array([0, 200_000])
    print(machine())
    print(f"{args.events} events per position, {args.threads} threads")
    print("| modality | surface and maps, ms | network, ms | together, ms | network layer by layer, ms |")
    print("|---|---|---|---|---|")
    given = load_weights(args.weights) if args.weights else None
    if given is not None and given.network.sees_sequence:
        a_position_ms = whole_sequences(given, args.events, args.rounds)
        if args.capture is not None:
            whole_command(args.capture, args.weights, a_position_ms)
        return
    for weights in [given] if given is not None else map(untrained, STANDARD_MODALITIES):
        see = StreamingReconstructor(weights)
        parts: list[tuple[float, float, float]] = []
        for n in range(args.rounds + 5):
            events = events_of_a_position(args.events, n)
            began = time.perf_counter()
            samples = make_samples(frame, 255.0, events, edges, Sampling())
            mapped = time.perf_counter()
            see(samples.frame[0], samples.surface[0])
            seen = time.perf_counter()
            weights.network.infer(weights.modality.inputs(samples.frame, samples.surface))
            parts.append((mapped - began, seen - mapped, time.perf_counter() - seen))
        maps, net, slow = (1e3 * statistics.median(part) for part in zip(*parts[5:], strict=True))
        print(f"| {weights.modality.name} | {maps:.2f} | {net:.2f} | {maps + net:.2f} | {slow:.2f} |")


if __name__ == "__main__":
    main()
