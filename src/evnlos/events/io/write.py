"""Writing event files: under a temporary name first, so that a file that exists is complete."""

from __future__ import annotations

import secrets
from os import PathLike
from pathlib import Path

from evnlos.errors import EventFileError
from evnlos.events.io.registry import format_to_write
from evnlos.types import Events


def write_events(path: str | PathLike[str], events: Events, *, format: str | None = None) -> None:
    """Write events to a file; it appears under its name only when it is complete.

    Args:
        path: The file to write; an existing one is replaced.
        events: The events.
        format: Name of the format, such as "EVT2"; by default the suffix decides: .h5 and .hdf5 HDF5 with
            DSEC columns, .npz NPZ, .raw EVT3, .csv CSV, .bin CeleX-V (name it ..._100M.bin).

    Raises:
        EventFileError: No writable format has that suffix or name, or the folder cannot be written.
        DataError: The format cannot hold the sensor size or the times.
    """
    path = Path(path)
    chosen = format_to_write(path, format)
    if not path.parent.is_dir():
        raise EventFileError(f"{path}: no such folder {path.parent}; create it first")
    assert chosen.write is not None
    temporary = path.with_name(f".{path.name[:80]}.{secrets.token_hex(4)}.part")
    try:
        chosen.write(temporary, events, path)
        temporary.replace(path)
    except OSError as error:
        raise EventFileError(
            f"{path}: writing failed ({error}); check the folder and the space on it"
        ) from None
    finally:
        temporary.unlink(missing_ok=True)
