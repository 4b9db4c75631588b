"""An empty matplotlib figure, or one line that says what to install."""

from __future__ import annotations

from typing import Any

from evnlos.errors import MissingDependencyError


def new_figure(size: tuple[float, float]) -> Any:
    """Return an empty figure of `size` (width, height) inches whose parts keep clear of each other.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingDependencyError("figures need matplotlib: pip install 'evnlos[plot]'") from None
    return Figure(size, layout="constrained")
