"""The interface of reconstructors and modalities: what a plugin needs, and files of before."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save

from evnlos import evaluate, load_model, train
from evnlos.cli import main
from evnlos.config import from_dict, load_yaml, read_yaml, save_yaml, to_dict
from evnlos.data import MODALITIES, ChannelGroup, Modality, Sampling, as_modality, read_capture
from evnlos.errors import ConfigError, DataError
from evnlos.experiment import read_records
from evnlos.models import (
    RECONSTRUCTORS,
    Reconstructor,
    ReconstructorSettings,
    SequenceConfig,
    UNetConfig,
    Weights,
    load_weights,
    published,
    save_weights,
)
from evnlos.registry import migrate
from evnlos.report import collect_results, write_report
from evnlos.training import Training

RECORDS = Path(__file__).resolve().parent.parent / "benchmarks" / "results" / "experiments"
SMALL = {"width": 8, "depth": 1, "shuffle": 2, "rank": 24, "ridge_multipliers": (0.1, 1.0)}
QUICK = Training(epochs=2, network=UNetConfig(**SMALL), precision="float32", batch_size=16)


@RECONSTRUCTORS.register
@dataclass(frozen=True)
class ToySettings(ReconstructorSettings):
    """One convolution over what is seen."""

    kind: str = "toy"
    size: int = 3

    def build(self, modality: str | Modality, sampling: Sampling) -> Reconstructor:
        return Toy(as_modality(modality), self, sampling)


class Toy(Reconstructor):
    """A kind of a user: a convolution behind the mean image, which it learns in closed form."""

    def __init__(self, modality: Modality, settings: ToySettings, sampling: Sampling) -> None:
        super().__init__(modality, settings, sampling)
        self.register_buffer("mean", torch.zeros(sampling.height, sampling.width))
        self.conv = torch.nn.Conv2d(modality.channels, 1, settings.size, padding="same")
        torch.nn.init.zeros_(self.conv.weight)
        torch.nn.init.zeros_(self.conv.bias)

    def fit(self, subset, seed, *, is_new, keep_normalization) -> None:
        if is_new:
            self.mean.copy_(subset(500)[1].float().mean(dim=0))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (self.mean + torch.tanh(self.conv(x))).clamp(0.001, 0.999)


@pytest.fixture
def four_channels():
    net = ChannelGroup(
        "net", 1, ("surface",), lambda maps: maps["surface"][:, :1] - maps["surface"][:, 1:], centred=False
    )
    made = Modality("four", (*as_modality("fusion").groups, net), "frames, events and their difference")
    MODALITIES.register(made)
    yield made
    MODALITIES.unregister("four")


def test_a_modality_of_four_channels_trains(four_channels, tiny_dataset, tmp_path) -> None:
    for network in (UNetConfig(**SMALL), SequenceConfig(**SMALL)):
        plan = replace(QUICK, modality="four", network=network, epochs=6, learning_rate=3e-3)
        train(tiny_dataset, plan, tmp_path / network.kind)
        weights = load_weights(tmp_path / network.kind)
        assert weights.modality.layout == {"frame": 1, "events": 2, "net": 1}
        assert [weights.network.embedding.groups[name].rank for name in weights.modality.layout] == [8, 4, 12]
        found = evaluate(weights, tiny_dataset, "validation").summary()
        assert found["overall"]["psnr_db"] > found["baselines"]["mean"]["overall"]["psnr_db"]
    path = tmp_path / "unet" / "weights.safetensors"
    MODALITIES.unregister("four")
    MODALITIES.register(replace(four_channels, groups=four_channels.groups[:2]))
    with pytest.raises(DataError, match="register the modality that it was trained with"):
        load_weights(path)
    MODALITIES.unregister("four")
    with pytest.raises(DataError, match="modality 'four'"):
        load_weights(path)
    MODALITIES.register(four_channels)


def test_a_group_gives_the_channels_that_it_says(four_channels) -> None:
    frame, surface = np.random.default_rng(0).random((3, 8, 8)), np.random.default_rng(1).random((3, 2, 8, 8))
    seen = four_channels.inputs(frame, surface).numpy()
    np.testing.assert_allclose(seen[:, 3], surface[:, 0] - surface[:, 1], atol=1e-6)
    wrong = replace(four_channels.groups[2], channels=2)
    with pytest.raises(ConfigError, match=r"'net' gives \(3, 1, 8, 8\)"):
        Modality("five", (wrong,), "").inputs(frame, surface)
    with pytest.raises(ConfigError, match="the map 'depth'"):
        Modality("deep", (replace(wrong, maps=("depth",)),), "").inputs(frame, surface)
    with pytest.raises(ConfigError, match="several maps"):
        replace(wrong, maps=("frame", "surface"), make=None)
    with pytest.raises(ConfigError, match="no modality of kind 'fusoin'; did you mean 'fusion'"):
        Training(modality="fusoin")


def test_a_kind_of_a_user_trains_resumes_and_is_scored(tiny_dataset, tmp_path, capsys) -> None:
    run, data = tmp_path / "run", str(tiny_dataset.folder)
    words = ["train", "--data", data, "--out", str(run), "--epochs", "2", "--modality", "fusion"]
    main([*words, "--network.kind", "toy", "--network.size", "5"])
    weights = load_weights(run)
    assert (weights.network.kind, weights.network.settings.size) == ("toy", 5)
    assert read_yaml(run / "run.yaml")["settings"]["network"] == {"kind": "toy", "size": 5}
    assert not weights.network.mean.eq(0).all()
    main(["finetune", "--weights", str(run), "--data", data, "--out", str(tmp_path / "fine"), "--epochs", "1"])
    assert load_weights(tmp_path / "fine").network.settings == weights.network.settings
    capsys.readouterr()
    main(["evaluate", "--weights", str(run), "--data", data, "--split", "validation", "--json"])
    assert json.loads(capsys.readouterr().out)["modality"] == "fusion"
    main(["weights", str(run)])
    assert "fusion, toy: one time step at a time" in capsys.readouterr().out
    dataset, results = collect_results([run], tiny_dataset.folder, "validation")
    assert "fusion" in write_report(tmp_path / "report.html", dataset, results, []).read_text()
    with pytest.raises(ConfigError, match="freeze names 'encoder'"):
        train(tiny_dataset, replace(QUICK, freeze=("encoder",)), tmp_path / "frozen", run)
    assert not (tmp_path / "frozen").exists()


def test_an_unknown_kind_names_those_that_there_are(tiny_dataset, tmp_path, capsys) -> None:
    with pytest.raises(SystemExit):
        main(
            [
                "train",
                "--data",
                str(tiny_dataset.folder),
                "--out",
                str(tmp_path / "x"),
                "--network.kind",
                "unit",
            ]
        )
    assert "there is no reconstructor of kind 'unit'; did you mean 'unet'?" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="no reconstructor of kind 'unit'"):
        from_dict(Training, {"network": {"kind": "unit"}})
    with pytest.raises(ConfigError, match=r"network\.widht; perhaps you meant 'width'"):
        from_dict(Training, {"network": {"kind": "sequence", "widht": 3}})
    with pytest.raises(ConfigError, match="kind is 'sequence'"):
        UNetConfig(kind="sequence")


# Files of before


def test_published_weights_say_what_they_are_in_the_words_of_today() -> None:
    for name, path in published().items():
        with safe_open(path, framework="pt") as file:
            about = json.loads(file.metadata()["evnlos"])
        today = migrate("weights", about)
        assert today["network"]["kind"] == ("sequence" if name.endswith("-sequence") else "unet")
        loaded = load_weights(path)
        assert loaded.modality.name == name.split("-")[1]
        assert loaded.network.sees_sequence == name.endswith("-sequence")
        for step in loaded.history:
            assert {"modality", "keep_normalization", "sequence_augmentations"} <= set(step["settings"])
            assert not {"paradigm", "joint", "views", "restandardise"} & set(step["settings"])


def test_settings_of_before_load(tmp_path) -> None:
    old = {"paradigm": "event", "joint": True, "views": 5, "restandardise": False, "loss": "balanced"}
    old |= {"network": {"width": 16, "strengths": [0.1, 1.0]}}
    save_yaml(old, tmp_path / "old.yaml")
    found = load_yaml(Training, tmp_path / "old.yaml")
    network = SequenceConfig(width=16, ridge_multipliers=(0.1, 1.0))
    noted = migrate("run", {"settings": {"loss": "balanced", "network": {"kind": "unet", "strengths": [1.0]}}})
    assert noted["settings"]["network"] == {"kind": "unet", "ridge_multipliers": [1.0]}  # so the run goes on
    assert found == Training("event", network=network, sequence_augmentations=5, keep_normalization=True)
    assert old["joint"] is True  # what was read stays as it was
    assert from_dict(Training, {"paradigm": "frame", "joint": False}) == Training()
    save_yaml(found, tmp_path / "new.yaml")
    assert load_yaml(Training, tmp_path / "new.yaml") == found


def test_records_of_before_load() -> None:
    records = read_records(RECORDS / "captures")
    assert {record.modality for record in records} == {"frame", "event", "fusion"}


def test_weights_and_a_run_of_the_format_before_go_on(tiny_dataset, tmp_path) -> None:
    """A run that an older version began: its settings, its checkpoint and its weights in their words."""
    from watching import stopped

    for kind, network in (("unet", UNetConfig(**SMALL)), ("sequence", SequenceConfig(**SMALL))):
        plan = replace(QUICK, network=network, modality="fusion", batch_size=4)
        train(tiny_dataset, plan, tmp_path / kind)
        begun = tmp_path / f"{kind}-old"
        stopped(train, tiny_dataset, plan, begun, after=1)
        _as_before(begun)
        train(tiny_dataset, plan, begun)
        one, other = (load_weights(run).network.state_dict() for run in (tmp_path / kind, begun))
        assert all(torch.equal(one[name], other[name]) for name in one)


def test_weights_of_before_keep_their_tensors(tmp_path) -> None:
    """Tensors get today's names; those of an embedding of one group did not name it."""
    sampling = Sampling(height=16, width=24, scored_rows=12)
    for modality in ("event", "fusion"):
        for settings in (UNetConfig(**SMALL), SequenceConfig(**SMALL), UNetConfig(width=8, depth=1, rank=0)):
            torch.manual_seed(0)
            network = settings.build(modality, sampling).eval()
            for buffer in network.buffers():
                torch.nn.init.normal_(buffer)
            state = {_name_before(name, network): value.clone() for name, value in network.state_dict().items()}
            about = {"format": "evnlos-weights-3", "paradigm": modality, "joint": network.sees_sequence}
            values = {key: value for key, value in to_dict(settings).items() if key != "kind"}
            about |= {"network": values, "sampling": to_dict(sampling), "history": []}
            path = tmp_path / "old.safetensors"
            path.write_bytes(save(state, metadata={"evnlos": json.dumps(about)}))
            loaded = load_weights(path)
            assert loaded.network.settings == settings
            assert all(
                torch.equal(value, loaded.network.state_dict()[k]) for k, value in network.state_dict().items()
            )
            save_weights(tmp_path / "new.safetensors", Weights(loaded.network))
            assert load_weights(tmp_path / "new.safetensors").network.settings == settings


