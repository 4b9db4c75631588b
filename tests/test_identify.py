"""What a setup can show: the linear algebra against slow truths, the mode counts, the words, the command."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from evnlos.analysis import AnalysisSettings, identify
from evnlos.analysis.identify import modes_above, setup_table, singular_values, verdict_on
from evnlos.analysis.linearized import AskedSize, LinearEstimator, bars, finest_bars, linearized, verdict
from evnlos.app.views import limits_of
from evnlos.calibration import Shown
from evnlos.cameras import FrameCamera
from evnlos.cli import main
from evnlos.config import save_yaml
from evnlos.data import Simulation
from evnlos.data.lab import Lab
from evnlos.errors import ConfigError, DataError
from evnlos.inverse.prior import LETTERS, TEST_CHARACTERS, TRAIN_CHARACTERS, handwritten_targets, letters
from evnlos.scene import HandwritingGlyphs, LineMotion, Scene, Target, TargetPlane
from evnlos.setups import (
    FittedSetup,
    PaperSetup,
    RadiometricSetup,
    named_setup,
    setup_names,
    setup_preset,
    stated_target_m,
)
from evnlos.types import Plane

SMALL = AnalysisSettings(cells=8, height=12, width=20, writers=1)


def random_problem(count: int = 12, pixels: int = 30):
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    root = draw(count, count) / 4
    return draw(pixels, count), 0.3 + 0.1 * draw(count), root, 0.1 + draw(pixels).square()


def test_the_estimator_is_the_textbook_one():
    """x^ = m + C A^T (A C A^T + D)^-1 (y - A m), written out in the pixels' space."""
    matrix, mean, root, variance = random_problem()
    whitened = matrix / variance.sqrt()[:, None]
    gram = whitened.mT @ whitened
    estimator = LinearEstimator.known(gram, mean, root)
    covariance = root @ root.mT
    gain = covariance @ matrix.mT @ torch.linalg.inv(matrix @ covariance @ matrix.mT + torch.diag(variance))
    y = torch.randn(30, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = mean + gain @ (y - matrix @ mean)
    backprojected = matrix.mT @ ((y - matrix @ mean) / variance)
    torch.testing.assert_close(estimator.estimate(backprojected), expected, rtol=1e-9, atol=1e-12)
    assert estimator.noise_error == pytest.approx(float((gain @ torch.diag(variance) @ gain.mT).trace()) / 12)
    # The posterior variance, averaged over the prior, is the expected error: trace(C - K A C).
    posterior = float((covariance - gain @ matrix @ covariance).trace()) / 12
    targets = mean + torch.randn(20_000, 12, generator=torch.Generator().manual_seed(2)).double() @ root.mT
    assert float(estimator.expected_error(targets).mean()) == pytest.approx(posterior, rel=0.03)


def test_expected_error_against_drawn_noise():
    matrix, mean, root, variance = random_problem()
    estimator = LinearEstimator.known(matrix.mT @ (matrix / variance[:, None]), mean, root)
    target = torch.linspace(0, 1, 12, dtype=torch.float64)
    noise = torch.randn(20_000, 30, generator=torch.Generator().manual_seed(3)).double() * variance.sqrt()
    seen = (matrix @ (target - mean) + noise) / variance
    error = (estimator.estimate(seen @ matrix) - target).square().mean()
    assert float(estimator.expected_error(target)) == pytest.approx(float(error), rel=0.03)


def test_white_prior_is_the_general_one_with_independent_cells():
    matrix, _, _, variance = random_problem()
    gram = matrix.mT @ (matrix / variance[:, None])
    power, axes = torch.linalg.eigh(gram)
    white = LinearEstimator.white(gram, power.flip(0), axes.flip(1))
    half = torch.full((12,), 0.5, dtype=torch.float64)
    known = LinearEstimator.known(gram, half, torch.eye(12, dtype=torch.float64) / 2)
    targets = torch.rand(5, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(white.expected(targets), known.expected(targets))
    assert white.noise_error == pytest.approx(known.noise_error)
    assert white.patterns_seen == known.patterns_seen


@settings(max_examples=50, deadline=None)
@given(st.floats(0.3, 8.0), st.floats(-10.0, 10.0))
def test_bars_are_means_over_cells(width, phase):
    """A hundred points per cell of the square wave itself."""
    drawn = bars(16, width, phase)
    points = (np.arange(1600) + 0.5) / 100
    wave = ((points - phase) % (2 * width) < width).reshape(16, 100).mean(axis=1)
    np.testing.assert_allclose(drawn[3].numpy(), wave, atol=0.1)
    torch.testing.assert_close(bars(16, width, phase, upright=False), drawn.mT)


def test_finest_bars_of_known_cameras():
    """A camera of all cells resolves single cells, a blind one nothing, block means of 4 cells bars near 4."""

    def finest(matrix: torch.Tensor) -> float | None:
        power, axes = torch.linalg.eigh(matrix.mT @ matrix)
        estimator = LinearEstimator.white(matrix.mT @ matrix, power.flip(0).clamp(min=0), axes.flip(1))
        return finest_bars(estimator, 16)

    sharp = 1e3 * torch.eye(256, dtype=torch.float64)
    assert finest(sharp) == pytest.approx(1.0)
    assert finest(1e-6 * sharp) is None
    block = torch.kron(torch.eye(4), torch.ones(1, 4) / 4).double()
    found = finest(1e3 * torch.kron(block, block))
    assert found is not None and 3.0 < found < 6.0


@pytest.mark.parametrize("level", [0.05, 0.5])
@pytest.mark.parametrize("known", [True, False])
def test_noise_is_that_of_the_camera(level, known):
    camera = FrameCamera(full_well_e=4000.0, read_noise_e=15.0, prnu=0.03, dsnu_e=20.0, bit_depth=10)
    if known:
        camera = dataclasses.replace(camera, prnu=0.0, dsnu_e=0.0)
    frame = camera.expose(np.full((1, 200, 200), level), seed=1)[0] / camera.white
    variance = camera.noise_variance(torch.tensor(level, dtype=torch.float64), fpn_corrected=known)
    assert float(frame.var()) == pytest.approx(float(variance), rel=0.03)
    plain = dataclasses.replace(camera, prnu=0.0, dsnu_e=0.0)
    quarter = plain.noise_variance(torch.tensor(level), frames=4)
    whole = plain.noise_variance(torch.tensor(level))
    assert float(quarter) == pytest.approx(float(whole) / 4)


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("matte-near", 3),
        ("matte-far", 3),
        ("hard-near", 12),
        ("hard-far", 7),
        ("main-near", 28),
        ("main-far", 14),
        ("easy-far", 47),
        ("aperture-near", 16),
        ("aperture-far", 17),
    ],
)
def test_mode_counts_of_the_presets(name, count):
    found = modes_above(singular_values(linearized(setup_preset(name)).matrix), 1e-2)
    assert abs(found - count) <= max(1, 0.03 * count)


