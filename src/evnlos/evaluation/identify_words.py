"""What the figures of a rig mean, in words."""

from __future__ import annotations

from dataclasses import fields

from evnlos.setups import Setup

_SHAPE = 4  # bars of a quarter of the plate tell where a letter is filled and where it is open
_EXTRA_MODES = 1.1


def verdict(patterns: int, finest_m: tuple[float | None, float | None], stroke_m: float, plate_m: float) -> str:
    """Return in a sentence what a reconstruction with this rig would be.

    Strokes are measured where bars of their width are resolved in both directions; the rough shape where bars
    of a quarter of the plate are.

    Args:
        patterns: Patterns in which handwritten plates differ by more than the noise.
        finest_m: Width of the finest upright and lying bars that are resolved, metres; None where none are.
        stroke_m: Typical stroke of the plates, metres.
        plate_m: Side of the plate, metres.

    Example:
        >>> verdict(3, (None, None), 0.008, 0.08).split(": ")[1]
        "a legible reconstruction will be the network's memory, not a measurement."
    """
    upright, lying = finest_m
    resolved = [width for width in finest_m if width is not None]
    if not resolved:
        bars = "no bars at all"
    elif len(resolved) == 1:
        there, missing = ("upright", "lying") if lying is None else ("lying", "upright")
        bars = f"{there} bars down to {1e3 * resolved[0]:.1f} mm, {missing} ones not at all"
    else:
        bars = f"bars down to {1e3 * max(resolved):.1f} mm"
    finest = None if upright is None or lying is None else max(upright, lying)
    if finest is not None and finest <= stroke_m:
        meaning = f"strokes of {1e3 * stroke_m:.1f} mm are measured"
    elif finest is not None and finest <= plate_m / _SHAPE:
        fine = f"strokes of {1e3 * stroke_m:.1f} mm"
        meaning = f"the rough shape is measured, {fine} are not: their detail will be memory"
    else:
        meaning = "a legible reconstruction will be the network's memory, not a measurement"
    return f"With this wall and noise {patterns} patterns can be told apart, and {bars}: {meaning}."


def artifact_note(setup: Setup, plain: Setup, cut: int, whole: int, level: float) -> str | None:
    """Return a warning where what a setup's model adds to a real wall shows modes that the wall does not have.

    Args:
        setup: The setup.
        plain: The same without that (`Setup.without_artifacts`), e.g. a tPSF without its hard edge.
        cut: Singular values of the setup above `level`.
        whole: The same without the artifact.
        level: Share of the largest singular value.
    """
    if cut <= _EXTRA_MODES * whole:
        return None
    changed = [item.name for item in fields(setup) if getattr(setup, item.name) != getattr(plain, item.name)]
    here, there = (", ".join(f"{name} {getattr(one, name):g}" for name in changed) for one in (setup, plain))
    return (
        f"{setup.wall_description()} with {here}: {cut} singular values lie above {level:g} of the largest, "
        f"{whole} with {there}; {setup.artifact} makes the operator look better conditioned than a wall is"
    )
