"""Recordings of ROS: topics of events and of images in `.db3`, `.mcap` and `.bag`.

A topic of events is one stream. EVT3 goes on from packet to packet, so the words of a topic are one row of
words; before the first whole time, and after packets that were lost, events have no time and are skipped.
"""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from evnlos.events.files.columns import (
    SALVAGE,
    ColumnCheck,
    Columns,
    ReadReport,
    Stream,
    StreamKind,
    allocate,
    choose_stream,
    collect,
    cut,
    unreadable,
)
from evnlos.events.files.evt3 import WRAP_US
from evnlos.events.files.mcap import Message, Topic
from evnlos.events.files.raw import CODECS
from evnlos.events.files.ros_messages import ARRAYS, IMAGES, PACKETS, EventArray, Packet, image_of
from evnlos.events.files.words import FAULTS, STATE_SIZE, TRIGGERS, new_state, report_faults

_LOG = logging.getLogger("evnlos")
_BLOCK_BYTES = 1 << 18  # its events stay in the cache until they are copied
_STAMPS = 200  # packets whose stamps are looked at
_CURE = f"the message is damaged: copy the file again or {SALVAGE}"
_FOREIGN = 0x7000  # an EVT3 word that decoders pass
_EVENTLESS = frozenset({0, 3})  # kinds of EVT3 words that only say where: rows and bases of vectors


class Container(Protocol):
    """A file of messages."""

    name: str

    def topics(self) -> list[Topic]:
        """Return the topics."""
        ...

    def messages(self, names: frozenset[str]) -> Iterator[Message]:
        """Yield the messages of the named topics."""
        ...


def streams_of(topics: Iterable[Topic]) -> tuple[Stream, ...]:
    """Return the topics as streams; images that were rendered from events are no camera's frames."""
    found = []
    for topic in topics:
        kind: StreamKind = "other"
        if topic.type in PACKETS + ARRAYS:
            kind = "events"
        elif topic.type in IMAGES and not topic.is_rendered:
            kind = "frames"
        found.append(Stream(topic.name, kind, topic.type, topic.messages))
    return tuple(found)


class RosSource:
    """One topic of events of a ROS recording."""

    def __init__(
        self,
        container: Container,
        path: Path,
        report: ReadReport,
        width: int | None,
        height: int | None,
        topic: str | None,
    ) -> None:
        self.path, self.report, self._container = path, report, container
        report.format = container.name
        report.streams = streams_of(container.topics())
        if not report.streams:
            for _ in container.messages(frozenset()):  # in strict mode the damage that hid them is the error
                pass
        chosen = choose_stream(path, report.streams, topic, "events", report.strict)
        report.topic = chosen.name
        self._is_packet = chosen.type in PACKETS
        if width is not None:
            report.set_geometry(width, height, "caller")
        else:
            self._find_geometry()

    def _messages(self) -> Iterator[Message]:
        return self._container.messages(frozenset([self.report.topic]))

    def _find_geometry(self) -> None:
        """Take the sensor size of the first whole message."""
        for message in self._messages():
            parsed = self._parsed(message)
            if parsed is not None:
                return self.report.set_geometry(parsed.width, parsed.height, "header", message.offset)
        raise unreadable(
            self.path, 0, f"topic {self.report.topic} holds no whole message", "copy the file again"
        )

    def _parsed(self, message: Message) -> Packet | EventArray | None:
        try:
            return Packet(message) if self._is_packet else EventArray(message)
        except ValueError as error:
            self.report.fault("left_over", message.offset, str(error), _CURE, lost_bytes=len(message.data))
            return None

    def blocks(self) -> Iterator[Columns]:
        """Yield the events: of about a megabyte of EVT3, or of one message."""
        self.report.faults.clear()  # those of the search for the size are met again
        self.report.first.clear()
        self.report.bytes_left_over, self.report.truncated = 0, False
        words = _Words(self.report)
        place = [0]
        check = ColumnCheck(self.report, lambda _: place[0])
        for message in self._messages():
            parsed = self._parsed(message)
            if parsed is None:
                continue
            place[0] = message.offset
            self._compare_size(parsed, message.offset)
            if isinstance(parsed, EventArray):
                yield from self._columns(message, parsed, check)
            elif parsed.encoding == "trigger":
                self.report.triggers += len(parsed.events) // 8
            elif parsed.encoding == "evt3":
                yield from words.add(parsed, message.offset)
            else:
                words.follow(parsed.seq, message.offset)
                yield from self._columns(message, parsed, check)
        yield from words.decoded()

    def _compare_size(self, parsed: Packet | EventArray, offset: int) -> None:
        """Report a packet whose sensor is another one than the first packet's."""
        sides, first = (parsed.width, parsed.height), (self.report.width, self.report.height)
        is_told = isinstance(parsed, EventArray) or parsed.encoding != "trigger"
        if is_told and self.report.geometry_from == "header" and sides != first:
            found = f"a packet of {sides[0]} x {sides[1]} pixels after one of {first[0]} x {first[1]}"
            self.report.fault("header", offset, found, f"give width= and height=, or {SALVAGE}")

    def _columns(self, message: Message, parsed: Packet | EventArray, check: ColumnCheck) -> Iterator[Columns]:
        unknown = 0
        try:
            found = parsed.columns()
        except ValueError as error:
            self.report.fault("unknown", message.offset, str(error), _CURE, lost_bytes=len(message.data))
            return
        columns, unknown = found if isinstance(found, tuple) else (found, 0)
        if unknown:
            text = f"{unknown} words of unknown kind in a packet"
            self.report.fault("unknown", message.offset, text, _CURE, count=unknown, lost_bytes=2 * unknown)
        if len(columns["t_us"]):
            yield check(columns)

    def read(self) -> Columns:
        """Return all events of the topic."""
        return collect(self.blocks(), self.path.stat().st_size)

    def words_of_file(self) -> Iterator[NDArray]:
        """Yield blocks of the topic's EVT3 words, from the first whole time on."""
        words = _Words(self.report)
        for message in self._messages():
            parsed = self._parsed(message)
            if isinstance(parsed, Packet) and parsed.encoding == "evt3":
                words.gather(parsed, message.offset)
                if words.is_full:
                    yield words.take()[0]
        yield words.take()[0]


