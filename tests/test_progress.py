"""How far a piece of work is: bars, lines and JSON that move while nothing is told, and time that is left."""

import importlib
import json
import os
import re
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from evnlos import doctor
from evnlos.analysis import AnalysisSettings, evaluate, identify
from evnlos.calibration.transport_fit import levenberg_marquardt
from evnlos.cli import main
from evnlos.errors import ConfigError
from evnlos.machine import ProgressBars, Step, note, show_progress
from evnlos.models import UNetConfig, Weights
from evnlos.optics import dense_matrix
from evnlos.optics.radiometric import noted_rows
from evnlos.setups import load_setup
from evnlos.types import Plane


@pytest.fixture(autouse=True)
def shown(monkeypatch):
    """Lines every 50 ms instead of every five seconds; what a test chooses ends with it."""
    monkeypatch.setattr("evnlos.machine.LINE_S", 0.05)
    monkeypatch.setattr("evnlos.machine._BEAT_S", 0.01)
    monkeypatch.delenv("TQDM_DISABLE", raising=False)
    yield
    show_progress(None)


class Clock:
    """The clock of progress, which a test puts forward."""

    late_s = 0.0

    def monotonic(self) -> float:
        """Return the time, seconds."""
        return time.monotonic() + self.late_s


@pytest.fixture
def clock(monkeypatch) -> Clock:
    found = Clock()
    monkeypatch.setattr("evnlos.machine.time", found)
    return found


def work(how: str | None, within="", total: int = 4) -> None:
    """Do a piece of work whose second unit lasts long."""
    show_progress(how)
    with ProgressBars() as progress:
        progress(Step("simulate", 0, total, "objects"))
        time.sleep(0.02)
        progress(Step("simulate", 1, total, "objects", within=within))
        time.sleep(0.4)


def test_the_bar_tells_the_time_that_is_left(capsys) -> None:
    work("bar")
    assert re.search(r"1/4 \[\d\d:\d\d<\d\d:\d\d", capsys.readouterr().err)


def test_where_there_is_no_terminal_lines_come_while_nothing_is_told(capsys) -> None:
    work(None, "writer03_R")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) >= 4
    assert not [line for line in lines if "\r" in line]
    pattern = r"simulate: 1 of 4 objects \(writer03_R\), \d+ s, about \d+ s left"
    assert [line for line in lines if re.fullmatch(pattern, line)]


def test_short_work_says_nothing_without_a_terminal(capsys, monkeypatch) -> None:
    monkeypatch.setattr("evnlos.machine.LINE_S", 5.0)
    work(None)
    assert capsys.readouterr().err == ""


def test_lines_of_json_hold_numbers_for_a_program(capsys) -> None:
    work("json", lambda: (0.5, "half of it"))
    found = [json.loads(line)["progress"] for line in capsys.readouterr().err.splitlines()]
    told = [one for one in found if one["within"] == "half of it"]
    assert told and {(one["what"], one["done"], one["total"], one["unit"]) for one in told} == {
        ("simulate", 1, 4, "objects")
    }
    for one in told:  # one and a half of four units are done
        assert one["left_s"] == pytest.approx(one["elapsed_s"] * 2.5 / 1.5, abs=0.2)


@pytest.mark.parametrize(("how", "variable"), [("none", ""), (None, "1"), ("bar", "1"), ("lines", "1")])
def test_quiet_and_tqdm_disable_show_nothing(how, variable, capsys, monkeypatch) -> None:
    monkeypatch.setenv("TQDM_DISABLE", variable)
    work(how)
    assert capsys.readouterr().err == ""


def test_work_that_nobody_knows_the_length_of(capsys) -> None:
    work("lines", total=0)
    assert re.search(r"simulate: 1 objects, \d+ s$", capsys.readouterr().err, re.MULTILINE)


def test_a_stage_that_says_nothing_itself_moves(capsys) -> None:
    show_progress("lines")
    with ProgressBars() as progress, progress.stage("track", "follow the target", 2, 3):
        time.sleep(0.3)
    assert "track: 2 of 3 stages (follow the target), 0 s" in capsys.readouterr().err