def target_in_the_middle() -> Scene:
    mask = np.zeros((32, 32))
    mask[4:20, 6:10], mask[16:20, 6:28] = 1.0, 0.5
    return Scene(Target("corner", mask), LineMotion(), 8.0)


def test_the_matrix_is_the_setup_that_the_lab_renders():
    for setup in (
        RadiometricSetup(roughness=0.3, gain=0.6, ambient=0.1, ambient_gradient=(0.2, -0.1)),
        RadiometricSetup(roughness=0.3, strip_m=(0.24, 0.12), gain=0.6),
        RadiometricSetup(wall_material="lambert", lamp_m=(-0.4, 0.0, 0.05)),
    ):
        scene, settings = target_in_the_middle(), AnalysisSettings(0.08, height=12, width=20)
        seen = linearized(setup, settings)
        mask = torch.from_numpy(scene.target.rasterise(settings.target_plane)).double().flatten()
        rendered = setup.resized(settings.shape).observe(scene).irradiance(4.0)
        expected = (seen.ambient + seen.matrix @ mask).reshape(settings.shape).float()
        torch.testing.assert_close(rendered, expected, rtol=1e-4, atol=1e-6)


def test_the_papers_matrix_is_its_wall_but_for_diffraction():
    scene, settings = target_in_the_middle(), AnalysisSettings(height=25, width=40)
    for length_m in (0.004, 0.02):
        setup = PaperSetup(tpsf_length_m=length_m, gain=0.9, field_of_view_m=0.3)
        seen = linearized(setup, settings)
        mask = torch.from_numpy(scene.target.rasterise(settings.target_plane)).double().flatten()
        rendered = setup.resized(settings.shape).observe(scene).irradiance(4.0).double().flatten()
        expected = seen.ambient + seen.matrix @ mask
        assert float((rendered - expected).abs().max()) < 0.03 * float(expected.max())


