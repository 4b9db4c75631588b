"""Training on samples simulated meanwhile: first the dataset itself, then others, all repeatable."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from evnlos import EvnlosError, train
from evnlos.cli import main
from evnlos.config import save_yaml
from evnlos.data import NlosDataset, live_dataset
from evnlos.data.pool import run_in_order
from evnlos.data.simulate import epoch_settings
from evnlos.errors import ConfigError
from evnlos.models import UNetConfig, load_weights
from evnlos.training import Training
from evnlos.training.source import ProcessGroup, SimulatedSource
from watching import stopped

CPU = torch.device("cpu")
ALONE = ProcessGroup(0, 1, CPU)
SETTINGS = Training(
    epochs=2, network=UNetConfig(width=8, depth=1, shuffle=1, rank=8), precision="float32", batch_size=7
)


@pytest.fixture(scope="module")
def few(tiny):
    """Four characters of one writer, two positions each: one is held out."""
    glyphs = replace(tiny.glyphs, characters="ATLC", writers=1)
    return replace(tiny, glyphs=glyphs, positions=4, duration_s=4.0, validation=0.25)


def epoch_of(source: SimulatedSource, epoch: int) -> list[tuple[bytes, bytes]]:
    """Return the samples of an epoch in the order of training."""
    batches = list(source.batches(epoch))
    return [
        (seen.numpy().tobytes(), truth.numpy().tobytes())
        for batch in batches
        for seen, truth in zip(batch.seen, batch.truth, strict=True)
    ]


def test_the_first_epoch_is_the_dataset_on_disk(tiny, tiny_dataset) -> None:
    names = tiny_dataset.objects("train")[:2]
    stored = NlosDataset(tiny_dataset, "train", "fusion")
    live = live_dataset(tiny)
    for name, (seen, truth) in zip(names, live.stream(names, 0, "fusion", CPU), strict=True):
        mine = np.flatnonzero(stored.names == name)
        assert torch.equal(seen, stored[torch.from_numpy(mine)][0])
        assert torch.equal(truth, stored[torch.from_numpy(mine)][1])
        np.testing.assert_allclose(live.truth(name), truth[:, 0].numpy(), atol=5e-4)  # half precision


def test_an_epoch_is_the_same_again_and_the_next_one_is_another(few) -> None:
    source = SimulatedSource(replace(live_dataset(few), mix=2), "event", 5, 0, ALONE)
    first, again = epoch_of(source, 0), epoch_of(source, 0)
    assert first == again
    assert len(first) == 3 * few.positions
    assert source.steps == len(list(source.batches(1))) == 3
    assert not set(first) & set(epoch_of(source, 1))
    assert epoch_settings(few, 0) == few
    assert len({epoch_settings(few, epoch).seed for epoch in range(5)}) == 5


def test_a_mix_is_shuffled_and_loses_nothing(few) -> None:
    kinds = {
        mix: epoch_of(SimulatedSource(replace(live_dataset(few), mix=mix), "frame", 4, 0, ALONE), 0)
        for mix in (1, 3)
    }
    assert sorted(kinds[1]) == sorted(kinds[3])
    assert kinds[1] != kinds[3]


def test_training_without_a_dataset_goes_on_after_a_stop_with_the_same_bytes(few, tmp_path) -> None:
    log = train(live_dataset(few), SETTINGS, tmp_path / "whole").records
    assert [record["epoch"] for record in log] == [1, 2]
    assert all(np.isfinite(record["loss"]) and "psnr_db" in record for record in log)
    stopped(train, live_dataset(few), SETTINGS, tmp_path / "stopped", after=1)
    train(live_dataset(few), SETTINGS, tmp_path / "stopped")
    whole, again = ((tmp_path / name / "weights.safetensors").read_bytes() for name in ("whole", "stopped"))
    assert whole == again
    weights = load_weights(tmp_path / "whole")
    assert weights.history[-1]["data"]["origin"] == "simulation"
    assert weights.mean_image is not None
    expected = np.mean(
        [live_dataset(few).truth(name) for name in live_dataset(few).objects("train")], axis=(0, 1)
    )
    np.testing.assert_allclose(weights.mean_image.numpy(), expected, atol=1e-6)
    with pytest.raises(EvnlosError, match="other settings"):
        train(live_dataset(replace(few, seed=5)), SETTINGS, tmp_path / "whole")


def test_the_command_simulates_as_it_trains(few, tmp_path, capsys) -> None:
    save_yaml(few, tmp_path / "setup.yaml")
    arguments = ["train", "--simulate", str(tmp_path / "setup.yaml"), "--epochs", "1", "--precision", "float32"]
    arguments += ["--network.width", "8", "--network.depth", "1", "--network.shuffle", "1"]
    main([*arguments, "--out", str(tmp_path / "run")])
    assert "1 epochs" in capsys.readouterr().out
    (line,) = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert json.loads(line)["epoch"] == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "setup.yaml"]
    assert not list(tmp_path.rglob("*.h5"))


@pytest.mark.parametrize("given", [[], ["--data", "d", "--simulate", "s.yaml"]])
def test_data_or_a_simulation_is_asked_for(given: list[str], tmp_path, capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["train", "--out", str(tmp_path / "run"), *given])
    assert stop.value.code == 2
    assert "--data DATASET or --simulate" in capsys.readouterr().err


def test_nobody_to_train_on_is_refused(few) -> None:
    with pytest.raises(ConfigError, match="none to train on"):
        live_dataset(replace(few, glyphs=replace(few.glyphs, characters="A"), validation=0.9))


def test_results_come_in_the_order_of_the_tasks() -> None:
    assert list(run_in_order(abs, [3, -1, 2, -5, 4], 2)) == [3, 1, 2, 5, 4]
    assert list(run_in_order(abs, [3, -1], 1)) == [3, 1]
    with pytest.raises(TypeError):
        list(run_in_order(abs, [1, "x", 2], 2))
