"""The tPSF: sign, shape, truncation, normalisation, length scale."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from evnlos.errors import ConfigError
from evnlos.optics import tpsf_kernel, tpsf_profile, tpsf_truncation


def brute_force(rho: float, t: float, mean_free_path: float, last: int) -> float:
    """Sum both signs of k, smallest terms first."""
    k = torch.arange(last, 0, -2, dtype=torch.float64)
    total = 0.0
    for sign in (1, -1):
        a = mean_free_path + sign * k * t
        total = total + a / (a**2 + rho**2) ** 1.5
    return float(total.sum()) * t / mean_free_path / (2 * math.pi)


def test_values_of_the_paper():
    rho = torch.linspace(0, 2, 100, dtype=torch.float64)
    h = tpsf_profile(rho)
    assert bool((h < 0).all())
    assert float(h[0]) == pytest.approx(-0.234, abs=5e-4)
    assert float(h[-1] / h[0]) == pytest.approx(0.072, abs=5e-4)
    assert bool((h.abs().diff() < 0).all())
    half = rho[(h / h[0] - 0.5).abs().argmin()]
    assert float(half) == pytest.approx(0.85, abs=0.03)


@settings(max_examples=25, deadline=None)
@given(st.floats(0, 6), st.floats(0.5, 4), st.floats(0.05, 0.4), st.integers(1, 40))
def test_truncation_bound_holds(rho, t, ratio, terms):
    mean_free_path = ratio * t
    value = float(tpsf_profile(torch.tensor(rho, dtype=torch.float64), t, mean_free_path, terms))
    # The reference's own tail falls with the square of its last k.
    truth = brute_force(rho, t, mean_free_path, 400_001)
    slack = (
        t / mean_free_path / (2 * math.pi) * mean_free_path / (t * (400_000 * t - mean_free_path) ** 2) + 1e-13
    )
    assert abs(value - truth) <= tpsf_truncation(t, mean_free_path, terms) + slack


def test_truncation_bound_is_not_idle():
    """Within a factor of twenty of the error it bounds, and falling with the fourth power."""
    value = float(tpsf_profile(torch.zeros((), dtype=torch.float64), terms=4))
    error = abs(value - brute_force(0.0, 2.0, 0.8, 2_000_001))
    assert error > tpsf_truncation(terms=4) / 20
    assert tpsf_truncation(terms=40) < 1.1e-4 * tpsf_truncation(terms=4)
    assert tpsf_truncation() < 5e-10


def test_kernel_is_the_profile_on_a_disc():
    kernel = tpsf_kernel(0.001, 0.01)
    assert kernel.shape == (41, 41)
    assert float(kernel.sum()) == pytest.approx(1.0, abs=1e-14)
    y, x = torch.meshgrid(torch.arange(-20, 21), torch.arange(-20, 21), indexing="ij")
    rho = (x**2 + y**2).double().sqrt() / 10
    expected = torch.where(rho <= 2, tpsf_profile(rho), torch.zeros(()))
    torch.testing.assert_close(kernel, expected / expected.sum(), rtol=1e-12, atol=1e-16)
    assert torch.equal(kernel, kernel.flip(0))
    assert torch.equal(kernel, kernel.mT)


def test_points_of_the_paper_set_the_scale_when_no_length_is_given():
    assert tpsf_kernel().shape == (199, 199)
    torch.testing.assert_close(tpsf_kernel(points=11), tpsf_kernel(1.0, 5.0))


def test_length_is_physical():
    """The half-width in metres does not depend on the pitch."""
    for pitch in (0.0005, 0.001, 0.002):
        row = tpsf_kernel(pitch, 0.02)
        row = row[row.shape[0] // 2]
        half = float((row >= row.max() / 2).sum()) * pitch / 2
        assert half == pytest.approx(0.83 * 0.02, abs=pitch)


def test_taper():
    hard, soft = tpsf_kernel(0.001, 0.02), tpsf_kernel(0.001, 0.02, window=0.5)
    middle = hard.shape[0] // 2
    assert float(hard[middle, 0] / hard.max()) == pytest.approx(0.072, abs=1e-3)
    assert float(soft[middle, 0] / soft.max()) < 1e-12
    inner = slice(middle - 20, middle + 21)  # rho <= 1, untouched by the window
    ratio = soft[middle, inner] / hard[middle, inner]
    assert float(ratio.max() / ratio.min()) == pytest.approx(1.0, abs=1e-12)
    assert float(soft.sum()) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("t is", {"t": 0.0}),
        ("mean_free_path is", {"mean_free_path": -1.0}),
        ("pole", {"mean_free_path": 2.0}),
        ("terms", {"terms": 0}),
        ("kernel_radius", {"kernel_radius": 0.0}),
        ("window", {"window": 1.5}),
        ("points", {"points": 1}),
        ("pitch_m", {"pitch_m": math.nan}),
        ("length_m", {"length_m": 0.0}),
        ("4097", {"length_m": 10_000.0}),
    ],
)
def test_bad_input(name, changed):
    with pytest.raises(ConfigError, match=name):
        tpsf_kernel(**changed)
