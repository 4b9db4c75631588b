"""Files and folders that are whole or not there, and one run at a time in a folder, whatever dies.

- Files from an address of the network or from a folder, each checked against the SHA-256 that a list states.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import IO

from evnlos.errors import DataError

LOCK = ".lock"
"""How the names of lock files in a folder begin; they may stay there, only a live process holds one."""

_HOST = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())[:40] or "-"
_UNFINISHED = re.compile(r"\.(?P<name>.+)\.(?P<host>[\w-]+)\.(?P<owner>[0-9]+)\.[0-9a-f]{8}\.part", re.S | re.A)
_swept: set[Path] = set()  # folders in which this process has looked for what dead ones left


def write_atomically(path: str | PathLike[str], content: bytes) -> None:
    """Write a file so that a reader sees either all of it or nothing; folders above it are made.

    Raises:
        DataError: The name is that of a folder, a device or a pipe.
        OSError: The content can't be written; no file is left.
    """
    if (folder := Path(path).parent.absolute()) not in _swept:
        _swept.add(folder)
        _sweep(folder)
    with _in_place_of(Path(path)) as temporary:
        temporary.write_bytes(content)


@contextmanager
def new_file(path: str | PathLike[str]) -> Iterator[Path]:
    """Give a temporary name beside `path` to write under; the file takes the name of `path` when all went well.

    It is on the disk before it does, in folders that are made. Leaving the block by an error leaves none; what
    a process left that was killed goes when a file is begun in the same folder.

    Args:
        path: The file to write; an existing one is replaced.

    Raises:
        DataError: The name is that of a folder, a device or a pipe.
        OSError: The file can't be written; none is left.
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
    check_folder(path := Path(path).absolute())
    if path.is_dir():
        with _held(path, _busy(path)):
            yield from _filled(path)
        return
    with _made(path.parent):
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


@contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Make a folder, with those above it; where the block fails, those that were made go again if empty."""
    made = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        with suppress(OSError):
            for one in made:
                one.rmdir()
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
    if not (folder := Path(folder)).exists():
        return True
    return folder.is_dir() and all(_is_lock(one) or _UNFINISHED.fullmatch(one.name) for one in folder.iterdir())


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
        raise DataError(f"{folder} is not an empty folder; give the name of a new one")


@contextmanager
def directory_lock(
    folder: str | Path, part: str = "", *, check: Callable[[], object] | None = None
) -> Iterator[Path]:
    """Hold a folder for this process; make it where it is not there, and take it away where nothing came.

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
    folder, lock = Path(folder), Path(folder) / LOCK
    if check is not None and not _is_lock(lock):
        check()
    is_new = not (part or lock.exists())
    with _made(folder), ExitStack() as held:
        held.enter_context(_held(lock, _busy(folder), is_shared=bool(part)))
        if part:
            held.enter_context(_held(folder / f"{LOCK}-{part}", _busy(folder)))
        try:
            if check is not None:
                check()  # again: another process may have begun its own work meanwhile
            if not part:
                _sweep(folder, whole=True)
            yield folder
        except BaseException:
            if is_new and [*folder.glob("*")] == [lock]:
                with suppress(OSError):  # a system may not let a file go that is open
                    lock.unlink()
            raise


def _busy(folder: Path) -> str:
    return f"another process is at work in {folder}; wait for it to end, or give another --out"


@contextmanager
def _held(path: Path, busy: str, *, is_shared: bool = False) -> Iterator[None]:
    """Hold a lock on a file or folder until this process ends; `DataError` of `busy` where another holds it."""
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
        if not path.exists():  # whoever held it has just taken it away
            raise DataError(busy)
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
    with _made(path.parent):
        try:
            yield temporary
            _synchronise(temporary)
            temporary.replace(path)
        except BaseException as error:
            with suppress(AttributeError):  # PyAV's errors keep theirs
                if isinstance(error, OSError) and error.filename == str(temporary):
                    error.filename = str(path)  # the name that a user knows
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


def _synchronise(path: Path) -> None:
    """Wait until a file, or all in a folder, is on the disk: some systems tell only then that it is full."""
    for file in path.rglob("*") if path.is_dir() else (path,):
        if file.is_file():
            with file.open("rb" if os.name == "posix" else "r+b") as handle:
                os.fsync(handle)


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


