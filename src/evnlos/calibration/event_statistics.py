"""Statistics of event recordings that a pixel's settings decide, beside those of simulated ones.

- Recorded events beside simulated ones: maps of counts, and the time surfaces that a network sees.
- What a calibrated setup gets wrong of the events of its own captures, for all that are solved after them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.calibration.captures import CaptureSet
from evnlos.calibration.frame_model import local_square
from evnlos.calibration.transport_fit import Residual
from evnlos.cameras import PixelSettings, simulate_events
from evnlos.cameras.streams import WHITE_DN
from evnlos.config import load_yaml
from evnlos.data import Simulation, read_capture
from evnlos.data.pool import run_in_order
from evnlos.data.sampling import Sampling, make_samples, reduce_by_area
from evnlos.errors import ConfigError, DataError
from evnlos.events import stride_for, thin_events
from evnlos.inverse.event_images import EVENT_ERRORS_FILE, EventErrors, event_statistic
from evnlos.inverse.prior import PatternPrior
from evnlos.inverse.sequence_statistic import EventStatistic
from evnlos.machine import Progress, Step, note, silent
from evnlos.setups import Setup, calibrated_file
from evnlos.types import Events, derive_seed, target_side_m

_STEP_PX = 0.2  # the light is linear in time between two rendered instants
_MOST_BYTES = 1 << 30
_ENOUGH_PX = 4000  # pixels that tell as much about a model as all do: they do not see each other
_MOST_PX = 20_000  # about as many are taken at all
_AT_ONCE = 32  # instants that are rendered together
_MOST_CAPTURES = 16  # that tell of errors: a second or two each
_SETTLE = 0.05  # share of the recording in which the pixels' references forget their start
_QUIET, _ACTIVE = 0.06, 0.5  # range of the log light of a pixel that sees nothing, and of one that sees much


@dataclass(frozen=True)
class Recording:
    """One event recording and the light that made it.

    Args:
        light: Light on the sensor in the pixel's digital numbers, float32 [T, H, W].
        times_s: Instants of the light, float64 [T], seconds.
        events: What the camera recorded.
        index: Number of the capture among those it came from.
    """

    light: NDArray[np.float32]
    times_s: NDArray[np.float64]
    events: Events
    index: int = 0

    @property
    def settled_us(self) -> int:
        """Instant from which events count, microseconds."""
        start, stop = self.times_s[0], self.times_s[-1]
        return round((start + _SETTLE * (stop - start)) * 1e6)

    @property
    def seconds(self) -> float:
        """Length of the part that counts, seconds."""
        return float(self.times_s[-1]) - self.settled_us * 1e-6

    def simulate(self, pixel: PixelSettings, seed: int) -> Events:
        """Return the events of a pixel under the same light."""
        return simulate_events(self.light, self.times_s, pixel, seed=seed)


def read_recordings(capture_set: CaptureSet, setup: Setup, count: int) -> list[Recording]:
    """Render the light of `count` captures, evenly chosen, from a fitted setup.

    Of more than 45,000 pixels every second row and column is taken, or fewer, which tell as much.

    Raises:
        DataError: The captures last so long that not even one's light fits in 1 GiB.
    """
    stride = stride_for(math.prod(capture_set.shape), _MOST_PX)
    pixels = math.prod(-(-side // stride) for side in capture_set.shape)
    chosen = np.unique(np.linspace(0, len(capture_set.captures) - 1, count).round().astype(int))
    recordings, used = [], 0
    for done, k in enumerate(chosen):
        note(f"light of capture {done + 1} of {len(chosen)}")
        capture, scene = capture_set.captures[k], capture_set.scenes[k]
        own = setup.resized(capture_set.shape)
        if capture_set.own:
            target, ambient, *_ = capture_set.own[k]
            own = replace(own, gain=own.gain * target, ambient=own.ambient * ambient)
        wall = own.observe(scene)
        first, last = (float(t) * 1e-6 for t in capture.frame_times_us[[0, -1]])
        steps = max(8, math.ceil((last - first) * wall.speed_px_s / _STEP_PX))
        used += 4 * (steps + 1) * pixels
        if used > _MOST_BYTES:
            break
        times = np.linspace(first, last, steps + 1)
        parts = np.array_split(times, math.ceil(len(times) / _AT_ONCE))
        rendered = [wall.irradiance(part).numpy()[:, ::stride, ::stride] for part in parts]
        light = np.concatenate(rendered) * np.float32(WHITE_DN)
        seen = thin_events(within(capture.events, first, last), stride)
        recordings.append(Recording(light, times, seen, int(k)))
    if not recordings:
        raise DataError(
            f"the light of one capture needs {used >> 20} MiB, above {_MOST_BYTES >> 20}; fit frames alone "
            "(--no-events) or record for less time"
        )
    return recordings


def thinned(recording: Recording, pixels: int = _ENOUGH_PX) -> Recording:
    """Return every n-th row and column of a recording, so that about so many pixels are left."""
    stride = stride_for(recording.light[0].size, pixels)
    light = np.ascontiguousarray(recording.light[:, ::stride, ::stride])
    return replace(recording, light=light, events=thin_events(recording.events, stride))


def within(events: Events, first_s: float, last_s: float) -> Events:
    """Return the events after `first_s` and up to `last_s`, seconds."""
    low, high = np.searchsorted(events.t_us, [first_s * 1e6, last_s * 1e6], side="right")
    part = slice(int(low), int(high))
    return Events(
        events.t_us[part], events.x[part], events.y[part], events.p[part], events.width, events.height
    )


@dataclass(frozen=True)
class Regions:
    """Pixels whose light moves much, and pixels whose light hardly moves.

    Args:
        active: bool [H, W].
        quiet: bool [H, W].
    """

    active: NDArray[np.bool_]
    quiet: NDArray[np.bool_]


def regions_of(recording: Recording) -> Regions:
    """Return the active and the quiet pixels of a recording, from its light.

    Raises:
        DataError: The light moves so little that no pixel tells a threshold.
    """
    light = np.log(np.maximum(recording.light, 1e-3))
    swing = np.ptp(light, axis=0)
    active = swing > _ACTIVE
    if active.mean() < 1e-3:
        raise DataError(
            f"the log light moves by at most {swing.max():.2f} in a recording; an event pixel needs {_ACTIVE} "
            "or more to show its thresholds: lower the ambient light, or fit frames alone (--no-events)"
        )
    quiet = swing < _QUIET
    if quiet.mean() < 0.01:
        quiet = swing <= np.quantile(swing, 0.05)
    return Regions(active, quiet)


def moments(recordings: Sequence[Recording], regions: Sequence[Regions], events: Sequence[Events]) -> NDArray:
    """Return six figures of a pixel and second, float64 [6], ON before OFF in each pair.

    Events of active pixels, the variance of the roots of their counts among neighbours, events of quiet pixels.
    """
    total, pixels = np.zeros(6), np.zeros(2)
    for recording, region, found in zip(recordings, regions, events, strict=True):
        counts = [count_map(found, polarity, recording.settled_us) for polarity in (True, False)]
        # The root of a count scatters alike for many events and for few.
        scatter = [local_square(np.sqrt(count)) for count in counts]
        for place, chosen in enumerate((region.active, region.quiet)):
            pixels[place] += chosen.sum() * recording.seconds
            for k in range(2):
                total[4 * place + k] += counts[k][chosen].sum()
                total[2 + k] += scatter[k][chosen].sum() if place == 0 else 0.0
    return total / np.repeat(pixels, [4, 2])


def count_map(events: Events, polarity: bool, after_us: int) -> NDArray[np.int64]:
    """Return the events of a polarity at each pixel after an instant, int64 [H, W]."""
    chosen = (events.p == polarity) & (events.t_us > after_us)
    flat = events.y[chosen].astype(np.int64) * events.width + events.x[chosen]
    return np.bincount(flat, minlength=events.width * events.height).reshape(events.height, events.width)


def by_pixel(
    events: Events, after_us: int = -1
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return flat pixel [E], time [E, us] and ON [E] of the events after an instant, by pixel, then by time."""
    late = events.t_us > after_us
    pixel = events.y[late].astype(np.int64) * events.width + events.x[late]
    order = np.lexsort((events.t_us[late], pixel))
    return pixel[order], events.t_us[late][order], events.p[late][order]


