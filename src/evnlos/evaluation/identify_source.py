"""From the name of a rig, or a file that describes one, to what `identify` needs."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from evnlos.calibration.summary import RIG_FILE, rig_file
from evnlos.config import from_dict, read_yaml
from evnlos.dataset import Simulation
from evnlos.dataset.lab import Lab
from evnlos.dataset.presets import PRESETS
from evnlos.errors import ConfigError
from evnlos.evaluation.identify_rig import AnyTransport
from evnlos.sensor import FrameCamera
from evnlos.transport import MeasuredTransport, PaperTransport, RadiometricTransport, rig_preset
from evnlos.transport.measured_file import SUFFIX
from evnlos.transport.rig import rig_names

_IN_A_FOLDER = ("rig", "lab", "dataset")  # files that are told apart by their folder


@dataclass(frozen=True)
class Described:
    """A rig and its frame camera.

    Args:
        name: Name of the rig, or of its file.
        transport: Its transport.
        camera: Its frame camera.
        word: What `--rig` takes for it: its name, or its file or folder without those above.
    """

    name: str
    transport: AnyTransport
    camera: FrameCamera
    word: str = ""


def described_rig(text: str | Path) -> Described:
    """Return the rig of a name ("main-near"; "simulate-paper" for a preset of `simulate`), a file or a folder.

    A file holds the settings of `evnlos simulate` or `evnlos lab` (of which `transport` and `frame_camera` are
    taken; what `vary` would draw stays as written), a dataset's `dataset.yaml`, a lab's `lab.yaml`, or the
    settings of a transport alone; or it is a measured transport (.safetensors). A folder that `evnlos
    calibrate` wrote stands for the `rig.yaml` in it.

    Raises:
        ConfigError: There is no such name and no such file, or the file holds something else.

    Example:
        >>> described_rig("hard-far").transport.roughness
        0.1
    """
    path = rig_file(Path(text))
    return replace(_read(path, str(text)), word=_word(path, str(text)))


def _word(path: Path, text: str) -> str:
    """Return how a rig is named on a command line, without the folders above it."""
    if not path.is_file():
        return text
    folder = path.resolve().parent.name
    if path.name == RIG_FILE:
        return folder
    return f"{folder}/{path.name}" if path.stem in _IN_A_FOLDER else path.name


def _read(path: Path, text: str) -> Described:
    if path.suffix == SUFFIX:
        return Described(path.stem, MeasuredTransport(file=str(path)), FrameCamera())
    if not path.is_file():
        if path.suffix in (".yaml", ".yml"):
            raise ConfigError(f"{path} does not exist; give a rig file or one of {', '.join(rig_names())}")
        preset = text.removeprefix("simulate-")
        if preset != text:
            if preset not in PRESETS:
                raise ConfigError(f"simulate has no preset {preset!r}; give one of {', '.join(PRESETS)}")
            simulation = PRESETS[preset]()
            return Described(text, simulation.transport, simulation.frame_camera)
        return Described(text, rig_preset(text), FrameCamera())
    name = path.resolve().parent.name if path.stem in _IN_A_FOLDER else path.stem
    values = read_yaml(path)
    if isinstance(values.get("lab"), dict):
        values = values["lab"]
    elif isinstance(values.get("config"), dict):
        values = values["config"]
    if "kind" in values:
        either: Any = PaperTransport | RadiometricTransport | MeasuredTransport
        return Described(name, from_dict(either, values, source=str(path)), FrameCamera())
    if "transport" not in values:
        near = difflib.get_close_matches("transport", [str(key) for key in values], n=1)
        hint = f"; perhaps {near[0]!r} is meant to be it" if near else ""
        raise ConfigError(
            f"{path} has no `transport`; give settings of `evnlos simulate` or `evnlos lab`{hint}"
        )
    lab_only = {item.name for item in fields(Lab)} - {item.name for item in fields(Simulation)}
    if lab_only & values.keys():
        lab = from_dict(Lab, values, source=str(path)).drawn()
        return Described(name, lab.transport, lab.frame_camera)
    simulation = from_dict(Simulation, values, source=str(path))
    return Described(name, simulation.transport, simulation.frame_camera)
