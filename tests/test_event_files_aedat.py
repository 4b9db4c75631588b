"""AEDAT 2.0 of jAER and 3.1 of cAER: events, frames, external inputs, damage."""

import logging
import struct

import numpy as np
import pytest

from evnlos.errors import EventFileError
from evnlos.events import iter_events, read_events, read_events_report, read_timed_frames, read_triggers
from evnlos.types import Events


@pytest.mark.parametrize(("name", "stem"), [("aedat2", "aedat2_davis346"), ("aedat31", "aedat31_davis346")])
def test_recordings_equal_their_truth(shared_data, name, stem):
    truth = np.load(shared_data / "recordings" / "aedat_truth.npz")
    path = shared_data / "recordings" / f"{stem}.aedat"
    events = read_events(path)
    for ours, theirs in (("x", "x"), ("y", "y"), ("p", "p"), ("t_us", "t")):
        np.testing.assert_array_equal(getattr(events, ours), truth[f"{name}_{theirs}"])
    assert (events.width, events.height) == tuple(truth[f"{name}_size"])
    np.testing.assert_array_equal(read_triggers(path).t_us, truth[f"{name}_external_t"])
    joined = np.concatenate([piece.t_us for piece in iter_events(path, window_us=10_000)])
    np.testing.assert_array_equal(joined, events.t_us)


# ---------------------------------------------------------------- AEDAT 2.0


def aedat2(pairs, chip: str = "eu.seebetter.ini.chips.davis.DAVIS240C", end: str = "\r\n") -> bytes:
    head = f"#!AER-DAT2.0{end}# This is a raw AE data file{end}# AEChip: {chip}{end}"
    return head.encode() + b"".join(struct.pack(">II", *pair) for pair in pairs)


def davis(x: int, y: int, p: int) -> int:
    return y << 22 | x << 12 | p << 11


def test_davis_of_jaer_by_hand(tmp_path):
    path = tmp_path / "a.aedat"
    words = [(davis(239, 179, 1), 2**32 - 2), (1 << 31 | 3 << 10, 5), (1 << 10, 7), (davis(3, 4, 0), 8)]
    for end in ("\n", "\r\n"):
        path.write_bytes(aedat2(words, end=end))
        assert read_events(path) == Events([2**32 - 2, 2**32 + 8], [239, 3], [179, 4], [1, 0], 240, 180)
        assert read_triggers(path).t_us.tolist() == [2**32 + 7]


def test_dvs128_says_what_it_takes_for_on(tmp_path, caplog):
    path = tmp_path / "a.aedat"
    path.write_bytes(
        aedat2([(5 << 8 | 7 << 1, 9), (6 << 8 | 8 << 1 | 1, 10)], "ch.unizh.ini.jaer.chip.retina.DVS128")
    )
    with caplog.at_level(logging.WARNING, "evnlos"):
        assert read_events(path) == Events([9, 10], [7, 8], [5, 6], [1, 0], 128, 128)
    assert "counts as ON" in caplog.text


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (aedat2([(davis(1, 1, 1), 5)])[:-3], "5 bytes into a pair"),
        (aedat2([(davis(1, 1, 1), 5), (davis(1, 1, 1), 4)]), "earlier"),
        (aedat2([(davis(240, 1, 1), 5)]), "sensor is 240 x 180"),
        (aedat2([], "some.Chip"), "camera 'some.Chip'.*give width="),
        (b"#!AER-DAT2.0\r\n" + bytes(16), "no camera"),
        (b"#!AER-DAT2" + bytes(16), "first line is damaged"),
    ],
)
def test_damaged_aedat2(data, said, tmp_path):
    (tmp_path / "a.aedat").write_bytes(data)
    with pytest.raises(EventFileError, match=said):
        read_events(tmp_path / "a.aedat")


def test_frames_of_jaer(tmp_path):
    """Reset and signal of each pixel; what was begun and not ended is left out."""
    draw = np.random.default_rng(0)
    levels = draw.integers(0, 1024, (2, 128, 128))
    samples = []
    for kind in (0, 1):
        for y in range(128):
            for x in range(128):
                word = 1 << 31 | y << 22 | x << 12 | kind << 10 | int(levels[kind, y, x])
                samples.append((word, 1000 + kind * 500 + y))
    path = tmp_path / "a.aedat"
    path.write_bytes(aedat2(samples[:70] + samples + samples[:50], "DAVIS128"))
    found = read_timed_frames(path)
    expected = np.clip(levels[0] - levels[1], 0, 1023) << 6
    np.testing.assert_array_equal(found.images, expected[None])
    assert found.t_us is not None and found.t_us.tolist() == [1500]


# ---------------------------------------------------------------- AEDAT 3.1


def aedat31(*packets: bytes, sources=("DAVIS240C",)) -> bytes:
    lines = ["#!AER-DAT3.1", "#Format: RAW", *(f"#Source {k}: {name}" for k, name in enumerate(sources))]
    lines += ["#Start-Time: 2026-01-01 00:00:00 (TZ+0000)", "#!END-HEADER"]
    return "".join(f"{line}\r\n" for line in lines).encode() + b"".join(packets)


