"""Names in settings files: the kinds that there are, and what older versions of this package called things.

A thing that a researcher swaps (a setup, an event model, a reconstructor) is described by a settings dataclass
with a field `kind`. The settings of one family share a base class derived from `Kinded`; a field of that type
takes the settings of any kind, from Python, YAML and the command line alike. A registry holds what ships with
the package, what a program registers, and what installed packages bring.

`from_dict` calls `migrate` for everything that it builds, so a YAML file of an older version loads like one of
today. Add a function to `_STEPS` for each change of a name or of a meaning; it sees the plain mapping.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import PackageNotFoundError, entry_points, version
from typing import Any, ClassVar, Generic, TypeVar

from evnlos.errors import ConfigError, UnknownNameError

T = TypeVar("T")
C = TypeVar("C")

NESTED = "within_kinded"
"""Type of a validation error within the settings of a kind; `loc` and `input` are in its context."""


class Registry(Generic[T]):
    """Classes, or other things that state a `kind`, by the name of their kind.

    Args:
        group: Entry-point group in which installed packages offer further kinds, e.g. "evnlos.event_models";
            an entry point's name is the kind, its object the class. It is loaded when its kind is requested.
        what: What a kind is one of, for messages, e.g. "event model".

    Example:
        >>> shapes = Registry("example.shapes", "shape")
        >>> @shapes.register
        ... class Ball:
        ...     kind = "ball"
        >>> shapes["ball"] is Ball, list(shapes)
        (True, ['ball'])
    """

    def __init__(self, group: str, what: str) -> None:
        self.group, self.what = group, what
        self._classes: dict[str, T] = {}

    def register(self, cls: C) -> C:
        """Add a class under its `kind` and return it, so that this can stand as a decorator.

        Args:
            cls: The class; `kind` is a class attribute or a dataclass field with a default.

        Raises:
            ConfigError: Another class has this kind already, or the class has none.
        """
        kind = kind_of(cls)
        if not kind:
            raise ConfigError(f"{_name(cls)} has no kind; give it a field `kind` with a default")
        there = self._classes.get(kind)
        if there is not None and (there.__module__, _name(there)) != (cls.__module__, _name(cls)):
            raise ConfigError(
                f"the {self.what} {kind!r} is {_name(there)} already; give {_name(cls)} another kind"
            )
        self._classes[kind] = cls  # type: ignore[assignment]
        return cls

    def unregister(self, kind: str) -> None:
        """Forget a kind that was registered, so that another class can have its name.

        Args:
            kind: Its name.

        Raises:
            UnknownNameError: There is no such kind; the nearest is named.
        """
        self.check(kind)
        self._classes.pop(kind, None)

    def __getitem__(self, kind: str) -> T:
        if isinstance(kind, str) and kind in self._classes:
            return self._classes[kind]
        self.check(kind)
        return self.register(next(iter(entry_points(group=self.group, name=kind))).load())

    def check(self, kind: str) -> None:
        """Refuse a kind that there is not; what another package offers is not loaded.

        Raises:
            ConfigError: The kind is no text.
            UnknownNameError: There is no such kind; the nearest is named.
        """
        if not isinstance(kind, str):
            raise ConfigError(
                f"the kind of a {self.what} is a {type(kind).__name__}; give one of {', '.join(self)}"
            )
        if kind in self:
            return
        near = difflib.get_close_matches(str(kind), list(self), n=1)
        cure = f"did you mean {near[0]!r}?" if near else f"give one of {', '.join(self)}"
        raise UnknownNameError(f"there is no {self.what} of kind {kind!r}; {cure}")

    def __iter__(self) -> Iterator[str]:
        found = dict.fromkeys(self._classes)
        found |= dict.fromkeys(point.name for point in entry_points(group=self.group))
        return iter(found)

    def __contains__(self, kind: object) -> bool:
        return kind in self._classes or kind in list(self)  # the list asks every installed package


def _name(thing: object) -> str:
    return getattr(thing, "__qualname__", repr(thing))


def kind_of(cls: object) -> str:
    """Return the kind that a class states, as an attribute or as the default of a field; "" if none."""
    kind = getattr(cls, "kind", "")
    return kind if isinstance(kind, str) else ""


class Kinded:
    """Base of the settings of one family; a field of this type takes the settings of any of its kinds.

    Derive the family's base from it and give that a `registry` and a `default_kind`; derive each kind, a frozen
    dataclass with `kind: Literal["name"] = "name"`, from the base, and register it. The base may itself be a
    dataclass with the fields that all kinds share: the class that states the `registry` is the base.
    A mapping without `kind`, as in YAML files of old, is of the default kind.
    """

    registry: ClassVar[Registry[Any]]
    """The kinds of the family."""
    default_kind: ClassVar[str] = ""
    """The kind of a mapping that names none."""

    def __post_init__(self) -> None:
        """Refuse numbers outside the range of their unit (docs/units.md), and another class's kind.

        Raises:
            ConfigError: There is one.
        """
        from evnlos.config import check_made  # which needs this module

        check_made(self)
        stated, own = kind_of(self), kind_of(type(self))
        if stated != own:
            raise ConfigError(f"kind is {stated!r}; {_name(type(self))} holds the settings of kind {own!r}")

    @classmethod
    def class_for(cls, values: object) -> type:
        """Return the settings class that a mapping describes.

        Args:
            values: Settings by name, of which only `kind` is looked at.

        Raises:
            ConfigError: There is no such kind.
        """
        if "registry" not in vars(cls):
            return cls
        kind = values.get("kind", cls.default_kind) if isinstance(values, dict) else cls.default_kind
        return cls.registry[kind]

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> Any:
        """Let a field of the family's type take settings of any kind, or a mapping of them."""
        if "registry" not in vars(cls):
            return handler(source)
        from pydantic import TypeAdapter, ValidationError
        from pydantic_core import PydanticCustomError, core_schema

        def validated(values: Any) -> Any:
            if isinstance(values, cls):
                return values
            if not isinstance(values, dict):
                raise ValueError(f"give a mapping of settings for the {cls.registry.what}")
            try:
                return TypeAdapter(cls.class_for(values)).validate_python(values)
            except ValidationError as error:  # the place of the setting within the whole is known one level up
                first = error.errors()[0]
                inner = {"input": first.get("input"), "fault": first["type"], **first.get("ctx", {})}
                inner["loc"] = (*first["loc"], *inner.get("loc", ()))
                raise PydanticCustomError(NESTED, "{text}", {**inner, "text": first["msg"]}) from None

        return core_schema.no_info_plain_validator_function(validated)


