"""An empty matplotlib figure, or one line that says what to install."""

from __future__ import annotations

from typing import Any, Literal

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


def signed_map() -> Any:
    """Return a colour map for values of either sign, dark blue below 0, grey at 0, light orange above.

    It grows lighter all the way, so the sign stays told in grey print, where a map with a pale middle loses it.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    new_figure((1.0, 1.0))  # or the line that says what to install
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("signed", ["#082060", "#8e8e92", "#ffdea0"])


def themed(theme: Literal["light", "dark"]) -> Any:
    """Return a context in which figures are made and saved on a light or a dark ground.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    new_figure((1.0, 1.0))  # or the line that says what to install
    from matplotlib import rc_context

    ink, ground = ("#e2e5eb", "#0e1014") if theme == "dark" else ("#1d2126", "#ffffff")
    keys = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")
    return rc_context(
        dict.fromkeys(keys, ink)
        | dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), ground)
    )
