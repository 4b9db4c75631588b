"""`evnlos weights`: what they are, and a copy of half the size that sees the same."""

import json
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO

import pytest
import torch

from evnlos import train
from evnlos.cli import main
from evnlos.errors import DataError
from evnlos.models import GENERIC, UNetConfig, load_weights, published, published_for, save_weights
from evnlos.training import Training


@pytest.fixture(scope="module")
def run(tiny_dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("weights") / "run"
    train(tiny_dataset, Training(epochs=1, network=UNetConfig(width=8, depth=1, rank=8)), out)
    return out


def test_they_say_what_they_see_and_where_they_come_from(run, capsys) -> None:
    main(["weights", str(run), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert (found["modality"], found["sees_sequence"], found["network"]["rank"]) == ("frame", False, 8)
    assert found["parameters"] < found["numbers"]
    main(["weights", str(run)])
    text = capsys.readouterr().out
    assert "frame, unet: one time step at a time" in text and "1. simulation" in text


def test_a_copy_of_half_the_size_sees_the_same(run, tmp_path, capsys) -> None:
    copy = tmp_path / "half.safetensors"
    main(["weights", str(run), "--half", str(copy)])
    whole = run / "weights.safetensors"
    assert copy.stat().st_size < 0.7 * whole.stat().st_size
    sampling = load_weights(whole).sampling
    x = torch.rand(2, 1, sampling.height, sampling.width)
    one, other = (load_weights(path).network(x) for path in (whole, copy))
    torch.testing.assert_close(one, other, atol=0.01, rtol=0)
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main(["weights", str(run), "--half", str(copy)])
    assert "exists" in capsys.readouterr().err


def test_a_copy_of_lower_rank_is_smaller_and_sees_nearly_the_same(run, tmp_path, capsys) -> None:
    one, other, wrong = (tmp_path / f"{name}.safetensors" for name in ("all", "fewer", "more"))
    main(["weights", str(run), "--half", str(one), "--rank", "8"])
    main(["weights", str(run), "--half", str(other), "--rank", "6"])
    assert other.stat().st_size < one.stat().st_size
    whole, few = (load_weights(path).network for path in (one, other))
    assert few.settings.rank == few.embedding.rank == 6
    fewer, all_of_them = few.embedding.groups["frame"], whole.embedding.groups["frame"]
    torch.testing.assert_close(fewer.basis, all_of_them.basis[:, :6])
    x = torch.rand(4, *whole.embedding.shape)
    all_of_them.weights[6:] = 0
    torch.testing.assert_close(few.embedding(x), whole.embedding(x))
    capsys.readouterr()
    for arguments in (["--half", str(wrong), "--rank", "9"], ["--rank", "6"]):
        with pytest.raises(SystemExit):
            main(["weights", str(run), *arguments])
    said = capsys.readouterr().err
    assert "this embedding has 8: give 1 to 8" in said and "give its file with --half" in said
    assert not wrong.exists()


def test_no_weights_are_named_in_one_line(tmp_path, capsys) -> None:
    with pytest.raises(SystemExit):
        main(["weights", str(tmp_path / "none")])
    assert "does not exist" in capsys.readouterr().err


def test_scores_go_with_a_copy(run, tiny_dataset, tmp_path, capsys) -> None:
    main(
        [
            "evaluate",
            "--weights",
            str(run),
            "--data",
            str(tiny_dataset.folder),
            "--split",
            "validation",
            "--json",
        ]
    )
    scores = tmp_path / "scores.json"
    scores.write_text(capsys.readouterr().out)
    copy = tmp_path / "scored.safetensors"
    main(["weights", str(run), "--half", str(copy), "--scores", str(scores)])
    kept = load_weights(copy).scores
    assert kept["images"] == 8 * len(tiny_dataset.objects("validation")) and "mean" in kept["baselines"]
    main(["weights", str(copy)])
    assert f"{kept['overall']['psnr_db']:.2f} dB on simulation, validation" in capsys.readouterr().out
    scores.write_text('{"overall": 1}')
    with pytest.raises(SystemExit):
        main(["weights", str(run), "--half", str(tmp_path / "no.safetensors"), "--scores", str(scores)])
    assert "is not what `evnlos evaluate --json` prints" in capsys.readouterr().err


def test_a_stranger_s_scores_do_no_harm(run, tmp_path, capsys) -> None:
    loaded = replace(load_weights(run), scores={"psnr_db": [1], "overall": "good"})
    save_weights(tmp_path / "w.safetensors", loaded)
    main(["weights", str(tmp_path / "w.safetensors")])
    assert "not what this version writes" in capsys.readouterr().out


@pytest.fixture(scope="module")
def listed() -> str:
    with redirect_stdout(StringIO()) as shown:
        main(["weights"])
    return shown.getvalue()


@pytest.mark.parametrize("name", published())
def test_published_weights_are_whole_and_say_how_good_they_are(name: str, listed: str) -> None:
    path = published()[name]
    assert path.stat().st_size <= 16_000_000
    loaded = load_weights(name)
    setup, modality, *kind = name.split("-")
    assert loaded.modality.name == modality and loaded.network.sees_sequence == (kind == ["sequence"])
    if setup == GENERIC:  # layers to begin with, behind an embedding that has yet to be fitted
        assert {step["data"]["origin"] for step in loaded.history} == {"simulation"}
        (trained,) = loaded.history
        assert path.stat().st_size < 5_000_000 and int(trained["data"]["name"].removesuffix(" walls")) >= 9
        assert "layers to begin a training with" in listed
        return
    assert loaded.confidence is not None and loaded.scores["images"] >= 160
    better = loaded.scores["overall"]["psnr_db"] - loaded.scores["baselines"]["mean"]["psnr_db"]
    assert better > 1
    # What they were trained on is not what they were scored on.
    captures = [step["data"] for step in loaded.history if step["data"]["origin"] == "captures"]
    if setup == "page":
        assert not captures and loaded.scores["data"] == "test"
    else:
        assert captures and not {name[-1] for data in captures for name in data["train"]} & set("GK49")
    assert f"{name}: {modality}, {loaded.network.kind}: " in listed


def test_the_weights_of_the_nearest_setup_are_taken() -> None:
    assert published_for(0.36, "frame", is_motion_known=True) == "near-frame-sequence"
    assert published_for(0.44, "frame", is_motion_known=True) == "far-frame-sequence"
    assert published_for(None, "event", is_motion_known=True) == "near-event-sequence"
    with pytest.raises(DataError, match="give the motion"):
        published_for(0.3, "fusion", is_motion_known=False)
    # Where there are none for the nearest setup, those of the next one are.
    assert published_for(0.5, "frame", is_motion_known=False) == "near-frame"
