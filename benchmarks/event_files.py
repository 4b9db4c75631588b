"""How fast do event files become arrays, next to the public readers of each format, on one thread?

Writes the files that it reads, interleaves the readers, and prints millions of events per second of processor
time (medians of the rounds) and how many times as fast as the fastest other reader evnlos is: the median of the
ratios within a round, and the ratio of the best rounds. Rivals are optional: those that cannot be imported (pip
install evutils faery expelliarmus evlib rosbags mcap evt3 aedat dv) are left out, as are those that fail.

    python benchmarks/event_files.py
    python benchmarks/event_files.py --events 3000000 --rounds 5 --only CeleX
    python benchmarks/event_files.py --write benchmarks/results/event_files.md
"""

from __future__ import annotations

import argparse
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


def write_legacy(path: Path, source: Path) -> None:
    """Write an EVT2.1 file with the halves of its words exchanged, the order that evutils reads."""
    data = source.read_bytes()
    at = data.index(b"% end\n") + 6
    halves = np.frombuffer(data[at:], "<u4").reshape(-1, 2)[:, ::-1]
    path.write_bytes(data[:at].replace(b"endianness=little", b"endianness=legacy") + halves.tobytes())


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
            if name == "EVT21":
                write_legacy(folder / f"{stream}_legacy.raw", path)
                yield f"EVT21 {stream}, legacy order", folder / f"{stream}_legacy.raw", len(events)
        if stream == "uniform":
            write_dat(folder / "uniform_DAT.dat", events)
            yield "DAT uniform", folder / "uniform_DAT.dat", len(events)


def tables(folder: Path, count: int) -> Iterator[tuple[str, Path, int, dict[str, Callable[[Path], object]]]]:
    """Yield title, file, number of events and readers of each line of the table."""
    import recordings

    rivals = rival_readers()
    for title, path, many in files(folder, count):
        yield title, path, many, rivals
    for title, path, many, names in recordings.files(folder, count):
        yield title, path, many, recordings.readers(names, many)
    celex = celex_events(count)
    write_events(folder / "rows_EI_100M.bin", celex)
    # no rival reads it: beside our own EVT2 in the same rounds
    evt2 = {"evnlos, EVT2": lambda _: read_events(folder / "rows_EVT2.raw")}
    yield "CeleX 1 rows", folder / "rows_EI_100M.bin", len(celex), evt2


def line_of(title: str, path: Path, count: int, times: dict[str, list[float]]) -> str:
    """Return a line of the table: the fastest other reader, and the rest."""
    speeds = {name: count / statistics.median(taken) / 1e6 for name, taken in times.items()}
    others = sorted((name for name in speeds if name != "evnlos"), key=lambda name: -speeds[name])
    ours, cells = times["evnlos"], [title, f"{path.stat().st_size / count:.2f}", f"{speeds['evnlos']:.0f}"]
    if others:
        first = times[others[0]]
        cells += [f"{others[0]} {speeds[others[0]]:.0f}", f"{ratio(ours, first):.2f}"]
        cells += [
            f"{min(first) / min(ours):.2f}",
            ", ".join(f"{name} {speeds[name]:.0f}" for name in others[1:]),
        ]
    else:
        cells += ["none reads it", "-", "-", ""]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=int, default=10_000_000)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--only", default="", help="lines whose title holds this")
    parser.add_argument("--write", help="file for the table")
    arguments = parser.parse_args()
    lines = [
        "# Event files",
        "",
        f"{arguments.events:,} events (ECF: 524,288), one thread, processor time, medians of "
        f"{arguments.rounds} interleaved rounds; millions of events per second.",
        "",
        machine(
            *["numpy", "evutils", "faery", "expelliarmus", "evlib", "rosbags", "mcap", "evt3", "aedat", "dv"]
        ),
        "",
        "| file | bytes per event | evnlos | fastest other | times as fast | best rounds | other readers |",
        "|---|---|---|---|---|---|---|",
    ]
    print("\n".join(lines))
    with tempfile.TemporaryDirectory() as folder:
        for title, path, count, rivals in tables(Path(folder), arguments.events):
            if arguments.only.lower() not in title.lower():
                continue
            times = measure(path, {"evnlos": read_events} | rivals, arguments.rounds, count)
            lines.append(line_of(title, path, count, times))
            print(lines[-1], flush=True)
    if arguments.write:
        Path(arguments.write).write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
