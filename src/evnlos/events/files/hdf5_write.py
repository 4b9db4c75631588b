"""Writing HDF5 with the columns of DSEC piece by piece; all metadata and chunks carry checksums."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from evnlos.machine import undisturbed
from evnlos.types import Events

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
