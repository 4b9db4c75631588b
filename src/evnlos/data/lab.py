"""Synthetic captures of a rendered laboratory, whose sensor is drawn from ranges of its own.

- Pseudo-real captures: recordings that the training simulator did not make, for people without a camera.
- Published sets of them, by name, whose content is known by its SHA-256.
"""

from __future__ import annotations

import re
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from evnlos.cameras import EventPixel, FrameCamera, LogFrameCamera, V2ePixel, mosaicked
from evnlos.config import check_made, differing_keys, from_dict, read_yaml, save_yaml, to_dict
from evnlos.data.capture_info import balances
from evnlos.data.pool import processes, run_tasks
from evnlos.data.sampling import character_of, mask_file, stated_targets
from evnlos.data.simulate import check_ranges, check_sequences, ranges_around, sequence_bytes, varied
from evnlos.errors import ConfigError, DataError
from evnlos.events import write_events
from evnlos.files import new_folder
from evnlos.machine import Progress, Step, silent
from evnlos.registry import __version__
from evnlos.scene import FontGlyphs, Glyphs, LineMotion, OtherTarget, Scene, SeveralTargets, with_others
from evnlos.scene.fonts import find_font
from evnlos.setups import RadiometricSetup, Setup, named_setup, setup_preset
from evnlos.setups.load import is_name
from evnlos.types import COLOURS, LUMA_601, Irradiance, Mosaic, derive_seed

_PUBLISHED_GAIN = {"near": 1.7, "far": 1.0}  # white levels of the brightest pixel

SENSOR_SPREAD: dict[str, tuple[float, float]] = {
    "setup.pixel.threshold_on": (0.18, 0.28),
    "setup.pixel.threshold_off": (0.20, 0.30),
    "setup.pixel.threshold_sigma": (0.035, 0.06),
    "setup.pixel.cutoff_hz": (25.0, 90.0),
    "setup.pixel.leak_rate_hz": (0.02, 0.15),
    "setup.pixel.shot_noise_rate_hz": (0.03, 0.20),
    "setup.pixel.refractory_s": (2e-4, 1.5e-3),
    "setup.pixel.hot_pixel_fraction": (0.0, 4e-4),
    "setup.pixel.jitter_s": (2e-5, 2e-4),
    "setup.frame_camera.exposure_s": (0.012, 0.030),
    "setup.frame_camera.full_well_e": (6_000.0, 12_000.0),
    "setup.frame_camera.read_noise_e": (8.0, 16.0),
    "setup.frame_camera.prnu": (0.012, 0.025),
    "setup.frame_camera.dsnu_e": (5.0, 15.0),
}
"""Uniform ranges of a setup's sensor.

The training simulator has mismatch 0.03, leak 0.01 Hz, no dead time, no hot pixels, no jitter, 15,000
electrons, 6 electrons of read noise, 1 % and 3 electrons of fixed pattern, 10 ms of exposure. No range holds
these but that of the hot pixels, which begins there. Thresholds, bandwidth and shot noise, which it draws from
wide ranges itself, lie inside those.
"""


LIGHT = {"gain": 0.7, "ambient": 0.06, "ambient_gradient": (0.3, -0.2)}
"""Light of the lab: dimmer and less even than in the training simulator."""
_CAMERAS = {
    "frame_camera": FrameCamera(exposure_s=0.016, full_well_e=9000.0, read_noise_e=12.0),
    "pixel": EventPixel(0.21, 0.24, 0.04, 40.0, leak_rate_hz=0.05, shot_noise_rate_hz=0.08, refractory_s=5e-4),
}

_SKETCH = (6, 10)  # pixels
_WAVELENGTHS_M = 650e-9, 550e-9, 450e-9  # of `COLOURS`


def in_the_lab(setup: Setup) -> Setup:
    """Return a wall and its geometry in the lab's light, before the lab's cameras."""
    return replace(setup, **LIGHT, **_CAMERAS)


