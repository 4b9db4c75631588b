"""`evnlos weights`: what they are, and a copy of half the size that sees the same."""

import json

import pytest
import torch

from evnlos import Training, UNetConfig, load_weights, train
from evnlos.cli import main


@pytest.fixture(scope="module")
def run(tiny_dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("weights") / "run"
    list(train(tiny_dataset, Training(epochs=1, network=UNetConfig(width=8, depth=1, rank=8)), out))
    return out


def test_they_say_what_they_see_and_where_they_come_from(run, capsys) -> None:
    main(["weights", str(run), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert (found["paradigm"], found["joint"], found["network"]["rank"]) == ("frame", False, 8)
    assert found["parameters"] < found["numbers"]
    main(["weights", str(run)])
    text = capsys.readouterr().out
    assert "frame, one position at a time" in text and "1. simulation" in text


def test_a_copy_of_half_the_size_sees_the_same(run, tmp_path, capsys) -> None:
    copy = tmp_path / "half.safetensors"
    main(["weights", str(run), "--half", str(copy)])
    whole = run / "weights.safetensors"
    assert copy.stat().st_size < 0.7 * whole.stat().st_size
    sampling = load_weights(whole).sampling
    x = torch.rand(2, 1, sampling["height"], sampling["width"])
    one, other = (load_weights(path).network(x) for path in (whole, copy))
    torch.testing.assert_close(one, other, atol=0.01, rtol=0)
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main(["weights", str(run), "--half", str(copy)])
    assert "exists" in capsys.readouterr().err


def test_no_weights_are_named_in_one_line(tmp_path, capsys) -> None:
    with pytest.raises(SystemExit):
        main(["weights", str(tmp_path / "none")])
    assert "does not exist" in capsys.readouterr().err
