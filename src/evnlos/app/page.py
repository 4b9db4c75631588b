"""The page in Gradio: texts, controls, and what happens when a control moves.

- The texts of the page that stand still.
- What happens when a control moves or a file arrives: images and words as HTML, piece by piece.
- The page in Gradio: controls on the left, images on the right.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from evnlos.app.controls import (
    CHARACTERS,
    FILMS,
    INK_SIDE,
    PRESETS,
    Controls,
    Recorded,
    drawn,
    link_of,
    picked,
    settings_of,
    simulate_film,
    simulate_sequence,
)
from evnlos.app.upload import read_upload_apart
from evnlos.app.views import (
    GLOSSARY,
    Networks,
    Reconstruction,
    View,
    event_views,
    found_views,
    from_each_frame,
    from_film,
    from_weights,
    from_whole_sequence,
    limits_of,
    message_box,
    nearest_setup,
    seen_views,
    sheet,
    verdict_box,
    waiting_box,
)
from evnlos.errors import EvnlosError
from evnlos.inverse import film_plane
from evnlos.plot.setup import setup_drawing
from evnlos.scene import Target

HEAD = """<header class="ev-head"><h1>Seeing around a corner</h1>
<p>Something moves behind a corner. Its light falls on a wall; a frame camera and an event camera see
the wall alone. Choose what is hidden and how good the wall and the cameras are, and watch what can be made
of it.</p></header>"""

PAPER = """<div class="ev-paper"><canvas class="ev-pen" width="192" height="192" tabindex="0" role="img"
aria-label="Drawing of the hidden object, 8 cm wide. Arrow keys move the pen, with Shift they draw."></canvas>
<i class="ev-nib"></i><button type="button" class="ev-button" onclick="evnlosClear(this)">Clear</button>
<small>8 cm x 8 cm. Draw with mouse or finger; arrow keys move the pen, with Shift they draw.</small></div>"""
"""The paper of a drawing; `page.js` draws on it."""


UPLOADS_AT_ONCE = 4
"""Uploads that are read at the same time, each in a process of its own."""
_drawing = threading.Lock()  # what was read and checked takes seconds, and the cores are the page's


def simulated(
    controls: Controls, hidden: Target | str, networks: Networks, link: str = ""
) -> Iterator[tuple[str, str]]:
    """Yield (sheet, verdict) of a simulated sequence three times: what is quick, all, and with the verdict.

    Args:
        controls: Setup and camera.
        hidden: The object that moves, or the name of a film: a plane that changes, of which no network knows.
        networks: The page's networks.
        link: Address of these settings.

    Raises:
        EvnlosError: The settings can't be.
    """
    is_film = isinstance(hidden, str)
    recorded = simulate_film(controls, hidden) if is_film else simulate_sequence(controls, hidden)
    before, after = seen_views(recorded), event_views(recorded)
    if is_film:
        found = [from_film(recorded, "frames")]
    else:
        found = [from_whole_sequence(recorded), from_each_frame(recorded)]
    assert recorded.simulation is not None  # it was simulated
    drawing = setup_drawing(recorded.simulation.setup)
    about = (
        link,
        drawing.svg.replace(" xmlns='http://www.w3.org/2000/svg'", "") if drawing else "",
    )  # within HTML it has none
    yield _sheet(recorded, before, found, after, *about), waiting_box()
    if is_film:
        found += [from_film(recorded, "events"), from_film(recorded, "both")]
    else:
        wall = networks.wall_of(recorded)
        found += [from_weights(recorded, name, one, wall) for name, one in networks.of(recorded).items()]
    pictures = _sheet(recorded, before, found, after, *about)
    yield pictures, waiting_box()
    yield pictures, verdict_box(limits_of(recorded.simulation))


def opening_verdict(controls: Controls) -> str:
    """Return the verdict on the setup that the page opens with."""
    return verdict_box(limits_of(controls.simulation()))


class Wanted:
    """Which upload each visitor looks at, and how: what comes of one that was removed meanwhile is not shown.

    Args:
        most: Visitors to remember; of others every result is shown.
    """

    def __init__(self, most: int = 1000) -> None:
        self._most, self._paths = most, dict[str, str | None]()

    def note(self, visitor: str, path: str | None) -> None:
        """Remember a visitor's file, or that there is none."""
        self._paths.pop(visitor, None)
        self._paths[visitor] = path
        while len(self._paths) > self._most:
            del self._paths[next(iter(self._paths))]

    def is_still(self, visitor: str, path: str | None) -> bool:
        """Return whether a file is the one that its visitor looks at."""
        return self._paths.get(visitor, path) == path


