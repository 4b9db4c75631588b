"""The frame camera against the closed forms of its noise model."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from evnlos import EvnlosError, FrameCamera
from evnlos.cameras.random_numbers import few_electrons, many_electrons
from evnlos.errors import ConfigError

QUIET = {"read_noise_e": 0.0, "prnu": 0.0, "dsnu_e": 0.0, "full_well_e": 1e10, "bit_depth": 16}


class Ramp:
    """A wall whose light grows with the square of time."""

    shape = (3, 5)
    speed_px_s = 0.0

    def irradiance(self, t_s) -> torch.Tensor:
        t = torch.as_tensor(np.asarray(t_s), dtype=torch.float64)
        return (t**2).reshape(-1, 1, 1).expand(-1, *self.shape).float()


def noise_dn(level: float, **settings: float) -> np.ndarray:
    camera = FrameCamera(**({"bit_depth": 16, "prnu": 0.0, "dsnu_e": 0.0, "read_noise_e": 0.0} | settings))
    return camera.expose(np.full((40, 50, 50), level), seed=3).astype(float) / camera.white


def test_an_exposure_is_the_mean_over_its_time() -> None:
    frames = FrameCamera(exposure_s=0.4, **QUIET).capture(Ramp(), [0.5, 0.7])
    expected = np.array([0.5, 0.7]) ** 2 + 0.4**2 / 12
    np.testing.assert_allclose(frames[:, 0, 0] / 65535, expected, atol=2e-5)
    at_once = FrameCamera(exposure_s=0.0, **QUIET).capture(Ramp(), [0.5])
    np.testing.assert_allclose(at_once / 65535, 0.25, atol=2e-5)


@pytest.mark.parametrize("level", [0.05, 0.4])
def test_shot_noise_is_the_root_of_the_electrons(level: float) -> None:
    seen = noise_dn(level, full_well_e=5000.0)
    assert seen.mean() == pytest.approx(level, rel=2e-3)
    assert seen.std() == pytest.approx(np.sqrt(level * 5000) / 5000, rel=0.02)


def test_read_noise_adds_in_squares() -> None:
    seen = noise_dn(0.3, full_well_e=5000.0, read_noise_e=30.0)
    assert seen.std() == pytest.approx(np.sqrt(0.3 * 5000 + 30**2) / 5000, rel=0.02)


def test_the_fixed_pattern_stays_and_the_noise_does_not() -> None:
    camera = FrameCamera(prnu=0.05, dsnu_e=0.0, read_noise_e=0.0, full_well_e=1e9, bit_depth=16)
    a, b = (camera.expose(np.full((2, 40, 40), 0.5), seed=s).astype(float) for s in (1, 2))
    assert a[0].std() / a[0].mean() == pytest.approx(0.05, rel=0.1)
    np.testing.assert_allclose(a[0], b[1], rtol=1e-3)
    other = FrameCamera(prnu=0.05, dsnu_e=0.0, read_noise_e=0.0, full_well_e=1e9, bit_depth=16, pattern_seed=9)
    assert (
        abs(np.corrcoef(a[0].ravel(), other.expose(np.full((1, 40, 40), 0.5), seed=1)[0].ravel())[0, 1]) < 0.1
    )


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (12, np.uint16), (16, np.uint16)])
def test_quantisation_and_saturation(bits: int, dtype: type) -> None:
    camera = FrameCamera(**(QUIET | {"bit_depth": bits}), black_level=10.0)
    seen = camera.expose(np.array([[[0.0, 0.5, 1.0, 7.0]]]), seed=0)
    white = 2**bits - 1
    assert seen.dtype == dtype
    np.testing.assert_allclose(seen[0, 0], [10, 10 + (white - 10) / 2, white, white], atol=1.0)


def test_the_same_seed_gives_the_same_frames_and_inputs_stay() -> None:
    light = np.random.default_rng(0).random((2, 6, 7))
    before = light.copy()
    camera = FrameCamera()
    np.testing.assert_array_equal(camera.expose(light, seed=5), camera.expose(light, seed=5))
    assert (camera.expose(light, seed=5) != camera.expose(light, seed=6)).any()
    np.testing.assert_array_equal(light, before)


@pytest.mark.parametrize(
    "settings", [{"full_well_e": 0.0}, {"bit_depth": 7}, {"exposure_s": -1.0}, {"gain": float("nan")}]
)
def test_bad_settings(settings: dict) -> None:
    with pytest.raises(EvnlosError, match=next(iter(settings))):
        FrameCamera(**settings)


@pytest.mark.parametrize("light", [np.full((1, 2, 2), np.nan), np.full((1, 2, 2), -0.1)])
def test_bad_light(light: np.ndarray) -> None:
    with pytest.raises(EvnlosError):
        FrameCamera().expose(light, seed=0)


@pytest.mark.parametrize("mean", [64.0, 300.0, 15_000.0])
def test_many_electrons_have_the_distribution_of_poisson(mean: float) -> None:
    z = np.linspace(-7, 7, 400_001)
    drawn = np.array([many_electrons(mean, value) for value in z])
    edges = np.flatnonzero(np.diff(drawn) > 0)
    assert (np.diff(drawn) >= 0).all()
    np.testing.assert_allclose(stats.norm.cdf(z[edges]), stats.poisson.cdf(drawn[edges], mean), atol=2.1e-4)


@pytest.mark.parametrize("mean", [0.0, 0.3, 5.0, 63.0])
def test_few_electrons_are_the_quantiles_of_poisson(mean: float) -> None:
    uniform = np.linspace(1e-6, 1 - 1e-6, 999)
    drawn = [few_electrons(mean, value) for value in uniform]
    np.testing.assert_array_equal(drawn, stats.poisson.ppf(uniform, mean))


@pytest.mark.parametrize("mean", [3.0, 200.0])
def test_frames_of_any_light_have_shot_noise(mean: float) -> None:
    camera = FrameCamera(full_well_e=65_535.0, bit_depth=16, prnu=0.0, dsnu_e=0.0, read_noise_e=0.0)
    seen = camera.expose(np.full((20, 60, 60), mean / 65_535), seed=1).ravel()
    values = np.arange(seen.max() + 2)
    shares = np.bincount(seen, minlength=len(values)) / seen.size
    np.testing.assert_allclose(shares, stats.poisson.pmf(values, mean), atol=0.006)
    frames = seen.reshape(20, -1).astype(float)
    assert abs(np.corrcoef(frames[0], frames[1])[0, 1]) < 0.05  # each frame has noise of its own


def test_electrons_are_collected_over_the_exposure() -> None:
    """A tenth of the exposure is a tenth of the signal and of its variance; the well is finite."""
    camera = FrameCamera(
        exposure_s=0.01, full_well_e=10_000.0, read_noise_e=0.0, prnu=0.0, dsnu_e=0.0, bit_depth=12,
        electrons_per_s=1e6, gain=1.0,
    )  # fmt: skip
    light = np.full((1, 100, 100), 0.5)
    long, short = (
        replace(camera, exposure_s=time).expose(light, seed=1).astype(float) for time in (0.01, 0.001)
    )
    unit = camera.dn_per_electron
    assert long.mean() / unit == pytest.approx(5000, rel=0.01)
    assert short.mean() / unit == pytest.approx(500, rel=0.01)
    assert short.var() / unit**2 == pytest.approx(500, rel=0.1)
    full = replace(camera, exposure_s=0.1).expose(light, seed=1).astype(float)
    assert full.mean() / unit == pytest.approx(10_000, rel=0.01)
    amplified = replace(camera, exposure_s=0.001, gain=8.0).expose(light, seed=1).astype(float)
    assert amplified.mean() == pytest.approx(8 * short.mean(), rel=0.01)
    with pytest.raises(ConfigError):
        FrameCamera(electrons_per_s=1e6, exposure_s=0.0)
