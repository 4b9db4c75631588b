"""The report: one self-contained HTML page with its glossary.

- The words of a report for readers from elsewhere: explained at its end, linked where they first stand.
- The report: one self-contained HTML page, with no requests to anywhere.
- The page of a scene: its pictures, what of them is right, and the commands that made them.
"""

from __future__ import annotations

import html
import mimetypes
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from evnlos.analysis import CHECKS
from evnlos.analysis.identify import Identification
from evnlos.data import Dataset, character_of, read_shard
from evnlos.events.volume import WORDS
from evnlos.files import write_atomically
from evnlos.registry import __version__
from evnlos.report.pictures import curves_svg, data_uri, grey, png, polarity, stretched
from evnlos.report.provenance import provenance_section
from evnlos.report.sections import (
    animations_section,
    belief_section,
    failures_section,
    folded,
    lead_section,
    limits_section,
    setup_section,
    strips_section,
    summary_section,
)
from evnlos.report.tables import (
    RunResult,
    available_metrics,
    baselines_of,
    best_two,
    columns_of,
    label,
    larger_is_better,
    rows_of,
    to_csv,
)
from evnlos.setups import NamedSetup

_EMBEDDED_BYTES = 4_000_000  # larger images stay beside the page of a scene

GLOSSARY = {
    "epnp": (
        "EPNP",
        "the paper's training: first on simulation, then fine-tuned on a few real captures. Short for "
        "Event-enhanced Passive Non-line-of-sight imaging with Physical embedding.",
    ),
    "e2e": ("E2E", "end to end: trained on the real captures alone, from random weights."),
    "simulation": ("simulation only", "trained on simulation, and never shown a real capture."),
    "frame": ("frame", "the network sees images of the wall, as an ordinary camera takes them."),
    "event": (
        "event",
        "the network sees what an event camera sends: each of its pixels reports when its light has grown or "
        "fallen by a set share. It comes as a time surface, a map of how lately each pixel last reported.",
    ),
    "fusion": ("fusion", "the network sees both, frames and events, and joins them."),
    "sequence": (
        "sequence",
        "the network sees all time steps of one sequence of the object together and draws the object once; "
        "without "
        "the word it sees a single time step. The motion of the object must be known.",
    ),
    "psnr_db": (
        "PSNR",
        "peak signal-to-noise ratio, in dB: how small the mean squared error is beside full white. 10 dB more "
        "are a tenth of the error. Mostly black images score high even where nothing is seen.",
    ),
    "psnr_box_db": (
        "PSNR in the box",
        "PSNR on the smallest box that holds the true object, grown by 2 pixels, without the black around it.",
    ),
    "ssim": (
        "SSIM",
        "structural similarity: compares brightness, contrast and structure in small windows; 1 is the same.",
    ),
    "ms_ssim": (
        "MS-SSIM",
        "SSIM at several scales, from fine detail to coarse shape; 1 is the same.",
    ),
    "haarpsi": (
        "HaarPSI",
        "compares edges at several scales by Haar wavelets, close to how people judge; 1 is the same.",
    ),
    "gmsd": (
        "GMSD",
        "gradient magnitude similarity deviation: how unevenly edges are kept. Lower is better; 0 is the same.",
    ),
    "lpips": (
        "LPIPS",
        "how far apart a network for photographs finds the two images. Lower is better; 0 is the same.",
    ),
}


