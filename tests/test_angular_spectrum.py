"""Free-space propagation against analytic truth, at tolerances that float32 mistakes do not pass."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import fresnel

from evnlos.errors import ConfigError, DataError
from evnlos.optics import (
    angular_spectrum,
    blur_radius_px,
    fresnel_number,
    sampling_limit_m,
)
from evnlos.optics.angular_spectrum import transfer_function

WAVELENGTH = 500e-9


def axis(samples: int, pitch: float) -> torch.Tensor:
    return (torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2) * pitch


def relative(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).norm() / b.norm())


def gaussian(samples: int, pitch: float, waist: float, distance: float) -> torch.Tensor:
    """Paraxial Gaussian beam without its carrier; complex128."""
    x = axis(samples, pitch)
    q = complex(1, distance * WAVELENGTH / (math.pi * waist**2))
    return torch.exp(-(x[:, None] ** 2 + x**2) / (waist**2 * q)) / q


def square_aperture(samples: int, pitch: float, side: float, distance: float) -> torch.Tensor:
    """Fresnel integral of a square opening, complex128."""
    x = axis(samples, pitch).numpy()
    scale = math.sqrt(2 / (WAVELENGTH * distance))
    (s1, c1), (s0, c0) = fresnel(scale * (x + side / 2)), fresnel(scale * (x - side / 2))
    one = torch.as_tensor(((c1 - c0) + 1j * (s1 - s0)) / np.sqrt(2j))
    return one[:, None] * one


def rayleigh_sommerfeld_sum(
    field: torch.Tensor, pitch_m: float, wavelength_m: float, distance_m: float, *, carrier: bool = False
) -> torch.Tensor:
    """Propagate by the first Rayleigh-Sommerfeld integral, summed directly (paper Eq. 16).

    E(p) = sum over q of U(q) z / (2 pi r^2) (1/r - j k) exp(j k r) dx^2, with r the distance from q to p; the
    term 1/r, which the paper drops, is kept.

    The field [H, W] comes back as complex128, with the factor exp(j k z) where `carrier` says so.
    """
    height, width = field.shape
    k = 2 * math.pi / wavelength_m
    dy = torch.arange(1 - height, height, dtype=torch.float64) * pitch_m
    dx = torch.arange(1 - width, width, dtype=torch.float64) * pitch_m
    lateral = dy[:, None] ** 2 + dx**2
    r = (lateral + distance_m**2).sqrt()
    excess = lateral / (r + distance_m)  # r - z without cancellation
    start = k * distance_m if carrier else 0.0
    impulse = torch.polar(distance_m / (2 * math.pi * r**2), k * excess + start) * torch.complex(
        1 / r, -k + 0 * r
    )
    source = field.to(torch.complex128)
    out = torch.zeros_like(source)
    for i in range(height):
        for j in range(width):
            window = impulse[height - 1 - i : 2 * height - 1 - i, width - 1 - j : 2 * width - 1 - j]
            out += source[i, j] * window
    return out * pitch_m**2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.complex64, torch.complex128])
def test_gaussian_beam(dtype):
    start = gaussian(512, 10e-6, 0.3e-3, 0.0).real.to(dtype)
    moved = angular_spectrum(start, 10e-6, WAVELENGTH, 0.4)
    assert moved.dtype == (torch.complex64 if dtype in (torch.float32, torch.complex64) else torch.complex128)
    assert relative(moved, gaussian(512, 10e-6, 0.3e-3, 0.4)) <= 1e-6


def test_gaussian_beam_backwards():
    waist = gaussian(256, 10e-6, 0.3e-3, 0.0)
    there = angular_spectrum(gaussian(256, 10e-6, 0.3e-3, 0.1), 10e-6, WAVELENGTH, -0.1)
    assert relative(there, waist) <= 1e-6


def test_square_aperture_beyond_the_sampling_limit():
    samples, pitch = 512, 10e-6
    assert sampling_limit_m(samples, pitch, WAVELENGTH) < 1.0
    x = axis(samples, pitch).abs() < 0.8e-3
    opening = (x[:, None] & x).double()
    truth = square_aperture(samples, pitch, 1.6e-3, 1.0)
    limited = relative(angular_spectrum(opening, pitch, WAVELENGTH, 1.0), truth)
    unlimited = relative(angular_spectrum(opening, pitch, WAVELENGTH, 1.0, band_limit=False), truth)
    assert limited < 1e-2
    assert unlimited > 10 * limited


@pytest.mark.parametrize("distance", [2e-3, 4e-3])
def test_direct_sum(distance):
    pitch = 4e-6
    x = axis(56, pitch)
    start = torch.exp(-(x[:, None] ** 2 + (x - 1e-5) ** 2) / 2e-5**2) * torch.exp(1j * 2e4 * x)
    slow = rayleigh_sommerfeld_sum(start, pitch, WAVELENGTH, distance)
    fast = angular_spectrum(start, pitch, WAVELENGTH, distance, pad=3)
    assert relative(fast, slow) < 1e-10
    carried = rayleigh_sommerfeld_sum(start, pitch, WAVELENGTH, distance, carrier=True)
    assert relative(angular_spectrum(start, pitch, WAVELENGTH, distance, pad=3, carrier=True), carried) < 1e-7


@pytest.mark.parametrize(("inset", "order"), [(0.0, 2.0), (0.25, 1.0)])
def test_order_of_convergence(inset, order):
    """Second order when the opening's edge lies between samples, first order when it cuts a cell."""
    errors = []
    for samples in (96, 192, 384):
        pitch = 2.4e-3 / samples
        side = 2 * (samples // 4 + inset) * pitch
        inside = axis(samples, pitch).abs() < side / 2
        opening = (inside[:, None] & inside).double()
        moved = angular_spectrum(opening, pitch, WAVELENGTH, 0.1, pad=4)
        errors.append(relative(moved, square_aperture(samples, pitch, side, 0.1)))
    orders = [math.log2(a / b) for a, b in pairwise(errors)]
    assert all(abs(found - order) < 0.25 for found in orders), (errors, orders)


def test_spectral_convergence_of_a_smooth_field():
    coarse, fine = (
        relative(
            angular_spectrum(gaussian(n, 4.8e-3 / n, 0.3e-3, 0.0), 4.8e-3 / n, WAVELENGTH, 0.2),
            gaussian(n, 4.8e-3 / n, 0.3e-3, 0.2),
        )
        for n in (24, 48)
    )
    assert coarse > 5e-4
    assert fine < 1e-7


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**31), st.floats(1e-3, 0.3), st.sampled_from([(33, 48), (64, 64), (51, 30)]))
def test_forward_then_backward_is_the_identity_in_band(seed, distance, shape):
    generator = torch.Generator().manual_seed(seed)
    start = torch.randn(*shape, generator=generator, dtype=torch.complex128)
    there = angular_spectrum(start, 10e-6, WAVELENGTH, distance, pad=1)
    back = angular_spectrum(there, 10e-6, WAVELENGTH, -distance, pad=1)
    transfer = transfer_function(shape, 10e-6, WAVELENGTH, distance, True, torch.complex128)
    in_band = torch.fft.ifft2(torch.fft.fft2(start) * (transfer.abs() > 0.5))
    assert relative(back, in_band) < 1e-12
    assert abs(there.norm() - in_band.norm()) < 1e-12 * in_band.norm()


