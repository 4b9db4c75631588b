"""What does the noise of a scan cost the picture behind a real photograph, and what does denoising give back?

    python benchmarks/measured_transport.py mushroom_chair.npz

The photograph is that of Saunders et al. (Nature 2019). Nobody scanned the room: its modelled matrix is scanned
by our simulator with a camera of stated read noise (white levels), imported, and inverts the real photograph. r
is Pearson's correlation with the picture on the screen, for the smooth inversion of docs/inversion.md.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

from evnlos import FrameCamera
from evnlos.calibration.scan import ScanPlan, import_scan, rehearse_scan, write_plan
from evnlos.solver import read_photograph
from evnlos.solver.inversion import Inversion, chosen_degree
from evnlos.transport import Lambert, MatrixTransport, light_transport_matrix
from evnlos.types import Plane

PITCH = 0.02
torch.set_num_threads(1)
photograph = read_photograph(sys.argv[1]).binned(6)
screen, shape = photograph.screen, photograph.patches.shape
sides = [round(float(np.ptp(middles)) / PITCH) + 1 for middles in (screen.y_m, screen.x_m)]
center = tuple(float(m.min() + m.max()) / 2 for m in (screen.x_m, screen.y_m))
plane = Plane(sides[0], sides[1], PITCH, center)
nearest = [
    np.abs(np.asarray(a)[:, None] - b).argmin(axis=1)
    for a, b in ((screen.y_m, plane.y_m), (screen.x_m, plane.x_m))
]
truth = light_transport_matrix(
    photograph.patches,
    plane,
    photograph.distance_m,
    Lambert(1.0),
    occluders=photograph.occluders,
    emission_exponent=photograph.emission_exponent,
    points=(3, 6),
).numpy()
truth *= 0.8 / truth.sum(axis=1).max()


def correlation(matrix: torch.Tensor) -> float:
    operator = MatrixTransport(matrix / torch.linalg.matrix_norm(matrix, 2), plane, shape)
    wall = photograph.measurement()
    image = Inversion(operator, wall, chosen_degree(operator, wall)).solve("tikhonov").image.numpy()
    seen = image[:, nearest[0]][:, :, nearest[1]]
    return float(np.corrcoef(seen.ravel(), photograph.truth.numpy().ravel())[0, 1])


print(f"{plane.height} x {plane.width} cells of {1e3 * PITCH:g} mm, wall of {shape[0]} x {shape[1]} patches")
print(f"modelled matrix: r = {correlation(torch.from_numpy(truth)):.3f}")
for pattern, noise in (("hadamard", 2e-3), ("hadamard", 8e-3), ("raster", 2e-3), ("raster", 5e-4)):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "scan"
        plan = ScanPlan((plane.width * PITCH, plane.height * PITCH), PITCH, center, pattern)
        list(write_plan(plan, folder))
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