class Glossary:
    """Words of one page; each is linked where it is first asked for, and explained once at the end."""

    def __init__(self) -> None:
        self._linked: set[str] = set()

    def link(self, key: str, words: str | None = None) -> str:
        """Return a word as HTML: a link to its explanation the first time, afterwards the word alone.

        Args:
            key: Which word; one that is not explained stays as it is.
            words: How it is written here; None: as in the glossary.
        """
        shown = html.escape(words or GLOSSARY.get(key, (key, ""))[0])
        if key in self._linked or key not in GLOSSARY:
            return shown
        self._linked.add(key)
        return f"<a href='#word-{key}'>{shown}</a>"

    def label(self, words: str) -> str:
        """Return a run's heading, such as "EPNP sequence frame", with each word linked at its first use."""
        rest = words.replace("simulation only", "simulation", 1).split(" ")
        long = {"simulation": "simulation only"}
        return " ".join(self.link(one.lower(), long.get(one, one)) for one in rest)

    def section(self, metrics: list[str]) -> str:
        """Return the explanations: of the kinds of networks and trainings, and of the metrics shown."""
        other = [key for key in _METRIC_KEYS if key not in metrics]
        rows = "".join(
            f"<dt id='word-{key}'>{html.escape(word)}</dt><dd>{html.escape(said)}</dd>"
            for key, (word, said) in GLOSSARY.items()
            if key not in other
        )
        return f"<h2>Words</h2><dl>{rows}</dl>"


_METRIC_KEYS = ("psnr_db", "psnr_box_db", "ssim", "ms_ssim", "haarpsi", "gmsd", "lpips")


_STYLE = Path(__file__).parent / "style.css"


def page_head(title: str) -> str:
    """Return what a page begins with: its title, and its style."""
    style = _STYLE.read_text(encoding="utf-8")
    return (
        "<!doctype html><html lang=en><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width,initial-scale=1'>"
        f"<title>{html.escape(title)}</title><style>{style}</style>"
    )


def write_report(
    path: str | Path,
    dataset: Dataset,
    results: list[RunResult],
    notes: list[str],
    split: str = "test",
    setup: NamedSetup | None = None,
    limits: Identification | None = None,
) -> Path:
    """Write the report and, beside it, its numbers as CSV.

    Args:
        path: The page, e.g. `report.html`; the table goes to the same name with `.csv`.
        dataset: What the runs were evaluated on.
        results: Evaluated runs; all on the same split.
        notes: Sentences that a reader must know, e.g. that the captures are rendered.
        split: Name of the split.
        setup: The setup of the recordings, to be drawn; None where it is unknown.
        limits: What `identify` found on the setup.

    Returns:
        The path of the page.
    """
    path = Path(path)
    words, metrics = Glossary(), available_metrics(results)
    content = "\n".join(
        [
            page_head("evnlos report"),
            "<h1>Around the corner: reconstructions of hidden moving objects</h1>",
            lead_section(results, limits),
            _head(dataset, results, notes, split, words),
            setup_section(setup.name if setup else "", setup.setup if setup else None),
            summary_section(results),
            *(_table(results, metric, *about, words) for metric, about in metrics.items()),
            _checks(results),
            belief_section(results),
            _pictures(dataset, results),
            animations_section(dataset, results),
            strips_section(results),
            failures_section(results),
            limits_section(limits),
            _curves(results),
            _optics(dataset, results),
            provenance_section(dataset, results, split, None if limits is None else setup),
            words.section(list(metrics)),
            "</html>",
        ]
    )
    write_atomically(path, content.encode())
    write_atomically(path.with_suffix(".csv"), to_csv(results).encode())
    return path


def _head(dataset: Dataset, results: list[RunResult], notes: list[str], split: str, words: Glossary) -> str:
    first = results[0].evaluation
    objects = ", ".join(character_of(name) for name in first.characters())
    lines = "".join(f"<p>{html.escape(note)}</p>" for note in notes)
    sampling = dataset.sampling
    canvas = (
        f"{sampling.width * sampling.pitch_m * 100:g} cm x {sampling.scored_rows * sampling.pitch_m * 100:g} cm"
    )
    psnr = words.link("psnr_db")
    no_lpips = (
        ""
        if results[0].evaluation.scores.lpips is not None
        else " LPIPS: not available (no VGG trunk was given)."
    )
    seen = f"{len(first.images)} images of {len(first.characters())} objects ({html.escape(objects)})"
    return (
        f"<p class=dim>evnlos {__version__} · {seen}, split “{html.escape(split)}”</p>{lines}"
        f"<p>Scored on a canvas of {canvas} at {sampling.pitch_m * 1e3:g} mm per pixel; {psnr} is the mean "
        "over the images of each image's PSNR with peak 1. The first columns are what one scores without "
        "looking: an all-black image, and the mean of the training images, then what pure memory scores. A "
        f"method that does not exceed them has learned nothing.{no_lpips}</p>"
        f"<p><b>{words.link('e2e')}</b>: trained on the captures alone. <b>{words.link('epnp')}</b>: "
        "pre-trained on simulation, then fine-tuned on the captures. <span class=best>Best</span> and "
        "<span class=second>second best</span> of a row are "
        "marked.</p>"
    )


