"""A setup's own light transport, measured with a display or a moving LED: plan, folder, import."""

from evnlos.calibration.scan.folder import Patterns, ScanInfo, Shot, read_scan_info, read_shots
from evnlos.calibration.scan.frames import rehearse_scan
from evnlos.calibration.scan.importer import ScanImport, ScanResult, import_scan
from evnlos.calibration.scan.matrix import Denoising, PsfCheck, choose_denoising, matrix_from_psf
from evnlos.calibration.scan.plan import (
    ScanCamera,
    ScanEstimate,
    ScanPlan,
    estimate_scan,
    lit_cells,
    write_plan,
)

__all__ = [
    "Denoising",
    "Patterns",
    "PsfCheck",
    "ScanCamera",
    "ScanEstimate",
    "ScanImport",
    "ScanInfo",
    "ScanPlan",
    "ScanResult",
    "Shot",
    "choose_denoising",
    "estimate_scan",
    "import_scan",
    "lit_cells",
    "matrix_from_psf",
    "read_scan_info",
    "read_shots",
    "rehearse_scan",
    "write_plan",
]
