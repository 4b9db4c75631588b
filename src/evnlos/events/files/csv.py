"""CSV: rows of numbers under a line of names, and the layouts of other programs, of CeleX-V among them.

- What the columns of a text file of events are: names, comments, and the layouts of other programs.
- Parsing and printing rows of numbers at memory speed.
- Reading and writing such files in blocks.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.files.celex import CelexOptions, UnwrapTimes
from evnlos.events.files.columns import SALVAGE, ColumnCheck, Columns, FileSink, ReadReport, join, unreadable
from evnlos.types import Events

MAX_LINE = 4096
_ALIASES = {
    "t": "t_us", "time": "t_us", "timestamp": "t_us", "ts": "t_us", "t_us": "t_us", "time_us": "t_us",
    "x": "x", "col": "x", "column": "x", "y": "y", "row": "y",
    "p": "p", "pol": "p", "polarity": "p", "on": "p",
    "adc": "adc", "intensity": "adc", "polarity_known": "polarity_known", "t_in_pixel": "t_in_pixel",
}  # fmt: skip
_CELEX = {
    3: ("y", "x", "t_us"),
    4: ("y", "x", "t_in_pixel", "t_us"),
    5: ("y", "x", "adc", "p", "t_us"),
}


@dataclass(frozen=True)
class Layout:
    """What the columns of a file are.

    Args:
        names: Column names, left to right.
        start: Byte offset of the first row.
        in_seconds: Whether times have decimals and are seconds.
        is_celex: Whether the file was exported by the CeleX-V program.
        size: Sensor size (width, height) that comments state.
        announced: Number of events that comments state.
    """

    names: tuple[str, ...]
    start: int
    in_seconds: bool = False
    is_celex: bool = False
    size: tuple[int, int] | None = None
    announced: int | None = None


def _comment(lines: list[bytes]) -> tuple[tuple[int, int] | None, int | None]:
    """Return sensor size and number of events that comment lines state."""
    text = b"\n".join(lines).decode("latin-1").lower()
    pair = re.search(r"geometry\W+(\d{1,5})\s*[x,]\s*(\d{1,5})", text)
    width, height = re.search(r"width\W+(\d{1,5})", text), re.search(r"height\W+(\d{1,5})", text)
    size = (int(pair[1]), int(pair[2])) if pair else None
    if size is None and width and height:
        size = int(width[1]), int(height[1])
    count = re.search(r"events=(\d{1,18})", text)
    return size, int(count[1]) if count else None


def _split(line: bytes) -> list[bytes]:
    return [field for field in re.split(rb"[\s,;]+", line.strip()) if field]


def _is_number(field: bytes) -> bool:
    return re.fullmatch(rb"[+-]?\d{1,18}(\.\d*)?", field) is not None


def _is_sign(field: bytes) -> bool:
    return field in (b"0", b"1", b"-1", b"+1")


def find_layout(start: bytes) -> Layout | None:
    """Return the layout of a text file from its first bytes, None where they are no rows of numbers."""
    if any(byte < 9 or 13 < byte < 32 or byte > 126 for byte in start[:MAX_LINE]):
        return None
    offset, comments, names = 0, [], ()
    for line in start.splitlines(keepends=True):
        fields = _split(line)
        if line[:1] in (b"#", b"%"):
            comments.append(line)
        elif fields and not names and not any(map(_is_number, fields)):
            names = tuple(_ALIASES.get(field.decode("latin-1").lower(), "") for field in fields)
            if not {"t_us", "x", "y"} <= set(names):
                return None
        elif fields:
            break
        offset += len(line)
    else:
        fields = []
    size, announced = _comment(comments)
    if names:
        in_seconds = bool(fields) and len(fields) == len(names) and b"." in fields[names.index("t_us")]
        return Layout(names, offset, in_seconds, "t_in_pixel" in names, size, announced)
    if not fields or not all(map(_is_number, fields)):
        return None
    return _headless(start, offset, fields, size, announced)


def _headless(
    start: bytes, offset: int, fields: list[bytes], size: tuple[int, int] | None, announced: int | None
) -> Layout | None:
    """Return the layout of rows without names: seconds first, the CeleX-V program's, or x, y, p, t."""
    rows = [_split(line) for line in start[offset:].splitlines()[:1000]]
    rows = [row for row in rows if len(row) == len(fields)]
    if len(fields) == 4 and b"." in fields[0]:
        return Layout(("t_us", "x", "y", "p"), offset, True, False, size, announced)
    if len(fields) == 4 and all(_is_sign(row[2]) for row in rows):
        return Layout(("x", "y", "p", "t_us"), offset, False, False, size, announced)
    if len(fields) == 4 and all(_is_sign(row[3]) for row in rows):
        return Layout(("t_us", "x", "y", "p"), offset, False, False, size, announced)
    if len(fields) in _CELEX:
        return Layout(_CELEX[len(fields)], offset, False, True, size, announced)
    return None


