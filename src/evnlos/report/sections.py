"""Sections of a report: what leads, the setup, the summary, confidence, images over time steps.

- What a report leads with: the best, the median and the worst object, and the verdict in words.
- The setup of a report: its drawing to scale, and what it can show at all.
- The figure that a report leads with: what pre-training gains, beside what one scores without looking.
- How far to believe the images: what each run said of its own sequences, beside what was true.
- Images of a report over positions: a strip of each object, animations, and the worst on purpose.
"""

from __future__ import annotations

import html

import numpy as np
import torch

from evnlos.analysis import BASELINES
from evnlos.analysis.identify import GUESSED, Identification, Verdict
from evnlos.analysis.scores import Interval, paired_difference
from evnlos.data import Dataset, character_of, modality_order, read_shard
from evnlos.events.volume import WORDS
from evnlos.plot.setup import PARTITION, setup_drawing
from evnlos.report.pictures import animation, curves_svg, data_uri, grey, png, polarity, stretched, strip
from evnlos.report.tables import METHODS, RunResult, baselines_of, label
from evnlos.setups import Setup

_LOWEST = 1e-3


def folded(summary: str, content: str) -> str:
    """Return HTML behind a line to click on; paper shows it in full.

    Args:
        summary: The line, in plain text.
        content: HTML.
    """
    return f"<details><summary>{html.escape(summary)}</summary>{content}</details>"


