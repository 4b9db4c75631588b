"""Weights that come with the package, by name."""

from __future__ import annotations

from pathlib import Path

from evnlos.errors import DataError

_FOLDER = Path(__file__).parent / "published"
_RIGS_M = {"near": 0.30, "far": 0.50}
"""Distance from hidden object to wall of each rig that there are weights for, metres."""
_PASS = "pass"


def published() -> dict[str, Path]:
    """Return the weights that come with the package: name, such as "near-frame", -> file.

    A name is rig and paradigm; one that ends in "-pass" sees all positions of a pass together.
    """
    return {path.stem: path for path in sorted(_FOLDER.glob("*.safetensors"))}


def published_rig(weights: str | Path) -> Path | None:
    """Return the calibrated rig that published weights were trained for, a `rig.yaml`; None for other weights.

    Args:
        weights: A name of `published`, or what else stands for weights.
    """
    name = str(weights)
    path = _FOLDER / f"{name.partition('-')[0]}.yaml"
    return path if name in published() and path.is_file() else None


def published_single() -> list[str]:
    """Return the names of the published weights that see one position at a time.

    Example:
        >>> published_single()
        ['near-event', 'near-frame']
    """
    return [name for name in published() if not name.endswith(f"-{_PASS}")]


def published_for(distance_m: float | None, paradigm: str, *, is_motion_known: bool) -> str:
    """Return the name of the published weights that fit a capture best.

    Args:
        distance_m: From hidden object to wall, metres; None: unknown, taken for that of `near`.
        paradigm: What they shall see: "frame", "event" or "fusion".
        is_motion_known: Whether the whole pass can be seen together, which needs the motion.

    Raises:
        DataError: There are none for this paradigm.

    Example:
        >>> published_for(0.28, "frame", is_motion_known=False)
        'near-frame'
    """
    wanted = _RIGS_M["near"] if distance_m is None else distance_m
    names = published()
    rigs = sorted(_RIGS_M, key=lambda rig: abs(_RIGS_M[rig] - wanted))
    kinds = [f"{paradigm}-{_PASS}", paradigm] if is_motion_known else [paradigm]
    for name in (f"{rig}-{kind}" for rig in rigs for kind in kinds):
        if name in names:
            return name
    raise DataError(
        f"no weights for {paradigm} come with the package that need no motion; give the motion in capture.yaml "
        "(`evnlos track` finds it), or weights of your own"
    )
