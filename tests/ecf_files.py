"""Prophesee HDF5 files by hand: a slow encoder of ECF chunks, in each of their three forms."""

from __future__ import annotations

import struct
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np

from evnlos.types import Events

FIELDS = np.dtype(
    {
        "names": ["x", "y", "p", "t"],
        "formats": ["<u2", "<u2", "<i2", "<i8"],
        "offsets": [0, 2, 4, 8],
        "itemsize": 16,
    }
)
CHUNK = 16_384


def coded_times(t) -> bytes:
    out, before, at = struct.pack("<Q", int(t[0])), int(t[0]), 0
    while at < len(t):
        run = int(np.searchsorted(t, t[at], "right")) - at
        step, before = int(t[at]) - before, int(t[at])
        if step >= 15:
            while step:
                out += bytes([0xF0 | step & 15])
                step >>= 4
        if run < 15:
            out += bytes([step << 4 | run])
        else:
            out += bytes([step << 4 | 15]) + struct.pack("<H", run)
        at += run
    return out


def runs(values) -> list[tuple[int, int]]:
    edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    return [(int(values[a]), b - a) for a, b in pairwise(edges)]


def chunk(events: Events, form: str = "packed") -> bytes:
    """Return a coded chunk: "packed" (y, x, p), "pairs" (rows as runs) or "masks"."""
    x, y, p, n = events.x.astype(int), events.y.astype(int), events.p.astype(int), len(events)
    head = struct.pack("<I", n << 2 | {"packed": 2, "pairs": 1, "masks": 0}[form]) + coded_times(events.t_us)
    fill = np.zeros(-n % 4, int)
    if form == "packed":
        values = np.concatenate([y << 12 | x << 1 | p, fill]).reshape(-1, 4).tolist()
        return head + b"".join(
            struct.pack("<III", a << 8 | b & 255, b >> 8 << 16 | c & 65_535, c >> 16 << 24 | d)
            for a, b, c, d in values
        )
    for value, run in runs(y):
        head += struct.pack("<H", value << 5 | run) if run < 31 else struct.pack("<HH", value << 5 | 31, run)
    if form == "pairs":
        values = np.concatenate([x << 1 | p, fill]).reshape(-1, 4).tolist()
        return head + b"".join(
            struct.pack("<HHH", a << 4 | b & 15, b >> 4 << 8 | c & 255, c >> 8 << 12 | d)
            for a, b, c, d in values
        )
    at = 0
    while at < n:
        word, stop = x[at] << 5, at + 1
        while stop < n and x[stop - 1] < x[stop] <= x[at] + 5:
            word |= 32 >> (x[stop] - x[at])
            stop += 1
        head += struct.pack("<H", word)
        at = stop
    for value, run in runs(p):
        head += bytes([value << 7 | run]) if run < 127 else bytes([value << 7 | 127]) + struct.pack("<H", run)
    return head


def write_ecf(path: Path, events: Events, form: str = "packed", chunks: list[bytes] | None = None) -> Path:
    """Write a Prophesee HDF5 file; `chunks` replace the coded ones."""
    with h5py.File(path, "w") as file:
        file.attrs["geometry"], file.attrs["version"] = f"{events.width}x{events.height}", "1.0"
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_chunk((CHUNK,))
        layout.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL, ())
        space = h5py.h5s.create_simple((len(events),), (h5py.h5s.UNLIMITED,))
        group = file.create_group("CD")
        dataset = h5py.h5d.create(group.id, b"events", h5py.h5t.py_create(FIELDS), space, layout)
        for k, start in enumerate(range(0, len(events), CHUNK)):
            data = chunks[k] if chunks else chunk(events[start : start + CHUNK], form)
            dataset.write_direct_chunk((start,), data, 0)
    return path
