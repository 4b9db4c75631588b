"""The times that the CeleX-V program prints into CSV files: they turn over, and some count ticks.

- CSV: rows of numbers under a line of names, and the layouts of other programs, of CeleX-V among them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.events.files.celex import CelexOptions, clock_from_name, tick_divisor
from evnlos.events.files.columns import SALVAGE, ColumnCheck, Columns, FileSink, ReadReport, join, unreadable
from evnlos.events.files.csv_rows import FAULTS, FIRST_FAULT, MAX_LINE, find_layout, parse_rows, print_rows
from evnlos.types import Events

_SDK_WRAP_TICKS = 1 << 22  # the camera's program prints times modulo this


class UnwrapTimes:
    """Undoes the turns of the times that the CeleX-V program prints, and converts ticks to microseconds."""

    def __init__(self, path: Path, report: ReadReport, options: CelexOptions) -> None:
        self._path, self._report, self._ticks = path, report, options.csv_in_ticks
        self._clock = options.clock_mhz or clock_from_name(path)
        self._turns, self._last = 0, 0

    def _divisor(self) -> int:
        if self._clock is None:
            found = "times that turn over or count ticks, and no clock"
            self._report.fault("header", 0, found, "give celex=CelexOptions(clock_mhz=...)")
            self._clock = 100
        return tick_divisor(self._clock)

    def __call__(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the times of the next rows, int64 [rows], in microseconds that go on ascending."""
        if not len(times):
            return times
        steps = np.diff(times, prepend=self._last)
        self._last = int(times[-1])
        shortest = _SDK_WRAP_TICKS if self._ticks else _SDK_WRAP_TICKS * 1024 // 140
        turned = steps < -shortest // 2  # a smaller step back is a fault, which the check of order reports
        turns = self._turns + np.cumsum(turned)
        self._turns = int(turns[-1])
        if not self._ticks and not self._turns:
            return times
        divisor = self._divisor()
        if self._ticks:
            return ((times + turns * _SDK_WRAP_TICKS) * 2048 + divisor) // (2 * divisor)
        return times + (turns * _SDK_WRAP_TICKS * 2048 + divisor) // (2 * divisor)


_BLOCK_BYTES = 1 << 20
_SALVAGE = f"repair the line or {SALVAGE}"
_LIMITS = {"x": (0, 65_535), "y": (0, 65_535), "adc": (0, 65_535), "p": (-1, 1), "polarity_known": (0, 1)}


