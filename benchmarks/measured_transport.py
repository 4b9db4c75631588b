"""What does the noise of a scan cost the image behind a real photograph, and what does denoising give back?

    python benchmarks/measured_transport.py mushroom_chair.npz

The photograph is that of Saunders et al. (Nature 2019). Nobody scanned the room: its modelled matrix is scanned
by our simulator with a camera of stated read noise (white levels), imported, and inverts the real photograph. r
is Pearson's correlation with the image on the screen, for the smooth inversion of docs/inversion.md.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

from evnlos import FrameCamera
from evnlos.calibration.scan import ScanPlan, import_scan, rehearse_scan, write_plan
from evnlos.inverse import read_photograph
from evnlos.inverse.inversion import Inversion, chosen_degree
from evnlos.optics import MatrixTransport

PITCH = 0.02
torch.set_num_threads(1)
photograph = read_photograph(sys.argv[1]).binned(6)
shape, plane = photograph.patches.shape, photograph.plane_of_screen(PITCH)
truth = photograph.matrix(plane).numpy()
truth *= 0.8 / truth.sum(axis=1).max()


def correlation(matrix: torch.Tensor) -> float:
    operator = MatrixTransport(matrix / torch.linalg.matrix_norm(matrix, 2), plane, shape)
    wall = photograph.measurement()
    image = Inversion(operator, wall, chosen_degree(operator, wall)).solve("tikhonov").image
    seen = photograph.at_cells(image, plane).numpy()
    return float(np.corrcoef(seen.ravel(), photograph.truth.numpy().ravel())[0, 1])


print(f"{plane.height} x {plane.width} cells of {1e3 * PITCH:g} mm, wall of {shape[0]} x {shape[1]} patches")
print(f"modelled matrix: r = {correlation(torch.from_numpy(truth)):.3f}")
for pattern, noise in (("hadamard", 2e-3), ("hadamard", 8e-3), ("raster", 2e-3), ("raster", 5e-4)):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "scan"
        plan = ScanPlan((plane.width * PITCH, plane.height * PITCH), PITCH, plane.center_m, pattern)
        write_plan(plan, folder)
        camera = FrameCamera(
            bit_depth=16, full_well_e=1e9, read_noise_e=noise * 1e9, prnu=0, dsnu_e=0, black_level=2000
        )
        rehearse_scan(folder, truth, shape, camera)
        found = import_scan(folder)
    plain, better = correlation(found.raw.double()), correlation(found.measurement.matrix.double())
    signal = found.signal_to_noise / found.denoising.gain
    print(
        f"{pattern}, frame noise {noise:g}: entry over noise {signal:.2f}, r = {plain:.3f}; denoised "
        f"(rank {found.denoising.rank}, {found.denoising.gain:.1f} x): r = {better:.3f}"
    )
