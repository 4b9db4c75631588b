"""ROS bags: version 1 (`.bag`, records and chunks) and version 2 in SQLite (`.db3`).

A `.db3` is opened read-only and as it lies there: no journal beside it is read, and nothing in it is run.
Formats: wiki.ros.org/Bags/Format/2.0; the tables of rosbag2's sqlite3 storage. Numbers are little endian.
"""

from __future__ import annotations

import sqlite3
import struct
from array import array
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from urllib.parse import quote

from evnlos.events.files.columns import SALVAGE, ReadReport, unreadable
from evnlos.events.files.mcap import MOST_CHUNK_BYTES, Message, Topic, topics_of, unpack
from evnlos.untrusted import open_regular

BAG_SIGNATURE = b"#ROSBAG V2.0\n"
DB3_SIGNATURE = b"SQLite format 3\0"
_SALVAGE = f"copy the file again or {SALVAGE}"
_OP_MESSAGE, _OP_HEADER, _OP_CHUNK, _OP_CHUNK_INFO, _OP_CONNECTION = 2, 3, 5, 6, 7
_MOST_HEADER_BYTES = 1 << 20
_STEPS = 1 << 16  # of SQLite's machine between two looks at what it has taken
_MOST_STEPS_PER_BYTE = 200
_TABLES = "SELECT name, type || ' ' || sql FROM sqlite_schema WHERE name IN ('topics', 'messages')"
_GIVE = "give a bag of ros2 bag record"
_ROWS = "SELECT id FROM messages"
_ROW = "SELECT topic_id, timestamp, data FROM messages WHERE id = ?"

Fields = dict[str, bytes]


