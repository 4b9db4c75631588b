"""What decides a calibration, and the captures that it works on.

- Settings: which captures are fitted and which held out, and where the search begins.
- The captures: one setup, one camera, known motions, some of them held out.
- What each has of its own: light and motion that differ from those of the setup and of its notes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evnlos.data.capture import Capture, by_name, read_capture
from evnlos.data.frames import clipped_at
from evnlos.data.sampling import character_of
from evnlos.data.simulate import Simulation
from evnlos.errors import ConfigError, DataError
from evnlos.scene import HandwritingGlyphs, LineMotion, Scene
from evnlos.setups import PaperSetup, RadiometricSetup
from evnlos.types import derive_seed


def _rough_metal() -> Simulation:
    return Simulation(
        glyphs=HandwritingGlyphs(characters="ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789", writers=8),
        setup=RadiometricSetup(roughness=0.1),
    )


@dataclass(frozen=True)
class Calibration:
    """How captures of a setup become a simulation of it."""

    exclude: tuple[str, ...] = ()
    """Names of captures, or characters, that the calibration never reads: those that a network is tested on."""
    holdout: tuple[str, ...] = ()
    """Names of captures, or characters, to check the fit on; none draws `holdout_share` of the captures."""
    holdout_share: float = 0.25
    """Share of the captures that is drawn for the check, between 0 and 1."""
    targets: Literal["known", "unknown"] = "known"
    """Whether the captures' targets are known; where not, any handwriting is as likely, and what the files say
    of targets is not looked at."""
    wall: Literal["auto", "any", "formula"] = "auto"
    """Whether the wall may be of any kind (slopes of its facets, texture, bend; what shines along), or is rough
    metal by one formula; `auto` is the first where targets are known and five captures or more are fitted."""
    fit_distance: bool = False
    """Fit the distance of target and wall too; else that of the capture's notes is taken as measured."""
    measured: dict[str, tuple[float, float]] = field(default_factory=dict)
    """What is measured, with a standard deviation, e.g. `camera_distance_m 0.6 0.02`: priors of wall `any`."""
    events: bool = True
    """Fit the event pixel too."""
    columns: int = 64
    """Columns of the images that the optics are fitted to, pixels; more cost time."""
    event_captures: int = 3
    """Captures whose events are simulated for the fit, and as many for the check."""
    start: Simulation = field(default_factory=_rough_metal)
    """Where the search starts, and every setting that it leaves alone."""
    seed: int = 0
    """Seed of every draw."""

    def __post_init__(self) -> None:
        if not 0 < (share := self.holdout_share) < 1:
            raise ConfigError(f"Calibration.holdout_share is {share}; give a share between 0 and 1")
        setup = self.start.setup
        if not setup.parameters():
            raise ConfigError(
                f"start.setup is {setup.kind}, which leaves no optics to fit; give paper or radiometric"
            )
        if self.targets == "unknown" and not setup.is_linear:
            raise ConfigError(
                f"start.setup is {setup.kind}, which is not linear; a fit to unknown targets needs radiometric"
            )
        if self.columns < 16:
            raise ConfigError(f"Calibration.columns is {self.columns}; give 16 pixels or more")
        if self.event_captures < 1:
            raise ConfigError(f"Calibration.event_captures is {self.event_captures}; give at least 1")


def rough_metal() -> Calibration:
    """Return the calibration of a rough metal wall: roughness, camera and place of the target are searched."""
    return Calibration()


def paper() -> Calibration:
    """Return the calibration of the paper's transport: tPSF length and shape, and an affine view."""
    start = _rough_metal()
    transport = PaperSetup(pitch_m=1e-3, kernel_radius=6.0, window=0.3, field_of_view_m=0.5)
    return Calibration(start=Simulation(glyphs=start.glyphs, setup=transport))


PRESETS: dict[str, Callable[[], Calibration]] = {"default": rough_metal, "paper": paper}
"""Calibrations by name."""


FEWEST = 3
"""Fewest captures of a calibration: two to fit, one to check."""


class Own(NamedTuple):
    """What a capture has of its own beside the setup and its notes.

    Args:
        target: Brightness of its target over the setup's.
        ambient: Its ambient light over the setup's.
        ahead_m: How far its target is ahead of the stated place in the middle of its frames, metres.
        speed: Its speed over the stated one.
        target_growth: By how much the target's brightness grows from first frame to last, over its mean.
        ambient_growth: By how much its ambient light does.
    """

    target: float = 1.0
    ambient: float = 1.0
    ahead_m: float = 0.0
    speed: float = 1.0
    target_growth: float = 0.0
    ambient_growth: float = 0.0

    def then(self, more: Own) -> Own:
        """Return both together: this is taken off a capture, and of what is left there is more."""
        ambient, ahead_m = self.ambient + self.target * (more.ambient - 1), self.ahead_m + more.ahead_m
        growth = self.target_growth + more.target_growth, self.ambient_growth + more.ambient_growth
        return Own(self.target * more.target, ambient, ahead_m, self.speed * more.speed, *growth)


