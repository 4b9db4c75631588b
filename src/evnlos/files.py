"""Files and folders that are whole or not there, and one run at a time in a folder, whatever dies."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from os import PathLike
from pathlib import Path

from evnlos.errors import DataError

LOCK = ".lock"
"""How the names of lock files in a folder begin; they may stay there, only a live process holds one."""

_HOST = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())[:40] or "-"
_UNFINISHED = re.compile(r"\.(?P<name>.+)\.(?P<host>[\w-]+)\.(?P<owner>[0-9]+)\.[0-9a-f]{8}\.part", re.S | re.A)
_swept: set[Path] = set()  # folders in which this process has looked for what dead ones left


def write_atomically(path: str | PathLike[str], content: bytes) -> None:
    """Write a file so that a reader sees either all of it or nothing: temporary file, fsync, rename.

    Raises:
        DataError: The name is that of a folder, a device or a pipe.
        OSError: The content can't be written; no file is left.
    """
    path = Path(path)
    folder = path.parent.absolute()
    if folder not in _swept:
        _swept.add(folder)
        _sweep(folder)
    with _in_place_of(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def new_file(path: str | PathLike[str]) -> Iterator[Path]:
    """Give a temporary name beside `path` to write under; the file takes the name of `path` when all went well.

    It is on the disk before it does. Leaving the block by an error leaves no file; what a process left that was
    killed goes when a file is begun in the same folder.

    Args:
        path: The file to write; an existing one is replaced.

    Raises:
        DataError: The name is that of a folder, a device or a pipe.
        OSError: The file can't be written; none is left.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.txt"
        >>> with new_file(path) as temporary:
        ...     _ = temporary.write_text("whole")
        >>> path.read_text(), len(list(path.parent.iterdir()))
        ('whole', 1)
    """
    _sweep(Path(path).parent)
    with _in_place_of(Path(path)) as temporary:
        yield temporary


@contextmanager
def new_folder(path: str | PathLike[str]) -> Iterator[Path]:
    """Give a temporary folder to write in, which takes the name of `path` when all went well.

    Leaving the block by an error leaves nothing; what a process left that was killed goes with the next one. A
    second process with the same `path` is refused as long as the first is at work.

    Args:
        path: The folder to make; it may be there, and empty.

    Raises:
        DataError: The folder holds something, or another process is at work in it.
        OSError: It can't be made.
    """
    path = Path(path).absolute()
    check_folder(path)
    if path.is_dir():
        with _held(path, _busy(path)):
            yield from _filled(path)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep(path.parent)
    if any(_unfinished_of(name, path.name) for name in [entry.name for entry in path.parent.iterdir()]):
        raise DataError(_busy(path))
    draft = path.with_name(_unfinished(path.name))
    try:
        draft.mkdir()
        yield draft
        _synchronise(draft)
        check_folder(path)
        try:
            draft.rename(path)
        except OSError:
            check_folder(path)  # another process was quicker by less than the check before
            raise
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise


def _filled(path: Path) -> Iterator[Path]:
    """Fill a folder that is there, empty: it may be a disk of its own, or have other rights than a new one."""
    _sweep(path, whole=True)
    draft = path / _unfinished(path.name)
    done: list[Path] = []
    try:
        draft.mkdir()
        yield draft
        _synchronise(draft)
        check_folder(path)
        for item in draft.iterdir():
            done.append(path / item.name)
            item.rename(path / item.name)
        draft.rmdir()
    except BaseException:
        for item in (draft, *done):
            shutil.rmtree(item, ignore_errors=True) if item.is_dir() else item.unlink(missing_ok=True)
        raise


def is_empty(folder: str | Path) -> bool:
    """Return whether a folder holds nothing but locks and unfinished files, or is not there."""
    folder = Path(folder)
    return not folder.exists() or (
        folder.is_dir() and all(_is_lock(path) or _UNFINISHED.fullmatch(path.name) for path in folder.iterdir())
    )


def _is_lock(path: Path) -> bool:
    """Return whether a file is a lock of ours: taking it changes nothing, as nothing is in it."""
    return path.name.startswith(LOCK) and path.is_file() and path.stat().st_size == 0


def check_folder(folder: str | Path) -> None:
    """Refuse a folder for results that is not new or empty.

    Raises:
        DataError: It holds something, or is a file.
    """
    folder = Path(folder)
    if (folder.is_symlink() and not folder.exists()) or not is_empty(folder):
        raise DataError(f"{folder} is not an empty folder; give a new one with --out")


@contextmanager
def directory_lock(
    folder: str | Path, part: str = "", *, check: Callable[[], object] | None = None
) -> Iterator[Path]:
    """Hold a folder for this process; make it where it is not there yet.

    Whoever holds the whole of it removes unfinished files of processes that were killed. Processes that hold
    parts don't exclude each other, but one that wants the whole; where the system has no shared locks
    (Windows), only those of the same part exclude each other.

    Args:
        folder: The folder to work in.
        part: Name of the share of the work, for several processes that each do another share ("3-of-16").
        check: Raises where the folder holds something else; then nothing in it is made, changed or removed.

    Raises:
        DataError: Another process holds it.
    """
    folder = Path(folder)
    if check is not None and not _is_lock(folder / LOCK):
        check()
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as held:
        held.enter_context(_held(folder / LOCK, _busy(folder), is_shared=bool(part)))
        if part:
            held.enter_context(_held(folder / f"{LOCK}-{part}", _busy(folder)))
        if check is not None:
            check()  # again: another process may have begun its own work meanwhile
        if not part:
            _sweep(folder, whole=True)
        yield folder


def _busy(folder: Path) -> str:
    return f"another process is at work in {folder}; wait for it to end, or give another --out"


@contextmanager
def _held(path: Path, busy: str, *, is_shared: bool = False) -> Iterator[None]:
    """Hold a lock on a file or folder, which the system releases when this process dies.

    Raises:
        DataError: Another process holds it; the text is `busy`.
    """
    try:
        import fcntl
    except ImportError:
        with _held_elsewhere(path, busy, is_shared):
            yield
        return
    is_folder = path.is_dir()
    handle = os.open(path, os.O_RDONLY if is_folder else os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    try:
        try:
            fcntl.flock(handle, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DataError(busy) from None
        except OSError:
            if not is_folder:  # file systems of a network may lock files alone
                raise
        yield
    finally:
        os.close(handle)


@contextmanager
def _held_elsewhere(path: Path, busy: str, is_shared: bool) -> Iterator[None]:
    """Hold a lock where there is no `flock`: on a file alone, and never shared."""
    from filelock import FileLock, Timeout

    if is_shared or path.is_dir():
        yield
        return
    try:
        with FileLock(path, timeout=0):
            yield
    except Timeout:
        raise DataError(busy) from None


@contextmanager
def _in_place_of(path: Path) -> Iterator[Path]:
    if path.exists() and not path.is_file():
        raise DataError(f"{path} is no plain file but a folder, device or pipe; give the name of a file")
    temporary = path.with_name(_unfinished(path.name))
    try:
        yield temporary
        _synchronise(temporary)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _synchronise(path: Path) -> None:
    """Wait until a file, or all in a folder, is on the disk: some systems tell only then that it is full."""
    for file in path.rglob("*") if path.is_dir() else (path,):
        if file.is_file():
            handle = os.open(file, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)


def _unfinished(name: str) -> str:
    """Return a new name for a file or folder that this process has not finished."""
    return f".{name[:40]}.{_HOST}.{os.getpid()}.{secrets.token_hex(4)}.part"


def _unfinished_of(found: str, name: str) -> bool:
    """Return whether a file's name is that of an unfinished `name` of this machine."""
    match = _UNFINISHED.fullmatch(found)
    return bool(match) and match["name"] == name[:40] and match["host"] == _HOST


def _sweep(folder: Path, *, whole: bool = False) -> None:
    """Remove what dead processes of this machine left unfinished in a folder, or of any if it is held whole.

    Whether a process of another machine lives can't be asked; who holds a folder whole knows that none does.
    """
    if os.name != "posix":  # elsewhere asking whether a process lives may end it
        return
    with suppress(OSError):
        for found in [entry for entry in os.scandir(folder) if entry.name.endswith(".part")]:
            match = _UNFINISHED.fullmatch(found.name)
            if not match or (_is_alive(int(match["owner"])) if match["host"] == _HOST else not whole):
                continue
            remove: Callable[..., None] = shutil.rmtree if found.is_dir(follow_symlinks=False) else os.unlink
            with suppress(OSError):
                remove(found.path)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # another user's, or no number of a process of ours
        pass
    return True
