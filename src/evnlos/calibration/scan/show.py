"""A scan as a show: one page or video on a monitor, to be filmed by a phone; its flashes tell the time.

The show begins and ends with the same code of flashes; between them it holds every pattern of the scan for the
same time, then images that tell the film's tone curve, and then moves characters over the plane. It can be
rehearsed: filmed by a pretended phone in front of a known wall.
"""

from __future__ import annotations

import base64
import io
import json
import math
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from evnlos.calibration.scan.folder import (
    ScanFrame,
    ScanInfo,
    cell_edges,
    displayed,
    lit_cells,
    read_scan_frames,
    read_scan_info,
)
from evnlos.cameras.video_files import write_video
from evnlos.config import load_yaml
from evnlos.errors import ConfigError
from evnlos.lab import Phone
from evnlos.machine import Progress, Step, silent
from evnlos.scene import FontGlyphs, LineMotion, Scene, Target
from evnlos.setups import Setup
from evnlos.types import Plane, derive_seed

SHOW_FILE = "show.yaml"
CODE = (1, 0, 0, 0, 1, 0, 0, 1, 1, 0, 1, 0, 1, 1, 1)
"""The flashes: a sequence of x^4 + x + 1 (Golomb, 1967), which looks like itself at one place only."""
_LEAD_S, _REST_S = 2.0, 1.0
_TARGET_PX = 128  # side of a character's image
_SPEED_M_S = (0.001, 1.0)


@dataclass(frozen=True)
class ShowInfo:
    """What `show.yaml` holds: the time of a show, and the display that it is made for."""

    hold_s: float = 0.5
    """How long a pattern stands, seconds."""
    chip_s: float = 0.2
    """How long a flash of the code stands, seconds."""
    targets: str = ""
    """Characters that move over the plane after the scan, one after the other."""
    target_m: float = 0.06
    """Side of such a character's square, metres."""
    speed_m_s: float = 0.02
    """Their speed from left to right, metres per second."""
    display: tuple[int, int] | None = None
    """Width and height of the display, pixels."""
    display_pitch: float = 0.00027
    """Side of a display pixel, metres."""

    def __post_init__(self) -> None:
        for name, (low, high) in {
            "hold_s": (0.2, 60.0),
            "chip_s": (0.1, 2.0),
            "target_m": (0.001, 10.0),
            "speed_m_s": _SPEED_M_S,
        }.items():
            if not low <= getattr(self, name) <= high:
                raise ConfigError(f"show.{name} is {getattr(self, name)}; give {low:g} to {high:g}")
        if len(set(self.targets)) != len(self.targets) or len(self.targets) > 100:
            raise ConfigError(f"show.targets is {self.targets!r}; give up to 100 characters, each once")


Kind = Literal["code", "rest", "pattern", "check", "target"]


@dataclass(frozen=True)
class Part:
    """A stretch of the show.

    Args:
        kind: "code" and "rest", "pattern" (an image of frames.csv), "check" (the tone curve's), or "target".
        start_s: When it begins, seconds from the show's begin.
        stop_s: When it ends.
        number: Which flash, image, check or target.
    """

    kind: Kind
    start_s: float
    stop_s: float
    number: int = 0


