"""All events of a sequence as two images of the target: what a network of whole sequences sees of them.

The solutions z = (A + m)^-1 b of what the events say (`sequence_statistic`) at a weak and at a strong prior m,
put where the target was at each instant. No sensor is quite the calibrated one, and an error that comes back
event after event is not averaged away as noise is. Captures with known targets show it: with z* the true
coefficients, b - A z* is noise of covariance A if the setup is right. What they share is taken from b, and what
else they miss, by more than noise, is added to the covariance of b: with N that sum,

    z = (A N^-1 A + m)^-1 A N^-1 (b - mean)

| symbol | meaning | unit |
|---|---|---|
| A, b | information and score of the coefficients, `EventStatistic` | |
| m | weight of the prior over its own, `EVENT_PRIORS` | |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.errors import ConfigError, DataError, UnknownNameError
from evnlos.inverse.prior import PatternPrior, ScoreErrors, handwritten_prior, root_of
from evnlos.inverse.sequence_light import EVENT_PRIORS, sequence_light
from evnlos.inverse.sequence_statistic import EventSolver, EventStatistic
from evnlos.machine import note
from evnlos.scene import Ink, LineMotion, Motion, Target
from evnlos.setups import Setup, load_setup
from evnlos.tensor_file import TensorFile
from evnlos.types import Events, Plane, target_side_m

CELLS, COEFFICIENTS = 32, 240
"""Cells along a side of the target, patterns of its prior; what fewer leave out shines as errors do."""
EVENT_ERRORS_FILE = "events.safetensors"
"""What captures showed of the errors of a calibrated setup, in its folder."""
WORTH = 1.1
"""How many times the events of when the target was last solved for make it worth solving for again."""

_SPAN_US = 100_000  # first and last instant are multiples of it, so that clocks that jitter share a light path
_FEWEST = 4  # captures that tell of errors
_LEAST_GAIN_DB = 0.3
_LEAST = 1e-6  # noise of a coefficient, in the mean of all


@dataclass(frozen=True)
class AboutErrors:
    """Description of a file of errors."""

    captures: tuple[str, ...]
    """Names of the captures."""
    gain_db: float = 0.0
    """What each gained from the others, decibels over the target plane, mean of both priors."""


@dataclass(frozen=True, eq=False)
class EventErrors:
    """What captures with known targets showed that a setup gets wrong of its events.

    How much events say depends on the target: a pixel sees the logarithm of the light, which changes less where
    a bright target shines; among 28 letters and digits the information differs 14-fold. So each capture keeps
    its own, and errors are in units of its root.

    Args:
        about: Names of the captures, and what they gained.
        errors: R^-1 (b - A z*) of the score b of each about its true target z*, float32 [C, k].
        roots: R, root of the information A of each (`root_of`), float32 [C, k, k].
        light: Mean light of each target, 0..1, float32 [C].

    Raises:
        DataError: The sizes disagree.
    """

    about: AboutErrors
    errors: torch.Tensor
    roots: torch.Tensor
    light: torch.Tensor

    def __post_init__(self) -> None:
        captures, count = len(self.about.captures), self.roots.shape[-1]
        shapes = self.errors.shape, self.roots.shape, self.light.shape
        if shapes != ((captures, count), (captures, count, count), (captures,)):
            raise DataError(f"errors {list(self.errors.shape)} of {captures} captures")

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        statistics: Sequence[EventStatistic],
        prior: PatternPrior,
        truths: Sequence[NDArray[np.floating]],
    ) -> EventErrors:
        """Return what sequences of known targets show.

        Args:
            names: Of the captures.
            statistics: What the events of each say if the setup is right.
            prior: What they are about.
            truths: True target of each, on the cells of the prior, [h, w].
        """
        roots = [root_of(one.information) for one in statistics]
        errors = [
            np.linalg.solve(root, one.score - one.information @ prior.coefficients(true))
            for root, one, true in zip(roots, statistics, truths, strict=True)
        ]
        light = np.array([true.mean() for true in truths])
        tensors = (torch.from_numpy(part).float() for part in (np.stack(errors), np.stack(roots), light))
        return cls(AboutErrors(tuple(names)), *tensors)

    def write(self, setup: Path, gain_db: float = 0.0) -> EventErrors:
        """Write them to the folder of a setup, with what captures gain by them, and return them with that."""
        found = replace(self, about=replace(self.about, gain_db=gain_db))
        tensors = {"errors": self.errors, "roots": self.roots, "light": self.light}
        EVENT_ERRORS.write(setup / EVENT_ERRORS_FILE, tensors, found.about)
        return found

    def corrected(self, statistic: EventStatistic, capture: str) -> EventStatistic:
        """Return what events say once the errors that other captures showed are known.

        Args:
            statistic: What they say if the setup is right.
            capture: Name of their capture, which does not count; fewer than 4 others change nothing.
        """
        others = self.errors.double().numpy()[[name != capture for name in self.about.captures]]
        return statistic if len(others) < _FEWEST else with_errors(statistic, ScoreErrors.of(others, 1.0))

    def told(self, *, corrected: bool) -> list[EventStatistic]:
        """Return what events of each capture say of targets: the information, and its root as scores.

        Scores R e of all e are made of the columns of the root R, since solving is linear.

        Args:
            corrected: Whether the errors are known (`corrected`), but for what all share, which is taken away.
        """
        found = [EventStatistic(np.zeros(len(r)), r @ r, r) for r in self.roots.double().numpy()]
        if not corrected:
            return found
        errors = ScoreErrors.of(self.errors.double().numpy(), 1.0)
        return [with_errors(one, replace(errors, mean=np.zeros_like(errors.mean))) for one in found]

    def gain_db(
        self, statistics: Sequence[EventStatistic], prior: PatternPrior, truths: Sequence[NDArray[np.floating]]
    ) -> float:
        """Return what the captures gain where each is corrected by what the others showed, decibels.

        The mean over captures and `EVENT_PRIORS` of 10 lg of the squared error before over that after.

        Args:
            statistics: What the events of each capture say if the setup is right.
            prior: What they are about.
            truths: True target of each, on the cells of the prior, [h, w].
        """
        gains = list[float]()
        for name, statistic, true in zip(self.about.captures, statistics, truths, strict=True):
            pairs = (one.solutions(EVENT_PRIORS) for one in (statistic, self.corrected(statistic, name)))
            for both in zip(*pairs, strict=True):
                before, after = (np.mean((np.clip(prior.image(z), 0.0, 1.0) - true) ** 2) for z in both)
                gains.append(float(10 * np.log10(before / after)))
        return float(np.mean(gains))


def with_errors(statistic: EventStatistic, errors: ScoreErrors) -> EventStatistic:
    """Return what events say once the errors of their setup count: the mean taken away, the scatter as noise.

    Args:
        statistic: What they say if the setup is right.
        errors: What the setup gets wrong of scores.
    """
    a, root = statistic.information, root_of(statistic.information)
    spread = root @ errors.spread
    noise = a + spread @ spread.T + _LEAST * np.trace(a) / len(a) * np.eye(len(a))
    pushed = np.linalg.solve(noise, a).T  # A N^-1
    return EventStatistic(statistic.z, pushed @ a, pushed @ (statistic.score - root @ errors.mean))


EVENT_ERRORS = TensorFile(
    "evnlos-event-errors-2",
    ("errors", "roots", "light"),
    AboutErrors,
    EventErrors,
    "errors of a setup's events",
    "the file that `evnlos calibrate` of this version writes beside setup.yaml",
)
"""Errors of events on disk."""


def event_errors(setup: str | Path, instead: str) -> EventErrors:
    """Return what captures with known targets showed that a setup gets wrong of its events.

    Args:
        setup: Folder of `evnlos calibrate`.
        instead: What to do without them, for the error.

    Raises:
        DataError: They are not there, damaged, or about other patterns than events are solved for.
    """
    path = Path(setup) / EVENT_ERRORS_FILE
    if not path.is_file():
        raise DataError(
            f"{setup} has no {EVENT_ERRORS_FILE}, which says what events of known targets miss; calibrate "
            f"again, or {instead}"
        )
    found = EVENT_ERRORS.load(path, "")
    if found.roots.shape[-1] != COEFFICIENTS:
        raise DataError(
            f"{path} is about {found.roots.shape[-1]} patterns of the target, and events are solved for "
            f"{COEFFICIENTS}; calibrate again, or {instead}"
        )
    return found


def gains_by_errors(setup: Path) -> bool:
    """Return whether captures gain before any network where what others showed of errors is taken from events.

    With less than 0.3 dB there is nothing to try.

    Args:
        setup: Folder of a calibrated setup.
    """
    path = setup / EVENT_ERRORS_FILE
    return path.is_file() and EVENT_ERRORS.load(path, "").about.gain_db >= _LEAST_GAIN_DB


class _Sequence(NamedTuple):
    """A sequence on the clock of its light path."""

    solver: EventSolver
    prior: PatternPrior
    began_us: int
    events: Events
    instants_s: NDArray[np.float64]
    position_m: NDArray[np.float64]


def event_statistic(
    events: Events, edges_us: NDArray[np.int64], motion: Motion | None, setup: str, side_m: float
) -> tuple[EventStatistic, PatternPrior]:
    """Return what all events of a sequence say of the target through a setup, and the prior that it is about.

    Arguments and errors as of `event_images`; `side_m` is the side of the target plane, metres.
    """
    found = _sequence(events, edges_us, motion, setup, side_m)
    from threadpoolctl import threadpool_limits  # whose import changes the environment

    with threadpool_limits(1):  # its products are small: a second thread mostly waits
        return found.solver(found.events), found.prior


def check_named(setup: str) -> None:
    """Refuse to solve events where no setup is named.

    Args:
        setup: Word of the setup, empty where none is.

    Raises:
        ConfigError: It is empty.
    """
    if not setup:
        raise ConfigError(
            "Sampling.setup is empty; the surfaces 'likelihood' and 'so-far' undo the light path of a setup: "
            "give the folder of `evnlos calibrate`"
        )


def _sequence(
    events: Events, edges_us: NDArray[np.int64], motion: Motion | None, setup: str, side_m: float
) -> _Sequence:
    check_named(setup)
    if motion is None:
        raise DataError(
            "the motion is unknown, and the surfaces 'likelihood' and 'so-far' need it; state it in "
            "capture.yaml (`evnlos track` finds it)"
        )
    edges_us, began_us = np.asarray(edges_us, np.int64), 0
    if isinstance(motion, LineMotion):  # on the motion's own clock the recordings of a setup share a light path
        began_us = round(1e6 * motion.start_s)
        motion, edges_us = replace(motion.in_its_plane(), start_s=0.0), edges_us - began_us
        events = replace(events, t_us=events.t_us - began_us)
    span = (int(edges_us[0]) // _SPAN_US * _SPAN_US * 1e-6, -(-int(edges_us[-1]) // _SPAN_US) * _SPAN_US * 1e-6)
    solver, prior = _solver(setup, motion, span, (events.height, events.width), side_m)
    note("what the events say")
    instants_s = np.asarray(edges_us[1:] * 1e-6, np.float64)
    return _Sequence(solver, prior, began_us, events, instants_s, motion.position_m(instants_s))


def event_images(
    events: Events,
    edges_us: NDArray[np.int64],
    motion: Motion | None,
    setup: str,
    canvas: Plane,
    capture: str | None = None,
    *,
    so_far: bool = False,
) -> NDArray[np.float32]:
    """Return the target that all events of a sequence show, where it is at each edge: float32 [N, 2, h, w].

    One image with a weak prior, one with a strong one (`EVENT_PRIORS`): the first is sharp and noisy.

    Args:
        events: The stream of the whole sequence.
        edges_us: Ascending edges of the grids, [N + 1], microseconds; the light is that between first and last.
        motion: Of the target.
        setup: Word of a setup whose light path and event pixel are known, see `load_setup`.
        canvas: What is drawn.
        capture: Name of the capture, whose sensor errs as other captures of the setup showed (`EventErrors`);
            None: the setup counts as right.
        so_far: Whether each image knows the events up to its edge alone. The target is solved for again where
            there are a tenth more than when it was last, and at the last edge.

    Raises:
        ConfigError: No setup is named, it is not linear, or its event model states no law of its crossings.
        DataError: The motion is unknown, or the file of errors is damaged or not there.
    """
    errors = None if capture is None else event_errors(setup, "give --sampling.surface likelihood")
    seen = _sequence(events, edges_us, motion, setup, target_side_m(canvas))
    places = seen.position_m
    steps = _worth_solving(seen) if so_far else [0]
    until = seen.instants_s[steps] if so_far else seen.solver.light.times_s[-1:]
    from threadpoolctl import threadpool_limits  # whose import changes the environment

    with threadpool_limits(1):
        found = seen.solver.so_far(seen.events, until)
        images = np.empty((len(places), len(EVENT_PRIORS), canvas.height, canvas.width), np.float32)
        for first, after, statistic in zip(steps, [*steps[1:], len(places)], found, strict=True):
            if errors is not None and capture is not None:
                statistic = errors.corrected(statistic, capture)
            images[first:after] = _drawn(statistic, seen.prior, canvas, places[first:after])
    return images


def _drawn(
    statistic: EventStatistic, prior: PatternPrior, canvas: Plane, position_m: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return the solutions at both priors where the target is at N instants, [N, 2, h, w]."""
    images = np.empty((len(position_m), len(EVENT_PRIORS), *canvas.shape), np.float32)
    for k, z in enumerate(statistic.solutions(EVENT_PRIORS)):
        seen = np.clip(prior.image(z), 0.0, 1.0).astype(np.float32)
        target = Target("events", seen, prior.target_plane.extent_m[0])
        images[:, k] = target.rasterise(canvas, position_m)
    return images


