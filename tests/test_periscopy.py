"""The real photograph, and photographs of our own, from file to image."""

import json
import sys

import numpy as np
import pytest
import torch

from evnlos.cli import main
from evnlos.cli.invert import InvertCommand, correlation, to_text
from evnlos.errors import ConfigError, DataError
from evnlos.inverse import prepare_inversion, read_photograph
from evnlos.inverse.inversion import convex_occluders


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A photograph of our own making: 12 x 10 cells, a post in between, some noise, a background."""
    path = tmp_path_factory.mktemp("photograph") / "own.npz"
    post = [[0.24, 0.2, 0.0], [0.27, 0.2, 0.4], [0.27, 0.2, 0.0], [0.24, 0.2, 0.4]]  # crosses itself as written
    cross = [[0.1, 0.2, 0.2], [0.4, 0.2, 0.2], [0.4, 0.2, 0.23], [0.1, 0.2, 0.23]]
    data = {
        "wall": np.zeros((32, 32)),
        "wall_x_m": np.linspace(0.1, 0.4, 32),
        "wall_z_m": np.linspace(0.4, 0.0, 32),
        "cell_x_m": np.linspace(0.4, 0.1, 12),
        "cell_z_m": np.linspace(0.35, 0.05, 10),
        "cell_size_m": np.array([0.027, 0.033]),
        "distance_m": np.array(0.4),
        "occluder_polygons_m": np.array([post, cross]),
        "emission_exponent": np.array([0.0, 2.0]),
    }
    truth = np.zeros((10, 12))
    truth[2:7, 3:6] = 1
    truth[6:8, 3:10] = 1
    np.savez(path, **data)
    clean = read_photograph(path).transport()(torch.as_tensor(truth)).numpy()
    rng = np.random.default_rng(0)
    smooth = 0.3 * clean.max() * np.linspace(0.5, 1, 32)[:, None]
    data["wall"] = clean + smooth + 0.002 * clean.max() * rng.standard_normal(clean.shape)
    np.savez(path, **data, truth=truth)
    return path


def test_without_matplotlib_what_was_found_is_kept(made, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    main(["invert", str(made), "--solver", "tikhonov", "--out", str(tmp_path / "p.png"), "--json"])
    said = capsys.readouterr()
    assert json.loads(said.out)["picture"] is None
    assert "evnlos[plot]" in said.err
    assert np.load(tmp_path / "p.npz")["tikhonov"].shape == (1, 10, 12)


def test_own_photograph_needs_its_occluder(made):
    photograph = read_photograph(made)
    assert photograph.truth is not None
    inversion = prepare_inversion(photograph)
    for rule in ("cv", "gcv", "discrepancy"):
        assert correlation(inversion.solve("tikhonov", rule=rule).image, photograph.truth) > 0.8
    for rule in ("cv", "discrepancy"):
        found = inversion.solve("tv", rule=rule)
        assert float(found.image.min()) >= 0
        assert correlation(found.image, photograph.truth) > 0.8
    blind = prepare_inversion(photograph, degree=inversion.degree, occluded=False)
    assert correlation(blind.solve("tikhonov").image, photograph.truth) < 0.4
    with pytest.raises(ConfigError, match="linear solver"):
        inversion.solve("tv", rule="gcv")


def test_a_photograph_without_its_truth_gives_the_same_image(made, tmp_path):
    data = dict(np.load(made))
    del data["truth"]
    np.savez(tmp_path / "blind.npz", **data)
    with_truth, without = (
        prepare_inversion(read_photograph(p)).solve("tikhonov") for p in (made, tmp_path / "blind.npz")
    )
    assert torch.equal(with_truth.image, without.image)


def test_binning_keeps_place_and_mean(made):
    photograph = read_photograph(made)
    binned = photograph.binned(2)
    assert binned.patches.shape == (16, 16)
    assert binned.patches.size_m[0] == pytest.approx(2 * photograph.patches.size_m[0])
    assert float(binned.wall.mean()) == pytest.approx(float(photograph.wall.mean()), rel=1e-6)
    assert binned.patches.x_m.mean() == pytest.approx(photograph.patches.x_m.mean())
    with pytest.raises(ConfigError, match="binning is 33"):
        photograph.binned(33)


def test_corners_are_put_in_order(made):
    (post, _) = convex_occluders(np.load(made)["occluder_polygons_m"], 0.4)
    x, y, _ = np.array(post.vertices_m).T
    area = abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2
    assert area == pytest.approx(0.03 * 0.4)


def test_command(made, tmp_path, capsys):
    out = tmp_path / "picture.png"
    InvertCommand((made,), out=out, json=True).run()
    found = json.loads(capsys.readouterr().out)
    assert set(found["solutions"]) == {"tikhonov", "tv", "without occluder"}
    assert out.stat().st_size > 1000
    assert np.load(out.with_suffix(".npz"))["tv"].shape == (1, 10, 12)
    assert "without occluder" in to_text(found)
    InvertCommand(
        (made,),
        solver="tikhonov",
        regularization="1e-4",
        background_degree=2,
        no_occluder=True,
        out=out,
        json=True,
    ).run()
    found = json.loads(capsys.readouterr().out)
    assert list(found["solutions"]) == ["tikhonov"]
    assert found["solutions"]["tikhonov"]["regularization"] == 1e-4
    with pytest.raises(ConfigError, match="--regularization is 'x'"):
        InvertCommand((made,), regularization="x", out=out).run()
    with pytest.raises(ConfigError, match="tikhonov only"):
        InvertCommand((made,), regularization="gcv", out=out).run()


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"distance_m": None}, "lacks distance_m"),
        ({"wall": None}, "lacks wall"),
        ({"wall_x_m": np.arange(3.0)}, "make them agree"),
        ({"truth": np.zeros((2, 2))}, "the truth is"),
    ],
)
def test_bad_files_are_refused(made, tmp_path, change, match):
    data = {k: v for k, v in (dict(np.load(made)) | change).items() if v is not None}
    np.savez(tmp_path / "bad.npz", **data)
    with pytest.raises(DataError, match=match):
        read_photograph(tmp_path / "bad.npz")


def test_no_archive_is_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"nothing of the kind")
    with pytest.raises(DataError, match="not an NPZ"):
        read_photograph(tmp_path / "a.npz")


def test_real_photograph(shared_data):
    """r above 0.78 with the chair, total variation no worse, next to nothing without; no truth is used."""
    photograph = read_photograph(shared_data / "periscopy" / "mushroom_chair.npz")
    assert photograph.emission_exponent == (1.0, 18.0)
    assert photograph.truth is not None
    inversion = prepare_inversion(photograph)
    smooth = correlation(inversion.solve("tikhonov").image, photograph.truth)
    sharp = inversion.solve("tv")
    assert sharp.converged
    assert smooth >= 0.78
    assert correlation(sharp.image, photograph.truth) >= smooth
    blind = prepare_inversion(photograph, degree=inversion.degree, occluded=False)
    assert correlation(blind.solve("tikhonov").image, photograph.truth) <= 0.3
