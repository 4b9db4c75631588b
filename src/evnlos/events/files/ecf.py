"""Prophesee's HDF5 event files, whose chunks are coded by ECF; decoded here, without a plug-in.

`/CD/events` holds (x u2, y u2, p i2, t i8) in chunks of 16384 events. A coded chunk is a header of 32 bits, the
first time, the times as runs of small differences, then columns: all of them packed, or rows as runs and (x, p)
packed, or masks of neighbours. Layout: github.com/prophesee-ai/hdf5_ecf (Apache-2.0), read, not copied.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.files.columns import (
    MOST_DEFLATED,
    SALVAGE,
    ColumnCheck,
    Columns,
    ReadReport,
    allocate,
    collect,
    cut,
    unreadable,
)
from evnlos.untrusted import stored

FILTER = 0x8ECF
_MOST_EVENTS = 65_535  # of a chunk: 16 bits count them
_MOST_CHUNK_BYTES = 32 * _MOST_EVENTS
_CURE = f"the file is damaged there: {SALVAGE}"
_FAULTS = (
    "", "ends before its last event", "counts more events than it holds", "holds bytes that are left over",
           "holds coordinates beyond 16 bits", "holds times beyond 64 bits",
)  # fmt: skip
_WHOLE, _SHORT, _OVERRUN, _LEFT, _OUTSIDE, _FAR = range(6)


@njit(cache=True)
def _u16(data, at):
    return np.int64(data[at]) | np.int64(data[at + 1]) << 8


@njit(cache=True)
def _u32(data, at):
    return _u16(data, at) | _u16(data, at + 2) << 16


@njit(cache=True)
def _run(data, at, word, low, most):
    """Return the run in the `low` bits of a word, or behind it where all of them are set, and the place behind.

    A fault is a negative place.
    """
    run = word & low
    if run == low:
        if at + 2 > len(data):
            return run, -_SHORT
        run = _u16(data, at)
        at += 2
    return run, at if run <= most else -_OVERRUN


@njit(cache=True)
def _decode_times(data, at, t_us):
    """Decode the times; return the place behind them, or a fault as a negative number."""
    size, count, time = len(data), len(t_us), np.int64(0)
    for place in range(8):
        time |= np.int64(data[at + place]) << (8 * place)
    if time < 0:
        return -_FAR
    at += 8
    filled = 0
    while filled < count:
        if at >= size:
            return -_SHORT
        byte = np.int64(data[at])
        at += 1
        if byte >> 4 == 15:  # parts of a difference, lowest first
            difference, shift = byte & 15, 4
            while at < size and data[at] >> 4 == 15:
                if shift > 56:
                    return -_FAR
                difference |= (np.int64(data[at]) & 15) << shift
                shift += 4
                at += 1
            if difference > np.int64(1 << 62) or time > np.int64(1 << 62):
                return -_FAR
            time += difference
            continue
        time += byte >> 4
        run, at = _run(data, at, byte, 15, count - filled)
        if at < 0:
            return at
        t_us[filled : filled + run] = time
        filled += run
    return at


@njit(cache=True)
def _four(words, width, values):
    """Unpack four values of 3/4 `width` bits from three words: three in the upper ends, one in the rest."""
    low = width // 4
    rest = (np.int64(1) << low) - 1
    a, b, c = words[0], words[1], words[2]
    values[0] = a >> low
    values[1] = (a & rest) | (b >> (2 * low)) << low
    values[2] = (b & ((np.int64(1) << (2 * low)) - 1)) | (c >> (3 * low)) << (2 * low)
    values[3] = c & ((np.int64(1) << (3 * low)) - 1)


@njit(cache=True)
def _decode_packed(data, at, x, y, p):
    """Decode groups of four events (y, x, p) in three words of 32 bits; the last group is whole."""
    groups = (len(x) + 3) // 4
    if at + 12 * groups > len(data):
        return -_SHORT
    values, words = np.empty(4, np.int64), np.empty(3, np.int64)
    for group in range(groups):
        words[0], words[1], words[2] = _u32(data, at), _u32(data, at + 4), _u32(data, at + 8)
        at += 12
        _four(words, 32, values)
        for place in range(min(4, len(x) - 4 * group)):
            value, index = values[place], 4 * group + place
            y[index] = (value >> 12) & 0x7FF
            x[index] = (value >> 1) & 0x7FF
            p[index] = (value & 1) != 0
    return at


@njit(cache=True)
def _decode_rows(data, at, y):
    filled = 0
    while filled < len(y):
        if at + 2 > len(data):
            return -_SHORT
        word = _u16(data, at)
        run, at = _run(data, at + 2, word, 31, len(y) - filled)
        if at < 0:
            return at
        y[filled : filled + run] = word >> 5
        filled += run
    return at


@njit(cache=True)
def _decode_pairs(data, at, x, p):
    """Decode groups of four (x, p) in three words of 16 bits; the last group is whole."""
    groups = (len(x) + 3) // 4
    if at + 6 * groups > len(data):
        return -_SHORT
    values, words = np.empty(4, np.int64), np.empty(3, np.int64)
    for group in range(groups):
        words[0], words[1], words[2] = _u16(data, at), _u16(data, at + 2), _u16(data, at + 4)
        at += 6
        _four(words, 16, values)
        for place in range(min(4, len(x) - 4 * group)):
            x[4 * group + place] = (values[place] >> 1) & 0x7FF
            p[4 * group + place] = (values[place] & 1) != 0
    return at


@njit(cache=True)
def _decode_masks(data, at, x):
    """Decode a column and five neighbours to its right, as a mask, in a word of 16 bits."""
    filled = 0
    while filled < len(x):
        if at + 2 > len(data):
            return -_SHORT
        word = _u16(data, at)
        at += 2
        x[filled] = word >> 5
        filled += 1
        for step in range(1, 6):
            if word & (32 >> step) and filled < len(x):
                x[filled] = (word >> 5) + step
                filled += 1
    return at


@njit(cache=True)
def _decode_signs(data, at, p):
    filled = 0
    while filled < len(p):
        if at + 1 > len(data):
            return -_SHORT
        byte = np.int64(data[at])
        run, at = _run(data, at + 1, byte, 127, len(p) - filled)
        if at < 0:
            return at
        p[filled : filled + run] = byte > 127
        filled += run
    return at


@njit(cache=True)
def decode_ecf(data, t_us, x, y, p):
    """Decode a chunk of as many events as the columns hold.

    Args:
        data: The coded bytes, uint8, at least 12.
        t_us: Takes the times, int64 [n], microseconds.
        x: Takes the columns, uint16 [n], pixels.
        y: Takes the rows, uint16 [n], pixels.
        p: Takes the polarities, bool [n].

    Returns:
        0, or the number of a fault.
    """
    head = _u32(data, 0)
    at = _decode_times(data, 4, t_us)
    if at >= 0 and head & 2:
        at = _decode_packed(data, at, x, y, p)
    elif at >= 0:
        at = _decode_rows(data, at, y)
        if at >= 0 and head & 1:
            at = _decode_pairs(data, at, x, p)
        elif at >= 0:
            at = _decode_masks(data, at, x)
            if at >= 0:
                at = _decode_signs(data, at, p)
    if at < 0:
        return -at
    return _WHOLE if at == len(data) else _LEFT


def is_prophesee(file: h5py.File) -> bool:
    """Return whether an HDF5 file holds the group CD of Prophesee's event files."""
    group = stored(file, "CD")
    return isinstance(group, h5py.Group) and "events" in group


