"""Every law of the operator protocol over every transport."""

import pytest
import torch

from evnlos.errors import ConfigError, DataError
from evnlos.optics import Diffraction, DiffuseReflection, LinearTransport, MatrixTransport, Transport, compose
from evnlos.types import Plane
from transports import EXAMPLES

DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])


@pytest.fixture(params=EXAMPLES, scope="module")
def transport(request) -> Transport:
    return EXAMPLES[request.param]()


@pytest.fixture(
    params=[name for name, make in EXAMPLES.items() if isinstance(make(), LinearTransport)], scope="module"
)
def linear(request) -> LinearTransport:
    made = EXAMPLES[request.param]()
    assert isinstance(made, LinearTransport)
    return made


def noise(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_registry_holds_both_kinds():
    kinds = {isinstance(make(), LinearTransport) for make in EXAMPLES.values()}
    assert kinds == {True, False}


def test_shapes(transport):
    image = transport(noise(2, 3, *transport.source.shape))
    assert image.shape == (2, 3, *transport.shape)
    assert transport.output is None or transport.output.shape == transport.shape
    assert image.abs().max() > 0


def test_adjoint(linear):
    x, y = noise(3, *linear.source.shape) - 0.5, noise(3, *linear.shape, seed=1) - 0.5
    forward, backward = (linear(x) * y).sum(), (x * linear.adjoint(y)).sum()
    assert abs(forward - backward) <= 1e-10 * max(abs(forward), (linear(x).norm() * y.norm()))


def test_adjoint_is_the_vjp(linear):
    x = noise(*linear.source.shape).requires_grad_()
    y = noise(*linear.shape, seed=1)
    (gradient,) = torch.autograd.grad(linear(x), x, y)
    torch.testing.assert_close(
        gradient, linear.adjoint(y), rtol=1e-11, atol=1e-12 * float(gradient.abs().max())
    )


def test_linear(linear):
    x, y = noise(*linear.source.shape), noise(*linear.source.shape, seed=1)
    together, apart = linear(2 * x - 3 * y), 2 * linear(x) - 3 * linear(y)
    assert (together - apart).norm() <= 1e-12 * (linear(x).norm() + linear(y).norm())


def test_modulus_is_not_linear(transport):
    if isinstance(transport, LinearTransport):
        pytest.skip("claims to be linear")
    assert not hasattr(transport, "adjoint")
    x, y = noise(*transport.source.shape), noise(*transport.source.shape, seed=1)
    error = (transport(x + y) - transport(x) - transport(y)).norm() / transport(x + y).norm()
    assert error > 1e-3


def test_batch_equals_loop(transport):
    x = noise(4, *transport.source.shape)
    torch.testing.assert_close(transport(x), torch.stack([transport(one) for one in x]), rtol=1e-12, atol=1e-14)


def test_adjoint_of_batch_equals_loop(linear):
    y = noise(2, 2, *linear.shape)
    loop = torch.stack([linear.adjoint(one) for one in y.flatten(0, 1)]).unflatten(0, (2, 2))
    torch.testing.assert_close(linear.adjoint(y), loop, rtol=1e-12, atol=1e-13)


def test_gradient(transport):
    x = (noise(*transport.source.shape) + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(transport, x, eps=1e-6, atol=1e-7, rtol=1e-5, fast_mode=True)


def test_float32_agrees(transport):
    x = noise(*transport.source.shape)
    single, double = transport(x.float()), transport(x)
    assert single.dtype == torch.float32
    assert double.dtype == torch.float64
    assert (single - double).norm() <= 2e-6 * double.norm()


@pytest.mark.parametrize("device", DEVICES)
def test_device(transport, device):
    image = transport(noise(*transport.source.shape).to(device))
    assert image.device.type == device


def test_input_is_unchanged_and_state_is_none(transport):
    x = noise(*transport.source.shape)
    before, first = x.clone(), transport(x)
    transport(noise(*transport.source.shape, seed=5, dtype=torch.float32))
    assert torch.equal(x, before)
    assert torch.equal(first, transport(x))


def test_wrong_input_is_refused(transport):
    height, width = transport.source.shape
    with pytest.raises(DataError, match=f"takes .*{height}, {width}"):
        transport(noise(height + 1, width))
    with pytest.raises(DataError, match="dtype"):
        transport(torch.zeros(height, width, dtype=torch.int64))


def test_composition():
    plane = Plane(5, 6, 0.01)
    first = DiffuseReflection(plane, torch.ones(3, 3, dtype=torch.float64))
    second = DiffuseReflection(first.output, torch.ones(1, 5, dtype=torch.float64))
    both = first.then(second)
    x = noise(5, 6)
    assert isinstance(both, LinearTransport)
    torch.testing.assert_close(both(x), second(first(x)))
    assert not isinstance(Diffraction(plane).then(first), LinearTransport)
    with pytest.raises(ConfigError, match="next one takes"):
        compose(first, first)
    with pytest.raises(ConfigError, match="no transport"):
        compose()


def test_matrix_of_wrong_size_is_refused():
    with pytest.raises(ConfigError, match="need"):
        MatrixTransport(torch.zeros(3, 3), Plane(2, 2, 1.0), (1, 3))


def test_reflection_equals_direct_sum():
    plane = Plane(4, 5, 1.0)
    x, kernel = noise(4, 5), noise(3, 5, seed=2)
    expected = torch.zeros(6, 9, dtype=torch.float64)
    for i in range(4):
        for j in range(5):
            expected[i : i + 3, j : j + 5] += x[i, j] * kernel
    torch.testing.assert_close(DiffuseReflection(plane, kernel)(x), expected)
