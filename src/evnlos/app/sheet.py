"""Views as one piece of HTML without requests: each a tall picture of all positions, of which one is shown."""

from __future__ import annotations

import html
import io
import json
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from evnlos.app.verdict import Verdict
from evnlos.app.views import View
from evnlos.report.pictures import data_uri

_GROUPS = {
    "seen": "What is there, and what the cameras see",
    "found": "What can be made of it",
    "events": "The events in space and time",
}


def sheet(views: Sequence[View], times_s: NDArray[np.float64], name: str = "pass") -> str:
    """Return views in their groups, above them a slider over the positions and a button that plays them.

    Moving the slider asks nobody: all positions are in the page already.

    Args:
        views: The views.
        times_s: Instant of each position, [N], seconds.
        name: What the pass is called, for people who listen to the page.
    """
    count = len(times_s)
    start = count // 2
    words = [f"position {k + 1} of {count}, {time:.2f} s" for k, time in enumerate(times_s)]
    texts = html.escape(json.dumps(words), True)
    parts = [
        '<div class="ev-player">',
        '<button type="button" class="ev-button ev-play" aria-pressed="false" onclick="evnlosPlay(this)">'
        "Play</button>",
        f'<label>Position <input type="range" class="ev-position" min="0" max="{count - 1}" step="1" '
        f'value="{start}" aria-label="Position of the hidden object" oninput="evnlosMove(this)"></label>',
        f'<output class="ev-now" data-texts="{texts}">{words[start]}</output></div>',
    ]
    for group, title in _GROUPS.items():
        chosen = [view for view in views if view.group == group]
        if chosen:
            parts.append(f'<h3 class="ev-title">{title}</h3><div class="ev-row ev-{group}">')
            parts += [_figure(view, start) for view in chosen]
            parts.append("</div>")
    content = "".join(parts)
    mark = zlib.crc32(content.encode())  # tells the page that another pass is shown
    return (
        f'<section class="ev-sheet" data-pass="{mark:08x}" style="--k:{start};--n:{count}" '
        f'aria-label="{html.escape(name, True)}">{content}</section>'
    )


def verdict_box(verdict: Verdict) -> str:
    """Return the verdict as HTML."""
    texts = (html.escape(text) for text in (verdict.meaning, verdict.reason, verdict.figures))
    meaning, reason, figures = texts
    return (
        '<div class="ev-verdict" role="status"><strong>Can this rig show anything? </strong>'
        f"<span>{meaning}</span><p>{reason} {figures}</p></div>"
    )


def waiting_box() -> str:
    """Return what stands where the verdict will be."""
    return (
        '<div class="ev-verdict" role="status"><strong>Can this rig show anything? </strong>'
        "<span>Looking at it.</span></div>"
    )


def message_box(text: str, wrong: bool = True) -> str:
    """Return a message of one line as HTML; nothing in it is taken for HTML."""
    line = html.escape(" ".join(text.split()))
    kind, role = ("ev-wrong", "alert") if wrong else ("ev-note", "status")
    return f'<div class="ev-message {kind}" role="{role}">{line}</div>'


def sprite(view: View) -> bytes:
    """Return all pictures of a view below each other as one PNG."""
    stack = view.pictures.reshape(-1, *view.pictures.shape[2:])  # [N h, w] or [N h, w, 4]
    image = Image.fromarray(np.ascontiguousarray(stack))
    options: dict[str, bytes] = {}
    if view.colours is not None:
        image = Image.frombytes("P", image.size, stack.tobytes())
        image.putpalette(view.colours[:, :3].tobytes())
        options["transparency"] = view.colours[:, 3].tobytes()
    buffer = io.BytesIO()
    image.save(buffer, "PNG", compress_level=3, **options)
    return buffer.getvalue()


def _figure(view: View, start: int) -> str:
    height, width = view.pictures.shape[1:3]
    many = len(view.pictures) > 1
    place = "calc(var(--k) / max(var(--n) - 1, 1) * 100%)" if many else "0"
    tall = "calc(var(--n) * 100%)" if many else "100%"
    ratio = f"{width} / {height}" if not view.cursor else "2 / 1"
    style = (
        f"aspect-ratio:{ratio};background-image:url({data_uri(sprite(view))});"
        f"background-size:100% {tall};background-position:0 {place}"
    )
    title, note = html.escape(view.title), html.escape(view.note)
    inner = '<i class="ev-cursor"></i>' if view.cursor else ""
    inner += "".join(
        f'<span class="ev-mark" style="left:{100 * x:.1f}%;top:{100 * y:.1f}%">{html.escape(text)}</span>'
        for text, x, y in view.marks
    )
    caption = ""
    if view.captions:
        texts = html.escape(json.dumps(view.captions), True)
        caption = f'<span class="ev-value" data-texts="{texts}">{html.escape(view.captions[start])}</span>'
    kind = " ev-line" if view.colours is not None else ""
    return (
        f'<figure><figcaption><b>{title}</b>{caption}</figcaption><div class="ev-picture{kind}" role="img" '
        f'aria-label="{title}: {note}" style="{style}">{inner}</div><small>{note}</small></figure>'
    )
