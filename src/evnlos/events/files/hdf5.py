"""HDF5 with the columns of DSEC (events/x, y, t, p) and an index of milliseconds; chunks have checksums.

- Writing HDF5 with the columns of DSEC piece by piece; all metadata and chunks carry checksums.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.files.columns import ColumnCheck, Columns, ReadReport, unreadable
from evnlos.threads import undisturbed
from evnlos.types import Events
from evnlos.untrusted import ElsewhereError, check_memory, open_hdf5, stored

SIGNATURE = b"\x89HDF\r\n\x1a\n"
_MAX_RATIO = 1100  # deflate and lzf shrink a chunk at most that much
_MOST_CHUNK_BYTES = 1 << 26
_NAMES = {"t_us": "t", "x": "x", "y": "y", "p": "p"}
_EVENT_BYTES = 26  # of an event as columns, and as what is stored
_OPTIONAL = ("adc", "polarity_known")
_H5_ERRORS = (
    OSError,
    RuntimeError,
    KeyError,
    ValueError,
    TypeError,
    AttributeError,
    OverflowError,
    MemoryError,
)
_CURE = "the file is damaged or not complete: copy it again"


@contextmanager
def _h5_errors(path: Path) -> Iterator[None]:
    """Turn whatever h5py raises on damage into one error."""
    try:
        yield
    except (
        OSError,
        RuntimeError,
        KeyError,
        ValueError,
        TypeError,
        AttributeError,
        OverflowError,
        MemoryError,
    ) as error:
        found = " ".join(str(error).split())[:160]
        if "filter" in found.lower() and ("plugin" in found.lower() or "not available" in found.lower()):
            cure = "install hdf5plugin, or export it uncompressed (ECF: convert with the camera maker's tools)"
        elif isinstance(error, ElsewhereError):
            cure = "write the columns into the file itself"
        else:
            cure = _CURE
        raise unreadable(path, 0, f"HDF5 cannot read it ({found})", cure) from None


class Hdf5Source:
    """An open HDF5 file of events."""

    def __init__(self, path: Path, report: ReadReport, width: int | None, height: int | None) -> None:
        self.path, self.report = path, report
        report.format = "HDF5"
        self._chunk_bytes = 0
        with _h5_errors(path), open_hdf5(path) as file:
            self._count = self._check_layout(file)
            self._t_offset = self._offset(file)
            self._geometry(file, width, height)

    def _datasets(self, file: h5py.File) -> dict[str, h5py.Dataset]:
        group = stored(file, "events")
        if not isinstance(group, h5py.Group):
            if isinstance(stored(file, "CD"), h5py.Group):
                raise unreadable(
                    self.path,
                    0,
                    "Prophesee's HDF5 (group CD, ECF codec)",
                    "convert it to RAW with the camera maker's tools",
                )
            raise unreadable(
                self.path, 0, "an HDF5 file without a group 'events'", "DSEC columns events/{x,y,t,p} are read"
            )
        datasets = {name: stored(group, key) for name, key in _NAMES.items()}
        datasets |= {name: stored(group, name) for name in _OPTIONAL if name in group}
        for name, dataset in datasets.items():
            if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1 or dataset.dtype.kind not in "iub":
                raise unreadable(
                    self.path, 0, f"events/{_NAMES.get(name, name)} is not a 1-D column of integers", _CURE
                )
        return datasets  # type: ignore[return-value]

    def _check_layout(self, file: h5py.File) -> int:
        """Return the number of events; refuse sizes that the stored bytes cannot hold before allocating."""
        lengths = {}
        for name, dataset in self._datasets(file).items():
            lengths[name] = int(dataset.shape[0])
            stored = dataset.id.get_storage_size()
            need = lengths[name] * dataset.dtype.itemsize
            chunk = dataset.chunks[0] * dataset.dtype.itemsize if dataset.chunks is not None else 0
            self._chunk_bytes = max(self._chunk_bytes, chunk)
            if chunk > _MOST_CHUNK_BYTES:
                found = f"events/{_NAMES.get(name, name)} has chunks of {chunk / 1e6:.0f} MB"
                raise unreadable(self.path, 0, found, "write it in smaller ones (h5repack -l CHUNK=65536)")
            missing = (
                dataset.chunks is not None and dataset.id.get_num_chunks() * dataset.chunks[0] < lengths[name]
            )
            if missing or need > stored * _MAX_RATIO:
                raise unreadable(
                    self.path,
                    0,
                    f"events/{_NAMES.get(name, name)} announces {need} bytes, {stored} are stored",
                    _CURE,
                )
        if len(set(lengths.values())) != 1:
            raise unreadable(self.path, 0, f"columns of unequal length {lengths}", _CURE)
        return lengths["t_us"]

    def _offset(self, file: h5py.File) -> int:
        for place in ("t_offset", "events/t_offset"):
            dataset = stored(file, place)
            if isinstance(dataset, h5py.Dataset) and dataset.size == 1 and dataset.dtype.kind in "iu":
                return int(dataset[()].item())
            if dataset is not None:
                raise unreadable(self.path, 0, f"{place} is no whole number", _CURE)
        return 0

    def _geometry(self, file: h5py.File, width: int | None, height: int | None) -> None:
        if width is not None:
            return self.report.set_geometry(width, height, "caller")
        for holder in (stored(file, "events"), file):
            if holder is not None and "width" in holder.attrs and "height" in holder.attrs:
                return self.report.set_geometry(holder.attrs["width"], holder.attrs["height"], "header")
        largest = {"x": 0, "y": 0}
        datasets = self._datasets(file)
        for start in range(0, self._count, 1 << 20):
            for name in largest:
                largest[name] = max(largest[name], int(datasets[name][start : start + (1 << 20)].max()))
        return self.report.set_geometry(largest["x"] + 1, largest["y"] + 1, "events")

    def _entries(self, name: str, dataset: h5py.Dataset, start: int, stop: int) -> NDArray:
        """Return entries in their type; narrow times are read into half of the column that they then fill."""
        count = stop - start
        fits = -(2**63) <= self._t_offset < 2**63 - 2**32
        if name == "t_us" and dataset.dtype == np.uint32 and fits:
            times = np.empty(count, np.int64)
            narrow = times.view(np.uint32)[count:]
            _read_into(narrow, dataset, start, stop)
            _widen(narrow, self._t_offset, times)
            return times
        values = np.empty(count, dataset.dtype)
        _read_into(values, dataset, start, stop)
        return self._column(name, values)

    def _column(self, name: str, values: NDArray) -> NDArray:
        if name in ("p", "polarity_known"):
            if values.dtype == np.bool_:
                return values
            least = 0 if values.dtype.kind == "u" or not values.size else int(values.min())
            if least < -1 or (values.size and int(values.max()) > 1):
                raise unreadable(self.path, 0, "events/p holds more than 0/1 or -1/+1", _CURE)
            return values.view(np.bool_) if values.dtype == np.uint8 else values > 0
        if name != "t_us":
            if values.dtype != np.uint16 and values.size:
                self._refuse_outside(name, values, 0, 65_535)
            return values.astype(np.uint16, copy=False)
        if not self._t_offset or not values.size:
            self._refuse_outside(name, values, -(2**63), 2**63 - 1)
            return values.astype(np.int64, copy=False)
        self._refuse_outside(name, values, -(2**63) - self._t_offset, 2**63 - 1 - self._t_offset)
        return np.add(values, self._t_offset, dtype=np.int64)

    def _refuse_outside(self, name: str, values: NDArray, low: int, high: int) -> None:
        info = np.iinfo(values.dtype) if values.dtype != np.bool_ else None
        if info is None or not values.size or (low <= info.min and info.max <= high):
            return  # whatever the column holds, it is inside
        if not (low <= int(values.min()) and int(values.max()) <= high):
            raise unreadable(self.path, 0, f"events/{_NAMES.get(name, name)} leaves {low}..{high}", _CURE)

    def blocks(self, size: int = 1 << 17) -> Iterator[Columns]:
        """Yield columns of at most `size` events."""
        with _h5_errors(self.path), open_hdf5(self.path, self._chunk_bytes) as file:
            datasets = self._datasets(file)
            check = ColumnCheck(self.report, lambda number: _stored_at(datasets["t_us"], number))
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


def _read_into(values: NDArray, dataset: h5py.Dataset, start: int, stop: int) -> None:
    """Read the entries start..stop; for a whole column the library need not work out what is chosen."""
    if start == 0 and stop == dataset.shape[0] and stop:
        dataset.read_direct(values)
    else:
        values[:] = dataset[start:stop]


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


_CHUNK = 65_536
_MAX_INDEX_MS = 1 << 24  # 4.7 hours; a longer index would be larger than the events of a sparse recording
_PACKED = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}


class _Storage:
    """The file beneath HDF5, for which every write succeeds.

    The library can't give up a file that it failed to write: it tries again at every close, at last when the
    process ends, and crashes there. So the first failure is kept for the sink to raise, and no more is written.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb+", buffering=0)
        self.failure: OSError | None = None
        self.read, self.readinto = self._file.read, self._file.readinto
        self.seek, self.tell, self.flush = self._file.seek, self._file.tell, self._file.flush

    def write(self, content: memoryview) -> int:
        """Write all of it, or note why not."""
        left = memoryview(content).cast("B")
        try:
            while len(left) and self.failure is None:
                left = left[self._file.write(left) :]
        except OSError as error:
            self.failure = error
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        """Set the file's size, or note why not."""
        try:
            return self._file.truncate(size)
        except OSError as error:
            self.failure = self.failure or error
            return size or 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Hdf5Sink:
    """An HDF5 file that grows: columns events/{x, y, t, p}, `ms_to_idx` and `t_offset`."""

    def __init__(self, path: Path, first: Events) -> None:
        start = int(first.t_us[0]) if len(first) else 0
        self._wide = first.duration_us >= 2**32 or not -(2**62) < start < 2**62
        self._t_offset = 0 if self._wide else start
        self._events, self._last = 0, 0
        self._storage = _Storage(path)
        with undisturbed():
            self._file = h5py.File(self._storage, "w", libver=("v110", "v110"))
            self._group = self._file.create_group("events")
            self._group.attrs["width"], self._group.attrs["height"] = first.width, first.height
        self._columns: dict[str, h5py.Dataset] = {}
        self._index: h5py.Dataset | None = None

    def append(self, events: Events) -> None:
        """Write a piece; the first decides how large a chunk is."""
        with self._told():
            self._append(events)

    def _append(self, events: Events) -> None:
        if len(events) and not self._wide and int(events.t_us[-1]) - self._t_offset >= 2**32:
            self._widen()
        # A difference of 64 bits: times that are far apart do not fit the narrow column, and are wide already.
        t_us = events.t_us if self._wide else (events.t_us - self._t_offset).astype(np.uint32)
        columns = {"x": events.x, "y": events.y, "t": t_us, "p": events.p.astype(np.uint8)}
        for name in ("adc", "polarity_known"):
            column = getattr(events, name)
            if column is not None:
                columns[name] = column.astype(np.uint8 if column.dtype == np.bool_ else column.dtype)
        for name, column in columns.items():
            if name not in self._columns:
                self._columns[name] = _create(self._group, name, column.dtype, len(column))
            _extend(self._columns[name], column)
        if len(events) and not self._wide:
            self._extend_index(t_us)
        self._events += len(events)

    def _extend_index(self, t_us: NDArray) -> None:
        """Note the index of the first event not earlier than each millisecond after `t_offset`."""
        known = 0 if self._index is None else len(self._index)
        self._last = int(t_us[-1]) // 1000
        if self._last >= _MAX_INDEX_MS:
            return
        starts = np.searchsorted(t_us, np.arange(known, self._last + 1, dtype=np.int64) * 1000)
        indices = starts.astype(np.uint64) + np.uint64(self._events)
        if self._index is None:
            self._index = _create(self._file, "ms_to_idx", indices.dtype, len(indices) + 1)
        _extend(self._index, indices)

    def _widen(self) -> None:
        """Put times of 64 bits in place of those of 32, which hold 71 minutes."""
        self._wide = True
        if "t" in self._columns:
            narrow = self._columns["t"]
            wide = _create(self._group, "t_wide", np.dtype(np.int64), _CHUNK)
            for start in range(0, len(narrow), _CHUNK):
                _extend(wide, narrow[start : start + _CHUNK].astype(np.int64) + self._t_offset)
            del self._group["t"]
            self._group.move("t_wide", "t")
            self._columns["t"] = wide
        if self._index is not None:
            del self._file["ms_to_idx"]
            self._index = None
        self._t_offset = 0

    def finish(self) -> None:
        """Complete the index and the offset."""
        with self._told():
            self._complete()
            self._file.close()  # here: what the library cannot write is an error before the file gets its name

    def _complete(self) -> None:
        if self._index is not None and self._last >= _MAX_INDEX_MS:
            del self._file["ms_to_idx"]
        elif not self._wide:
            if self._index is None:
                self._index = _create(self._file, "ms_to_idx", np.dtype(np.uint64), 2)
            missing = self._last + 2 - len(self._index)
            _extend(self._index, np.full(missing, self._events, np.uint64))
        _put_compact(self._file, "t_offset", self._t_offset)

    def close(self) -> None:
        """Close the file."""
        with undisturbed():
            self._file.close()
        self._storage.close()

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Raise what the storage noted, also where the library stumbles over what was not written."""
        try:
            with undisturbed():
                yield
        finally:
            if self._storage.failure is not None:
                raise self._storage.failure


def _create(group: h5py.Group, name: str, dtype: np.dtype, expected: int) -> h5py.Dataset:
    chunk = (max(1, min(_CHUNK, expected)),)
    return group.create_dataset(name, (0,), dtype, chunks=chunk, maxshape=(None,), **_PACKED)


def _extend(dataset: h5py.Dataset, values: NDArray) -> None:
    count = len(dataset)
    dataset.resize(count + len(values), axis=0)
    dataset[count:] = values


def _put_compact(file: h5py.File, name: str, value: int) -> None:
    """Store one number inside the object header, which has a checksum; a plain scalar has none."""
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_layout(h5py.h5d.COMPACT)
    layout.set_obj_track_times(False)  # the same events give the same bytes
    space = h5py.h5s.create(h5py.h5s.SCALAR)
    dataset = h5py.h5d.create(file.id, name.encode(), h5py.h5t.NATIVE_INT64, space, layout)
    dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, np.array(value, np.int64))
