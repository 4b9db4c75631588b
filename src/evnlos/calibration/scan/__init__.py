"""A setup's own light transport, measured with a display or a moving LED: plan, folder, import."""

from evnlos.calibration.scan.film import FilmReading, FilmResult, add_events, import_film
from evnlos.calibration.scan.folder import (
    Patterns,
    ScanFrame,
    ScanInfo,
    lit_cells,
    read_scan_frames,
    read_scan_info,
)
from evnlos.calibration.scan.frames import rehearse_scan
from evnlos.calibration.scan.importer import ScanImport, ScanResult, import_scan
from evnlos.calibration.scan.matrix import Denoising, PsfCheck, choose_denoising, matrix_from_psf
from evnlos.calibration.scan.plan import (
    ScanCamera,
    ScanEstimate,
    ScanPlan,
    estimate_scan,
    write_plan,
)
from evnlos.calibration.scan.show import Show, ShowInfo, read_show, rehearse_film

__all__ = [
    "Denoising",
    "FilmReading",
    "FilmResult",
    "Patterns",
    "PsfCheck",
    "ScanCamera",
    "ScanEstimate",
    "ScanFrame",
    "ScanImport",
    "ScanInfo",
    "ScanPlan",
    "ScanResult",
    "Show",
    "ShowInfo",
    "add_events",
    "choose_denoising",
    "estimate_scan",
    "import_film",
    "import_scan",
    "lit_cells",
    "matrix_from_psf",
    "read_scan_frames",
    "read_scan_info",
    "read_show",
    "rehearse_film",
    "rehearse_scan",
    "write_plan",
]
