"""The page in Gradio: controls on the left, pictures on the right; everything it shows comes from `work`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from evnlos.app.controls import Controls
from evnlos.app.hidden import CHARACTERS, INK_SIDE, drawn, picked
from evnlos.app.networks import Networks
from evnlos.app.sheet import message_box
from evnlos.app.words import GLOSSARY, HEAD, PAPER
from evnlos.app.work import UPLOADS_AT_ONCE, opening_verdict, simulated, uploaded
from evnlos.errors import EvnlosError

_PICK, _DRAW = "Pick a character", "Draw one"
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
        with gr.Tab("Simulate a pass"), gr.Row(equal_height=False):
            with gr.Column(scale=1, min_width=290):
                controls = _controls(gr, opening)
            with gr.Column(scale=4, min_width=480):
                verdict = gr.HTML(first[1])
                pictures = gr.HTML(first[0], elem_id="ev-opening")
        with gr.Tab("Your recording"):
            gr.Markdown(
                "An event recording in any format that `evnlos info` reads, or a capture folder as a `.zip`; "
                f"at most {limit / 1e6:g} MB. It stays on the machine that runs this page, in a folder that is "
                "deleted when the page is stopped."
            )
            file = gr.File(label="Recording, or zip of a capture folder", file_count="single", type="filepath")
            message = gr.HTML()
            shown = gr.HTML()
        gr.HTML(GLOSSARY)
        run = _on_controls(gr, opening, networks)
        quiet: dict[str, Any] = {"show_progress": "hidden", "api_visibility": "private"}
        for control in controls:
            control.change(run, controls, [pictures, verdict], trigger_mode="always_last", **quiet)
        # The page opens with a pass that is there already; only its verdict may still be on its way.
        page.load(lambda: opening_verdict(opening), None, verdict, **quiet)
        file.change(
            lambda path: uploaded(path, scratch, limit, networks),
            file,
            [shown, message],
            show_progress="minimal",
            show_progress_on=message,
            api_visibility="private",
            concurrency_limit=UPLOADS_AT_ONCE,
        )
    return page


def theme(gradio: Any) -> Any:
    """Return a theme of the fonts that are there: others would be asked for elsewhere."""
    return gradio.themes.Base(
        primary_hue="blue", neutral_hue="slate", font=list(_FONT), font_mono=["ui-monospace", "monospace"]
    )


def _controls(gr: Any, opening: Controls) -> list[Any]:
    def slider(low: float, high: float, value: float, step: float, label: str, info: str = "") -> Any:
        return gr.Slider(low, high, value=value, step=step, label=label, info=info or None)

    with gr.Group():
        how = gr.Radio([_PICK, _DRAW], value=_PICK, label="Hidden object")
        character = gr.Dropdown(list(CHARACTERS), value="R", label="Character, on a plate of 8 cm")
        ink = gr.Textbox(elem_id="ev-ink", visible="hidden", max_length=2 * INK_SIDE**2)
        with gr.Column(visible=False) as paper:
            gr.HTML(PAPER, padding=True)
    how.change(
        lambda chosen: (gr.update(visible=chosen == _PICK), gr.update(visible=chosen == _DRAW)),
        how,
        [character, paper],
        show_progress="hidden",
        api_visibility="private",
    )
    with gr.Accordion("Rig", open=True):
        wall = gr.Radio([_METAL, _MATTE], value=_METAL, label="Wall")
        rough = slider(0.01, 0.3, opening.roughness, 0.01, "Wall roughness (metal)")
        distance = slider(15, 60, 100 * opening.distance_m, 1, "Distance from object to wall, cm")
        speed = slider(0.5, 20, 100 * opening.speed_m_s, 0.5, "Speed of the object, cm/s")
        ambient = slider(0, 0.7, opening.ambient, 0.01, "Ambient light, white levels")
    with gr.Accordion("Cameras", open=True):
        noise = slider(0.2, 10, opening.frame_noise, 0.1, "Frame noise, times the usual camera's")
        on = slider(0.03, 0.6, opening.threshold_on, 0.01, "Threshold of brighter events, log light")
        off = slider(0.03, 0.6, opening.threshold_off, 0.01, "Threshold of darker events, log light")
        event_noise = slider(0, 2, opening.event_noise_hz, 0.01, "Event noise, events a second and pixel")
    return [how, character, ink, wall, rough, distance, speed, ambient, noise, on, off, event_noise]


def _on_controls(gr: Any, opening: Controls, networks: Networks) -> Callable[..., Iterator[tuple[str, str]]]:
    def run(
        how: str,
        character: str,
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
            target = drawn(ink) if how == _DRAW else picked(character)
            yield from simulated(chosen, target, networks)
        except EvnlosError as error:
            yield gr.skip(), message_box(str(error))

    return run