def test_a_start_that_takes_long_says_that_libraries_are_loading(capsys) -> None:
    """On a cold disk they take longer than ten seconds, and a command said nothing meanwhile."""
    for after_s, said in ((0.05, "start: 0 of 1 stages (loading PyTorch and other libraries), 0 s"), (9, "")):
        show_progress("lines")
        with doctor.told_while_loading(after_s):
            time.sleep(0.3)
        assert capsys.readouterr().err.partition("\n")[0] == said


def test_what_computes_notes_what_is_at_work(capsys) -> None:
    show_progress("lines")
    with ProgressBars() as progress, progress.stage("identify", "main-near", 0, 2):
        note("light path")
        time.sleep(0.2)
        progress(Step("identify", 1, 2, "stages", within="main-far"))
        time.sleep(0.2)
    told = capsys.readouterr().err
    assert "identify: 0 of 2 stages (main-near; light path), 0 s" in told
    assert "(main-far)" in told and "(main-far; light path)" not in told


def test_a_piece_that_is_done_is_told_once(capsys, clock) -> None:
    show_progress("lines")
    with ProgressBars() as outer:
        outer(Step("render", 18, 19, "captures"))
        time.sleep(0.2)
        clock.late_s = 2  # as where the next line is due
        outer(Step("render", 19, 19, "captures"))
        with ProgressBars() as inner:
            inner(Step("simulate", 5, 5, "objects"))  # of a run before this one
            inner(Step("train", 1, 3, "networks"))
            time.sleep(0.3)
    told = capsys.readouterr().err
    assert told.count("render: 19 of 19") == 1 and told.count("train: 1 of 3") > 2 and "simulate" not in told


@pytest.mark.parametrize(("seconds", "said"), [(8.4, "8 s"), (95, "1 min 35 s"), (7300, "2 h 1 min")])
def test_a_time_is_told_as_people_say_it(seconds, said, capsys, clock) -> None:
    show_progress("lines")
    with ProgressBars() as progress:
        progress(Step("simulate", 0, 0, "objects"))
        clock.late_s = seconds
        progress(Step("simulate", 1, 0, "objects"))
    assert f"simulate: 1 objects, {said}\n" in capsys.readouterr().err


def test_a_fit_says_which_trial_it_makes(monkeypatch) -> None:
    told = list[str]()
    monkeypatch.setattr("evnlos.calibration.transport_fit.note", told.append)
    t = torch.linspace(0, 1, 20, dtype=torch.float64)
    truth = torch.exp(-3 * t)
    found = levenberg_marquardt(lambda p: torch.exp(-p[0] * t) - truth, [1.0], [1e-4], [(0.1, 10.0)])
    assert told[:2] == ["round 1, slope 1 of 1", "round 1, trial 2"] and len(told) == found.evaluations - 1


def test_identify_says_what_it_works_on(monkeypatch) -> None:
    """One stage of ten seconds and more, within which something new is told every second or so."""
    told = list[str]()
    for room in ("analysis.identify", "analysis.linearized", "inverse.prior"):
        monkeypatch.setattr(importlib.import_module(f"evnlos.{room}"), "note", told.append)
    # Cells and hands of no other test, whose targets would be known already.
    identify(load_setup("matte-near"), AnalysisSettings(cells=9, height=12, width=20, writers=3))
    parts = ("light path", "handwritten target 2 of", "singular values", "modes at a noise", "bars of")
    assert not [part for part in parts if not any(one.startswith(part) for one in told)]


