"""From chunks to images: the running surface, its reduction, the network.

- Area averaging with what does not change worked out beforehand, for one image after the other.
- The time surface as a state that events change, in place of a map computed from all events anew.
- One time step after the other, as fast as a CPU goes: the network as a graph with its constants folded in.
- From chunks to images: the running surface, its reduction, the network, and how long each took.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from evnlos.data import Sampling, as_modality
from evnlos.errors import ConfigError, DataError
from evnlos.events import TRACE_TAUS, RunningTrace
from evnlos.events import surface as kernels
from evnlos.live.packet import UNKNOWN_US, Chunk, Clock, SystemClock
from evnlos.live.run import Picture, Timing
from evnlos.models import Weights, published_single
from evnlos.types import Events


@njit(cache=True)
def _reduce(images, first_y, over_y, first_x, over_x, out):
    """Fill `out` [N, h, w] from `images` [N, H, W]; an axis has each cell's first place and weights."""
    width = images.shape[2]
    line = np.empty(width, np.float32)
    for number in range(images.shape[0]):
        for row in range(out.shape[1]):
            line[:] = np.float32(0)
            for k in range(over_y.shape[1]):
                share, source = over_y[row, k], images[number, first_y[row] + k]
                for column in range(width):
                    line[column] += share * source[column]
            for column in range(out.shape[2]):
                start, total = first_x[column], np.float32(0)
                for k in range(over_x.shape[1]):
                    total += over_x[column, k] * line[start + k]
                out[number, row, column] = total


