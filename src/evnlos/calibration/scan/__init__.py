"""A rig's own light transport, measured with a display or a moving LED: plan, folder, import."""

from evnlos.calibration.scan.denoise import Denoising, choose_denoising
from evnlos.calibration.scan.estimate import ScanCamera, ScanEstimate, estimate_scan
from evnlos.calibration.scan.folder import ScanInfo, Shot, read_scan_info, read_shots
from evnlos.calibration.scan.importer import ScanImport, ScanResult, import_scan
from evnlos.calibration.scan.patterns import Patterns
from evnlos.calibration.scan.plan import ScanPlan, lit_cells, write_plan
from evnlos.calibration.scan.psf import PsfCheck, matrix_from_psf
from evnlos.calibration.scan.rehearsal import rehearse_scan

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
