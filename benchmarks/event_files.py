"""How fast do event files become arrays, next to other Python packages, on one thread?

Writes the files that it reads, interleaves the packages, prints millions of events per second of processor time
(median of the rounds) and the ratio to each rival (median of the ratios within a round). Rivals are optional:
those that cannot be imported (pip install evutils faery expelliarmus evlib) are left out.

    python benchmarks/event_files.py
    python benchmarks/event_files.py --events 3000000 --rounds 5 --only CeleX
    python benchmarks/event_files.py --write benchmarks/results/event_files.md
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

THREADS = "OMP_NUM_THREADS NUMBA_NUM_THREADS OPENBLAS_NUM_THREADS RAYON_NUM_THREADS POLARS_MAX_THREADS"
for name in THREADS.split():
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

from evnlos.events import read_events, write_events  # noqa: E402
from evnlos.types import Events  # noqa: E402
from machine import machine  # noqa: E402

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
    try:
        from expelliarmus import Wizard

        # it has to be told the format, which stands in the names of the files written here
        found["expelliarmus"] = lambda path: Wizard(encoding=path.stem.split("_")[-1].lower()).read(str(path))
    except ImportError:
        pass
    try:
        import evlib

        found["evlib"] = lambda path: evlib.load_events(str(path)).collect()
    except ImportError:
        pass
    return found


def count_of(result: object) -> int:
    return len(result)  # type: ignore[arg-type]


def measure(
    path: Path, readers: dict[str, Callable[[Path], object]], rounds: int, count: int
) -> dict[str, list[float]]:
    """Return the processor times of each reader, in seconds; a reader that fails or miscounts is left out."""
    times: dict[str, list[float]] = {name: [] for name in readers}
    for turn in range(rounds + 1):  # the first round compiles and warms the page cache
        for name in list(times):
            start = time.process_time()
            try:
                result = readers[name](path)
            except Exception as error:
                print(f"    {name}: {type(error).__name__}: {str(error)[:80]}")
                del times[name]
                continue
            took = time.process_time() - start
            if count_of(result) != count:
                print(f"    {name}: {count_of(result)} events instead of {count}")
                del times[name]
            elif turn:
                times[name].append(took)
            del result
    return times


def ratio(ours: list[float], theirs: list[float]) -> float:
    """Return how many times faster ours is: the median over the rounds."""
    return statistics.median(b / a for a, b in zip(ours, theirs, strict=True))


def files(folder: Path, count: int) -> Iterator[tuple[str, Path, int]]:
    """Write the files of the table one after the other."""
    for stream, make in (("uniform", uniform), ("rows", rows)):
        events = make(count)
        for name in ("EVT2", "EVT21", "EVT3", "HDF5"):
            path = folder / f"{stream}_{name}{'.h5' if name == 'HDF5' else '.raw'}"
            write_events(path, events, format=name)
            yield f"{name} {stream}", path, len(events)
        if stream == "uniform":
            write_dat(folder / "uniform_DAT.dat", events)
            yield "DAT uniform", folder / "uniform_DAT.dat", len(events)
    celex = celex_events(count)
    write_events(folder / "rows_EI_100M.bin", celex)
    yield "CeleX 1 rows", folder / "rows_EI_100M.bin", len(celex)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--events", type=int, default=10_000_000)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--only", default="", help="rows whose name holds this, and EVT2 rows for CeleX-V")
    parser.add_argument("--write", help="file for the table")
    arguments = parser.parse_args()
    readers = {"evnlos": read_events} | rival_readers()
    lines = [
        "# Event files",
        "",
        f"{arguments.events:,} events, one thread, processor time, medians of {arguments.rounds} interleaved "
        "rounds; millions of events per second.",
        "",
        machine("numpy", "evutils", "faery", "expelliarmus", "evlib"),
        "",
        f"| file | bytes per event | {' | '.join(readers)} | ratios |\n|---|---|{'---|' * len(readers)}---|",
    ]
    print("\n".join(lines))
    with tempfile.TemporaryDirectory() as folder:
        evt2 = Path(folder) / "rows_EVT2.raw"
        for title, path, count in files(Path(folder), arguments.events):
            if arguments.only.lower() not in title.lower():
                continue
            chosen = readers
            if title.startswith("CeleX"):  # no rival reads it: beside our own EVT2 in the same rounds
                chosen = {"evnlos": read_events, "evnlos EVT2": lambda _: read_events(evt2)}
            times = measure(path, chosen, arguments.rounds, count)
            speeds = {name: count / statistics.median(taken) / 1e6 for name, taken in times.items()}
            cells = " | ".join(f"{speeds[name]:.0f}" if name in speeds else "-" for name in readers)
            ratios = [
                f"{ratio(times['evnlos'], times[name]):.2f} x {name}" for name in times if name != "evnlos"
            ]
            lines.append(f"| {title} | {path.stat().st_size / count:.2f} | {cells} | {', '.join(ratios)} |")
            print(lines[-1], flush=True)
    if arguments.write:
        Path(arguments.write).write_text("\n".join(lines) + "\n")


def installed(name: str) -> bool:
    return importlib.util.find_spec(name) is not None


if __name__ == "__main__":
    main()
