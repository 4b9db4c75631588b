"""Kinds that a registry holds, entry points among them, and settings of any kind from a mapping."""

from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from typing import Literal

import pytest

from evnlos import registry as rooms
from evnlos.cameras import EventPixel
from evnlos.config import from_dict, to_dict
from evnlos.errors import ConfigError
from evnlos.registry import Kinded, Registry, migrate
from evnlos.setups import PaperSetup


class Shape(Kinded):
    registry = Registry("evnlos.test_shapes", "shape")
    default_kind = "ball"


@Shape.registry.register
@dataclass(frozen=True)
class Ball(Shape):
    radius_m: float = 1.0
    kind: Literal["ball"] = "ball"


@Shape.registry.register
@dataclass(frozen=True)
class Box(Shape):
    side_m: float = 2.0
    kind: Literal["box"] = "box"


@dataclass(frozen=True)
class Room:
    thing: Shape = field(default_factory=Ball)


@pytest.mark.parametrize("room", [Room(), Room(Ball(3.0)), Room(Box(0.5))])
def test_settings_of_every_kind_survive_the_round_trip(room) -> None:
    assert from_dict(Room, to_dict(room)) == room


def test_a_mapping_without_a_kind_is_of_the_default_kind() -> None:
    assert from_dict(Room, {"thing": {"radius_m": 2}}) == Room(Ball(2.0))


@pytest.mark.parametrize(
    ("thing", "says"),
    [
        ({"kind": "bax"}, "did you mean 'box'"),
        ({"kind": "sphere-like"}, "give one of ball, box"),
        ({"kind": "box", "side": 1.0}, "thing.side; perhaps you meant 'side_m'"),
        ({"kind": "box", "radius_m": 1.0}, "unknown setting thing.radius_m"),
        ({"kind": "box", "side_m": "long"}, "thing.side_m = 'long'"),
        (3, "mapping"),
    ],
)
def test_what_fits_no_kind_is_refused(thing, says) -> None:
    with pytest.raises(ConfigError) as caught:
        from_dict(Room, {"thing": thing})
    assert says in str(caught.value)


def test_an_installed_package_brings_a_kind(monkeypatch) -> None:
    point = EntryPoint("cone", "test_registry:Cone", "evnlos.test_shapes")

    def offered(group: str, name: str | None = None) -> list[EntryPoint]:
        return [point] if group == point.group and name in (None, point.name) else []

    monkeypatch.setattr(rooms, "entry_points", offered)
    assert "cone" in Shape.registry
    assert from_dict(Room, {"thing": {"kind": "cone", "height_m": 4.0}}) == Room(Cone(4.0))
    Shape.registry.unregister("cone")


@dataclass(frozen=True)
class Cone(Shape):
    height_m: float = 1.0
    kind: Literal["cone"] = "cone"


def test_installed_packages_are_looked_through_for_other_kinds_alone(monkeypatch) -> None:
    monkeypatch.setattr(rooms, "entry_points", lambda **_: pytest.fail("each look takes milliseconds"))
    Shape.registry.check("ball")
    assert "box" in Shape.registry


def test_two_classes_cannot_have_one_kind() -> None:
    @dataclass(frozen=True)
    class Other(Shape):
        kind: Literal["box"] = "box"

    with pytest.raises(ConfigError):
        Shape.registry.register(Other)
    with pytest.raises(ConfigError):
        Shape.registry.register(int)
    assert Shape.registry.register(Box) is Box


def test_values_of_today_are_not_touched() -> None:
    values = {"setup": {"kind": "radiometric", "pixel": {"leak_rate_hz": 0.0}}}
    assert migrate("Simulation", values) == values == migrate("Something", values)


def test_settings_of_a_kind_do_not_call_themselves_another() -> None:
    """They could be saved, and not be read again."""
    with pytest.raises(ConfigError):
        PaperSetup(kind="radiometric")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ConfigError):
        EventPixel(kind="v2e")  # pyright: ignore[reportArgumentType]


def test_classes_of_one_name_in_two_modules_are_two() -> None:
    registry = Registry("evnlos.none", "thing")
    first, second = (type("Thing", (), {"kind": "one", "__module__": module}) for module in ("a", "b"))
    registry.register(first)
    registry.register(first)
    with pytest.raises(ConfigError):
        registry.register(second)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("Simulation", {"transport": "paper"}),
        ("Lab", {"transport": ["paper"]}),
        ("Simulation", {"rigs": 3, "setups": 5}),
        ("Simulation", {"transport": {"kind": "paper"}, "setup": {"kind": "radiometric"}}),
        ("Training", {"paradigm": "event", "modality": "frame"}),
        ("Training", {"joint": True, "network": {"kind": "unet"}}),
        ("Training", {"restandardise": "no"}),
    ],
)
def test_names_of_before_that_contradict_those_of_today_are_refused(name, values) -> None:
    with pytest.raises(ConfigError):
        migrate(name, values)


def test_names_of_before_that_say_the_same_pass() -> None:
    assert migrate("Simulation", {"rigs": 3, "setups": 3}) == {"setups": 3}
    assert migrate("Training", {"joint": True, "network": {"kind": "sequence"}})["network"] == {
        "kind": "sequence"
    }
