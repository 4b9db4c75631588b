"""How much of a moving target is in frames and in events: the expected PSNR of the best linear estimate.

The target is Gaussian (`inverse.handwritten_prior`), everything is linearised at handwritten targets of a
writer and of characters that the prior does not know. Frames are linear, with the camera's variance at that
light. Each crossing of a threshold is one row: the change of filtered log light since the pixel's last event is
the threshold, with an error of the crossing. A pixel's own thresholds are unknown within their mismatch and are
integrated out; noise events are taken as labelled, and silences say nothing unless asked for. With H the sum of
the information of all rows, the expected squared error is the trace of (1 + H)^-1 in the prior's coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
import torch

from evnlos.analysis.scores import scored_sampling
from evnlos.cameras import EVENT_MODELS, CrossingLaw, PixelSettings
from evnlos.cameras.streams import WHITE_DN
from evnlos.data import Capture, Sampling
from evnlos.errors import ConfigError
from evnlos.inverse import (
    EventRecord,
    Levels,
    NormalEquations,
    PatternPrior,
    SequenceLight,
    handwritten_prior,
    levels_of,
    predicted_record,
    sequence_light,
)
from evnlos.inverse.prior import handwritten_targets
from evnlos.inverse.sequence_problem import position_subsets
from evnlos.machine import note
from evnlos.scene import LineMotion
from evnlos.setups import Setup
from evnlos.types import Plane, aligned, length_text

_GRID = (50, 80)  # pixels at which the sensor is looked at
_REFERENCES = "AS2"  # characters that the prior does not know


@dataclass(frozen=True)
class SequenceAnalysisSettings:
    """How the question is put for a moving target_plane."""

    travel_m: float = 0.16
    """Length of the target's way, left to right, about the middle, metres."""
    speed_m_s: float = 0.02
    """Its speed, metres per second."""
    positions: int = 40
    """Equally spaced positions with a frame at the end of each."""
    counts: tuple[int, ...] = (1, 2, 5, 10, 20, 40)
    """Numbers of positions to ask for."""
    coefficients: int = 150
    """Coefficients of the Gaussian prior."""
    writers: int = 6
    """Writers whose characters are the prior."""
    cells: int = 32
    """Cells a side of the target plane."""
    target_size_m: float = 0.08
    """Side of the target plane, metres."""
    crossing_noise: float = 0.04
    """Standard deviation of the error of a crossing beside the event model's own, log units."""
    other_noises: tuple[float, ...] = (0.08, 0.02, 0.01)
    """The same, tried for the setup's own event model only."""
    other_models: bool = True
    """Whether the event models that share the thresholds of the setup's own are tried as well."""
    silences: bool = False
    """Whether the time without events at the end of a pixel's record counts, as a weak row."""
    fpn_corrected: bool = True
    """Whether the frame camera's fixed pattern is known; where not, it is integrated out."""

    def __post_init__(self) -> None:
        for name in ("travel_m", "speed_m_s", "crossing_noise", "target_size_m"):
            if not 0 < (value := getattr(self, name)) < math.inf:
                raise ConfigError(f"SequenceAnalysisSettings.{name} is {value}; give a positive number")
        for name in ("positions", "coefficients", "writers"):
            if (value := getattr(self, name)) < 1:
                raise ConfigError(f"SequenceAnalysisSettings.{name} is {value}; give 1 or more")
        noises = self.other_noises
        if not all(0 < value < math.inf for value in noises):
            raise ConfigError(f"SequenceAnalysisSettings.other_noises is {noises}; give positive numbers")
        wrong = [count for count in self.counts if not 1 <= count <= self.positions]
        if wrong or not self.counts:
            raise ConfigError(
                f"SequenceAnalysisSettings.counts is {self.counts}; give numbers from 1 to {self.positions}"
            )
        if not 8 <= self.cells <= 64:
            raise ConfigError(f"SequenceAnalysisSettings.cells is {self.cells}; give 8 to 64")

    @property
    def motion(self) -> LineMotion:
        """The motion."""
        return LineMotion((-self.travel_m / 2, 0.0), self.speed_m_s)

    @classmethod
    def of_capture(cls, capture: Capture) -> SequenceAnalysisSettings:
        """Return the question of one position and of all of a capture, for its own event model alone.

        Args:
            capture: Its motion and the number of its frames count; the default's where the motion is unknown.
        """
        travel_m, speed_m_s, positions = cls.travel_m, cls.speed_m_s, cls.positions
        frames, motion = len(capture.frame_times_us), capture.motion
        if motion is not None and motion.speed_m_s > 0 and frames > 1:
            lasts_s = frames * float(np.median(np.diff(capture.frame_times_us))) * 1e-6
            travel_m, speed_m_s, positions = motion.speed_m_s * lasts_s, motion.speed_m_s, frames
        return cls(travel_m, speed_m_s, positions, (1, positions), other_noises=(), other_models=False)

    @property
    def duration_s(self) -> float:
        """Length of the sequence, seconds."""
        return self.travel_m / self.speed_m_s


