"""Events that arrive as UDP packets, ours or AEStream's, and a sender for cameras' programs and for tests.

A packet of AEStream is words of 32 bits, little endian: row in bits 0-14, polarity in bit 15, column in bits
16-30; where bit 31 is clear the next word is the time, microseconds. Zeros may fill up the last packet.
"""

from __future__ import annotations

import select
import socket
from collections import Counter
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Literal, NamedTuple

import numpy as np

from evnlos.errors import ConfigError, DataError
from evnlos.events.files.columns import Columns, cut, trusted_events
from evnlos.live.growing_file import OrderedTail
from evnlos.live.packet import (
    UNKNOWN_US,
    USUAL_EVENTS,
    Batch,
    Chunk,
    Clock,
    Heading,
    Packet,
    SystemClock,
    pack,
    unpack,
    unpack_all,
)
from evnlos.types import Events

_BUFFER_BYTES = 1 << 22  # asked of the system, which may give less
_BATCH = 64  # most packets in a chunk
_GATHER_S = 0.001  # packets are gathered so long: a chunk each would cost more than it hastens
_NAP_S = 0.05
_TURN = 1 << 32
_LATE = 1 << 31
_PADDING = bytes(8)  # as an event, it would be one at pixel (0, 0) and time 0
_AGREEING = 100  # packets in a row that are left out and follow each other: 0.2 s of a calm stream
_FAULTS = ("malformed packets", "lost packets", "late packets", "streams taken up anew")


class Listener:
    """A port at which datagrams arrive.

    Args:
        scheme: Kind of the address, for messages.
        host: Address to listen at; 127.0.0.1 takes packets of this machine only.
        port: Port; 0 takes a free one.
        clock: The clock that arrivals are told by.

    Attributes:
        port: The port that is listened at.
        name: Its address.

    Raises:
        ConfigError: The address can't be listened at.
    """

    def __init__(self, scheme: str, host: str, port: int, clock: Clock) -> None:
        self._socket, self._clock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), clock
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise ConfigError(
                f"{scheme}://{host}:{port} can't be listened at ({error}); give a free port of this machine"
            ) from None
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self.name = f"{scheme}://{host}:{self.port}"

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()

    def receive(self) -> tuple[list[bytes], float]:
        """Return the packets that lie ready, after a short wait for the first one, and when that one came."""
        if not select.select([self._socket], [], [], _NAP_S)[0]:
            return [], 0.0
        first_s, found = self._clock.now(), []
        self._clock.sleep(_GATHER_S)
        while len(found) < _BATCH:
            try:
                found.append(self._socket.recv(65_536))
            except BlockingIOError:
                break
            except OSError:  # a sender's closed port, as some systems report it
                continue
        return found, first_s


class UdpSource:
    """A source that listens for packets (`evnlos.live.packet`).

    A malformed packet, one of another sensor, and one that comes after its successor are left out and counted;
    so are packets that never came, by the gaps in the sequence. A packet with the number 0 begins a new stream;
    so does the last of 100 that were left out in a row and follow each other: then the stream was wrong.

    Args:
        host: Address to listen at; 127.0.0.1 takes packets of this machine only.
        port: Port; 0 takes a free one.
        idle_s: End after so many seconds without a packet, counted from the first one; None = never.

    Attributes:
        port: The port that is listened at.

    Raises:
        ConfigError: The address can't be listened at.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0, *, idle_s: float | None = None) -> None:
        self._clock, self._idle_s = SystemClock(), idle_s
        self._listener = Listener("udp", host, port, self._clock)
        unpack(pack(Packet(0, Events.empty(1, 1))))  # compiles the decoder before the first packet comes
        self.port = self._listener.port
        self.name, self.has_frames, self.waits = self._listener.name, False, False
        self._faults: Counter[str] = Counter()
        self._stream: _Stream | None = None
        self._other: _Stream | None = None  # what packets that were left out agree on

    def faults(self) -> dict[str, int]:
        """Return how many packets were malformed, lost and late, and how often a stuck stream was taken up."""
        return {name: self._faults[name] for name in _FAULTS}

    def close(self) -> None:
        """Stop listening."""
        self._listener.close()

    def chunks(self, stop: Callable[[], bool]) -> Iterator[Chunk]:
        """Yield what arrived since the chunk before, until a packet says that it is the last one."""
        heard_s: float | None = None
        ended = False
        try:
            while not (stop() or ended):
                datagrams, first_s = self._listener.receive()
                last_s = self._clock.now()
                if not datagrams:
                    if self._idle_s is not None and heard_s is not None and last_s - heard_s > self._idle_s:
                        return
                    continue
                heard_s = last_s
                batch, malformed = unpack_all(datagrams)
                self._faults["malformed packets"] += malformed
                if batch is None:
                    continue
                for first, last, begins in self._runs(batch):
                    yield _chunk(batch, first, last, begins, first_s, last_s)
                    ended = ended or any(heading.is_last for heading in batch.headings[first:last])
        finally:
            self.close()

    def _runs(self, batch: Batch) -> Iterator[tuple[int, int, bool]]:
        """Yield (first, last + 1) of packets that follow each other in a stream, and whether they begin it."""
        first, begins = 0, False
        for number in range(len(batch.headings)):
            place = self._place(batch, number)
            if place != "next" and number > first:
                yield first, number, begins
            if place != "next":
                first = number + (place == "left out")
                begins = place == "first"
        if first < len(batch.headings):
            yield first, len(batch.headings), begins

    def _place(self, batch: Batch, number: int) -> Literal["first", "next", "left out"]:
        """Return a packet's place in the stream, and count what is wrong."""
        heading, times = batch.headings[number], batch.columns["t_us"]
        span = None
        if heading.length:
            span = int(times[batch.edges[number]]), int(times[batch.edges[number + 1] - 1])
        if heading.sequence == 0 or self._stream is None:
            self._stream, self._other = _Stream.after(heading, span), None
            return "first" if heading.sequence == 0 else "next"
        fault, gap = self._stream.fault(heading, span)
        if fault is None:
            self._faults["lost packets"] += gap
            self._stream, self._other = _Stream.after(heading, span, self._stream), None
            return "next"
        # One forged or broken packet from far ahead would stop the stream for good: who goes on is believed.
        agrees = self._other is not None and self._other.fault(heading, span)[0] is None
        self._other = _Stream.after(heading, span, self._other if agrees else None)
        if self._other.packets >= _AGREEING:
            self._faults["streams taken up anew"] += 1
            self._stream, self._other = self._other, None
            return "first"
        self._faults[fault] += 1
        return "left out"


