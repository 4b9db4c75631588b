"""Generalization: one network on other objects and other walls, with what its confidence says."""

import json
import sys
from dataclasses import replace

import pytest
import torch

from evnlos.cli import main
from evnlos.config import save_yaml
from evnlos.data import NlosDataset, Sampling, SensorSize, Simulation
from evnlos.errors import DataError
from evnlos.experiment import generalization
from evnlos.experiment.presets import evaluation_sets
from evnlos.models import UNetConfig, Weights, save_weights
from evnlos.models.confidence import fit_confidence
from evnlos.scene import DrawingGlyphs, HandwritingGlyphs
from evnlos.scene.drawings import KINDS
from evnlos.setups import PaperSetup, RadiometricSetup

SAMPLING = Sampling(height=32, width=48, pitch_m=0.005, scored_rows=24)
SETUP = Simulation(
    setup=RadiometricSetup(cell_m=0.01, gain=0.7, ambient=0.06, sensor=SensorSize(48, 72)),
    positions=8,
    vary={"setup.gain": (0.5, 0.9)},
)


def test_the_sets_change_one_thing_each() -> None:
    found = evaluation_sets(SETUP, SAMPLING, 4)
    assert set(KINDS) < set(found) and "matte wall" in found
    for name, config in found.items():
        assert config.sampling == SAMPLING and not config.vary and config.frame_camera == SETUP.frame_camera
        moved = config.setup != SETUP.setup
        assert moved == (name not in KINDS and name != "characters of an unseen hand")
        assert moved <= isinstance(config.glyphs, HandwritingGlyphs)
        assert len(config.glyphs.objects()) == (36 if "unseen" in name else 4)
    with pytest.raises(DataError, match="radiometric"):
        evaluation_sets(replace(SETUP, setup=PaperSetup()), SAMPLING, 4)


def test_a_network_is_scored_set_by_set(tiny_dataset, tmp_path, capsys, monkeypatch) -> None:
    setup = tmp_path / "setups" / "lab"
    setup.mkdir(parents=True)
    save_yaml(SETUP, setup / "setup.yaml")
    torch.manual_seed(0)
    network = UNetConfig(width=4, depth=1, rank=0).build("frame", SAMPLING).eval()
    bare = Weights(network)
    save_weights(tmp_path / "bare.safetensors", bare)
    with pytest.raises(DataError, match="holds no confidence"):
        generalization(tmp_path / "bare.safetensors", setup, tmp_path, 1)
    confidence = fit_confidence(network, NlosDataset(tiny_dataset, "train", "frame"), SAMPLING.canvas)
    save_weights(tmp_path / "w.safetensors", replace(bare, confidence=confidence))

    def two(setup: Simulation, sampling: Sampling, each: int) -> dict[str, Simulation]:
        base = replace(setup, sampling=sampling, vary={}, validation=0.0)
        dim = replace(SETUP.setup, gain=0.2)
        icons = replace(base, glyphs=DrawingGlyphs(kinds=("icon",), each=2))
        return {"icon": icons, "dim": replace(icons, setup=dim)}

    # By name: the package's attribute `generalization` is the function, not the module.
    monkeypatch.setattr(sys.modules["evnlos.experiment.presets"], "evaluation_sets", two)
    command = ["experiment", "carry-over", "--weights", str(tmp_path / "w.safetensors"), "--rig", "lab"]
    command += ["--out", str(tmp_path), "--workers", "1"]
    with monkeypatch.context() as little:
        little.setattr("evnlos.untrusted.memory_left", lambda: 1000)
        with pytest.raises(SystemExit):
            main(command)
        assert "GB of memory" in capsys.readouterr().err.splitlines()[-1]
        main([*command, "--force"])
    found = json.loads((tmp_path / "generalization-lab-w.json").read_text())
    assert [one["name"] for one in found] == ["icon", "dim"]
    for one in found:
        assert [p["name"] for p in one["confidence_checks"]] == ["icon_000", "icon_001"]
        assert one["consistent_db"] > 0
        assert all(p["explained"] is not None and p["skill"] < 1 for p in one["confidence_checks"])
    text = (tmp_path / "generalization-lab-w.md").read_text()
    widths = {line.count("|") for line in text.splitlines() if line.startswith("|")}
    assert widths == {13} and "Mean skill of the best" in text
    pytest.importorskip("matplotlib")
    assert (tmp_path / "generalization-lab-w.png").stat().st_size > 10_000
