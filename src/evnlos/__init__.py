"""evnlos sees moving things around a corner with an event camera: simulate, learn, reconstruct, measure."""

import evnlos.threads  # noqa: F401 - before PyTorch
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
from evnlos.evaluation import evaluate, reconstruct
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
from evnlos.training import Training, train
from evnlos.transport import (
    GGX,
    Lambert,
    PaperTransport,
    RadiometricTransport,
    View,
    angular_spectrum,
    tpsf_kernel,
)
from evnlos.types import Events, Plane
from evnlos.version import __version__

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
    "PaperTransport",
    "PathMotion",
    "Plane",
    "RadiometricTransport",
    "ResidualUNet",
    "Sampling",
    "Scene",
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
