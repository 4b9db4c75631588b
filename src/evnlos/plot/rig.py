"""The set-up of a rig, to scale, seen from above; SVG in the colours of the page that it stands on."""

from __future__ import annotations

import html
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evnlos.setups import Setup

_WIDTH, _HEIGHT, _MARGIN = 620, 400, 46
_LIGHT, _SIGHT = "#c9760b", "#2f7bd6"  # told apart with every common kind of colour blindness
PARTITION = "hides the object (sketch)"
"""What stands beside the line that no rig's settings state."""
_STEPS_M = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)


@dataclass(frozen=True)
class Drawing:
    """An SVG drawing; a notebook shows it as a picture.

    Args:
        svg: The drawing.
    """

    svg: str

    def _repr_svg_(self) -> str:
        return self.svg


def setup_drawing(setup: Setup, travel_m: float = 0.16, plate_m: float = 0.08) -> Drawing | None:
    """Return the setup from above, to scale: wall, object and its way, cameras and their view, what is between.

    Where the setup has no place of the camera, none is drawn. Occluders stand where they are; what hides the
    object from the camera is in no setup, so a dotted line sketches it.

    Args:
        setup: The setup.
        travel_m: Way of the object's middle, metres.
        plate_m: Side of the object's plate, metres.

    Returns:
        The drawing; None for a setup that does not know where its parts are.

    Example:
        >>> from evnlos.setups import load_setup
        >>> setup_drawing(load_setup("main-near")).svg[:4]
        '<svg'
    """
    layout = setup.layout()
    if layout is None:
        return None
    parts, around = [], []  # drawn in metres first: (kind, points, style or words)
    middle, deep = layout.target
    half = (travel_m + plate_m) / 2
    parts.append(
        ("line", [(middle - half, deep), (middle + half, deep)], f"stroke='{_LIGHT}' stroke-dasharray='2 3'")
    )
    parts.append(
        (
            "line",
            [(middle - plate_m / 2, deep), (middle + plate_m / 2, deep)],
            f"stroke='{_LIGHT}' stroke-width='4'",
        )
    )
    parts.append(("text", [(middle, deep)], f"object {100 * plate_m:.3g} cm, way {100 * travel_m:.3g} cm"))
    reach = max(half + abs(middle) + 0.04, 0.2)
    around += [(middle - half, deep), (middle + half, deep)]
    if layout.camera is not None:
        eye = layout.camera
        seen = [(x, 0.0) for x in layout.seen_m or ()]
        reach = max(reach, *(abs(x) + 0.02 for x, _ in seen))
        parts += [("line", [eye, one], f"stroke='{_SIGHT}' stroke-width='1'") for one in seen]
        parts.append(("disc", [eye], f"fill='{_SIGHT}'"))
        parts.append(("text", [eye], f"cameras, {layout.camera_words}"))
        for polygon in layout.occluders:
            corners = np.asarray(polygon)
            parts.append(
                ("line", [tuple(c) for c in (*corners, corners[0])], "stroke='currentColor' stroke-width='3'")
            )
            parts.append(("text", [tuple(corners.mean(axis=0))], "occluder"))
        hidden = _partition(eye, seen, (middle - half, middle + half), deep)
        if hidden is not None:
            dotted = "stroke='currentColor' stroke-width='3' stroke-dasharray='2 4' data-part='partition'"
            parts += [("line", list(hidden), dotted), ("text", [hidden[1]], PARTITION)]
            around += list(hidden)
        if layout.lamp is not None:
            lamp = layout.lamp
            parts += [("disc", [lamp], f"fill='{_LIGHT}'"), ("text", [lamp], "lamp")]
            around.append(lamp)
        parts.append(
            (
                "line",
                [(middle, deep), (0.0, 0.0), eye],
                f"stroke='{_LIGHT}' stroke-width='.8' stroke-dasharray='6 4'",
            )
        )
        around += [eye, *seen]
    parts.append(("line", [(-reach, 0.0), (reach, 0.0)], "stroke='currentColor' stroke-width='5'"))
    around += [(-reach, 0.0), (reach, 0.0)]
    return Drawing(_svg(parts, np.array(around), layout.wall, deep))


