"""The figure that a report leads with: what pre-training gains, beside what one scores without looking."""

from __future__ import annotations

import html

import numpy as np

from evnlos.dataset import modality_order
from evnlos.evaluation import BASELINES
from evnlos.evaluation.intervals import Interval, paired_difference
from evnlos.report.gather import METHODS, RunResult
from evnlos.report.tables import baselines_of

_COLOURS = {"simulation only": "#8a93a0", "E2E": "#b8862b", "EPNP": "#0b5fa5"}
_WIDTH, _LEFT, _RIGHT, _BAR, _GAP, _GROUP = 760, 150, 60, 17, 3, 16


def gains_of(results: list[RunResult]) -> dict[str, Interval]:
    """Return for each kind of network PSNR of EPNP minus E2E, dB, with a 95 % interval over the objects.

    A kind is what a network sees: a modality, time step by time step or whole sequences. Runs of one method
    and kind (seeds) are averaged.
    """
    found = {}
    for kind in _kinds(results):
        stacks = {
            method: [r.evaluation.scores.psnr_db for r in results if (r.method, r.kind) == (method, kind)]
            for method in ("EPNP", "E2E")
        }
        if stacks["EPNP"] and stacks["E2E"]:
            found[kind] = paired_difference(
                np.stack(stacks["EPNP"]), np.stack(stacks["E2E"]), results[0].evaluation.names
            )
    return found


def lead(results: list[RunResult]) -> str:
    """Return the first section of the page: bars of mean PSNR, and what EPNP gains over E2E in words."""
    gains = gains_of(results)
    words = "; ".join(f"{kind} {gain} dB" for kind, gain in gains.items())
    said = (
        f"<p><b>EPNP over E2E: {html.escape(words)}</b> (mean, 95 % interval over the objects).</p>"
        if words
        else ""
    )
    return f"<h2>What is gained</h2>{said}{_bars(results)}"


def _kinds(results: list[RunResult]) -> list[str]:
    """Return the kinds of network that there are, single positions first."""
    order = sorted(results, key=lambda r: (r.sees_sequence, modality_order(r.modality)))
    return list(dict.fromkeys(r.kind for r in order))


def _bars(results: list[RunResult]) -> str:
    """Return mean PSNR of each method and kind of network as bars; baselines are upright lines."""
    means: dict[tuple[str, str], float] = {}
    for kind in _kinds(results):
        for method in METHODS:
            values = [
                r.evaluation.scores.psnr_db.mean() for r in results if (r.method, r.kind) == (method, kind)
            ]
            if values:
                means[kind, method] = float(np.mean(values))
    blanks = {name: float(scores.psnr_db.mean()) for name, scores in baselines_of(results).items()}
    low = np.floor(min([*means.values(), *blanks.values()]) - 1)
    high = np.ceil(max([*means.values(), *blanks.values()]) + 0.5)

    def x(value: float) -> float:
        return _LEFT + (value - low) / (high - low) * (_WIDTH - _LEFT - _RIGHT)

    parts, y = [], 12.0 * len(blanks) + 10  # each baseline has a line for its name
    for kind in _kinds(results):
        shown = [method for method in METHODS if (kind, method) in means]
        for method in shown:
            value = means[kind, method]
            parts.append(
                _text(_LEFT - 8, y + 13, "end", f"{method} {kind}")
                + f"<rect x={x(low):.1f} y={y} width={x(value) - x(low):.1f} height={_BAR} "
                f"fill='{_COLOURS[method]}'/>" + _text(x(value) + 5, y + 13, "start", f"{value:.2f}")
            )
            y += _BAR + _GAP
        y += _GROUP if shown else 0
    # From left to right, each name right of its line and below the one before: no line crosses a name.
    for k, (name, value) in enumerate(sorted(blanks.items(), key=lambda pair: pair[1])):
        line = f"M{x(value):.1f} {12 * k + 3}V{y - _GROUP:.1f}"
        parts.append(
            f"<path d='{line}' stroke=currentColor stroke-dasharray='3 3'/>"
            + _text(x(value) + 4, 12 * k + 12, "start", f"{BASELINES[name]} {value:.1f}")
        )
    parts.append(_text(_WIDTH - 4, y + 8, "end", f"mean PSNR, dB; from {low:g} dB"))
    box = f"viewBox='0 0 {_WIDTH} {y + 14:.0f}'"
    label = "mean PSNR of each method beside the baselines"
    return f"<svg {box} role=img aria-label='{label}' font-size=12>{''.join(parts)}</svg>"


def _text(x: float, y: float, anchor: str, words: str) -> str:
    return f"<text x={x:.1f} y={y:g} text-anchor={anchor} fill=currentColor>{html.escape(words)}</text>"