def test_energy_is_kept():
    start = gaussian(256, 10e-6, 0.3e-3, 0.0)
    moved = angular_spectrum(start, 10e-6, WAVELENGTH, 0.4)
    assert abs(float(moved.norm() / start.norm()) - 1) < 1e-7


def test_zero_distance_is_the_identity():
    start = torch.randn(17, 23, generator=torch.Generator().manual_seed(0), dtype=torch.complex128)
    assert relative(angular_spectrum(start, 10e-6, WAVELENGTH, 0.0), start) < 1e-14


def test_pruned_transform_equals_the_plain_one():
    start = torch.randn(2, 3, 37, 50, generator=torch.Generator().manual_seed(0), dtype=torch.complex128)
    transfer = transfer_function((93, 125), 10e-6, WAVELENGTH, 0.1, True, torch.complex128)
    plain = torch.fft.ifft2(torch.fft.fft2(start, s=(93, 125)) * transfer)[..., :37, :50]
    assert relative(angular_spectrum(start, 10e-6, WAVELENGTH, 0.1, pad=2.5), plain) < 1e-14


@pytest.mark.parametrize("shape", [(2, 150, 201), (130, 260)])
def test_blocked_transform_equals_the_plain_one(shape):
    start = torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.complex128)
    padded = (2 * shape[-2], 2 * shape[-1])
    transfer = transfer_function(padded, 10e-6, WAVELENGTH, 0.1, True, torch.complex128)
    plain = torch.fft.ifft2(torch.fft.fft2(start, s=padded) * transfer)[..., : shape[-2], : shape[-1]]
    before = start.clone()
    assert relative(angular_spectrum(start, 10e-6, WAVELENGTH, 0.1), plain) < 1e-14
    assert torch.equal(start, before)