@dataclass(frozen=True)
class EventBound:
    """What the events of one event model are worth.

    Args:
        kind: Kind of the event model.
        noise: Root mean square error of a crossing, the model's own and what was added to it, log units.
        per_pixel: Signal events per pixel of the whole sequence, mean over the references.
        events_db: Expected PSNR for each number of positions, dB.
        both_db: The same from events and frames.
    """

    kind: str
    noise: float
    per_pixel: float
    events_db: tuple[float, ...]
    both_db: tuple[float, ...]


@dataclass(frozen=True)
class Bounds:
    """What frames and events of a moving target are worth, on the canvas of such a target.

    Args:
        name: Name of the setup.
        settings: How the question was put.
        prior_db: PSNR of the prior's mean, dB.
        frames_db: Expected PSNR from frames, for each of the settings' numbers of positions.
        events: The event models, the setup's own first.
    """

    name: str
    settings: SequenceAnalysisSettings
    prior_db: float
    frames_db: tuple[float, ...]
    events: tuple[EventBound, ...]

    def summary(self) -> dict[str, Any]:
        """Return plain numbers."""
        return asdict(self)

    def table(self, in_columns: bool = False) -> str:
        """Return the expected PSNR over the number of positions, in Markdown, or in columns for a terminal."""
        named = [("frames", self.frames_db)]
        for one in self.events:
            what = f"{one.kind}, {100 * one.noise:.1f} %"
            named += [(f"events, {what}", one.events_db), (f"both, {what}", one.both_db)]
        head = [f"{self.name}: expected PSNR, dB, of n positions", *map(str, self.settings.counts)]
        rows = [head, *([name, *(f"{value:.1f}" for value in values)] for name, values in named)]
        counts = {one.kind: f"{one.kind} {one.per_pixel:.2f}" for one in self.events}
        size = length_text(self.settings.target_size_m, digits=0)
        remarks = (
            f"Prior alone {self.prior_db:.2f} dB, of a target of {size}. Per cent: error of a crossing, log "
            f"units. Crossings per pixel of the whole sequence: {', '.join(counts.values())}."
        )
        if in_columns:
            return f"{aligned(rows)}\n{remarks}"
        lines = [f"| {' | '.join(row)} |" for row in rows]
        return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:], "", remarks])


def sequence_bounds(
    setup: Setup, settings: SequenceAnalysisSettings | None = None, name: str = "setup", seed: int = 0
) -> Bounds:
    """Say how well a moving target can be told from frames, events, both, for each event model that applies.

    A model applies if it knows its thresholds (`PixelSettings.crossing_law`): the setup's own, and all
    registered kinds that share the parameters of its thresholds, which they take over. Events of n positions
    are those of n positions' time about the middle; frames of n positions are spread over the whole way.

    Args:
        setup: A linear setup.
        settings: Motion, prior and noise; None is the default.
        name: What to call the setup.
        seed: Seed of the noise events.

    Raises:
        ConfigError: The setup is not linear.
    """
    settings = settings or SequenceAnalysisSettings()
    target_plane = Plane(settings.cells, settings.cells, settings.target_size_m / settings.cells)
    prior = handwritten_prior(target_plane, min(settings.coefficients, settings.cells**2), settings.writers)
    grid = (min(setup.shape[0], _GRID[0]), min(setup.shape[1], _GRID[1]))
    light = sequence_light(setup, prior, settings.motion.position_m, (0.0, settings.duration_s), grid)
    # neighbours see the same: each pixel of the grid stands for several of the sensor
    pixels = setup.shape[0] * setup.shape[1] / (grid[0] * grid[1])
    targets = handwritten_targets(target_plane, settings.writers)
    chosen = [next(k for k, at in enumerate(targets.names) if at.endswith(f"_{c}")) for c in _REFERENCES]
    note("frames of the sequence")
    references = [prior.coefficients(targets.test[k].numpy()) for k in chosen]
    frames = list(pixels * frame_information(light, np.array(references), setup, settings))
    found = []
    typical = float(light(references[0]).mean()) * WHITE_DN
    for kind, pixel in _models(setup.pixel, others=settings.other_models).items():
        if (law := pixel.crossing_law(typical)) is None:
            continue
        note(f"events of {kind}")
        noises = (settings.crossing_noise, *(settings.other_noises if pixel is setup.pixel else ()))
        each = [event_information(light, z, law, settings, noises, seed) for z in references]
        count = float(np.mean([one[2] for one in each]))
        for n in range(len(noises)):
            events = [pixels * one[0][n] for one in each]
            rms = float(np.mean([one[1][n] for one in each]))
            both = [one + other for one, other in zip(events, frames, strict=True)]
            found.append(EventBound(kind, rms, count, _decibel(prior, events), _decibel(prior, both)))
    alone = _decibel(prior, [np.zeros((1, prior.count, prior.count))])[0]
    return Bounds(name, settings, alone, _decibel(prior, frames), tuple(found))


