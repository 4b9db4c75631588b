"""An empty matplotlib figure, or one line that says what to install."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Literal

from evnlos.errors import DataError, MissingDependencyError
from evnlos.files import write_atomically


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


def save_figure(figure: Any, path: str | Path, *, dpi: int) -> Path:
    """Write a figure whole or not at all, in the format of the path's suffix, PNG without one; return the path.

    Raises:
        DataError: There is no such format.
    """
    path, drawn = Path(path), io.BytesIO()
    known = figure.canvas.get_supported_filetypes()
    kind = path.suffix.lower().removeprefix(".") or "png"
    if kind not in known:
        raise DataError(f"{path} is no picture of a known format; end its name in .png, .svg or .pdf")
    figure.savefig(drawn, dpi=dpi, format=kind)
    write_atomically(path, drawn.getvalue())
    return path


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
