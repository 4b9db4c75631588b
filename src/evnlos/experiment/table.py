"""Records as tables: arms beside the baselines, seeds averaged, with intervals over the characters."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from evnlos.dataset import character_of, modality_order
from evnlos.errors import DataError
from evnlos.evaluation import BASELINES
from evnlos.evaluation.intervals import Interval, paired_difference
from evnlos.experiment.study import Record

_PLACES = {"psnr_db": 2, "psnr_box_db": 2}


def means_of(records: list[Record], metric: str = "psnr_db") -> dict[tuple[str, str], list[float]]:
    """Return (arm, modality) -> the mean over all characters of each seed; ensembles stand by themselves."""
    found: dict[tuple[str, str], list[float]] = defaultdict(list)
    for record in records:
        name = record.arm if record.seed >= 0 else f"{record.arm}, ensemble"
        found[name, record.modality].append(float(np.mean(list(record.scores[metric].values()))))
    return dict(found)


def difference(records: list[Record], arm: str, other: str, modality: str) -> Interval:
    """Return PSNR of an arm minus that of another, dB, seeds averaged, with an interval over characters.

    Raises:
        DataError: One of the arms has no record.
    """
    stacks, objects = [], None
    for name in (arm, other):
        chosen = [r for r in records if r.arm == name and r.modality == modality and r.seed >= 0]
        if not chosen:
            raise DataError(f"no record of {name!r} on {modality}; run the experiment first")
        objects = [key for key, values in chosen[0].positions.items() for _ in values]
        stacks.append([np.concatenate(list(record.positions.values())) for record in chosen])
    assert objects is not None
    return paired_difference(stacks[0], stacks[1], objects)


def summary_table(records: list[Record], metric: str = "psnr_db") -> str:
    """Return Markdown: a row an arm, a column a modality; mean over characters and seeds, +- over the seeds."""
    means = means_of(records, metric)
    modalities = sorted({key[1] for key in means}, key=modality_order)
    digits = _PLACES.get(metric, 3)
    lines = [f"| {metric} | {' | '.join(modalities)} |", "|---|" + "---|" * len(modalities)]
    for name, title in BASELINES.items():
        cells = []
        for modality in modalities:
            values = [
                r.baselines[name][metric] for r in records if r.modality == modality and name in r.baselines
            ]
            cells.append(
                f"{np.mean([np.mean(list(v.values())) for v in values[-1:]]):.{digits}f}" if values else ""
            )
        lines.append(f"| {title} | {' | '.join(cells)} |")
    for arm in dict.fromkeys(key[0] for key in means):
        cells = [_cell(means.get((arm, modality)), digits) for modality in modalities]
        lines.append(f"| {arm} | {' | '.join(cells)} |")
    return "\n".join(lines)


def character_table(records: list[Record], arms: tuple[str, ...], metric: str = "psnr_db") -> str:
    """Return Markdown in the paper's layout: a row a character, a column for each arm and modality."""
    chosen = [r for r in records if r.arm in arms and r.seed >= 0]
    seen = sorted({r.modality for r in chosen}, key=modality_order)
    columns = [(a, p) for a in arms for p in seen if any(r.arm == a and r.modality == p for r in chosen)]
    digits = _PLACES.get(metric, 3)
    lines = [
        f"| {metric} | {' | '.join(f'{arm} {modality}' for arm, modality in columns)} |",
        "|---|" + "---|" * len(columns),
    ]
    for name in dict.fromkeys(name for record in chosen for name in record.scores[metric]):
        values = [
            np.mean([r.scores[metric][name] for r in chosen if (r.arm, r.modality) == column])
            for column in columns
        ]
        best = max(values)
        cells = [f"**{v:.{digits}f}**" if v == best else f"{v:.{digits}f}" for v in values]
        lines.append(f"| {character_of(name)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def gain_table(records: list[Record], arm: str = "EPNP", other: str = "E2E") -> str:
    """Return Markdown: what an arm gains over the strongest of others, dB with a 95 % interval over characters.

    Args:
        records: Records of a study.
        arm: Name of the arm.
        other: How the names of the others begin; of several, each modality has its strongest.
    """
    means = means_of([r for r in records if r.seed >= 0])
    modalities = sorted({r.modality for r in records if r.arm == arm}, key=modality_order)
    lines = [f"| {arm} - strongest {other} | which | dB, 95 % interval |", "|---|---|---|"]
    for modality in modalities:
        others = [name for name, seen in means if seen == modality and name.startswith(other)]
        if others:
            best = max(others, key=lambda name: float(np.mean(means[name, modality])))
            lines.append(f"| {modality} | {best} | {difference(records, arm, best, modality)} |")
    return "\n".join(lines)


def checks_table(records: list[Record]) -> str:
    """Return Markdown: shares of pictures that the independent reader names rightly, and that are no memory."""
    found: dict[tuple[str, str], list[dict[str, float]]] = defaultdict(list)
    for record in records:
        name = record.arm if record.seed >= 0 else f"{record.arm}, ensemble"
        found[name, record.modality].append(record.checks)
    lines = [
        "| | read rightly | of the true pictures | nearer to the truth than to any shot |",
        "|---|---|---|---|",
    ]
    for (arm, modality), checks in found.items():
        cells = []
        for key in ("read", "read_truth", "nearer_to_truth"):
            values = [c[key] for c in checks if key in c]
            cells.append(f"{100 * np.mean(values):.0f} %" if values else "")
        lines.append(f"| {arm} {modality} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(values: list[float] | None, digits: int) -> str:
    if not values:
        return ""
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    return f"{np.mean(values):.{digits}f} +- {np.std(values, ddof=1):.{digits}f}"
