"""What a visitor chooses: controls, the hidden object, and the sequence that the cameras saw.

- What the page lets a visitor choose, as settings of a small simulation.
- The hidden object: a character picked, a visitor's drawing, or a plane that changes.
- One sequence as the cameras saw it, whether it was simulated a moment ago or uploaded.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Literal
from urllib.parse import urlencode

import numpy as np
from numpy.typing import NDArray

from evnlos.cameras import EventCamera, EventPixel, FrameCamera
from evnlos.data import Samples, Sampling, Simulation, make_samples
from evnlos.data.sampling import edges_from
from evnlos.data.simulations import page
from evnlos.errors import ConfigError, DataError
from evnlos.inverse.sequence_problem import matrix_of
from evnlos.optics import FilmWall, MatrixTransport
from evnlos.scene import (
    DIGITS,
    TRAIN_WRITERS,
    UPPER_CASE,
    Film,
    HandwritingGlyphs,
    Motion,
    Scene,
    Target,
    closing_hand,
    drawing,
)
from evnlos.scene.glyph_sets import TargetPlane
from evnlos.setups import RadiometricSetup, SensorSize
from evnlos.types import Events, Irradiance, Plane, derive_seed

_PAGE = page()  # what the package's networks learned from: setup and samples here are the same
POSITIONS = _PAGE.positions
"""Positions of a sequence, as in a dataset."""
TRAVEL_M = _PAGE.motion.speed_m_s * _PAGE.duration_s
"""Way of the hidden object, metres, as in a dataset."""
COARSE = _PAGE.sampling
"""The standard canvas of 24 cm x 16 cm in cells of the simulation: coarse, so that a new wall takes less than a
second."""

Wall = Literal["metal", "matte"]


@dataclass(frozen=True)
class Controls:
    """Setup and camera as the page's controls state them; hidden object apart.

    Raises:
        ConfigError: A value outside its range.

    Example:
        >>> Controls(speed_m_s=0.04).duration_s
        4.0
    """

    wall: Wall = "metal"
    """Rough metal, or matte white paint that throws light everywhere alike."""
    roughness: float = 0.05
    """Roughness of the metal (GGX alpha), 0.01 to 0.3."""
    distance_m: float = 0.3
    """Distance from hidden object to wall, metres, 0.15 to 0.6."""
    speed_m_s: float = 0.02
    """Speed of the hidden object, metres per second, 0.005 to 0.2."""
    ambient: float = 0.05
    """Ambient light, white levels, 0 to 0.7."""
    frame_noise: float = 1.0
    """Noise of the frame camera in multiples of the default camera's, 0.2 to 10."""
    threshold_on: float = 0.15
    """Threshold of ON events, log intensity, 0.03 to 0.6."""
    threshold_off: float = 0.15
    """Threshold of OFF events, log intensity, 0.03 to 0.6."""
    event_noise_hz: float = 0.01
    """Noise events of a pixel in the dark, hertz, 0 to 2."""
    columns: int = 48
    """Columns of the camera, pixels, 16 to 320; it has five rows to eight columns."""
    seed: int = 1
    """Seed of all noise."""

    def __post_init__(self) -> None:
        if self.wall not in ("metal", "matte"):
            raise ConfigError(f"wall is {self.wall!r}; give metal or matte")
        for name, low, high in (
            ("roughness", 0.01, 0.3),
            ("distance_m", 0.15, 0.6),
            ("speed_m_s", 0.005, 0.2),
            ("ambient", 0.0, 0.7),
            ("frame_noise", 0.2, 10.0),
            ("threshold_on", 0.03, 0.6),
            ("threshold_off", 0.03, 0.6),
            ("event_noise_hz", 0.0, 2.0),
            ("columns", 16, 320),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise ConfigError(f"{name} is {value!r}; give a number from {low:g} to {high:g}")
            if not low - 1e-9 <= value <= high + 1e-9:
                raise ConfigError(f"{name} is {value:g}; give {low:g} to {high:g}")

    @property
    def duration_s(self) -> float:
        """Length of the sequence, seconds."""
        return TRAVEL_M / self.speed_m_s

    def simulation(self) -> Simulation:
        """Return the same as settings of `evnlos simulate`: a radiometric wall, both cameras, coarse samples.

        The noise of a pixel grows with the square root of the light over the full well, so that a well smaller
        by the noise squared gives that multiple of the noise in any light.
        """
        usual = FrameCamera()
        camera = FrameCamera(
            full_well_e=usual.full_well_e / self.frame_noise**2,
            read_noise_e=usual.read_noise_e / self.frame_noise,
            dsnu_e=usual.dsnu_e / self.frame_noise**2,
        )
        return Simulation(
            motion=replace(_PAGE.motion, speed_m_s=self.speed_m_s),
            duration_s=self.duration_s,
            positions=POSITIONS,
            setup=RadiometricSetup(
                wall_material="ggx" if self.wall == "metal" else "lambert",
                # A matte wall has no roughness: one value, so that its matrix is made once.
                roughness=self.roughness if self.wall == "metal" else 0.05,
                distance_m=self.distance_m,
                cell_m=COARSE.pitch_m,
                ambient=self.ambient,
                sensor=SensorSize(round(self.columns * 5 / 8), self.columns),
                frame_camera=camera,
                pixel=EventPixel(
                    threshold_on=self.threshold_on,
                    threshold_off=self.threshold_off,
                    shot_noise_rate_hz=self.event_noise_hz,
                ),
            ),
            sampling=COARSE,
            seed=self.seed,
        )


PRESETS: dict[str, dict[str, object]] = {
    "usual": {},
    "polished metal": {"roughness": 0.02},
    "dull metal": {"roughness": 0.1},
    "matte paint: nothing is seen": {"wall": "matte"},
    "far away": {"distance_m": 0.5},
    "fast": {"speed_m_s": 0.1},
    "noisy camera": {"frame_noise": 5.0, "event_noise_hz": 0.5},
    "bright room": {"ambient": 0.5},
}
"""Settings to begin with, by name: what differs from the usual ones."""
_LINKED = ("wall", *(name for name in Controls.__dataclass_fields__ if name not in ("wall", "columns", "seed")))


def link_of(controls: Controls, character: str = "", ink: str = "") -> str:
    """Return the query of an address that opens the page with these settings; a film is a character here.

    Example:
        >>> link_of(Controls(roughness=0.02), "G")
        '?character=G&roughness=0.02'
    """
    usual = Controls()
    query: dict[str, object] = (
        {"ink": ink} if ink else {"film" if character in FILMS else "character": character}
    )
    query |= {name: getattr(controls, name) for name in _LINKED}
    changed = {name: value for name, value in query.items() if value != getattr(usual, name, None)}
    return "?" + urlencode(changed)


def settings_of(query: Mapping[str, str], opening: Controls) -> tuple[Controls, str, str]:
    """Return controls, character or film, and drawing of an address that `link_of` made.

    Args:
        query: Names and values; names that are none of ours are left alone.
        opening: What holds where nothing is said.

    Raises:
        ConfigError: A value that cannot be.
    """
    character, ink = query.get("character", "R"), query.get("ink", "")
    if character not in CHARACTERS or len(character) != 1 or len(ink) > 2 * INK_SIDE**2:
        raise ConfigError(f"character is {character[:20]!r}; give one of {CHARACTERS}")
    film = query.get("film", "")
    if film and film not in FILMS:
        raise ConfigError(f"film is {film[:20]!r}; give {' or '.join(FILMS)}")
    given: dict[str, Any] = {}
    for name in _LINKED:
        if name in query:
            try:
                given[name] = query[name] if name == "wall" else float(query[name])
            except ValueError:
                raise ConfigError(f"{name} is {query[name][:20]!r}; give a number") from None
    return replace(opening, **given), film or character, ink


CHARACTERS = UPPER_CASE + DIGITS
"""What can be picked."""
_SIDE = 128  # of a mask, pixels: 26 a cell
INK_SIDE = 32
"""Pixels a side of a drawing."""
_LEAST_INK = 1e-3
_EMPTY = "the drawing is empty; draw something, or pick a character"


@lru_cache(maxsize=64)
def picked(character: str) -> Target:
    """Return a character in a hand that no training set holds, on the standard target of 8 cm.

    Raises:
        ConfigError: It is none of `CHARACTERS`.
    """
    if len(character) != 1 or character not in CHARACTERS:
        raise ConfigError(f"the hidden character is {character[:20]!r}; give one of {CHARACTERS}")
    glyphs = HandwritingGlyphs(
        characters=character, writers=1, first_writer=TRAIN_WRITERS, target_plane=TargetPlane(size_px=_SIDE)
    )
    return glyphs.target(glyphs.objects()[0])


def drawn(ink: str, size_m: float = 0.08) -> Target:
    """Return a drawing as a target that shines where there is ink.

    Args:
        ink: `INK_SIDE` rows of as many values, row 0 on top, two hexadecimal digits each: 00 nothing, ff full.
        size_m: Side of the target plane, metres.

    Raises:
        DataError: There is no ink, or the text is no drawing.

    Example:
        >>> drawn("00" * 512 + "ff" * 256 + "00" * 256).mask.mean()
        np.float32(0.25)
    """
    if not ink:
        raise DataError(_EMPTY)
    wanted = 2 * INK_SIDE**2
    if len(ink) != wanted or not set(ink) <= set("0123456789abcdef"):
        raise DataError(f"the drawing is a text of {len(ink)} characters; give {wanted} hexadecimal digits")
    values = np.frombuffer(bytes.fromhex(ink), np.uint8).reshape(INK_SIDE, INK_SIDE)
    mask = values.astype(np.float32) / np.float32(255)
    if mask.mean() < _LEAST_INK:
        raise DataError(_EMPTY)
    return Target("drawing", mask, size_m)


FILM_PLANE = Plane(16, 16, 0.005)
"""The hidden plane that changes, in cells of a reconstruction: 8 cm, as a target."""
_FINE = Plane(2 * FILM_PLANE.height, 2 * FILM_PLANE.width, FILM_PLANE.pitch_m / 2)  # cells of the simulation


def _hand() -> Film:
    """Return a hand that closes and opens twice."""
    shapes = [closing_hand(closed, _FINE.width) for closed in np.linspace(0, 1, 17)]
    once = [*shapes, *shapes[-2::-1]]
    images = [*once, *once[1:]]
    return Film(np.stack(images), np.linspace(0, 1, len(images)))


def _screen() -> Film:
    """Return a screen that shows four pictures, each fading into the next."""
    pictures = [drawing(kind, 0, 0, _FINE.width) for kind in ("icon", "person", "vehicle", "doodle")]
    return Film(
        np.stack([one for one in pictures for _ in range(2)]), [0, 0.19, 0.27, 0.46, 0.54, 0.73, 0.81, 1]
    )


FILMS: dict[str, Callable[[], Film]] = {"closing hand": _hand, "screen that fades": _screen}
"""Hidden planes that change, by name; a film lasts from 0 to 1."""


@lru_cache(maxsize=8)
def _shown(name: str) -> Film:
    return FILMS[name]()


@lru_cache(maxsize=16)
def _film_path(setup: RadiometricSetup) -> MatrixTransport:
    return matrix_of(setup.operator(_FINE))


_TOLERANCE = 0.03  # thresholds: the eye sees no difference to the default, which takes longer


@dataclass(frozen=True, eq=False)
class Recorded:
    """One sequence: events, the instants of its positions, and what else is known.

    Args:
        name: What to call it.
        events: Its events.
        edges_us: N + 1 ascending instants, int64, microseconds; position k has the events in
            (edge k, edge k + 1].
        frames: One frame a position, digital numbers, [N, H, W]; None where there were no frames.
        peak: Largest digital number of a frame.
        motion: The hidden object's motion on the events' clock; None where it is unknown.
        target: The hidden object; None where it is unknown.
        simulation: The setup, where it is known.
        distance_m: From hidden object to wall, metres, where it is noted.
        notes: What reading did, a line each.
        film: What a hidden plane shows that changes; None of an object that moves, and where it is unknown.
    """

    name: str
    events: Events
    edges_us: NDArray[np.int64]
    frames: NDArray | None = None
    peak: int = 255
    motion: Motion | None = None
    target: Target | None = None
    simulation: Simulation | None = None
    distance_m: float | None = None
    notes: tuple[str, ...] = field(default=())
    film: Film | None = None

    def __len__(self) -> int:
        return len(self.edges_us) - 1

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Instant of each position, [N], seconds."""
        return self.edges_us[1:].astype(np.float64) * 1e-6

    def samples(self, sampling: Sampling) -> Samples:
        """Return what a network sees at each position; frames are black where there are none."""
        blank = np.zeros((len(self), *self.events.shape), np.uint8) if self.frames is None else self.frames
        return make_samples(
            blank, self.peak, self.events, self.edges_us, sampling, motion=self.motion, target=self.target
        )

    def truth(self, sampling: Sampling) -> NDArray[np.float32] | None:
        """Return the hidden object on a canvas's scored rows, float32 [N, h, w], 0..1; None where unknown."""
        if self.motion is None or self.target is None:
            return None
        places = self.motion.position_m(self.times_s)
        return self.target.rasterise(sampling.canvas, places)[:, sampling.scored]


def simulate_sequence(controls: Controls, target: Target) -> Recorded:
    """Simulate one sequence of a hidden object.

    Args:
        controls: Setup and camera.
        target: What is hidden.

    Raises:
        ConfigError: The setup is geometrically impossible, or the camera gets no light.
    """
    simulation = controls.simulation()
    scene = Scene(target, simulation.motion, simulation.duration_s)
    wall, times_s = simulation.setup.observe(scene), scene.position_times_s(simulation.positions)
    seen = _recorded(controls, simulation, wall, times_s, target.name)
    return replace(seen, motion=scene.motion, target=target)


def simulate_film(controls: Controls, name: str) -> Recorded:
    """Simulate one sequence of a hidden plane that changes, once from beginning to end.

    Args:
        controls: Setup and camera; the speed says how long it takes, as of an object that moves.
        name: One of `FILMS`.

    Raises:
        ConfigError: The setup is geometrically impossible, or the name is none.
    """
    if name not in FILMS:
        raise ConfigError(f"the hidden film is {name[:20]!r}; give {' or '.join(FILMS)}")
    simulation = controls.simulation()
    setup, seconds = simulation.setup, simulation.duration_s
    film = Film(_shown(name).images, seconds * np.asarray(_shown(name).times_s))
    # No edge goes more than half the image in the quarter of the film in which a hand closes.
    speed = 2 * setup.sensor.width / seconds
    path = _film_path(replace(setup.optics(), sensor=setup.sensor))
    wall = FilmWall(path, film, ambient=setup.ambient_light(), speed_px_s=speed)
    times_s = np.arange(1, POSITIONS + 1) * seconds / POSITIONS
    return replace(_recorded(controls, simulation, wall, times_s, name), film=film)


def _recorded(
    controls: Controls, simulation: Simulation, wall: Irradiance, times_s: NDArray[np.float64], name: str
) -> Recorded:
    """Return what the cameras record of a wall."""
    camera = simulation.frame_camera
    events = EventCamera(simulation.pixel, _TOLERANCE, simulation.setup.time_step_s).record(
        wall, 0.0, simulation.duration_s, seed=derive_seed(controls.seed, "events")
    )
    frames = camera.capture(wall, times_s, seed=derive_seed(controls.seed, "frames"))
    return Recorded(name, events, edges_from(times_s), frames, camera.white, simulation=simulation)
