"""How far to believe the pictures: what each run said of its own passes, beside what was true."""

from __future__ import annotations

import html

import numpy as np

from evnlos.dataset import character_of
from evnlos.report.gather import RunResult
from evnlos.report.tables import label


def belief_section(results: list[RunResult]) -> str:
    """Return a table: support and skill of each object for each run that has a confidence, or nothing."""
    known = [r for r in results if r.evaluation.worth]
    if not known:
        return ""
    heads = "".join(f"<th colspan=2>{html.escape(label(r))}</th>" for r in known)
    names = "".join("<th>support</th><th>skill</th>" for _ in known)
    rows = []
    for k, name in enumerate(known[0].evaluation.characters()):
        passes = [r.evaluation.worth[k] for r in known]
        cells = "".join(
            f"<td>{f'{one.support:.0%}' if one.measured else 'nothing measured'}</td><td>{one.skill:.0%}</td>"
            for one in passes
        )
        rows.append(f"<tr><td>{html.escape(character_of(name))}</td>{cells}</tr>")
    held = [np.mean([one.coverage for one in r.evaluation.worth]) for r in known]
    wide = [np.mean([one.width for one in r.evaluation.worth]) for r in known]
    held_cells = "".join(f"<td colspan=2>{value:.0%}</td>" for value in held)
    wide_cells = "".join(f"<td colspan=2>{value:.2f}</td>" for value in wide)
    return (
        "<h2>How far to believe them</h2><p class=dim>Support: the share of what tells objects apart that both "
        "halves of the pass agree on, which the network says without knowing the truth. Skill: the share of it "
        "that is right; below 0 the average object would have been nearer. The intervals are to hold 90 % of "
        "the plate's pixels; a length of 1 is from black to white.</p>"
        f"<div class=wide><table><tr><th></th>{heads}</tr><tr><th></th>{names}</tr>{''.join(rows)}"
        f"<tr class=mean><td>pixels in their interval</td>{held_cells}</tr>"
        f"<tr><td>length of the intervals</td>{wide_cells}</tr></table></div>"
    )
