"""Events that arrive as UDP packets, and a sender for cameras' programs and for tests."""

from __future__ import annotations

import select
import socket
from collections import Counter
from collections.abc import Callable, Iterator
from types import TracebackType

import numpy as np

from evnlos.errors import ConfigError, DataError
from evnlos.events.io.columns import cut, trusted_events
from evnlos.live.chunk import UNKNOWN_US, Chunk
from evnlos.live.clock import Clock, SystemClock
from evnlos.live.packet import USUAL_EVENTS, Batch, Packet, pack, unpack, unpack_all
from evnlos.types import Events

_BUFFER_BYTES = 1 << 22  # asked of the system, which may give less
_BATCH = 64  # most packets in a chunk
_GATHER_S = 0.001  # packets are gathered so long: a chunk each would cost more than it hastens
_NAP_S = 0.05
_TURN = 1 << 32
_LATE = 1 << 31


class UdpSource:
    """A source that listens for packets (`evnlos.live.packet`).

    A malformed packet, one of another sensor, and one that comes after its successor are left out and counted;
    so are packets that never came, by the gaps in the sequence. A packet with the number 0 begins a new stream.

    Args:
        host: Address to listen at; 127.0.0.1 takes packets of this machine only.
        port: Port; 0 takes a free one.
        idle_s: End after so many seconds without a packet; None = never.
        clock: The clock that arrivals are told by.

    Attributes:
        port: The port that is listened at.

    Raises:
        ConfigError: The address can't be listened at.
    """

    def __init__(
        self, host: str = "127.0.0.1", port: int = 0, *, idle_s: float | None = None, clock: Clock | None = None
    ) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise ConfigError(
                f"udp://{host}:{port} can't be listened at ({error}); give a free port of this machine"
            ) from None
        self._socket.setblocking(False)
        unpack(pack(Packet(0, Events.empty(1, 1))))  # compiles the decoder before the first packet comes
        self.port: int = self._socket.getsockname()[1]
        self.name, self.has_frames, self.waits = f"udp://{host}:{self.port}", False, False
        self._clock, self._idle_s = clock or SystemClock(), idle_s
        self._faults: Counter[str] = Counter()
        self._next: int | None = None
        self._newest: int | None = None
        self._size: tuple[int, int] | None = None

    def faults(self) -> dict[str, int]:
        """Return how many packets were malformed, lost and late."""
        return {name: self._faults[name] for name in ("malformed packets", "lost packets", "late packets")}

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()

    def chunks(self, stop: Callable[[], bool]) -> Iterator[Chunk]:
        """Yield what arrived since the chunk before, until a packet says that it is the last one."""
        heard_s, ended = self._clock.now(), False
        try:
            while not (stop() or ended):
                datagrams, first_s = self._receive()
                last_s = self._clock.now()
                if not datagrams:
                    if self._idle_s is not None and last_s - heard_s > self._idle_s:
                        return
                    continue
                heard_s = last_s
                batch, malformed = unpack_all(datagrams)
                self._faults["malformed packets"] += malformed
                if batch is None:
                    continue
                for first, last in self._runs(batch):
                    yield _chunk(batch, first, last, first_s, last_s)
                    ended = ended or any(heading.is_last for heading in batch.headings[first:last])
        finally:
            self.close()

    def _receive(self) -> tuple[list[bytes], float]:
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

    def _runs(self, batch: Batch) -> Iterator[tuple[int, int]]:
        """Yield (first, last + 1) of packets that follow each other in one stream; count what is left out."""
        first = 0
        for number, heading in enumerate(batch.headings):
            is_next = self._is_next(batch, number)
            if (not is_next or heading.sequence == 0) and number > first:
                yield first, number
            if not is_next:
                first = number + 1
            elif heading.sequence == 0:  # another stream: not to be joined with the one before
                first = number
        if first < len(batch.headings):
            yield first, len(batch.headings)

    def _is_next(self, batch: Batch, number: int) -> bool:
        """Return whether a packet's place in the stream allows it, and count what is wrong."""
        heading = batch.headings[number]
        size = heading.height, heading.width
        if heading.sequence == 0:
            self._next, self._newest, self._size = None, None, size
        self._size = self._size or size
        if size != self._size:
            self._faults["malformed packets"] += 1
            return False
        times = batch.columns["t_us"]
        gap = 0 if self._next is None else (heading.sequence - self._next) % _TURN
        backwards = (
            heading.length > 0 and self._newest is not None and int(times[batch.edges[number]]) < self._newest
        )
        if gap >= _LATE or backwards:
            self._faults["late packets"] += 1
            return False
        self._faults["lost packets"] += gap
        self._next = (heading.sequence + 1) % _TURN
        if heading.length:
            self._newest = int(times[batch.edges[number + 1] - 1])
        return True


def _chunk(batch: Batch, first: int, last: int, first_s: float, last_s: float) -> Chunk:
    events = batch.events(first, last)
    until = int(events.t_us[-1]) if len(events) else UNKNOWN_US
    return Chunk(events, until, first_s, last_s, restart=batch.headings[first].sequence == 0)


class UdpSender:
    """Sends a stream as packets; use it as a context, whose end tells the receiver that the stream ends.

    Args:
        host: Address of the receiver.
        port: Its port.
        packet_events: Most events a packet.
        start: Number of the first packet; 0 tells the receiver that a new stream begins.

    Raises:
        ConfigError: `packet_events` is below 1.

    Example:
        >>> source = UdpSource()
        >>> with UdpSender("127.0.0.1", source.port) as sender:
        ...     sender.send(Events([5, 9], [1, 2], [0, 1], [True, False], width=4, height=2))
        >>> [chunk.events for chunk in source.chunks(lambda: False)]
        [Events(2 events, 4 x 2, 5..9 us, 50 % ON)]
    """

    def __init__(self, host: str, port: int, *, packet_events: int = USUAL_EVENTS, start: int = 0) -> None:
        if packet_events < 1:
            raise ConfigError(f"packet_events is {packet_events}; give at least 1 event a packet")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._to = host, port
        self._most = packet_events
        self._number = start
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
        for start in range(0, len(events), self._most):
            part = cut(columns, start, min(start + self._most, len(events)))
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
