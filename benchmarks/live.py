"""How long from an event to its image, live, at 160 x 100 and a million events per second; where does it go?

    python benchmarks/live.py                              # replay and UDP, event and fusion, two threads
    python benchmarks/live.py --threads 1 --sources replay --seconds 20
    python benchmarks/live.py --modalities event --weights RUN
    python benchmarks/live.py --write benchmarks/results/live.md
    python benchmarks/live.py --sources udp --modalities event --rate 3e6 --seconds 600  # each event counted?

Random events, the worst case for the surface, in true time: from memory, an event being due at its own
instant, or from another process by UDP in packets of 180 events. Latency is wall time to the image as an
array, from the instant of the first event that is new in it (the one that waited longest) and from that of the
last one; the parts are those of the first. Compilation and the first runs of the network are left out.

Other work on the machine is most of what is measured, unless it is kept away: as root,
`setsid -w nice -n -20 bash -c 'echo -20 > /proc/self/autogroup; exec python benchmarks/live.py'` (Linux).
"""

from __future__ import annotations

import argparse
import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from evnlos.data import STANDARD_MODALITIES, Sampling
from evnlos.live.engine import Engine
from evnlos.live.packet import USUAL_EVENTS, EventSource, Packet, pack
from evnlos.live.run import RateOptions, Run
from evnlos.live.sources import Replay, TimedFrame
from evnlos.live.udp import UdpSource
from evnlos.models import UNetConfig, Weights, load_weights
from evnlos.types import Events
from machine import machine

WIDTH, HEIGHT = 160, 100
PIECE_US = 20_000
FRAME_US = 200_000
_NUMBER_AT, _BASE_AT = 8, 16  # of a packet, see docs/live.md
COLUMNS = (
    "source", "modality", "images/s", "M events/s", "oldest p50, ms", "p90", "p99", "max", "newest p50, ms",
    "p99", "surface p50, ms", "network p50, ms", "surface / network / rest, %", "events dropped / lost",
    "cores used",
)  # fmt: skip