def uploaded(
    path: str | None,
    scratch: Path,
    limit_bytes: int,
    networks: Networks,
    rests: bool = False,
    sides_m: tuple[float, float] = (0.2, 0.14),
) -> tuple[str, str]:
    """Return (sheet, message) of an uploaded file; whatever is wrong with it is a message of one line.

    Args:
        path: The file, or None where there is none.
        scratch: Folder to unpack in.
        limit_bytes: Largest file, bytes.
        networks: The page's networks.
        rests: Whether nothing moves as a whole, by the visitor's word: a film is shown, as of frames whose
            motion nobody states.
        sides_m: Width and height of the plane that changes, metres.
    """
    if not path:
        return "", message_box(_NO_FILE, wrong=False)
    try:
        recorded = read_upload_apart(path, scratch, limit_bytes)
        found, refused = [], []
        with _drawing:
            known, wall = {} if rests else networks.of(recorded), networks.wall_of(recorded)
            setup = nearest_setup(recorded) if (rests or not known) and recorded.frames is not None else None
            if setup is not None:
                found.append(from_film(recorded, "frames", (setup, film_plane(sides_m, _CELLS))))
            for name, one in known.items():
                try:
                    found.append(from_weights(recorded, name, one, wall))
                except EvnlosError as error:
                    refused.append(str(error))
            pictures = _sheet(recorded, seen_views(recorded), found, event_views(recorded))
    except (EvnlosError, OSError, MemoryError) as error:
        return "", message_box(_without_folder(str(error) or "the file needs too much memory", path, scratch))
    notes = [*recorded.notes, *refused]
    if found and not known:
        size = " x ".join(f"{100 * side:g} cm" for side in sides_m)
        notes.append(
            f"shown as the film of a plane of {size} that changes, with the published setup whose distance is "
            "nearest; evnlos invert --changing takes your own setup"
        )
    elif rests:
        notes.append("without frames there is no film here; see evnlos invert --changing --from events")
    elif not known:
        notes.append(
            "no network to reconstruct with: those of the package need a capture folder that states the "
            "motion; or start the page with --weights"
        )
    return pictures, message_box("; ".join(notes), wrong=False)


def _sheet(
    recorded: Recorded, before: list[View], found: list[Reconstruction], after: list[View], *about: str
) -> str:
    views = [*before, *found_views(found), *after]
    moment = ("position", "hidden object") if recorded.film is None else ("image", "film")
    times_s = recorded.times_s - recorded.edges_us[0] * 1e-6
    return sheet(views, times_s, recorded.name, *about, moment=moment)


def _without_folder(text: str, path: str, scratch: Path) -> str:
    """Return a message without the folders of this machine."""
    folders = {scratch, scratch.resolve(), Path(path).parent, Path(path).resolve().parent}
    for folder in sorted(folders, key=lambda one: len(str(one)), reverse=True):  # the inner ones first
        text = re.sub(re.escape(str(folder)) + r"/(unpacked-[^/]*/)*", "", text)
    return text


_NO_FILE = "no file yet: choose a recording, or a capture folder as a zip"
_PICK, _DRAW, _CHANGE = "Pick a character", "Draw one", "One that changes"
_MOVES, _RESTS = "moves as a whole", "rests and changes its picture"
_CELLS = 16  # along the longer side of an uploaded film
_BEFORE = 4  # controls of what is hidden
_SPEED = "One that changes takes as long as an object of this speed for its 16 cm."
_METAL, _MATTE = "rough metal", "matte white paint"
_FONT = ("system-ui", "sans-serif")


