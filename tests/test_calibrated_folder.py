"""A folder that `calibrate` wrote stands for the same setup wherever it lies, to every command."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from evnlos.calibration import Residual, SetupFit, write_setup
from evnlos.cli import main
from evnlos.config import load_yaml, save_yaml
from evnlos.data import (
    FixedPattern,
    SensorSize,
    Simulation,
    open_dataset,
    pattern_of,
    read_shard,
    save_pattern,
    simulate,
)
from evnlos.data.lab import Lab, render_captures
from evnlos.optics.facets import SlopeTable
from evnlos.scene import FontGlyphs, HandwritingGlyphs
from evnlos.setups import FittedSetup, RadiometricSetup, load_setup
from evnlos.setups.files import AboutWall, FittedWall, write_fitted
from evnlos.types import Plane


def test_a_calibrated_folder_may_be_moved(tmp_path) -> None:
    drawing = np.zeros((16, 16), np.float32)
    drawing[4:12, 6:10] = 1
    wall = tmp_path / "searched" / "wall.safetensors"
    table, ones = (
        SlopeTable.of_lobes(np.array([[0.1, 0.15]]), np.array([1.0]), scale=0.1, matte=0.1),
        np.ones((12, 20)),
    )
    about = AboutWall(table.scale, table.step, table.matte, Plane(1, 1, 0.01), Plane(4, 12, 0.02))
    ones, texture = ones.astype(np.float32), np.zeros((1, 1), np.float32)
    left, right = np.zeros((1, 12, 20), np.float32), np.zeros((1, 48), np.float32)
    wall.parent.mkdir()
    checksum = write_fitted(wall, FittedWall(table.log_density, ones, ones, texture, left, right, about))
    setup = FittedSetup(
        file=str(wall), checksum=checksum, cell_m=0.01, target_offset_m=(-0.17, 0.0), sensor=SensorSize(12, 20)
    )
    found = Simulation(glyphs=HandwritingGlyphs(characters="A", writers=1), setup=setup, positions=2)
    fit = SetupFit(
        simulation=found,
        training=found,
        fitted=("lab_A",),
        held_out=("lab_B",),
        optics=SimpleNamespace(on_bound={}),  # type: ignore[arg-type]
        noise=SimpleNamespace(pattern=FixedPattern(ones, 0 * ones)),  # type: ignore[arg-type]
        pixel=None,
        residuals={
            name: Residual(before=0.5, after=0.102, noise=0.1)
            for name in ("frames fit", "frames held out", "frames held out, without pattern")
        },
        example=(),
        known={"lab_A": drawing},
    )
    folder, moved = tmp_path / "near", tmp_path / "elsewhere" / "near"
    write_setup(fit, [], folder)
    before = simulate(load_yaml(Simulation, folder / "training.yaml"), tmp_path / "before")
    for name in ("setup.yaml", "training.yaml"):
        assert str(tmp_path) not in (folder / name).read_text()
    moved.parent.mkdir()
    folder.rename(moved)
    found = load_setup(moved)  # which says what it leaves of the light beside the noise
    assert found == replace(setup, file=str(moved / "wall.safetensors"), unexplained=0.0201)
    main(
        [
            "simulate",
            "--config",
            str(moved / "training.yaml"),
            "--out",
            str(tmp_path / "after"),
            "--workers",
            "1",
        ]
    )
    after = open_dataset(tmp_path / "after")
    assert after.objects() == before.objects() and "redrawn00_lab_A" in after.objects()
    for name in after.objects():
        np.testing.assert_array_equal(
            read_shard(after.shard(name))[0].frame, read_shard(before.shard(name))[0].frame
        )


def test_the_fixed_pattern_of_a_calibrated_folder_goes_with_it(tmp_path) -> None:
    ones = np.ones((4, 6), np.float32)
    own, other = tmp_path / "near", tmp_path / "other"
    for folder, level in ((own, 0.5), (other, 0.25)):
        folder.mkdir()
        (folder / "setup.yaml").write_text("kind: radiometric\n")
        save_pattern(FixedPattern(ones, level * ones), folder / "pattern.safetensors")
    for word in (own, own / "setup.yaml", str(own)):
        found = pattern_of(word)
        assert found is not None and found.offset[0, 0] == 0.5
        found = pattern_of(word, other)
        assert found is not None and found.offset[0, 0] == 0.25
    assert pattern_of(None) is None and pattern_of("main-near") is None
    assert pattern_of(own / "wall.safetensors") is None
    (own / "pattern.safetensors").unlink()
    assert pattern_of(own) is None


def test_invert_and_track_take_the_pattern_of_the_calibrated_folder(tmp_path, capsys) -> None:
    """With `--setup FOLDER` and with `--pattern FOLDER` besides, the figures are the same."""
    lab = Lab(
        glyphs=FontGlyphs(family="kalam", characters="L"),
        setup=RadiometricSetup(cell_m=0.01, gain=0.7, ambient=0.06, sensor=SensorSize(24, 36)),
        frame_rate_hz=1.0,
    )
    (capture,) = render_captures(lab, tmp_path / "lab")
    folder, bare = tmp_path / "near", tmp_path / "bare.yaml"
    folder.mkdir()
    save_yaml(lab.setup, folder / "setup.yaml")
    save_yaml(lab.setup, bare)
    draw = np.random.default_rng(0)
    offset = draw.normal(0, 0.02, (24, 36)).astype(np.float32)
    save_pattern(FixedPattern(np.ones((24, 36), np.float32), offset), folder / "pattern.safetensors")

    def figure(*words: str | Path) -> object:
        options = () if "--from" in words else ("--cells", 8, "--solver", "tikhonov")
        options += ("--json", "--force")
        main([str(word) for word in ("invert", capture, *options, *words)])
        return json.loads(capsys.readouterr().out)["rows"][0]["psnr_db"]

    out = ("--out", tmp_path / "i.png")
    stated = figure("--setup", bare, "--pattern", folder, *out)
    assert figure("--setup", folder, *out) == stated != figure("--setup", bare, *out)
    out += ("--from", "frames")
    stated = figure("--setup", bare, "--pattern", folder, *out)
    assert figure("--setup", folder, *out) == stated != figure("--setup", bare, *out)

    def position(*words: str | Path) -> object:
        tracked = ("track", capture, "--cells", 8, "--out", tmp_path / "t.png", "--json", "--force")
        main([str(word) for word in (*tracked, *words)])
        return json.loads(capsys.readouterr().out)["position_sigma"]

    stated = position("--setup", bare, "--pattern", folder)
    assert position("--setup", folder) == stated != position("--setup", bare)