@dataclass(frozen=True)
class Lab:
    """A rendered laboratory: a wall of metal or paint instead of a tPSF, and other cameras."""

    name: str = "lab"
    """Name of the setup; captures are called NAME_A, NAME_B, ..."""
    glyphs: Glyphs = field(default_factory=FontGlyphs)
    """What is hidden."""
    motion: LineMotion = field(default_factory=LineMotion)
    """How it moves."""
    others: tuple[OtherTarget, ...] = ()
    """Targets that are there beside each object; in a settings file alone."""
    cover: bool = False
    """Whether a later target hides those before it as far as it shines itself; else their light adds."""
    duration_s: float = 8.0
    """Length of a sequence, seconds."""
    frame_rate_hz: float = 5.0
    """Frames per second, hertz; a sequence of 8 s has the 40 positions of the paper."""
    setup: Setup = field(default_factory=lambda: in_the_lab(RadiometricSetup()))
    """Wall, geometry, light and cameras; a linear frame camera has 8 bits as captures have, and the event pixel
    is on purpose not that of the training simulator."""
    spread: dict[str, tuple[float, float]] = field(default_factory=lambda: dict(SENSOR_SPREAD))
    """Settings drawn once for the setup, uniformly: dotted name -> (low, high); {} takes them as they stand."""
    seed: int = 0
    """Seed of every draw, the sensor's own settings among them."""
    palette: tuple[str, ...] = ()
    """Colours of each object in bands from its top, RRGGBB, hexadecimal shares of white light; with any, frames
    are in colour, and events of the luma unless there is an `event_mosaic`."""
    mosaic: Mosaic | None = None
    """Colour filters of the frame camera; without them each pixel of a coloured frame sees all colours."""
    event_mosaic: Mosaic | None = None
    """Colour filters of the event camera; without them each pixel sees the luma."""
    white_balance: tuple[float, float, float] = (0.8, 1.0, 0.6)
    """What colour filters let through of white: red, green and blue, up to a factor."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", self.name):
            raise ConfigError(f"Lab.name is {self.name!r}; give letters, digits, '.', '_' or '-'")
        for name, unit in (("duration_s", "seconds"), ("frame_rate_hz", "hertz")):
            if not 0 < (value := getattr(self, name)) < float("inf"):
                raise ConfigError(f"Lab.{name} is {value}; give a positive number of {unit}")
        if self.duration_s * self.frame_rate_hz < 1:
            raise ConfigError(
                f"Lab.duration_s is {self.duration_s} s at {self.frame_rate_hz} Hz; a sample needs two frames"
            )
        if isinstance(camera := self.setup.frame_camera, LogFrameCamera):
            if self.is_coloured:
                raise ConfigError("Lab has a palette or mosaic, and frames of kind log are grey; leave one out")
        elif camera.bit_depth != 8:
            raise ConfigError(f"Lab.setup.frame_camera.bit_depth is {camera.bit_depth}; captures hold 8 bits")
        for one in self.palette:
            if not re.fullmatch(r"[0-9A-Fa-f]{6}", one):
                raise ConfigError(f"Lab.palette has {one!r}; give six hexadecimal digits, such as ff8000")
        if not all(0 < one < float("inf") for one in self.white_balance):
            raise ConfigError(f"Lab.white_balance is {self.white_balance}; give three numbers above 0")
        _ = self.setup.event_camera  # refuses a step that does not fit the model
        check_ranges(self, self.ranges)
        check_made(self)

    @property
    def is_coloured(self) -> bool:
        """Whether its frames are in colour."""
        return bool(self.palette) or self.mosaic is not None

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """`spread` without those of `SENSOR_SPREAD` whose settings the chosen kinds of cameras do not have."""
        there = ranges_around(self, dict.fromkeys(self.spread, 0.0))
        return {p: ends for p, ends in self.spread.items() if p in there or ends != SENSOR_SPREAD.get(p)}

    def drawn(self) -> Lab:
        """Return the lab with its sensor's settings drawn from `spread`: a function of the seed and the name.

        Example:
            >>> one, other = Lab(seed=1).drawn(), Lab(seed=2).drawn()
            >>> one.setup.pixel == other.setup.pixel, 0.18 <= one.setup.pixel.threshold_on <= 0.28, one.spread
            (False, True, {})
        """
        if not self.spread:
            return self
        pattern = derive_seed(self.seed, self.name, "fixed pattern")
        camera = replace(self.setup.frame_camera, pattern_seed=pattern)  # type: ignore[type-var]
        own = replace(self, setup=replace(self.setup, frame_camera=camera))
        return replace(varied(own, self.ranges, self.seed, self.name), spread={})


def lab_of(word: str | Path, lab: Lab | None = None) -> Lab:
    """Return the lab with the setup of a word (see `load_setup`), and its name.

    Args:
        word: A name, which leaves light and cameras to the lab, the name of a room, or a file or folder, which
            state all. A room's cameras are as stated, with no `spread`.
        lab: All other settings; None is the default lab.

    Raises:
        ConfigError: The word names no setup.
    """
    lab = Lab() if lab is None else lab
    found = named_setup(word)
    name = re.sub(r"[^A-Za-z0-9._-]", "-", found.name).lstrip(".-_") or lab.name
    if not is_name(word):
        return replace(lab, name=name, setup=found.setup)
    setup = replace(found.setup, sensor=lab.setup.sensor)
    if setup.is_lit:
        return replace(lab, name=name, setup=setup, spread={})
    return replace(lab, name=name, setup=in_the_lab(setup))


def published_lab(name: str, asked: Lab | None = None) -> Lab:
    """Return the lab of a published set of 36 captures, "near" (0.30 m) or "far" (0.50 m).

    Wall, geometry and light are those that the calibration of the documentation's recordings found, in round
    numbers. The sensor is v2e's pixel in steps of 4 ms, with a camera whose pattern is fixed.

    Args:
        name: Name of the set.
        asked: The default lab, with the characters to render where they are not all.

    Raises:
        ConfigError: There is no set of this name, or `asked` differs in more than its characters.
        MissingDependencyError: The font (of `evnlos[fonts]`) is not installed.
    """
    if name not in _PUBLISHED_GAIN:
        raise ConfigError(f"there is no published set {name!r}; give one of {', '.join(_PUBLISHED_GAIN)}")
    characters = getattr((asked or Lab()).glyphs, "characters", "")
    if asked is not None and asked != replace(Lab(), glyphs=FontGlyphs(characters=characters)):
        raise ConfigError(f"the set {name!r} states all settings; give --glyphs.characters beside it at most")
    glyphs = FontGlyphs(family="Nunito Bold", characters=characters)
    find_font(glyphs.family, strict=True)
    setup = replace(
        setup_preset(f"main-{name}"),
        gain=_PUBLISHED_GAIN[name],
        ambient=0.055,
        ambient_gradient=(0.1, 0.0),
        frame_camera=FrameCamera(0.016, 10_000.0, 12.0, prnu=0.02, dsnu_e=10.0, pattern_seed=28),
        pixel=V2ePixel(0.19, 0.22, 0.04, 40.0, 0.02, 0.3, 1e-3, pattern_seed=28),
        time_step_s=0.004,
    )
    return Lab(name=name, glyphs=glyphs, setup=setup, spread={}, seed=28)


def render_captures(
    lab: Lab,
    out: str | Path,
    names: list[str] | None = None,
    workers: int = 1,
    progress: Progress = silent,
    force: bool = False,
    record: str = "lab.yaml",
) -> list[Path]:
    """Render one capture folder per object, and `lab.yaml` beside them.

    A capture that exists is done and is kept, so that a run can be taken up again; the captures are the same
    for any number of workers.

    Args:
        lab: Setup, cameras and objects.
        out: The folder for the captures; new, or begun with the same settings (other characters may be added).
        names: Objects of `lab.glyphs`; all by default.
        workers: Processes; 0 means one for each core.
        progress: Called when the work begins and as each capture is in place, with its folder.
        force: Whether to begin although the machine's memory will hardly do.
        record: Name of the file with the settings; labs whose files have different names share a folder.

    Returns:
        The capture folders, in the order of `names`.

    Raises:
        DataError: `out` is a file, or was begun with other settings, or holds a folder in a capture's place, or
            the captures that are rendered at a time take more memory than there is.
        ConfigError: The setup is geometrically impossible.
    """
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise DataError(f"{out} is a file; give a folder for the captures")
    drawn = lab.drawn()
    names = lab.glyphs.objects() if names is None else names
    at_once = processes(workers, max(len(names), 1))
    if not force:
        frames = round(lab.duration_s * lab.frame_rate_hz) + 1
        check_sequences(
            sequence_bytes(drawn.setup, lab.glyphs.target_plane.size_m, lab.duration_s, frames), at_once
        )
    folders = {name: out / _folder_name(lab, name) for name in names}
    for folder in folders.values():
        if folder.exists() and not (folder / "capture.yaml").is_file():
            raise DataError(f"{folder} is there without a capture.yaml; move it away, it is no capture")
    # A wrong setup is an error before anything is written; a few pixels are enough to find it.
    if names:
        drawn.setup.resized(_SKETCH).observe_all(_scene(drawn, names[0]))
    out.mkdir(parents=True, exist_ok=True)
    _record(lab, drawn, out / record)
    missing = [(drawn, name, folder) for name, folder in folders.items() if not folder.is_dir()]
    what, total, there = f"render {out.name}", len(folders), len(folders) - len(missing)
    progress(Step(what, there, total, "captures"))
    with closing(run_tasks(_render, missing, workers)) as finished:
        for done, folder in enumerate(finished, start=there + 1):
            progress(Step(what, done, total, "captures", folder))
    return list(folders.values())


def _record(lab: Lab, drawn: Lab, path: Path) -> None:
    """Write the settings, or refuse a folder that was begun with other ones."""
    asked = to_dict(lab)
    if path.is_file():
        before = read_yaml(path).get("lab")
        differing = ["lab: missing"]
        if isinstance(before, dict):
            differing = differing_keys(asked, to_dict(from_dict(Lab, before, source=str(path))))
        differing = [line for line in differing if not line.startswith("glyphs.characters:")]
        if differing:
            raise DataError(
                f"{path.parent} was begun with other settings ({'; '.join(differing[:3])}); give another folder"
            )
    sensor = {"pixel": to_dict(drawn.setup.pixel), "frame_camera": to_dict(drawn.setup.frame_camera)}
    save_yaml({"evnlos": __version__, "lab": asked, "drawn": sensor}, path)


def _folder_name(lab: Lab, name: str) -> str:
    """Return NAME_A for a font, which shows each character once, and NAME_object for other glyphs."""
    return f"{lab.name}_{character_of(name) if isinstance(lab.glyphs, FontGlyphs) else name}"


def _scene(lab: Lab, name: str) -> Scene | SeveralTargets:
    scene = Scene(lab.glyphs.target(name, lab.seed), lab.motion, lab.duration_s)
    return with_others(scene, lab.others, lab.cover, lab.seed)


def _in_light(lab: Lab, scene: Scene | SeveralTargets, weights: ArrayLike) -> Scene | SeveralTargets:
    """Return the scene as light that counts red, green and blue by `weights`, which add up to 1, shows it."""
    if not lab.palette:
        return scene
    bands = np.array([list(bytes.fromhex(one)) for one in lab.palette]) @ np.asarray(weights) / 255
    shown = tuple(replace(one, target=one.target.banded(bands)) for one in scene.scenes)
    return replace(scene, scenes=shown) if isinstance(scene, SeveralTargets) else shown[0]


def _coloured_walls(lab: Lab, scene: Scene | SeveralTargets) -> list[Irradiance]:
    """Return the wall behind a filter of each of `COLOURS`."""
    walls = []
    for k, white in enumerate(balances(lab.white_balance)):
        light = {"gain": lab.setup.gain * white, "ambient": lab.setup.ambient * white}
        if hasattr(lab.setup, "wavelength_m"):
            light["wavelength_m"] = _WAVELENGTHS_M[k]
        walls.append(replace(lab.setup, **light).observe_all(_in_light(lab, scene, np.eye(3)[k])))
    return walls


def _frames(lab: Lab, walls: list[Irradiance], times_s: NDArray[np.float64], seed: int) -> NDArray:
    """Return frames [N, H, W] of one wall or behind a mosaic, or [N, H, W, 3]: one exposure per colour."""
    capture = lab.setup.frame_camera.capture
    if len(walls) == 1:
        return capture(walls[0], times_s, seed=seed)
    named = zip(COLOURS, walls, strict=True)
    stacked = np.stack([capture(one, times_s, seed=derive_seed(seed, name)) for name, one in named], axis=-1)
    return stacked if lab.mosaic is None else mosaicked(stacked, lab.mosaic)


class _FilteredWall:
    """The light of three walls, one a colour, behind Bayer filters: each pixel sees that of its own."""

    def __init__(self, walls: list[Irradiance], mosaic: Mosaic) -> None:
        self.walls, self.shape, self.speed_px_s = walls, walls[0].shape, max(one.speed_px_s for one in walls)
        self.mosaic: Mosaic = mosaic

    def irradiance(self, t_s: ArrayLike) -> torch.Tensor:
        light = torch.stack([one.irradiance(t_s) for one in self.walls], dim=-1)
        return torch.from_numpy(mosaicked(light.numpy(), self.mosaic))


def _render(task: tuple[Lab, str, Path]) -> Path:
    """Render a capture into a folder that is there whole or not at all."""
    lab, name, folder = task
    scene = _scene(lab, name)
    wall = lab.setup.observe_all(_in_light(lab, scene, np.array(LUMA_601) / sum(LUMA_601)))
    times_s = np.arange(round(lab.duration_s * lab.frame_rate_hz) + 1) / lab.frame_rate_hz
    seed = derive_seed(lab.seed, name)
    walls = _coloured_walls(lab, scene) if lab.is_coloured or lab.event_mosaic else []
    seen = _FilteredWall(walls, lab.event_mosaic) if lab.event_mosaic else wall
    events = lab.setup.event_camera.record(seen, 0.0, lab.duration_s, seed=derive_seed(seed, "events"))
    frames = _frames(lab, walls if lab.is_coloured else [wall], times_s, derive_seed(seed, "frames"))
    with new_folder(folder) as draft:
        (draft / "frames").mkdir()
        write_events(draft / "events.raw", events)
        rows = ["t_us,file"]
        for k, (time_s, frame) in enumerate(zip(times_s, frames, strict=True)):
            Image.fromarray(frame).save(draft / f"frames/{k:04d}.png")
            rows.append(f"{round(time_s * 1e6)},frames/{k:04d}.png")
        (draft / "frames.csv").write_text("\n".join(rows) + "\n")
        for k, one in enumerate(scene.scenes):
            colours = [_in_light(lab, one, weights).scenes[0].target.mask for weights in np.eye(3)]
            mask = np.stack(colours, axis=-1) if lab.palette else one.target.mask
            Image.fromarray(np.round(mask * 255).astype(np.uint8)).save(draft / mask_file(k))
        save_yaml(_description(lab, folder.name, scene), draft / "capture.yaml")
    return folder


def _description(lab: Lab, name: str, scene: Scene | SeveralTargets) -> dict[str, Any]:
    setup, camera = lab.setup, lab.setup.frame_camera
    distance_m = setup.default_distance_m if lab.motion.z_m is None else lab.motion.z_m
    return {
        "camera": {
            "name": "rendered laboratory",
            "width": setup.sensor.width,
            "height": setup.sensor.height,
            "frame_rate_hz": lab.frame_rate_hz,
            "exposure_s": camera.exposure_s,
            **{key: one for key in ("mosaic", "event_mosaic") if (one := getattr(lab, key))},
            **({"log": to_dict(camera.codes)} if isinstance(camera, LogFrameCamera) else {}),
            **({"white_balance": list(lab.white_balance)} if lab.is_coloured or lab.event_mosaic else {}),
        },
        "events": "events.raw",
        "frames": "frames.csv",
        **stated_targets(name, scene.scenes, lab.cover),
        "setup": {
            **({} if distance_m is None else {"distance_m": distance_m}),
            "wall": f"rendered: {setup.wall_description()}",
            "ambient": f"{setup.ambient:g} of the white level in the middle",
            "rendered": {"by": f"evnlos {__version__}", "seed": lab.seed, "setup": to_dict(setup)},
        },
    }
