"""The best linear reconstruction: exact where the world is linear, cautious where it is noise."""

import numpy as np
import pytest
import torch

from evnlos.errors import DataError
from evnlos.inverse import left_out_errors
from evnlos.models import fit_linear
from evnlos.models.reconstructor import RIDGES


def world(noise: float, objects: int = 30, positions: int = 10, seed: int = 0):
    """Images of 6 modes, measured by a random matrix: inputs, truth, names."""
    draw = torch.Generator().manual_seed(seed)
    modes = torch.randn(6, 8 * 12, generator=draw) / 40
    count = objects * positions
    truth = 0.5 + torch.randn(count, 6, generator=draw) @ modes
    matrix = torch.randn(8 * 12, 2 * 8 * 12, generator=draw) / 10
    seen = truth @ matrix + noise * torch.randn(count, 2 * 8 * 12, generator=draw)
    names = np.repeat([f"o{k}" for k in range(objects)], positions)
    return seen.reshape(count, 2, 8, 12), truth.reshape(count, 8, 12), names


def test_a_linear_world_is_found_exactly() -> None:
    inputs, truth, names = world(0.0)
    found = fit_linear(inputs[:200], truth[:200], names[:200], rank=6)
    torch.testing.assert_close(found(inputs[200:]), truth[200:], atol=2e-3, rtol=0)
    np.testing.assert_allclose((found.basis.T @ found.basis).numpy(), np.eye(6), atol=1e-5)


def test_it_is_the_ridge_regression_that_it_says() -> None:
    inputs, truth, names = world(0.3)
    found = fit_linear(inputs, truth, names, rank=192)  # all components: no direction is left out
    x = (inputs.flatten(1) - inputs.flatten(1).mean(0)).double()
    y = (truth.flatten(1) - truth.flatten(1).mean(0)).double()
    ridge = found.regularization * (x.T @ x).diagonal().mean() * torch.eye(192, dtype=torch.float64)
    weights = torch.linalg.solve(x.T @ x + ridge, x.T @ y)
    expected = (truth.double().mean(0).flatten() + x @ weights).clamp(0, 1).reshape(truth.shape)
    torch.testing.assert_close(found(inputs).double(), expected, atol=1e-4, rtol=0)


def test_errors_on_objects_left_out_are_those_of_one_regression_for_each_ridge() -> None:
    inputs, truth, _ = world(0.3)
    code, y = inputs.flatten(1)[:, :40], truth.flatten(1) - truth.flatten(1).mean(0)
    left = torch.arange(len(code)) % 5 == 0
    kept = code[~left].double()
    inner, outer = kept.T @ kept, kept.T @ y[~left].double()
    plain = []
    for regularization in RIDGES:
        ridge = regularization * inner.diagonal().mean() * torch.eye(40, dtype=torch.float64)
        plain.append((code[left].double() @ torch.linalg.solve(inner + ridge, outer) - y[left]).square().sum())
    rest, aim = code[left].double(), y[left].double()
    found = left_out_errors(inner, outer, rest.T @ rest, rest.T @ aim, RIDGES) + aim.square().sum()
    torch.testing.assert_close(found, torch.stack(plain), rtol=1e-5, atol=0)


def test_more_noise_asks_for_more_ridge_and_never_loses_to_the_mean() -> None:
    regularizations = []
    for noise in (0.01, 0.3, 100.0):
        inputs, truth, names = world(noise)
        found = fit_linear(inputs[:200], truth[:200], names[:200], rank=40)
        error = (found(inputs[200:]) - truth[200:]).square().mean()
        blank = (truth[:200].mean(0) - truth[200:]).square().mean()
        assert error < 1.02 * blank
        regularizations.append(found.regularization)
    assert regularizations[0] < regularizations[1] < regularizations[2]


def test_same_seed_same_numbers_and_wrong_input_is_named() -> None:
    inputs, truth, names = world(0.1)
    one, other = (fit_linear(inputs, truth, names, rank=8, seed=3)(inputs[:3]) for _ in range(2))
    assert torch.equal(one, other)
    with pytest.raises(DataError, match="2 images"):
        fit_linear(inputs, truth[:2], names)
    with pytest.raises(DataError, match="at least two"):
        fit_linear(inputs[:10], truth[:10], names[:10])