def _table(results: list[RunResult], metric: str, title: str, unit: str, decimals: int, words: Glossary) -> str:
    skip = len(baselines_of(results))
    columns = columns_of(results)
    heads = "".join(f"<th>{html.escape(c)}</th>" for c in columns[:skip])
    heads += "".join(f"<th>{words.label(c)}</th>" for c in columns[skip:])
    better = "&uarr; higher is better" if larger_is_better(metric) else "&darr; lower is better"
    lines = []
    for group, character, values in rows_of(results, metric):
        ranked = values if larger_is_better(metric) else [None if v is None else -v for v in values]
        best, second = best_two(ranked, skip)
        cells = "".join(
            f"<td class='{'best' if i == best else 'second' if i == second else ''}'>"
            f"{'-' if v is None else f'{v:.{decimals}f}'}</td>"
            for i, v in enumerate(values)
        )
        kind = " class=mean" if character == "mean" else ""
        lines.append(f"<tr{kind}><td>{html.escape(group)} {html.escape(character)}</td>{cells}</tr>")
    heading = words.link(metric, title) + (f", {unit}" if unit else "")
    table = (
        f"<div class=wide><table><tr><th class=better>{better}</th>{heads}</tr>{''.join(lines)}</table></div>"
    )
    return f"<h2>{heading}</h2>{table if metric == 'psnr_db' else folded(f'Table of {title}', table)}"


def _checks(results: list[RunResult]) -> str:
    """Show what stands beside the metrics: can the images be read, and are they more than memory?"""
    rows = []
    for name, meaning in CHECKS.items():
        values = [r.evaluation.checks.get(name) for r in results]
        if any(value is not None for value in values):
            cells = "".join(f"<td>{'-' if v is None else f'{v:.0%}'}</td>" for v in values)
            rows.append(f"<tr><td>{meaning}</td>{cells}</tr>")
    if not rows:
        return ""
    heads = "".join(f"<th>{html.escape(label(r))}</th>" for r in results)
    return (
        "<h2>Read, or remembered?</h2><p class=dim>The reader is a small network trained on clean glyphs of "
        "other hands. “nearest neighbour” answers with the training object whose measurement is most alike.</p>"
        + folded("Table", f"<div class=wide><table><tr><th></th>{heads}</tr>{''.join(rows)}</table></div>")
    )


def _pictures(dataset: Dataset, results: list[RunResult]) -> str:
    """Show one position of each object: wall frame, surface, truth and each reconstruction."""
    first = results[0].evaluation
    heads = ["", "wall frame", "events", "truth", *(label(r) for r in results)]
    cells = [f"<b>{html.escape(h)}</b>" for h in heads]
    for name in first.characters():
        chosen = np.flatnonzero(first.names == name)
        k = len(chosen) // 2
        samples, _ = read_shard(dataset.shard(name))
        shown = [stretched(samples.frame[k]), polarity(samples.surface[k]), grey(first.truth[chosen[k]])]
        shown += [grey(r.evaluation.images[chosen[k]]) for r in results]
        texts = ["wall frame", "time surface", "truth", *(label(r) for r in results)]
        cells.append(html.escape(name))
        cells += [
            f"<img alt='{html.escape(text)} of {html.escape(name)}' src='{data_uri(png(picture))}'>"
            for text, picture in zip(texts, shown, strict=True)
        ]
    grid = f"grid-template-columns:4.5rem repeat({len(heads) - 1},minmax(56px,100px))"
    return (
        "<h2>Images</h2><p class=dim>The middle position of each object. Wall frame stretched in contrast; "
        f"events as time surface ({WORDS}); reconstructions and truth from 0 to 1.</p>"
        f"<div class=tiles style='{grid}'>{''.join(f'<div>{c}</div>' for c in cells)}</div>"
    )