def pieces(rate_hz: float, seconds: float, seed: int = 0) -> Iterator[Events]:
    """Yield random events as pieces of 20 ms: one second of them again and again."""
    draw = np.random.default_rng(seed)
    count = round(rate_hz * PIECE_US / 1e6)
    second = []
    for _ in range(1_000_000 // PIECE_US):
        places = (draw.integers(0, side, count).astype(np.uint16) for side in (WIDTH, HEIGHT))
        t_us = np.sort(draw.integers(0, PIECE_US, count))
        second.append(Events(t_us, *places, draw.random(count) < 0.5, WIDTH, HEIGHT))
    for number in range(round(seconds * 1e6 / PIECE_US)):
        part = second[number % len(second)]
        yield Events(part.t_us + number * PIECE_US, part.x, part.y, part.p, WIDTH, HEIGHT)


def replay(rate_hz: float, seconds: float, with_frames: bool) -> Replay:
    """Return a source in this process; a thread makes the chunks."""
    draw = np.random.default_rng(1)
    times = range(0, round(seconds * 1e6), FRAME_US) if with_frames else ()
    frames = [TimedFrame(t, draw.random((HEIGHT, WIDTH), np.float32)) for t in times]
    return Replay(list(pieces(rate_hz, seconds)), frames)


def send(port: int, rate_hz: float, seconds: float) -> int:
    """Send the events by UDP in true time and return their number; what the other process does.

    One second is packed beforehand and sent again and again under new numbers and times: the sender stands for
    a camera, not for work on this machine. Each packet is full, so that lost packets tell how many events were
    lost.
    """
    second: list[tuple[int, bytearray]] = []
    for part in pieces(rate_hz, 1.0):
        for start in range(0, len(part) - USUAL_EVENTS + 1, USUAL_EVENTS):
            full = part[start : start + USUAL_EVENTS]
            second.append((int(full.t_us[-1]), bytearray(pack(Packet(0, full)))))
    bases = [struct.unpack_from("<q", data, _BASE_AT)[0] for _, data in second]
    number, passes = 0, max(1, round(seconds))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        start_s = time.perf_counter()
        for turn in range(passes):
            for (until_us, data), base_us in zip(second, bases, strict=True):
                struct.pack_into("<I", data, _NUMBER_AT, number)
                struct.pack_into("<q", data, _BASE_AT, base_us + turn * 1_000_000)
                ahead_s = start_s + turn + until_us / 1e6 - time.perf_counter()
                if ahead_s > 0.002:
                    time.sleep(ahead_s)
                sender.sendto(data, ("127.0.0.1", port))
                number += 1
        last = pack(Packet(number, Events.empty(WIDTH, HEIGHT), is_last=True))
        for _ in range(3):  # the receiver's buffer may be full
            time.sleep(0.3)
            sender.sendto(last, ("127.0.0.1", port))
    return number * USUAL_EVENTS


def network_of(modality: str, path: str | None) -> Weights:
    """Return the weights given, else an untrained network of the default size."""
    if path:
        return load_weights(path)
    torch.manual_seed(0)
    return Weights(UNetConfig().build(modality, Sampling()).eval())


def row(name: str, weights: Weights, arguments: argparse.Namespace) -> str:
    """Run once and return a line of the table."""
    rate_hz, seconds, other = arguments.rate_hz, arguments.seconds, None
    engine = Engine(weights)
    if name == "udp":
        source: EventSource = UdpSource(idle_s=30)
        engine.begin()
        call = [sys.executable, __file__, "--send", str(source.port), "--rate-hz", str(rate_hz)]
        other = subprocess.Popen([*call, "--seconds", str(seconds)], stdout=subprocess.PIPE, text=True)
    else:
        source = replay(rate_hz, seconds, weights.modality.needs_frames)
        engine.begin()
    run = Run(source, engine, RateOptions(rate=arguments.images_hz))
    before = time.process_time()
    done = run.go().summary()
    cpu = (time.process_time() - before) / max(done["seconds"], 1e-9)
    lost = (
        done["dropped"]["events"],
        USUAL_EVENTS * sum(done["faults"].get(f"{how} packets", 0) for how in ("lost", "late", "malformed")),
    )
    if other is not None:
        sent = int(other.communicate()[0])
        short = sent - done["events"] - sum(lost)
        print(
            f"sent {sent:,} = pictured {done['events']:,} + dropped {lost[0]:,} + lost {lost[1]:,}; "
            f"difference {short}",
            flush=True,
        )
        if short:
            raise SystemExit("events are missing that nothing counts")
    spread = done["latency_ms"]
    oldest, newest = spread["oldest_event"], spread["newest_event"]
    if oldest is None:
        return f"| {name} | {weights.modality.name} | no image with an event |"
    parts = [spread[part]["mean"] for part in ("surface", "network", "wait")]
    shares = " / ".join(f"{100 * part / sum(parts):.0f}" for part in parts)
    cells = [name, weights.modality.name, f"{done['images_hz']:.0f}", f"{done['events_hz'] / 1e6:.2f}"]
    cells += [f"{oldest[q]:.1f}" for q in ("p50", "p90", "p99", "max")]
    cells += [f"{newest[q]:.1f}" for q in ("p50", "p99")]
    cells += [f"{spread['surface']['p50']:.1f}", f"{spread['network']['p50']:.1f}", shares]
    return "| " + " | ".join([*cells, f"{lost[0]:,} / {lost[1]:,}", f"{cpu:.2f}"]) + " |"


def nice() -> str:
    """Return the process's priority, with that of its group where the system schedules groups."""
    group = Path("/proc/self/autogroup")
    words = group.read_text().split()[-1:] if group.is_file() else []
    return " and of its group ".join([str(os.nice(0)) if hasattr(os, "nice") else "usual", *words])


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sources", nargs="+", choices=("replay", "udp"), default=["replay", "udp"])
    parser.add_argument("--modalities", nargs="+", choices=STANDARD_MODALITIES, default=["event", "fusion"])
    parser.add_argument("--rate-hz", "--rate", type=float, default=1e6, help="events per second")
    parser.add_argument("--pictures-hz", type=float, default=RateOptions.rate, help="most images per second")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--threads", type=int, default=2, help="threads of the network")
    parser.add_argument("--weights", help="weights or run, of the modality asked for")
    parser.add_argument("--write", help="file for the table")
    parser.add_argument("--send", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.send is not None:
        print(send(arguments.send, arguments.rate_hz, arguments.seconds))
        return
    torch.set_num_threads(arguments.threads)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    lines = [
        "# Live latency",
        "",
        f"{WIDTH} x {HEIGHT} pixels, {arguments.rate_hz:,.0f} events per second for {arguments.seconds:.0f} s; "
        f"at most {arguments.images_hz:.0f} images per second of {Sampling.width} x {Sampling.height}; "
        f"{arguments.threads} threads; niceness {nice()}, load before: {load:.1f}.",
        "",
        machine(),
        "",
        f"| {' | '.join(COLUMNS)} |",
        f"|{'---|' * len(COLUMNS)}",
    ]
    print("\n".join(lines), flush=True)
    for name in arguments.sources:
        for modality in arguments.modalities:
            if name == "udp" and modality != "event":
                continue  # packets carry no frames
            lines.append(row(name, network_of(modality, arguments.weights), arguments))
            print(lines[-1], flush=True)
    if arguments.write:
        Path(arguments.write).write_text("\n".join(lines) + "\n")
    return


if __name__ == "__main__":
    main()
