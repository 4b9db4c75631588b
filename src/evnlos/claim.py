"""One run at a time in a folder: a lock that the system releases when its holder dies."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from evnlos.errors import DataError

LOCK = ".lock"
"""Name of the lock file in a folder; it may stay there, only a live process holds it."""


@contextmanager
def claim(folder: str | Path, part: str = "") -> Iterator[Path]:
    """Hold a folder for this process; make it where it is not there yet.

    Args:
        folder: The folder to work in.
        part: Name of the share of the work, for several processes that each do another share ("3-of-16").

    Raises:
        DataError: Another process holds it.
    """
    from filelock import FileLock, Timeout

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    name = f"{LOCK}-{part}" if part else LOCK
    try:
        with FileLock(folder / name, timeout=0):
            if not part:
                _sweep(folder)
            yield folder
    except Timeout:
        raise DataError(
            f"another process is at work in {folder}; wait for it to end, or give another --out"
        ) from None


def is_empty(folder: str | Path) -> bool:
    """Return whether a folder holds nothing but locks, or is not there."""
    folder = Path(folder)
    return not folder.is_dir() or all(path.name.startswith(LOCK) for path in folder.iterdir())


def check_folder(folder: str | Path) -> None:
    """Refuse a folder for results that is not new or empty.

    Raises:
        DataError: It holds something, or is a file.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DataError(f"{folder} is not an empty folder; give a new one with --out")


def _sweep(folder: Path) -> None:
    """Remove half-written files of a process that was killed: whoever holds the whole folder may."""
    for path in folder.glob(".*.tmp"):
        path.unlink(missing_ok=True)