UNSTATED = ("kind", "linear")
"""What settings files and hashes leave out: frame cameras had no kinds, and those of before were linear."""

try:
    __version__ = version("evnlos")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"


Step = Callable[[dict[str, Any]], dict[str, Any]]


def migrate(name: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a file of any version in the names and with the meaning of this one.

    Args:
        name: What the values describe: the name of the settings class, e.g. "Simulation".
        values: Nested mappings as they stand in the file; not changed. Those of today come back as they are.

    Example:
        >>> migrate("Simulation", {"pixel": {"leak_rate_hz": 0.0}})["setup"]
        {'pixel': {'kind': 'continuous', 'initial_phase': 'rest', 'leak_rate_hz': 0.0}}
    """
    for step in _STEPS.get(name, ()):
        values = step(values)
    return values


def todays_weights(name: str) -> str:
    """Return the name of published weights of any version as it is today; other names come back as they are.

    Example:
        >>> todays_weights("near-frame-pass")
        'near-frame-sequence'
    """
    return f"{name.removesuffix('-pass')}-sequence" if name.endswith("-pass") else name


def _pixel_has_a_kind(values: dict[str, Any]) -> dict[str, Any]:
    """Name the one event model that settings without `kind` meant."""
    pixel = values.get("pixel")
    if not isinstance(pixel, dict) or "kind" in pixel:
        return values
    return {**values, "pixel": {"kind": "continuous", **_initial_phase(pixel)}}


def _initial_phase(pixel: dict[str, Any]) -> dict[str, Any]:
    """State the first state of the pixels, which once followed from the leak: at rest without any."""
    leaks = pixel.get("leak_rate_hz", 1.0) != 0
    return {"initial_phase": "random" if leaks else "rest", **pixel}


def _training(values: dict[str, Any]) -> dict[str, Any]:
    """Before, `joint` chose the network and `paradigm` what it sees."""
    values = _renamed(values, paradigm="modality", views="sequence_augmentations")
    network = values.get("network")
    if isinstance(network, dict):
        network = values["network"] = _network(network)
    if "joint" in values:
        kind = "sequence" if values.pop("joint") else "unet"
        stated = dict(network) if isinstance(network, dict) else {}
        _refuse_two("joint", kind == "sequence", "network.kind", stated.get("kind", kind) == "sequence")
        values["network"] = {"kind": kind, **stated}
    if values.get("loss") == "balanced":
        values["loss"] = "normalized_bce_mse_ssim"
    if "restandardise" in values:
        if not isinstance(anew := values.pop("restandardise"), bool):
            raise ConfigError(f"restandardise is {anew!r}; give keep_normalization: true or false")
        values["keep_normalization"] = not anew
    return values


def _weights(values: dict[str, Any]) -> dict[str, Any]:
    """What a weights file says of itself; up to format 3 `joint` stood beside the network's settings."""
    if values.get("format") != "evnlos-weights-3":
        return values
    values = _renamed(values, paradigm="modality")
    kind, network = "sequence" if values.pop("joint", False) else "unet", values.get("network")
    if isinstance(network, dict):
        values["network"] = {"kind": kind, **network}
    if isinstance(values.get("history"), list):
        values["history"] = [_run(one) if isinstance(one, dict) else one for one in values["history"]]
    return values | {"format": "evnlos-weights-4"}


def _run(values: dict[str, Any]) -> dict[str, Any]:
    """What the folder of a run, or the history of its weights, says of one training."""
    settings = values.get("settings")
    return {**values, "settings": migrate("Training", settings)} if isinstance(settings, dict) else values


def _renamed(values: dict[str, Any], **names: str) -> dict[str, Any]:
    """Return a copy with keys of before in today's names, in their places; refused if both differ."""
    for before, now in names.items():
        if before in values and now in values:
            _refuse_two(before, values[before], now, values[now])
    return {names.get(key, key): value for key, value in values.items()}


def _refuse_two(before: str, old: object, now: str, new: object) -> None:
    if old != new:
        raise ConfigError(f"{before} is {old!r} and {now}, its name of today, {new!r}; leave {before} out")


def _record(values: dict[str, Any]) -> dict[str, Any]:
    """The record of an experiment."""
    values = _renamed(values, paradigm="modality", rig="setup")
    arm = str(values.get("arm", ""))
    words = {" joint": " sequence", "balanced loss": "normalized loss", " shots": " captures"}
    for before, now in words.items():
        arm = arm.replace(before, now)
    return values | {"arm": arm} if "arm" in values else values


def _paper_setup(values: dict[str, Any]) -> dict[str, Any]:
    """The setup of the paper's equations."""
    return _renamed(values, **_PAPER)


def _network(values: dict[str, Any]) -> dict[str, Any]:
    """A network behind a linear embedding."""
    return _renamed(values, strengths="ridge_multipliers")


def _glyphs(values: dict[str, Any]) -> dict[str, Any]:
    """Hidden characters of any kind."""
    return _renamed(values, plate="target_plane")


def _several_setups(values: dict[str, Any]) -> dict[str, Any]:
    """Name the number of walls that a simulation draws."""
    return _renamed(values, rigs="setups")


_CAMERAS = ("sensor", "frame_camera", "pixel", "time_step_s")
_LAB_CAMERAS = {
    "frame_camera": {"exposure_s": 0.016, "full_well_e": 9000.0, "read_noise_e": 12.0},
    "pixel": {
        "kind": "continuous",
        "initial_phase": "random",
        "threshold_on": 0.21,
        "threshold_off": 0.24,
        "threshold_sigma": 0.04,
        "cutoff_hz": 40.0,
        "leak_rate_hz": 0.05,
        "shot_noise_rate_hz": 0.08,
        "refractory_s": 0.0005,
    },
}
"""Cameras of the laboratory, which its files need not have stated."""
_LAB_WALL = {"kind": "radiometric", "gain": 0.7, "ambient": 0.06, "ambient_gradient": [0.3, -0.2]}


def _one_setup(values: dict[str, Any]) -> dict[str, Any]:
    """Gather `transport` and the cameras in `setup`, and rename the ranges over them."""
    there = [key for key in ("transport", *_CAMERAS) if key in values]
    found = {key: value for key, value in values.items() if key not in there}
    if there:
        if "transport" in values and "setup" in values:
            _refuse_two("transport", values["transport"], "setup", values["setup"])
        setup = values.get("setup") or values.get("transport") or {}
        if not isinstance(setup, dict):
            raise ConfigError(f"the setup is {setup!r}; give its settings, e.g. {{kind: paper}}")
        setup = setup | {key: values[key] for key in _CAMERAS if key in values}
        found["setup"] = setup
    for ranges in ("vary", "spread"):
        if isinstance(found.get(ranges), dict):
            found[ranges] = {_path_in_setup(str(path)): ends for path, ends in found[ranges].items()}
    return found


def _path_in_setup(path: str) -> str:
    path = path.replace("glyphs.plate.", "glyphs.target_plane.")
    section, _, rest = path.partition(".")
    if section in ("transport", "setup"):
        return f"setup.{_PAPER.get(rest, rest)}"
    return f"setup.{path}" if section in _CAMERAS else path


def _lab_setup(values: dict[str, Any]) -> dict[str, Any]:
    """Write out the laboratory's own wall and cameras in a file that left some of them out."""
    if isinstance(values.get("setup"), dict):
        values = {**values, "setup": {"kind": "radiometric", **_LAB_CAMERAS, **values["setup"]}}
        return _one_setup(_pixel_has_a_kind(values))
    if not {"transport", *_CAMERAS} & values.keys():
        return _one_setup(values)
    wall = values.get("transport", _LAB_WALL)
    if isinstance(wall, dict):
        wall = {"kind": "radiometric", **wall}  # the one kind that a laboratory had
    return _one_setup(_pixel_has_a_kind({**_LAB_CAMERAS, **values, "transport": wall}))


_PAPER = {"wave_pitch_m": "field_step_m", "taper": "window", "rho_max": "kernel_radius"}
_GLYPHS = ("DrawingGlyphs", "EmnistGlyphs", "FontGlyphs", "HandwritingGlyphs", "NistGlyphs")
_STEPS: dict[str, tuple[Step, ...]] = {
    "Simulation": (_pixel_has_a_kind, _one_setup, _several_setups),
    "Lab": (_lab_setup,),
    "Training": (_training,),
    "weights": (_weights,),
    "run": (_run,),
    "Record": (_record,),
    "CaptureInfo": (partial(_renamed, rig="setup"),),
    "TargetInfo": (partial(_renamed, plate_m="size_m"),),
    "PaperSetup": (_paper_setup,),
    **dict.fromkeys(_GLYPHS, (_glyphs,)),
    **dict.fromkeys(("UNetConfig", "SequenceConfig"), (_network,)),
}
