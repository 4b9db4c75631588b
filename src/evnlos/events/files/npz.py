"""NPZ: the columns of `Events` as arrays of a zip archive, whose members carry checksums."""

from __future__ import annotations

import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

import numpy as np

from evnlos.events.files.columns import DTYPES, MOST_DEFLATED, ColumnCheck, Columns, ReadReport, unreadable
from evnlos.types import Events
from evnlos.untrusted import NUMPY_ERRORS, check_memory

SIGNATURE = b"PK\x03\x04"
_CURE = "the file is damaged or not complete: copy it again"
_REQUIRED = ("t_us", "x", "y", "p")
_OPTIONAL = ("adc", "polarity_known")
_ALIASES = {"t": "t_us"}
_LEVEL = 1  # of deflate: a fifth of the time of 6, and files of sensors are 8 to 18 % larger
_EVENT_BYTES = 39  # of an event as columns, as what is stored, and as bytes that are read


@contextmanager
def _zip_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except NUMPY_ERRORS as error:
        found = " ".join(str(error).split())[:160]
        raise unreadable(path, 0, f"NPZ cannot be read ({found})", _CURE) from None


class _Member:
    """One array of the archive, read from its start to its end."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, stack: ExitStack) -> None:
        self.path, self.name = path, info.filename.removesuffix(".npy")
        self._file: IO[bytes] = stack.enter_context(archive.open(info))
        version = np.lib.format.read_magic(self._file)
        if version != (1, 0):  # headers of the others may be gigabytes long, and no column needs one
            raise unreadable(path, info.header_offset, f"array {self.name} is of NPY version {version}", _CURE)
        self.shape, fortran, self.dtype = np.lib.format.read_array_header_1_0(self._file)
        size = int(np.prod(self.shape, dtype=object)) * self.dtype.itemsize
        if self.dtype.hasobject or self.dtype.kind not in "iub" or (fortran and len(self.shape) > 1):
            raise unreadable(
                path,
                info.header_offset,
                f"array {self.name} has dtype {self.dtype}",
                "give whole numbers, times in microseconds",
            )
        if (
            self._file.tell() + size != info.file_size
            or info.file_size > MOST_DEFLATED * info.compress_size + 4096
        ):
            raise unreadable(path, info.header_offset, f"array {self.name} announces {size} bytes", _CURE)

    def take(self, count: int) -> np.ndarray:
        """Return the next `count` entries."""
        data = self._file.read(count * self.dtype.itemsize)
        if len(data) != count * self.dtype.itemsize:
            raise unreadable(self.path, 0, f"array {self.name} ends early", _CURE)
        return np.frombuffer(bytearray(data), self.dtype)  # a writable copy: torch refuses others

    def close(self) -> None:
        """Read to the end, where the checksum is compared."""
        if self._file.read(1):
            raise unreadable(self.path, 0, f"array {self.name} is longer than it says", _CURE)
        self._file.close()


class NpzSource:
    """An NPZ file of events: arrays t_us (or t), x, y, p, width, height, and the optional columns."""

    def __init__(self, path: Path, report: ReadReport, width: int | None, height: int | None) -> None:
        self.path, self.report = path, report
        report.format = "NPZ"
        with _zip_errors(path), ExitStack() as stack:
            archive = stack.enter_context(zipfile.ZipFile(path))
            infos = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            self._infos = {_ALIASES.get(name, name): info for name, info in infos.items()}
            missing = [name for name in _REQUIRED if name not in self._infos]
            if missing:
                raise unreadable(
                    path, 0, f"an NPZ file without {', '.join(missing)}", "arrays t_us, x, y, p are read"
                )
            self._names = [name for name in (*_REQUIRED, *_OPTIONAL) if name in self._infos]
            members = {name: _Member(path, archive, self._infos[name], stack) for name in self._names}
            shapes = {name: member.shape for name, member in members.items()}
            if len(set(shapes.values())) != 1 or len(shapes["t_us"]) != 1:
                raise unreadable(path, 0, f"columns of shapes {shapes}", _CURE)
            self._count = int(shapes["t_us"][0])
            self._geometry(archive, stack, width, height)

    def _geometry(
        self, archive: zipfile.ZipFile, stack: ExitStack, width: int | None, height: int | None
    ) -> None:
        if width is not None:
            return self.report.set_geometry(width, height, "caller")
        if "width" in self._infos and "height" in self._infos:
            sides = []
            for name in ("width", "height"):
                member = _Member(self.path, archive, self._infos[name], stack)
                if int(np.prod(member.shape, dtype=object)) != 1:
                    raise unreadable(
                        self.path, 0, f"{name} of shape {member.shape}", "one number belongs there"
                    )
                sides.append(int(member.take(1)[0]))
                member.close()
            return self.report.set_geometry(sides[0], sides[1], "header")
        sides = []
        for name in ("x", "y"):
            member, largest, left = _Member(self.path, archive, self._infos[name], stack), 0, self._count
            while left:
                largest = max(largest, int(member.take(min(left, 1 << 20)).max()))
                left -= min(left, 1 << 20)
            sides.append(largest + 1)
        return self.report.set_geometry(sides[0], sides[1], "events")

    def _convert(self, name: str, values: np.ndarray) -> np.ndarray:
        dtype = DTYPES[name]
        if values.dtype == dtype:
            return values
        if values.size:
            low, high = (-1, 1) if dtype == np.bool_ else (np.iinfo(dtype).min, np.iinfo(dtype).max)
            if int(values.min()) < low or int(values.max()) > high:
                raise unreadable(self.path, 0, f"array {name} leaves {low}..{high}", _CURE)
        return values > 0 if dtype == np.bool_ else values.astype(dtype)

    def blocks(self, size: int = 1 << 17) -> Iterator[Columns]:
        """Yield columns of at most `size` events."""
        check = ColumnCheck(self.report, lambda _: self._infos["t_us"].header_offset)
        with _zip_errors(self.path), ExitStack() as stack:
            archive = stack.enter_context(zipfile.ZipFile(self.path))
            members = {name: _Member(self.path, archive, self._infos[name], stack) for name in self._names}
            for start in range(0, self._count, size):
                count = min(size, self._count - start)
                block = {name: self._convert(name, member.take(count)) for name, member in members.items()}
                if start + count == self._count:
                    for member in members.values():
                        member.close()
                yield check(block)

    def read(self) -> Columns:
        """Return all events.

        Raises:
            DataError: They need more memory than there is.
        """
        check_memory(
            _EVENT_BYTES * self._count, f"{self.path}: {self._count:,} events", "cut it with evnlos convert"
        )
        return next(self.blocks(max(self._count, 1)), {})


class NpzSink:
    """Columns that wait in files without a name until the archive, one array after the other, is written."""

    def __init__(self, path: Path, first: Events) -> None:
        self._path, self._size = path, (first.width, first.height)
        self._events = 0
        self._held = {
            name: tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115 - closed in close
            for name in first.columns()
        }
        self._dtypes = {name: column.dtype for name, column in first.columns().items()}

    def append(self, events: Events) -> None:
        """Keep a piece."""
        for name, column in events.columns().items():
            self._held[name].write(column.tobytes())
        self._events += len(events)

    def finish(self) -> None:
        """Write the archive."""
        with zipfile.ZipFile(self._path, "w", zipfile.ZIP_DEFLATED, compresslevel=_LEVEL) as archive:
            for name, file in self._held.items():
                header = {"descr": self._dtypes[name].str, "fortran_order": False, "shape": (self._events,)}
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array_header_1_0(member, header)
                    file.seek(0)
                    shutil.copyfileobj(file, member, 1 << 20)
            for name, side in zip(("width", "height"), self._size, strict=True):
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, np.array(side))

    def close(self) -> None:
        """Give the files without a name back."""
        for file in self._held.values():
            file.close()