def build_page(
    gradio: Any, first: tuple[str, str], opening: Controls, networks: Networks, scratch: Path, limit: int
) -> Any:
    """Return the page.

    Args:
        gradio: The package.
        first: Sheet and verdict that the page opens with.
        opening: Settings that the controls open with.
        networks: The page's networks.
        scratch: Folder for uploads of this session.
        limit: Largest upload, bytes.
    """
    gr = gradio
    with gr.Blocks(title="evnlos", analytics_enabled=False, fill_width=True, delete_cache=(600, 3600)) as page:
        gr.HTML(HEAD, elem_id="ev-about")
        with gr.Tab("Simulate a sequence"), gr.Row(equal_height=False, elem_classes="ev-work"):
            with gr.Column(scale=1, min_width=290, elem_classes="ev-controls"):
                preset = gr.Dropdown(list(PRESETS), value="usual", label="Begin with")
                controls = _controls(gr, opening)
            with gr.Column(scale=4, min_width=480, elem_classes="ev-results"):
                verdict = gr.HTML(first[1], elem_classes="ev-said")
                pictures = gr.HTML(first[0], elem_id="ev-opening")
        with gr.Tab("Your recording"):
            gr.Markdown(
                "An event recording in any format that `evnlos info` reads, or a capture folder as a `.zip`; "
                f"at most {limit / 1e6:g} MB. It stays on the machine that runs this page, in a folder that is "
                "deleted when the page is stopped."
            )
            with gr.Row():
                rests = gr.Radio([_MOVES, _RESTS], value=_MOVES, label="The hidden object")
                wide = gr.Number(20, label="Width of a plane that changes, cm")
                high = gr.Number(14, label="Height of a plane that changes, cm")
            file = gr.File(label="Recording, or zip of a capture folder", file_count="single", type="filepath")
            message = gr.HTML()
            shown = gr.HTML()
        gr.HTML(GLOSSARY)
        run = _on_controls(gr, opening, networks)
        quiet: dict[str, Any] = {"show_progress": "hidden", "api_visibility": "private"}
        for control in controls:
            control.change(run, controls, [pictures, verdict], trigger_mode="always_last", **quiet)
        preset.input(
            lambda name: _values(replace(opening, **PRESETS[name])), preset, controls[_BEFORE:], **quiet
        )
        # The page opens with a sequence that is there already; only its verdict may still be on its way.
        page.load(_open_link(gr, opening), None, [*controls, verdict], **quiet)
        wanted = Wanted()

        def begin(path: str | None, how: str, wide: float | None, high: float | None, request: Any) -> Any:
            wanted.note(request.session_hash, repr([path, how, wide, high]))
            return "", message_box("reading ..." if path else _NO_FILE, wrong=False)

        def read(path: str | None, how: str, wide: float | None, high: float | None, request: Any) -> Any:
            what, sides_m = repr([path, how, wide, high]), ((wide or 0) / 100, (high or 0) / 100)
            found = uploaded(path, scratch, limit, networks, how == _RESTS, sides_m)
            return found if wanted.is_still(request.session_hash, what) else (gr.skip(), gr.skip())

        for step in (begin, read):
            step.__annotations__["request"] = gr.Request  # Gradio hands it to who names it
        given = [file, rests, wide, high]
        when: dict[str, Any] = {"triggers": [one.change for one in given], "trigger_mode": "multiple"}
        gr.on(fn=begin, inputs=given, outputs=[shown, message], queue=False, **when, **quiet)
        slow = {"show_progress": "minimal", "show_progress_on": message, "concurrency_limit": UPLOADS_AT_ONCE}
        gr.on(fn=read, inputs=given, outputs=[shown, message], **when, **(quiet | slow))
    return page


def theme(gradio: Any) -> Any:
    """Return a theme of the fonts that are there: others would be asked for elsewhere."""
    return gradio.themes.Base(
        primary_hue="blue", neutral_hue="slate", font=list(_FONT), font_mono=["ui-monospace", "monospace"]
    )


