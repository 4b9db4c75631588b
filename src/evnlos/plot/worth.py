"""Can the confidence be trusted? What is left when the least supported passes go, and support against skill."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evnlos.plot.figure import new_figure, save_figure

if TYPE_CHECKING:
    from evnlos.evaluation.worth import PassWorth

_LEAST_SKILL = -1.2  # worse passes are drawn on this line


def draw_worth(found: Mapping[str, Sequence[PassWorth]], path: str | Path) -> Path:
    """Draw the risk-coverage curves of all passes, and each pass's skill over its support.

    Args:
        found: The passes by the name of their set.
        path: The picture, PNG or SVG.

    Returns:
        The path.

    Raises:
        MissingDependencyError: Matplotlib is not installed.
    """
    from evnlos.evaluation.worth import risk_coverage

    figure = new_figure((10.5, 4.4))
    curves, cloud = figure.subplots(1, 2)
    passes = [one for those in found.values() for one in those]
    skill, support = (np.array([getattr(one, key) for one in passes]) for key in ("skill", "support"))
    for order, name, line in (
        (support, "the most supported first", "-"),
        (skill, "the best first (not known to a user)", "--"),
    ):
        kept, risk = risk_coverage(order, 1 - skill)
        curves.plot(100 * kept, risk, line, label=name, lw=1.6)
    curves.axhline(float(np.mean(1 - skill)), color="0.5", lw=1.0, ls=":", label="all passes")
    curves.set(xlabel="passes kept, %", ylabel="mean risk of what is kept (1 - skill)", ylim=(0, None))
    curves.legend(frameon=False, fontsize=8)
    marks = "osD^v<>PX*ph"
    for number, (name, those) in enumerate(found.items()):
        cloud.plot(
            [one.support for one in those],
            [max(one.skill, _LEAST_SKILL) for one in those],
            marks[number % len(marks)],
            ms=5,
            alpha=0.75,
            label=name,
            color=f"C{number % 10}",
        )
    cloud.axline((0, 0), (1, 1), color="0.5", lw=1.0, ls=":")
    cloud.set(xlabel="support: what was said", ylabel=f"skill: what was true ({_LEAST_SKILL} or less below)")
    cloud.set(xlim=(-0.03, 1.03), ylim=(_LEAST_SKILL - 0.1, 1.05))
    cloud.legend(frameon=False, fontsize=7, loc="lower right")
    return save_figure(figure, path, dpi=100)
