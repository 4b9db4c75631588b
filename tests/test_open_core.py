"""The core is open: a setup, an event model and a reconstructor that stand in this file alone go all the way.

They are registered here and nowhere else; simulate, train, evaluate, report and the command line take them by
their kind. Whoever has to change the package to make this file pass has closed the core again.
"""

import json
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from evnlos import evaluate, simulate, train
from evnlos.cameras import EVENT_MODELS, EventModel, PixelSettings
from evnlos.cli import main
from evnlos.config import load_yaml, save_yaml
from evnlos.data import Sampling, Simulation, as_modality, read_shard
from evnlos.models import RECONSTRUCTORS, Reconstructor, ReconstructorSettings
from evnlos.report import collect_results, write_report
from evnlos.scene import HandwritingGlyphs
from evnlos.setups import SensorSize, Setup, load_setup
from evnlos.training import Training
from evnlos.types import Plane


@Setup.registry.register
@dataclass(frozen=True)
class ToyWindow(Setup):
    """No wall: the camera sees the target through frosted glass, a region `width_m` wide."""

    kind: Literal["toy-window"] = "toy-window"
    width_m: float = 0.24
    """Width of what the sensor sees, metres."""
    frost_px: int = 3
    """Side of the square over which the glass blurs, pixels; odd."""

    def observe(self, scene):
        return FrostedImage(self, scene)


