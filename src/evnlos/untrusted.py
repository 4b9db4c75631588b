"""Opening files that may be a stranger's: plain files only, by lists of formats, and nothing beside the file.

An image named `.png` may be a program for Ghostscript, a video a playlist of films elsewhere, a column of an
HDF5 file the bytes of another file, and a name in a folder a pipe that never ends: all are opened here.
Requests that a page from elsewhere sends to a server of this machine are refused here.
"""

from __future__ import annotations

import errno
import ipaddress
import json
import os
import re
import stat
import struct
import subprocess
import sys
import tempfile
import threading
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Self, cast

from evnlos.errors import DataError, EvnlosError, absent

if TYPE_CHECKING:  # they are slow to import, and not every command needs them
    import h5py
    from PIL import Image

RASTER_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "GIF", "WEBP", "PPM")
"""Formats of images that are decoded, as Pillow names them; never PostScript, which is a program."""

CONTAINER_FORMATS = (
    "mov,mp4,m4a,3gp,3g2,mj2",
    "matroska,webm",
    "avi",
    "mpeg",
    "mpegts",
    "mpegvideo",
    "m4v",
    "h264",
    "hevc",
    "obu",
    "ivf",
    "flv",
    "asf",
    "ogg",
    "mxf",
    "nut",
    "dv",
    "mjpeg",
    "yuv4mpegpipe",
)
"""Video containers that are read, as FFmpeg names them; all hold their images themselves, no playlists."""


MOST_IMAGE_PIXELS = 1 << 26
"""Pixels of an image, at most: a small file can claim any number."""
MOST_SENSOR_PIXELS = 1 << 24
"""Pixels of a sensor whose pixels all get memory, at most; the largest event cameras have a quarter."""


_PILLOW_ERRORS = (
    ValueError, SyntaxError, TypeError, LookupError, ArithmeticError, AttributeError, EOFError, MemoryError,
    struct.error, zlib.error,
)  # fmt: skip
"""What Pillow raises on damage, besides OSError."""


NUMPY_ERRORS = (
    OSError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError, EOFError, RuntimeError,
    MemoryError, SyntaxError, struct.error, tokenize.TokenError, zlib.error, zipfile.BadZipFile,
    zipfile.LargeZipFile,
)  # fmt: skip
"""What NumPy raises on damaged arrays and archives."""


class ElsewhereError(ValueError):
    """A file's content lies, or may lie, in another file."""


def no_file(path: Path) -> str:
    """Return why a path that is not a regular file can't be read, and the cure."""
    if path.is_dir():
        return f"{path} is a folder; give a file in it"
    if path.exists():
        return f"{path} is not a regular file but a device or a pipe; copy it into a file first"
    return f"{absent(path)}; check the path"


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a plain file for reading; a pipe, device or folder is refused, and never waited for.

    Args:
        path: The file.

    Raises:
        OSError: It can't be opened, or is no plain file.
    """
    file = open(os.fspath(path), "rb", opener=_without_waiting)  # noqa: SIM115 - handed to the caller
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "no plain file but a pipe or a device", os.fspath(path))
    return cast(BinaryIO, file)


def _without_waiting(path: str, flags: int) -> int:
    """Open without waiting for the other end of a pipe."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


@contextmanager
def open_image(path: str | os.PathLike[str] | BinaryIO) -> Iterator[Image.Image]:
    """Yield an open image of one of `RASTER_FORMATS`, told by its content.

    Args:
        path: The file, or an open one.

    Raises:
        OSError: It can't be opened, is no plain file, no image of these formats, or has too many pixels.
    """
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # our own limit follows
        with ExitStack() as stack:
            file = stack.enter_context(open_regular(path)) if isinstance(path, (str, os.PathLike)) else path
            try:
                image = stack.enter_context(Image.open(file, formats=RASTER_FORMATS))
                width, height = image.size
                if width * height > MOST_IMAGE_PIXELS:
                    most = f"at most {MOST_IMAGE_PIXELS:,} are read"
                    raise OSError(f"it claims {width} x {height} pixels; {most}")
                yield image
            except _PILLOW_ERRORS as error:
                reason = " ".join(str(error).split())[:120] or type(error).__name__
                raise OSError(f"it is damaged, or larger than the memory ({reason})") from None


