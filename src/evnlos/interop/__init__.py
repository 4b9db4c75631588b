"""Thin adapters to other packages, imported when they are used."""

__all__: list[str] = []