def block(kind: int, events: list[bytes], turns: int = 0, source: int = 0, valid: int | None = None) -> bytes:
    size = len(events[0]) if events else 8
    head = (kind, source, size, 4, turns, len(events), len(events), len(events) if valid is None else valid)
    return struct.pack("<hhiiiiii", *head) + b"".join(events)


def polarity(t: int, x: int, y: int, p: int, valid: int = 1) -> bytes:
    return struct.pack("<Ii", x << 17 | y << 2 | p << 1 | valid, t)


def frame(pixels: np.ndarray, begin: int, end: int) -> bytes:
    info = 1 | pixels.shape[2] << 1
    sides = (pixels.shape[1], pixels.shape[0], 0, 0)
    return struct.pack("<Iiiiiiiii", info, begin, end, begin, end, *sides) + pixels.astype("<u2").tobytes()


def test_caer_by_hand(tmp_path):
    path = tmp_path / "a.aedat"
    first = block(1, [polarity(5, 239, 179, 1), polarity(6, 1, 1, 1, valid=0), polarity(7, 3, 4, 0)], valid=2)
    special = block(0, [struct.pack("<Ii", 2 << 1 | 1, 9), struct.pack("<Ii", 3 << 1 | 1, 10)])
    other = block(3, [bytes(36)])
    path.write_bytes(aedat31(first, special, other, block(1, [polarity(2, 0, 0, 1)], turns=3)))
    times = [5, 7, 3 * 2**31 + 2]
    assert read_events(path) == Events(times, [239, 3, 0], [179, 4, 0], [1, 0, 1], 240, 180)
    triggers = read_triggers(path)
    assert triggers.t_us.tolist() == [9, 10] and triggers.rising.tolist() == [True, False]


def test_two_cameras_in_one_file(tmp_path):
    path = tmp_path / "a.aedat"
    packets = [block(1, [polarity(5 + k, k, 0, 1)], source=k) for k in (0, 1)]
    path.write_bytes(aedat31(*packets, sources=("DAVIS240C", "DVS128")))
    with pytest.raises(EventFileError, match="one of: 0, 1"):
        read_events(path)
    assert read_events(path, topic="1") == Events([6], [1], [0], [1], 128, 128)


@pytest.mark.parametrize("samples", [1, 3])
def test_frames_of_caer(samples, tmp_path):
    pixels = np.random.default_rng(0).integers(0, 65_536, (4, 6, samples)).astype(np.uint16)
    path = tmp_path / "a.aedat"
    path.write_bytes(aedat31(block(2, [frame(pixels, 10, 20)]), block(2, [frame(pixels, 30, 50)], turns=1)))
    found = read_timed_frames(path)
    grey = pixels[:, :, 0] if samples == 1 else np.round(pixels @ [0.299, 0.587, 0.114])
    np.testing.assert_array_equal(found.images, np.stack([grey, grey]))
    assert found.t_us is not None and found.t_us.tolist() == [15, 2**31 + 40]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (aedat31(block(1, [polarity(5, 0, 0, 1)]))[:-3], "a packet of 8 bytes, 5 are left"),
        (aedat31(bytes(20)), "20 bytes into a packet's header"),
        (aedat31(block(1, [polarity(5, 0, 0, 1), polarity(4, 0, 0, 1)])), "earlier"),
        (aedat31(block(1, [polarity(5, 240, 0, 1)])), "sensor is 240 x 180"),
        (aedat31(block(1, [bytes(12)])), "12 bytes instead of 8"),
        (aedat31(block(1, [polarity(5, 0, 0, 1)], valid=9)), "9 of them valid"),
        (aedat31().replace(b"3.1", b"3.0"), "version 3.0"),
        (aedat31().replace(b"RAW", b"Serial-TS"), "format Serial-TS"),
    ],
)
def test_damaged_aedat31(data, said, tmp_path):
    (tmp_path / "a.aedat").write_bytes(data)
    with pytest.raises(EventFileError, match=said):
        read_events(tmp_path / "a.aedat")


@pytest.mark.parametrize("make", [
    lambda: aedat2([(davis(k % 240, k % 180, k % 2), k * 10) for k in range(300)]),
    lambda: aedat31(*(block(1, [polarity(k * 10 + j, j, k, 1) for j in range(10)]) for k in range(30))),
])  # fmt: skip
def test_any_damage_is_one_line_or_events(make, tmp_path):
    data, path = make(), tmp_path / "a.aedat"
    draw = np.random.default_rng(0)
    failed = 0
    for attempt in range(150):
        out = bytearray(data)
        if attempt % 5 == 0:
            del out[int(draw.integers(12, len(out))) :]
        else:
            out[int(draw.integers(0, len(out)))] ^= 1 << int(draw.integers(0, 8))
        path.write_bytes(out)
        for mode in ("strict", "salvage"):
            try:
                events, _ = read_events_report(path, mode)
            except EventFileError as error:
                assert "\n" not in str(error) and str(path) in str(error)
                failed += mode == "strict"
                continue
            Events(events.t_us, events.x, events.y, events.p, events.width, events.height)
    assert failed > 30
