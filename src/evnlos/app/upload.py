"""A visitor's file, unpacked and checked.

- Unpacking a stranger's zip: nothing leaves its folder, nothing is a link, and no stated size is believed.
- A visitor's file: an event recording, or a capture folder as a zip, checked and read into one sequence.
- The same in a process of its own, so that a bad file takes neither the page's time nor its memory.

Run as a program: path, folder to unpack in, largest size in bytes, limit of memory in bytes, limit of processor
time in seconds. Writes one line of JSON, "error" or what the sequence is, then the bytes of the arrays named
there.
"""

from __future__ import annotations

import json
import stat
import sys
import tempfile
import zipfile
import zlib
from dataclasses import asdict
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evnlos.app.controls import POSITIONS, Recorded
from evnlos.data import read_capture
from evnlos.data.capture_info import inside, read_capture_info
from evnlos.errors import DataError, EvnlosError
from evnlos.events.recording import Recording
from evnlos.scene import LineMotion, Target
from evnlos.types import Events
from evnlos.untrusted import Child, limit_this_process

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


MOST_EVENTS = 20_000_000
"""Events that are read, at most: 260 MB."""
_MOST_PIXELS = 2_100_000  # of a sensor whose pixels all get maps
_MOST_MAP_BYTES = 1 << 30  # of all maps of a sequence
_MOST_FRAME_BYTES = 1 << 28  # of the frames of a capture
_ZIP = b"PK\x03\x04"
_PROGRAM = Path(__file__)
_CHILD_BYTES = 3 << 30
_CHILD_S = 60  # and a second more for every megabyte


def read_upload_apart(path: str | Path, scratch: str | Path, limit_bytes: int) -> Recorded:
    """Read an uploaded file as `read_upload` does, in a process of its own, under limits of memory and time.

    Args:
        path: The file.
        scratch: Folder to unpack in.
        limit_bytes: Largest file, and largest content of a zip, bytes.

    Raises:
        EvnlosError: As of `read_upload`, or reading took too much time or memory.
    """
    path = Path(path)
    seconds = _CHILD_S + path.stat().st_size // 1_000_000
    with tempfile.TemporaryDirectory(prefix="unpacked-", dir=scratch) as folder:
        words = [str(path.absolute()), folder, str(limit_bytes), str(_CHILD_BYTES), str(seconds)]
        with Child(_PROGRAM, words, seconds) as child:
            return _taken(child)


def _taken(child: Child) -> Recorded:
    """Return what the program made of the file: a line of JSON, then the arrays that it names."""
    about = child.take_json()
    if "error" in about:
        raise DataError(about["error"])
    arrays: dict[str, Any] = {}
    for name, kind, shape in about["arrays"]:
        dtype = np.dtype(kind)
        data = child.take(dtype.itemsize * int(np.prod(shape, dtype=np.int64)))
        arrays[name] = np.frombuffer(data, dtype).reshape(shape)
    columns = {name.removeprefix("events."): one for name, one in arrays.items() if name.startswith("events.")}
    motion, target = about["motion"], about["target"]
    return Recorded(
        about["name"],
        Events(**columns, width=about["width"], height=about["height"]),
        arrays["edges_us"],
        arrays.get("frames"),
        about["peak"],
        motion=None if motion is None else LineMotion(**motion),
        target=None if target is None else Target(mask=arrays["mask"], **target),
        distance_m=about["distance_m"],
        notes=tuple(about["notes"]),
    )


def read_upload(path: str | Path, scratch: str | Path, limit_bytes: int) -> Recorded:
    """Read an uploaded file; what is unpacked is deleted again before this returns.

    A zip with a capture.yaml is a capture; anything else has to be an event file, in any format that
    `read_events` knows.

    Args:
        path: The file.
        scratch: Folder to unpack in.
        limit_bytes: Largest file, and largest content of a zip, bytes.

    Raises:
        EvnlosError: The file is too large, damaged, or not what it should be; the text is one line.
    """
    path = Path(path)
    size = path.stat().st_size
    if size > limit_bytes:
        raise DataError(
            f"{path.name} has {size / 1e6:.0f} MB; at most {limit_bytes / 1e6:g} MB are taken: "
            "cut it with evnlos convert, or start the page with a larger --upload-mb"
        )
    with path.open("rb") as file:
        zipped = file.read(4) == _ZIP
    if not zipped or path.suffix.lower() == ".npz":
        return _read_recording(path)
    with tempfile.TemporaryDirectory(prefix="unpacked-", dir=scratch) as folder:
        files = unpack_zip(path, Path(folder) / path.stem, limit_bytes)
        found = [one for one in files if one.name == "capture.yaml"]
        if len(found) != 1:
            raise DataError(
                f"{path.name} holds {len(found)} files capture.yaml; "
                "zip one capture folder (see docs/own_camera.md)"
            )
        return _read_capture(found[0].parent)