def intervals(
    pixel: NDArray[np.int64], t_us: NDArray[np.int64], on: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return pixel, length [us] and unlike polarity of successive events of one pixel, from `by_pixel`."""
    same = np.diff(pixel) == 0
    return pixel[1:][same], np.diff(t_us)[same], (on[1:] != on[:-1])[same]


def simulated(recordings: Sequence[Recording], pixel: PixelSettings, seed: int) -> list[Events]:
    """Return simulated events of all recordings; the same seed draws the same mismatch and noise."""
    return [r.simulate(pixel, derive_seed(seed, "calibration", k)) for k, r in enumerate(recordings)]


_DRAWS = 4  # simulations whose mean stands for the model: one alone would add its own noise
_BLOCK_PX = 5

Maps = dict[str, NDArray[np.float32]]


def event_residuals(
    capture_set: CaptureSet,
    recordings: Sequence[Recording],
    before: PixelSettings,
    after: PixelSettings,
    sampling: Sampling,
    seed: int,
) -> tuple[dict[str, Residual], dict[str, tuple[NDArray, NDArray]]]:
    """Compare recorded events with the mean of simulated ones under the same light.

    Args:
        capture_set: The captures.
        recordings: Light and events of some of them.
        before: Pixel of the start.
        after: Fitted pixel.
        sampling: Resolution and kind of the time surfaces.
        seed: Seed of the simulations.

    Returns:
        Residuals of `counts` (events a polarity in blocks of 5 x 5 pixels between two frames) and `surfaces`
        (the standard sample's maps); their noise is that of one simulated recording against the mean. And the
        surfaces [N, 2, h, w] of camera and model by capture.
    """
    edges = [capture_set.captures[r.index].frame_times_us for r in recordings]
    seen = _maps([r.events for r in recordings], edges, sampling)
    mean = {
        name: _mean_maps(recordings, pixel, edges, sampling, derive_seed(seed, "check"))
        for name, pixel in (("before", before), ("after", after))
    }
    other = _maps(simulated(recordings, after, derive_seed(seed, "noise")), edges, sampling)
    residuals = {}
    for kind, maps in seen.items():
        spread = float(maps.std())
        distance = {name: _rms(maps - model[kind]) / spread for name, model in mean.items()}
        residuals[kind] = Residual(**distance, noise=_rms(other[kind] - mean["after"][kind]) / spread)
    lengths = np.cumsum([len(e) - 1 for e in edges])[:-1]
    pairs = zip(*(np.split(m["surfaces"], lengths) for m in (seen, mean["after"])), strict=True)
    names = [capture_set.names[r.index] for r in recordings]
    return residuals, dict(zip(names, pairs, strict=True))


def _mean_maps(
    recordings: Sequence[Recording],
    pixel: PixelSettings,
    edges: list[NDArray[np.int64]],
    sampling: Sampling,
    seed: int,
) -> Maps:
    total: Maps = {}
    for draw in range(_DRAWS):
        maps = _maps(simulated(recordings, pixel, derive_seed(seed, draw)), edges, sampling)
        total = {kind: total.get(kind, np.float32(0)) + m / np.float32(_DRAWS) for kind, m in maps.items()}
    return total


def _maps(events: Sequence[Events], edges: list[NDArray[np.int64]], sampling: Sampling) -> Maps:
    """Return the counts and the surfaces of all recordings, one after the other."""
    pairs = list(zip(events, edges, strict=True))
    return {
        "counts": np.concatenate([block_counts(e, instants) for e, instants in pairs]),
        "surfaces": np.concatenate([_surfaces(e, instants, sampling) for e, instants in pairs]),
    }


def block_counts(events: Events, edges_us: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the mean events per pixel in blocks of 5 x 5 pixels between two instants, float32 [N, 2, h, w].

    Args:
        events: The events; ON is the first of the two maps.
        edges_us: Instants, ascending, microseconds, [N + 1]; an event at an instant belongs to what ends there.
    """
    bins = len(edges_us) - 1
    when = np.searchsorted(edges_us, events.t_us, side="left") - 1
    inside = (when >= 0) & (when < bins)
    place = ((when * 2 + ~events.p) * events.height + events.y) * events.width + events.x
    counts = np.bincount(place[inside], minlength=bins * 2 * events.height * events.width)
    full = counts.reshape(bins, 2, events.height, events.width)
    return reduce_by_area(full, (-(-events.height // _BLOCK_PX), -(-events.width // _BLOCK_PX)))


def _surfaces(events: Events, edges_us: NDArray[np.int64], sampling: Sampling) -> NDArray[np.float32]:
    """Return the time surfaces of a standard sample, float32 [N, 2, h, w]."""
    blank = np.zeros((len(edges_us) - 1, events.height, events.width), np.uint8)
    return make_samples(blank, 1.0, events, edges_us, sampling).surface


def _rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


@dataclass(frozen=True)
class _Solved:
    """What the events of a capture say, and its target."""

    name: str
    statistic: EventStatistic
    prior: PatternPrior
    truth: NDArray[np.float32]


def _solve(setup: str, side_m: float, folder: Path) -> _Solved | None:
    """Solve the events of a capture; None where it has none, or its target or motion is not known.

    Raises:
        ConfigError: No law of the setup's event model is known.
    """
    capture = read_capture(folder, needs_frames=False)
    target = capture.target
    if not capture.has_events or capture.motion is None or target is None or capture.several is not None:
        return None
    of = capture.events, capture.frame_times_us, capture.motion
    statistic, prior = event_statistic(*of, setup, side_m)
    return _Solved(capture.name, statistic, prior, target.rasterise(prior.target_plane))


def write_event_errors(
    setup: Path,
    captures: Iterable[Path],
    names: Collection[str],
    progress: Progress = silent,
    workers: int = 1,
) -> EventErrors | None:
    """Find what captures with known targets show of the errors of a setup's events, and write it to its folder.

    Newly drawn sequences err as it says (`evnlos.models.DrawnSequences`), and the surface `corrected` takes it
    into account: for a capture that is among these, what the others showed. Whether a network gains by that,
    only that network tells (`evnlos.training.best_shown`); captures tell what they gain before any network.

    Args:
        setup: Folder of a calibrated setup.
        captures: Capture folders.
        names: Names of the captures that the setup was calibrated with; of more than 16 every so many are
            taken. Those without events, of unknown or several targets, or of unknown motion, are passed over.
        progress: Called as the captures are read.
        workers: Processes that solve the captures; 0 is one for each core.

    Returns:
        The errors; None, and no file is there, where no capture shows them, or no law of the setup's event
        model is known.
    """
    learned = [folder for folder in captures if folder.resolve().name in names]
    learned = learned[:: max(1, -(-len(learned) // _MOST_CAPTURES))]
    (setup / EVENT_ERRORS_FILE).unlink(missing_ok=True)
    if not learned:
        return None
    side_m = target_side_m(load_yaml(Simulation, calibrated_file(setup)).sampling.canvas)
    what, solved = "errors of the events", list[_Solved]()
    progress(Step(what, 0, len(learned), "captures"))
    try:
        with closing(run_in_order(partial(_solve, str(setup), side_m), learned, workers)) as found:
            for done, one in enumerate(found, start=1):
                solved += [one] if one else []
                progress(Step(what, done, len(learned), "captures"))
    except ConfigError:
        return None
    if not solved:
        return None
    prior = solved[0].prior
    statistics, truths = [one.statistic for one in solved], [one.truth for one in solved]
    errors = EventErrors.of([one.name for one in solved], statistics, prior, truths)
    return errors.write(setup, errors.gain_db(statistics, prior, truths))