def test_compiling_is_told_apart_from_standing_still(capsys, clock) -> None:
    from numba import njit
    from numba.core import event

    @njit
    def kernel(x: float) -> float:
        return x + 1

    class Slow(event.Listener):
        """Makes a compilation one that takes three seconds, of which the last line tells."""

        def __init__(self) -> None:
            self.told = list[str]()

        def on_start(self, event) -> None:
            clock.late_s += 3
            capsys.readouterr()
            time.sleep(0.2)
            self.told.append(capsys.readouterr().err)

        def on_end(self, event) -> None: ...

    slow = Slow()
    show_progress("lines")
    with ProgressBars() as progress:
        progress(Step("events", 0, 2, "frames"))
        time.sleep(0.1)  # the first look begins to listen
        with event.install_listener("numba:compile", slow):
            kernel(1.0)
            kernel(2.0)
        capsys.readouterr()
        time.sleep(0.2)
    (told,) = slow.told
    assert "events: 0 of 2 frames (compiling, once per installation)" in told
    after = capsys.readouterr().err
    assert "events: 0 of 2 frames" in after and "compiling" not in after


FIRST_LINE = """
import time
import evnlos.machine as machine
from numba.core import event  # as whoever is about to compile
with machine.ProgressBars() as progress:
    progress(machine.Step("reconstruct", 0, 3, "stages"))
    time.sleep(1.5)
    event.start_event("numba:compile")
    time.sleep(1.5)
    machine.LINE_S = 0.1
    time.sleep(1.5)
"""


def test_compilations_are_listened_for_before_the_first_line() -> None:
    known = os.environ | {"EVNLOS_PROGRESS": "lines"}
    found = subprocess.run([sys.executable, "-c", FIRST_LINE], env=known, capture_output=True, text=True)
    assert found.stderr.startswith("reconstruct: 0 of 3 stages (compiling, once per installation)")


