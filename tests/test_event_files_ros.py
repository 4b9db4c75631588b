"""ROS recordings: `.db3`, `.mcap`, `.bag`, every message type and encoding, damage, strangers' files."""

import json
import logging
import sqlite3
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from evnlos.errors import DataError, EventFileError, MissingDependencyError
from evnlos.events import (
    iter_events,
    read_events,
    read_events_report,
    read_timed_frames,
    read_triggers,
    write_events,
)
from evnlos.types import Events
from ros_files import (
    IMAGE,
    PACKET,
    Cdr,
    Recording,
    Ros1,
    bag_bytes,
    event_array,
    image,
    mcap_bytes,
    mono,
    packet,
    write_bag,
    write_db3,
    write_mcap,
)

REAL = (
    "ros2_evt3_640x480.db3", "ros1_evt3_640x480.bag", "ros2_libcaer_cmp_346x260.mcap",
    "ros2_libcaer_dvxplorer.db3", "ros2_evt3_zstd.mcap",
)  # fmt: skip


@pytest.mark.parametrize("name", REAL)
def test_real_recordings_give_the_published_counts(shared_data, name):
    if "zstd" in name:
        pytest.importorskip("zstandard")
    truth = json.loads((shared_data / "recordings" / "ros_truth.json").read_text())["files"][name]["counted"]
    path = shared_data / "recordings" / name
    events, report = read_events_report(path, "strict")
    assert report.clean and events.shape == (truth["height"], truth["width"])
    assert (len(events), int(events.p.sum())) == (truth["events"], truth["on"])
    assert (int(events.x.sum(dtype=int)), int(events.y.sum(dtype=int))) == (truth["sum_x"], truth["sum_y"])
    assert int((events.t_us - events.t_us[0]).sum()) == truth["sum_t_from_first_us"]
    first = truth.get("first_t_us", truth.get("first_t_ns", 0) // 1000)
    last = truth.get("last_t_us", truth.get("last_t_ns", 0) // 1000)
    assert (int(events.t_us[0]), int(events.t_us[-1])) == (first, last)
    pieces = list(iter_events(path, window_us=100_000))
    assert np.array_equal(np.concatenate([piece.t_us for piece in pieces]), events.t_us)
    if "triggers" in truth:
        triggers = read_triggers(path)
        assert len(triggers) == report.triggers == truth["triggers"]
        assert int(triggers.rising.sum()) == truth["triggers_edge_1"]
        assert int(triggers.t_us.sum()) == truth["sum_trigger_t_us"]
        assert sorted(set(triggers.channel.tolist())) == truth["trigger_ids"]


# ---------------------------------------------------------------- containers by hand


def stream(count: int = 40, seed: int = 0) -> Events:
    draw = np.random.default_rng(seed)
    times = 1_000 + np.sort(draw.integers(0, 9_000, count))
    return Events(
        times, draw.integers(0, 64, count), draw.integers(0, 48, count), draw.integers(0, 2, count), 64, 48
    )


def recording(events: Events, make=Cdr, topic: str = "/cam/events", per_packet: int = 10) -> Recording:
    out = []
    for seq, start in enumerate(range(0, len(events), per_packet)):
        part = events[start : start + per_packet]
        base = int(part.t_us[0]) * 1000
        data = packet(mono(part.t_us * 1000 - base, part.x, part.y, part.p), "mono", seq + 3, base, make=make)
        out.append((topic, PACKET, base, data))
    return out


@pytest.fixture(params=["db3", "mcap", "mcap-lz4", "mcap-zstd", "bag", "bag-bz2", "bag-lz4", "bag-killed"])
def container(request, tmp_path):
    """Return a function that writes a recording of CDR or ROS 1 messages into one kind of container."""
    kind, _, method = request.param.partition("-")
    if method in ("lz4", "zstd"):
        pytest.importorskip({"lz4": "lz4", "zstd": "zstandard"}[method])

    def write(make_messages, name: str = "a") -> Path:
        path = tmp_path / f"{name}.bin"  # found by its content
        if kind == "db3":
            return write_db3(path, make_messages(Cdr))
        if kind == "mcap":
            return write_mcap(path, make_messages(Cdr), compression=method)
        index = method != "killed"
        return write_bag(
            path, make_messages(Ros1), compression=method if index and method else "none", index=index
        )

    return write


def test_every_container_gives_the_events(container):
    events = stream()
    path = container(lambda make: [("/chatter", "std_msgs/msg/String", 0, b"x" * 9), *recording(events, make)])
    found, report = read_events_report(path, "strict")
    assert found == events and report.topic == "/cam/events"
    assert [(one.name, one.kind) for one in report.streams] == [
        ("/chatter", "other"),
        ("/cam/events", "events"),
    ]
    joined = np.concatenate([piece.x for piece in iter_events(path, n_events=7)])
    assert np.array_equal(joined, events.x)


def test_several_cameras_are_chosen_by_name(container, caplog):
    left, right = stream(seed=1), stream(seed=2)
    path = container(
        lambda make: recording(left, make, "/left/events") + recording(right, make, "/right/events")
    )
    with pytest.raises(EventFileError, match=r"topic=.*/left/events, /right/events"):
        read_events(path)
    assert read_events(path, topic="/right/events") == right and read_events(path, topic="left/events") == left
    with pytest.raises(EventFileError, match="no stream of events is '/up'; give one of: /left/events"):
        read_events(path, topic="/up")
    with caplog.at_level(logging.WARNING, "evnlos"):
        assert read_events_report(path)[0] == left
    assert "took /left/events" in caplog.text


def test_images_and_their_clock(container):
    draw = np.random.default_rng(3)
    grey = [draw.integers(0, 256, (6, 8)).astype(np.uint8) for _ in range(3)]
    path = container(
        lambda make: [
            ("/cam/image", IMAGE, k, image(k * 40_000_000 + 999, one, make=make)) for k, one in enumerate(grey)
        ]
    )
    found = read_timed_frames(path)
    np.testing.assert_array_equal(found.images, np.stack(grey))
    assert found.t_us is not None and found.t_us.tolist() == [0, 40_000, 80_000]
    with pytest.raises(EventFileError, match="no stream of events; it holds /cam/image"):
        read_events(path)


def test_lost_packets_are_told(container):
    events = stream()
    path = container(lambda make: recording(events, make)[:2] + recording(events, make)[3:])
    with pytest.raises(EventFileError, match="packet 6 follows packet 4: 1 were lost"):
        read_events(path)
    found, report = read_events_report(path)
    assert report.faults == {"lost": 1} and len(found) == 30


def test_damage_is_one_line_or_the_truth(container):
    events = stream(200)
    path = container(lambda make: recording(events, make))
    data = path.read_bytes()
    draw = np.random.default_rng(0)
    failed = 0
    for attempt in range(80):
        out = bytearray(data)
        if attempt < 20:
            del out[int(draw.integers(0, len(out))) :]
        else:
            out[int(draw.integers(0, len(out)))] ^= 1 << int(draw.integers(0, 8))
        path.write_bytes(out)
        for mode in ("strict", "salvage"):
            try:
                found, _ = read_events_report(path, mode)
            except EventFileError as error:
                assert "\n" not in str(error) and str(error).startswith(str(path))
                failed += mode == "strict"
                continue
            Events(found.t_us, found.x, found.y, found.p, found.width, found.height)
            assert len(found) <= 200
    assert failed > 20


def test_a_cut_file_keeps_its_good_part(container):
    events = stream(2000)
    path = container(lambda make: recording(events, make))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 3 // 4])
    with pytest.raises(EventFileError):
        read_events(path)
    found, report = read_events_report(path)
    assert report.truncated and len(found) >= 500
    assert found == events[: len(found)]


# ---------------------------------------------------------------- messages


@pytest.mark.parametrize("method", ["", "lz4", "zstd"])
def test_salvage_of_a_damaged_mcap_chunk_invents_no_events(method, tmp_path):
    """A wrong byte of a packed chunk spreads over what comes out; the chunk goes, the others stay."""
    if method:
        pytest.importorskip({"lz4": "lz4", "zstd": "zstandard"}[method])
    events = stream(4_000)
    path = write_mcap(tmp_path / "a.mcap", recording(events, per_packet=100), compression=method, per_chunk=10)
    data, draw = path.read_bytes(), np.random.default_rng(5)
    true = {row.tobytes() for row in np.stack([events.t_us, events.x, events.y, events.p], 1)}
    kept = []
    for _ in range(60):
        out = bytearray(data)
        out[int(draw.integers(len(data) // 4, len(data) // 2))] ^= 1 << int(draw.integers(0, 8))
        path.write_bytes(out)
        try:
            found, report = read_events_report(path)
        except EventFileError:
            continue
        rows = np.stack([found.t_us, found.x, found.y, found.p], 1)
        false = sum(row.tobytes() not in true for row in rows)
        assert false <= (0 if method else 100)  # of a plain chunk the damaged packet alone
        assert report.clean or len(found) < 4_000 or not method
        kept.append(len(found))
    assert len(kept) > 40 and 2_000 <= min(kept) < 4_000


def test_what_hides_all_topics_is_told_in_strict_mode(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, 10_000).astype(np.uint8).tobytes()
    path = tmp_path / "a"
    for start, place in ((b"#ROSBAG V2.0\n", 13), (b"\x89MCAP0\r\n", 8)):
        path.write_bytes(start + noise)
        with pytest.raises(EventFileError, match=f"byte {place}: a record"):
            read_events(path)
        with pytest.raises(EventFileError, match="nothing in it can be read; copy it again"):
            read_events_report(path)


def test_faults_of_a_db3_name_the_message(tmp_path):
    path = write_db3(tmp_path / "a.db3", recording(stream()))
    with sqlite3.connect(path) as base:
        base.execute("UPDATE messages SET data = x'0001000000' WHERE id = 3")
    base.close()
    with pytest.raises(EventFileError, match=r"a\.db3: message 3: "):
        read_events(path)
    found, report = read_events_report(path)
    assert len(found) == 30 and "message 3: " in report.first["left_over"]


def test_a_topic_whose_sensor_changes_is_an_error(tmp_path):
    """Two sensors in one topic are two cameras, or damage."""
    sizes = (64, 48), (64, 48), (32, 24)
    words = mono([5_000, 7_000], [3, 31], [2, 20], [1, 0])
    messages = [
        ("/e", PACKET, k, packet(words, seq=k, base_ns=k * 10**6, size=size)) for k, size in enumerate(sizes)
    ]
    path = write_mcap(tmp_path / "a.mcap", messages)
    with pytest.raises(EventFileError, match="a packet of 32 x 24 pixels after one of 64 x 48; give width="):
        read_events(path)
    found, report = read_events_report(path)
    assert len(found) == 6 and report.faults == {"header": 1}
    assert len(read_events(path, width=64, height=48)) == 6


def test_a_db3_that_was_cut_is_an_error(tmp_path, shared_data):
    """SQLite takes missing bytes of the last page for zeros: three of them would cost an event unsaid."""
    path = tmp_path / "a.db3"
    path.write_bytes((shared_data / "recordings" / "ros2_evt3_640x480.db3").read_bytes()[:-3])
    with pytest.raises(EventFileError, match="2920445 bytes where its header announces 2920448; it was cut"):
        read_events(path)
    found, report = read_events_report(path)
    assert report.truncated and len(found) == 343_473


@pytest.mark.parametrize("frame_id", ["", "a", "ab", "abc", "abcd"])
@pytest.mark.parametrize("encoding", ["mono", "libcaer", "libcaer_cmp"])
def test_padding_follows_the_strings(encoding, frame_id, tmp_path):
    words = {
        "mono": mono([5_000, 7_000], [3, 63], [2, 47], [1, 0]),
        "libcaer": struct.pack("<IiIiIi", 3 << 17 | 2 << 2 | 3, 5, 0, 6, 63 << 17 | 47 << 2 | 1, 7),
        "libcaer_cmp": struct.pack("<7H", 0x1005, 0x2003, 0x3802, 0x1007, 0x203F, 0x4000 | 40, 0x5080),
    }[encoding]
    for make, write in ((Cdr, write_mcap), (Ros1, write_bag), (Cdr, write_db3)):
        path = tmp_path / f"{make.__name__}{write.__name__}"
        write(
            path, [("/e", PACKET, 0, packet(words, encoding, make=make, frame_id=frame_id, base_ns=2_000_999))]
        )
        found = read_events(path)
        assert found == Events([2_005, 2_007], [3, 63], [2, 47], [1, 0], 64, 48)


def test_the_clock_of_libcaer_turns_over_inside_a_packet(tmp_path):
    words = struct.pack("<IiIi", 1, 2**31 - 2, 1, 3)
    path = write_mcap(tmp_path / "a", [("/e", PACKET, 0, packet(words, "libcaer", base_ns=10**18))])
    assert (read_events(path).t_us - 10**15).tolist() == [2**31 - 2, 2**31 + 3]


@pytest.mark.parametrize(("make", "kind"), [(Ros1, "dvs_msgs/EventArray"), (Cdr, "dvs_msgs/msg/EventArray"),
                                            (Ros1, "prophesee_event_msgs/EventArray")])  # fmt: skip
def test_arrays_of_events(make, kind, tmp_path):
    columns = (
        [1_000_002_000, 1_999_999_999, 2_000_000_000, 2_000_000_001],
        [0, 63, 5, 6],
        [47, 0, 1, 2],
        [1, 0, 1, 1],
    )
    message = event_array(*columns, make=make)
    write = write_bag if make is Ros1 else write_mcap
    found = read_events(write(tmp_path / "a", [("/dvs/events", kind, 0, message)]))
    assert found == Events([1_000_002, 1_999_999, 2_000_000, 2_000_000], *columns[1:], width=64, height=48)
    with pytest.raises(EventFileError, match="4 events in"):
        read_events(write(tmp_path / "a", [("/dvs/events", kind, 0, message[:-5])]))


def evt3_words(events: Events, folder: Path) -> np.ndarray:
    write_events(folder / "words.raw", events, format="EVT3")
    data = (folder / "words.raw").read_bytes()
    return np.frombuffer(data[data.index(b"% end\n") + 6 :], "<u2")


def evt3_packets(words: np.ndarray, size: int, first: int = 0) -> Recording:
    parts = [words[start : start + size] for start in range(0, len(words), size)]
    return [("/e", PACKET, k, packet(one.tobytes(), "evt3", first + k)) for k, one in enumerate(parts)]


@pytest.mark.parametrize("size", [1, 7, 10_000])
def test_evt3_goes_on_from_packet_to_packet(size, tmp_path):
    events = stream(300)
    path = write_mcap(tmp_path / "a", evt3_packets(evt3_words(events, tmp_path), size), per_chunk=50)
    assert read_events(path) == events


def test_evt3_that_begins_in_the_middle_skips_what_has_no_time(tmp_path):
    events = stream(300)
    words = evt3_words(events, tmp_path)
    cut = int(np.flatnonzero(words >> 12 == 8)[1])
    path = write_mcap(tmp_path / "a", evt3_packets(words[cut - 40 :], 20))
    found, report = read_events_report(path, "strict")
    assert report.skipped > 0 and len(found) and found == events[len(events) - len(found) :]
    messages = evt3_packets(words, 20)
    path = write_mcap(tmp_path / "b", messages[:3] + messages[5:])
    found, report = read_events_report(path)
    assert report.faults == {"lost": 2}
    assert set(found.t_us.tolist()) <= set(events.t_us.tolist())


def test_what_is_not_read_is_named(tmp_path):
    def fails(data: bytes, said: str) -> None:
        with pytest.raises(EventFileError, match=said):
            read_events(write_mcap(tmp_path / "a", [("/e", PACKET, 0, data)]))

    fails(packet(b"", "evt9"), "events coded as 'evt9'; evt3")
    fails(packet(bytes(9), "mono"), "9 bytes of events that have 8")
    fails(packet(struct.pack("<H", 0x9000), "libcaer_cmp"), "1 words of unknown kind")
    fails(packet(mono([1], [64], [0], [1])), "x=64, y=0; the sensor is 64 x 48")
    fails(packet(mono([9000, 1], [1, 1], [0, 0], [1, 1])), "earlier")
    fails(packet(b"", size=(0, 5)), "a sensor of 0 x 5")
    fails(packet(b"")[:-3], "ends")
    fails(b"\x28\xb5\x2f\xfd" + bytes(40), "compression_mode")
    (tmp_path / "a.db3.zstd").write_bytes(b"\x28\xb5\x2f\xfd" + bytes(40))
    with pytest.raises(EventFileError, match="zstd -d"):
        read_events(tmp_path / "a.db3.zstd")


def test_colours_rows_with_padding_and_16_bits(tmp_path):
    pixels = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3) * 9
    for encoding, order in (("rgb8", [0, 1, 2]), ("bgr8", [2, 1, 0])):
        path = write_mcap(tmp_path / encoding, [("/i", IMAGE, 0, image(7_000, pixels[:, :, order], encoding))])
        grey = np.round(pixels @ [0.299, 0.587, 0.114])
        np.testing.assert_array_equal(read_timed_frames(path).images[0], grey)
    deep = np.array([[1, 70, 65_535]], np.uint16)
    found = read_timed_frames(write_mcap(tmp_path / "d", [("/i", IMAGE, 0, image(7_000, deep, "mono16"))]))
    np.testing.assert_array_equal(found.images[0], deep)
    with pytest.raises(EventFileError, match="coded as 'jpeg2000'"):
        read_timed_frames(write_mcap(tmp_path / "j", [("/i", IMAGE, 0, image(7_000, deep, "jpeg2000"))]))


# ---------------------------------------------------------------- strangers' files


def test_a_packed_recording_without_its_package_names_the_cure(tmp_path, monkeypatch):
    pytest.importorskip("zstandard")
    path = write_mcap(tmp_path / "a", recording(stream()), compression="zstd")
    monkeypatch.setitem(__import__("sys").modules, "zstandard", None)
    with pytest.raises(MissingDependencyError, match=r"pip install evnlos\[ros\]"):
        read_events(path)


@pytest.mark.parametrize("kind", ["bz2", "lz4", "zstd"])
def test_bombs_take_no_memory(kind, tmp_path):
    if kind != "bz2":
        pytest.importorskip({"lz4": "lz4", "zstd": "zstandard"}[kind])
    messages = [("/e", PACKET, 0, packet(bytes(1 << 26)))]
    data = bag_bytes(messages, compression=kind) if kind == "bz2" else mcap_bytes(messages, kind)
    assert len(data) < 1 << 20
    size = struct.pack("<I" if kind == "bz2" else "<Q", len(packet(bytes(1 << 26))))
    path = tmp_path / "bomb"
    for claimed in (0, 1000, 2**31 - 1):
        out = bytearray(data)
        at = out.find(b"size=") + 5 if kind == "bz2" else out.find(kind.encode()) - 16
        out[at : at + 4] = struct.pack("<I", claimed)
        path.write_bytes(out)
        tracemalloc.start()
        with pytest.raises(EventFileError):
            read_events(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 1 << 24, f"{size!r}"


def test_tables_that_are_programs_are_refused(tmp_path):
    path = tmp_path / "view.db3"
    base = sqlite3.connect(path)
    base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
    base.execute(f"INSERT INTO topics VALUES (1, '/e', '{PACKET}', 'cdr')")
    base.execute(
        "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
        "SELECT id, 1 AS topic_id, id AS timestamp, zeroblob(1000000000) AS data FROM n"
    )
    base.commit()
    base.close()
    with pytest.raises(EventFileError, match="views or programs"):
        read_events(path)
    other = sqlite3.connect(tmp_path / "other.db3")
    other.execute("CREATE TABLE notes(a)")
    other.commit()
    other.close()
    with pytest.raises(EventFileError, match="without ROS messages"):
        read_events(tmp_path / "other.db3")


def test_a_bag_is_read_as_it_lies_there(tmp_path):
    """No journal is replayed, nothing is written beside the file, and unmerged messages are told."""
    path = write_db3(tmp_path / "a.db3", recording(stream()))
    (tmp_path / "a.db3-wal").write_bytes(b"x" * 100)
    before = path.read_bytes()
    with pytest.raises(EventFileError, match=r"a\.db3-wal"):
        read_events(path)
    assert read_events_report(path)[0] == stream()
    assert path.read_bytes() == before and sorted(p.name for p in tmp_path.iterdir()) == ["a.db3", "a.db3-wal"]


def test_independent_readers_agree_on_the_containers(tmp_path):
    reader = pytest.importorskip("mcap.reader")
    messages = recording(stream())
    with write_mcap(tmp_path / "a.mcap", messages).open("rb") as file:
        found = [message.data for _, _, message in reader.NonSeekingReader(file).iter_messages()]
    assert found == [data for *_, data in messages]


# ---------------------------------------------------------------- written


def test_written_mcap_comes_back_and_independent_readers_see_all(tmp_path):
    draw = np.random.default_rng(0)
    times = np.sort(draw.integers(0, 30_000_000, 100_000))
    times[50_000:] += 10_000_000  # a silence
    columns = (
        draw.integers(0, 128, len(times)),
        draw.integers(0, 96, len(times)),
        draw.integers(0, 2, len(times)),
    )
    events = Events(times, *columns, width=128, height=96)
    path = tmp_path / "a.mcap"
    write_events(path, (events[start : start + 7_000] for start in range(0, len(events), 7_000)))
    found, report = read_events_report(path, "strict")
    assert found == events
    assert [(one.name, one.kind) for one in report.streams] == [
        ("/event_camera/events", "events"), ("/event_camera/image", "other"),
    ]  # fmt: skip
    with pytest.raises(EventFileError, match="no stream of frames"):
        read_timed_frames(path)  # images of events are no camera's frames
    reader = pytest.importorskip("mcap.reader")
    with path.open("rb") as file:
        seeking = reader.make_reader(file, validate_crcs=True)
        summary = seeking.get_summary()
        stamps = [(channel.topic, message.log_time) for _, channel, message in seeking.iter_messages()]
    assert {channel.topic for channel in summary.channels.values()} == {topic for topic, _ in stamps}
    assert len(stamps) == summary.statistics.message_count and len(summary.chunk_indexes) >= 1
    assert [stamp for _, stamp in stamps] == sorted(stamp for _, stamp in stamps)


def test_what_mcap_cannot_hold_is_refused(tmp_path):
    for times in ([-1], [2**31 * 10**6]):
        with pytest.raises(DataError, match="MCAP packets hold times"):
            write_events(tmp_path / "a.mcap", Events(times, [0], [0], [True], 4, 4))
    with pytest.raises(DataError, match="65536 x 32768"):
        write_events(tmp_path / "a.mcap", Events.empty(10, 40_000))
    write_events(tmp_path / "empty.mcap", Events.empty(10, 20))
    assert read_events(tmp_path / "empty.mcap") == Events.empty(10, 20)
    assert not list(tmp_path.glob("a.mcap*"))
