"""What the figures of a rig mean, in words."""

from __future__ import annotations

from evnlos.transport import PaperTransport

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


def truncation_note(transport: PaperTransport, cut: int, whole: int, level: float) -> str | None:
    """Return a warning where the edge of the tPSF's disc shows modes that the wall does not have.

    Args:
        transport: The transport, with its hard or tapered edge.
        cut: Singular values above `level` with that edge.
        whole: The same for the kernel carried on and faded out.
        level: Share of the largest singular value.
    """
    if cut <= _EXTRA_MODES * whole:
        return None
    edge = f"the tPSF ends at rho = {transport.rho_max:g} with taper {transport.taper:g}"
    wide = f"carried on to rho = {4 * transport.rho_max:g} and faded out"
    return (
        f"{edge}: {cut} singular values lie above {level:g} of the largest, {whole} with the kernel {wide}; "
        "the kink at the edge makes the operator look better conditioned than a wall is (raise taper towards 1)"
    )
