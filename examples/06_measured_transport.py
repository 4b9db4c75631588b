"""Scan a setup cell by cell and by Hadamard patterns; hold what is imported against the setup's true matrix."""

import tempfile
from pathlib import Path

import numpy as np

from evnlos import FrameCamera
from evnlos.calibration.scan import ScanCamera, ScanImport, ScanPlan, import_scan, rehearse_scan, write_plan
from evnlos.setups import setup_preset

SHAPE = (60, 96)  # pixels
setup = setup_preset("main-near")
camera = FrameCamera(bit_depth=12, full_well_e=15_000, read_noise_e=30, prnu=0, dsnu_e=0)
guess = ScanCamera(full_level=0.8, lobe_m=0.05, full_well_e=15_000, read_noise_e=30, bit_depth=12)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


errors = {}
print("errors in 1e-4 white levels   planned  estimated  true   denoised: estimated  true")
for pattern in ("raster", "hadamard"):
    plan = ScanPlan(plane=(0.16, 0.08), pattern=pattern, camera=guess)
    truth = setup.matrix(SHAPE, plan.cells).numpy()
    truth *= guess.full_level / truth.sum(axis=1).max()  # exposed alike: all cells lit reach 0.8
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "scan"
        write_plan(plan, folder)
        text = (folder / "scan.yaml").read_text().replace("white_dn: null", "white_dn: 4095")
        (folder / "scan.yaml").write_text(text)
        rehearse_scan(folder, truth, SHAPE, camera)
        plain = import_scan(folder, ScanImport(denoise=False))
        better = import_scan(folder)
    planned = plan.estimate()
    row = [planned.noise * planned.cell_level, rms(plain.measurement.noise.numpy())]
    row += [rms(plain.raw.numpy() - truth), rms(better.measurement.noise.numpy())]
    row += [rms(better.measurement.matrix.numpy() - truth)]
    errors[pattern] = row
    print(f"{pattern:28}" + "".join(f"{1e4 * value:9.2f}" for value in row), better.denoising)
    print(
        f"{'':28}brightest entry {1e4 * truth.max():.0f}, {planned.scan_frames} images, {planned.seconds:.0f} s"
    )

ratio = errors["raster"][2] / errors["hadamard"][2]
print(f"Hadamard patterns make the noise {ratio:.1f} times smaller")
assert abs(errors["hadamard"][1] / errors["hadamard"][2] - 1) < 0.1