class RunningEventImages:
    """The target that events show while they come: `event_images` of those so far, one instant after the other.

    Each search begins where the last one ended.

    Args:
        span_us: First and last instant of the sequence, microseconds on the events' clock.
        motion: Of the target.
        setup: Word of a setup whose light path and event pixel are known.
        canvas: What is drawn.
        shape: Rows and columns of the event camera.

    Raises:
        ConfigError: As for `event_images`.
        DataError: As for `event_images`.
    """

    def __init__(
        self, span_us: tuple[int, int], motion: Motion | None, setup: str, canvas: Plane, shape: tuple[int, int]
    ) -> None:
        none = Events.empty(shape[1], shape[0])
        self._seen = _sequence(none, np.asarray(span_us), motion, setup, target_side_m(canvas))
        self._canvas, self._last_s = canvas, float(self._seen.solver.light.times_s[-1])
        self.begin()

    def begin(self) -> None:
        """Forget what events said before."""
        self._unknown = self._seen.solver.nothing_known()

    def at(self, events: Events, until_us: int, position_m: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return both images, float32 [2, h, w], of the events up to an instant.

        Args:
            events: All since the beginning; later ones are passed over.
            until_us: The instant, microseconds; after the last of the sequence counts as that.
            position_m: Where the target is drawn, (x, y) in metres.
        """
        began_us, solver = self._seen.began_us, self._seen.solver
        until_s = min((until_us - began_us) * 1e-6, self._last_s)
        moved = replace(events, t_us=events.t_us - began_us)
        from threadpoolctl import threadpool_limits  # whose import changes the environment

        with threadpool_limits(1):
            statistic = solver.solved(moved, until_s, self._unknown)
            return _drawn(statistic, self._seen.prior, self._canvas, np.reshape(position_m, (1, 2)))[0]


def _worth_solving(seen: _Sequence) -> list[int]:
    """Return at which steps enough events came since the step before to solve for the target again."""
    counts = np.searchsorted(seen.events.t_us, np.round(1e6 * seen.instants_s), side="right")
    steps, last = list[int](), len(counts) - 1
    for step, count in enumerate(counts.tolist()):
        if not steps or step == last or count > WORTH * counts[steps[-1]]:
            steps.append(step)
    return steps


def event_prior(
    setup: Setup, side_m: float, patterns: int = COEFFICIENTS, letters_m: float = 0.0
) -> PatternPrior:
    """Return the prior over targets that events are solved with: letters as large as the setup's known ones.

    Args:
        setup: The setup.
        side_m: Side of the target plane, metres.
        patterns: Patterns that are kept.
        letters_m: Size of letters of a setup that knows none, metres; 0 = as large as the plane.
    """
    ink = setup.ink if setup.ink.size_m or not letters_m else Ink(letters_m)
    return handwritten_prior(Plane(CELLS, CELLS, side_m / CELLS), patterns, ink=ink)


@lru_cache(maxsize=2)
def _solver(
    setup: str, motion: Motion, span_s: tuple[float, float], shape: tuple[int, int], side_m: float
) -> tuple[EventSolver, PatternPrior]:
    """Return the solver of a setup, and its prior: letters as large as the known targets' or the usual one."""
    try:
        known = load_setup(setup)
    except UnknownNameError:
        raise UnknownNameError(
            f"the setup {setup!r}, whose light path the events are solved through, is not there: give the "
            "folder of `evnlos calibrate` that the samples were made with, from where its name leads to it, or "
            "put a folder `near` beside weights `near-....safetensors`"
        ) from None
    prior = event_prior(known, side_m)
    note("light path of the events")
    light = sequence_light(known.seen_by(shape), prior, motion.position_m, span_s, shape)
    return EventSolver(light, known.pixel.known_law(light.typical_dn)), prior