def _controls(gr: Any, opening: Controls) -> list[Any]:
    def slider(low: float, high: float, value: float, step: float, label: str, info: str = "") -> Any:
        made = gr.Slider(low, high, value=value, step=step, label=label, info=info or None)
        checked = made.preprocess
        made.preprocess = lambda given: checked(
            min(max(given, low), high)
        )  # typed into the box; page.js shows it
        return made

    with gr.Group():
        how = gr.Radio([_PICK, _DRAW, _CHANGE], value=_PICK, label="Hidden object")
        character = gr.Dropdown(list(CHARACTERS), value="R", label="Character, on a target plane of 8 cm")
        film = gr.Dropdown(
            list(FILMS), value=next(iter(FILMS)), visible=False, label="What changes, on a target plane of 8 cm"
        )
        ink = gr.Textbox(elem_id="ev-ink", visible="hidden", max_length=2 * INK_SIDE**2)
        with gr.Column(visible=False) as paper:
            gr.HTML(PAPER, padding=True)
    how.change(
        lambda chosen: [gr.update(visible=chosen == one) for one in (_PICK, _DRAW, _CHANGE)],
        how,
        [character, paper, film],
        show_progress="hidden",
        api_visibility="private",
    )
    with gr.Accordion("Setup", open=True):
        wall = gr.Radio([_METAL, _MATTE], value=_METAL, label="Wall")
        rough = slider(0.01, 0.3, opening.roughness, 0.01, "Wall roughness (metal)")
        distance = slider(15, 60, 100 * opening.distance_m, 1, "Distance from object to wall, cm")
        speed = slider(0.5, 20, 100 * opening.speed_m_s, 0.5, "Speed of the object, cm/s", _SPEED)
        ambient = slider(0, 0.7, opening.ambient, 0.01, "Ambient light, white levels")
    with gr.Accordion("Cameras", open=True):
        noise = slider(0.2, 10, opening.frame_noise, 0.1, "Frame noise, times the usual camera's")
        on = slider(0.03, 0.6, opening.threshold_on, 0.01, "Threshold of brighter events, log light")
        off = slider(0.03, 0.6, opening.threshold_off, 0.01, "Threshold of darker events, log light")
        event_noise = slider(0, 2, opening.event_noise_hz, 0.01, "Event noise, events per pixel per second")
    return [how, character, film, ink, wall, rough, distance, speed, ambient, noise, on, off, event_noise]


def _values(controls: Controls) -> list[Any]:
    """Return what the controls of setup and cameras show."""
    wall = _MATTE if controls.wall == "matte" else _METAL
    one = controls
    seen = [wall, one.roughness, 100 * one.distance_m, 100 * one.speed_m_s, one.ambient, one.frame_noise]
    return [*seen, one.threshold_on, one.threshold_off, one.event_noise_hz]


def _open_link(gr: Any, opening: Controls) -> Callable[[Any], list[Any]]:
    untouched = [gr.skip()] * (_BEFORE + len(_values(opening)))

    def load(request: Any) -> list[Any]:
        query = dict(request.query_params)
        try:
            controls, character, ink = settings_of(query, opening)
        except EvnlosError as error:
            return [*untouched, message_box(f"the link cannot be opened: {error}")]
        if (controls, character, ink) == (opening, "R", ""):
            return [*untouched, opening_verdict(opening)]
        how = _DRAW if ink else _CHANGE if character in FILMS else _PICK
        hidden = [gr.skip(), character] if character in FILMS else [character, gr.skip()]
        return [how, *hidden, ink, *_values(controls), gr.skip()]

    load.__annotations__["request"] = gr.Request  # Gradio hands it to who names it
    return load


def _on_controls(gr: Any, opening: Controls, networks: Networks) -> Callable[..., Iterator[tuple[str, str]]]:
    def run(
        how: str,
        character: str,
        film: str,
        ink: str,
        wall: str,
        rough: float,
        distance_cm: float,
        speed_cm_s: float,
        ambient: float,
        noise: float,
        on: float,
        off: float,
        event_noise_hz: float,
    ) -> Iterator[tuple[str, str]]:
        try:
            chosen = Controls(
                "matte" if wall == _MATTE else "metal",
                rough,
                distance_cm / 100,
                speed_cm_s / 100,
                ambient,
                noise,
                on,
                off,
                event_noise_hz,
                opening.columns,
                opening.seed,
            )
            hidden = drawn(ink) if how == _DRAW else film if how == _CHANGE else picked(character)
            link = link_of(chosen, film if how == _CHANGE else character, ink if how == _DRAW else "")
            yield from simulated(chosen, hidden, networks, link)
        except EvnlosError as error:
            yield gr.skip(), message_box(str(error))

    return run