def _curves(results: list[RunResult]) -> str:
    """Show loss and score over the epochs of the runs whose log is there, and say whose is not."""
    logged = [r for r in results if r.log]
    series = {label(r): [(line["epoch"], line["loss"]) for line in r.log] for r in logged}
    scores = {
        label(r): [(line["epoch"], line["psnr_db"]) for line in r.log if "psnr_db" in line] for r in logged
    }
    parts = [curves_svg(series, "epoch", "loss of the training")]
    if any(scores.values()):
        parts.append(curves_svg(scores, "epoch", "PSNR on the validation objects, dB"))
    if without := [r.name for r in results if not r.log]:
        names = html.escape(", ".join(without))
        parts.append(f"<p class=dim>No curve, for a weights file holds no log of its training: {names}.</p>")
    return "<h2>Training</h2>" + "".join(parts)


def _optics(dataset: Dataset, results: list[RunResult]) -> str:
    """Show what the optics of each simulated dataset does to the image."""
    found = {dataset.folder.resolve().name: dataset.optics}
    for step in (step for r in results for step in r.history):
        found[step["data"]["name"]] = step["data"].get("optics", {})
    lines = [
        f"<tr><td>{html.escape(name)}</td><td>{html.escape(key)}</td><td>{value:.3g}</td></tr>"
        for name, figures in found.items()
        for key, value in figures.items()
    ]
    if not lines:
        return ""
    heads = "<tr><th>dataset</th><th></th><th></th></tr>"
    return (
        "<h2>Optics of the simulation</h2><p class=dim>Fresnel number of half a target; blur by diffraction "
        "and "
        "radius of the tPSF in camera pixels; distance up to which the sampled wave is true, in metres.</p>"
        + folded("Table", f"<div class=wide><table>{heads}{''.join(lines)}</table></div>")
    )


def scene_page(
    title: str,
    shows: str,
    pictures: Mapping[str, str],
    remarks: Mapping[str, str],
    steps: Iterable[tuple[str, str]],
    folder: Path,
) -> str:
    """Return the page of a scene that commands simulated and solved.

    Args:
        title: Its heading.
        shows: What is hidden, and what sees it.
        pictures: The caption of each file; one that is not there is named.
        remarks: What to make of the pictures, each under its name.
        steps: Each command, with what it printed.
        folder: Where the files lie; large ones stay there beside the page.
    """
    figures = []
    for file, caption in pictures.items():
        kind, where = mimetypes.guess_type(file)[0] or "image/png", folder / file
        if not where.is_file():  # the commands have said why, and go on
            figures.append(f"<p>{html.escape(file)} is not there: images need evnlos[plot].</p>")
            continue
        is_small = where.stat().st_size <= _EMBEDDED_BYTES
        source = data_uri(where.read_bytes(), kind) if is_small else html.escape(file)
        image = f"<img class=moving src='{source}' alt='{html.escape(caption)}'>"
        figures.append(f"<figure>{image}<figcaption>{html.escape(caption)}</figcaption></figure>")
    return "\n".join(
        [
            page_head(title),
            f"<h1>{html.escape(title)}</h1><p>{html.escape(shows)}</p>",
            f"<div class=movies>{''.join(figures)}</div>",
            *(f"<p><b>{html.escape(name)}.</b> {html.escape(text)}</p>" for name, text in remarks.items()),
            "<h2>How</h2><p>Everything is simulated. These commands made it, in this folder:</p>",
            *(f"<pre>$ {html.escape(step)}\n{html.escape(said)}</pre>" for step, said in steps),
            "</html>",
        ]
    )
