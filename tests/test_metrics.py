"""Metrics against closed forms and a slow, obvious reference."""

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d
from scipy.signal import convolve2d, correlate2d

from evnlos import EvnlosError, psnr, ssim
from evnlos.metrics import gmsd, haarpsi, ms_ssim


def slow_ssim(x: np.ndarray, y: np.ndarray) -> float:
    taps = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    taps /= taps.sum()

    def blur(image: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(image, taps, axis=0), taps, axis=1)[5:-5, 5:-5]

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    top = (2 * mx * my + 1e-4) * (2 * cov + 9e-4)
    return float((top / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))).mean())


def test_psnr_of_a_constant_error() -> None:
    truth = torch.rand(3, 8, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert psnr(truth + 0.01, truth) == pytest.approx([40.0] * 3, abs=1e-9)
    assert psnr(truth * 255 + 2.55, truth * 255, peak=255.0) == pytest.approx([40.0] * 3, abs=1e-9)
    assert torch.isinf(psnr(truth, truth)).all()


@pytest.mark.parametrize("seed", range(4))
def test_ssim_is_that_of_the_slow_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = rng.random((23, 31))
    y = np.clip(x + 0.2 * rng.standard_normal(x.shape), 0, 1)
    assert ssim(torch.from_numpy(x), torch.from_numpy(y)).item() == pytest.approx(slow_ssim(x, y), abs=1e-12)


def test_a_batch_is_its_single_images() -> None:
    x, y = torch.rand(2, 3, 4, 16, 17, generator=torch.Generator().manual_seed(1)).double()
    together = ssim(x, y)
    assert together.shape == (3, 4)
    assert together[1, 2].item() == pytest.approx(ssim(x[1, 2], y[1, 2]).item(), abs=1e-12)


def test_an_all_black_image_of_a_sparse_target_already_has_a_high_ssim() -> None:
    truth = torch.zeros(48, 96)
    truth[20:28, 40:42] = 1.0
    assert ssim(torch.zeros_like(truth), truth).item() > 0.8


@pytest.mark.parametrize(
    ("image", "truth", "says"),
    [
        (torch.zeros(8, 8), torch.zeros(8, 9), "differ"),
        (torch.full((16, 16), float("nan")), torch.zeros(16, 16), "NaN"),
        (torch.zeros(16, 16, dtype=torch.uint8), torch.zeros(16, 16, dtype=torch.uint8), "floats"),
        (torch.zeros(8, 8), torch.zeros(8, 8), "window"),
    ],
)
def test_bad_input(image: torch.Tensor, truth: torch.Tensor, says: str) -> None:
    with pytest.raises(EvnlosError, match=says):
        ssim(image, truth)


def pairs(seed: int, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = rng.random((height, width))
    return x, np.clip(x + 0.2 * rng.standard_normal(x.shape), 0, 1)


def halved(x: np.ndarray) -> np.ndarray:
    height, width = x.shape[0] // 2 * 2, x.shape[1] // 2 * 2
    return sum(x[a:height:2, b:width:2] for a in (0, 1) for b in (0, 1)) / 4


def slow_gmsd(x: np.ndarray, y: np.ndarray) -> float:
    def magnitude(image: np.ndarray) -> np.ndarray:
        edge = np.array([[1, 0, -1]] * 3) / 3
        return np.hypot(correlate2d(image, edge, "valid"), correlate2d(image, edge.T, "valid"))

    a, b = magnitude(255 * halved(x)), magnitude(255 * halved(y))
    return float(((2 * a * b + 170) / (a**2 + b**2 + 170)).std())


def slow_haarpsi(x: np.ndarray, y: np.ndarray) -> float:
    def logistic(value: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.exp(-4.2 * value))

    top = bottom = 0.0
    a, b = 255 * halved(x), 255 * halved(y)
    for turned in (False, True):
        sizes = []
        for scale in (2, 4, 8):
            edge = np.ones((scale, scale)) / scale
            edge[: scale // 2] *= -1
            edge = edge.T if turned else edge
            sizes.append([np.abs(convolve2d(image, edge, "same")) for image in (a, b)])
        likeness = [(2 * p * q + 900) / (p * p + q * q + 900) for p, q in sizes[:2]]
        weight = np.maximum(*sizes[2])
        top += (logistic(0.5 * (likeness[0] + likeness[1])) * weight).sum()
        bottom += weight.sum()
    return float((np.log(top / bottom / (1 - top / bottom)) / 4.2) ** 2)


def slow_ms_ssim(x: np.ndarray, y: np.ndarray, scales: int) -> float:
    weights = np.array([0.0448, 0.2856, 0.3001, 0.2363, 0.1333][:scales])
    weights /= weights.sum()
    taps = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    taps /= taps.sum()

    def blur(image: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(image, taps, axis=0), taps, axis=1)[5:-5, 5:-5]

    result = 1.0
    for scale, weight in enumerate(weights):
        if scale:
            x, y = halved(x), halved(y)
        mx, my = blur(x), blur(y)
        cs = (2 * (blur(x * y) - mx * my) + 9e-4) / (blur(x * x) - mx**2 + blur(y * y) - my**2 + 9e-4)
        if scale == scales - 1:
            cs = cs * (2 * mx * my + 1e-4) / (mx**2 + my**2 + 1e-4)
        result *= max(cs.mean(), 0) ** weight
    return float(result)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("height", "width", "scales"), [(48, 96, 3), (61, 50, 3), (12, 13, 1)])
def test_ms_ssim_is_that_of_the_slow_reference(seed: int, height: int, width: int, scales: int) -> None:
    x, y = pairs(seed, height, width)
    found = ms_ssim(torch.from_numpy(x), torch.from_numpy(y)).item()
    assert found == pytest.approx(slow_ms_ssim(x, y, scales), abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("shape", [(48, 96), (33, 47)])
def test_gmsd_and_haarpsi_are_those_of_the_slow_references(seed: int, shape: tuple[int, int]) -> None:
    x, y = pairs(seed, *shape)
    a, b = torch.from_numpy(x), torch.from_numpy(y)
    assert gmsd(a, b).item() == pytest.approx(slow_gmsd(x, y), abs=1e-12)
    assert haarpsi(a, b).item() == pytest.approx(slow_haarpsi(x, y), abs=1e-9)


@pytest.mark.parametrize(("metric", "best"), [(ms_ssim, 1.0), (gmsd, 0.0), (haarpsi, 1.0)])
def test_metrics_know_the_same_and_the_worse_and_batches(metric, best: float) -> None:
    truth = torch.rand(2, 3, 48, 64, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    assert metric(truth, truth) == pytest.approx(np.full((2, 3), best), abs=1e-9)
    distance = [(metric(truth + level * noise, truth) - best).abs() for level in (0.02, 0.2)]
    assert (distance[1] > distance[0]).all()
    assert metric(truth + noise, truth)[1, 2] == pytest.approx(
        metric((truth + noise)[1, 2], truth[1, 2]).item(), abs=1e-12
    )
    with pytest.raises(EvnlosError, match="pixels per side"):
        metric(torch.zeros(5, 20), torch.zeros(5, 20))


def test_haarpsi_of_two_empty_images_is_one() -> None:
    assert haarpsi(torch.zeros(16, 16), torch.zeros(16, 16)).item() == 1.0


def test_peaks_and_windows_that_are_none_are_refused() -> None:
    image = torch.linspace(0, 1, 256).reshape(16, 16)
    for call in (lambda: psnr(image, image, peak=0), lambda: ssim(image, image, window=10)):
        with pytest.raises(EvnlosError):
            call()
