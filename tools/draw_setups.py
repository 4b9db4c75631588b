"""Draw the parts of two setups, to scale: the paper's, and the one of a monitor, a phone and a baking tray.

python tools/draw_setups.py        # docs/figures/setup_paper.svg, docs/figures/setup_first_light.svg
"""

from pathlib import Path

from evnlos.plot.setup import setup_drawing
from evnlos.setups import setup_preset

FIGURES = Path(__file__).resolve().parent.parent / "docs" / "figures"
ROOM = "style='background:#fff;color:#222' "


def main() -> None:
    """Write both drawings."""
    setup = setup_preset("main-near")
    drawings = {
        "paper": (setup_drawing(setup, 0.16, 0.08), {"cameras, ": "event and frame camera, "}),
        "first_light": (
            setup_drawing(setup, 0.0, 0.16),
            {
                "object 16 cm, way 0 cm": "monitor; 16 x 8 cm in its middle shine",
                "cameras, ": "phone, ",
                "relay wall, metal of roughness 0.05": "baking tray, upright",
                "hides the object (sketch)": "cardboard: the phone must not see the screen",
            },
        ),
    }
    for name, (drawing, words) in drawings.items():
        assert drawing is not None
        svg = drawing.svg.replace("<svg ", f"<svg {ROOM}", 1)
        for before, after in words.items():
            assert before in svg, f"the drawing no longer says {before!r}"
            svg = svg.replace(before, after)
        (FIGURES / f"setup_{name}.svg").write_text(svg + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