def test_a_cut_tpsf_is_told_apart():
    cut = identify(
        PaperSetup(tpsf_length_m=0.02), settings=AnalysisSettings(cells=16, height=20, width=32, writers=1)
    )
    assert "kink" in cut.warnings[0]
    assert "kernel_radius 2, window 0" in cut.warnings[0]
    faded = identify(
        PaperSetup(tpsf_length_m=0.02, window=1.0),
        settings=AnalysisSettings(cells=16, height=20, width=32, writers=1),
    )
    assert not faded.warnings
    assert PaperSetup().without_artifacts() == PaperSetup(kernel_radius=8.0, window=0.5)


def test_prior_and_test_share_no_character():
    assert not set(TEST_CHARACTERS) & set(TRAIN_CHARACTERS)
    assert len(TEST_CHARACTERS) + len(TRAIN_CHARACTERS) == 36
    targets = handwritten_targets(SMALL.target_plane, 1)
    assert len(targets.names) == len(targets.test) == 2 * len(TEST_CHARACTERS)
    assert 0.004 < targets.stroke_m < 0.012


def test_the_letters_that_come_with_the_package_are_those_of_their_glyphs():
    packaged, names = letters(), LETTERS.objects()
    assert len(packaged) == len(names) == LETTERS.writers * len(TRAIN_CHARACTERS)
    side = len(packaged[0].mask)
    squares = Plane(side, side, LETTERS.target_plane.size_m / side)
    for name, one in list(zip(names, packaged, strict=True))[::9]:
        assert np.abs(one.mask - LETTERS.target(name).rasterise(squares)).max() <= 0.501 / 255, name


def test_a_sharp_setup_shows_more_than_a_matte_wall():
    settings = AnalysisSettings(cells=16, height=30, width=48, writers=1)
    easy, matte = (identify(setup_preset(name), settings=settings, name=name) for name in ("easy", "matte"))
    assert easy.modes > 5 * matte.modes
    assert easy.at_camera.patterns > 2 * matte.at_camera.patterns
    assert easy.at_camera.psnr_db > matte.at_camera.psnr_db + 1 > matte.mean_db + 1
    assert easy.at_camera.patterns > easy.at_noise_std.patterns
    assert matte.at_camera.finest_m is None
    assert "training data" in matte.verdict and "not from the measurement" not in easy.verdict
    averaged = identify(setup_preset("easy"), settings=dataclasses.replace(settings, frames=100))
    assert averaged.at_camera.noise == pytest.approx(easy.at_camera.noise / 10)
    assert averaged.at_camera.patterns > easy.at_camera.patterns
    assert averaged.at_camera.finest_m < easy.at_camera.finest_m
    json.dumps(easy.summary(arrays=True))
    table = setup_table([easy, matte]).splitlines()
    assert table[0].startswith("From one frame; two figures") and "|" not in "".join(table)
    assert len({line.index(line.split("  ")[-1]) for line in table[1:4]}) == 1  # the last column is one
    assert easy.verdict.startswith("From one frame of this wall ")
    assert averaged.verdict.startswith("From the mean of 100 frames of this wall ")


def test_a_post_resolves_across_itself_only():
    found = identify(
        setup_preset("aperture"), settings=AnalysisSettings(cells=16, height=30, width=48, writers=1)
    )
    upright, lying = found.at_camera.stroke_m
    assert upright is not None and upright < 0.012
    assert lying is None
    assert "upright bars" in found.verdict


def test_picard_and_image():
    """The coefficients of a noiseless image, from the definition; the same seed draws the same image."""
    one, same, other = (identify(setup_preset("hard"), settings=SMALL, seed=seed) for seed in (0, 0, 1))
    setup = linearized(setup_preset("hard"), SMALL)
    targets = handwritten_targets(SMALL.target_plane, 1)
    light = setup.ambient + setup.matrix @ targets.mean
    whitened = setup.matrix / FrameCamera().noise_variance(light).sqrt()[:, None]
    left, values, _ = torch.linalg.svd(whitened, full_matrices=False)
    torch.testing.assert_close(one.at_camera.spectrum[:20], values[:20], rtol=1e-6, atol=1e-9)
    seen = (left.mT @ (whitened @ targets.test[targets.typical])).abs()
    torch.testing.assert_close(one.at_camera.picard[:20], seen[:20], rtol=1e-5, atol=1e-6)
    assert torch.equal(one.at_camera.picture, same.at_camera.picture)
    assert not torch.equal(one.at_camera.picture, other.at_camera.picture)