def frame_information(
    light: SequenceLight, z: np.ndarray, setup: Setup, settings: SequenceAnalysisSettings
) -> np.ndarray:
    """Return the information of frames at each of the settings' numbers of positions, [..., counts, k, k].

    Args:
        light: The light, linear in the coefficients.
        z: Coefficients at whose light the camera's noise is taken, [..., k].
        setup: Its frame camera.
        settings: Positions, and whether the fixed pattern is known.
    """
    chosen = [set(position_subsets(settings.positions, count, 1)[0].tolist()) for count in settings.counts]
    everywhere, camera, unknowns = np.arange(len(light.left)), setup.frame_camera, z.shape[-1]
    every_seen = [light(one) for one in z.reshape(-1, unknowns)]
    found = np.zeros((len(every_seen), len(chosen), unknowns, unknowns))
    size = (*found.shape[:2], len(everywhere))
    summed, weights = np.zeros((*size, 0 if settings.fpn_corrected else unknowns)), np.zeros(size)
    for k in sorted(set().union(*chosen)):
        now = np.full(len(everywhere), (k + 1) * settings.duration_s / settings.positions)
        rows = light.rows(everywhere, now)  # the same whatever is seen
        for each, seen in enumerate(every_seen):
            there = torch.from_numpy(light.at(seen, everywhere, now))
            weight = (camera.shows(there) / camera.noise_variance(there)).numpy()  # clipped ones tell nothing
            one = NormalEquations.empty(unknowns)
            one.add(rows, weight, np.zeros(len(rows)), everywhere, 0.0)
            for n in (n for n, mine in enumerate(chosen) if k in mine):
                found[each, n] += one.information
                if not settings.fpn_corrected:
                    summed[each, n] += rows * weight[:, None]
                    weights[each, n] += weight
    for each, seen in enumerate(every_seen if not settings.fpn_corrected else ()):
        spread = camera.pattern_variance(torch.from_numpy(seen.mean(axis=1))).sqrt().numpy()
        for total, part, weight in zip(found[each], summed[each], weights[each], strict=True):
            NormalEquations(total, np.zeros(unknowns)).subtract_offsets(part, weight, spread)
    return found.reshape(*z.shape[:-1], *found.shape[1:])