class EcfEvents:
    """The events of an open Prophesee HDF5 file.

    Args:
        path: The file.
        report: Takes the sensor size and what is wrong.
        file: The open file.
        width: Sensor width, pixels, where the file is wrong; None = the file's.
        height: Sensor height, pixels.
    """

    def __init__(
        self, path: Path, report: ReadReport, file: h5py.File, width: int | None, height: int | None
    ) -> None:
        self.path, self.report = path, report
        dataset = stored(file, "CD/events")
        names = ("x", "y", "p", "t")
        known = set(dataset.dtype.names or ()) if isinstance(dataset, h5py.Dataset) else set()
        if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1 or not set(names) <= known:
            raise unreadable(path, 0, "CD/events is no table of x, y, p, t", "export it again")
        if any(dataset.dtype[name].kind not in "iu" for name in names):
            raise unreadable(path, 0, "CD/events holds columns that are no whole numbers", "export it again")
        self.dataset, self.count = dataset, int(dataset.shape[0])
        filters = dataset.id.get_create_plist()
        codes = [filters.get_filter(k)[0] for k in range(filters.get_nfilters())]
        self._is_coded = codes == [FILTER]
        if FILTER in codes and not self._is_coded:
            raise unreadable(path, 0, "CD/events is packed by ECF and by another filter", "export it again")
        self._chunk = dataset.chunks[0] if dataset.chunks else 1 << 16
        self._check_sizes()
        shift = _text(file.attrs.get("time_shift", "0"))
        try:
            self.shift_us = int(shift)
        except ValueError:
            raise unreadable(
                path, 0, f"a time_shift of {shift[:20]!r}", "a whole number belongs there"
            ) from None
        if not abs(self.shift_us) < 2**62:
            raise unreadable(path, 0, f"a time_shift of {self.shift_us}", "give microseconds below 2^62")
        if width is not None:
            report.set_geometry(width, height, "caller")
        elif "geometry" in file.attrs:
            sides = _text(file.attrs["geometry"]).partition("x")
            report.set_geometry(sides[0], sides[2], "header")
        else:
            raise unreadable(path, 0, "a file that names no geometry", "give width= and height=")

    def _check_sizes(self) -> None:
        """Refuse a table that the stored chunks cannot fill, before anything is allocated."""
        if self._is_coded and not 0 < self._chunk <= _MOST_EVENTS:
            raise unreadable(self.path, 0, f"ECF chunks of {self._chunk} events", "at most 65535 are coded")
        chunks = -(-self.count // self._chunk)
        if self.dataset.chunks is not None and self.dataset.id.get_num_chunks() < chunks:
            found = (
                f"CD/events announces {self.count} events, {self.dataset.id.get_num_chunks()} chunks are stored"
            )
            raise unreadable(self.path, 0, found, "the file is damaged or not complete: copy it again")
        stored_bytes = self.dataset.id.get_storage_size()
        if not self._is_coded and self.count * self.dataset.dtype.itemsize > stored_bytes * MOST_DEFLATED:
            found = f"CD/events announces {self.count} events, {stored_bytes} bytes are stored"
            raise unreadable(self.path, 0, found, "the file is damaged or not complete: copy it again")

    def blocks(self) -> Iterator[Columns]:
        """Yield the events chunk by chunk."""
        place = [0]
        check = ColumnCheck(self.report, lambda _: place[0])
        for start in range(0, self.count, self._chunk):
            columns = self._block(start, min(self._chunk, self.count - start), place)
            if columns is not None:
                if self.shift_us:
                    columns["t_us"] = columns["t_us"] - self.shift_us
                yield check(columns)

    def _block(self, start: int, count: int, place: list[int]) -> Columns | None:
        if not self._is_coded:
            return _of_rows(self.dataset[start : start + count])
        about = self.dataset.id.get_chunk_info_by_coord((start,))
        place[0] = about.byte_offset or 0
        size = int(about.size or 0)
        if not 12 <= size <= _MOST_CHUNK_BYTES:
            return self._damaged(place[0], f"is of {size} bytes", size)
        mask, data = self.dataset.id.read_direct_chunk((start,))
        if mask:  # the writer left this chunk as it is
            rows = np.frombuffer(data, self.dataset.dtype)[:count]
            return _of_rows(rows) if len(rows) == count else self._damaged(place[0], "is too short", size)
        coded = np.frombuffer(data, np.uint8)
        stated = int.from_bytes(coded[:4].tobytes(), "little") >> 2
        if stated not in (count, self._chunk):  # HDF5's own pipeline codes the last chunk with its padding
            return self._damaged(place[0], f"holds {stated} events where {count} are announced", size)
        out = allocate(stated)
        fault = decode_ecf(coded, out["t_us"], out["x"], out["y"], out["p"])
        if fault == _LEFT:
            self.report.fault("left_over", place[0], f"an ECF chunk {_FAULTS[fault]}", _CURE, lost_bytes=1)
        elif fault:
            return self._damaged(place[0], _FAULTS[fault], size)
        return cut(out, 0, count)

    def _damaged(self, offset: int, found: str, size: int) -> None:
        self.report.fault("left_over", offset, f"an ECF chunk {found}", _CURE, lost_bytes=size)

    def edges(self, file: h5py.File) -> tuple[NDArray, NDArray, NDArray] | None:
        """Return times, channels and levels of the external triggers; None where there are none."""
        dataset = stored(file, "EXT_TRIGGER/events")
        if dataset is None:
            return None
        names = set(dataset.dtype.names or ()) if isinstance(dataset, h5py.Dataset) else set()
        if not isinstance(dataset, h5py.Dataset) or not {"p", "t", "id"} <= names or dataset.ndim != 1:
            raise unreadable(self.path, 0, "EXT_TRIGGER/events is no table of p, t, id", "export it again")
        if dataset.shape[0] * dataset.dtype.itemsize > dataset.id.get_storage_size() * MOST_DEFLATED:
            raise unreadable(self.path, 0, "EXT_TRIGGER/events announces more than is stored", "copy it again")
        rows = dataset[:]
        return rows["t"].astype(np.int64) - self.shift_us, rows["id"].astype(np.uint8), rows["p"] != 0


def _text(value: object) -> str:
    return value.decode("latin-1") if isinstance(value, bytes) else str(value)


def _of_rows(rows: NDArray) -> Columns:
    return {
        "t_us": rows["t"].astype(np.int64), "x": rows["x"].astype(np.uint16), "y": rows["y"].astype(np.uint16),
        "p": rows["p"] > 0,
    }  # fmt: skip


class EcfSource:
    """An open Prophesee HDF5 file.

    Args:
        path: The file.
        report: Takes what is wrong.
        opened: Opens the file and turns what h5py raises into one line.
        width: Sensor width, pixels; None = the file's.
        height: Sensor height, pixels.
    """

    def __init__(
        self,
        path: Path,
        report: ReadReport,
        opened: Callable,
        width: int | None,
        height: int | None,
    ) -> None:
        self._options, self._opened, self._report = (width, height), opened, report
        self._path = path
        with opened(path) as file:
            found = EcfEvents(path, report, file, width, height).edges(file)
            report.triggers = 0 if found is None else len(found[0])

    def blocks(self) -> Iterator[Columns]:
        """Yield the events chunk by chunk."""
        with self._opened(self._path) as file:
            yield from EcfEvents(self._path, self._report, file, *self._options).blocks()

    def read(self) -> Columns:
        """Return all events."""
        return collect(self.blocks(), self._path.stat().st_size)

    def edges(self) -> Iterator[tuple[NDArray, NDArray, NDArray]]:
        """Yield times [us], channels and levels of the external triggers."""
        with self._opened(self._path) as file:
            found = EcfEvents(self._path, self._report, file, *self._options).edges(file)
        if found is not None:
            yield found
