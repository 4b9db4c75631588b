"""The best linear reconstruction, learned in closed form: what a network starts from, and has to beat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.data import Modality
from evnlos.errors import DataError
from evnlos.types import derive_seed

_LAMBDAS = tuple(10.0 ** (k / 2) for k in range(-12, 5))  # in units of the mean power of a component
_FOLDS = 5
_EXTRA = 20  # columns of the random probe beyond the rank
_POWERS = 2
_TINY = 1e-30


@dataclass(frozen=True, eq=False)
class LinearEstimate:
    """y = mean_out + (x - mean_in) basis weights: a ridge regression on the main components of the input.

    Args:
        mean_in: Mean input, [D], D = C H W.
        basis: Main directions of the inputs, [D, R], orthogonal, their coefficients uncorrelated.
        powers: Power of each coefficient, summed over the samples, [R].
        weights: From the coefficients to the picture, [R, H W].
        mean_out: Mean picture, [H, W].
        regularization: Weight of the ridge that was chosen, in units of the mean power of a component.
    """

    mean_in: Tensor
    basis: Tensor
    powers: Tensor
    weights: Tensor
    mean_out: Tensor
    regularization: float

    def shrinkage(self, strength: float) -> Tensor:
        """Return the factors of the coefficients, [R], that make the ridge `strength` times as strong.

        Along uncorrelated coefficients a ridge regression is one division each, so that those of all ridges
        share basis and weights: W(s) = diag((p + l) / (p + s l)) W(1), p the powers, l the ridge.
        """
        ridge = self.regularization * self.powers.mean().clamp_min(_TINY)
        return (self.powers + ridge) / (self.powers + strength * ridge)

    def __call__(self, inputs: Tensor) -> Tensor:
        """Return pictures [N, H, W], 0..1, for inputs [N, C, H, W]."""
        code = (inputs.float().flatten(1) - self.mean_in) @ self.basis  # [N, R]
        return (self.mean_out + (code @ self.weights).unflatten(1, tuple(self.mean_out.shape))).clamp(0, 1)


def fit_linear(
    inputs: Tensor,
    truth: Tensor,
    objects: NDArray[np.str_],
    rank: int = 256,
    seed: int = 0,
    modality: Modality | None = None,
) -> LinearEstimate:
    """Fit the linear estimate with the least mean squared error on unseen objects.

    The basis comes from a randomised singular value decomposition (Halko, Martinsson and Tropp, SIAM Review
    53, 2011); the ridge is the best of a grid when one fold of the objects at a time is left out. The
    groups of channels of a modality have a basis each, in units of their own noise.

    Args:
        inputs: What the network would see, [N, C, H, W].
        truth: True pictures, [N, H, W], 0..1.
        objects: Object of each sample, [N].
        rank: Most components of the input.
        seed: Seed of the random probe and of the folds.
        modality: Which channels belong together; None: all do.

    Raises:
        DataError: The lengths differ, or there are fewer than two objects.
    """
    names = np.unique(objects)
    if not len(inputs) == len(truth) == len(objects):
        raise DataError(f"{len(inputs)} inputs, {len(truth)} pictures and {len(objects)} names; give as many")
    if len(names) < 2:
        raise DataError(f"{len(names)} object(s); a ridge is chosen on objects left out: give at least two")
    order = np.random.default_rng(derive_seed(seed, "folds")).permutation(len(names))
    fold_of = dict(zip(names[order], np.arange(len(names)) % min(_FOLDS, len(names)), strict=True))
    folds = torch.tensor([int(fold_of[name]) for name in objects])
    y = truth.float().flatten(1)  # [N, H W]
    mean_out = y.mean(dim=0)
    parts = [(slice(None), rank)]
    if modality is not None:
        parts = list(zip(modality.slices.values(), modality.ranks(rank), strict=True))
    found = [_fit(inputs[:, own].float().flatten(1), y - mean_out, folds, r, seed) for own, r in parts]
    shape = tuple(truth.shape[1:])
    if len(found) == 1:
        return LinearEstimate(*found[0][:4], mean_out.unflatten(0, shape), found[0][4])
    # Each part in units of its own noise, as its own best ridge tells it: else the noise of the events would
    # hide the fine detail of the frames.
    scales = torch.tensor(
        [
            float(regularization * powers.mean().clamp_min(_TINY)) ** -0.5
            for _, _, powers, _, regularization in found
        ]
    )
    scales = scales / scales.log().mean().exp()
    basis = torch.block_diag(*(one[1] * scale for one, scale in zip(found, scales, strict=True)))
    mean_in = torch.cat([one[0] for one in found])
    # One part at a time: frame and events side by side in float32 would fill the memory once more.
    codes = [
        (inputs[:, own].float().flatten(1) - one[0]) @ one[1] * scale
        for (own, _), one, scale in zip(parts, found, scales, strict=True)
    ]
    turned, powers, weights, regularization = _regress(torch.cat(codes, dim=1), y - mean_out, folds)
    return LinearEstimate(
        mean_in, basis @ turned, powers, weights, mean_out.unflatten(0, shape), regularization
    )


def _fit(
    x: Tensor, y: Tensor, folds: Tensor, rank: int, seed: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, float]:
    """Return mean input [D], basis [D, R], powers [R], weights [R, H W] and ridge of one part of the input."""
    mean_in = x.mean(dim=0)
    x = x - mean_in
    basis = _main_directions(x, min(rank, *x.shape), seed)
    turned, powers, weights, regularization = _regress(x @ basis, y, folds)
    return mean_in, basis @ turned, powers, weights, regularization


def _regress(code: Tensor, y: Tensor, folds: Tensor) -> tuple[Tensor, Tensor, Tensor, float]:
    """Return what makes the code [N, R] uncorrelated [R, R], its powers [R], weights [R, H W] and ridge."""
    powers, turn = torch.linalg.eigh((code.T @ code).double())
    powers, turn = powers.clamp_min(0).float().flip(0), turn.float().flip(1)
    code = code @ turn
    parts = []  # of each fold: C^T C [R, R] and C^T Y [R, H W]
    for fold in folds.unique():
        own = folds == fold
        part = code[own]
        parts.append(((part.T @ part).double(), (part.T @ y[own]).double()))
    gram, outer = (torch.stack(column).sum(dim=0) for column in zip(*parts, strict=True))
    errors = sum(_left_out(gram - own, outer - aim, own, aim) for own, aim in parts)
    regularization = _LAMBDAS[int(torch.as_tensor(errors).argmin())]
    weights = outer.float() / (powers + regularization * powers.mean().clamp_min(_TINY))[:, None]
    return turn, powers, weights, regularization


def _left_out(gram: Tensor, outer: Tensor, left_gram: Tensor, left_outer: Tensor) -> Tensor:
    """Return the squared error on samples left out, less their sum |Y|^2, for each ridge, float64.

    In the eigenvectors of the other samples' Gram matrix each ridge is a diagonal, and ||C W - Y||^2 needs no
    more than matrices of the code's size.

    Args:
        gram: C^T C of the other samples, float64 [R, R].
        outer: Their C^T Y, float64 [R, H W].
        left_gram: C^T C of those left out.
        left_outer: Their C^T Y.
    """
    powers, turn = torch.linalg.eigh(gram)
    powers = powers.clamp_min(0)
    turned = turn.T @ outer  # [R, H W]
    aimed = (turned * (turn.T @ left_outer)).sum(dim=1)
    square = (turn.T @ left_gram @ turn) * (turned @ turned.T)
    ridges = torch.tensor(_LAMBDAS, dtype=torch.float64) * powers.mean().clamp_min(_TINY)
    inverse = 1 / (powers + ridges[:, None])  # [ridges, R]
    return ((inverse @ square) * inverse).sum(dim=1) - 2 * inverse @ aimed


def _main_directions(x: Tensor, rank: int, seed: int) -> Tensor:
    """Return the main right singular directions of x [N, D], orthonormal [D, R]."""
    draw = torch.Generator().manual_seed(derive_seed(seed, "probe") % 2**63)
    probe = torch.randn(x.shape[1], min(rank + _EXTRA, *x.shape), generator=draw)
    reached, _ = torch.linalg.qr(x @ probe)
    for _ in range(_POWERS):
        back, _ = torch.linalg.qr(x.T @ reached)
        reached, _ = torch.linalg.qr(x @ back)
    _, _, right = torch.linalg.svd(reached.T @ x, full_matrices=False)
    return right[:rank].T.contiguous()