class _Stream(NamedTuple):
    """What is expected of the packets of a stream."""

    following: int
    """Number of the next packet."""
    newest_us: int | None
    """Time of the newest event."""
    size: tuple[int, int]
    """Width and height of the sensor."""
    packets: int
    """Packets of it so far that followed each other."""

    @staticmethod
    def after(heading: Heading, span: tuple[int, int] | None, before: _Stream | None = None) -> _Stream:
        """Return the stream after a packet, whose events are from `span[0]` to `span[1]`."""
        newest = span[1] if span is not None else None if before is None else before.newest_us
        count = 1 + (0 if before is None else before.packets)
        return _Stream((heading.sequence + 1) % _TURN, newest, (heading.width, heading.height), count)

    def fault(self, heading: Heading, span: tuple[int, int] | None) -> tuple[str | None, int]:
        """Return what is wrong with a packet if it is of the stream, and how many before it are missing."""
        if (heading.width, heading.height) != self.size:
            return "malformed packets", 0
        gap = (heading.sequence - self.following) % _TURN
        is_earlier = span is not None and self.newest_us is not None and span[0] < self.newest_us
        return ("late packets" if gap >= _LATE or is_earlier else None), gap


def _chunk(batch: Batch, first: int, last: int, begins: bool, first_s: float, last_s: float) -> Chunk:
    events = batch.events(first, last)
    until = int(events.t_us[-1]) if len(events) else UNKNOWN_US
    return Chunk(events, until, first_s, last_s, restart=begins)


