"""From chunks to pictures: the running surface, its reduction, the network, and how long each took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import ConfigError
from evnlos.evaluation.streaming import StreamingReconstructor
from evnlos.live.chunk import UNKNOWN_US, Chunk
from evnlos.live.clock import Clock, SystemClock
from evnlos.live.reduction import AreaReduction
from evnlos.live.surface import RunningSurface
from evnlos.model import Weights
from evnlos.types import Events

_WARM = 8  # the graph is optimised in its first calls


@dataclass(frozen=True)
class Timing:
    """How long a picture took, seconds; NaN for both latencies where no event is new in it.

    Args:
        oldest_s: From the first event that is new in it to the picture: the longest that an event waited.
        newest_s: From its last event to the picture.
        wait_s: The part of `oldest_s` before work on the picture began: in the source, in the queue, for the
            picture before.
        surface_s: Taking the events and making the maps that the network sees.
        network_s: The network.
    """

    oldest_s: float
    newest_s: float
    wait_s: float
    surface_s: float
    network_s: float


@dataclass(frozen=True, eq=False)
class Picture:
    """A reconstruction and what it was made of.

    Args:
        number: Its number, from 0.
        t_us: Event time that it shows, microseconds.
        made_s: Instant at which it was ready, seconds on the `Clock`.
        image: The reconstruction, float32 [H, W], 0..1.
        surface: The time surface that the network saw, float32 [2, H, W]: ON, OFF.
        frame: The frame that it saw, float32 [H, W], 0..1; None without frames.
        events: Number of events that are new in it.
        timing: How long it took.
    """

    number: int
    t_us: int
    made_s: float
    image: NDArray[np.float32]
    surface: NDArray[np.float32]
    frame: NDArray[np.float32] | None
    events: int
    timing: Timing


class Engine:
    """Turns chunks into pictures, with weights of any modality.

    A network that sees events gets the surface at the instant that the stream has reached, and beside it the
    newest frame, where it sees frames too; one that sees frames alone makes one image per frame.

    Args:
        weights: Network, modality and sampling.
        clock: The clock that it goes by.

    Raises:
        ConfigError: The weights were trained on another surface than "sae".

    Example:
        >>> from evnlos.dataset import Sampling
        >>> from evnlos.model import UNetConfig
        >>> sampling = Sampling(height=16, width=24, scored_rows=12)
        >>> network = UNetConfig(width=4, depth=1, rank=0).build("event", sampling)
        >>> engine = Engine(Weights(network))
        >>> events = Events([3, 9], [1, 30], [2, 20], [True, False], width=48, height=32)
        >>> picture = engine.see([Chunk(events, 9, 0.0, 0.0)])
        >>> picture.image.shape, picture.t_us, picture.events
        ((16, 24), 9, 2)
    """

    def __init__(self, weights: Weights, clock: Clock | None = None) -> None:
        self._see = StreamingReconstructor(weights)
        self.modality, self.sampling = weights.modality, self._see.sampling
        if self.sampling.surface != "sae":
            raise ConfigError(
                f"the weights take the surface {self.sampling.surface!r}; live reconstruction makes 'sae': "
                "train with --sampling.surface sae"
            )
        self._clock = clock or SystemClock()
        self._shape = self.sampling.height, self.sampling.width
        self._dark = np.zeros(self._shape, np.float32)
        self._number = 0
        self._forget()

    @property
    def needs_frames(self) -> bool:
        """Whether the network sees frames."""
        return self.modality.needs_frames

    def _forget(self) -> None:
        self._surface: RunningSurface | None = None
        self._frame: NDArray[np.float32] | None = None
        self._until_us = UNKNOWN_US
        self._events = 0

    def begin(self) -> None:
        """Forget what came before, and compile now what would make the first picture late."""
        self._forget()
        surface, reduce = RunningSurface(*self._shape, 1.0), AreaReduction(self._shape, self._shape)
        place = np.zeros(1, np.uint16)
        surface.add(Events(np.array([1]), place, place, np.array([True]), self._shape[1], self._shape[0]))
        for _ in range(_WARM):
            self._see(self._dark, reduce(surface.at(1)))

    def see(self, chunks: Sequence[Chunk]) -> Picture | None:
        """Take chunks in their order and return the picture behind them; None where there is none to be made.

        Raises:
            DataError: The chunks do not follow each other, or change the sensor.
        """
        begun_s = self._clock.now()
        oldest_s = newest_s = float("nan")
        new_frame = False
        for chunk in chunks:
            is_new = chunk.frame is not None
            if len(chunk.events) if self.modality.needs_events else is_new:
                oldest_s = chunk.first_s if np.isnan(oldest_s) else oldest_s
                newest_s = chunk.last_s
            if not self.modality.needs_events and is_new:
                oldest_s = newest_s = chunk.last_s  # a frame comes at the end of its chunk
            new_frame |= is_new
            self._take(chunk)
        if self._surface is None or self._until_us == UNKNOWN_US:
            return None
        if self.needs_frames and self._frame is None:
            return None
        if not self.modality.needs_events and not new_frame:
            return None
        surface = self._reduce(self._surface.at(self._until_us))
        mapped_s = self._clock.now()
        image = self._see(self._dark if self._frame is None else self._frame, surface).numpy()
        made_s = self._clock.now()
        timing = Timing(
            made_s - oldest_s, made_s - newest_s, begun_s - oldest_s, mapped_s - begun_s, made_s - mapped_s
        )
        events, self._events = self._events, 0
        self._number += 1
        return Picture(self._number - 1, self._until_us, made_s, image, surface, self._frame, events, timing)

    def _take(self, chunk: Chunk) -> None:
        if chunk.restart:
            self._forget()
        if self._surface is None:
            self._surface = RunningSurface(*chunk.events.shape, self.sampling.tau_s * 1e6)
            self._reduce = AreaReduction(chunk.events.shape, self._shape)
        self._surface.add(chunk.events)
        self._events += len(chunk.events)
        if chunk.frame is not None:
            image = np.ascontiguousarray(chunk.frame, np.float32)
            self._frame = AreaReduction(image.shape, self._shape)(image[None])[0]
        self._until_us = max(self._until_us, chunk.until_us)
