"""Unpacking a stranger's zip: nothing leaves its folder, nothing is a link, and no stated size is believed."""

from __future__ import annotations

import stat
import zipfile
import zlib
from pathlib import Path, PurePosixPath, PureWindowsPath

from evnlos.errors import DataError

MOST_FILES = 5000
"""Files and folders of a zip, at most."""
_DIRECTORY_BYTES = 4 << 20  # of the list of files, which is read as a whole
_TAIL_BYTES = 65_557  # the end record with the longest comment
_END, _END_64 = b"PK\x05\x06", b"PK\x06\x07"
_BLOCK = 1 << 20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def unpack_zip(path: str | Path, folder: str | Path, limit_bytes: int) -> list[Path]:
    """Unpack a zip into a folder that is new.

    The bytes that come out are counted while they come; what the zip says of sizes decides nothing. When an
    error is raised, what was unpacked so far stays in the folder: it is the caller's to delete.

    Args:
        path: The zip.
        folder: Where it goes; must not exist.
        limit_bytes: Most bytes of all files together.

    Returns:
        The files, in the order of the zip.

    Raises:
        DataError: The zip is damaged, encrypted or too large, holds too many files, or a name that is absolute,
            leads out of the folder, appears twice, or belongs to a link or a device.
    """
    path, folder = Path(path), Path(folder)
    _check_directory(path)
    files: list[Path] = []
    left = limit_bytes
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            if len(entries) > MOST_FILES:
                raise DataError(
                    f"{path.name} holds {len(entries)} files; at most {MOST_FILES} are unpacked: leave some out"
                )
            places = [_place(entry, path.name) for entry in entries]
            folder.mkdir(parents=True)
            for entry, place in zip(entries, places, strict=True):
                target = folder.joinpath(*place.parts)
                if entry.is_dir():
                    target.mkdir(parents=True, exist_ok=True)
                    continue
                target.parent.mkdir(parents=True, exist_ok=True)
                left -= _copied(archive, entry, target, left, limit_bytes)
                files.append(target)
    except FileExistsError:
        raise DataError(f"{path.name} holds a name twice; zip the folder again") from None
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, ValueError) as error:
        text = " ".join(str(error).split())[:120]
        raise DataError(f"{path.name} is no zip that can be unpacked ({text}); zip the folder again") from None
    except OSError as error:
        raise DataError(
            f"{path.name} cannot be unpacked ({error.strerror}); give its files shorter, plain names"
        ) from None
    return files


def _check_directory(path: Path) -> None:
    """Refuse a list of files that would take much memory before it could be looked at."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - _TAIL_BYTES))
        tail = file.read()
    at = tail.rfind(_END)
    if at < 0 or len(tail) - at < 22:
        raise DataError(f"{path.name} is no zip, or its end is missing; zip the folder again")
    listed = int.from_bytes(tail[at + 12 : at + 16], "little")
    if listed > _DIRECTORY_BYTES or _END_64 in tail[max(0, at - 20) : at]:
        raise DataError(f"{path.name} lists too many files; at most {MOST_FILES} are unpacked: leave some out")


def _place(entry: zipfile.ZipInfo, name: str) -> PurePosixPath:
    """Return the place of an entry below the folder.

    Raises:
        DataError: It would lie elsewhere, or is no plain file or folder.
    """
    place, mode = PurePosixPath(entry.filename), entry.external_attr >> 16
    shown = repr(entry.filename[:80])
    strange = "\\" in entry.filename or "\0" in entry.filename or PureWindowsPath(entry.filename).drive
    if place.is_absolute() or ".." in place.parts or strange or not place.parts:
        raise DataError(f"{name} holds {shown}, which leads out of its folder; zip the folder again")
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise DataError(f"{name} holds {shown}, a link or a device; put the file itself into the zip")
    if entry.flag_bits & 1:
        raise DataError(f"{name} is encrypted; zip the folder without a password")
    if entry.compress_type not in _METHODS:
        raise DataError(f"{name} is packed by method {entry.compress_type}; use a plain zip (deflate)")
    return place


def _copied(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path, left: int, limit_bytes: int) -> int:
    """Copy an entry to a new file and return its bytes, of which there may be `left`."""
    count = 0
    with archive.open(entry) as source, target.open("xb") as file:
        while block := source.read(_BLOCK):
            count += len(block)
            if count > left:
                raise DataError(
                    f"{Path(str(archive.filename)).name} unpacks to more than {limit_bytes / 1e6:g} MB; "
                    "upload less, or start the page with a larger --upload-mb"
                )
            file.write(block)
    return count
