"""The table in the shape of the paper's: objects x (near, far) x modality x (E2E, EPNP), as rows and as CSV."""

from __future__ import annotations

import csv
import io

import numpy as np

from evnlos.dataset import character_of
from evnlos.evaluation import BASELINES, Scores
from evnlos.report.gather import RunResult

METRICS = {
    "psnr_db": ("PSNR", "dB", 2),
    "psnr_box_db": ("PSNR in the box", "dB", 2),
    "ssim": ("SSIM", "", 3),
    "ms_ssim": ("MS-SSIM", "", 3),
    "haarpsi": ("HaarPSI", "", 3),
    "gmsd": ("GMSD", "", 3),
}
_SMALLER_IS_BETTER = ("gmsd", "lpips")


def columns_of(results: list[RunResult]) -> list[str]:
    """Return the headings of the table: baselines, then a column for each run."""
    baselines = list(baselines_of(results))
    return [*(BASELINES[name] for name in baselines), *(label(r) for r in results)]


def baselines_of(results: list[RunResult]) -> dict[str, Scores]:
    """Return the baselines of the last run: its mean picture is that of captures, where any run saw some."""
    return results[-1].evaluation.baselines


def label(result: RunResult) -> str:
    """Return the heading of a run's column."""
    return f"{result.method} {result.kind}"


def rows_of(results: list[RunResult], metric: str) -> list[tuple[str, str, list[float | None]]]:
    """Return (group, character, values) for each object, then the mean of each group and of all.

    The group is the object's name before its last underscore, e.g. `near` of `near_G`.
    """
    first = results[0].evaluation
    tables = [*baselines_of(results).values(), *(r.evaluation.scores for r in results)]
    rows = []
    groups: dict[str, list[str]] = {}
    for name in first.characters():
        groups.setdefault(_group(name), []).append(name)
    for group, names in groups.items():
        rows += [
            (group, character_of(name), [t.mean(first.names == name)[metric] for t in tables]) for name in names
        ]
        chosen = np.isin(first.names, names)
        rows.append((group, "mean", [t.mean(chosen)[metric] for t in tables]))
    if len(groups) > 1:
        rows.append(("all", "mean", [t.mean()[metric] for t in tables]))
    return rows


def available_metrics(results: list[RunResult]) -> dict[str, tuple[str, str, int]]:
    """Return the metrics that every run has: name -> (title, unit, decimals)."""
    every = METRICS | {"lpips": ("LPIPS (VGG)", "", 3)}
    scores = [r.evaluation.scores for r in results]
    return {name: about for name, about in every.items() if all(getattr(s, name) is not None for s in scores)}


def to_csv(results: list[RunResult]) -> str:
    """Return all metrics of all objects as CSV: metric, group, character, one column a method."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["metric", "group", "character", *columns_of(results)])
    for metric in available_metrics(results):
        for group, character, values in rows_of(results, metric):
            writer.writerow([metric, group, character, *values])
    return buffer.getvalue()


def to_text(results: list[RunResult], metric: str = "psnr_db") -> str:
    """Return one metric's table as aligned text for a terminal."""
    decimals = METRICS[metric][2]
    body: list[list[str]] = [["", *columns_of(results)]]
    for group, character, values in rows_of(results, metric):
        body.append([f"{group} {character}", *("-" if v is None else f"{v:.{decimals}f}" for v in values)])
    widths = [max(len(row[i]) for row in body) for i in range(len(body[0]))]
    return "\n".join("  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)) for row in body)


def larger_is_better(metric: str) -> bool:
    """Return whether a larger value of the metric is the better one."""
    return metric not in _SMALLER_IS_BETTER


def best_two(values: list[float | None], skip: int) -> tuple[int | None, int | None]:
    """Return the positions of the largest and second largest value behind the first `skip` ones."""
    ranked = [(v, i) for i, v in enumerate(values) if v is not None and i >= skip]
    order = [i for _, i in sorted(ranked, key=lambda pair: -pair[0])]
    return (order[0] if order else None), (order[1] if len(order) > 1 else None)


def _group(name: str) -> str:
    return name.rsplit("_", 1)[0] if "_" in name else "all"
