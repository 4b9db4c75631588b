"""Inversion without learning, on the operator protocol."""

__all__: list[str] = []