def test_the_flags_stand_anywhere(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr("evnlos.machine.LINE_S", 1e-6)  # every step is told, however fast it is
    video = tmp_path / "v.npy"
    np.save(video, np.full((3, 4, 6), 100, np.uint8))
    for words, how in ((["--progress", "lines"], "lines"), (["--progress=json"], "json"), (["--json"], "json")):
        main(["events", str(video), "--fps", "10", "--out", str(tmp_path / f"{words[0]}{how}.npz"), *words])
        told = [
            line for line in capsys.readouterr().err.splitlines() if "3 frames" in line or "progress" in line
        ]
        assert told and {"json" if line.startswith('{"progress": ') else "lines" for line in told} == {how}
    main(["events", str(video), "--fps", "10", "--out", str(tmp_path / "q.npz"), "--quiet"])
    assert capsys.readouterr().err == ""
    with pytest.raises(SystemExit):
        main(["--progress", "loud", "doctor"])
    assert "give one of auto, bar, lines, json, none" in capsys.readouterr().err


def test_a_variable_that_is_none_of_them_is_refused(monkeypatch) -> None:
    monkeypatch.setenv("EVNLOS_PROGRESS", "loud")
    with pytest.raises(ConfigError, match="EVNLOS_PROGRESS is 'loud'"):
        ProgressBars()


def test_networks_at_work_are_told_with_their_epochs(tmp_path) -> None:
    from evnlos.experiment.run import Run, epochs_at_work
    from evnlos.training import Training

    runs = [Run(None, Training(epochs=4), tmp_path / name, None) for name in ("done", "half", "new", "later")]
    for name, epochs in (("done", 4), ("half", 2), ("new", 0)):
        (tmp_path / name).mkdir()
        if epochs:
            (tmp_path / name / "metrics.jsonl").write_text('{"epoch": 1}\n' * epochs)
    (tmp_path / "done" / "weights.safetensors").touch()
    part, text = epochs_at_work(runs)
    assert part == 0.5
    assert text == "half epoch 3/4, new epoch 1/4"


def test_invert_tells_its_captures_and_its_solvers(tiny_captures, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr("evnlos.machine.LINE_S", 1e-6)  # every step is told, however fast it is
    words = [
        "invert",
        str(tiny_captures[0]),
        "--setup",
        "main-near",
        "--cells",
        "8",
        "--columns",
        "16",
        "--force",
    ]
    for more, told in (
        (["--positions", "2"], "invert: 0 of 1 motions (light path of the setup"),
        (["--from", "frames"], "invert: 0 of 1"),
    ):
        main([*words, *more, "--progress", "lines", "--out", str(tmp_path / "i.png")])
        assert told in capsys.readouterr().err


def test_the_demo_shows_a_first_reconstruction_with_published_weights(tmp_path, capsys, monkeypatch) -> None:
    began, later = time.process_time(), list[str]()
    monkeypatch.setattr("evnlos.cli.experiment.run_demo", lambda settings: later.append(str(settings.out)))
    words = ["demo", "--out", str(tmp_path / "demo"), "--quiet"]
    main(words)
    assert time.process_time() - began < 60
    shown = capsys.readouterr().out
    assert (tmp_path / "demo" / "first" / "summary.json").is_file() and "lab_S by near-frame-sequence" in shown
    assert [path.name for path in (tmp_path / "demo" / "captures").glob("lab_*")] == ["lab_S"]
    main(words)
    with pytest.raises(SystemExit):
        main(["demo", "--out", str(tmp_path / "wrong"), "--captures", str(tmp_path / "nowhere"), "--quiet"])
    assert capsys.readouterr().out == "" and not (tmp_path / "wrong").exists() and len(later) == 2


def test_evaluate_tells_its_stages(tiny_dataset) -> None:
    network = UNetConfig(width=4, depth=1, rank=0).build("frame", tiny_dataset.sampling)
    steps: list[Step] = []
    evaluate(Weights(network), tiny_dataset, "all", progress=steps.append)
    assert [one.done for one in steps] == [0, 1, 2, 3] and {one.total for one in steps} == {3}
    assert [one.within for one in steps][1:3] == ["scores and baselines", "confidence"]


def test_a_short_video_is_worked_on_after_its_last_frame(tmp_path, monkeypatch, capsys) -> None:
    """All its frames are read before the first of their events: what compiles then is told, not silent."""
    import evnlos.cameras.video as video

    slow = video.EventStream.push
    monkeypatch.setattr(video.EventStream, "push", lambda *given: (time.sleep(0.2), slow(*given)))
    np.save(tmp_path / "clip.npy", np.full((5, 4, 6), 100, np.uint8))
    words = [str(tmp_path / "clip.npy"), "--fps", "30", "--out", str(tmp_path / "e.h5")]
    main(["events", *words, "--progress", "lines"])
    assert "e.h5: 5 frames (their events" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["easy-near", "main-near", "worn"])
def test_a_light_path_counts_what_is_done(name: str, monkeypatch) -> None:
    """It stood there as "light path" for as long as it took."""
    noted = list[str]()
    monkeypatch.setattr("evnlos.optics.radiometric.note", noted.append)
    dense = load_setup(name).operator(Plane(6, 6, 0.013), (25, 90)).dense()
    assert noted[:2] == ["light path, 0 of 2250 pixels", "light path, 2048 of 2250 pixels"]
    for room in ("optics.facets", "optics.radiometric"):
        monkeypatch.setattr(f"evnlos.{room}.noted_rows", lambda pixels: [slice(0, pixels)])
    assert torch.equal(dense, load_setup(name).operator(Plane(6, 6, 0.013), (25, 90)).dense())


def test_a_large_light_path_has_sixteen_parts(monkeypatch) -> None:
    noted = list[str]()
    monkeypatch.setattr("evnlos.optics.radiometric.note", noted.append)
    parts = list(noted_rows(100_000))
    assert [(part.start, part.stop) for part in parts] == [(k * 6250, (k + 1) * 6250) for k in range(16)]
    assert noted == [f"light path, {k * 6250} of 100000 pixels" for k in range(16)]


def test_a_matrix_found_column_by_column_counts_them(monkeypatch) -> None:
    noted = list[str]()
    monkeypatch.setattr("evnlos.optics.operator.note", noted.append)
    dense_matrix(lambda image: 2.0 * image, torch.zeros(20, 20))
    assert noted == ["light path, 0 of 400 cells", "light path, 256 of 400 cells"]