class _AestreamTail:
    start = 0

    def __init__(self) -> None:
        self.arrived_us = 0
        self._newest: int | None = None

    def feed(self, data: bytes) -> tuple[Columns, int]:
        data = data[: (len(data.rstrip(b"\0")) + 7) // 8 * 8] if data.endswith(_PADDING) else data
        words = np.frombuffer(data[: len(data) // 4 * 4], "<u4").astype(np.int64)
        is_timed = bool(len(words)) and not words[0] >> 31
        at = words[: len(words) // 2 * 2 : 2] if is_timed else words
        good = (at >> 31 == 0) if is_timed else (at >> 31 == 1)
        faults = int((~good).sum()) + (4 * (len(at) << is_timed) != len(data))
        if is_timed:
            newest = int(words[1]) if self._newest is None else self._newest
            t_us = newest + (words[1 : 2 * len(at) : 2] - newest + _LATE) % _TURN - _LATE
        else:
            t_us = np.full(len(at), self.arrived_us)
        at, t_us = at[good], t_us[good]
        if len(at):
            self._newest = max(int(t_us.max()), int(t_us[0]) if self._newest is None else self._newest)
        x, y = ((at >> bit & 0x7FFF).astype(np.uint16) for bit in (16, 0))
        return {"t_us": t_us, "x": x, "y": y, "p": (at >> 15 & 1).astype(bool)}, faults


class AestreamSource:
    """A source that listens for packets of AEStream; which of them were lost can't be known.

    Args:
        host: Address to listen at; 127.0.0.1 takes packets of this machine only.
        port: Port; 0 takes a free one.
        width: Sensor width, pixels: the packets do not say it.
        height: Sensor height, pixels.
        idle_s: End after so many seconds without a packet, counted from the first one; None = never.

    Raises:
        ConfigError: The address can't be listened at, or the sensor size is missing.
    """

    def __init__(
        self, host: str, port: int, width: int | None, height: int | None, *, idle_s: float | None = None
    ) -> None:
        if width is None or height is None:
            raise ConfigError("packets of AEStream say no sensor size; give --width and --height")
        self._clock, self._idle_s, self._size = SystemClock(), idle_s, (width, height)
        self._listener = Listener("aestream", host, port, self._clock)
        self.port, self.name = self._listener.port, self._listener.name
        self.has_frames, self.waits = False, False
        self._faults: Counter[str] = Counter()

    def faults(self) -> dict[str, int]:
        """Return how many events were damaged or came late, and how often a stream began anew."""
        return {name: self._faults[name] for name in ("damaged or late events", "streams taken up anew")}

    def close(self) -> None:
        """Stop listening."""
        self._listener.close()

    def chunks(self, stop: Callable[[], bool]) -> Iterator[Chunk]:
        """Yield what arrived since the chunk before."""
        begun_s, heard_s, useless, begins = self._clock.now(), None, 0, False
        tail = OrderedTail(words := _AestreamTail(), *self._size)
        try:
            while not stop():
                datagrams, first_s = self._listener.receive()
                last_s = self._clock.now()
                heard_s = last_s if datagrams else heard_s
                if self._idle_s is not None and heard_s is not None and last_s - heard_s > self._idle_s:
                    return
                words.arrived_us = round((last_s - begun_s) * 1e6)
                for data in datagrams:
                    before = tail.faults
                    events = tail.feed(data)
                    self._faults["damaged or late events"] += tail.faults - before
                    useless = 0 if len(events) else useless + 1
                    if len(events):
                        yield Chunk(events, int(events.t_us[-1]), first_s, last_s, restart=begins)
                        begins = False
                    elif useless == _AGREEING:
                        useless, begins = 0, True
                        tail = OrderedTail(words := _AestreamTail(), *self._size)
                        self._faults["streams taken up anew"] += 1
        finally:
            self.close()


class UdpSender:
    """Sends a stream as packets; use it as a context, whose end tells the receiver that the stream ends.

    Args:
        host: Address of the receiver.
        port: Its port.

    Example:
        >>> source = UdpSource()
        >>> with UdpSender("127.0.0.1", source.port) as sender:
        ...     sender.send(Events([5, 9], [1, 2], [0, 1], [True, False], width=4, height=2))
        >>> [chunk.events for chunk in source.chunks(lambda: False)]
        [Events(2 events, 4 x 2, 5..9 us, 50 % ON)]
    """

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._to = host, port
        self._number = 0  # tells the receiver that a new stream begins
        self._size: tuple[int, int] | None = None

    def __enter__(self) -> UdpSender:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._size is not None:
            self._put(Packet(self._number, Events.empty(self._size[1], self._size[0]), is_last=True))
        self._socket.close()

    def send(self, events: Events) -> None:
        """Send the next events of the stream at once, in as many packets as they need.

        Raises:
            DataError: They do not fit into packets (`pack`).
        """
        self._size = events.shape
        columns = {"t_us": events.t_us, "x": events.x, "y": events.y, "p": events.p}
        for start in range(0, len(events), USUAL_EVENTS):
            part = cut(columns, start, min(start + USUAL_EVENTS, len(events)))
            self._put(Packet(self._number, trusted_events(part, events.width, events.height)))

    def _put(self, packet: Packet) -> None:
        self._socket.sendto(pack(packet), self._to)
        self._number = (self._number + 1) % _TURN


def send_timed(sender: UdpSender, events: Events, *, speed: float = 1.0, clock: Clock | None = None) -> None:
    """Send a recording at true speed, in steps of 2 ms.

    Args:
        sender: Where to.
        events: The recording.
        speed: How many times faster than life.
        clock: The clock to go by.

    Raises:
        DataError: The speed is not positive.
    """
    if not 0 < speed < np.inf:
        raise DataError(f"speed is {speed}; give a positive number")
    clock = clock or SystemClock()
    start_s, step_us = clock.now(), max(round(2000 * speed), 1)
    at = 0
    while at < len(events):
        first = int(events.t_us[0])
        until = int(events.t_us[at]) + step_us
        stop = int(np.searchsorted(events.t_us, until, "right"))
        clock.sleep(start_s + (until - first) / 1e6 / speed - clock.now())
        columns = {"t_us": events.t_us, "x": events.x, "y": events.y, "p": events.p}
        sender.send(trusted_events(cut(columns, at, stop), events.width, events.height))
        at = stop