@contextmanager
def open_container(path: str | os.PathLike[str]) -> Iterator[Any]:
    """Yield an open video container (PyAV) of one of `CONTAINER_FORMATS`; FFmpeg opens no file by itself.

    Args:
        path: The file.

    Raises:
        OSError: It can't be opened, is no plain file, or no such container (`av.error.FFmpegError`).
        ValueError: FFmpeg is handed something that it does not take.
    """
    import av

    # Each of the three is enough today; should a later FFmpeg understand one otherwise, two are left.
    options = {"format_whitelist": ",".join(CONTAINER_FORMATS), "protocol_whitelist": "none"}
    with (
        open_regular(path) as file,
        av.open(file, container_options=options, io_open=_refuse_other) as container,
    ):
        yield container


def _refuse_other(url: str, flags: int, options: dict[str, str]) -> Any:
    raise PermissionError(errno.EACCES, "a video that names other files")


@contextmanager
def open_hdf5(path: str | os.PathLike[str], chunk_bytes: int = 1 << 20) -> Iterator[h5py.File]:
    """Yield an HDF5 file, open for reading. What is in it is reached through `stored` alone.

    Args:
        path: The file.
        chunk_bytes: Size of the largest chunk, bytes: it is unpacked once and not for every part of it.

    Raises:
        OSError: It can't be opened, is no plain file, or not HDF5.
    """
    import h5py

    with open_regular(path):
        pass
    with h5py.File(path, "r", rdcc_nbytes=max(chunk_bytes, 1 << 20)) as file:
        yield file