@dataclass(frozen=True)
class CaptureSet:
    """Captures of one setup, in the order of their names.

    Args:
        captures: The captures; the motion of each is known, and, where they are `labelled`, the target.
        target_size_m: Side of the targets, metres.
        own: What each had of its own, which frames and motions no longer have; () is nothing.
        drifts: Whether target and ambient light of each count as unknown.
    """

    captures: tuple[Capture, ...]
    target_size_m: float = 0.08
    own: tuple[Own, ...] = ()
    drifts: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the captures."""
        return tuple(capture.name for capture in self.captures)

    @property
    def motions(self) -> tuple[LineMotion, ...]:
        """Motion of each capture's target."""
        return tuple(_motion(capture) for capture in self.captures)

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """Target and motion of each capture."""
        return tuple(_scene(capture) for capture in self.captures)

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the sensor, pixels."""
        height, width = self.captures[0].frames.shape[1:]
        return height, width

    @property
    def peak(self) -> int:
        """Largest digital number of the frames."""
        return self.captures[0].peak

    def times_s(self, k: int) -> NDArray[np.float64]:
        """Return the instants of the frames of capture `k`, float64 [T], seconds."""
        return self.captures[k].frame_times_us.astype(np.float64) * 1e-6

    def frames(self) -> NDArray:
        """Return the frames of all captures, one after the other, digital numbers [N, H, W]."""
        return np.concatenate([capture.frames for capture in self.captures])

    def frame_of(self, every: int = 1) -> NDArray[np.int64]:
        """Return the number of the capture that every n-th frame of each belongs to, int64 [N]."""
        return np.repeat(np.arange(len(self.captures)), [len(c.frames[::every]) for c in self.captures])


def read_capture_set(
    folders: Iterable[str | Path],
    *,
    exclude: Sequence[str] = (),
    holdout: Sequence[str] = (),
    share: float = 0.25,
    seed: int = 0,
    target_size_m: float | None = None,
) -> tuple[CaptureSet, CaptureSet]:
    """Read the captures of one setup and split them into those to fit and those to check the fit on.

    Args:
        folders: Capture folders.
        exclude: Names of captures, or characters, that are left alone: they are not even read.
        holdout: Names, or characters, to check on; empty draws a share of the captures.
        share: Share of the captures that is drawn, 0..1.
        seed: Seed of the draw.
        target_size_m: Side of the targets where the targets are unknown, metres: what the captures say of their
            targets is then dropped. None takes the targets as known.

    Returns:
        The captures to fit, and those held out.

    Raises:
        DataError: Too few captures, two of one name, one without target or motion, or captures of different
            cameras, setups or targets.
    """
    paths = by_name({Path(folder).resolve() for folder in folders})
    _refuse_strangers(paths, (*exclude, *holdout))
    chosen = [name for name in sorted(paths) if not _named(name, exclude)]
    if len(chosen) < FEWEST:
        raise DataError(
            f"{len(chosen)} capture(s) are left to calibrate on; give {FEWEST} or more, best 20, of one setup"
        )
    captures = [_white_where_clipped(read_capture(paths[name], needs_events=False)) for name in chosen]
    captures = captures if target_size_m is None else [replace(one, target=None) for one in captures]
    for capture in captures:
        _motion(capture) if target_size_m is not None else _scene(capture)
        _check_same_setup(captures[0], capture)
    side = _scene(captures[0]).target.size_m if target_size_m is None else target_size_m
    held = {name for name in chosen if _named(name, holdout)} or _drawn(chosen, share, seed)
    if len(chosen) - len(held) < (least := FEWEST - 1):
        raise DataError(f"{len(held)} of {len(chosen)} captures are held out; leave {least} or more to fit")
    fitted = tuple(capture for capture in captures if capture.name not in held)
    return CaptureSet(fitted, side), CaptureSet(tuple(one for one in captures if one.name in held), side)


def _white_where_clipped(capture: Capture) -> Capture:
    """Return a capture that is white, as saturated pixels are, where its camera is clipped below white."""
    if (white := clipped_at(capture.frames, capture.peak)) == capture.peak:
        return capture
    frames = np.where(capture.frames >= white, capture.peak, capture.frames).astype(capture.frames.dtype)
    return replace(capture, frames=frames)


def _named(name: str, wanted: Sequence[str]) -> bool:
    return name in wanted or character_of(name) in wanted


def _drawn(names: list[str], share: float, seed: int) -> set[str]:
    if not 0 < share < 1:
        raise DataError(f"the share held out is {share}; give a number between 0 and 1")
    count = max(1, round(share * len(names)))
    order = np.random.default_rng(derive_seed(seed, "calibration holdout")).permutation(len(names))
    return {names[i] for i in order[:count]}


def _refuse_strangers(paths: dict[str, Path], wanted: Sequence[str]) -> None:
    for one in wanted:
        if not any(one in (name, character_of(name)) for name in paths):
            raise DataError(f"no capture is named {one} or shows it; excluded and held-out names must be given")


def _scene(capture: Capture) -> Scene:
    scene = capture.scene
    if scene is None:
        missing = "target mask" if capture.target is None else "motion"
        raise DataError(
            f"{capture.name} has no known {missing}; add `{missing.split()[0]}` to its capture.yaml, or leave "
            "the capture out"
        )
    return scene


def _motion(capture: Capture) -> LineMotion:
    if capture.motion is None:
        raise DataError(
            f"{capture.name} has no known motion; add `motion` to its capture.yaml (`evnlos track` finds it), "
            "or leave the capture out"
        )
    return capture.motion.in_its_plane()


def _check_same_setup(first: Capture, other: Capture) -> None:
    """Refuse captures of another camera, setup or target than the first one's; other notes are free."""
    notes, others = (one.info.setup | one.info.setup.get("rendered", {}) for one in (first, other))
    pairs = {
        "camera": (first.info.camera, other.info.camera),
        **{f"setup.{key}": (notes.get(key), others.get(key)) for key in ("distance_m", "wall", "ambient")},
        "target_size_m": tuple(one.target.size_m if one.target else None for one in (first, other)),
        "size": (first.frames.shape[1:], other.frames.shape[1:]),
        "bit depth": (str(first.frames.dtype), str(other.frames.dtype)),
    }
    cure = "calibrate the captures of one setup and one camera at a time"
    for what, (mine, theirs) in pairs.items():
        if mine != theirs:
            raise DataError(f"{first.name} and {other.name} differ in {what} ({mine} and {theirs}); {cure}")
    if notes.get("setup") != others.get("setup"):
        raise DataError(f"{first.name} and {other.name} were rendered of different setups; {cure}")


