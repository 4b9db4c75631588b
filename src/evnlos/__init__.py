"""evnlos sees moving things around a corner with an event camera: simulate, learn, reconstruct, measure."""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

from evnlos.version import __version__

if TYPE_CHECKING:
    from evnlos.dataset import (
        NlosDataset,
        Sampling,
        Simulation,
        import_captures,
        open_dataset,
        read_capture,
        simulate,
    )
    from evnlos.errors import EvnlosError
    from evnlos.evaluation import evaluate, load_model, reconstruct
    from evnlos.events import (
        CelexOptions,
        iter_events,
        keep_known_polarity,
        read_events,
        read_events_report,
        read_frames,
        time_surface,
        voxel_grid,
        write_events,
    )
    from evnlos.metrics import psnr, ssim
    from evnlos.model import ResidualUNet, UNetConfig, load_weights
    from evnlos.scene import LineMotion, PathMotion, Scene, Target, find_font
    from evnlos.sensor import EventCamera, EventPixel, FrameCamera, simulate_events
    from evnlos.setups import PaperSetup, RadiometricSetup, Setup, load_setup
    from evnlos.training import Training, train
    from evnlos.transport import GGX, Lambert, View, angular_spectrum, tpsf_kernel
    from evnlos.types import Events, Plane

__all__ = [
    "GGX",
    "CelexOptions",
    "EventCamera",
    "EventPixel",
    "Events",
    "EvnlosError",
    "FrameCamera",
    "Lambert",
    "LineMotion",
    "NlosDataset",
    "PaperSetup",
    "PathMotion",
    "Plane",
    "RadiometricSetup",
    "ResidualUNet",
    "Sampling",
    "Scene",
    "Setup",
    "Simulation",
    "Target",
    "Training",
    "UNetConfig",
    "View",
    "__version__",
    "angular_spectrum",
    "evaluate",
    "find_font",
    "import_captures",
    "iter_events",
    "keep_known_polarity",
    "load_model",
    "load_setup",
    "load_weights",
    "open_dataset",
    "psnr",
    "read_capture",
    "read_events",
    "read_events_report",
    "read_frames",
    "reconstruct",
    "simulate",
    "simulate_events",
    "ssim",
    "time_surface",
    "tpsf_kernel",
    "train",
    "voxel_grid",
    "write_events",
]

_FROM = {
    "dataset": (
        "NlosDataset",
        "Sampling",
        "Simulation",
        "import_captures",
        "open_dataset",
        "read_capture",
        "simulate",
    ),
    "errors": ("EvnlosError",),
    "evaluation": ("evaluate", "load_model", "reconstruct"),
    "events": (
        "CelexOptions",
        "iter_events",
        "keep_known_polarity",
        "read_events",
        "read_events_report",
        "read_frames",
        "time_surface",
        "voxel_grid",
        "write_events",
    ),
    "metrics": ("psnr", "ssim"),
    "model": ("ResidualUNet", "UNetConfig", "load_weights"),
    "scene": ("LineMotion", "PathMotion", "Scene", "Target", "find_font"),
    "sensor": ("EventCamera", "EventPixel", "FrameCamera", "simulate_events"),
    "setups": ("PaperSetup", "RadiometricSetup", "Setup", "load_setup"),
    "training": ("Training", "train"),
    "transport": (
        "GGX",
        "Lambert",
        "View",
        "angular_spectrum",
        "tpsf_kernel",
    ),
    "types": ("Events", "Plane"),
}
"""Names of `__all__` by the module that has them."""
_HOME = {name: module for module, names in _FROM.items() for name in names}

if not TYPE_CHECKING:  # else a checker would take every name for one of the package's

    def __getattr__(name: str) -> object:
        """Import what is asked for when it is asked for: `--version` and `evnlos doctor` need no PyTorch.

        Raises:
            AttributeError: The package has no such name and no such module.
        """
        if name in _HOME:
            found = getattr(importlib.import_module(f"evnlos.{_HOME[name]}"), name)
        else:
            found = _module(name)
        globals()[name] = found
        return found


def _module(name: str) -> ModuleType:
    missing = AttributeError(f"module 'evnlos' has no attribute {name!r}", name=name)
    if name.startswith("_"):
        raise missing
    try:
        return importlib.import_module(f"evnlos.{name}")
    except ModuleNotFoundError as error:
        if error.name != f"evnlos.{name}":
            raise
        raise missing from None


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