def _partition(
    eye: tuple[float, float], seen: list[tuple[float, float]], way: tuple[float, float], deep: float
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return a line that hides the object's whole way from the camera and leaves light and sight free.

    It stands between the object's way and the camera's nearer line of sight, upright on the wall.

    Returns:
        Its ends (x, z), metres, from the object's depth on; None where the camera is no deeper than the object,
        or there is no gap.
    """
    if eye[1] <= deep:
        return None
    side = 1.0 if eye[0] > (way[0] + way[1]) / 2 else -1.0
    near, far = max(way, key=lambda x: side * x), min(way, key=lambda x: side * x)
    share = deep / eye[1]
    sight = min((x + share * (eye[0] - x) for x, _ in seen), key=lambda x: side * x)
    if side * (sight - near) <= 0:
        return None
    x = (near + sight) / 2
    steepest = deep + (x - far) / (eye[0] - far) * (eye[1] - deep)  # where the line to the far end passes
    end = deep + 1.15 * (steepest - deep)
    return (x, deep), (x, end)


def _svg(parts: list, around: NDArray[np.float64], wall: str, deep: float) -> str:
    low, high = around.min(axis=0), around.max(axis=0)
    scale = min(
        (_WIDTH - 2 * _MARGIN) / (high[0] - low[0]), (_HEIGHT - 2 * _MARGIN - 26) / max(high[1] - low[1], 1e-9)
    )

    def place(point: tuple[float, float]) -> tuple[float, float]:
        return _MARGIN + (point[0] - low[0]) * scale, _MARGIN + (point[1] - low[1]) * scale

    drawn = []
    for kind, points, style in parts:
        at = [place(point) for point in points]
        if kind == "line":
            drawn.append(
                f"<polyline points='{' '.join(f'{x:.1f},{y:.1f}' for x, y in at)}' fill='none' {style}/>"
            )
        elif kind == "disc":
            drawn.append(f"<circle cx='{at[0][0]:.1f}' cy='{at[0][1]:.1f}' r='6' {style}/>")
        else:
            x = min(max(at[0][0], 90), _WIDTH - 110)
            drawn.append(_text(x, at[0][1] + 20, style))
    drawn.append(_text(place((0.0, 0.0))[0], _MARGIN - 16, wall))
    x, top, bottom = place((low[0], 0.0))[0] + 12, place((0.0, 0.0))[1] + 4, place((0.0, deep))[1]
    drawn.append(f"<path d='M{x:.1f} {top:.1f}V{bottom:.1f}' stroke='currentColor' stroke-width='.8' />")
    drawn.append(_text(x + 5, (top + bottom) / 2, f"{100 * deep:.3g} cm", "start"))
    step = max((one for one in _STEPS_M if one * scale <= 150), default=_STEPS_M[0])
    left, foot = _MARGIN, _HEIGHT - 14
    drawn.append(f"<path d='M{left} {foot - 4}v4h{step * scale:.1f}v-4' fill='none' stroke='currentColor' />")
    drawn.append(_text(left + step * scale + 8, foot, f"{100 * step:g} cm; seen from above, to scale", "start"))
    return (
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {_WIDTH} {_HEIGHT}' width='{_WIDTH}' role='img' "
        f"aria-label='set-up, to scale' font-family='sans-serif' font-size='12'>{''.join(drawn)}</svg>"
    )


def _text(x: float, y: float, words: str, anchor: str = "middle") -> str:
    return (
        f"<text x='{x:.1f}' y='{y:.1f}' text-anchor='{anchor}' fill='currentColor'>{html.escape(words)}</text>"
    )