@dataclass(frozen=True)
class Show:
    """What a display shows at each instant.

    Args:
        info: The scan.
        scan_frames: Its images, in order.
        show: Time and display.

    Raises:
        ConfigError: A character is wider than the plane.
    """

    info: ScanInfo
    scan_frames: tuple[ScanFrame, ...]
    show: ShowInfo = field(default_factory=ShowInfo)

    def __post_init__(self) -> None:
        height, width = self.info.plane.extent_m
        if self.show.targets and not self.show.target_m <= min(height, width) * 1.001:
            found = f"show.target_m is {self.show.target_m:g} m, the plane {width:g} x {height:g} m"
            raise ConfigError(f"{found}; give smaller characters or a larger --plane")

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """The stretches, one after the other without gaps."""
        hold, chip = self.show.hold_s, self.show.chip_s
        code: list[tuple[Kind, float, int]] = [("code", chip, k) for k in range(len(CODE))]
        moving: list[tuple[Kind, float, int]] = []
        for k in range(len(self.show.targets)):
            moving.append(("rest", _REST_S, 0))
            moving.append(("target", self.scenes[k].duration_s, k))
        order: list[tuple[Kind, float, int]] = [
            ("rest", _LEAD_S, 0),
            *code,
            ("rest", _REST_S, 0),
            *(("pattern", hold, k) for k in range(len(self.scan_frames))),
            *(("check", hold, k) for k in range(len(CHECKS))),
            *moving,
            ("rest", _REST_S, 0),
            *code,
            ("rest", _LEAD_S, 0),
        ]
        found, time = [], 0.0
        for kind, length, number in order:
            found.append(Part(kind, time, time + length, number))
            time += length
        return tuple(found)

    @property
    def duration_s(self) -> float:
        """Length of the show, seconds."""
        return self.parts[-1].stop_s

    @cached_property
    def checks(self) -> tuple[NDArray[np.bool_], ...]:
        """What the images for the tone curve light, [h, w] each: see `CHECKS`."""
        height, width = self.info.plane.shape
        draw = np.random.default_rng(derive_seed(0, "checks"))
        cells = height * width
        left = np.broadcast_to(np.arange(width) < width / 2, (height, width))
        mixed, few = (draw.permutation(cells).reshape(height, width) for _ in range(2))
        lit = {"none": mixed < 0, "all": mixed >= 0, "left": left, "right": ~left}
        lit |= {"half": mixed < cells // 2, "rest": mixed >= cells // 2}
        lit |= {"quarter": few < cells // 4, "three": few >= cells // 4}
        return tuple(lit[name] for name in CHECKS)

    @property
    def motion(self) -> LineMotion:
        """How a character moves, from its begin on: over the plane's width, through its middle."""
        x, y = self.info.plane.center_m
        return LineMotion((x - self._way_m / 2, y), self.show.speed_m_s)

    @cached_property
    def scenes(self) -> tuple[Scene, ...]:
        """The characters of the show and their motion, one after the other."""
        duration_s = max(self._way_m / self.show.speed_m_s, 0.5)
        found = []
        for name in self.show.targets:
            glyphs = FontGlyphs(characters=name)
            target = Target(name, glyphs.target(glyphs.objects()[0]).mask, self.show.target_m)
            found.append(Scene(target, self.motion, duration_s))
        return tuple(found)

    @property
    def _way_m(self) -> float:
        return max(self.info.plane.extent_m[1] - self.show.target_m, 0.0)

    def part_at(self, t_s: float) -> Part:
        """Return the stretch at an instant, seconds from the show's begin; the nearest one outside it."""
        return self.parts[max(bisect_right(self.parts, t_s, key=lambda part: part.start_s) - 1, 0)]

    def cells(self, part: Part) -> NDArray[np.float32]:
        """Return the brightness of the cells in a stretch without a target, float32 [h, w]."""
        if part.kind == "check":
            return self.checks[part.number].astype(np.float32)
        pattern = self.scan_frames[part.number].pattern if part.kind == "pattern" else None
        if pattern is not None:
            return lit_cells(self.info, pattern).astype(np.float32)
        return np.full(self.info.plane.shape, CODE[part.number] if part.kind == "code" else 0, np.float32)


CHECKS = ("none", "left", "right", "half", "rest", "quarter", "three", "all", "left", "right", "none")
"""The images that tell the tone curve: what each lights. Light adds up, so that those of a pair have to give
what all cells give; the first pair comes once more after the brightest, by which a changing exposure shows."""
PAIRS = ((1, 2), (3, 4), (5, 6), (8, 9))
"""Numbers of the checks that complete one another."""


def read_show(folder: str | Path) -> Show:
    """Read the show of a scan's folder.

    Args:
        folder: The folder.

    Raises:
        ConfigError: show.yaml is missing, or has an unknown key, a wrong type or a value out of range.
    """
    folder, info = Path(folder), read_scan_info(folder)
    if not (folder / SHOW_FILE).is_file():
        cure = "plan it with --show page or video"
        raise ConfigError(f"{folder} holds no {SHOW_FILE}, so a film of it tells no time; {cure}")
    return Show(info, tuple(read_scan_frames(folder, info)), load_yaml(ShowInfo, folder / SHOW_FILE))


def shown_image(show: Show, part: Part, t_s: float) -> NDArray[np.uint8]:
    """Return what the display shows at an instant, uint8 [rows, columns]."""
    display, pitch = show.show.display, show.show.display_pitch
    assert display is not None  # refused before
    if part.kind != "target":
        return displayed(show.cells(part), show.info.plane, display, pitch)
    scene, side = show.scenes[part.number], max(1, round(show.show.target_m / pitch))
    x, y = scene.motion.position_m(t_s - part.start_s) - np.asarray(show.info.plane.center_m)
    canvas = Image.new("L", display)
    place = (round(x / pitch + (display[0] - side) / 2), round(y / pitch + (display[1] - side) / 2))
    canvas.paste(_target_image(scene.target).resize((side, side), Image.Resampling.BOX), place)
    return np.asarray(canvas)


def show_images(show: Show, fps: float) -> Iterator[NDArray[np.uint8]]:
    """Yield what the display shows, an image a frame at `fps`; the same array while nothing changes."""
    before: Part | None = None
    picture = np.zeros((1, 1), np.uint8)
    for number in range(math.ceil(show.duration_s * fps)):
        t_s = (number + 0.5) / fps
        part = show.part_at(t_s)
        if part is not before or part.kind == "target":
            picture, before = shown_image(show, part, t_s), part
        yield picture


def show_page(show: Show) -> str:
    """Return the show as a page that needs nothing but itself; cells are drawn in the display's own pixels."""
    assert show.show.display is not None  # refused before
    plane = show.info.plane
    y, x = cell_edges(plane, show.show.display, show.show.display_pitch)
    pictures, parts, known = [], [], dict[bytes, int]()
    for part in show.parts:
        if part.kind == "target":
            way = show.scenes[part.number].motion.position_m(np.array([0.0, part.stop_s - part.start_s]))
            ends = (way - np.asarray(plane.center_m)) / show.show.display_pitch
            parts.append([round(part.start_s, 4), -1 - part.number, *ends.ravel().round(3).tolist()])
            continue
        bits = np.packbits(show.cells(part).ravel() > 0).tobytes()
        if bits not in known:
            known[bits] = len(pictures)
            pictures.append(base64.b64encode(bits).decode())
        parts.append([round(part.start_s, 4), known[bits]])
    data = {
        "display": show.show.display,
        "rows": y.tolist(),
        "columns": x.tolist(),
        "pictures": pictures,
        "parts": parts,
        "duration_s": show.duration_s,
        "side": show.show.target_m / show.show.display_pitch,
        "bar_px": 0.1 / show.show.display_pitch,
        "targets": [_as_url(_target_image(scene.target)) for scene in show.scenes],
    }
    page = (Path(__file__).parent / "show.html").read_text(encoding="utf-8")
    return page.replace('"{show}"', json.dumps(data))


def _target_image(target: Target) -> Image.Image:
    image = Image.fromarray(np.round(255 * target.mask).astype(np.uint8))
    return image.resize((_TARGET_PX, _TARGET_PX), Image.Resampling.LANCZOS)


def _as_url(image: Image.Image) -> str:
    data = io.BytesIO()
    image.save(data, "PNG")
    return f"data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}"


_STATES = 32  # images that are kept
_FINER = 3
BEGIN_S = 1.5  # a rehearsed show begins this long after the film
_KEY_S = 0.1  # between the instants at which a moving character's light is computed


class FilmedShow:
    """The light of a show on a wall of a known setup, as a phone sees it (`lab.FilmedLight`).

    Args:
        show: The show.
        matrix: White levels for each cell of a plane at full brightness, float32 [H W, cells].
        plane: Those cells, each a whole fraction of one of the scan's, which they cover.
        ambient: Light that is always there, white levels, float32 [H, W].
    """

    def __init__(self, show: Show, matrix: NDArray, plane: Plane, ambient: NDArray) -> None:
        self._show, self._matrix, self._plane, self._ambient = show, matrix, plane, ambient
        self._known: dict[tuple[Part, int], NDArray[np.float32]] = {}

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the image, pixels."""
        return self._ambient.shape[0], self._ambient.shape[1]

    def at(self, t_s: float) -> NDArray[np.float32]:
        """Return the light at an instant, white levels, float32 [H, W]."""
        show_s = t_s - BEGIN_S
        part = self._show.part_at(show_s)
        if part.kind != "target":
            return self._light(part, 0)
        place = (min(max(show_s, part.start_s), part.stop_s) - part.start_s) / _KEY_S
        first = int(place)
        before = self._light(part, first)
        mixed = before + (self._light(part, first + 1) - before) * np.float32(place - first)
        return mixed.astype(np.float32)

    def _light(self, part: Part, key: int) -> NDArray[np.float32]:
        name = (part, key)
        if name not in self._known:
            if len(self._known) >= _STATES:
                self._known.pop(next(iter(self._known)))
            if part.kind == "target":
                scene = self._show.scenes[part.number]
                cells = scene.target.rasterise(self._plane, scene.motion.position_m(key * _KEY_S))
            else:
                finer = self._plane.height // self._show.info.plane.height
                cells = np.kron(self._show.cells(part), np.ones((finer, finer)))
            image = (self._matrix @ cells.astype(np.float32).ravel()).reshape(self.shape)
            self._known[name] = image + self._ambient
        return self._known[name]


def rehearse_film(
    folder: str | Path,
    setup: Setup,
    phone: Phone | None = None,
    shape: tuple[int, int] = (144, 256),
    *,
    level: float = 0.5,
    ambient: float = 0.04,
    seed: int = 0,
    progress: Progress = silent,
) -> Path:
    """Film the show of a planned scan with a known setup, as a phone would, and return the film: film.mp4.

    Characters are drawn with three times as many cells a side as the scan has; the room's own light is uneven.

    Args:
        folder: A folder that `write_plan` wrote, with a show.
        setup: A linear setup.
        phone: The phone; None is the default.
        shape: Size (H, W) of the film, pixels.
        level: White levels of the brightest pixel while all cells shine.
        ambient: Light that is always there, white levels.
        seed: Seed of noise and shake.
        progress: Called as the work goes on.
    """
    progress(Step("light path", 0, 1, "matrices"))
    folder, phone, show = Path(folder), phone or Phone(), read_show(folder)
    cells = show.info.plane
    fine = Plane(cells.height * _FINER, cells.width * _FINER, cells.pitch_m / _FINER, cells.center_m)
    matrix = setup.seen_by(shape).operator(fine, shape, torch.float32).dense(torch.float32).numpy()
    matrix = matrix * np.float32(level / max(float(matrix.sum(axis=1).max()), 1e-12))
    y, x = (np.linspace(-1, 1, side) for side in shape)
    spot = np.exp(-((x + 0.5) ** 2 + (y[:, None] + 0.4) ** 2) / 0.02)
    room = (ambient * (1 + 0.2 * x + 0.1 * y[:, None] + 0.8 * spot)).astype(np.float32)
    light = FilmedShow(show, matrix, fine, room)
    length = show.duration_s + 2 * BEGIN_S
    total = round(length * phone.frame_rate_hz)

    def frames() -> Iterator[NDArray[np.uint8]]:
        for number, frame in enumerate(phone.film(light, length, seed)):
            if number % 30 == 0:
                progress(Step("film", number, total, "frames"))
            yield frame

    write_video(folder / "film.mp4", frames(), phone.frame_rate_hz, phone.quality, "fast")
    progress(Step("film", total, total, "frames"))
    return folder / "film.mp4"
