"""Registries of kinds: what ships with the package, what a program registers, what installed packages bring.

A thing that a researcher swaps (a setup, an event model, a reconstructor) is described by a settings dataclass
with a field `kind`. The settings of one family share a base class derived from `Kinded`; a field of that type
takes the settings of any kind, from Python, YAML and the command line alike.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import Any, ClassVar, Generic, TypeVar

from evnlos.errors import ConfigError

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
        if there is not None and _name(there) != _name(cls):
            raise ConfigError(
                f"the {self.what} {kind!r} is {_name(there)} already; give {_name(cls)} another kind"
            )
        self._classes[kind] = cls  # type: ignore[assignment]
        return cls

    def __getitem__(self, kind: str) -> T:
        if not isinstance(kind, str):
            raise ConfigError(
                f"the kind of a {self.what} is a {type(kind).__name__}; give one of {', '.join(self)}"
            )
        if kind in self._classes:
            return self._classes[kind]
        for point in entry_points(group=self.group, name=str(kind)):
            return self.register(point.load())
        near = difflib.get_close_matches(str(kind), list(self), n=1)
        cure = f"did you mean {near[0]!r}?" if near else f"give one of {', '.join(self)}"
        raise ConfigError(f"there is no {self.what} of kind {kind!r}; {cure}")

    def __iter__(self) -> Iterator[str]:
        found = dict.fromkeys(self._classes)
        found |= dict.fromkeys(point.name for point in entry_points(group=self.group))
        return iter(found)

    def __contains__(self, kind: object) -> bool:
        return kind in list(self)


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
        """Refuse numbers outside the range of their unit (docs/units.md).

        Raises:
            ConfigError: There is one.
        """
        from evnlos.config import check_made  # which needs this module

        check_made(self)

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
                inner = {"loc": first["loc"], "input": first.get("input"), **first.get("ctx", {})}
                raise PydanticCustomError(NESTED, "{text}", {**inner, "text": first["msg"]}) from None

        return core_schema.no_info_plain_validator_function(validated)