def _cells(inside: int, outside: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return, for each of `outside` equal cells, the first of `inside` places covered, and their shares."""
    cell = inside / outside
    edges = np.arange(outside + 1) * cell
    most = min(int(np.ceil(cell)) + 1, inside)
    first = np.minimum(np.floor(edges[:-1]).astype(np.int64), inside - most)
    places = first[:, None] + np.arange(most)
    covered = np.minimum(edges[1:, None], places + 1) - np.maximum(edges[:-1, None], places)
    return first, (np.maximum(covered, 0.0) / cell).astype(np.float32)


class AreaReduction:
    """`reduce_by_area` from one size to another, without its threads.

    For small maps those cost more than the work.

    Args:
        inside: Height and width of the maps given, pixels.
        outside: Height and width of those returned, pixels.

    Example:
        >>> AreaReduction((1, 6), (1, 4))(np.arange(6.0, dtype=np.float32).reshape(1, 1, 6)).round(2)
        array([[[0.33, 1.67, 3.33, 4.67]]], dtype=float32)
    """

    def __init__(self, inside: tuple[int, int], outside: tuple[int, int]) -> None:
        self.outside = outside
        self._first_y, self._over_y = _cells(inside[0], outside[0])
        self._first_x, self._over_x = _cells(inside[1], outside[1])

    def __call__(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return maps [N, H, W] as maps [N, *outside]; each is the mean over its cell."""
        out = np.empty((len(images), *self.outside), np.float32)
        _reduce(images, self._first_y, self._over_y, self._first_x, self._over_x, out)
        return out


_NEVER = -1
_NO_TIMES, _NO_PLACES, _NO_SIGNS = np.zeros(0, np.int64), np.zeros(0, np.uint16), np.zeros(0, np.bool_)
_NO_STARTS = np.zeros(2, np.int64)


@njit(cache=True)
def _remember(t_us, x, y, p, origin, newest):
    """Write the time of each event over that of its pixel and polarity; times ascend, so the last one stays."""
    height, width = newest.shape[1], newest.shape[2]
    flat = newest.reshape(-1)
    off = np.uint32(height * width)
    for index in range(len(t_us)):
        pixel = np.uint32(y[index]) * np.uint32(width) + np.uint32(x[index])
        flat[pixel + (np.uint32(0) if p[index] else off)] = t_us[index] - origin


class RunningSurface:
    """The surface of active events ("sae") of a stream so far, at any instant from its newest event on.

    It equals `time_surface(all events, [begin, t_us], tau_us)` bit for bit; an event costs one write, a map one
    exponential a pixel.

    Args:
        height: Sensor height, pixels.
        width: Sensor width, pixels.
        tau_us: Time constant, microseconds, above 0.

    Raises:
        DataError: The time constant is not positive.

    Example:
        >>> surface = RunningSurface(1, 2, tau_us=5.0)
        >>> surface.add(Events([5, 10], [0, 1], [0, 0], [True, False], width=2, height=1))
        >>> surface.at(10).round(3).tolist()
        [[[0.36800000071525574, 0.0]], [[0.0, 1.0]]]
    """

    def __init__(self, height: int, width: int, tau_us: float) -> None:
        if not (np.isfinite(tau_us) and tau_us > 0):
            raise DataError(f"tau_us is {tau_us}; give a positive number of microseconds")
        self.shape, self.tau_us = (height, width), float(tau_us)
        self._times = np.full((2, height, width), _NEVER, np.int64)
        self._origin: int | None = None
        self._newest = 0

    def add(self, events: Events) -> None:
        """Take the next events of the stream.

        Raises:
            DataError: They are of another sensor, or begin before the newest event taken.
        """
        if events.shape != self.shape:
            raise DataError(
                f"events of {events.width} x {events.height} pixels after those of {self.shape[1]} x "
                f"{self.shape[0]}; give one sensor a stream"
            )
        if not len(events):
            return
        first = int(events.t_us[0])
        if self._origin is None:
            self._origin = self._newest = first
        if first < self._newest:
            raise DataError(f"events from {first} us after one at {self._newest} us; give them in order")
        _remember(events.t_us, events.x, events.y, events.p, self._origin, self._times)
        self._newest = int(events.t_us[-1])

    def at(self, t_us: int) -> NDArray[np.float32]:
        """Return the surface at an instant, float32 [2, H, W], 0..1: ON, OFF.

        Raises:
            DataError: The instant is before the newest event taken.
        """
        out = np.zeros((1, 2, *self.shape), np.float32)
        if self._origin is None:
            return out[0]
        if t_us < self._newest:
            raise DataError(f"a surface at {t_us} us, with an event at {self._newest} us; ask for a later one")
        edges = np.array([t_us, t_us], np.int64)
        columns = (_NO_TIMES, _NO_PLACES, _NO_PLACES, _NO_SIGNS)
        grids = kernels.Grids(*columns, edges, _NO_STARTS, self.tau_us, True)
        kernels.sae(grids, kernels.TimeMap(self._times, _NEVER, self._origin), out)
        return out[0]


_WARM = 8  # the graph is optimised in its first calls


class StreamingReconstructor:
    """A network of single time steps: the same images as `reconstruct`, without Python between its layers.

    The graph is traced at the first use (about a second), for the sampling that the weights were trained on.

    Args:
        weights: The network.

    Raises:
        DataError: The network sees whole sequences.

    Example:
        >>> from evnlos.data import Sampling
        >>> from evnlos.models import UNetConfig
        >>> sampling = Sampling(height=16, width=24, scored_rows=12)
        >>> network = UNetConfig(width=4, depth=1, rank=0).build("frame", sampling)
        >>> see = StreamingReconstructor(Weights(network))
        >>> see(np.zeros((16, 24)), np.zeros((2, 16, 24))).shape
        torch.Size([16, 24])
    """

    def __init__(self, weights: Weights) -> None:
        self.modality, self.sampling = weights.modality, weights.sampling
        if weights.network.sees_sequence:
            names = " or ".join(published_single())
            raise DataError(
                f"these weights see whole sequences; give weights of single time steps: {names}, which come "
                "with the package, or your own, trained with --network.kind unet"
            )
        shape = (1, self.modality.channels, self.sampling.height, self.sampling.width)
        network = weights.network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        example = torch.zeros(shape).contiguous(memory_format=torch.channels_last)
        with torch.inference_mode(), warnings.catch_warnings():
            # The sizes are fixed here, which is what the tracer warns of.
            warnings.simplefilter("ignore")
            self._graph = torch.jit.freeze(torch.jit.trace(network, example))

    @torch.inference_mode()
    def __call__(self, frame: NDArray, surface: NDArray) -> Tensor:
        """Return the image, float32 [H, W], 0..1, of one time step.

        Args:
            frame: What the frame camera saw, [H, W], as in `Samples`.
            surface: Time surface, [2, H, W]; [4, H, W] of `sae-trace`.

        Raises:
            DataError: The maps are not of the size that the network was trained on.
        """
        size = (self.sampling.height, self.sampling.width)
        if np.shape(frame) != size or np.shape(surface) != (self.sampling.surface_maps, *size):
            raise DataError(
                f"frame {np.shape(frame)} and surface {np.shape(surface)} do not fit weights for {size}; bring "
                "them to that size by `make_samples`"
            )
        seen = self.modality.inputs(np.asarray(frame)[None], np.asarray(surface)[None])
        return self._graph(seen.contiguous(memory_format=torch.channels_last))[0, 0]


class Engine:
    """Turns chunks into images, with weights of any modality.

    A network that sees events gets the surface at the instant that the stream has reached, and beside it the
    newest frame, where it sees frames too; one that sees frames alone makes one image per frame.

    Args:
        weights: Network, modality and sampling; None: no network, what the cameras see alone.
        clock: The clock that it goes by.

    Raises:
        ConfigError: The weights were trained on another surface than "sae" and "sae-trace".

    Example:
        >>> from evnlos.data import Sampling
        >>> from evnlos.models import UNetConfig
        >>> sampling = Sampling(height=16, width=24, scored_rows=12)
        >>> network = UNetConfig(width=4, depth=1, rank=0).build("event", sampling)
        >>> engine = Engine(Weights(network))
        >>> events = Events([3, 9], [1, 30], [2, 20], [True, False], width=48, height=32)
        >>> image = engine.see([Chunk(events, 9, 0.0, 0.0)])
        >>> image.image.shape, image.t_us, image.events
        ((16, 24), 9, 2)
    """

    def __init__(self, weights: Weights | None, clock: Clock | None = None) -> None:
        self._see = None if weights is None else StreamingReconstructor(weights)
        self.modality = as_modality("event") if weights is None else weights.modality
        self.sampling = Sampling() if weights is None else weights.sampling
        if self.sampling.surface not in ("sae", "sae-trace"):
            raise ConfigError(
                f"the weights take the surface {self.sampling.surface!r}; live reconstruction makes 'sae' and "
                "'sae-trace': train with --sampling.surface sae"
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
        self._trace: RunningTrace | None = None
        self._frame: NDArray[np.float32] | None = None
        self._until_us = UNKNOWN_US
        self._events = 0

    def begin(self) -> None:
        """Forget what came before, and compile now what would make the first image late."""
        self._forget()
        place = np.zeros(1, np.uint16)
        one = Events(np.array([1]), place, place, np.array([True]), self._shape[1], self._shape[0])
        self._take(Chunk(one, 1, 0.0, 0.0))
        for _ in range(_WARM):
            self._image(self._maps())
        self._forget()

    def _maps(self) -> NDArray[np.float32]:
        """Return the surface at the instant that the stream has reached, as the network sees it."""
        assert self._surface is not None
        found = self._surface.at(self._until_us)
        if self._trace is not None:
            found = np.concatenate([found, self._trace.at(self._until_us)])
        return self._reduce(found)

    def _image(self, surface: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """Return what the network makes of the surface and the newest frame; None without one."""
        if self._see is None:
            return None
        return self._see(self._dark if self._frame is None else self._frame, surface).numpy()

    def see(self, chunks: Sequence[Chunk]) -> Picture | None:
        """Take chunks in their order and return the image behind them; None where there is none to be made.

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
        surface = self._maps()
        mapped_s = self._clock.now()
        image = self._image(surface)
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
            if self.sampling.surface == "sae-trace":
                self._trace = RunningTrace(*chunk.events.shape, TRACE_TAUS * self.sampling.tau_s * 1e6)
        self._surface.add(chunk.events)
        if self._trace is not None:
            self._trace.add(chunk.events)
        self._events += len(chunk.events)
        if chunk.frame is not None:
            image = np.ascontiguousarray(chunk.frame, np.float32)
            self._frame = AreaReduction(image.shape, self._shape)(image[None])[0]
        self._until_us = max(self._until_us, chunk.until_us)
