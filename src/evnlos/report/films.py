"""Pictures of a report over positions: a strip of each object, animations, and the worst on purpose."""

from __future__ import annotations

import html

import numpy as np

from evnlos.dataset import Dataset, read_shard
from evnlos.events.colours import WORDS
from evnlos.report.gather import RunResult
from evnlos.report.pictures import animation, data_uri, grey, png, polarity, stretched, strip
from evnlos.report.tables import label

MOST_OBJECTS = 8
"""Objects whose strips are shown; a page is to be mailed."""
MOST_MOVING = 4
"""Objects that move."""
_POSITIONS = 10
_WORST = 6
_RATE_HZ = 8.0


def strips_section(results: list[RunResult]) -> str:
    """Return strips: for each object truth and every run's picture at up to ten positions, evenly spread."""
    first = results[0].evaluation
    rows = []
    for name in first.characters()[:MOST_OBJECTS]:
        chosen = _spread(np.flatnonzero(first.names == name))
        shown = [("truth", first.truth), *((label(r), r.evaluation.images) for r in results)]
        for words, images in shown:
            title = html.escape(f"{name}: {words}")
            picture = data_uri(png(strip([grey(images[k]) for k in chosen], _POSITIONS)))
            rows.append(f"<div>{title}</div><div><img alt='{title}' src='{picture}'></div>")
    left = len(first.characters()) - MOST_OBJECTS
    more = f" {left} further objects are left out." if left > 0 else ""
    return (
        f"<h2>Position by position</h2><p class=dim>From left to right while the object passes.{more}</p>"
        f"<div class=strips>{''.join(rows)}</div>"
    )


def animations_section(dataset: Dataset, results: list[RunResult]) -> str:
    """Return animations: wall frame, events, truth and the picture of the best run, for a few objects."""
    best = max(results, key=lambda r: float(r.evaluation.scores.psnr_db.mean()))
    found = best.evaluation
    cells = []
    for name in found.characters()[:MOST_MOVING]:
        samples, _ = read_shard(dataset.shard(name))
        pictures = []
        for k, at in enumerate(np.flatnonzero(found.names == name)):
            four = [stretched(samples.frame[k]), polarity(samples.surface[k])]
            scored = dataset.sampling.scored
            four = [picture[scored] for picture in four] + [grey(found.truth[at]), grey(found.images[at])]
            pictures.append(strip(four, 4))
        moving = data_uri(animation(pictures, _RATE_HZ, webp=True), "image/webp")
        words = f"wall, events, truth and picture of {name}, moving"
        cells.append(
            f"<figure><img class=moving alt='{html.escape(words)}' src='{moving}'>"
            f"<figcaption>{html.escape(name)}</figcaption></figure>"
        )
    return (
        f"<h2>Moving</h2><p class=dim>Wall frame, events as time surface ({WORDS}), truth, and the "
        f"picture of {html.escape(label(best))}, the run with the highest mean PSNR. Print shows the first "
        "position.</p>"
        f"<div class=movies>{''.join(cells)}</div>"
    )


def failures_section(results: list[RunResult]) -> str:
    """Return the worst pictures of each run: those that gain least over the mean picture, or lose most."""
    blocks = []
    for r in results:
        found = r.evaluation
        blank = found.baselines.get("mean", found.baselines["zero"])
        gain = found.scores.psnr_db - blank.psnr_db
        cells = []
        for k in _worst(gain, found.names):
            name = str(found.names[k])
            position = int(np.flatnonzero(found.names == name).searchsorted(k))
            pair = data_uri(png(strip([grey(found.truth[k]), grey(found.images[k])], 1)))
            words = f"{name}, position {position}: {found.scores.psnr_db[k]:.1f} dB ({gain[k]:+.1f})"
            cells.append(
                f"<figure><img class=worst alt='truth above, picture below: {html.escape(words)}' src='{pair}'>"
                f"<figcaption>{html.escape(words)}</figcaption></figure>"
            )
        lost = float(np.mean(gain < 0))
        blocks.append(
            f"<h3>{html.escape(label(r))}: {lost:.0%} of its pictures are worse than the mean picture</h3>"
            f"<div class=movies>{''.join(cells)}</div>"
        )
    return (
        "<h2>Where it fails</h2><p class=dim>The worst pictures of each run, by number, no more than two of an "
        "object where there are enough: truth above, picture below, PSNR and in brackets the difference to the "
        "mean training picture, dB.</p>" + "".join(blocks)
    )


def _worst(gain: np.ndarray, names: np.ndarray) -> list[int]:
    """Return the samples that gain least, spread over the objects: a whole pass would be the same picture."""
    each = max(2, -(-_WORST // len(np.unique(names))))
    taken: list[int] = []
    for k in np.argsort(gain, kind="stable"):
        if len(taken) < _WORST and np.sum(names[taken] == names[k]) < each:
            taken.append(int(k))
    return taken


def _spread(indices: np.ndarray) -> np.ndarray:
    """Return up to ten of the indices, evenly spread, both ends among them."""
    return indices[
        np.unique(np.linspace(0, len(indices) - 1, min(_POSITIONS, len(indices))).round().astype(int))
    ]
