"""The captures that a calibration works on: one rig, one camera, known motions, some of them held out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.dataset.capture import Capture, read_capture
from evnlos.dataset.importer import character_of
from evnlos.errors import DataError
from evnlos.scene import LineMotion, Scene
from evnlos.seeds import derive_seed

FEWEST = 3
"""Fewest captures of a calibration: two to fit, one to check."""


@dataclass(frozen=True)
class Shots:
    """Captures of one rig, in the order of their names.

    Args:
        captures: The captures; the motion of each is known, and, where they are `labelled`, the target.
        plate_m: Side of the plates, metres.
    """

    captures: tuple[Capture, ...]
    plate_m: float = 0.08

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

    def frame_of(self) -> NDArray[np.int64]:
        """Return the number of the capture that each frame of `frames` belongs to, int64 [N]."""
        return np.repeat(np.arange(len(self.captures)), [len(capture.frames) for capture in self.captures])


def read_shots(
    folders: Iterable[str | Path],
    *,
    exclude: Sequence[str] = (),
    holdout: Sequence[str] = (),
    share: float = 0.25,
    seed: int = 0,
    plate_m: float | None = None,
) -> tuple[Shots, Shots]:
    """Read the captures of one rig and split them into those to fit and those to check the fit on.

    Args:
        folders: Capture folders.
        exclude: Names of captures, or characters, that are left alone: they are not even read.
        holdout: Names, or characters, to check on; empty draws a share of the captures.
        share: Share of the captures that is drawn, 0..1.
        seed: Seed of the draw.
        plate_m: Side of the plates where the targets are unknown, metres: what the captures say of their
            targets is then dropped. None takes the targets as known.

    Returns:
        The captures to fit, and those held out.

    Raises:
        DataError: Too few captures, two of one name, one without target or motion, or captures of different
            cameras, rigs or plates.
    """
    paths = {Path(folder).resolve().name: Path(folder).resolve() for folder in folders}
    _refuse_strangers(paths, (*exclude, *holdout))
    chosen = [name for name in sorted(paths) if not _named(name, exclude)]
    if len(chosen) < FEWEST:
        raise DataError(
            f"{len(chosen)} capture(s) are left to calibrate on; give {FEWEST} or more, best 20, of one rig"
        )
    captures = [read_capture(paths[name]) for name in chosen]
    if plate_m is not None:
        captures = [replace(capture, target=None) for capture in captures]
    for capture in captures:
        _motion(capture) if plate_m is not None else _scene(capture)
        _check_same_rig(captures[0], capture)
    side = _scene(captures[0]).target.size_m if plate_m is None else plate_m
    held = {name for name in chosen if _named(name, holdout)} or _drawn(chosen, share, seed)
    if len(chosen) - len(held) < FEWEST - 1:
        raise DataError(
            f"{len(held)} of {len(chosen)} captures are held out; leave {FEWEST - 1} or more to fit"
        )
    return (
        Shots(tuple(capture for capture in captures if capture.name not in held), side),
        Shots(tuple(capture for capture in captures if capture.name in held), side),
    )


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
    return capture.motion


def _check_same_rig(first: Capture, other: Capture) -> None:
    """Refuse captures of another camera, rig or plate than the first one's."""
    pairs = {
        "camera": (first.info.camera, other.info.camera),
        "rig": (first.info.rig, other.info.rig),
        "plate_m": tuple(one.target.size_m if one.target else None for one in (first, other)),
        "size": (first.frames.shape[1:], other.frames.shape[1:]),
        "bit depth": (str(first.frames.dtype), str(other.frames.dtype)),
    }
    for what, (mine, theirs) in pairs.items():
        if mine != theirs:
            raise DataError(
                f"{first.name} and {other.name} differ in {what} ({mine} and {theirs}); "
                "calibrate the captures of one rig and one camera at a time"
            )
