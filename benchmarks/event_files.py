"""How fast do event files become arrays, next to other Python packages, on one thread?

Writes the files that it reads, interleaves the packages, prints millions of events a second (best of the
rounds) and the ratio to each rival. Rivals are optional: those that cannot be imported are left out.

    python benchmarks/event_files.py --events 10000000 --rounds 7 [--rivals FOLDER_OF_SITE_PACKAGES]
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

from evnlos.events import read_events, write_events  # noqa: E402
from evnlos.types import Events  # noqa: E402

WIDTH, HEIGHT = 1280, 720


def uniform(count: int, seed: int = 0) -> Events:
    """Every event anywhere: no two words alike, the worst case of a vectorised format."""
    draw = np.random.default_rng(seed)
    return Events(
        np.sort(draw.integers(0, count, count)),
        draw.integers(0, WIDTH, count),
        draw.integers(0, HEIGHT, count),
        draw.integers(0, 2, count).astype(bool),
        width=WIDTH,
        height=HEIGHT,
    )


def rows(count: int, seed: int = 0) -> Events:
    """Bursts along rows as a sensor's readout sends them: about 8 events of one time, row and sign."""
    draw = np.random.default_rng(seed)
    bursts = count // 8 + 1
    length = draw.integers(1, 16, bursts)
    index = np.repeat(np.arange(bursts), length)[:count]
    count = len(index)
    starts = np.searchsorted(index, np.arange(bursts))
    place = np.arange(count) - starts[index]
    x = draw.integers(0, WIDTH - 40, bursts)[index] + place * draw.integers(1, 3, bursts)[index]
    y, sign = draw.integers(0, HEIGHT, bursts)[index], draw.integers(0, 2, bursts)[index].astype(bool)
    return Events(index.astype(np.int64), x, y, sign, width=WIDTH, height=HEIGHT)


def write_dat(path: Path, events: Events) -> None:
    head = f"% Data file containing CD events\n% Version 2\n% Width {WIDTH}\n% Height {HEIGHT}\n".encode()
    words = np.empty((len(events), 2), "<u4")
    words[:, 0] = events.t_us
    words[:, 1] = events.x | events.y.astype(np.uint32) << 14 | events.p.astype(np.uint32) << 28
    path.write_bytes(head + bytes([12, 8]) + words.tobytes())


def celex_events(count: int, seed: int = 0) -> Events:
    draw = np.random.default_rng(seed)
    base = rows(count, seed)
    adc = draw.integers(0, 4096, len(base))
    return Events(base.t_us * 20, base.x, base.y, base.p, 1280, 800, adc=adc)


def rival_readers() -> dict[str, Callable[[Path], object]]:
    """Return the readers that can be imported; each returns arrays of the whole file."""
    found: dict[str, Callable[[Path], object]] = {}
    try:
        from evutils.io import EventReader

        found["evutils"] = lambda path: EventReader(path, max_events=10**9).read_all()
    except ImportError:
        pass
    try:
        import faery

        found["faery"] = lambda path: faery.events_stream_from_file(path).to_array()
    except ImportError:
        pass
    return found


def count_of(result: object) -> int:
    return len(result)  # type: ignore[arg-type]


def measure(
    path: Path, readers: dict[str, Callable[[Path], object]], rounds: int, count: int
) -> dict[str, float]:
    """Return the best time of each reader, in seconds; a reader that fails or miscounts is left out."""
    best: dict[str, float] = {}
    broken: set[str] = set()
    for _ in range(rounds + 1):  # the first round compiles and warms the page cache
        for name, read in readers.items():
            if name in broken:
                continue
            start = time.perf_counter()
            try:
                result = read(path)
            except Exception as error:
                print(f"    {name}: {type(error).__name__}: {str(error)[:80]}")
                broken.add(name)
                continue
            took = time.perf_counter() - start
            if count_of(result) != count:
                print(f"    {name}: {count_of(result)} events instead of {count}")
                broken.add(name)
            else:
                best[name] = min(best.get(name, took), took)
            del result
    return {name: best[name] for name in best if name not in broken}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--events", type=int, default=10_000_000)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--rivals", help="site-packages folder to look for rivals in")
    arguments = parser.parse_args()
    if arguments.rivals:
        sys.path.append(arguments.rivals)
    readers = {"evnlos": read_events} | rival_readers()
    machine = platform.processor() or platform.machine()
    print(f"{machine}, {os.cpu_count()} cores, Python {platform.python_version()}")
    print(f"{arguments.events:,} events, one thread, best of {arguments.rounds}, millions of events a second")
    streams = {"uniform": uniform(arguments.events), "rows": rows(arguments.events)}
    reference = 0.0
    with tempfile.TemporaryDirectory() as folder:
        cases: list[tuple[str, Path, int]] = []
        for stream, events in streams.items():
            for name in ("EVT2", "EVT21", "EVT3", "HDF5"):
                path = Path(folder) / f"{stream}_{name}{'.h5' if name == 'HDF5' else '.raw'}"
                write_events(path, events, format=name)
                cases.append((f"{name} {stream}", path, len(events)))
        write_dat(Path(folder) / "uniform.dat", streams["uniform"])
        cases.append(("DAT uniform", Path(folder) / "uniform.dat", len(streams["uniform"])))
        celex = celex_events(arguments.events)
        write_events(Path(folder) / "rows_EI_100M.bin", celex)
        cases.append(("CeleX 1 rows", Path(folder) / "rows_EI_100M.bin", len(celex)))
        print(
            f"| file | bytes an event | {' | '.join(readers)} | ratios |\n|---|---|{'---|' * len(readers)}---|"
        )
        for title, path, count in cases:
            chosen = {"evnlos": read_events} if title.startswith("CeleX") else readers
            best = measure(path, chosen, arguments.rounds, count)
            speeds = {name: count / took / 1e6 for name, took in best.items()}
            if title == "EVT2 rows":
                reference = speeds["evnlos"]
            cells = " | ".join(f"{speeds[name]:.0f}" if name in speeds else "-" for name in readers)
            ratios = [f"{speeds['evnlos'] / speeds[name]:.2f} x {name}" for name in speeds if name != "evnlos"]
            if title.startswith("CeleX"):
                ratios = [f"{speeds['evnlos'] / reference:.2f} x EVT2 rows of evnlos"]
            print(
                f"| {title} | {path.stat().st_size / count:.2f} | {cells} | {', '.join(ratios)} |", flush=True
            )


if __name__ == "__main__":
    main()
