"""HDF5 with the columns of DSEC (events/x, y, t, p) and an index of milliseconds; chunks have checksums."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.io.columns import ColumnCheck, Columns
from evnlos.events.io.report import ReadReport, unreadable
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