@pytest.mark.parametrize(
    ("widths", "words"),
    [
        ((0.005, 0.006), "strokes of 8.0 mm are measured; finer detail would come from the training data"),
        ((0.012, 0.019), "rough shape"),
        ((0.012, 0.021), "not from the measurement"),
        ((None, 0.004), "lying bars down to 4.0 mm, upright ones not at all"),
        ((None, None), "no bars at all"),
    ],
)
def test_verdict(widths, words):
    assert words in verdict(5, widths, 0.008, 0.08)


def test_command(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    small = ["--cells", "8", "--height", "12", "--width", "20", "--writers", "1"]
    main(["identify", "matte-near", "--json", *small])
    found = json.loads(capsys.readouterr().out)
    assert (found["setup"], found["modes_above_1e-2"]) == ("matte-near", 3)
    assert "training data" in found["verdict"]
    main(["identify", "matte-near", "hard-far", "--out", str(tmp_path / "o"), *small])
    shown = capsys.readouterr().out
    assert (
        "\nmatte-near  3  " in shown
        and "hard-far: From one frame of this wall" in shown
        and "--bounds" in shown
    )
    names = {path.name for path in (tmp_path / "o").iterdir()}
    assert names == {"identify_matte-near.png", "identify_hard-far.png", "identify_setups.png", "identify.json"}
    assert len(json.loads((tmp_path / "o" / "identify.json").read_text())) == 2


METRES = RadiometricSetup(distance_m=6.0, camera_distance_m=12.0, cell_m=0.05, strip_m=(4.8, 1.6))
"""main-near, twenty times as large."""


def test_the_target_is_as_large_as_the_setup_says(tmp_path, capsys):
    """Of 8 cm, which nobody asked about, a scene of metres showed nothing at all: a false no."""
    near, metres = identify(setup_preset("main-near"), SMALL), identify(METRES, SMALL)
    assert metres.settings.target_size_m == 1.6 and metres.at_camera.patterns == near.at_camera.patterns > 5
    assert identify(METRES, dataclasses.replace(SMALL, target_size_m=0.08)).at_camera.patterns < 3
    assert linearized(METRES, SMALL).target_plane.extent_m == pytest.approx((1.6, 1.6))
    small = ["--cells", "8", "--height", "12", "--width", "20", "--writers", "1"]
    save_yaml(METRES, tmp_path / "metres.yaml")
    main(["identify", str(tmp_path / "metres.yaml"), "main-near", *small])
    lines = capsys.readouterr().out.splitlines()
    told = [line.partition(": ")[0] for line in lines if line.startswith("On the target plane")]
    assert [f"holds: {name}): all-black" in " ".join(lines) for name in ("metres", "main-near")] == [True, True]
    assert told == [
        f"On the target plane of {size} (the largest that the setup's strip holds"
        for size in ("1.6 m", "80 mm")
    ]
    assert any(line.startswith("metres: ") and "of a target of 1.6 m" in line for line in lines)
    main(["identify", str(tmp_path / "metres.yaml"), "--target-size-m", "0.5", "--json", *small])
    found = json.loads(capsys.readouterr().out)
    assert (found["analysis"]["target_size_m"], found["target_size_from"]) == (0.5, "as asked")


def test_all_ask_about_the_targets_that_the_file_states(tmp_path, capsys):
    """The strip leaves room that no target fills; what is calibrated states how large its targets were."""
    glyphs = HandwritingGlyphs(target_plane=TargetPlane(size_m=1.2))
    simulation, path = Simulation(glyphs=glyphs, setup=METRES), tmp_path / "setup.yaml"
    save_yaml(simulation, path)
    assert stated_target_m(path) == stated_target_m(tmp_path) == named_setup(path).target_m == 1.2
    main(["identify", str(tmp_path), "--cells", "16", "--writers", "2", "--json"])
    found, page = json.loads(capsys.readouterr().out), limits_of(simulation)
    assert found["analysis"]["target_size_m"] == page.settings.target_size_m == 1.2
    assert found["camera_noise"]["patterns_above_noise"] == page.at_camera.patterns
    shown, told = (
        Shown.by(simulation),
        verdict_on(named_setup(path).setup, None, stated_m=named_setup(path).target_m),
    )
    assert shown.patterns == page.at_camera.patterns and told.wall == page.wall
    assert "of this wall and a target of 1.2 m, " in told.wall
    lab = Lab(glyphs=dataclasses.replace(Lab().glyphs, target_plane=TargetPlane(size_m=0.5)), setup=METRES)
    save_yaml(lab, tmp_path / "lab.yaml")
    assert stated_target_m(tmp_path / "lab.yaml") == 0.5


@pytest.mark.parametrize("name", [*setup_names(), "worn", "workshop", "simulate-paper", "simulate-page"])
def test_named_setups_are_asked_about_8_cm(name):
    """Their documented figures are of it."""
    found = named_setup(name)
    assert found.target_m is None and AskedSize.of(found.setup).size_m == 0.08
    assert AskedSize.of(FittedSetup(cell_m=0.08 / 17)).size_m == 0.08


def test_setup_files(tmp_path):
    assert named_setup("simulate-paper").setup.optics() == PaperSetup().optics()
    path = tmp_path / "setup.yaml"
    save_yaml(setup_preset("hard"), path)
    assert named_setup(path).setup == setup_preset("hard")
    save_yaml(Simulation(setup=PaperSetup(window=0.3)), path)
    assert named_setup(path).setup == PaperSetup(window=0.3)
    lab = Lab(name="bench", setup=setup_preset("aperture"))
    save_yaml(lab, path)
    assert named_setup(path).setup == setup_preset("aperture")
    assert named_setup(path).setup.frame_camera == lab.setup.frame_camera
    path.write_text("transport: {kind: radiometric, roughness: 0.2}\nframe_camera: {read_noise_e: 3.0}\n")
    assert named_setup(path).setup.frame_camera.read_noise_e == 3.0


@pytest.mark.parametrize("stem", ["setup", "training"])
def test_a_file_whose_name_says_nothing_is_called_as_its_folder(stem, tmp_path, monkeypatch):
    path = tmp_path / "copper" / f"{stem}.yaml"
    path.parent.mkdir()
    save_yaml(setup_preset("hard"), path)
    monkeypatch.chdir(path.parent)
    assert named_setup(path).name == named_setup(path.name).name == "copper"
    path.rename("tin.yaml")
    assert named_setup("tin.yaml").name == "tin"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("kind: radiometric\nroughnes: 0.1\n", "roughness"),
        ("setip: {}\n", "has no `setup`.*setip"),
        ("transport: {kind: mirror}\n", "no setup of kind 'mirror'"),
        ("- 1\n", "mapping"),
    ],
)
def test_bad_setup_files(tmp_path, text, match):
    path = tmp_path / "setup.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=match):
        named_setup(path)