def moved_along(motion: LineMotion, ahead_m: float, speed: float, middle_s: float) -> LineMotion:
    """Return a motion that is ahead of another in the middle of the frames, and faster.

    Args:
        motion: The other.
        ahead_m: Way along its direction, metres; below 0 it lags behind.
        speed: Its speed over the other's.
        middle_s: Instant of the middle of the frames, seconds.
    """
    along = np.asarray(motion.direction) / np.hypot(*motion.direction)
    late = motion.speed_m_s * (speed - 1) * (middle_s - motion.start_s)
    start = np.asarray(motion.start_m) + (ahead_m - late) * along
    return replace(motion, start_m=(float(start[0]), float(start[1])), speed_m_s=motion.speed_m_s * speed)


def relit(capture: Capture, levels: NDArray, peak: int) -> Capture:
    """Return a capture with other light in its frames; what was saturated stays so.

    Args:
        capture: The capture.
        levels: Its frames in the other light, digital numbers that need not be whole, [N, H, W].
        peak: Largest digital number.
    """
    frames = np.rint(levels).clip(0, peak).astype(capture.frames.dtype)
    return replace(capture, frames=np.where(capture.frames >= peak, capture.frames, frames))


def working_shape(shape: tuple[int, int], columns: int) -> tuple[int, int]:
    """Return the size (h, w), w about `columns` and at most the sensor's, that keeps the sensor's shape best.

    Args:
        shape: Sensor size (H, W), pixels.
        columns: Wanted number of columns.

    Example:
        >>> working_shape((100, 160), 60)
        (40, 64)
    """
    height, width = shape
    if columns >= width:
        return shape
    candidates = [
        (max(1, round(w * height / width)), w) for w in range(columns, min(width, columns * 4 // 3) + 1)
    ]
    return min(candidates, key=lambda s: (round(abs(s[0] * width / (s[1] * height) - 1), 6), s[1]))