def stored(group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | None:
    """Return a group or dataset that lies in the file itself; None where there is none of that name.

    Args:
        group: Open file or group.
        name: Name below it; "a/b" goes through groups.

    Raises:
        ElsewhereError: A link leads there, or its values are those of other files (external storage) or of
            other datasets (virtual).
    """
    import h5py

    node: Any = group
    for part in name.split("/"):
        link = node.get(part, getlink=True) if isinstance(node, h5py.Group) else None
        if link is None:
            return None
        if not isinstance(link, h5py.HardLink):
            raise ElsewhereError(f"{name} is a link")
        node = node[part]
    if isinstance(node, h5py.Dataset) and (node.external or node.is_virtual):
        raise ElsewhereError(f"the values of {name} lie in other files or datasets")
    return node


def memory_left() -> int:
    """Return the bytes that this process can still take: what the machine has free and its limits leave."""
    left = [1 << 40]
    try:
        with open("/proc/meminfo", encoding="ascii") as file:  # noqa: PTH123 - not of Linux: no such file
            left += [int(line.split()[1]) << 10 for line in file if line.startswith("MemAvailable")]
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        left += [limit - _address_space()] if limit != resource.RLIM_INFINITY else []
    except (OSError, ValueError, ImportError):
        pass  # another system: arrays that are too large raise MemoryError there
    return max(min(left), 0)


def _address_space() -> int:
    """Return the bytes of address space that this process has; 0 on a system that does not say it."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:  # noqa: PTH123
            return int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def check_memory(needed: int, what: str, cure: str, most: int | None = None) -> None:
    """Refuse what would take more memory than there is, before anything is taken.

    Args:
        needed: Bytes.
        what: What needs them, the beginning of a sentence.
        cure: What to do about it.
        most: Bytes that may be taken; None = half of `memory_left`.

    Raises:
        DataError: It needs more.
    """
    most = memory_left() // 2 if most is None else most
    if needed > most:
        raise DataError(
            f"{what} needs {needed / 1e9:.1f} GB of memory; {most / 1e9:.1f} GB may be taken: {cure}"
        )


class Child:
    """A program of ours that reads a stranger's file in a process of its own, and is ended with the block.

    The program calls `limit_this_process` before it opens the file.

    Args:
        program: Its file.
        words: Its arguments.
        seconds: After so many it is ended, whatever it does; None = its own limits suffice.
    """

    def __init__(self, program: Path, words: list[str], seconds: float | None = None) -> None:
        known = os.pathsep.join(place for place in sys.path if place)
        threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed in __exit__
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(program), *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env=os.environ | threads | {"PYTHONPATH": known, "RUST_BACKTRACE": "0"},
        )
        assert self._process.stdout is not None
        self.stream = self._process.stdout
        self._seconds = seconds
        self._is_late = threading.Event()
        self._clock = None if seconds is None else threading.Timer(seconds, self._end_late)
        if self._clock is not None:
            self._clock.daemon = True
            self._clock.start()

    def _end_late(self) -> None:
        self._is_late.set()
        self._process.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._clock is not None:
            self._clock.cancel()
        self._process.kill()  # a reader may stop early
        self.stream.close()
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._process.wait()
        self._errors.close()

    def take(self, size: int) -> bytearray:
        """Return the next `size` bytes of its output."""
        data = bytearray(self.stream.read(size))
        if len(data) < size:
            raise self.failure(self._last_words())
        return data

    def take_json(self) -> Any:
        """Return the next line of its output, read as JSON."""
        line = self.stream.readline()
        if not line.endswith(b"\n"):
            raise self.failure(self._last_words())
        try:
            return json.loads(line)
        except ValueError:
            raise self.failure("it wrote no answer") from None

    def failure(self, found: str) -> EvnlosError:
        """Return the error of a program that ended too early, whose last words are `found`."""
        return DataError(f"it could not be read ({found})")

    def _last_words(self) -> str:
        code = self._process.wait()
        if self._is_late.is_set():
            return f"it took longer than {self._seconds:.0f} s"
        self._errors.seek(0)
        lines = self._errors.read(1 << 16).decode("utf-8", "replace").strip().splitlines()
        said = [line for line in lines if "Error" in line or "panicked" in line or "Exception" in line]
        ended = f"it ended with code {code}" if code >= 0 else f"it was ended by signal {-code}"
        return " ".join((said or lines or [ended])[-1].split())[:160]


def limit_this_process(memory_bytes: int, seconds: int) -> None:
    """Bound what this process takes from here on, and end it with the process that started it as a `Child`.

    Args:
        memory_bytes: Address space beyond what it has now.
        seconds: Processor time in all.
    """
    threading.Thread(target=_end_with_input, daemon=True).start()
    try:
        import resource
    except ImportError:  # a system without limits
        return
    space = _address_space() + memory_bytes
    wanted = {resource.RLIMIT_AS: space, resource.RLIMIT_CPU: seconds, resource.RLIMIT_CORE: 0}
    for kind, most in wanted.items():
        hard = resource.getrlimit(kind)[1]  # that of this process may only be lowered
        limit = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (limit, limit))


def _end_with_input() -> None:
    while os.read(0, 1 << 10):
        pass
    os._exit(1)


_HEADER = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^\s:\[\]@/]+)(?::\d+)?")


def is_local(host: str) -> bool:
    """Return whether a host is this machine itself, which nobody else can reach.

    Example:
        >>> is_local("127.0.0.1"), is_local("[::1]"), is_local("localhost"), is_local("0.0.0.0")
        (True, True, True, False)
    """
    try:
        return host.lower() == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def names_this_machine(header: str, own: str = "127.0.0.1") -> bool:
    """Return whether a request's Host header names this machine.

    A page from elsewhere may have made its own name lead here; its requests carry that name. The port says
    nothing more, and another one is what a forwarded port has.

    Args:
        header: The header, with or without a port.
        own: Further name that the server listens under.

    Example:
        >>> names_this_machine("localhost:8765"), names_this_machine("evil.example:8765")
        (True, False)
    """
    found = _HEADER.fullmatch(header)
    return found is not None and (is_local(found[1]) or found[1].lower() == own.lower())