class FrostedImage:
    """What the sensor of a `ToyWindow` receives, at any instant."""

    def __init__(self, setup, scene):
        self.setup, self.scene, self.shape = setup, scene, setup.shape
        self.plane = Plane(*self.shape, setup.width_m / self.shape[1])
        self.speed_px_s = float(scene.motion.speed_m_s) / self.plane.pitch_m

    def irradiance(self, t_s):
        t_s = np.asarray(t_s, dtype=np.float64)
        at_m = self.scene.motion.position_m(t_s.reshape(-1))
        image = torch.from_numpy(self.scene.target.rasterise(self.plane, at_m)).float()
        side = self.setup.frost_px
        blurred = F.avg_pool2d(image[:, None], side, stride=1, padding=side // 2)[:, 0]
        light = self.setup.gain * blurred + self.setup.ambient_light()
        return light.reshape(*t_s.shape, *self.shape)


@EVENT_MODELS.register
@dataclass(frozen=True)
class ToyLevel(PixelSettings):
    """A comparator: ON where a pixel rises above a level, OFF where it falls below."""

    level_dn: float = 60.0
    """The level, DN."""
    kind: Literal["toy-level"] = "toy-level"

    def model(self, shape, seed=0, thresholds=None, *, tile_px=None, threads=None):
        return Comparators(self)


class Comparators(EventModel):
    def __init__(self, settings):
        self.settings = settings

    def start(self, frame, time_s):
        self.above = np.asarray(frame) > self.settings.level_dn

    def advance(self, light, times_s):
        rows, first = light.pixels(0, len(self.above))
        above = rows[:, first : first + len(self.above)] > self.settings.level_dn
        before = np.concatenate([self.above[None], above[:-1]])
        self.above = above[-1].copy()
        step, pixel = np.nonzero(above != before)
        return np.rint(times_s[step] * 1e6).astype(np.int64), pixel.astype(np.int32), above[step, pixel]


@RECONSTRUCTORS.register
@dataclass(frozen=True)
class ToyConvolution(ReconstructorSettings):
    """A single convolution."""

    kind: Literal["toy-convolution"] = "toy-convolution"
    side: int = 5
    """Side of the kernel, pixels; odd."""

    def build(self, modality, sampling):
        return OneConvolution(as_modality(modality), self, sampling)


class OneConvolution(Reconstructor):
    def __init__(self, modality, settings, sampling):
        super().__init__(modality, settings, sampling)
        self.layer = torch.nn.Conv2d(modality.channels, 1, settings.side, padding="same")

    def forward(self, x):
        return torch.sigmoid(self.layer(x))


SETUP = ToyWindow(gain=0.6, sensor=SensorSize(32, 48), pixel=ToyLevel(level_dn=80.0))
CONFIG = Simulation(
    glyphs=HandwritingGlyphs(characters="ACHLT", writers=1),
    setup=SETUP,
    sampling=Sampling(height=32, width=48, pitch_m=0.005, scored_rows=24),
    positions=6,
    validation=0.25,
    held_out="T",
)
TRAINING = Training(epochs=3, batch_size=6, modality="fusion", network=ToyConvolution(side=7))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return simulate(CONFIG, tmp_path_factory.mktemp("open") / "dataset")


@pytest.fixture(scope="module")
def run(dataset, tmp_path_factory):
    return train(dataset, TRAINING, tmp_path_factory.mktemp("open") / "run")


def test_they_are_simulated(dataset) -> None:
    samples, _ = read_shard(dataset.shard("writer00_H"))
    assert samples.frame.std() > 0.05
    assert (samples.event_count > 20).all()
    # The frame shows the target in its own place: only frosted glass lies between.
    assert np.corrcoef(samples.frame[3].ravel(), samples.truth[3].ravel())[0, 1] > 0.8


def test_processes_make_the_same_dataset_where_they_can_import_this_file(dataset, tmp_path) -> None:
    simulate(CONFIG, tmp_path / "d", workers=2)
    for name in dataset.objects():
        assert (tmp_path / "d" / f"{name}.h5").read_bytes() == dataset.shard(name).read_bytes()


def test_the_network_learns_and_is_read_back_by_its_kind(run) -> None:
    losses = [record["loss"] for record in run.records]
    assert losses[-1] < losses[0]
    weights = run.load()
    assert isinstance(weights.network, OneConvolution)
    assert weights.network.settings == TRAINING.network


def test_it_is_evaluated_and_reported(run, dataset, tmp_path) -> None:
    found = evaluate(run.load(), dataset)
    assert found.characters() == ["writer00_T"]
    assert np.isfinite(found.scores.psnr_db).all()
    assert {"zero", "mean", "nearest"} <= found.baselines.keys()
    opened, results = collect_results([run.folder], dataset.folder)
    (result,) = results
    assert result.evaluation.summary() == found.summary()
    page = write_report(tmp_path / "report.html", opened, results, []).read_text()
    assert "toy-window" in page


def test_settings_survive_yaml_and_the_resolver_knows_the_setup(dataset, tmp_path) -> None:
    save_yaml(CONFIG, tmp_path / "toy.yaml")
    assert load_yaml(Simulation, tmp_path / "toy.yaml") == CONFIG
    for word in (tmp_path / "toy.yaml", dataset.folder / "dataset.yaml"):
        known = load_setup(word)
        assert getattr(known, "setup", known) == SETUP


def test_the_command_line_takes_them_all(tmp_path, capsys) -> None:
    save_yaml(CONFIG, tmp_path / "toy.yaml")
    data, out = str(tmp_path / "data"), str(tmp_path / "out")
    main(["simulate", "--config", str(tmp_path / "toy.yaml"), "--out", data, "--workers", "1"])
    network = ["--network.kind", "toy-convolution", "--network.side", "3"]
    main(["train", "--data", data, "--out", out, "--epochs", "1", "--modality", "fusion", *network])
    capsys.readouterr()
    main(["weights", out, "--json"])
    assert json.loads(capsys.readouterr().out)["network"]["side"] == 3
    main(["evaluate", "--weights", out, "--data", data, "--json"])
    assert json.loads(capsys.readouterr().out)["images"] == 6
    main(["report", out, "--data", data, "--out", str(tmp_path / "report.html")])
    assert (tmp_path / "report.html").stat().st_size > 10_000
    main(["finetune", "--weights", out, "--data", data, "--out", str(tmp_path / "tuned"), "--epochs", "1"])
    assert (tmp_path / "tuned" / "weights.safetensors").is_file()