def event_information(
    light: SequenceLight,
    z: np.ndarray,
    law: CrossingLaw,
    settings: SequenceAnalysisSettings,
    noises: Sequence[float] | None = None,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the information of events for each error of a crossing and each number of positions.

    Args:
        light: The light.
        z: Coefficients of the target that makes the events, [k].
        law: Constants of the event model.
        settings: Positions, noise of a crossing, silences.
        noises: Errors of a crossing beside the law's own, log units; None = that of the settings.
        seed: Seed of the noise events.

    Returns:
        float64 [noises, counts, k, k]; root mean square error of a crossing, log units, [noises]; crossings per
        pixel.
    """
    noises = (settings.crossing_noise,) if noises is None else noises
    seen = light(z)
    levels = levels_of(seen, light.times_s, law)
    record = predicted_record(light, levels, law, seed)
    measured = record.measured
    middle, share = settings.duration_s / 2, settings.duration_s / settings.positions / 2
    windows = [(middle - count * share, middle + count * share) for count in settings.counts]
    weights, rms = [], []
    for noise in noises:
        variance = record.variance(light, seen, law, noise)
        rms.append(math.sqrt(variance[measured].mean()) if measured.any() else math.nan)
        for first, last in windows:
            inside = measured & (record.t_s > first) & (record.t_s <= last)
            weights.append(np.where(inside, 1.0 / variance, 0.0))
    found = row_information(light, levels, record, np.stack(weights), law.threshold_sigma)
    found = found.reshape(len(noises), len(windows), *found.shape[1:])
    if settings.silences:
        for n, noise in enumerate(noises):
            for k, window in enumerate(windows):
                found[n, k] += _silence_information(light, levels, record, law, window, noise)
    return found, np.array(rms), float(measured.sum()) / len(light.left)


def row_information(
    light: SequenceLight,
    levels: Levels,
    record: EventRecord,
    weights: np.ndarray,
    spread: float,
    block: int = 16_384,
) -> np.ndarray:
    """Return the information of a record's rows with the thresholds of each pixel integrated out, [W, k, k].

    Args:
        light: The light.
        levels: Levels at which it is linearised.
        record: The events.
        weights: 1 / variance of each instant's change, 0 = does not count, once or for several cases, [W, N].
        spread: Mismatch of the thresholds, log units.
        block: Rows at a time; the result does not depend on it.
    """
    totals = [NormalEquations.empty(light.right.shape[2] - 1) for _ in weights]
    for part, rows, _ in record.blocks(light, levels, block):
        group = 2 * record.pixel[part] + (record.sign[part] > 0)
        order = np.argsort(group, kind="stable")
        for total, weight in zip(totals, weights, strict=True):
            counts = order[weight[part][order] > 0]
            total.add(rows[counts], weight[part][counts], np.zeros(len(counts)), group[counts], spread)
    return np.stack([total.information for total in totals])


def _silence_information(
    light: SequenceLight,
    levels: Levels,
    record: EventRecord,
    law: CrossingLaw,
    window: tuple[float, float],
    noise: float,
) -> np.ndarray:
    """Return the information of "no event since": a change that is uniform between the thresholds."""
    index = np.arange(len(record))
    known = ((record.sign != 0) | (record.origin >= 0) | law.starts_at_rest) & (record.t_s <= window[1])
    known &= record.t_s < light.times_s[-1]
    last = np.full(len(light.left), -1)
    np.maximum.at(last, record.pixel[known], index[known])
    pixel = np.flatnonzero(last >= 0)
    count = len(pixel)
    ends = EventRecord(
        np.repeat(pixel, 2),
        np.stack([record.t_s[last[pixel]], np.full(count, window[1])], axis=1).ravel(),
        np.tile(np.array([0, 1], np.int8), count),
        np.stack([np.full(count, -1), 2 * np.arange(count)], axis=1).ravel(),
    )
    width = law.threshold_on + law.threshold_off
    variance = width**2 / 12 + 2 * law.threshold_sigma**2 / 4 + law.noise**2 + noise**2
    weight = np.where(ends.sign > 0, 1.0 / variance, 0.0)
    return row_information(light, levels, ends, weight[None], 0.0)[0]


def canvas_decibel(error: float, target_plane: Plane, sampling: Sampling | None = None) -> float:
    """Return the PSNR of a mean squared error of the target's cells; dark elsewhere.

    Args:
        error: Mean squared error of a cell.
        target_plane: The cells.
        sampling: What is scored; None: `scored_sampling`.
    """
    sampling = sampling or scored_sampling(target_plane.extent_m[1])
    canvas = sampling.width * sampling.scored_rows * sampling.pitch_m**2
    return -10 * math.log10(error * math.prod(target_plane.extent_m) / canvas)


def _decibel(prior: PatternPrior, information: list[np.ndarray]) -> tuple[float, ...]:
    """Return the PSNR of the mean error over references, for each number of positions."""
    errors = [[prior.error(one) for one in each] for each in information]
    return tuple(
        round(canvas_decibel(float(value), prior.target_plane), 3) for value in np.mean(errors, axis=0)
    )


def _models(own: PixelSettings, *, others: bool) -> dict[str, PixelSettings]:
    """Return the setup's own event model and, where asked for, the other kinds with its thresholds."""
    found = {str(getattr(own, "kind", "")): own}
    values = {item.name: getattr(own, item.name) for item in fields(own) if item.name != "kind"}  # type: ignore[arg-type]
    for kind in EVENT_MODELS if others else ():
        settings = EVENT_MODELS[kind]
        names = {item.name for item in fields(settings)}  # type: ignore[arg-type]
        if kind not in found and "threshold_on" in names & set(values):
            other: Any = settings()
            found[kind] = replace(other, **{name: values[name] for name in names & set(values)})
    return found