_NEWLINE, _RETURN, _MINUS, _PLUS, _DOT, _ZERO, _NINE = 10, 13, 45, 43, 46, 48, 57
_COMMA, _SEMICOLON, _SPACE, _TAB = 44, 59, 32, 9
FAULTS, FIRST_FAULT, SCALED = range(3)  # slots of the state


@njit(cache=True)
def parse_rows(data, columns, seconds_column, values, starts, state):
    """Parse whole lines of `columns` numbers each; return rows and bytes used.

    Numbers are whole, except in `seconds_column` (-1: none), where decimals are seconds and become
    microseconds, rounded. A line that is no such row is counted, the first one's place is kept, and it is left
    out. `starts` receives the place of each row.
    """
    rows, used, at, size = 0, 0, 0, len(data)
    while at < size:
        end = at
        while end < size and data[end] != _NEWLINE:
            end += 1
        if end == size:
            break
        field, place, good = 0, at, True
        while good:
            while place < end and (data[place] == _SPACE or data[place] == _TAB or data[place] == _RETURN):
                place += 1
            if place == end:
                break
            if field == columns:
                good = False
                break
            negative = data[place] == _MINUS
            if negative or data[place] == _PLUS:
                place += 1
            value, digits = np.int64(0), 0
            while place < end and _ZERO <= data[place] <= _NINE:
                value = value * 10 + (data[place] - _ZERO)
                digits += 1
                place += 1
            if digits == 0 or digits > 18:
                good = False
                break
            if field == seconds_column:
                if digits > 12:
                    good = False
                    break
                value *= 1_000_000
                if place < end and data[place] == _DOT:
                    place += 1
                    unit, up = np.int64(100_000), False
                    first = True
                    while place < end and _ZERO <= data[place] <= _NINE:
                        digit = np.int64(data[place] - _ZERO)
                        if unit > 0:
                            value += digit * unit
                        elif first:
                            up = digit >= 5
                            first = False
                        unit //= 10
                        place += 1
                    if up:
                        value += 1
            values[rows, field] = -value if negative else value
            field += 1
            while place < end and (data[place] == _SPACE or data[place] == _TAB or data[place] == _RETURN):
                place += 1
            if place < end and (data[place] == _COMMA or data[place] == _SEMICOLON):
                place += 1
            elif place < end and place > at and not (data[place - 1] == _SPACE or data[place - 1] == _TAB):
                good = False
        if good and field == columns:
            starts[rows] = at
            rows += 1
        elif not (good and field == 0):  # an empty line is no row and no fault
            if state[FAULTS] == 0:
                state[FIRST_FAULT] = at
            state[FAULTS] += 1
        at = end + 1
        used = at
    return rows, used


@njit(cache=True)
def print_rows(values, data):
    """Print rows of whole numbers with commas; return the bytes written. 21 bytes per number suffice."""
    at = 0
    digits = np.empty(20, np.uint8)
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            value = values[row, column]
            if value < 0:
                data[at] = _MINUS
                at += 1
            count = 0
            while True:
                # The remainder is taken before the sign: -value overflows for the smallest number.
                quotient = (
                    value // 10 if value >= 0 else -((-(value + 1)) // 10) - (((-(value + 1)) % 10 + 1) // 10)
                )
                digit = value - quotient * 10
                digits[count] = _ZERO + (digit if digit >= 0 else -digit)
                count += 1
                value = quotient
                if value == 0:
                    break
            for index in range(count):
                data[at] = digits[count - 1 - index]
                at += 1
            data[at] = _COMMA if column + 1 < values.shape[1] else _NEWLINE
            at += 1
    return at


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
            self.file.write(text[: print_rows(values, text)].data)  # tofile says not why it failed
        self._events += len(events)

    def finish(self) -> None:
        """Announce the number of events in the comment."""
        self.file.seek(0)
        self._comment()