ADDRESSES: tuple[str, ...] = ()
"""Where published captures, weights and examples lie, the first that answers counts; none is public yet."""
ADDRESS_VARIABLE = "EVNLOS_DATA"  # addresses that come before those, separated by spaces; also folders
LIST = "SHA256SUMS"  # names the files of a published folder: a SHA-256 and a path below the folder a line
_MOST_LIST_BYTES, _ANSWER_S = 1 << 20, 20.0
_LINE = re.compile(r"([0-9a-f]{64})  (\S[^\\\0\r\n]*)", re.A)


def published_list(address: str, kind: str) -> dict[str, str]:
    """Return the files that an address offers, path below the folder -> SHA-256; downloads the list alone.

    Args:
        address: A URL (https://, http://) or a folder, with a folder for each kind below it.
        kind: "captures", "weights" or "examples".

    Raises:
        OSError: It can't be reached.
        DataError: The list is none, or names a file outside its folder.
    """
    with _opened(address, f"{kind}/{LIST}") as file:
        text = file.read(_MOST_LIST_BYTES + 1)
    lines = text.decode("utf-8", "replace").splitlines()
    found = {match[2]: match[1] for match in map(_LINE.fullmatch, lines) if match}
    if not found or len(found) != len(lines) or len(text) > _MOST_LIST_BYTES:
        raise DataError(f"{address}: {kind}/{LIST} is no list of files; give an address of published files")
    if outside := [name for name in found if ":" in name or {"", ".", ".."} & {*name.split("/")}]:
        raise DataError(f"{address}: {kind}/{LIST} names {outside[0][:80]!r}, outside its folder; don't use it")
    return dict(sorted(found.items()))


def fetch_file(address: str, kind: str, name: str, digest: str, out: Path, most_bytes: int) -> int:
    """Get one published file, and return its size in bytes; it is there as it was published, or not at all.

    Args:
        address: As for `published_list`.
        kind: Folder of the address.
        name: Path of the file below it, and below `out`.
        digest: SHA-256 that it must have.
        out: Folder for the files.
        most_bytes: A larger file is refused.

    Raises:
        OSError: The address can't be reached, or the file not be written.
        DataError: The file is another one, or too large.
    """
    size, found, what = 0, hashlib.sha256(), f"{kind}/{name}"
    with _opened(address, what) as source, new_file(out / name) as draft, draft.open("wb") as target:
        while block := source.read(1 << 20):
            size += len(block)
            if size > most_bytes:
                raise DataError(f"{name} is larger than {most_bytes / 1e9:g} GB; allow more with --most-gb")
            found.update(block)
            target.write(block)
        if found.hexdigest() != digest:
            other = f"SHA-256 {found.hexdigest()[:12]}..., not {digest[:12]}..."
            cure = "it was damaged or replaced: try again, or another address"
            raise DataError(f"{address}: {what} is not the listed file ({other}); {cure}")
    return size


def has_digest(path: Path, digest: str) -> bool:
    """Return whether a file is there and has a SHA-256."""
    return path.is_file() and _digest(path) == digest


def write_list(folder: Path) -> Path:
    """Write the list of a folder that is to be published, and return its path."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != LIST)
    lines = [f"{_digest(path)}  {path.relative_to(folder).as_posix()}\n" for path in paths]
    write_atomically(folder / LIST, "".join(lines).encode())
    return folder / LIST


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _opened(address: str, name: str) -> IO[bytes]:
    """Open a file below an address; nothing but http, https and plain folders is followed."""
    if "://" not in address:
        return (Path(address) / name).open("rb")
    if not address.lower().startswith(("http://", "https://")):
        raise DataError(f"{address} is no address of published files; give https://, http:// or a folder")
    from http.client import HTTPException
    from urllib.parse import quote
    from urllib.request import urlopen

    try:
        return urlopen(f"{address.rstrip('/')}/{quote(name)}", timeout=_ANSWER_S)
    except (HTTPException, ValueError) as error:
        raise DataError(f"{address} is no address ({error}); give https://HOST/PATH or a folder") from None
