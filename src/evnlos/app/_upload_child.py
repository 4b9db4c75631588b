"""Reads an upload in a process of its own, so that a bad one takes neither the page's time nor its memory.

Run as a program: path, folder to unpack in, largest size in bytes, limit of memory in bytes, limit of processor
time in seconds. Writes one line of JSON, "error" or what the sequence is, then the bytes of the arrays named
there.
"""

import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.app.controls import Recorded
from evnlos.app.upload import read_upload
from evnlos.errors import EvnlosError
from evnlos.scene import LineMotion
from evnlos.untrusted import limit_this_process


def main(path: str, folder: str, limit_bytes: int, memory_bytes: int, seconds: int) -> None:
    """Write what is in an uploaded file to the standard output."""
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
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5]))