class _Words:
    """The EVT3 words of a topic, packet by packet, and their decoder."""

    def __init__(self, report: ReadReport) -> None:
        self._report = report
        self._state = new_state()
        self._seq: int | None = None
        self._is_timed = False  # whether a whole time was seen: TIME_HIGH, then TIME_LOW
        self._high_seen = False
        self._parts: list[NDArray] = []
        self._starts: list[int] = []
        self._offsets: list[int] = []
        self._size = 0

    @property
    def is_full(self) -> bool:
        """Whether enough words are held for a block."""
        return 2 * self._size >= _BLOCK_BYTES

    def follow(self, seq: int, offset: int) -> bool:
        """Report messages that are missing before this one; return whether any are."""
        before, self._seq = self._seq, seq
        if before is None or seq == before + 1:
            return False
        lost = seq - before - 1
        found = f"packet {seq} follows packet {before}" + (f": {lost} were lost" if lost > 0 else "")
        cure = f"the recorder lost data; {SALVAGE} to go on behind the gap"
        self._report.fault("lost", offset, found, cure, count=max(lost, 1))
        return True

    def gather(self, packet: Packet, offset: int) -> None:
        """Take the words of a packet."""
        if self.follow(packet.seq, offset):
            self._is_timed = self._high_seen = False
        if len(packet.events) % 2:
            found = f"{len(packet.events)} bytes of EVT3, whose words have two"
            self._report.fault("left_over", offset, found, _CURE, lost_bytes=1)
        words = np.frombuffer(packet.events, "<u2", len(packet.events) // 2)
        if not self._is_timed:
            words = self._without_untimed(words)
        if len(words):
            self._parts.append(words)
            self._starts.append(self._size)
            self._offsets.append(offset)
            self._size += len(words)

    def _without_untimed(self, words: NDArray) -> NDArray:
        """Return the words with all that is before the first TIME_LOW behind a TIME_HIGH made foreign."""
        words = words.copy()
        kinds = words >> 12
        start = 0
        if not self._high_seen:
            highs = np.flatnonzero(kinds == 8)
            start = int(highs[0]) if len(highs) else len(words)
            self._high_seen = bool(len(highs))
        lows = start + np.flatnonzero(kinds[start:] == 6)
        self._is_timed = self._high_seen and bool(len(lows))
        stop = int(lows[0]) if len(lows) else len(words)
        untimed = np.isin(kinds[:stop], list(_EVENTLESS), invert=True)
        untimed[start:stop] &= kinds[start:stop] != 8
        gone = kinds[:stop][untimed]
        self._report.skipped += int(((gone == 2) | (gone == 4) | (gone == 5)).sum())
        words[:stop][untimed] = _FOREIGN
        return words

    def take(self) -> tuple[NDArray, list[int], list[int]]:
        """Return the words held, where each packet begins in them and in the file; they are held no more."""
        words = np.concatenate(self._parts) if self._parts else np.empty(0, np.uint16)
        starts, offsets = self._starts, self._offsets
        self._parts, self._starts, self._offsets, self._size = [], [], [], 0
        return words, starts, offsets

    def add(self, packet: Packet, offset: int) -> Iterator[Columns]:
        """Take the words of a packet, and yield events where enough are held."""
        self.gather(packet, offset)
        if self.is_full:
            yield from self.decoded()

    def decoded(self) -> Iterator[Columns]:
        """Yield the events of the words that are held."""
        words, starts, offsets = self.take()
        if not len(words):
            return
        codec, report, state = CODECS["EVT3"], self._report, self._state
        out = allocate(codec.bound(words))
        columns = out["t_us"], out["x"], out["y"], out["p"]
        count = codec.decode(words, state, *columns, report.width, report.height)
        report.triggers += int(state[TRIGGERS])
        state[TRIGGERS] = 0
        if state[FAULTS:STATE_SIZE:2].any():
            report_faults(report, state, words, codec, lambda index: offsets[bisect_right(starts, index) - 1])
        if count:
            yield cut(out, 0, count)


def ros_frames(
    container: Container, path: Path, report: ReadReport, topic: str | None
) -> Iterator[tuple[int, NDArray]]:
    """Yield the stamp [us] and the image, uint8 or uint16 [H, W], of each image of a topic.

    Raises:
        EventFileError: The file has no images, or images of several sizes, or is damaged.
    """
    report.streams = streams_of(container.topics())
    report.topic = choose_stream(path, report.streams, topic, "frames", report.strict).name
    offset = _sensor_offset(container, path, report)
    kind = None
    for message in container.messages(frozenset([report.topic])):
        try:
            stamp_ns, image = image_of(message)
            kind = kind or (image.shape, image.dtype)
            if (image.shape, image.dtype) != kind:
                raise ValueError(f"an image {image.shape} {image.dtype} after {kind[0]} {kind[1]}")
        except ValueError as error:
            report.fault("left_over", message.offset, str(error), _CURE, lost_bytes=len(message.data))
            continue
        yield stamp_ns // 1000 - offset, image


def _sensor_offset(container: Container, path: Path, report: ReadReport) -> int:
    """Return what to take from ROS times to get the events' clock, microseconds.

    EVT3 has the sensor's own clock, all other events have ROS times. The stamp of a packet is the ROS time of
    its first event: the median over the first packets is the offset.
    """
    topics = [stream.name for stream in report.streams if stream.type in PACKETS]
    offsets: list[int] = []
    turns, before = 0, 0
    for message in container.messages(frozenset(topics if len(topics) == 1 else [])):
        try:
            packet = Packet(message)
        except ValueError:
            continue
        if packet.encoding != "evt3" or len(offsets) == _STAMPS:
            break
        words = np.frombuffer(packet.events, "<u2", len(packet.events) // 2)
        highs = np.flatnonzero(words >> 12 == 8)
        lows = np.flatnonzero(words >> 12 == 6)
        lows = lows[lows > highs[0]] if len(highs) else lows[:0]
        if len(lows):
            clock = int(words[highs[0]] & 0xFFF) << 12 | int(words[lows[0]] & 0xFFF)
            turns += clock < before - WRAP_US // 2
            before = clock
            offsets.append(packet.stamp_ns // 1000 - turns * WRAP_US - clock)
    if len(topics) > 1:
        _LOG.warning("%s: %d topics of events: the frames keep the time of ROS", path, len(topics))
    return int(np.median(offsets)) if offsets else 0
