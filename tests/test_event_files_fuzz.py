"""Any bytes at all: strict reading gives checked events or one error, salvage likewise; nothing else, ever."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from evnlos.errors import EventFileError
from evnlos.events import CelexOptions, iter_events, read_events, read_events_report, read_frames, write_events
from evnlos.types import Events

FILES = [
    "e.h5",
    "e.npz",
    "evt3.raw",
    "evt2.raw",
    "evt21.raw",
    "e.csv",
    "e_EI_100M.bin",
    "e_EO_70M.bin",
    "e.dat",
    "e.mcap",
]
FUZZ = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def written(folder: Path, name: str) -> bytes:
    """Return the bytes of a small good file."""
    draw = np.random.default_rng(1)
    times = np.sort(draw.integers(0, 200_000, 200))
    adc = draw.integers(0, 4096, 200) if "EI" in name else None
    columns = (draw.integers(0, 1280, 200), draw.integers(0, 720, 200), draw.integers(0, 2, 200).astype(bool))
    height = 800 if name.endswith(".bin") else 720
    events = Events(times, *columns, width=1280, height=height, adc=adc)
    if name.endswith(".dat"):
        rows = b"".join(
            struct.pack("<II", int(t), int(x) | int(y) << 14 | int(p) << 28)
            for t, x, y, p in zip(events.t_us, events.x, events.y, events.p, strict=True)
        )
        return b"% Data file containing CD events\n% Version 2\n% Width 1280\n% Height 720\n\x0c\x08" + rows
    stem = name.split(".")[0].upper()
    write_events(folder / name, events, format=stem if stem.startswith("EVT") else None)
    return (folder / name).read_bytes()


edits = st.lists(
    st.tuples(
        st.sampled_from(["flip", "set", "insert", "delete", "cut"]),
        st.one_of(st.floats(0, 1), st.floats(0, 0.02)),
        st.binary(min_size=1, max_size=8),
    ),
    min_size=1,
    max_size=4,
)


def damage(data: bytes, changes) -> bytes:
    out = bytearray(data)
    for what, place, value in changes:
        at = min(int(place * len(out)), max(len(out) - 1, 0))
        if not out:
            break
        if what == "flip":
            out[at] ^= 1 << (value[0] & 7)
        elif what == "set":
            out[at : at + len(value)] = value
        elif what == "insert":
            out[at:at] = value
        elif what == "delete":
            del out[at : at + len(value)]
        else:
            del out[at:]
    return bytes(out)


def survives(path: Path, **options) -> None:
    """Read in every way; the checked constructor must accept whatever comes back."""
    for read in (
        lambda: [read_events(path, **options)],
        lambda: [read_events_report(path, **options)[0]],
        lambda: list(iter_events(path, n_events=64, **options)),
        lambda: list(iter_events(path, window_us=1_000, on_error="salvage", **options)),
    ):
        try:
            pieces = read()
        except EventFileError as error:
            assert "\n" not in str(error) and str(path) in str(error)
            continue
        for events in pieces:
            Events(events.t_us, events.x, events.y, events.p, events.width, events.height)


@pytest.mark.parametrize("name", FILES)
def test_edited_files(name, tmp_path):
    data = written(tmp_path, name)
    path = tmp_path / f"x_{name}"

    @FUZZ
    @given(edits)
    def check(changes):
        path.write_bytes(damage(data, changes))
        survives(path)

    check()


@FUZZ
@given(
    st.sampled_from([b"", b"% evt 2.0\n", b"% evt 3.0\n", b"% evt 2.1\n", b"t,x,y,p\n", b"#!AER-DAT4.0\r\n"]),
    st.binary(),
)
def test_any_bytes(tmp_path, start, body):
    (tmp_path / "any_100M.bin").write_bytes(start + body)
    survives(tmp_path / "any_100M.bin")


@FUZZ
@given(st.integers(0, 2), st.booleans(), st.binary(max_size=400))
def test_any_celex(tmp_path, event_format, has_imu, body):
    path = tmp_path / "any.bin"
    path.write_bytes(bytes(12) + body)
    options = CelexOptions(clock_mhz=100, event_format=event_format, has_imu=has_imu)
    survives(path, celex=options)
    try:
        read_frames(path, celex=options)
    except EventFileError as error:
        assert "\n" not in str(error)


def test_damaged_aedat4_cannot_take_the_process_down(shared_data, tmp_path):
    pytest.importorskip("aedat")
    data = (shared_data / "captures" / "far_A" / "events.aedat4").read_bytes()
    truth = read_events(shared_data / "captures" / "far_A" / "events.aedat4")
    path = tmp_path / "e.aedat4"
    draw = np.random.default_rng(0)
    for attempt in range(12):
        out = bytearray(data)
        top = 1_200 if attempt % 2 else len(out)
        out[int(draw.integers(0, top))] ^= 1 << int(draw.integers(0, 8))
        path.write_bytes(out if attempt else data[: len(data) // 2])
        try:
            assert read_events(path) == truth
        except EventFileError as error:
            assert "\n" not in str(error) and str(path) in str(error)
        else:
            assert attempt
