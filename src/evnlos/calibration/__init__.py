"""Fitting the simulator to captures of a rig."""

__all__: list[str] = []
