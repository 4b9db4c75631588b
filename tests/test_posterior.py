"""A learned prior: samples of what it and a measurement leave open, and its file."""

import json

import numpy as np
import pytest
import torch

from evnlos.cli import main
from evnlos.errors import ConfigError, DataError, UnknownNameError
from evnlos.inverse import PatternPrior
from evnlos.models import AboutPrior, LearnedPrior, TargetLikelihood, load_prior, posterior_samples, save_prior
from evnlos.types import Plane

CELLS = 8


class Gaussian(LearnedPrior):
    """The exact denoiser of targets that are normal, mean 0.5 and a covariance with long waves."""

    def __init__(self) -> None:
        super().__init__(AboutPrior(width=8, cells=CELLS, trained_on="a normal distribution"))
        place = torch.arange(CELLS, dtype=torch.float64)
        along = torch.exp(-((place[:, None] - place) ** 2) / 8)
        self.covariance = 0.12**2 * torch.kron(along, along)

    def forward(self, noisy: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        own = torch.eye(CELLS**2, dtype=torch.float64)
        gain = torch.linalg.solve(self.covariance + float(noise[0]) ** 2 * own, self.covariance)
        return (0.5 + (noisy.flatten(1).double() - 0.5) @ gain).float().view_as(noisy)


def test_samples_have_mean_and_covariance_of_the_exact_posterior() -> None:
    """A normal prior and a measurement of nine patterns: the answer is known in closed form."""
    prior, draw = Gaussian(), np.random.default_rng(5)
    patterns = np.linalg.qr(draw.standard_normal((CELLS**2, 9)))[0] * draw.uniform(0.2, 2, 9)
    basis = PatternPrior(Plane(CELLS, CELLS, 0.01), np.full(CELLS**2, 0.5), patterns, 0.0)
    root = draw.standard_normal((9, 9))
    information, score = root @ root.T, root @ draw.standard_normal(9)
    samples = posterior_samples(prior, TargetLikelihood(basis, information, score), 600, seed=2)
    inverse = patterns / np.square(patterns).sum(axis=0)  # z = inverse^T (x - mean)
    covariance = np.linalg.inv(np.linalg.inv(prior.covariance.numpy()) + inverse @ information @ inverse.T)
    mean = 0.5 + covariance @ inverse @ score
    flat = samples.flatten(1).double().numpy()
    deviation = np.sqrt(np.diag(covariance))
    assert np.abs(flat.mean(axis=0) - mean).max() < 5 * deviation.max() / np.sqrt(600) + 0.01
    assert np.abs(flat.std(axis=0) / deviation - 1).mean() < 0.15
    assert np.corrcoef(np.cov(flat.T).ravel(), covariance.ravel())[0, 1] > 0.97


def test_a_measurement_that_says_nothing_leaves_the_prior() -> None:
    prior = Gaussian()
    basis = PatternPrior(Plane(CELLS, CELLS, 0.01), np.full(CELLS**2, 0.5), np.eye(CELLS**2)[:, :3], 0.0)
    samples = posterior_samples(prior, TargetLikelihood(basis, np.zeros((3, 3)), np.zeros(3)), 600)
    assert abs(float(samples.std(dim=0).mean()) / 0.12 - 1) < 0.1
    again = posterior_samples(prior, TargetLikelihood(basis, np.zeros((3, 3)), np.zeros(3)), 600)
    assert torch.equal(samples, again)


def test_a_prior_comes_back_from_its_file(tmp_path) -> None:
    torch.manual_seed(1)
    prior = LearnedPrior(AboutPrior(width=8, cells=CELLS, trained_on="nothing"))
    save_prior(tmp_path / "one.safetensors", prior)
    back, noisy = load_prior(tmp_path / "one.safetensors"), torch.rand(2, CELLS, CELLS)
    assert back.about == prior.about
    assert torch.allclose(back(noisy, torch.ones(2)), prior(noisy, torch.ones(2)), atol=1e-2)  # half precision
    content = bytearray((tmp_path / "one.safetensors").read_bytes())
    content[-3] ^= 1
    (tmp_path / "two.safetensors").write_bytes(content)
    with pytest.raises(DataError):
        load_prior(tmp_path / "two.safetensors")


def test_invert_draws_targets_that_the_frames_allow(tiny_captures, tmp_path, capsys, monkeypatch) -> None:
    torch.manual_seed(1)
    prior = LearnedPrior(AboutPrior(width=8, cells=32, trained_on="nothing"))
    save_prior(tmp_path / "priors" / "targets.safetensors", prior)
    monkeypatch.setenv("EVNLOS_WEIGHTS", str(tmp_path))
    drawn = list[tuple]()
    monkeypatch.setattr("evnlos.plot.results.draw_inversion", lambda *given: drawn.append(given[1:]))
    words = [
        "invert",
        str(tiny_captures[0]),
        "--setup",
        "main-near",
        "--out",
        str(tmp_path / "i.png"),
        "--force",
    ]
    main([*words, "--from", "frames", "--samples", "3", "--json"])
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert 0 <= row["open_share"] <= 1
    with np.load(tmp_path / "i.npz") as arrays:
        name = tiny_captures[0].name
        samples = arrays[f"{name}_samples"]
        assert samples.shape == (3, 32, 32) and 0 <= samples.min() <= samples.max() <= 1
        np.testing.assert_allclose(arrays[name], samples.mean(axis=0), atol=1e-6)
        assert set(np.unique(arrays[f"{name}_truth"])) >= {0.0, 1.0}
    ((panels, side_m),) = drawn
    titles = [f"{name} truth", f"{name}, {row['psnr_db']:.1f} dB of {row['expected_db']:.1f} expected"]
    titles += [f"{name} deviation", *(f"{name} sample {k}" for k in (1, 2, 3))]
    assert [title for title, _ in panels] == titles and side_m == row["side_m"] > 0
    main([*words, "--from", "frames", "--samples", "2"])
    assert "cells that the data leave open" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main([*words, "--samples", "3"])
    assert "--samples 3 takes --from frames, events or both" in capsys.readouterr().err


def test_wrong_requests_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="faces"):
        load_prior("faces")
    basis = PatternPrior(Plane(4, 4, 0.01), np.zeros(16), np.eye(16)[:, :2], 0.0)
    seen = TargetLikelihood(basis, np.eye(2), np.zeros(2))
    with pytest.raises(ConfigError, match="8 x 8"):
        posterior_samples(Gaussian(), seen)
    with pytest.raises(ConfigError, match="0 samples"):
        posterior_samples(Gaussian(), seen, 0)
