"""What a measured matrix can't say about a rig: its own noise and the size of its cells, in words."""

from __future__ import annotations

import torch

from evnlos.evaluation.identify_rig import Bench, SeenRig, within_scan
from evnlos.transport import MeasuredTransport


def scan_notes(
    transport: MeasuredTransport, bench: Bench, rig: SeenRig, singular: torch.Tensor, level: float
) -> list[str]:
    """Return what makes a measured rig look better or worse than it is.

    The noise of the measurement has singular values of its own; those of the matrix that are not above its
    largest can't be told from it, however well conditioned they look.

    Args:
        transport: The measured transport.
        bench: Cells and pixels.
        rig: Its linear map.
        singular: Singular values of that map over the largest, descending.
        level: Share of the largest above which a mode is called usable.
    """
    measured = transport.measurement()
    seen = within_scan(transport, bench)
    noise = transport.noise_matrix(seen.shape, seen.plate) * transport.gain
    floor = float(torch.linalg.matrix_norm(noise, 2) / torch.linalg.matrix_norm(rig.matrix, 2))
    above, usable = int((singular > floor).sum()), int((singular > level).sum())
    found = []
    if above < usable:
        found.append(
            f"the scan's own noise reaches {floor:.2g} of the largest singular value: {above} of the {usable} "
            "modes "
            f"above {level:g} are surely measured, the others may be noise; repeat the scan more often"
        )
    if not measured.about.noise_cells:
        found.append(
            "the matrix was denoised or made from a point-spread function: its noise is not independent from "
            "cell "
            "to cell, and modes that were cut off count as absent"
        )
    pitch = measured.about.plane.pitch_m
    if pitch > 1.01 * bench.plate.pitch_m:
        found.append(
            f"the scan's cells are {1e3 * pitch:.1f} mm: bars narrower than that were not measured, whatever "
            "the wall"
        )
    return found
