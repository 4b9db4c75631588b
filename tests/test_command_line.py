"""The habits of the command line: completion, log levels, JSON on stdout, documented variables."""

import contextlib
import json
import logging
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import evnlos
from evnlos import Events, doctor, write_events
from evnlos.cli import VERBS, main
from evnlos.cli.about import script
from evnlos.cli.main import command_of
from evnlos.cli.parsing import say
from evnlos.data import captures_in
from evnlos.types import matching_paths

SOURCE = Path(evnlos.__file__).parent
PAGE = (SOURCE.parent.parent / "docs" / "command_line.md").read_text()


@pytest.fixture
def recording(tmp_path) -> Path:
    path = tmp_path / "events.npz"
    write_events(path, Events([1, 2, 9], [0, 1, 2], [0, 1, 1], [1, 0, 1], width=4, height=3))
    return path


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_flags_and_choices(tmp_path) -> None:
    (tmp_path / "completion").write_text(script("bash"))
    (tmp_path / "some_file").touch()
    cases = {
        "evnlos tra": "train",
        "evnlos train --netw": "--network.width",
        "evnlos train --schedule ": "cosine",
    }
    ask = '. ./completion; read -ra COMP_WORDS <<< "$0"; [[ "$0" = *" " ]] && COMP_WORDS+=(""); '
    ask += 'COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); _tyro_evnlos; printf "%s\\n" "${COMPREPLY[@]}"'
    for typed, offered in cases.items():
        done = subprocess.run(["bash", "-c", ask, typed], capture_output=True, text=True, cwd=tmp_path)
        assert offered in done.stdout.split(), (typed, done)
    shown = subprocess.run(
        ["bash", "-c", ". ./completion; complete -p evnlos"], capture_output=True, cwd=tmp_path
    )
    assert b"-o default" in shown.stdout  # files, where nothing else fits


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_the_completion_of_other_shells_knows_every_command(shell: str, capsys) -> None:
    main(["completion", shell])
    text = capsys.readouterr().out
    assert not [verb for verb in VERBS if verb not in text]


