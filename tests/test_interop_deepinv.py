"""Our operators inside deepinv: adjoint, batches, one of its solvers against ours. Skips without deepinv."""

import warnings

import pytest
import torch

from evnlos.errors import DataError, MissingDependencyError
from evnlos.inverse import as_physics, tikhonov
from evnlos.optics import MatrixTransport
from transports import EXAMPLES


@pytest.fixture
def deepinv():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pytest.importorskip("deepinv", exc_type=ImportError)


def test_absence_is_said(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "deepinv.physics", None)
    with pytest.raises(MissingDependencyError, match="pip install deepinv"):
        as_physics(EXAMPLES["matte wall"]())


def test_adjoint_and_batch(deepinv):
    operator = EXAMPLES["diffuse reflection"]()
    physics = as_physics(operator)
    x = torch.rand(2, 3, *operator.source.shape, generator=torch.Generator().manual_seed(0)).double()
    assert isinstance(physics, deepinv.physics.LinearPhysics)
    assert torch.equal(physics(x), operator(x))
    assert abs(float(physics.adjointness_test(x))) < 1e-9 * float(physics(x).norm() * x.norm())
    with pytest.raises(DataError, match="B, C, h, w"):
        physics.A(x[0])


def test_its_prox_is_our_tikhonov(deepinv):
    """prox of |A x - y|^2 / 2 at 0 with step g is the Tikhonov solution with regularization = 1 / g."""
    example = EXAMPLES["rough metal"]()
    assert isinstance(example, MatrixTransport)
    # Its conjugate gradients add an absolute 1e-8 to a denominator: norm 1 and bright images make that small.
    matrix = example.matrix / torch.linalg.matrix_norm(example.matrix, 2)
    operator = MatrixTransport(matrix, example.source, example.shape)
    y = 1e6 * operator(torch.rand(1, 1, 7, 10, generator=torch.Generator().manual_seed(1)).double())
    theirs = as_physics(operator).prox_l2(torch.zeros(1, 1, 7, 10).double(), y, 1e3, max_iter=500, tol=1e-10)
    ours = tikhonov(operator, y, 1e-3).image
    assert (theirs - ours).norm() < 1e-5 * ours.norm()