def _read_recording(path: Path) -> Recorded:
    events, complete = _first_events(Recording(path))
    if not len(events):
        raise DataError(f"{path.name} holds no event; check it with evnlos info")
    if events.width * events.height > _MOST_PIXELS:
        raise DataError(
            f"{path.name} is of a sensor of {events.width} x {events.height} pixels; "
            f"at most {_MOST_PIXELS:,} are shown"
        )
    first, last = int(events.t_us[0]), int(events.t_us[-1])
    edges = np.round(np.linspace(first - 1, max(last, first + POSITIONS), POSITIONS + 1)).astype(np.int64)
    notes = [f"{len(events):,} events of a sensor of {events.width} x {events.height} pixels"]
    if not complete:
        notes.append(f"only the first {MOST_EVENTS:,} events are shown")
    return Recorded(path.stem, events, edges, notes=tuple(notes))


def _first_events(recording: Recording) -> tuple[Events, bool]:
    """Return the first events of a recording, and whether these are all."""
    pieces, count, complete = [], 0, True
    for piece in recording.pieces():
        pieces.append(piece[: MOST_EVENTS - count])
        count += len(pieces[-1])
        if count >= MOST_EVENTS:
            complete = False
            break
    height, width = recording.shape
    if not pieces:
        return Events.empty(max(width, 1), max(height, 1)), True
    columns = {name: np.concatenate([getattr(one, name) for one in pieces]) for name in ("t_us", "x", "y", "p")}
    return Events(**columns, width=pieces[0].width, height=pieces[0].height), complete


def _read_capture(folder: Path) -> Recorded:
    info = read_capture_info(folder)
    width, height = info.camera.width, info.camera.height
    if width * height > _MOST_PIXELS:
        raise DataError(f"the camera has {width} x {height} pixels; at most {_MOST_PIXELS:,} are shown")
    info.check_cameras(folder.name, frames=False, events=True)
    assert info.events is not None
    recording = Recording(inside(folder, info.events), width=width, height=height)
    if not _first_events(recording)[1]:
        raise DataError(
            f"{info.events} holds {MOST_EVENTS:,} events or more; cut it with evnlos convert before you zip it"
        )
    capture = read_capture(folder, _MOST_FRAME_BYTES, needs_frames=False)
    frames, edges = capture.frames[1:], capture.frame_times_us
    if not len(frames):
        raise DataError("the capture has one frame; a position needs two, with events between")
    most = max(1, _MOST_MAP_BYTES // (8 * frames.shape[1] * frames.shape[2]))
    notes = list(capture.notes)
    if len(frames) > most:
        frames, edges = frames[:most], edges[: most + 1]
        notes.append(f"only the first {most} positions are shown")
    return Recorded(
        capture.name,
        capture.events,
        np.asarray(edges),
        _own(frames) if capture.has_frames else None,
        capture.peak,
        motion=capture.motion,
        target=capture.target,
        distance_m=capture.distance_m,
        notes=tuple(notes),
    )


def _own(frames: NDArray) -> NDArray:
    """Return frames that no longer lean on a file."""
    return np.array(frames)


def _tell(path: str, folder: str, limit_bytes: int, memory_bytes: int, seconds: int) -> None:
    """Write what is in an uploaded file to the standard output: the program of the other process."""
    limit_this_process(memory_bytes, seconds)
    try:
        recorded = read_upload(path, folder, limit_bytes)
    except (EvnlosError, OSError, MemoryError) as error:
        said = str(error) or f"{Path(path).name} needs too much memory"
        sys.stdout.buffer.write(json.dumps({"error": said}).encode() + b"\n")
        return
    arrays = _arrays(recorded)
    motion, target = recorded.motion, recorded.target
    about = {
        "name": recorded.name,
        "width": recorded.events.width,
        "height": recorded.events.height,
        "peak": int(recorded.peak),
        "motion": asdict(motion) if isinstance(motion, LineMotion) else None,
        "target": None if target is None else {"name": target.name, "size_m": target.size_m},
        "distance_m": recorded.distance_m,
        "notes": recorded.notes,
        "arrays": [(name, one.dtype.str, one.shape) for name, one in arrays.items()],
    }
    sys.stdout.buffer.write(json.dumps(about).encode() + b"\n")
    for one in arrays.values():
        sys.stdout.buffer.write(one.data)


def _arrays(recorded: Recorded) -> dict[str, NDArray]:
    found: dict[str, NDArray] = {f"events.{name}": one for name, one in recorded.events.columns().items()}
    found["edges_us"] = recorded.edges_us
    if recorded.frames is not None:
        found["frames"] = recorded.frames
    if recorded.target is not None:
        found["mask"] = recorded.target.mask
    return {name: np.ascontiguousarray(one) for name, one in found.items()}


if __name__ == "__main__":
    _tell(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5]))
