"""`evnlos app`: a page to play with."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from evnlos.app.serve import Server, serve
from evnlos.cli.console import Flat


@dataclass(frozen=True)
class AppCommand:
    """A page to play with: hide something, choose wall and cameras, watch what can be seen; uploads too."""

    weights: tuple[Path, ...] = ()
    """Weights files, or folders of runs, that reconstruct beside the classical solvers; none takes those of
    the package."""
    server: Flat[Server] = field(default_factory=Server)

    def run(self) -> None:
        """Run the page until it is interrupted."""
        serve(self.server, self.weights, lambda address: print(f"{address}  (Ctrl+C stops it)", flush=True))