def test_log_levels(recording, monkeypatch, capsys) -> None:
    def notes() -> str:
        say("a note")
        say("warning: a warning")
        return capsys.readouterr().err

    main(["cite"])
    assert notes() == "a note\nwarning: a warning\n"
    main(["cite", "--log-level", "warning"])
    assert notes() == "warning: a warning\n"
    monkeypatch.setenv("EVNLOS_LOG", "error")
    main(["cite"])
    assert notes() == ""
    main(["--log-level=info", "cite"])
    assert "a note" in notes()
    monkeypatch.setenv("EVNLOS_LOG", "loud")
    with pytest.raises(SystemExit) as stop:
        main(["cite"])
    assert stop.value.code == 2
    assert "EVNLOS_LOG is 'loud'; give one of debug, info, warning, error" in capsys.readouterr().err
    monkeypatch.delenv("EVNLOS_LOG")
    with pytest.raises(SystemExit):
        main(["info", "nowhere.raw", "--log-level", "debug"])
    shown = capsys.readouterr().err
    assert "Traceback" in shown and shown.splitlines()[-1].startswith("evnlos info: error: nowhere.raw")
    main(["info", str(recording)])
    assert len(logging.getLogger("evnlos").handlers) == 1


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_words_that_do_not_fit_are_one_line_whatever_the_terminal_shows(encoding: str) -> None:
    for words, said in (
        (("--port", "abc"), "--port is 'abc'; give a whole number"),
        (("--prot", "3"), "Unrecognized options: --prot, 3; Perhaps you meant: --port INT"),
        (("one", "two"), "one, two: app takes no more words without a flag; give one at a time"),
        (("--port",), "Missing value for argument '--port'. Expected 1 values"),
    ):
        done = subprocess.run(
            [sys.executable, "-m", "evnlos", "app", *words],
            env={**os.environ, "PYTHONIOENCODING": encoding, "COLUMNS": "40"},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 2 and done.stdout == ""
        assert done.stderr == f"evnlos app: error: {said}; see evnlos app --help\n"


_NUMBERS = re.compile(r"^ *│? *(--[a-z][\w.-]*) ((?:\{None\}\||\[|\{)*(?:STR )?(?:FLOAT|INT).*?)(?:  |$)", re.M)
"""An option of numbers in the help, and what its words are."""
_ITS_FIRST_WORD = {
    "capture": "check",
    "experiment": "captures",
    "fetch": "captures",
    "pixel": "fit",
    "scan": "plan",
}
_NEEDED = {"--data": ("evaluate", "finetune", "report"), "--weights": ("evaluate", "finetune")}


@pytest.mark.parametrize("verb", VERBS)
def test_a_number_that_is_none_is_told_with_its_flag_and_the_cure(verb: str, monkeypatch, capsys) -> None:
    """`--fps nan` was told "fps is nan; its size has to be 1e-30 to 1e+30"; others showed types of Python."""
    monkeypatch.setenv("COLUMNS", "400")
    with contextlib.suppress(SystemExit):
        main([verb, "--help"])
    page = capsys.readouterr().out
    rest = [_ITS_FIRST_WORD[verb]] if verb in _ITS_FIRST_WORD else []
    rest += ["x"] * (len(re.findall(r" [A-Z]\w+", page.splitlines()[0])) if verb != "experiment" else 0)
    rest += [word for flag, verbs in _NEEDED.items() if verb in verbs for word in (flag, "x")]
    for k, (kind, flag) in enumerate({kind: flag for flag, kind in _NUMBERS.findall(page)}.items()):
        wrong = ("nan", "-inf", "1e400")[k % 3]
        count = 2 if "[" in kind else len(re.findall(r"FLOAT|INT", kind))
        with pytest.raises(SystemExit) as end:
            main([verb, *rest, flag, *["one"] * ("STR" in kind), *[wrong] * count])
        told = capsys.readouterr().err
        assert end.value.code == 2 and told.count("\n") == 1
        assert re.search(rf"{flag} is '.*; give .*(number|NUMBER|INT)", told), told
        assert "INT" in kind or "finite" in told, told
        assert not re.search("Error parsing|typing|tuple|FLOAT", told), told


def test_json_is_one_object(recording, tmp_path, capsys) -> None:
    def printed(*words: object) -> dict:
        capsys.readouterr()
        main([*map(str, words), "--json"])
        return json.loads(capsys.readouterr().out)

    made = printed("convert", recording, "--out", tmp_path / "same.h5")
    assert made["events"] == 3 and made["bytes"] == (tmp_path / "same.h5").stat().st_size
    assert printed("cite")["evnlos"].startswith("@software{evnlos")


def test_the_page_lists_the_commands_with_json() -> None:
    with_json = {verb for verb in VERBS if "json" in command_of(verb).__dataclass_fields__}
    sentence = re.search(r"`--json` is there(.*?)`experiment`", PAGE, re.DOTALL)
    assert sentence and set(re.findall(r"`(\w+)`", sentence[1])) == with_json


def test_every_variable_that_is_read_is_documented() -> None:
    used: set[str] = set()
    for path in SOURCE.rglob("*.py"):
        text = path.read_text()
        used |= set(re.findall(r'environ(?:\.get\(|\[)"(\w+)"', text)) | set(
            re.findall(r'"(EVNLOS_\w+)"', text)
        )
    assert {"EVNLOS_LOG", "EVNLOS_VGG16", "RANK"} <= used
    assert not {name for name in used if f"`{name}`" not in PAGE}


def test_the_doctor_survives_a_part_that_raises(monkeypatch) -> None:
    def fails() -> bool:
        raise ImportError("libcudart.so: cannot open shared object file")

    monkeypatch.setattr(torch.cuda, "is_available", fails)
    parts = {part.name: part for part in doctor.examine()}
    assert parts["GPU"].needed and "ImportError: libcudart.so" in parts["GPU"].found and parts["GPU"].cure
    assert parts["reader"].there and parts["numba"].there


def test_a_pattern_stands_for_the_captures_that_it_matches(tiny_captures, tmp_path, capsys) -> None:
    """Windows' shells, and quotes in the others, hand patterns on; the program looks for what they match."""
    above = tiny_captures[0].parent
    pattern = str(above / tiny_captures[0].name[:-1]) + "?"
    matching = captures_in([Path(pattern)])
    assert matching == sorted(path for path in tiny_captures if path.match(pattern))
    assert captures_in([above]) == captures_in([above / "*"]) == sorted(tiny_captures)
    main(["import", pattern, "--out", str(tmp_path / "data"), "--no-check-images", "--json"])
    split = json.loads(capsys.readouterr().out)["split"]
    assert sum(map(len, split.values())) == len(matching) > 1
    odd = tmp_path / "odd[1]"  # brackets are a pattern's, and this is a name
    shutil.copytree(tiny_captures[0], odd)
    assert matching_paths([odd, "nothing/*"]) == [odd, Path("nothing/*")]


@pytest.mark.parametrize(
    "words",
    [
        ["simulate", "--out", "file/x"],
        ["demo", "--out", "file/x"],
        ["lab", "--out", "file/x"],
        ["import", "CAPTURE", "--out", "file/x"],
        ["calibrate", "CAPTURE", "--out", "file/x"],
        ["train", "--data", "DATA", "--out", "file/x"],
        ["finetune", "--weights", "near-frame", "--data", "DATA", "--out", "file/x"],
        ["report", "run", "--data", "DATA", "--out", "file/x.html"],
        ["identify", "main-near", "--out", "file/x"],
        ["reconstruct", "CAPTURE", "--out", "file/x"],
        ["invert", "CAPTURE", "--setup", "main-near", "--out", "file/x.png"],
        ["track", "CAPTURE", "--out", "file/x.png"],
        ["experiment", "simulation", "--out", "file/x"],
        ["live", "CAPTURE", "--out", "file/x"],
        ["events", "clip.gif", "--out", "file/x.h5"],
        ["convert", "CAPTURE/events.raw", "--out", "file/x.h5"],
        ["clean", "CAPTURE/events.raw", "--out", "file/x.h5"],
        ["preview", "CAPTURE/events.raw", "--out", "file/x.gif"],
        ["events", "clip.gif", "--out", "x.h5", "--preview", "file/x.gif"],
        ["weights", "near-frame", "--half", "file/x.safetensors"],
        ["pixel", "fit", "CAPTURE/events.raw", "--light", "unknown", "--out", "file/x"],
        ["scan", "import", "CAPTURE", "--out", "file/x.safetensors"],
        ["corner", "clip.gif", "--edge", "9", "9", "--wall", "9", "0", "--end", "0", "9", "--out", "file/x"],
    ],
    ids=lambda words: words[0],
)
def test_where_a_result_goes_is_looked_at_before_it_is_worked_for(
    words, tiny_captures, tiny_dataset, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("in the way")
    given = {"CAPTURE": str(tiny_captures[0]), "DATA": str(tiny_dataset.folder)}
    for name, path in given.items():
        words = [word.replace(name, path) for word in words]
    monkeypatch.setattr(command_of(words[0]), "run", lambda self: pytest.fail("it began"))
    with pytest.raises(SystemExit) as end:
        main(words)
    said = capsys.readouterr().err
    assert end.value.code == 2 and said.count("\n") == 1 and "file is a file; give another place" in said


@pytest.mark.parametrize(
    ("words", "there"),
    [
        (["track", "CAPTURE", "--out", "a.png"], "a.png"),
        (["track", "CAPTURE"], "track.json"),
        (["invert", "wall.npz", "--out", "wall.png"], "wall.npz"),
        (["report", "run", "--data", "d"], "report.csv"),
        (["events", "VIDEO", "--out", "a.h5"], "a.h5"),
        (["events", "VIDEO", "--out", "a.h5", "--preview", "a.gif"], "a.gif"),
        (["convert", "a.raw", "--out", "a.csv"], "a.csv"),
        (["clean", "a.raw", "--out", "a.csv"], "a.csv"),
        (["preview", "a.raw"], "a.gif"),
        (["preview", "a.raw", "--out", "b.png"], "b.png"),
        (["identify", "main-near", "--out", "limits"], "limits/identify.json"),
        (
            ["corner", "a.mp4", *["--edge", "9", "9", "--wall", "9", "0", "--end", "0", "9"]],
            "corner/summary.json",
        ),
        (["corner", "a.mp4", "--simulate"], "a.json"),
        (["scan", "import", "tray"], "tray/transport.safetensors"),
        (["scan", "import", "tray", "--out", "wall.safetensors"], "wall.png"),
        (["scan", "rehearse", "tray"], "tray/film.mp4"),
        (["pixel", "fit", "led.raw", "--out", "fit"], "fit/pixel.yaml"),
        (["calibrate", "CAPTURE", "--out", "setup"], "setup/setup.yaml"),
    ],
)
def test_nothing_is_replaced_without_force(words, there, tiny_captures, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path(there).parent.mkdir(exist_ok=True)
    Path(there).write_text("precious")
    tmp_path.with_suffix(".gif").write_bytes(b"GIF89a")
    with pytest.raises(SystemExit) as end:
        known = {"CAPTURE": tiny_captures[0], "VIDEO": tmp_path.with_suffix(".gif")}
        main([str(known.get(word, word)) for word in words])
    told = capsys.readouterr().err
    assert end.value.code == 2 and told.count("\n") == 1 and f"{there} exists; give another" in told
    assert "--force" in told and Path(there).read_text() == "precious"
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == {tmp_path / there}


@pytest.mark.parametrize("verb", ["events", "invert", "report", "capture", "import", "calibrate"])
def test_what_is_read_can_not_be_left_out_by_the_words_of_the_help(verb, capsys) -> None:
    with pytest.raises(SystemExit):
        main([verb, "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    place = shown.partition("positional arguments")[2].partition("options")[0]
    assert "(required)" in place and "(default: )" not in place and "[PATH" not in shown


@pytest.mark.parametrize("verb", VERBS)
def test_what_writes_a_file_has_force(verb) -> None:
    fields = command_of(verb).__dataclass_fields__
    if "out" in fields and str(fields["out"].type).startswith(("OutFile", "OutImage")):
        assert "force" in fields


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["simulate", "--out", "notes"], "notes is not empty and holds no dataset.yaml; give a new folder"),
        (["simulate", "--out", "new", "--workers", "-1"], "workers is -1; give 0 (one for each core) or more"),
        (["simulate", "--out", "new", "--workers", "-1", "--force"], "workers is -1; give 0"),
        (["simulate", "--out", "new", "--workers", "-1", "--dry-run"], "workers is -1; give 0"),
        (["lab", "--out", "new", "--workers", "-1"], "workers is -1; give 0"),
        (["lab", "--out", "notes"], "lab_A is there without a capture.yaml; move it away"),
        (
            ["train", "--data", "DATA", "--out", "notes"],
            "notes is not empty and holds no run; give a new folder",
        ),
        (["import", "CAPTURE", "--out", "notes"], "notes is not empty and holds no dataset.yaml"),
    ],
)
def test_what_is_refused_is_told_alone_and_changes_nothing(
    words, said, tiny_captures, tiny_dataset, tmp_path, monkeypatch, capsys
) -> None:
    """Not after notes on what will not be done."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes" / "lab_A").mkdir(parents=True)
    data = shutil.copytree(tiny_dataset.folder, tmp_path / "data")
    page = (data / "dataset.yaml").read_text()
    (data / "dataset.yaml").write_text(page.replace("  setup:\n", "  setup:\n    misfit: by far\n", 1))
    given = {"CAPTURE": str(tiny_captures[0]), "DATA": str(data)}
    with pytest.raises(SystemExit) as end:
        main([given.get(word, word) for word in words])
    told = capsys.readouterr()
    assert end.value.code == 2 and told.err.count("\n") == 1 and said in told.err and not told.out
    assert {path.name for path in tmp_path.rglob("*") if data not in path.parents} == {"notes", "data", "lab_A"}


def test_a_list_that_may_be_left_out_says_so_in_the_help(capsys) -> None:
    for verb in VERBS:
        with contextlib.suppress(SystemExit):
            main([verb, "--help"])
        shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert "(default: )" not in shown, verb
        assert verb not in ("identify", "fetch", "lab") or "(default: unset)" in shown, verb


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "vid v.npy",
            "; vid is a folder; several files are the images of one video: give one video, or a folder",
        ),
        ("v.npy", "; v.npy: its frames carry no times; give --fps; see"),
        ("vid", "; vid/v.npy: its frames carry no times; give --fps; see"),
        ("nowhere.mp4", "; nowhere.mp4: no such file; check the path; see"),
    ],
)
def test_the_answer_to_a_missing_out_is_the_whole_cure(
    words: str, said: str, tmp_path, monkeypatch, capsys
) -> None:
    """It named --out alone, and the next answers the folder, then the missing times."""
    monkeypatch.chdir(tmp_path)
    Path("vid").mkdir()
    for name in ("v.npy", "vid/v.npy"):
        np.save(name, np.zeros((3, 4, 6), np.uint8))
    with pytest.raises(SystemExit) as end:
        main(["events", *words.split()])
    told = capsys.readouterr().err
    assert end.value.code == 2 and told.count("\n") == 1 and said in told
    assert (
        "--out PATH (The event file; its ending says the format: .h5, " in told
        and "e.g. --out result.h5" in told
    )
    with pytest.raises(SystemExit):  # and with it the same is said, before anything is opened
        main(["events", *words.split(), "--out", "e.h5"])
    assert said.split("; ")[1] in capsys.readouterr().err and not Path("e.h5").exists()


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no folder here in which nobody can make a file")
@pytest.mark.parametrize("words", ["identify main-near --out", "simulate --out", "convert e.npz --out"])
def test_a_place_where_nobody_can_write_is_refused_before_the_work(
    words: str, tmp_path, monkeypatch, capsys
) -> None:
    """For root every place seemed to be writable, and half a minute of work was lost."""
    monkeypatch.chdir(tmp_path)
    write_events("e.npz", Events([1, 2], [0, 1], [0, 1], [1, 0], 2, 2))
    with pytest.raises(SystemExit) as end:
        main([*words.split(), "/proc/nope/o.h5"])
    told = capsys.readouterr().err
    assert end.value.code == 2 and told.count("\n") == 1
    assert "/proc/nope/o.h5 cannot be written: /proc is not writable; give another place" in told
