"""Curves as inline SVG: small, printable, with no requests."""

from __future__ import annotations

import html
import math

_COLOURS = ("#0b5fa5", "#b23a12", "#2f7d32", "#7a3fa0", "#8a6d00", "#00788a", "#a02c5d", "#5b6470", "#3d4fc4")
_WIDTH, _HEIGHT, _LEFT, _TOP, _BOTTOM = 980, 300, 60, 16, 40
_PEN, _LETTER = 44, 7.0  # room for a line of the legend, and for each letter of its name


def curves_svg(series: dict[str, list[tuple[float, float]]], x_label: str, y_label: str) -> str:
    """Return named curves of (x, y) points as one SVG drawing with axes and legend; empty ones are left out."""
    series = {name: points for name, points in series.items() if points}
    if not series:
        return ""
    xs = [x for points in series.values() for x, _ in points]
    ys = [y for points in series.values() for _, y in points]
    x0, x1 = min(xs), max(max(xs), min(xs) + 1)
    low, high = min(ys), max(ys)
    if high - low <= 1e-6 * max(abs(low), abs(high), 1.0):  # a run of one epoch
        low, high = low - 0.5, high + 0.5
    ticks = _ticks(low, high)
    y0, y1 = min(ticks[0], low), max(ticks[-1], high)
    wide, high = _WIDTH - _LEFT - _PEN - _LETTER * max(map(len, series)), _HEIGHT - _TOP - _BOTTOM

    def place(x: float, y: float) -> tuple[float, float]:
        return _LEFT + (x - x0) / (x1 - x0) * wide, _TOP + (y1 - y) / (y1 - y0) * high

    parts = [
        f"<svg viewBox='0 0 {_WIDTH} {_HEIGHT}' role=img aria-label='{html.escape(y_label)}' font-size=12>"
    ]
    for tick in ticks:
        y = place(x0, tick)[1]
        parts.append(f"<path d='M{_LEFT} {y:.1f}H{_LEFT + wide:.1f}' stroke='currentColor' opacity='.15'/>")
        parts.append(f"<text x={_LEFT - 6} y={y + 4:.1f} text-anchor=end fill=currentColor>{tick:g}</text>")
    for tick in _ticks(x0, x1):
        if x0 <= tick <= x1:
            x = place(tick, y0)[0]
            parts.append(
                f"<text x={x:.1f} y={_TOP + high + 16} text-anchor=middle fill=currentColor>{tick:g}</text>"
            )
    below = f"x={_LEFT + wide:.1f} y={_HEIGHT - 6} text-anchor=end"
    parts.append(f"<text {below} fill=currentColor>{html.escape(x_label)}</text>")
    parts.append(f"<text x={_LEFT} y=11 fill=currentColor>{html.escape(y_label)}</text>")
    for i, (name, points) in enumerate(series.items()):
        colour, dash = _COLOURS[i % len(_COLOURS)], ("", "6 3", "2 3")[i // 3 % 3]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(*p) for p in points))
        pen = f"stroke='{colour}' stroke-width=1.8 stroke-dasharray='{dash}'"
        parts.append(f"<polyline points='{path}' fill=none {pen}/>")
        y = _TOP + 14 + 17 * i
        parts.append(f"<path d='M{_LEFT + wide + 12:.1f} {y - 4}h22' {pen}/>")
        parts.append(f"<text x={_LEFT + wide + 40:.1f} y={y} fill=currentColor>{html.escape(name)}</text>")
    return "".join(parts) + "</svg>"


def _ticks(low: float, high: float) -> list[float]:
    """Return about five round numbers that span the range."""
    span = max(high - low, 1e-9)
    step = 10 ** math.floor(math.log10(span / 4))
    step *= next(f for f in (1, 2, 5, 10) if span / (step * f) <= 5)
    return [round(k * step, 10) for k in range(math.floor(low / step), math.ceil(high / step) + 1)]