def test_gradient_of_the_blocked_transform():
    """The adjoint of propagation is propagation backwards."""
    draw = torch.Generator().manual_seed(0)
    u, v = (torch.randn(150, 140, generator=draw, dtype=torch.complex128) for _ in range(2))
    u.requires_grad_()
    (gradient,) = torch.autograd.grad(angular_spectrum(u, 10e-6, WAVELENGTH, 0.05), u, v)
    assert relative(gradient, angular_spectrum(v, 10e-6, WAVELENGTH, -0.05)) < 1e-13


def test_evanescent_waves_decay_both_ways():
    start = torch.zeros(16, 16, dtype=torch.complex128)
    start[8, 8] = 1
    for distance in (1e-6, -1e-6):
        moved = angular_spectrum(start, 100e-9, WAVELENGTH, distance, band_limit=False)
        assert moved.abs().max() < 1
    assert transfer_function((16, 16), 100e-9, WAVELENGTH, -1e-6, False, torch.complex128).abs().max() <= 1


def test_transfer_function_is_cached_and_input_is_unchanged():
    start = torch.ones(8, 8, dtype=torch.float64)
    angular_spectrum(start, 10e-6, WAVELENGTH, 0.123)
    hits = transfer_function.cache_info().hits
    angular_spectrum(start, 10e-6, WAVELENGTH, 0.123)
    assert transfer_function.cache_info().hits == hits + 1
    assert torch.equal(start, torch.ones(8, 8, dtype=torch.float64))


def test_gradient():
    start = torch.randn(
        5, 7, generator=torch.Generator().manual_seed(0), dtype=torch.complex128, requires_grad=True
    )
    assert torch.autograd.gradcheck(lambda u: angular_spectrum(u, 10e-6, WAVELENGTH, 0.05), start)


def test_figures():
    assert fresnel_number(0.04, WAVELENGTH, 0.5) == pytest.approx(6400)
    assert sampling_limit_m(512, 10e-6, WAVELENGTH) == pytest.approx(0.2048)
    assert blur_radius_px(10e-6, WAVELENGTH, 0.5) == pytest.approx(50.0)


@pytest.mark.parametrize(
    ("error", "changed"),
    [
        (ConfigError, {"pitch_m": 0.0}),
        (ConfigError, {"wavelength_m": -1.0}),
        (ConfigError, {"distance_m": math.nan}),
        (ConfigError, {"pad": 0.5}),
        (DataError, {"field": torch.zeros(4)}),
        (DataError, {"field": torch.zeros(4, 4, dtype=torch.int32)}),
    ],
)
def test_bad_input(error, changed):
    good = {"field": torch.zeros(4, 4), "pitch_m": 1e-5, "wavelength_m": WAVELENGTH, "distance_m": 0.1}
    with pytest.raises(error, match=next(iter(changed))):
        angular_spectrum(**(good | changed))