class BagFile:
    """A ROS 1 bag.

    Args:
        path: The file.
        report: Takes what is wrong.
    """

    name = "BAG"

    def __init__(self, path: Path, report: ReadReport) -> None:
        self.path, self.report = path, report
        self._size = path.stat().st_size

    def topics(self) -> list[Topic]:
        """Return the topics: from the index behind the chunks, else by reading all."""
        quiet = BagFile(self.path, ReadReport(self.path, strict=False))
        connections: dict[int, Topic] = {}
        counts: dict[int, int] = {}
        start = quiet._index_start()
        if start is not None:
            with suppress(ValueError):  # a damaged index is not needed
                quiet._read_index(start, connections, counts)
        if not connections or not quiet.report.clean:
            connections, counts = {}, {}
            for _ in BagFile(self.path, ReadReport(self.path, strict=False))._walk(connections, frozenset()):
                pass
        return topics_of(connections, counts)

    def messages(self, names: frozenset[str]) -> Iterator[Message]:
        """Yield the messages of the named topics in the order of the file."""
        yield from self._walk({}, names)

    def _index_start(self) -> int | None:
        """Return the place of the index that the bag's first record names; None where it has none."""
        for op, fields, _, _ in self._records_of_file(len(BAG_SIGNATURE)):
            start = int.from_bytes(fields.get("index_pos", b""), "little")
            return start if op == _OP_HEADER and 0 < start < self._size else None
        return None

    def _read_index(self, start: int, connections: dict[int, Topic], counts: dict[int, int]) -> None:
        """Fill the connections, and messages per connection, from the index at byte `start`."""
        for op, fields, data, _ in self._records_of_file(start):
            if op == _OP_CONNECTION:
                self._connect(fields, data, connections)
            elif op == _OP_CHUNK_INFO:
                for at in range(0, len(data) // 8 * 8, 8):
                    number, count = struct.unpack_from("<II", data, at)
                    counts[number] = counts.get(number, 0) + count

    def _walk(self, connections: dict[int, Topic], names: frozenset[str]) -> Iterator[Message]:
        announced: int | None = None
        chunks = 0
        for op, fields, data, at in self._records_of_file(len(BAG_SIGNATURE)):
            if op == _OP_HEADER:
                start = int.from_bytes(fields.get("index_pos", b""), "little")
                announced = int.from_bytes(fields.get("chunk_count", b""), "little") if start else None
            try:
                if op == _OP_CHUNK:
                    chunks += 1
                    method = fields.get("compression", b"none").decode("latin-1")
                    unpacked = memoryview(
                        unpack(method, data, int.from_bytes(fields.get("size", b""), "little"))
                    )
                    inside = _records(unpacked)
                else:
                    inside = iter([(op, fields, data)])
                for inner, named, content in inside:
                    if inner == _OP_CONNECTION:
                        self._connect(named, content, connections)
                    elif inner == _OP_MESSAGE:
                        topic = connections.get(_integer(named, "conn", 4))
                        if topic is None:
                            raise ValueError("a message of a connection that is not announced")
                        if topic.name in names:
                            nanosecond, second = divmod(_integer(named, "time", 8), 1 << 32)
                            yield Message(topic, at, second * 10**9 + nanosecond, content)
            except ValueError as error:
                self.report.fault("left_over", at, str(error), _SALVAGE, lost_bytes=len(data))
        if announced is not None and chunks < announced:
            found = f"{chunks} chunks where {announced} are announced"
            self.report.fault("truncated", self._size, found, _SALVAGE)

    def _connect(self, fields: Fields, data: memoryview, connections: dict[int, Topic]) -> None:
        described = _fields(data)
        name = fields.get("topic", b"").decode("utf-8", "replace")
        type_name = described.get("type", b"").decode("utf-8", "replace")
        connections[_integer(fields, "conn", 4)] = Topic(name, type_name, "ros1")

    def _records_of_file(self, at: int) -> Iterator[tuple[int, Fields, memoryview, int]]:
        """Yield kind, fields, data and place of the records from byte `at`; index records without data."""
        with open_regular(self.path) as file:
            while at < self._size:
                file.seek(at)
                size = int.from_bytes(file.read(4), "little")
                if not 0 < size <= min(_MOST_HEADER_BYTES, self._size - at - 8):
                    found = f"a record header of {size} bytes, {self._size - at} are left in the file"
                    self.report.fault("truncated", at, found, _SALVAGE, lost_bytes=self._size - at)
                    return
                try:
                    fields = _fields(memoryview(file.read(size)))
                    op = _integer(fields, "op", 1)
                except ValueError as error:
                    self.report.fault("left_over", at, str(error), _SALVAGE, lost_bytes=self._size - at)
                    return
                length = int.from_bytes(file.read(4), "little")
                if length > self._size - at - 8 - size:
                    found = f"a record of {length} bytes, {self._size - at - 8 - size} are left"
                    self.report.fault("truncated", at, found, _SALVAGE, lost_bytes=self._size - at)
                    return
                if length > MOST_CHUNK_BYTES:
                    found = f"a record of {length} bytes, at most {MOST_CHUNK_BYTES} are read"
                    raise unreadable(self.path, at, found, "write it again with smaller chunks (rosbag filter)")
                is_wanted = op in (_OP_MESSAGE, _OP_CHUNK, _OP_CHUNK_INFO, _OP_CONNECTION)
                yield op, fields, memoryview(file.read(length) if is_wanted else b""), at
                at += 8 + size + length


def _fields(data: memoryview) -> Fields:
    """Return the fields of a record header: four bytes of length, then name=value."""
    found: Fields = {}
    at = 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        text = bytes(data[at + 4 : at + 4 + size])
        name, mark, value = text.partition(b"=")
        if len(text) != size or not mark:
            raise ValueError("a record header whose fields do not fit into it")
        found[name.decode("latin-1")] = value
        at += 4 + size
    return found


def _integer(fields: Fields, name: str, size: int) -> int:
    value = fields.get(name, b"")
    if len(value) != size:
        raise ValueError(f"a record whose field {name!r} has {len(value)} bytes instead of {size}")
    return int.from_bytes(value, "little")


def _records(data: memoryview) -> Iterator[tuple[int, Fields, memoryview]]:
    """Yield kind, fields and data of the records of a chunk."""
    at = 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        middle = at + 4 + size
        if middle + 4 > len(data):
            raise ValueError("a record header that leaves its chunk")
        fields = _fields(data[at + 4 : middle])
        end = middle + 4 + int.from_bytes(data[middle : middle + 4], "little")
        if end > len(data):
            raise ValueError("a record that leaves its chunk")
        yield _integer(fields, "op", 1), fields, data[middle + 4 : end]
        at = end


class Db3File:
    """A ROS 2 bag in SQLite.

    Args:
        path: The file.
        report: Takes what is wrong.
    """

    name = "DB3"

    def __init__(self, path: Path, report: ReadReport) -> None:
        self.path, self.report = path, report
        with open_regular(path) as file:
            self._size = file.seek(0, 2)

    def topics(self) -> list[Topic]:
        """Return the topics in the order of the table."""
        with self._errors(), closing(self._open()) as base:
            return list(self._topics(base).values())

    def _topics(self, base: sqlite3.Connection) -> dict[int, Topic]:
        found: dict[int, Topic] = {}
        for number, name, kind, coding in base.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            if not isinstance(number, int) or not all(isinstance(text, str) for text in (name, kind, coding)):
                raise unreadable(self.path, 0, "a table of topics that holds no names", "copy the file again")
            found[number] = Topic(name, kind.replace("/msg/", "/"), coding)
        return found

    def messages(self, names: frozenset[str]) -> Iterator[Message]:
        """Yield the messages of the named topics in the order of their receipt."""
        self.report.place = "byte"
        if Path(f"{self.path}-wal").exists() and Path(f"{self.path}-wal").stat().st_size:
            found = f"messages may still stand in {self.path.name}-wal beside it, which is not read"
            cure = f"close the recorder, or open and close the bag with ros2 bag info, or {SALVAGE}"
            self.report.fault("truncated", 0, found, cure)
        self._check_size()
        with self._errors():
            base = self._open()
        with closing(base):
            with self._errors():
                wanted = {number: topic for number, topic in self._topics(base).items() if topic.name in names}
            rows = self._rows(base, wanted)
            self.report.place = "message"  # SQLite does not say where in the file its bytes stand
            for row in rows:
                found = self._row(base, row)
                if found is None or found[0] not in wanted:
                    self.report.fault("left_over", row, "it holds no bytes of a message", _SALVAGE)
                else:
                    yield Message(wanted[found[0]], row, found[1], found[2])

    def _check_size(self) -> None:
        """Report a file that is shorter than its header says: SQLite takes what is missing for zeros."""
        with open_regular(self.path) as file:
            head = file.read(100)
        page = int.from_bytes(head[16:18], "big")
        announced = (1 << 16 if page == 1 else page) * int.from_bytes(head[28:32], "big")
        if head[24:28] == head[92:96] and self._size < announced:  # else the writer did not keep that number
            found = f"the file has {self._size} bytes where its header announces {announced}"
            cure = f"it was cut: copy the file again or {SALVAGE}"
            self.report.fault("truncated", self._size, found, cure)

    def _row(self, base: sqlite3.Connection, row: int) -> tuple[int, int, bytes] | None:
        """Return topic, time of receipt and bytes of a message; None where it is damaged."""
        try:
            found = base.execute(_ROW, (row,)).fetchone()
        except (sqlite3.Error, OverflowError, MemoryError):
            return None
        if found is None or [type(value) for value in found] != [int, int, bytes]:
            return None
        return found

    def _rows(self, base: sqlite3.Connection, wanted: dict[int, Topic]) -> array:
        """Return the numbers of the messages in order; their bytes are read one message at a time."""
        rows = array("q")
        marks = ",".join("?" * len(wanted))
        try:
            self._collect(
                base, f"{_ROWS} WHERE topic_id IN ({marks}) ORDER BY timestamp, id", tuple(wanted), rows
            )
        except (sqlite3.Error, TypeError, OverflowError, MemoryError) as error:
            found = f"SQLite cannot read it ({' '.join(str(error).split())[:120]})"
            self.report.fault("truncated", 0, found, _SALVAGE)
            del rows[:]
            with suppress(sqlite3.Error, TypeError, OverflowError, MemoryError):  # what the damage leaves
                self._collect(base, f"{_ROWS} NOT INDEXED WHERE topic_id IN ({marks})", tuple(wanted), rows)
        return rows

    def _collect(self, base: sqlite3.Connection, text: str, values: tuple[int, ...], rows: array) -> None:
        for (row,) in base.execute(text, values):
            rows.append(row)
            if len(rows) > self._size // 4:
                raise unreadable(
                    self.path, 0, f"more messages than a file of {self._size} bytes holds", _SALVAGE
                )

    def _open(self) -> sqlite3.Connection:
        """Open the file for reading only, without its journal; its tables may only be plain ones."""
        name = quote(str(self.path.absolute()))
        base = sqlite3.connect(f"file:{name}?mode=ro&immutable=1", uri=True, isolation_level=None)
        try:
            base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(MOST_CHUNK_BYTES, max(self._size, 1 << 16)))
            base.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
            pragmas = ["trusted_schema = OFF", "cell_size_check = ON", "temp_store = MEMORY", "mmap_size = 0"]
            if not self.report.strict:  # SQLite then opens a file that was cut as well; it stays read-only
                pragmas.append("writable_schema = ON")
            for pragma in pragmas:
                base.execute(f"PRAGMA {pragma}").fetchall()
            base.set_progress_handler(_Patience(self._size), _STEPS)
            tables = dict(base.execute(_TABLES).fetchall())
            if set(tables) != {"topics", "messages"}:
                raise unreadable(self.path, 0, "an SQLite file without ROS messages", _GIVE)
            if not all(str(text).lower().startswith("table create table") for text in tables.values()):
                raise unreadable(self.path, 0, "tables that are views or programs", _GIVE)
            base.set_authorizer(_only_read)
        except BaseException:
            base.close()
            raise
        return base

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OverflowError, TypeError, UnicodeDecodeError, MemoryError) as error:
            found = f"SQLite cannot read it ({' '.join(str(error).split())[:120]})"
            raise unreadable(self.path, 0, found, f"the file is damaged or was cut: {_SALVAGE}") from None


class _Patience:
    """Ends a query that takes more steps than a file of that size can be worth."""

    def __init__(self, size: int) -> None:
        self._left = (size * _MOST_STEPS_PER_BYTE) // _STEPS + 1000

    def __call__(self) -> int:
        self._left -= 1
        return self._left < 0


def _only_read(action: int, *_: object) -> int:
    allowed = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)
    return sqlite3.SQLITE_OK if action in allowed else sqlite3.SQLITE_DENY