def lead_section(results: list[RunResult], limits: Identification | None) -> str:
    """Return what stands below the title: best, median and worst object of the best run, and the verdict.

    Args:
        results: Evaluated runs; the best is that of the highest mean PSNR.
        limits: What `identify` found on the setup; None where it is unknown.
    """
    best = max(results, key=lambda r: float(r.evaluation.scores.psnr_db.mean()))
    found = best.evaluation
    mean = {name: float(found.scores.psnr_db[found.names == name].mean()) for name in found.characters()}
    order = sorted(mean, key=lambda name: -mean[name])
    # Of two objects none is the median.
    chosen = {order[len(order) // 2]: "median", order[-1]: "worst", order[0]: "best"}
    cells = []
    for name, rank in sorted(chosen.items(), key=lambda pair: -mean[pair[0]]):
        there = np.flatnonzero(found.names == name)
        k = there[len(there) // 2]
        pair = data_uri(png(strip([grey(found.truth[k]), grey(found.images[k])], 2)))
        words = html.escape(f"{rank}: {character_of(name)}, {mean[name]:.1f} dB")
        cells.append(
            f"<figure><img class=lead alt='truth and reconstruction, {words}' src='{pair}'>"
            f"<figcaption>{words}</figcaption></figure>"
        )
    lines = "".join(
        f"<p><b>{html.escape(line[:1].upper() + line[1:])}.</b></p>" for line in _said(best, limits)
    )
    return (
        f"<div class=movies>{''.join(cells)}</div><p class=dim>Truth on the left, beside it the image of "
        f"{html.escape(label(best))}, the run with the highest mean PSNR; objects ranked by theirs.</p>{lines}"
    )


def _said(run: RunResult, limits: Identification | None) -> list[str]:
    """Return the verdict on all sequences of a run, in the words of the verdict on one."""
    wall, checks = "" if limits is None else limits.wall, run.evaluation.confidence_checks
    if not checks:
        return Verdict(wall, "this run holds no confidence in its images", GUESSED[None]).lines
    count = sum(one.measured for one in checks)
    recording = f"of {count} of {len(checks)} sequences something was measured"
    if 0 < count < len(checks):
        return Verdict(wall, recording, f"of these, {GUESSED[True]}; of the others, {GUESSED[False]}").lines
    return Verdict(wall, recording, GUESSED[count > 0]).lines


def setup_section(name: str, setup: Setup | None) -> str:
    """Return the section that shows the setup; without one, how to have it shown."""
    warned = () if setup is None else setup.warnings()
    head = "<h2>The setup</h2>" + "".join(f"<p><b>Warning: {html.escape(line)}.</b></p>" for line in warned)
    if setup is None:
        said = "The setup is not known to this page; <code>evnlos report --setup SETUP.yaml</code> draws it."
        return f"{head}<p class=dim>{said}</p>"
    if steps := setup.steps():
        told = "; ".join(
            f"{step} {100 * share:.1f} % ({'kept' if kept else 'left out'})"
            for step, (share, kept) in steps.items()
        )
        head += (
            "<p class=dim>Steps of the wall&#x27;s fit, and what each took away of what was left of captures "
            f"held out, beside their noise: {html.escape(told)}.</p>"
        )
    drawing = setup_drawing(setup)
    if drawing is None:
        words = html.escape(f"{name}: {setup.describe()}")
        return f"{head}<p>{words}. Where its parts stand is not known, so it has no drawing.</p>"
    told = (
        "An object moves around the corner. Its light falls on the relay wall, which scatters it; two cameras "
        "watch the wall and never see the object."
    )
    drawn = drawing.svg
    hides = (
        " What hides the object is not among the settings of the setup: the dotted line is a sketch."
        if PARTITION in drawn
        else " What hides the object is not among the settings of the setup, and is not drawn."
    )
    return (
        f"{head}<p>{told} Setup: {html.escape(name)}.</p><div class=setup>{drawn}</div><p class=dim>{hides}</p>"
    )


def limits_section(found: Identification | None) -> str:
    """Return the section that says what any method can make of one image; nothing without a setup."""
    if found is None:
        return ""
    at = found.at_camera
    spectrum, picard = _points(at.spectrum), _points(at.picard)
    noise = [(1.0, 0.0), (max(x for x, _ in [(2.0, 0.0), *spectrum, *picard]), 0.0)]
    series = {"singular value / noise": spectrum, "a letter's coefficient / noise": picard, "noise": noise}
    pictures = "".join(
        f"<figure><img class=large alt='{words}' src='{data_uri(png(grey(image.numpy())))}'>"
        f"<figcaption>{words}</figcaption></figure>"
        for image, words in ((found.truth, "a typical target"), (at.picture, "best linear image"))
    )
    warned = "".join(f"<p>{html.escape(words)}</p>" for words in found.warnings)
    return (
        "<h2>What this setup can show at all</h2>"
        f"<p><b>{html.escape(found.verdict)}</b></p>{warned}<p class=dim>One image of the wall, the object "
        "at a known place, the setup known exactly; patterns whose value lies above 0 stand above the noise. "
        f"On the target plane itself: best linear image {at.psnr_db:.1f} dB, mean target "
        f"{found.mean_db:.1f} dB, "
        f"all-black {found.zero_db:.1f} dB. What a network draws beyond that it knows from its training.</p>"
        f"<div class=pair>{pictures}</div>{curves_svg(series, 'pattern', 'log10 of value over noise')}"
    )


def _points(values: torch.Tensor) -> list[tuple[float, float]]:
    """Return number and logarithm of each value up to the last one that stands above the lowest drawn."""
    above = np.flatnonzero(values.numpy() > _LOWEST)
    last = int(above[-1]) + 1 if len(above) else 0
    logs = np.log10(np.maximum(values.numpy()[:last], _LOWEST))
    return [(float(k), float(v)) for k, v in enumerate(logs, start=1)]


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


def summary_section(results: list[RunResult]) -> str:
    """Return the first section of the page: bars of mean PSNR, and what EPNP gains over E2E in words."""
    gains = gains_of(results)
    words = "; ".join(f"{kind} {gain} dB" for kind, gain in gains.items())
    said = (
        f"<p><b>EPNP over E2E: {html.escape(words)}</b> (mean, 95 % interval over the objects).</p>"
        if words
        else ""
    )
    lost = "".join(f"<p>{html.escape(line)}</p>" for line in losses_of(results))
    return f"<h2>What is gained</h2>{said}{lost}{_bars(results)}"


def losses_of(results: list[RunResult]) -> list[str]:
    """Return a line for each kind of network that fine-tuning made worse than simulation alone, mean PSNR."""
    found = []
    for kind in _kinds(results):
        mean = {
            method: float(np.mean([r.evaluation.scores.psnr_db for r in runs]))
            for method in ("simulation only", "EPNP")
            if (runs := [r for r in results if (r.method, r.kind) == (method, kind)])
        }
        if len(mean) == 2 and mean["EPNP"] < mean["simulation only"]:
            found.append(
                f"Fine-tuning harmed {kind}: {mean['simulation only']:.2f} dB with simulation only, "
                f"{mean['EPNP']:.2f} dB after it. Use the weights from before, or fewer epochs."
            )
    return found


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


def belief_section(results: list[RunResult]) -> str:
    """Return a table: support and skill of each object for each run that has a confidence, or nothing."""
    known = [r for r in results if r.evaluation.confidence_checks]
    if not known:
        return ""
    heads = "".join(f"<th colspan=2>{html.escape(label(r))}</th>" for r in known)
    names = "".join("<th>support</th><th>skill</th>" for _ in known)
    rows = []
    for k, name in enumerate(known[0].evaluation.characters()):
        sequences = [r.evaluation.confidence_checks[k] for r in known]
        cells = "".join(
            f"<td>{f'{one.support:.0%}' if one.measured else 'nothing measured'}</td><td>{one.skill:.0%}</td>"
            for one in sequences
        )
        rows.append(f"<tr><td>{html.escape(character_of(name))}</td>{cells}</tr>")
    held = [np.mean([one.coverage for one in r.evaluation.confidence_checks]) for r in known]
    wide = [np.mean([one.width for one in r.evaluation.confidence_checks]) for r in known]
    held_cells = "".join(f"<td colspan=2>{value:.0%}</td>" for value in held)
    wide_cells = "".join(f"<td colspan=2>{value:.2f}</td>" for value in wide)
    table = (
        f"<div class=wide><table><tr><th></th>{heads}</tr><tr><th></th>{names}</tr>{''.join(rows)}"
        f"<tr class=mean><td>pixels in their interval</td>{held_cells}</tr>"
        f"<tr><td>length of the intervals</td>{wide_cells}</tr></table></div>"
    )
    return (
        "<h2>How far to believe them</h2><p class=dim>Support: the share of what distinguishes objects that "
        "both halves of the sequence agree on, which the network says without knowing the truth. Skill: the share "
        "of it "
        "that is right; below 0 the average object would have been nearer. The intervals are to hold 90 % of "
        "the target plane's pixels; a length of 1 is from black to white.</p>"
        + folded("Table of support and skill", table)
    )


MOST_OBJECTS = 8
"""Objects whose strips are shown; a page is to be mailed."""
MOST_MOVING = 4
"""Objects that move."""
_POSITIONS = 10
_WORST = 6
_RATE_HZ = 8.0


def strips_section(results: list[RunResult]) -> str:
    """Return strips: for each object truth and every run's image at up to ten positions, evenly spread."""
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
        + folded("Film strips", f"<div class=strips>{''.join(rows)}</div>")
    )


def animations_section(dataset: Dataset, results: list[RunResult]) -> str:
    """Return animations: wall frame, events, truth and the image of the best run, for a few objects."""
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
        words = f"wall, events, truth and image of {name}, moving"
        cells.append(
            f"<figure><img class=moving alt='{html.escape(words)}' src='{moving}'>"
            f"<figcaption>{html.escape(name)}</figcaption></figure>"
        )
    return (
        f"<h2>Moving</h2><p class=dim>Wall frame, events as time surface ({WORDS}), truth, and the "
        f"image of {html.escape(label(best))}, the run with the highest mean PSNR. Print shows the first "
        "position.</p>"
        f"<div class=movies>{''.join(cells)}</div>"
    )


def failures_section(results: list[RunResult]) -> str:
    """Return the worst images of each run: those that gain least over the mean image, or lose most."""
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
                f"<figure><img class=worst alt='truth above, image below: {html.escape(words)}' src='{pair}'>"
                f"<figcaption>{html.escape(words)}</figcaption></figure>"
            )
        lost = float(np.mean(gain < 0))
        blocks.append(
            f"<h3>{html.escape(label(r))}: {lost:.0%} of its images are worse than the mean image</h3>"
            f"<div class=movies>{''.join(cells)}</div>"
        )
    return (
        "<h2>Where it fails</h2><p class=dim>The worst images of each run, by number, no more than two of an "
        "object where there are enough: truth above, image below, PSNR and in brackets the difference to the "
        "mean training image, dB.</p>" + "".join(blocks)
    )


def _worst(gain: np.ndarray, names: np.ndarray) -> list[int]:
    """Return the samples that gain least, spread over the objects: one object's would look the same."""
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
