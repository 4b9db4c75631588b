"""What a measured matrix can't say about a rig: its own noise and the size of its cells, in words."""

from __future__ import annotations

import torch

from evnlos.evaluation.identify_rig import LinearizedSetup
from evnlos.setups import OperatorNoise


def scan_notes(noise: OperatorNoise, seen: LinearizedSetup, singular: torch.Tensor, level: float) -> list[str]:
    """Return what makes a measured setup look better or worse than it is.

    The noise of the measurement has singular values of its own; those of the matrix that are not above its
    largest can't be told from it, however well conditioned they look.

    Args:
        noise: One draw of the noise of the measured operator, and what is known of it.
        seen: The linear map of the setup.
        singular: Singular values of that map over the largest, descending.
        level: Share of the largest above which a mode is called usable.
    """
    floor = float(torch.linalg.matrix_norm(noise.matrix, 2) / torch.linalg.matrix_norm(seen.matrix, 2))
    above, usable = int((singular > floor).sum()), int((singular > level).sum())
    found = []
    if above < usable:
        found.append(
            f"the scan's own noise reaches {floor:.2g} of the largest singular value: {above} of the {usable} "
            "modes "
            f"above {level:g} are surely measured, the others may be noise; repeat the scan more often"
        )
    if not noise.is_independent:
        found.append(
            "the matrix was denoised or made from a point-spread function: its noise is not independent from "
            "cell "
            "to cell, and modes that were cut off count as absent"
        )
    if noise.pitch_m > 1.01 * seen.plate.pitch_m:
        found.append(
            f"the scan's cells are {1e3 * noise.pitch_m:.1f} mm: bars narrower than that were not measured, "
            "whatever the wall"
        )
    return found
