"""Fine-tuning chosen on captures held out: it takes what helps, leaves what harms, goes on after a stop."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evnlos.cli import main
from evnlos.config import config_hash, from_dict, to_dict
from evnlos.data import Dataset, NlosDataset, Sampling, Simulation, read_shard, simulate
from evnlos.errors import ConfigError, DataError
from evnlos.machine import Step
from evnlos.metrics import psnr
from evnlos.models import FrameOperator, UNetConfig, load_weights
from evnlos.scene import HandwritingGlyphs
from evnlos.setups import RadiometricSetup, SensorSize
from evnlos.training import (
    MOST_ASYMMETRY,
    Training,
    alternatives,
    asymmetry,
    augmented,
    between,
    choose_and_finetune,
    read_choice,
    train,
)

SMALL = UNetConfig(width=8, depth=1, blocks=1, rank=8)


@pytest.fixture(scope="module")
def pretrained(tiny_dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("choice") / "pretrained"
    return train(tiny_dataset, Training(epochs=1, network=SMALL, learning_rate=1e-3), out).folder


def score(run, dataset) -> float:
    held = NlosDataset(dataset, "validation", "frame")
    return float(psnr(load_weights(run).network.infer(held.inputs), held.truth.float()).mean())


def test_what_helps_is_taken(tiny_dataset, pretrained, tmp_path) -> None:
    good = Training(epochs=3, network=SMALL, learning_rate=2e-3)
    run = choose_and_finetune(tiny_dataset, (good,), tmp_path / "run", pretrained)
    choice = read_choice(run.folder)
    assert choice is not None and choice.candidate == 0 and choice.share > 0
    assert choice.gain_db > choice.error_db > 0
    assert score(run.folder, tiny_dataset) > score(pretrained, tiny_dataset)
    assert not (tmp_path / "run-trials").exists()
    assert load_weights(run.folder).history[-1]["choice"]["gain_db"] == choice.gain_db


def test_what_harms_is_left(tiny_dataset, pretrained, tmp_path) -> None:
    better = train(tiny_dataset, Training(epochs=4, network=SMALL), tmp_path / "better", pretrained).folder
    harmful = Training(epochs=1, network=SMALL, learning_rate=1.0)
    run = choose_and_finetune(tiny_dataset, (harmful,), tmp_path / "run", better)
    choice = read_choice(run.folder)
    assert choice is not None and choice.candidate is None and choice.table[0][-1] < -0.5
    ours, theirs = (load_weights(path).network.state_dict() for path in (run.folder, better))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_rate_epochs_normalization_embedding_and_what_is_kept_are_tried(
    tiny_dataset, pretrained, tmp_path
) -> None:
    """Also for a network whose size is not that of the settings."""
    asked = Training(epochs=1, learning_rate=1e-3)
    tried = alternatives(asked, load_weights(pretrained).network)
    assert tried[0] == asked and len({config_hash(to_dict(one)) for one in tried}) == 7
    assert [one.freeze for one in tried if one.freeze] == [("encoder",)]
    run = choose_and_finetune(tiny_dataset, tried, tmp_path / "run", pretrained)
    choice = read_choice(run.folder)
    assert choice is not None and len(choice.table) == 7 and choice.gain_db > 0
    held = np.array(choice.table)
    assert (held[:5, 0] == held[6, 0]).all() and held[5, 0] != held[6, 0]  # another embedding is another start


def test_settings_that_the_captures_are_too_few_for_are_left_out(
    tiny_dataset, pretrained, tmp_path, monkeypatch
) -> None:
    def picky(dataset: Dataset, settings: Training, *others):
        if settings.refit_embedding:
            raise DataError("2 objects to tell light from noise; give 8 or more")
        return train(dataset, settings, *others)

    monkeypatch.setattr("evnlos.training.choice.train", picky)
    settings = Training(epochs=1, network=SMALL)
    asks = replace(settings, refit_embedding=True)
    choice = read_choice(
        choose_and_finetune(tiny_dataset, (settings, asks), tmp_path / "run", pretrained).folder
    )
    assert choice is not None and set(choice.table[1]) == {None} and None not in choice.table[0]
    with pytest.raises(DataError, match="give 8 or more"):  # asked for first, it is no alternative
        choose_and_finetune(tiny_dataset, (asks, settings), tmp_path / "first", pretrained)


def test_it_goes_on_and_repeats_its_bytes(tiny_dataset, pretrained, tmp_path) -> None:
    settings = (Training(epochs=1, network=SMALL), Training(epochs=1, network=SMALL, learning_rate=1e-4))
    once = choose_and_finetune(tiny_dataset, settings, tmp_path / "once", pretrained)

    class StopError(Exception):
        pass

    def stop(step) -> None:
        if step.what.startswith("choose") and step.done == 2:
            raise StopError

    with pytest.raises(StopError):
        choose_and_finetune(tiny_dataset, settings, tmp_path / "twice", pretrained, progress=stop)
    again = choose_and_finetune(tiny_dataset, settings, tmp_path / "twice", pretrained)
    assert once.file.read_bytes() == again.file.read_bytes()
    assert json.loads((again.folder / "choice.json").read_text())["table"]
    # done is done
    assert choose_and_finetune(tiny_dataset, settings, tmp_path / "twice", pretrained).records == again.records


def test_between_is_a_line(pretrained) -> None:
    old = load_weights(pretrained).network
    new = load_weights(pretrained).network
    with torch.no_grad():
        for value in new.parameters():
            value.add_(1.0)
    for share in (0.0, 0.25, 1.0):
        middle = between(old, new, share)
        for one, two in zip(old.parameters(), middle.parameters(), strict=True):
            np.testing.assert_allclose((two - one).detach(), share, atol=1e-5)


def test_nothing_to_choose_from_is_refused(tiny_dataset, pretrained, tmp_path) -> None:
    with pytest.raises(ConfigError):
        choose_and_finetune(tiny_dataset, (), tmp_path / "run", pretrained)
    one = replace(tiny_dataset, split={"train": tiny_dataset.objects("train")[:1]})
    run = choose_and_finetune(one, (Training(epochs=1, network=SMALL),), tmp_path / "one", pretrained)
    choice = read_choice(run.folder)
    assert choice is not None and choice.candidate is None


def captured(folder: Path, offset_y_m: float = 0.0, characters: str = "ABCEFGHJKLRT") -> Dataset:
    """Return objects before a wall, whose camera looks at the middle of their height or so far beside it."""
    setup = RadiometricSetup(cell_m=0.005, gain=0.7, ambient=0.06, sensor=SensorSize(48, 72))
    across_m, _ = setup.offset_m()
    config = Simulation(
        glyphs=HandwritingGlyphs(characters=characters, writers=1),
        setup=replace(setup, target_offset_m=(across_m, offset_y_m)),
        sampling=Sampling(height=32, width=48, pitch_m=0.005, scored_rows=24),
        positions=8,
        validation=0.0,
        held_out="T",
    )
    return simulate(config, folder)


def frames_of(dataset: Dataset, truth: np.ndarray) -> np.ndarray:
    """Return the frames that the setup of a dataset makes of true images [N, H, W], without noise."""
    operator = FrameOperator(from_dict(Simulation, dataset.config).setup, dataset.sampling)
    return operator(torch.from_numpy(truth)).numpy()


def test_further_captures_are_what_the_setup_would_make_of_their_truth(tmp_path) -> None:
    dataset = captured(tmp_path / "d")
    steps = list[Step]()
    more = augmented(dataset, "frame", steps.append)
    assert [one.done for one in steps if one.unit == "fits"] == [0, 1, 2, 3, 4]
    assert any(one.unit == "captures" for one in steps)
    assert more.config["augmented"]["asymmetry"] < MOST_ASYMMETRY
    names = more.objects("train")
    assert len(names) == 4 * len(dataset.objects("train")) and more.objects("test") == dataset.objects("test")
    kinds = {"writer": 11, "mirror": 11, "mean00": 10, "mean01": 10, "mean02": 2}
    assert {key: sum(name.startswith(key) for name in names) for key in kinds} == kinds
    for name in (names[0], names[11], names[22], names[-1]):
        samples, _ = read_shard(more.shard(name))
        assert samples.truth is not None
        off = samples.frame - frames_of(dataset, samples.truth)
        assert abs(off.mean()) < 2e-3 and off.std() < 0.01, name
        assert samples.truth.min() >= 0 and samples.truth.max() <= 1
    assert augmented(dataset, "frame").folder == more.folder


def test_events_have_mirror_images_and_no_means(tmp_path) -> None:
    dataset = captured(tmp_path / "d")
    names = augmented(dataset, "fusion").objects("train")
    assert len(names) == 2 * len(dataset.objects("train"))
    assert not [name for name in names if name.startswith("mean")]


def test_captures_of_a_setup_that_is_not_symmetric_are_not_mirrored(tmp_path) -> None:
    dataset = captured(tmp_path / "d", offset_y_m=0.04)
    assert asymmetry(dataset) > MOST_ASYMMETRY
    assert augmented(dataset, "event").objects("train") == dataset.objects("train")
    names = augmented(dataset, "frame").objects("train")
    assert len(names) == 2 * len(dataset.objects("train")) and not [
        n for n in names if n.startswith("mirrored")
    ]


def test_few_captures_tell_no_symmetry(tmp_path) -> None:
    dataset = captured(tmp_path / "d", characters="ABCT")
    with pytest.raises(DataError, match="3 captures tell no symmetry"):
        asymmetry(dataset)
    assert len(augmented(dataset, "frame").objects("train")) == 6


@pytest.mark.parametrize(("offset_y_m", "is_symmetric"), [(0.0, True), (0.02, False)])
def test_asymmetry_tells_a_camera_two_centimetres_off(offset_y_m, is_symmetric, tmp_path) -> None:
    found = asymmetry(captured(tmp_path / "d", offset_y_m))
    assert (found <= MOST_ASYMMETRY) == is_symmetric, found


@pytest.mark.parametrize("done", [0, 1])
def test_a_failed_choice_says_what_it_leaves(
    done, tiny_dataset, pretrained, tmp_path, monkeypatch, capsys
) -> None:
    trained = list[Path]()

    def failing(dataset, settings, out, *rest):
        if len(trained) == done:
            out.mkdir(parents=True)
            raise DataError("the captures are odd")
        trained.append(out)
        return train(dataset, settings, out, *rest)

    monkeypatch.setattr("evnlos.training.choice.train", failing)
    words = ["--weights", str(pretrained), "--data", str(tiny_dataset.folder), "--out", str(tmp_path / "run")]
    with pytest.raises(SystemExit) as end:
        main(["finetune", "--choose", "--epochs", "1", *words])
    told, trials = capsys.readouterr().err.splitlines()[-1], tmp_path / "run-trials"
    assert end.value.code == 2 and "the captures are odd" in told and trials.exists() is bool(done)
    assert (f"{trials} keeps what is trained: run the command again" in told) is bool(done)
