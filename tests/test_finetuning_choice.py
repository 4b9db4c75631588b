"""Fine-tuning chosen on captures held out: it takes what helps, leaves what harms, goes on after a stop."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from evnlos.data import NlosDataset
from evnlos.errors import ConfigError
from evnlos.metrics import psnr
from evnlos.models import UNetConfig, load_weights
from evnlos.training import Training, between, choose_and_finetune, read_choice, train

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
