"""A setup fitted to sequences of objects that nobody knows."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from evnlos.calibration import Calibration, fit_setup, read_capture_set
from evnlos.calibration.blind_calibration import CELLS, WRITERS, FrameResiduals, fit_blind
from evnlos.errors import ConfigError, DataError
from evnlos.inverse.prior import handwritten_targets
from evnlos.setups import PaperSetup, RadiometricSetup

SETUP = RadiometricSetup(roughness=0.06)
PLACES = np.stack([np.linspace(-0.06, 0.06, 7), np.zeros(7)], axis=1)
SHAPE = (6, 10)


def sequences(noise: float, seed: int = 0) -> tuple[FrameResiduals, torch.Tensor]:
    """Return frames of unseen handwriting with noise in units of what moves, and the true targets."""
    draw = torch.Generator().manual_seed(seed)
    empty = FrameResiduals(torch.zeros(1, 7, *SHAPE), PLACES, 0.08, CELLS)
    targets = handwritten_targets(empty.target_plane, WRITERS).test[::2].unflatten(1, empty.target_plane.shape)
    light = empty.sight(SETUP)(targets)
    light = light / light.std()
    light = light + noise * torch.randn(light.shape, generator=draw)
    # Ambient light and the pattern of the camera: still, and of any form.
    light = light + 3 * torch.rand(SHAPE, generator=draw)
    return FrameResiduals(light, PLACES, 0.08, CELLS), targets


def test_the_evidence_is_that_of_the_dense_gaussian() -> None:
    light, _ = sequences(0.3)
    sight, terms = light.sight(SETUP), light.terms(SETUP)
    prior = handwritten_targets(light.target_plane, WRITERS)
    gain, variance = 0.7 / terms.lit**0.5, 0.05
    eye = torch.eye(CELLS**2, dtype=torch.float64).unflatten(1, light.target_plane.shape)
    matrix = sight(eye)  # [n n, N, h, w]
    matrix = (matrix - matrix.mean(dim=1, keepdim=True)).flatten(1).mT
    # The means of the sequence take 1 of 7 dimensions: look at 6 of an orthonormal basis of the others.
    basis = torch.linalg.svd(torch.eye(7).double() - 1 / 7)[0][:, :6]
    onto = torch.kron(basis.mT.contiguous(), torch.eye(SHAPE[0] * SHAPE[1]).double())
    seen, through = light.moving.flatten(1) @ onto.mT, onto @ matrix
    covariance = gain**2 * through @ prior.root @ prior.root.mT @ through.mT
    dense = multivariate_normal(
        (gain * through @ prior.mean).numpy(), (covariance + variance * torch.eye(len(onto))).numpy()
    )
    expected = -dense.logpdf(seen.numpy()).mean() - 0.5 * len(onto) * np.log(2 * np.pi)
    assert terms.samples == len(onto)
    assert terms.cost(gain, variance) * len(onto) == pytest.approx(expected, rel=1e-7)  # the matrix is float32


def test_the_right_wall_is_the_likeliest_and_shows_the_targets() -> None:
    light, targets = sequences(0.1)
    found = {
        rough: light.explained(replace(SETUP, roughness=rough)) for rough in (0.03, 0.045, 0.06, 0.08, 0.12)
    }
    assert min(found, key=lambda rough: found[rough].cost) == 0.06
    best = found[0.06]
    assert best.noise == pytest.approx(0.1, rel=0.15)
    shown, true = (one.flatten(1) - one.flatten(1).mean(dim=1, keepdim=True) for one in (best.targets, targets))
    alike = (shown * true).sum(dim=1) / (shown.norm(dim=1) * true.norm(dim=1))
    assert float(alike.mean()) > 0.5


def test_a_setup_is_found_without_its_targets(tiny_captures, tmp_path) -> None:
    fit, held = read_capture_set(tiny_captures, holdout=("4",), target_size_m=0.08)
    assert all(capture.target is None for capture in (*fit.captures, *held.captures))
    start = RadiometricSetup(roughness=0.12)  # the lab's is 0.05
    known = ("distance_m", "target_offset_m", "camera_distance_m", "camera_angle_deg", "field_of_view_deg")
    found = fit_blind(fit, held, start, fixed=known, iterations=4)
    assert found.optics.setup.roughness == pytest.approx(0.05, rel=0.1)
    assert found.check.after < found.check.before
    assert found.check.noise <= found.check.after
    assert all(capture.target is not None for capture in (*found.fitted.captures, *found.held_out.captures))


def test_unknown_targets_need_a_radiometric_start_and_a_motion(tiny_captures, tmp_path) -> None:
    start = replace(Calibration().start, setup=PaperSetup())
    with pytest.raises(ConfigError, match="radiometric"):
        Calibration(targets="unknown", start=start)
    folder = tmp_path / "lab_A"
    folder.mkdir()
    for path in tiny_captures[0].rglob("*"):
        if path.is_file():
            (folder / path.relative_to(tiny_captures[0])).parent.mkdir(exist_ok=True)
            (folder / path.relative_to(tiny_captures[0])).write_bytes(path.read_bytes())
    text = (folder / "capture.yaml").read_text()
    (folder / "capture.yaml").write_text(text[: text.index("motion:")])
    with pytest.raises(DataError, match=r"no known motion.*evnlos track"):
        fit_setup([folder, *tiny_captures[1:]], Calibration(targets="unknown"))
