"""Metrics against closed forms and a slow, obvious reference."""

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d

from evnlos import EvnlosError, psnr, ssim


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


def test_an_all_black_picture_of_a_sparse_target_already_has_a_high_ssim() -> None:
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
