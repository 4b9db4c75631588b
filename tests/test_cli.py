"""Every command, as a user types it: right input does the job, wrong input is one line and exit code 2."""

import html
import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from evnlos import open_dataset
from evnlos.cli import VERBS, main
from evnlos.config import save_yaml
from evnlos.data import Samples, Sampling
from evnlos.machine import ProgressBars
from evnlos.models import ConfidenceReport, SequenceConfig, Weights, published_for, save_weights
from evnlos.report import result_sheet

NETWORK = ["--network.width", "8", "--network.depth", "2"]


def call(*arguments: object) -> None:
    main([str(argument) for argument in arguments])


def fails(capsys, *arguments: object) -> str:
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        call(*arguments)
    error = capsys.readouterr().err
    assert stop.value.code == 2, error
    lines = [line for line in error.splitlines() if line.startswith("evnlos")]
    assert len(lines) == 1, error
    assert "Traceback" not in error
    return lines[0]


@pytest.fixture(scope="module")
def recorded(tiny_captures, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("recorded") / "d"
    sampling = ["--sampling.height", 32, "--sampling.width", 48, "--sampling.scored-rows", 24]
    call("import", *tiny_captures, "--out", out, "--test", "4", *sampling, "--sampling.pitch-m", 0.005)
    return out


@pytest.fixture(scope="module")
def runs(recorded, tiny_dataset, tmp_path_factory) -> dict[str, Path]:
    """Pre-trained, fine-tuned and end-to-end runs, made by the commands."""
    out = tmp_path_factory.mktemp("runs")
    found = {}
    for modality in ("frame", "fusion"):
        pre, epnp, e2e = (out / f"{kind}-{modality}" for kind in ("pre", "epnp", "e2e"))
        call(
            "train",
            "--data",
            tiny_dataset.folder,
            "--modality",
            modality,
            "--out",
            pre,
            "--epochs",
            2,
            *NETWORK,
        )
        call("finetune", "--weights", pre, "--data", recorded, "--out", epnp, "--epochs", 2)
        call("train", "--data", recorded, "--modality", modality, "--out", e2e, "--epochs", 2, *NETWORK)
        found |= {p.name: p for p in (pre, epnp, e2e)}
    return found


def test_the_page_is_made_again_by_its_own_script(
    runs, recorded, tiny, tiny_captures, tmp_path, monkeypatch, capsys
) -> None:
    """In an empty folder with the captures, the simulation's settings and the files that the page shows."""
    capsys.readouterr()
    names = ["epnp-frame", "e2e-frame"]
    call("report", *[runs[one] for one in names], "--data", recorded, "--out", tmp_path / "a.html", "--json")
    first = json.loads(capsys.readouterr().out)
    page = html.unescape((tmp_path / "a.html").read_text())
    script = re.search(r"To make it again.*?<pre>(.*?)</pre>", page, re.DOTALL)[1]
    again = tmp_path / "again"
    again.mkdir()
    for one in tiny_captures:
        shutil.copytree(one, again / one.name)
    for name, text in re.findall(r"<h3>([^<]*[.]yaml)</h3><pre>(.*?)</pre>", page, re.DOTALL):
        (again / name).write_text(text)
    (simulation,) = re.findall(r"^# (.*[.]yaml): settings of hash", script, re.MULTILINE)
    save_yaml(tiny, again / simulation)
    monkeypatch.chdir(again)
    for line in script.splitlines():
        if not line.startswith("#"):
            capsys.readouterr()
            main(shlex.split(line)[1:])
    call("report", *names, "--data", recorded.name, "--out", again / "b.html", "--json")
    second = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert second["runs"] == first["runs"] and second["baselines"] == first["baselines"]


WITHOUT_OUT = (
    "evaluate",
    "weights",
    "verify",
    "info",
    "convert",
    "clean",
    "capture",
    "app",
    "cite",
    "doctor",
    "completion",
)
"""Commands that write nothing, or name what they write in another way."""


@pytest.mark.parametrize("verb", VERBS)
def test_help_shows_every_command_with_its_defaults(verb: str, capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        call(verb, "--help")
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "--out" in text or verb in WITHOUT_OUT
    assert "default" in text
    call("--help")
    assert verb in capsys.readouterr().out


def test_version(capsys) -> None:
    call("--version")
    assert re.match(r"\d+\.\d+", capsys.readouterr().out)


def test_simulate_prints_what_diffraction_does(tiny, tmp_path, capsys) -> None:
    save_yaml(tiny, tmp_path / "tiny.yaml")
    call(
        "simulate",
        "--config",
        tmp_path / "tiny.yaml",
        "--glyphs.characters",
        "AB",
        "--out",
        tmp_path / "d",
        "--workers",
        1,
    )
    shown = capsys.readouterr()
    assert "fresnel_number" in shown.err
    assert "4 objects, 32 samples, 0 missing" in shown.out
    assert len(open_dataset(tmp_path / "d").objects()) == 4
    with pytest.raises(SystemExit):
        call(
            "simulate", "--config", tmp_path / "tiny.yaml", "--glyphs.kharacters", "AB", "--out", tmp_path / "e"
        )


def test_import_splits(recorded) -> None:
    assert open_dataset(recorded).split == {
        "train": ["lab_A", "lab_L", "lab_T"],
        "validation": [],
        "test": ["lab_4"],
    }


def test_lab_renders_a_capture(tmp_path, capsys) -> None:
    small = [
        "--setup.sensor.height",
        24,
        "--setup.sensor.width",
        36,
        "--setup.cell-m",
        0.02,
        "--frame-rate-hz",
        1,
    ]
    call("lab", "--out", tmp_path / "lab", "--glyphs.family", "kalam", "--glyphs.characters", "K", *small)
    assert (tmp_path / "lab" / "lab_K" / "capture.yaml").is_file()
    assert len(list((tmp_path / "lab" / "lab_K" / "frames").glob("*.png"))) == 9


def test_evaluate_prints_one_json_object(runs, recorded, capsys) -> None:
    capsys.readouterr()
    call("evaluate", "--weights", runs["epnp-fusion"], "--data", recorded, "--json")
    found = json.loads(capsys.readouterr().out)
    assert found["modality"] == "fusion"
    assert found["images"] == 8
    assert set(found["characters"]) == {"lab_4"}
    assert found["characters"]["lab_4"]["character"] == "4"
    for scores in (
        found["overall"],
        found["baselines"]["zero"]["overall"],
        found["baselines"]["mean"]["overall"],
    ):
        assert 0 < scores["psnr_db"] < 60
        assert -1 <= scores["ssim"] <= 1
        assert scores["lpips"] is None
    call("evaluate", "--weights", runs["epnp-fusion"], "--data", recorded)
    assert "not available" in capsys.readouterr().out


def test_evaluate_refuses_objects_that_training_saw(runs, tmp_path, tiny_captures, capsys) -> None:
    sampling = ["--sampling.height", 32, "--sampling.width", 48, "--sampling.scored-rows", 24]
    call(
        "import", *tiny_captures, "--out", tmp_path / "d", "--test", "A", *sampling, "--sampling.pitch-m", 0.005
    )
    assert "lab_A" in fails(capsys, "evaluate", "--weights", runs["e2e-frame"], "--data", tmp_path / "d")


def test_reconstruct_writes_images_strip_and_animation(runs, tiny_captures, tmp_path, capsys) -> None:
    capsys.readouterr()
    call("reconstruct", tiny_captures[3], "--weights", runs["epnp-frame"], "--out", tmp_path / "r", "--json")
    found = json.loads(capsys.readouterr().out)
    assert found["positions"] == 8 and found["scores"]["psnr_db"] > 0
    assert len(list((tmp_path / "r").glob("position_*.png"))) == 8
    images = np.load(tmp_path / "r" / "reconstruction.npy")
    assert images.shape == (8, 32, 48)
    with Image.open(tmp_path / "r" / "animation.gif") as animation:
        assert animation.n_frames == 8
    with Image.open(tmp_path / "r" / "position_03.png") as picture:
        np.testing.assert_array_equal(np.asarray(picture)[::4, ::4], np.round(255 * images[3]).astype(np.uint8))
    assert "not an empty folder" in fails(
        capsys, "reconstruct", tiny_captures[3], "--weights", runs["epnp-frame"], "--out", tmp_path / "r"
    )


def test_without_weights_published_ones_that_fit_are_taken(tiny_captures, tmp_path, capsys) -> None:
    folder, unknown = tmp_path / "known", tmp_path / "unknown"
    for copy in (folder, unknown):
        shutil.copytree(tiny_captures[0], copy)
        text = (copy / "capture.yaml").read_text()
        (copy / "capture.yaml").write_text(text.replace("  mask: target.png\n", ""))
    text = (unknown / "capture.yaml").read_text()
    (unknown / "capture.yaml").write_text(text[: text.index("motion:")] + "setup:\n  distance_m: null\n")
    taken = []
    for number, capture in enumerate((folder, unknown)):
        capsys.readouterr()
        call("reconstruct", capture, "--out", tmp_path / f"out{number}", "--json")
        taken.append(json.loads(capsys.readouterr().out)["weights"])
    assert taken == [published_for(0.3, "frame", is_motion_known=known) for known in (True, False)]
    assert taken[1] == "near-frame"


def test_report_is_one_page_without_requests(runs, recorded, tmp_path, capsys) -> None:
    call("report", *runs.values(), "--data", recorded, "--out", tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert not re.findall(r"(?:src|href)=['\"](?!data:|#)", page)
    assert not re.findall(r"https?:", page.replace("http://www.w3.org/2000/svg", ""))
    # What leads, one position, a strip of truth and runs, an animation, the worst images of each run.
    assert page.count("<img") == 1 + (3 + len(runs)) + (1 + len(runs)) + 1 + 6 * len(runs)
    rows = (tmp_path / "report.csv").read_text().splitlines()
    assert rows[0].split(",")[3:6] == ["all-black", "mean image", "mean target at its place"]
    assert {"simulation only frame", "E2E fusion", "EPNP frame"} <= set(rows[0].split(","))
    shown = capsys.readouterr().out
    assert "report:" in shown and "lab 4" in shown
    # The page, the CSV and `evaluate` say the same.
    call("evaluate", "--weights", runs["e2e-fusion"], "--data", recorded, "--json")
    number = json.loads(capsys.readouterr().out)["overall"]["psnr_db"]
    row = dict(zip(rows[0].split(","), rows[1].split(","), strict=True))
    assert float(row["E2E fusion"]) == pytest.approx(number)
    assert f">{number:.2f}<" in page


def test_a_misspelt_command_names_the_nearest(capsys) -> None:
    for word, meant in (("reconstrct", "reconstruct"), ("Simulate", "simulate"), ("calibrat", "calibrate")):
        said = fails(capsys, word)
        assert f"unknown command {word!r}; did you mean {meant!r}?" in said and "finetune" not in said


def test_a_misspelt_option_before_any_command_names_the_nearest(capsys) -> None:
    for word, meant in (("--verson", "--version"), ("--hlep", "--help"), ("--quite", "--quiet")):
        assert f"unknown option {word!r}; did you mean {meant!r}?" in fails(capsys, word)
    said = fails(capsys, "-x")
    assert "unknown option '-x'; give one of --version, --help" in said and "finetune" not in said


def test_captures_that_are_not_there_match_nothing(tmp_path, capsys) -> None:
    said = fails(capsys, "demo", "--out", tmp_path / "none", "--captures", tmp_path / "nope" / "*")
    assert "nope/* matches nothing; give capture folders" in said and not (tmp_path / "none").exists()


def test_one_image_of_a_whole_recording_is_shown_once(tiny_captures, tmp_path, capsys) -> None:
    sampling = Sampling(height=24, width=36, scored_rows=18)
    network = SequenceConfig(width=4, depth=1, rank=4).build("frame", sampling).eval()
    save_weights(tmp_path / "w.safetensors", Weights(network))
    call("reconstruct", tiny_captures[0], "--weights", tmp_path / "w.safetensors", "--out", tmp_path / "r")
    assert "all positions show one image" in capsys.readouterr().out
    told = json.loads((tmp_path / "r" / "summary.json").read_text())
    assert told["one_picture"] and any("one image" in line for line in told["in_words"])
    assert "confidence" in told or told["no_confidence"] in told["in_words"]
    positions = [path.name for path in (tmp_path / "r").glob("position_*.png")]
    assert len(positions) == 1 < told["positions"]  # it stood there once for each, moved along the stated path
    with Image.open(tmp_path / "r" / positions[0]) as one, Image.open(tmp_path / "r" / "strip.png") as row:
        assert row.width <= 2 * one.width
    with Image.open(tmp_path / "r" / "result.png") as sheet:
        assert sheet.width > 900 and sheet.height > 400
        dark = np.asarray(sheet.convert("L")) < 60
        assert dark[:40].any() and dark[-40:].any()  # a title, and what it means


def test_the_result_is_drawn_with_and_without_what_may_be_unknown() -> None:
    sampling = Sampling(height=24, width=36, scored_rows=18)
    draw = np.random.default_rng(1)
    maps = draw.random((3, 24, 36), np.float32)
    path = np.stack([np.linspace(-0.08, 0.08, 3), np.zeros(3)], axis=1)
    samples = Samples(maps, draw.random((3, 2, 24, 36), np.float32), maps, np.arange(3.0), path, np.full(3, 9))
    interval = ConfidenceReport(0.9, 0.1, torch.zeros(3, 24, 36), torch.ones(3, 24, 36))
    whole = result_sheet("all", maps, samples, sampling, interval, ["a line"])
    bare = replace(samples, truth=None, position_m=None)
    short = result_sheet("less", maps, bare, sampling, None, ["a line", "one that is " + "very " * 60 + "long"])
    assert whole.dtype == np.uint8 and whole.shape[1:] == short.shape[1:] and whole.shape[0] > short.shape[0]
    assert (whole == (11, 95, 165)).all(axis=-1).any() and not (short == (11, 95, 165)).all(axis=-1).any()


def test_wrong_input_is_one_line_and_exit_code_2(
    runs, recorded, tiny_captures, tmp_path, monkeypatch, capsys
) -> None:
    out = tmp_path / "out"
    assert "unknown command 'zzz'; give one of demo, simulate" in fails(capsys, "zzz")
    assert "--port is 'abc'; give a whole number; see" in fails(capsys, "app", "--port", "abc")
    assert "--fps is 'x'; give a number; see" in fails(capsys, "events", "v.mp4", "--fps", "x", "--out", "e.h5")
    assert "--changing is '1'; give NUMBER NUMBER; see" in fails(capsys, "invert", "c", "--changing", "1")
    assert "--pressset, near; perhaps you meant --set; see" in fails(capsys, "lab", "--pressset", "near")
    assert "Unrecognized options: --prot, 3; Perhaps you meant: --port INT" in fails(
        capsys, "app", "--prot", "3"
    )
    told = fails(capsys, "simulate")
    assert (
        "Missing from evnlos simulate: --out PATH (Folder of the dataset; " in told
        and "e.g. --out result;" in told
    )
    for flag, command in (("--start", ["calibrate", "c"]), ("--setup.pixel", ["simulate"])):  # groups of flags
        told = fails(capsys, *command, "--out", out, flag, "nope")
        assert f"Unrecognized options: {flag}, nope; Perhaps you meant: {flag}." in told and len(told) < 240
        assert told.count("--") == 5 and " or others; see evnlos" in told  # that one, three, --help
    (tmp_path / "w.npz").touch()
    monkeypatch.chdir(tmp_path)
    told = fails(capsys, "track", "c", "--targets", "nope")
    assert "--targets is 'nope'; give a whole number or auto; see" in told
    for words, said in (
        (
            ("identify", "--sequence.positions", "-1"),
            "SequenceAnalysisSettings.positions is -1; give 1 or more",
        ),
        (("identify", "--sequence.other-noises", "0"), "other_noises is (0.0,); give positive numbers"),
        (("invert", "w.npz", "--noise-sigma", "-1"), "--noise-sigma is -1; give 1e-12 or more"),
        (("invert", "w.npz", "--background-degree", "-1"), "--background-degree is -1; give 0 or more"),
        (("fetch", "captures", "--most-gb", "-1"), "--most-gb is -1; give more than 0 and at most 1e+06"),
    ):
        assert said in fails(capsys, *words)
    told = fails(capsys, "lab", "--out", out, "--set", "nope")
    assert "--set is 'nope'; give one of 'near', 'far'; see" in told or "'far', 'near'; see" in told
    assert "no modality of kind 'x'; give one of frame, event, fusion" in fails(
        capsys, "train", "--out", out, "--modality", "x"
    )
    assert "no dataset" in fails(capsys, "train", "--data", tmp_path, "--out", out)
    assert "does not exist" in fails(
        capsys, "finetune", "--weights", tmp_path / "w", "--data", recorded, "--out", out
    )
    known = ("finetune", "--weights", runs["e2e-frame"], "--data", recorded, "--captures", recorded)
    known += ("--out", out)
    assert "drawn is 0; give --drawn" in fails(capsys, *known)
    assert "leave --captures away" in fails(capsys, *known, "--choose")
    assert "not a folder" in fails(
        capsys, "reconstruct", tmp_path / "c", "--weights", runs["e2e-frame"], "--out", out
    )
    assert "capture.yaml" in fails(capsys, "import", tmp_path, "--out", out)
    assert "does not exist" in fails(capsys, "simulate", "--config", tmp_path / "c.yaml", "--out", out)
    assert "--preset" in fails(capsys, "simulate", "--preset", "papper", "--out", out)
    (tmp_path / "c.yaml").write_text("epoch: 3\n")
    assert "epochs" in fails(capsys, "train", "--config", tmp_path / "c.yaml", "--data", recorded, "--out", out)
    assert "vgg" in fails(
        capsys, "evaluate", "--weights", runs["e2e-frame"], "--data", recorded, "--vgg", tmp_path / "vgg.pth"
    )
    assert "pitch_m" in fails(capsys, "import", *tiny_captures, "--out", out, "--sampling.pitch-m", "-1")
    assert not out.exists()


def test_what_is_wrong_is_told_before_the_work(tiny_captures, tmp_path, capsys, monkeypatch) -> None:
    """Each of these was told after minutes of work, in the system's words, or in a way that led elsewhere."""
    monkeypatch.chdir(tmp_path)
    one, file = tiny_captures[0], tmp_path / "notes.txt"
    file.write_text("hello")
    for name in ("capture.yaml", "events.raw"):
        assert f"{name} is one file of a capture; give its folder" in fails(capsys, "reconstruct", one / name)
    assert "text that begins with 'hello', of no known event format; give a capture's folder or" in fails(
        capsys, "reconstruct", file
    )
    monkeypatch.setattr(ProgressBars, "__enter__", lambda _: pytest.fail("the work began"))
    for words in (["identify", "main-near"], ["demo"], ["pixel", "fit", one], ["calibrate", one], ["simulate"]):
        assert "notes.txt is a file; give the name of a folder" in fails(capsys, *words, "--out", file)
    for words in (["track", one], ["invert", one, "--setup", "main-near"]):
        assert "end its name in .png" in fails(capsys, *words, "--out", "a.xyz")
        assert "is a folder; give the name of a file" in fails(capsys, *words, "--out", tmp_path)
    assert "Demo.writers is -1; give 1 or more" in fails(capsys, "demo", "--writers", -1)
    assert "Demo.test names no character" in fails(capsys, "demo", "--test")
    assert "--captures holds 2, of which 1 are not to test on" in fails(
        capsys, "demo", "--captures", *tiny_captures[:2]
    )
    (tmp_path / "empty").mkdir()
    assert "empty holds no capture.yaml" in fails(capsys, "calibrate", *tiny_captures, "empty", "--out", "out")
    wrong = ("--cells", -3), ("--regularization", "-1"), ("--regularization", "few")
    for flag, value in wrong:
        told = fails(capsys, "invert", one, "--setup", "main-near", flag, value)
        assert f"{flag} is" in told and str(value) in told
    assert "is a folder, without --setup" in fails(capsys, "invert", one)
    assert "check has 0 folders; give one or more" in fails(capsys, "capture", "check")


def test_the_demo_runs_on_given_captures(tiny_captures, tmp_path, capsys, monkeypatch) -> None:
    from evnlos.data import SensorSize, simulations
    from evnlos.scene import HandwritingGlyphs

    few = replace(
        (usual := simulations.default()),
        glyphs=HandwritingGlyphs(characters="AB"),
        setup=replace(usual.setup, sensor=SensorSize(25, 40)),
        positions=8,
    )
    monkeypatch.setattr(simulations, "default", lambda: few)
    told = list[str]()
    monkeypatch.setattr(ProgressBars, "__call__", lambda _, step: told.append(step.what))
    one = ["--pretrain-epochs", 1, "--finetune-epochs", 1, "--e2e-epochs", 1, "--writers", 1, "--width", 8]
    one += ["--workers", 1, "--no-calibrate", "--single-epochs", 1, "--modalities", "event", "fusion"]
    call("demo", "--out", tmp_path / "demo", "--captures", *tiny_captures, *one)
    shown = capsys.readouterr().out
    assert "EPNP sequence fusion" in shown and "E2E event" in shown and "report:" in shown
    assert "| sees | strongest E2E |" in shown and "was not fitted to this setup" in shown
    page = (tmp_path / "demo" / "report.html").read_text()
    assert "Synthetic captures" not in page
    told = [what for what in told if not what.startswith("reconstruct ")]  # the first image comes before all
    parts = [re.fullmatch(r"part (\d) of 6, (.*)", what) for what in told]
    numbers = [int(part[1]) for part in parts if part]
    assert sorted(numbers) == numbers and {1, 2, 6} < set(numbers) and len(numbers) == len(told)
    assert {part[2] for part in parts if part and part[1] == "6"} == {"evaluate"}
    # A second call takes up what is there: nothing is made again, the table is the same. The folder above the
    # captures, with a file beside them, stands for them; one without captures is refused.
    note = tiny_captures[0].parent / "note.txt"
    note.write_text("seen on a Monday")
    call("demo", "--out", tmp_path / "demo", "--captures", note.parent, note, *one)
    table, again = [line for line in shown.splitlines() if line.startswith("|")], capsys.readouterr().out
    assert len(table) > 3 and all(line in again for line in table)
    (tmp_path / "empty").mkdir()
    said = fails(capsys, "demo", "--out", tmp_path / "none", "--captures", tmp_path / "empty")
    assert "holds no capture.yaml" in said and not (tmp_path / "none").exists()


def test_the_demos_own_captures_hold_its_test_characters() -> None:
    from evnlos.demo import LAB_CHARACTERS, Demo
    from evnlos.models import GENERIC

    assert Demo().start == GENERIC
    assert set(Demo().test) < set(LAB_CHARACTERS)
    assert len(set(LAB_CHARACTERS)) == len(LAB_CHARACTERS)