def _name_before(name: str, network: Reconstructor) -> str:
    """Return what format 3 called a tensor."""
    first, _, rest = name.partition(".")
    if first == "normalization":
        return f"standardise.{rest}"
    if first == "scale":
        return f"unet.standardise.{rest}"
    if first == "embedding":
        _, group, last = rest.split(".")
        return f"embedding.{group}.{last}" if len(network.modality.groups) > 1 else f"embedding.{last}"
    return name if network.sees_sequence else rest


def _as_before(run: Path) -> None:
    """Rewrite the files of a begun run as the version before wrote them."""
    from evnlos.config import config_hash

    about = read_yaml(run / "run.yaml")
    settings, network = about["settings"], dict(about["settings"]["network"])
    kind = network.pop("kind")
    old = {"paradigm": settings["modality"], "joint": kind == "sequence", "network": network}
    old |= {"views": settings["sequence_augmentations"], "restandardise": not settings["keep_normalization"]}
    dropped = ("modality", "network", "sequence_augmentations", "keep_normalization")
    about["settings"] = old | {key: value for key, value in settings.items() if key not in dropped}
    save_yaml(about, run / "run.yaml")
    path = run / "checkpoint.safetensors"
    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["evnlos"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    sampling = from_dict(Sampling, header["sampling"])
    built = from_dict(Training, about["settings"]).network.build("fusion", sampling)
    renamed = {
        f"network.{_name_before(name[8:], built)}" if name.startswith("network.") else name: value
        for name, value in tensors.items()
    }
    kept = {key: header[key] for key in ("epoch", "log")} | {"key": config_hash(about["settings"])}
    path.write_bytes(save(renamed, metadata={"evnlos": json.dumps(kept)}))


def test_a_model_gives_images_confidence_and_warnings(tiny_dataset, tiny_captures, tmp_path) -> None:
    train(tiny_dataset, replace(QUICK, epochs=1), tmp_path / "run")
    model = load_model(tmp_path / "run")
    found = model.reconstruct(tiny_captures[0])
    assert found.images.shape == (8, 32, 48) and found.samples.truth is not None
    assert found.confidence is None and "never learned it" in (found.no_confidence or "")
    assert not found.warnings and found.light is None and not found.is_moved
    again = model.reconstruct(read_capture(tiny_captures[0]))
    assert torch.equal(found.images, again.images)
    trained = load_model("near-frame").reconstruct(tiny_captures[0])
    assert trained.confidence is not None and trained.confidence.explained is not None
    assert trained.no_confidence is None and trained.images.shape == (8, 64, 96)
    with pytest.raises(ConfigError, match="--track without --setup"):
        model.reconstruct(tiny_captures[0], track=True)
