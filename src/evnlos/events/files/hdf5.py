"""HDF5 with columns of events: DSEC (events/x, y, t, p), M3ED (prophesee/left/x), EVIMO (events_t, events_xy).

Any group with such columns is a stream. Times are whole microseconds, after `t_offset` where there is one, or
seconds as floating-point numbers. Prophesee's own files, with the group CD, are read by `ecf`.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.files.columns import (
    MOST_DEFLATED,
    ColumnCheck,
    Columns,
    ReadReport,
    Stream,
    choose_stream,
    refuse_topic,
    unreadable,
)
from evnlos.events.files.ecf import EcfSource, is_prophesee
from evnlos.untrusted import ElsewhereError, check_memory, open_hdf5, stored

SIGNATURE = b"\x89HDF\r\n\x1a\n"
_MOST_CHUNK_BYTES = 1 << 26
_ALIASES = {
    "t_us": ("t", "ts", "t_us", "timestamps"),
    "x": ("x", "xs", "xy"),
    "y": ("y", "ys", "xy"),
    "p": ("p", "ps", "pol", "polarity", "polarities"),
}
_PREFIXES = ("", "events_", "dataset_events_")  # of columns beside others in one group (EVIMO)
_MOST_DEEP, _MOST_GROUPS = 4, 500  # of a search for columns
_EVENT_BYTES = 26  # of an event as columns, and as what is stored
_OPTIONAL = ("adc", "polarity_known")
_H5_ERRORS = (
    OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError, MemoryError,
)  # fmt: skip
_CURE = "the file is damaged or not complete: copy it again"
_BLOCK_EVENTS = 1 << 17
_FEWEST = 4096  # entries of a chunk that is worth a call of its own
_SHUFFLE, _DEFLATE, _SUM = h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_FLETCHER32
_PACKINGS = ((_DEFLATE,), (_SHUFFLE, _DEFLATE), (_DEFLATE, _SUM), (_SHUFFLE, _DEFLATE, _SUM))


@contextmanager
def _h5_errors(path: Path) -> Iterator[None]:
    """Turn whatever h5py raises on damage into one error."""
    try:
        yield
    except _H5_ERRORS as error:
        found = " ".join(str(error).split())[:160]
        if "filter" in found.lower() and ("plugin" in found.lower() or "not available" in found.lower()):
            cure = "install hdf5plugin, or export it uncompressed (ECF: convert with the camera maker's tools)"
        elif isinstance(error, ElsewhereError):
            cure = "write the columns into the file itself"
        else:
            cure = _CURE
        raise unreadable(path, 0, f"HDF5 cannot read it ({found})", cure) from None


@contextmanager
def _opened(path: Path, chunk_bytes: int = 0) -> Iterator[h5py.File]:
    with _h5_errors(path), open_hdf5(path, chunk_bytes) as file:
        yield file


def open_hdf5_events(
    path: Path, report: ReadReport, width: int | None, height: int | None, topic: str | None
) -> Hdf5Source | EcfSource:
    """Return the source of an HDF5 file, by what is in it: Prophesee's group CD, or columns.

    Args:
        path: The file.
        report: Takes what is wrong.
        width: Sensor width, pixels; None = the file's.
        height: Sensor height, pixels.
        topic: Name of the group with the columns, of a file with several; None = the only one.
    """
    report.format = "HDF5"
    with _opened(path) as file:
        is_ecf = is_prophesee(file)
    if is_ecf:
        refuse_topic(path, "Prophesee's HDF5", topic)
        return EcfSource(path, report, _opened, width, height)
    return Hdf5Source(path, report, width, height, topic)


def _column_names(group: h5py.Group) -> dict[str, str] | None:
    """Return the name of each column in a group, None where it holds no events."""
    for prefix in _PREFIXES:
        found = {}
        for column, aliases in _ALIASES.items():
            names = [prefix + alias for alias in aliases if prefix + alias in group]
            names = [name for name in names if not isinstance(group.get(name, getlink=True), h5py.HardLink)
                     or isinstance(group[name], h5py.Dataset)]  # fmt: skip
            if names:
                found[column] = names[0]
        if len(found) == len(_ALIASES):
            return found
    return None


def _tables(file: h5py.File) -> dict[str, dict[str, str]]:
    """Return the groups that hold columns of events, by their path, and the names of the columns."""
    found: dict[str, dict[str, str]] = {}
    waiting: list[tuple[str, h5py.Group]] = [("", file)]
    seen = 0
    while waiting and seen < _MOST_GROUPS:
        place, group = waiting.pop(0)
        seen += 1
        names = _column_names(group)
        if names is not None:
            found[place] = names
            continue
        for name in group:
            link = group.get(name, getlink=True)
            inside = group[name] if isinstance(link, h5py.HardLink) else None
            if isinstance(inside, h5py.Group) and place.count("/") < _MOST_DEEP:
                waiting.append((f"{place}/{name}".lstrip("/"), inside))
    return found


class Hdf5Source:
    """Columns of events in an open HDF5 file."""

    def __init__(
        self, path: Path, report: ReadReport, width: int | None, height: int | None, topic: str | None = None
    ) -> None:
        self.path, self.report = path, report
        self._chunk_bytes = 0
        with _opened(path) as file:
            stored(file, "events")  # a link there is told as what it is
            tables = _tables(file)
            if not tables:
                cure = "columns x, y, t, p of events are read, in any group"
                raise unreadable(path, 0, "an HDF5 file without columns of events", cure)
            report.streams = tuple(Stream(name or "/", "events", "HDF5 columns") for name in tables)
            report.topic = choose_stream(path, report.streams, topic, "events", report.strict).name
            self._group = report.topic.strip("/")
            self._stored_names = tables[self._group]
            self._count = self._check_layout(file)
            self._t_offset = self._offset(file)
            self._geometry(file, width, height)

    def _holder(self, file: h5py.File) -> h5py.Group:
        group = stored(file, self._group) if self._group else file
        if not isinstance(group, h5py.Group):
            raise unreadable(self.path, 0, f"{self._group} is no group", _CURE)
        return group

    def _called(self, name: str) -> str:
        """Return what a column is called in the file."""
        return f"{self._group}/{self._stored_names.get(name, name)}".lstrip("/")

    def _datasets(self, file: h5py.File) -> dict[str, h5py.Dataset]:
        group = self._holder(file)
        datasets = {name: stored(group, key) for name, key in self._stored_names.items()}
        datasets |= {name: stored(group, name) for name in _OPTIONAL if name in group}
        for name, dataset in datasets.items():
            is_pair = self._stored_names.get(name, "").endswith("xy")
            kinds = "iubf" if name == "t_us" else "iub"
            if (
                not isinstance(dataset, h5py.Dataset)
                or dataset.dtype.kind not in kinds
                or (dataset.shape[1:] != ((2,) if is_pair else ()))
                or dataset.ndim == 0
            ):
                what = "pairs" if is_pair else "a 1-D column"
                raise unreadable(self.path, 0, f"{self._called(name)} is not {what} of integers", _CURE)
        return datasets  # type: ignore[return-value]

    def _check_layout(self, file: h5py.File) -> int:
        """Return the number of events; refuse sizes that the stored bytes cannot hold before allocating."""
        lengths = {}
        for name, dataset in self._datasets(file).items():
            lengths[name] = int(dataset.shape[0])
            stored = dataset.id.get_storage_size()
            need = dataset.size * dataset.dtype.itemsize
            chunk = math.prod(dataset.chunks) * dataset.dtype.itemsize if dataset.chunks is not None else 0
            self._chunk_bytes = max(self._chunk_bytes, chunk)
            if chunk > _MOST_CHUNK_BYTES:
                found = f"{self._called(name)} has chunks of {chunk / 1e6:.0f} MB"
                raise unreadable(self.path, 0, found, "write it in smaller ones (h5repack -l CHUNK=65536)")
            is_cut = bool(chunk) and dataset.id.get_num_chunks() * chunk < need
            if is_cut or need > stored * MOST_DEFLATED:
                found = f"{self._called(name)} announces {need} bytes, {stored} are stored"
                raise unreadable(self.path, 0, found, _CURE)
        if len(set(lengths.values())) != 1:
            raise unreadable(self.path, 0, f"columns of unequal length {lengths}", _CURE)
        return lengths["t_us"]

    def _offset(self, file: h5py.File) -> int:
        for place in dict.fromkeys(("t_offset", f"{self._group}/t_offset".lstrip("/"))):
            dataset = stored(file, place)
            if isinstance(dataset, h5py.Dataset) and dataset.size == 1 and dataset.dtype.kind in "iu":
                return int(dataset[()].item())
            if dataset is not None:
                raise unreadable(self.path, 0, f"{place} is no whole number", _CURE)
        return 0

    def _geometry(self, file: h5py.File, width: int | None, height: int | None) -> None:
        if width is not None:
            return self.report.set_geometry(width, height, "caller")
        for holder in (self._holder(file), file):
            if "width" in holder.attrs and "height" in holder.attrs:
                return self.report.set_geometry(holder.attrs["width"], holder.attrs["height"], "header")
        resolution = stored(self._holder(file), "calib/resolution")  # M3ED: width, height
        if isinstance(resolution, h5py.Dataset) and resolution.shape == (2,) and resolution.dtype.kind in "iu":
            return self.report.set_geometry(int(resolution[0]), int(resolution[1]), "header")
        largest = {"x": 0, "y": 0}
        datasets = self._datasets(file)
        for start in range(0, self._count, 1 << 20):
            for name in largest:
                values = _entries_of(datasets[name], name, start, min(start + (1 << 20), self._count))
                largest[name] = max(largest[name], int(values.max()))
        return self.report.set_geometry(largest["x"] + 1, largest["y"] + 1, "events")

    def _entries(self, name: str, dataset: h5py.Dataset, start: int, stop: int) -> NDArray:
        """Return entries in their type; narrow times are read into half of the column that they then fill."""
        count = stop - start
        fits = -(2**63) <= self._t_offset < 2**63 - 2**32
        if name == "t_us" and dataset.dtype == np.uint32 and fits:
            times = np.empty(count, np.int64)
            if not _read_chunks(times, dataset, start, stop, self._t_offset):
                narrow = times.view(np.uint32)[count:]
                narrow[:] = dataset[start:stop]
                _widen(narrow, self._t_offset, times)
            return times
        return self._column(name, _entries_of(dataset, name, start, stop))

    def _column(self, name: str, values: NDArray) -> NDArray:
        if name in ("p", "polarity_known"):
            if values.dtype == np.bool_:
                return values
            least = 0 if values.dtype.kind == "u" or not values.size else int(values.min())
            if least < -1 or (values.size and int(values.max()) > 1):
                raise unreadable(self.path, 0, f"{self._called(name)} holds more than 0/1 or -1/+1", _CURE)
            return values.view(np.bool_) if values.dtype == np.uint8 else values > 0
        if name != "t_us":
            if values.dtype != np.uint16 and values.size:
                self._refuse_outside(name, values, 0, 65_535)
            return values.astype(np.uint16, copy=False)
        if values.dtype.kind == "f":
            values = self._microseconds(values)
        if not self._t_offset or not values.size:
            self._refuse_outside(name, values, -(2**63), 2**63 - 1)
            return values.astype(np.int64, copy=False)
        self._refuse_outside(name, values, -(2**63) - self._t_offset, 2**63 - 1 - self._t_offset)
        return np.add(values, self._t_offset, dtype=np.int64)

    def _microseconds(self, seconds: NDArray) -> NDArray[np.int64]:
        """Return times in seconds as whole microseconds."""
        if not (np.abs(seconds) < 2**61 / 1e6).all():
            raise unreadable(self.path, 0, f"{self._called('t_us')} holds NaN or no times", "mend them")
        return np.rint(seconds.astype(np.float64) * 1e6).astype(np.int64)

    def _refuse_outside(self, name: str, values: NDArray, low: int, high: int) -> None:
        info = np.iinfo(values.dtype) if values.dtype != np.bool_ else None
        if info is None or not values.size or (low <= info.min and info.max <= high):
            return  # whatever the column holds, it is inside
        if not (low <= int(values.min()) and int(values.max()) <= high):
            raise unreadable(self.path, 0, f"{self._called(name)} leaves {low}..{high}", _CURE)

    def blocks(self, size: int | None = None) -> Iterator[Columns]:
        """Yield columns of at most `size` events; None = some 100,000, as whole chunks of the first column."""
        with _h5_errors(self.path), open_hdf5(self.path, self._chunk_bytes) as file:
            datasets = self._datasets(file)
            check = ColumnCheck(self.report, lambda number: _stored_at(datasets["t_us"], number))
            chunk = (datasets["t_us"].chunks or (1,))[0]
            size = size or max(_BLOCK_EVENTS // chunk, 1) * chunk
            for start in range(0, self._count, size):
                block = {}
                for name, dataset in datasets.items():
                    block[name] = self._entries(name, dataset, start, min(start + size, self._count))
                yield check(block)

    def read(self) -> Columns:
        """Return all events."""
        check_memory(
            _EVENT_BYTES * self._count, f"{self.path}: {self._count:,} events", "cut it with evnlos convert"
        )
        return next(self.blocks(max(self._count, 1)), {})


def _entries_of(dataset: h5py.Dataset, name: str, start: int, stop: int) -> NDArray:
    """Return the entries start..stop of a column, or of one of two columns that are stored as pairs."""
    if dataset.ndim == 2:
        return dataset[start:stop, 0 if name == "x" else 1]
    values = np.empty(stop - start, dataset.dtype)
    if not _read_chunks(values, dataset, start, stop):
        values[:] = dataset[start:stop]
    return values


def _read_chunks(values: NDArray, dataset: h5py.Dataset, start: int, stop: int, offset: int = 0) -> bool:
    """Fill `values` with the entries start..stop plus `offset`, chunk by chunk, faster than the library.

    False where packing or chunks are of another kind, or damaged: the library reads them or says what is wrong.
    """
    kind, size = dataset.dtype, dataset.dtype.itemsize
    length = dataset.chunks[0] if dataset.chunks else 0
    is_whole = length and start % length == 0 and (stop % length == 0 or stop == dataset.shape[0])
    if not is_whole or length < _FEWEST or size > 8 or kind.kind not in "iuf" or kind.byteorder == ">":
        return False
    bits = values.view(f"u{values.itemsize}")
    plan = dataset.id.get_create_plist()
    filters = tuple(plan.get_filter(place)[0] for place in range(plan.get_nfilters()))
    if filters not in _PACKINGS or (size > 1 and _SHUFFLE not in filters):
        return False
    for first in range(start, stop, length):
        try:
            mask, packed = dataset.id.read_direct_chunk((first,))
            data = b"" if mask else _unpack(packed, _SUM in filters, size * length)
        except (*_H5_ERRORS, zlib.error):
            return False
        if len(data) != size * length:
            return False
        planes = np.frombuffer(data, np.uint8).reshape(size, length)
        _join_planes(planes, offset, bits[first - start : min(first + length, stop) - start])
    return True


def _unpack(packed: bytes, is_summed: bool, size: int) -> bytes:
    """Return what deflate made `packed` of; empty where a sum differs or where it is not `size` bytes."""
    wrapper = zlib.MAX_WBITS
    if is_summed:
        packed, sums = packed[:-4], tuple(np.frombuffer(packed[-4:], "<u2") % 65_535)
        if sums != _fletcher(np.frombuffer(packed, np.uint8)) or packed[:1] != b"x" or packed[1] & 32:
            return b""
        packed, wrapper = packed[2:], -zlib.MAX_WBITS  # one sum will do: zlib's takes a seventh of the time
    unpacker = zlib.decompressobj(wrapper)
    data = unpacker.decompress(packed, size + 1)
    return data if unpacker.eof and len(data) == size else b""


@njit(cache=True)
def _fletcher(data):
    """Return both parts of HDF5's Fletcher-32 sum: words of 16 bits, high byte first, modulo 65535."""
    total, weighted, pairs = np.uint64(0), np.uint64(0), len(data) // 2
    for first in range(0, pairs, 4096):
        block = data[2 * first : 2 * min(first + 4096, pairs)]
        size, before = np.uint64(len(block) // 2), total
        for index in range(len(block) // 2):
            word = np.uint64(block[2 * index]) << np.uint64(8) | np.uint64(block[2 * index + 1])
            total += word
            weighted += word * (size - np.uint64(index))
        weighted, total = (weighted + size * before) % np.uint64(65_535), total % np.uint64(65_535)
    if len(data) % 2:
        total = (total + (np.uint64(data[-1]) << np.uint64(8))) % np.uint64(65_535)
        weighted = (weighted + total) % np.uint64(65_535)
    return total, weighted


@njit(cache=True)
def _join_planes(planes, offset, values):
    """Undo HDF5's shuffle: planes[k] are the bytes k of all entries, the lowest first; 4 bytes get `offset`."""
    if len(planes) == 1:
        values[:] = planes[0, : len(values)]
    elif len(planes) == 2:
        low, high = planes[0], planes[1]
        for index in range(len(values)):
            values[index] = np.uint16(low[index]) | np.uint16(high[index]) << np.uint16(8)
    elif len(planes) == 4:
        a, b, c, d = planes[0], planes[1], planes[2], planes[3]
        for index in range(len(values)):
            low_half = np.uint32(a[index]) | np.uint32(b[index]) << np.uint32(8)
            high_half = np.uint32(c[index]) | np.uint32(d[index]) << np.uint32(8)
            values[index] = offset + np.int64(low_half | high_half << np.uint32(16))
    else:
        for index in range(len(values)):
            value = np.uint64(0)
            for place in range(len(planes)):
                value |= np.uint64(planes[place, index]) << np.uint64(8 * place)
            values[index] = value


@njit(cache=True)
def _widen(narrow, offset, times):
    """Fill `times` with narrow + offset; `narrow` may be its upper half, as entries are used before that."""
    for index in range(len(times)):
        times[index] = np.int64(narrow[index]) + offset


def _stored_at(dataset: h5py.Dataset, number: int) -> int:
    """Return the byte of the file where the chunk with entry `number` starts."""
    if dataset.chunks is None:
        return (dataset.id.get_offset() or 0) + number * dataset.dtype.itemsize
    start = number // dataset.chunks[0] * dataset.chunks[0]
    return dataset.id.get_chunk_info_by_coord((start,)).byte_offset or 0
