"""`evnlos invert PICTURE... --setup transport.safetensors`: still pictures of the wall, a measured setup."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from evnlos.calibration.scan.importer import fill_bad
from evnlos.cli.notes import say
from evnlos.dataset.frame_sources import read_image
from evnlos.errors import ConfigError
from evnlos.setups import Setup
from evnlos.setups.base import dense_matrix
from evnlos.setups.measured import averaged
from evnlos.solver.inversion import Inversion, chosen_degree
from evnlos.solver.solution import Solution
from evnlos.solver.tikhonov import Rule
from evnlos.transport import MatrixTransport

_FINEST = 48  # pixels a side that a rough wall's light needs


@dataclass(frozen=True)
class StillOptions:
    """What `evnlos invert` was told about still pictures."""

    dark: Path | None
    solvers: tuple[Literal["tikhonov", "tv"], ...]
    lam: float | None
    rule: Rule
    noise_sigma: float | None
    degree: int | None
    bin: int | None


def invert_stills(
    files: Sequence[Path], setup: Setup, options: StillOptions
) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return the figures, and the pictures [files, h, w] on the scanned cells by solver.

    The dark frame (the scan's own where none is given) is taken off, unusable pixels are filled in alike in
    the pictures and in the matrix, both are reduced, and the operator is brought to norm 1.

    Raises:
        ConfigError: A picture does not have the scan's size or is one that the scan was not.
        DataError: A picture can't be read.
    """
    clock = time.perf_counter()
    measured = setup.measurement()
    pictures = [read_image(path, measured.shape) for path in files]
    peaks = {float(np.iinfo(picture.dtype).max) for picture in pictures}
    if len(peaks) > 1:
        raise ConfigError("the pictures have 8 and 16 bits; give pictures of one camera")
    white = float(measured.about.white_dn or peaks.pop())
    if (brightest := max(int(picture.max()) for picture in pictures)) > white:
        raise ConfigError(f"a picture reaches {brightest} DN, the scan's white is {white:g}; save both alike")
    light = torch.from_numpy(np.stack(pictures).astype(np.float32)) / white
    if options.dark is None:
        light = light - setup.ambient_light(measured.shape)
    else:
        light = light - torch.from_numpy(read_image(options.dark, measured.shape).astype(np.float32)) / white
    filled = fill_bad(light.numpy(), measured.bad.numpy(), measured.shape)
    shape = reduced(measured.shape, options.bin)
    flat = averaged(torch.from_numpy(filled).flatten(1).mT, measured.shape, shape)
    image = flat.mT.unflatten(1, shape).double()
    image = image / image.abs().max().clamp(min=1e-12)
    cells = measured.about.plane
    matrix = dense_matrix(setup.operator(cells, shape))
    operator = MatrixTransport(matrix / torch.linalg.matrix_norm(matrix, 2), cells, shape)
    degree = chosen_degree(operator, image) if options.degree is None else options.degree
    found: dict[str, Any] = {
        "files": [str(path) for path in files],
        "setup": setup.wall_description(),
        "wall": list(shape),
        "background_degree": degree,
        "solutions": {},
    }
    images: dict[str, torch.Tensor] = {}
    inversion = Inversion(operator, image, degree)
    for name in options.solvers:
        solution = inversion.solve(name, options.lam, options.rule, options.noise_sigma)
        found["solutions"][name] = figures_of(name, solution)
        images[name] = solution.image
    found["seconds"] = round(time.perf_counter() - clock, 1)
    return found, images


def figures_of(name: str, solution: Solution) -> dict[str, Any]:
    """Return the figures of a solution, with a warning where the solver gave up."""
    if not solution.converged:
        say(f"warning: {name} stopped after {solution.iterations} iterations before it had converged")
    return {"lam": solution.lam, "misfit": solution.noise_sigma, "iterations": solution.iterations}


def reduced(shape: tuple[int, int], bin: int | None) -> tuple[int, int]:
    """Return the size (h, w) that pictures are reduced to: pixels binned, by default at most 48 a side."""
    most = max(shape)
    factor = most / min(most, _FINEST) if bin is None else bin
    if not 1 <= factor <= min(shape):
        raise ConfigError(f"the binning is {bin}; give 1 to {min(shape)} pixels")
    return max(1, round(shape[0] / factor)), max(1, round(shape[1] / factor))
