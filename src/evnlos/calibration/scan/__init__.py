"""A setup's own light transport, measured with a display or a moving LED: plan, folder, import."""

from evnlos.calibration.scan.folder import Patterns, ScanFrame, ScanInfo, read_scan_frames, read_scan_info
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
    "ScanFrame",
    "ScanImport",
    "ScanInfo",
    "ScanPlan",
    "ScanResult",
    "choose_denoising",
    "estimate_scan",
    "import_scan",
    "lit_cells",
    "matrix_from_psf",
    "read_scan_frames",
    "read_scan_info",
    "rehearse_scan",
    "write_plan",
]
