"""ROS bags, Prophesee's HDF5 (ECF) and AEDAT, and their public readers, for the table of `event_files.py`.

`rosbags` and `mcap` stop at the message: what they hand over is decoded by the package `evt3` or by NumPy
(mono), as their users must.
"""

from __future__ import annotations

import importlib
import os
import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

for name in (
    "OMP_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "RAYON_NUM_THREADS",
    "POLARS_MAX_THREADS",
):
    os.environ.setdefault(name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

import numpy as np  # noqa: E402

from ecf_files import write_ecf  # noqa: E402
from event_files import rows  # noqa: E402
from evnlos.events import write_events  # noqa: E402
from evnlos.types import Events  # noqa: E402
from ros_files import PACKET, Cdr, Recording, Ros1, mono, packet, write_bag, write_db3, write_mcap  # noqa: E402

_PACKET_BYTES = 1 << 15
Reader = Callable[[Path], object]


class Decoded:
    """Messages of a rival that stops at messages, decoded by what else can be installed."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._encoding = ""
        self._bases: list[int] = []

    def add(self, message: Any) -> None:
        self._encoding = message.encoding
        self._parts.append(bytes(message.events))
        self._bases.append(message.time_base)

    def __len__(self) -> int:
        """Decode and return the number of events."""
        if self._encoding == "evt3":
            return len(importlib.import_module("evt3").decode_bytes(b"".join(self._parts), 1280, 720).x)
        words = np.frombuffer(b"".join(self._parts), "<u8")
        base = np.repeat(self._bases, [len(part) // 8 for part in self._parts])
        t = (base + (words & 0xFFFFFFFF).astype(np.int64)) // 1000
        x, y = (words >> 32).astype(np.uint16), ((words >> 48) & 0x7FFF).astype(np.uint16)
        p = (words >> 63).astype(bool)
        return len(np.broadcast_arrays(t, x, y, p)[0])


_PACKET_TEXT = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
    "bool is_bigendian\nuint8[] events\n"
)


def parser_of(is_ros1: bool) -> Callable[[bytes], Any]:
    stores = importlib.import_module("rosbags.typesys")
    store = stores.get_typestore(stores.Stores.ROS1_NOETIC if is_ros1 else stores.Stores.ROS2_HUMBLE)
    name = "event_camera_msgs/msg/EventPacket"
    store.register(stores.get_types_from_msg(_PACKET_TEXT, name))
    parse = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    return lambda data: parse(data, name)


def rosbags_reader(_: int) -> Reader:
    reader1 = importlib.import_module("rosbags.rosbag1").Reader
    reader2 = importlib.import_module("rosbags.rosbag2").Reader
    parse1, parse2 = parser_of(True), parser_of(False)

    def read(path: Path) -> Decoded:
        is_bag, found = path.suffix == ".bag", Decoded()
        parse = parse1 if is_bag else parse2
        with reader1(path) if is_bag else reader2(path.parent) as bag:
            for _, _, data in bag.messages():
                found.add(parse(data))
        len(found)
        return found

    return read


def mcap_reader(_: int) -> Reader:
    make = importlib.import_module("mcap.reader").make_reader
    parse = parser_of(False)

    def read(path: Path) -> Decoded:
        found = Decoded()
        with path.open("rb") as file:
            for _, _, message in make(file).iter_messages():
                found.add(parse(message.data))
        len(found)
        return found

    return read


def evlib_reader(_: int) -> Reader:
    evlib = importlib.import_module("evlib")
    return lambda path: evlib.load_events(str(path)).collect()


def evutils_reader(_: int) -> Reader:
    reader = importlib.import_module("evutils.io").EventReader
    return lambda path: reader(path, max_events=10**9).read_all()


def aedat_reader(_: int) -> Reader:
    aedat = importlib.import_module("aedat")

    def read(path: Path) -> np.ndarray:
        return np.concatenate([one["events"] for one in aedat.Decoder(str(path)) if "events" in one])

    return read


def dv_reader(_: int) -> Reader:
    opened = importlib.import_module("dv").AedatFile

    def read(path: Path) -> np.ndarray:
        with opened(str(path)) as file:
            return np.hstack([packet for packet in file["events"].numpy()])  # noqa: C416 - it has no length

    return read


RIVALS: dict[str, Callable[[int], Reader]] = {
    "rosbags": rosbags_reader, "mcap": mcap_reader, "evlib": evlib_reader, "evutils": evutils_reader,
    "aedat": aedat_reader, "dv": dv_reader,
}  # fmt: skip


def readers(names: tuple[str, ...], count: int) -> dict[str, Reader]:
    """Return those of the named readers that can be imported."""
    found: dict[str, Reader] = {}
    for name in names:
        try:
            found[name] = RIVALS[name](count)
        except ImportError as error:
            print(f"    {name}: {error}")
    return found


def evt3_messages(folder: Path, events: Events, make: type[Cdr]) -> Recording:
    write_events(folder / "words.raw", events)
    data = (folder / "words.raw").read_bytes()
    data = data[data.index(b"% end\n") + 6 :]
    parts = [data[start : start + _PACKET_BYTES] for start in range(0, len(data), _PACKET_BYTES)]
    size = (events.width, events.height)
    return [("/e", PACKET, k, packet(one, "evt3", k, 0, size, make)) for k, one in enumerate(parts)]


def mono_messages(events: Events) -> Recording:
    out: Recording = []
    for seq, start in enumerate(range(0, len(events), 4096)):
        one = events[start : start + 4096]
        base = int(one.t_us[0]) * 1000
        words = mono(one.t_us * 1000 - base, one.x, one.y, one.p)
        out.append(("/e", PACKET, base, packet(words, "mono", seq, base, (events.width, events.height))))
    return out


def libcaer_words(events: Events) -> np.ndarray:
    words = np.empty((len(events), 2), "<u4")
    words[:, 0] = (
        events.x.astype(np.uint32) << 17 | events.y.astype(np.uint32) << 2 | events.p.astype(np.uint32) << 1 | 1
    )
    words[:, 1] = events.t_us
    return words


def write_aedat31(path: Path, events: Events) -> None:
    with path.open("wb") as file:
        file.write(b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DAVIS640\r\n#!END-HEADER\r\n")
        for start in range(0, len(events), 4096):
            words = libcaer_words(events[start : start + 4096])
            file.write(struct.pack("<hhiiiiii", 1, 1, 8, 4, 0, len(words), len(words), len(words)))
            words.tofile(file)


def write_aedat2(path: Path, events: Events) -> None:
    words = np.empty((len(events), 2), ">u4")
    words[:, 0] = (
        events.y.astype(np.uint32) << 22 | events.x.astype(np.uint32) << 12 | events.p.astype(np.uint32) << 11
    )
    words[:, 1] = events.t_us
    path.write_bytes(b"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.Davis640\r\n" + words.tobytes())


def files(folder: Path, count: int) -> Iterator[tuple[str, Path, int, tuple[str, ...]]]:
    """Write the files of the table one after the other: title, path, events, rivals."""
    events = rows(count)
    count = len(events)
    small = Events(events.t_us, events.x % 640, events.y % 480, events.p, 640, 480)
    cdr = evt3_messages(folder, events, Cdr)
    bag2 = folder / "bag2"  # rosbags wants a folder with metadata.yaml
    bag2.mkdir()
    write_db3(bag2 / "a.db3", cdr)
    metadata(bag2 / "a.db3", len(cdr))
    yield "ROS 2 .db3, evt3", bag2 / "a.db3", count, ("rosbags",)
    yield (
        "ROS 1 .bag, evt3",
        write_bag(folder / "a.bag", evt3_messages(folder, events, Ros1), per_chunk=24),
        count,
        ("rosbags",),
    )
    yield "ROS 2 .mcap, evt3", write_mcap(folder / "a.mcap", cdr, per_chunk=24), count, ("mcap",)
    yield (
        "ROS 2 .mcap, mono",
        write_mcap(folder / "b.mcap", mono_messages(events), per_chunk=24),
        count,
        ("mcap",),
    )
    part = events[: 1 << 19]
    for form in ("packed", "pairs"):
        yield f"HDF5 with ECF, {form}", write_ecf(folder / f"{form}.h5", part, form), len(part), ("evlib",)
    write_aedat2(folder / "a2.aedat", small)
    yield "AEDAT 2.0", folder / "a2.aedat", count, ("evutils", "evlib")
    write_aedat31(folder / "a3.aedat", small)
    yield "AEDAT 3.1", folder / "a3.aedat", count, ("evutils", "evlib")
    write_events(folder / "a.aedat4", small)
    yield "AEDAT4", folder / "a.aedat4", count, ("aedat", "dv")


def metadata(path: Path, count: int) -> None:
    """Write the metadata.yaml that rosbags wants beside a .db3."""
    topic = f"{{name: /e, type: {PACKET}, serialization_format: cdr, offered_qos_profiles: ''}}"
    (path.parent / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 4\n  storage_identifier: sqlite3\n"
        f"  relative_file_paths: [{path.name}]\n  duration: {{nanoseconds: {count}}}\n"
        f"  starting_time: {{nanoseconds_since_epoch: 0}}\n  message_count: {count}\n"
        f"  topics_with_message_count: [{{topic_metadata: {topic}, message_count: {count}}}]\n"
        "  compression_format: ''\n  compression_mode: ''\n"
    )