class CsvSource:
    """An open text file of events."""

    def __init__(
        self,
        path: Path,
        report: ReadReport,
        width: int | None,
        height: int | None,
        options: CelexOptions | None,
    ) -> None:
        self.path, self.report = path, report
        self._options = options or CelexOptions()
        with path.open("rb") as file:
            layout = find_layout(file.read(1 << 16))
        if layout is None:
            raise unreadable(path, 0, "text that is no table of events", "columns t_us, x, y, p are read")
        self._layout = layout
        report.format = "CSV"
        if width is not None:
            report.set_geometry(width, height, "caller")
        elif layout.size is not None:
            report.set_geometry(*layout.size, "header")
        elif layout.is_celex:
            report.set_geometry(1280, 800, "format")
        else:
            largest = [0, 0]
            quiet = ReadReport(path, strict=False)
            for values, _ in self._rows(quiet):
                for index, name in enumerate(("x", "y")):
                    column = values[:, layout.names.index(name)]
                    if len(column):
                        largest[index] = max(largest[index], min(int(column.max()), 65_535))
            report.set_geometry(largest[0] + 1, largest[1] + 1, "events")

    def _rows(self, report: ReadReport) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Yield blocks of rows [rows, columns] and the byte offset of each row."""
        layout = self._layout
        columns = len(layout.names)
        seconds = layout.names.index("t_us") if layout.in_seconds else -1
        state = np.zeros(3, np.int64)
        offset, tail, count = layout.start, b"", 0
        with self.path.open("rb") as file:
            file.seek(offset)
            while True:
                data = file.read(_BLOCK_BYTES)
                last = len(data) < _BLOCK_BYTES
                text = tail + data
                if last and text and not text.endswith(b"\n"):
                    if layout.announced is not None:  # a file of ours ends its last line
                        found = "the last line has no end"
                        report.fault("truncated", offset + len(text), found, f"copy the file again: {_SALVAGE}")
                    text += b"\n"
                block = np.frombuffer(text, np.uint8)
                most = len(text) // (2 * columns) + 1  # a digit and a separator a column
                values, starts = np.empty((most, columns), np.int64), np.empty(most, np.int64)
                rows, used = parse_rows(block, columns, seconds, values, starts, state)
                if state[FAULTS]:
                    at = int(state[FIRST_FAULT])
                    found = f"the line {text[at : at + 40].splitlines()[0]!r}"
                    cure = f"{columns} numbers belong there: {_SALVAGE}"
                    report.fault("unknown", offset + at, found, cure, count=int(state[FAULTS]))
                    state[:] = 0
                if len(text) - used > MAX_LINE and not last:
                    found = f"a line of more than {MAX_LINE} bytes"
                    lost = self.path.stat().st_size - offset - used
                    report.fault("unknown", offset + used, found, "the file is no CSV", lost_bytes=lost)
                    return
                count += rows
                yield values[:rows], offset + starts[:rows]
                offset += used
                tail = text[used:]
                if last:
                    break
        if layout.announced is not None and layout.announced != count and report.clean:
            kind = "truncated" if count < layout.announced else "count"
            found = f"{count} events where the header announces {layout.announced}"
            report.fault(kind, self.path.stat().st_size, found, f"copy the file again: {_SALVAGE}")

    def blocks(self) -> Iterator[Columns]:
        """Yield the events of about a megabyte of text at a time."""
        check = ColumnCheck(self.report)
        unwrap = UnwrapTimes(self.path, self.report, self._options) if self._layout.is_celex else None
        for values, offsets in self._rows(self.report):
            values, offsets = self._in_range(values, offsets)
            columns = {name: values[:, index] for index, name in enumerate(self._layout.names)}
            if unwrap is not None:
                columns["t_us"] = unwrap(columns["t_us"])
            yield check(_typed(columns, self._layout.is_celex), offsets)

    def _in_range(self, values: NDArray, offsets: NDArray) -> tuple[NDArray, NDArray]:
        """Leave out, and report, rows with a number that its column cannot hold."""
        for index, name in enumerate(self._layout.names):
            low, high = _LIMITS.get(name, (-(2**63), 2**63 - 1))
            wrong = (values[:, index] < low) | (values[:, index] > high)
            if wrong.any():
                first = int(np.argmax(wrong))
                found = f"{name} = {values[first, index]}"
                cure = f"it runs from {low} to {high}: {_SALVAGE}"
                self.report.fault("out_of_range", int(offsets[first]), found, cure, count=int(wrong.sum()))
                values, offsets = values[~wrong], offsets[~wrong]
        return values, offsets

    def read(self) -> Columns:
        """Return all events."""
        return join(list(self.blocks()))


def _typed(columns: dict[str, NDArray], is_celex: bool) -> Columns:
    """Return columns in their types; polarities that the file does not have are unknown."""
    out: Columns = {
        "t_us": np.ascontiguousarray(columns["t_us"]),
        "x": columns["x"].astype(np.uint16),
        "y": columns["y"].astype(np.uint16),
    }
    if "p" in columns:
        out["p"] = columns["p"] > 0
        if is_celex:
            out["polarity_known"] = columns["p"] != 0  # the camera's program prints 0 for no change
    else:
        out["p"] = np.zeros(len(out["t_us"]), np.bool_)
        out["polarity_known"] = np.zeros(len(out["t_us"]), np.bool_)
    if "polarity_known" in columns:
        out["polarity_known"] = columns["polarity_known"] > 0
    if "adc" in columns:
        out["adc"] = columns["adc"].astype(np.uint16)
    return out


class CsvSink(FileSink):
    """A comment with sensor size and count, a line of names, and one row per event."""

    def __init__(self, path: Path, first: Events) -> None:
        super().__init__(path)
        self._size, self._events = (first.width, first.height), 0
        self._comment()
        self.file.write((",".join(first.columns()) + "\n").encode("ascii"))

    def _comment(self) -> None:
        width, height = self._size
        self.file.write(f"# width={width} height={height} events={self._events:<18}\n".encode("ascii"))

    def append(self, events: Events) -> None:
        """Write the rows of a piece."""
        for start in range(0, len(events), 1 << 16):
            part = events[start : start + (1 << 16)].columns().values()
            values = np.stack([column.astype(np.int64) for column in part], axis=1)  # [rows, columns]
            text = np.empty(21 * values.size, np.uint8)
            text[: print_rows(values, text)].tofile(self.file)
        self._events += len(events)

    def finish(self) -> None:
        """Announce the number of events in the comment."""
        self.file.seek(0)
        self._comment()
