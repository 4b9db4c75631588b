"""Named simulations: Python functions, so that a preset can say why each of its values is what it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from evnlos.dataset.sampling import Sampling
from evnlos.dataset.simulate import Simulation
from evnlos.scene import DIGITS, TRAIN_WRITERS, UPPER_CASE, FontGlyphs, HandwritingGlyphs, LineMotion
from evnlos.setups.presets import as_in_the_paper, page_setup, rough_paper


def default() -> Simulation:
    """Return the simulation to pre-train on when the rig is known only roughly: the paper's transport, varied.

    Blur, light, noise and thresholds are drawn for each object from wide ranges, the magnification from a
    narrow one around a target 0.3 m from the wall and a camera 0.6 m from it; the camera aims at the middle
    of the travel. A view that varied more would make the place of the target unknowable from one picture.
    """
    return Simulation(
        glyphs=HandwritingGlyphs(characters="ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789", writers=8),
        setup=rough_paper(),
        vary={
            "setup.field_of_view_m": (0.55, 0.62),
            "setup.tpsf_length_m": (0.006, 0.03),
            "setup.rho_max": (2.0, 5.0),
            "setup.stretch": (1.0, 1.2),
            "setup.gain": (0.8, 2.4),
            "setup.ambient": (0.02, 0.1),
            "setup.ambient_gradient.0": (-0.4, 0.4),
            "setup.ambient_gradient.1": (-0.4, 0.4),
            "setup.pixel.threshold_on": (0.1, 0.35),
            "setup.pixel.threshold_off": (0.1, 0.35),
            "setup.pixel.cutoff_hz": (10.0, 200.0),
            "setup.pixel.shot_noise_rate_hz": (0.0, 1.0),
        },
    )


def paper() -> Simulation:
    """Return the paper's simulated training set: 39 x 26 handwritten letters, 0.5 m, 500 nm, 960 x 600 pixels.

    NIST-like handwriting stands in for NIST; give `--glyphs.kind nist-sd19` and the folder of your own copy.
    """
    return Simulation(
        glyphs=HandwritingGlyphs(),
        setup=as_in_the_paper(),
    )


def paper_nist_test() -> Simulation:
    """Return the paper's first simulated test set: 1 x 26 letters of a writer that the training never saw."""
    return _tested_on(HandwritingGlyphs(writers=1, first_writer=TRAIN_WRITERS))


def paper_comic_letters() -> Simulation:
    """Return the paper's second simulated test set: the 26 letters of the Comic face."""
    return _tested_on(FontGlyphs(characters=UPPER_CASE))


def paper_comic_digits() -> Simulation:
    """Return the paper's third simulated test set: the 10 digits of the Comic face, smaller than letters."""
    return _tested_on(FontGlyphs(characters=DIGITS))


def _tested_on(glyphs: HandwritingGlyphs | FontGlyphs) -> Simulation:
    """Return the paper's simulation of other objects, none of them for training."""
    return replace(paper(), glyphs=glyphs, validation=0.0)


def page() -> Simulation:
    """Return the simulation that the networks of `evnlos app` learn from: the page's rig, its sliders moved.

    Metal from smooth to rough, the distances, lights, noises and thresholds around the page's first setting;
    beyond, where even the best linear picture shows next to nothing, the networks are not at home.
    """
    setup = page_setup()
    well_e, read_e = setup.frame_camera.full_well_e, setup.frame_camera.read_noise_e
    return Simulation(
        glyphs=HandwritingGlyphs(characters=UPPER_CASE + DIGITS, writers=44),
        motion=LineMotion((-0.08, 0.0), 0.02),
        setup=setup,
        sampling=Sampling(height=32, width=48, pitch_m=0.005, scored_rows=24),
        vary={
            "setup.roughness": (0.02, 0.09),
            "setup.distance_m": (0.2, 0.4),
            "setup.ambient": (0.0, 0.3),
            "setup.frame_camera.full_well_e": (well_e / 4, 2 * well_e),
            "setup.frame_camera.read_noise_e": (read_e / 2, 2 * read_e),
            "setup.pixel.threshold_on": (0.08, 0.3),
            "setup.pixel.threshold_off": (0.08, 0.3),
            "setup.pixel.shot_noise_rate_hz": (0.0, 0.2),
        },
        rigs=200,
    )


PRESETS: dict[str, Callable[[], Simulation]] = {
    "default": default,
    "page": page,
    "paper": paper,
    "paper-nist-test": paper_nist_test,
    "paper-comic-letters": paper_comic_letters,
    "paper-comic-digits": paper_comic_digits,
}
"""Simulations by name; `paper` is the paper's training set, the others of its name are its test sets."""