@pytest.mark.parametrize(
    ("match", "make"),
    [
        ("perhaps you meant 'main-near'", lambda: named_setup("main-nera")),
        ("does not exist", lambda: named_setup("nothing.yaml")),
        ("no preset 'papr'", lambda: named_setup("simulate-papr")),
        ("cells is 4", lambda: AnalysisSettings(cells=4)),
        ("cells is 100", lambda: AnalysisSettings(cells=100)),
        ("target_size_m is 0", lambda: AnalysisSettings(target_size_m=0.0)),
        ("noise_std", lambda: AnalysisSettings(noise_std=float("nan"))),
        ("does not see the wall", lambda: linearized(RadiometricSetup(camera_angle_deg=80.0), SMALL)),
        ("no light", lambda: linearized(PaperSetup(offset_m=(5.0, 0.0)), SMALL)),
    ],
)
def test_bad_input(match, make):
    with pytest.raises(ConfigError, match=match):
        make()


def test_bad_sizes():
    with pytest.raises(DataError, match="root"):
        LinearEstimator.known(torch.eye(3), torch.zeros(3), torch.eye(4))


@pytest.mark.parametrize("there", ["identify.json", "identify_matte-near.png"])
def test_no_figure_is_replaced_unasked(tmp_path, capsys, there):
    (tmp_path / there).write_text("mine")
    with pytest.raises(SystemExit):
        main(["identify", "matte-near", "--out", str(tmp_path)])
    assert f"{there} exists" in capsys.readouterr().err
    assert (tmp_path / there).read_text() == "mine"


def test_no_setup(capsys):
    with pytest.raises(SystemExit):
        main(["identify"])
    assert "no setup given" in capsys.readouterr().err
    assert len(setup_names()) == 12
