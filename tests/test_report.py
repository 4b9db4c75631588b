"""The page to mail: setup, films, failures, limits and origin, small and without requests."""

import base64
import html
import io
import re
import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from chromium import Chromium, missing
from evnlos.analysis import AnalysisSettings, Evaluation, identify, score
from evnlos.analysis.confidence import ConfidenceCheck
from evnlos.analysis.identify import GUESSED
from evnlos.cli import main
from evnlos.cli.main import command_of
from evnlos.config import save_yaml
from evnlos.data import Dataset, Samples, Sampling, Simulation, create_dataset, write_shard
from evnlos.demo import Demo, run_demo
from evnlos.plot.setup import PARTITION, setup_drawing
from evnlos.report import RunResult, seen_in_training, write_report
from evnlos.report.pictures import curves_svg
from evnlos.report.provenance import Commands
from evnlos.report.sections import gains_of, lead_section, setup_section, spectrum_points, worst_images
from evnlos.report.tables import named
from evnlos.setups import PaperSetup, RadiometricSetup, lit_setup, load_setup, named_setup, setup_preset

POSITIONS = 12


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two objects, two runs: one adds noise to the truth, the other answers the same to everything."""
    draw = np.random.default_rng(0)
    sampling = Sampling(height=32, width=48, pitch_m=0.005, scored_rows=24)
    names, truths = ["near_G", "near_K"], []
    folder = tmp_path_factory.mktemp("recorded") / "near"
    data = Dataset(folder, "captures", sampling, {"train": [], "validation": [], "test": names})
    create_dataset(data)
    for name in names:
        truth = (draw.random((POSITIONS, 32, 48)) > 0.8).astype(np.float32)
        frame, surface = (
            draw.random((POSITIONS, 32, 48), np.float32),
            draw.random((POSITIONS, 2, 32, 48), np.float32),
        )
        times = np.arange(1.0, POSITIONS + 1)
        samples = Samples(frame, surface, truth, times, np.zeros((POSITIONS, 2)), np.ones(POSITIONS, np.int64))
        write_shard(data.shard(name), samples, {"object": name, "config_hash": ""})
        truths.append(truth[:, sampling.scored])
    truth = torch.from_numpy(np.concatenate(truths))
    of = np.repeat(names, POSITIONS)
    blank = {"zero": score(torch.zeros_like(truth), truth), "mean": score(truth.mean() + 0 * truth, truth)}
    runs = []
    for method, image in (("EPNP", (0.9 * truth)), ("E2E", torch.full_like(truth, 0.9))):
        steps = [{"settings": {"epochs": 2}, "data": {"name": "sim", "origin": "simulation"}}] * (
            method == "EPNP"
        )
        steps += [{"settings": {"epochs": 3}, "data": {"name": "near", "origin": "captures"}}]
        found = Evaluation(image, truth, of, score(image, truth), blank)
        runs.append(RunResult(method.lower(), "frame", False, method, found, [], steps, sampling=sampling))
    return data, runs


def test_the_page_shows_set_up_films_failures_and_origin(made, tmp_path) -> None:
    data, runs = made
    setup = named_setup("main-near")
    limits = identify(setup.setup, AnalysisSettings(cells=8, height=12, width=20, writers=1), "main-near")
    setup = setup._replace(setup=replace(setup.setup, misfit="frames are left"))
    path = write_report(tmp_path / "report.html", data, runs, [], setup=setup, limits=limits)
    page = path.read_text()
    assert "Warning: the calibration of this setup warns: frames are left." in page
    assert path.stat().st_size < 5e6
    assert not re.findall(r"(?:src|href)=['\"](?!data:|#)", page)
    assert not re.findall(r"https?:", page.replace("http://www.w3.org/2000/svg", ""))
    for heading in (
        "Words",
        "The setup",
        "Moving",
        "Position by position",
        "Where it fails",
        "How it was made",
    ):
        assert f"<h2>{heading}</h2>" in page
    assert "What this setup can show at all" in page and html.escape(limits.verdict) in page
    assert "metal of roughness 0.05" in page
    assert page.count("data:image/webp") == 2  # an animation an object
    assert page.count("near_G: ") >= 3  # truth and both runs over positions
    # The run that answers the same fails everywhere, and the page says so.
    assert "E2E frame: 100% of its images are worse than the mean image" in page
    assert "EPNP frame: 0% of its images are worse than the mean image" in page
    worst = runs[1].evaluation.scores.psnr_db.min()
    assert f"{worst:.1f} dB (" in page.split("Where it fails")[1]
    shown = page.split("How it was made")[1]
    assert "evnlos import near_G near_K --out near --test near_G near_K" in shown
    assert "evnlos train --data sim --config epnp-1.yaml --out epnp-1" in shown
    assert "evnlos finetune --data near --weights epnp-1 --config epnp.yaml --out epnp" in shown
    assert "evnlos report epnp e2e --data near --split test --setup main-near --out report.html" in shown
    assert "torch " in shown and "/tmp/" not in page.replace(str(tmp_path), "")


STEPS = [
    {
        "settings": {"epochs": 2},
        "data": {"name": "sim", "origin": "simulation", "config_hash": "ab12", "train": ["w_A"]},
    },
    {"settings": {"epochs": 3}, "data": {"name": "old", "origin": "captures", "train": ["near_1", "near_2"]}},
]


def test_every_command_of_the_page_is_one_that_the_program_takes(made, monkeypatch) -> None:
    """Names of runs, of files and of published weights; each line is parsed, not run."""
    data, (run, _) = made
    file = replace(run, name="mine", history=STEPS)
    come = replace(run, name="near-frame-sequence", history=STEPS, is_published=True)
    live = replace(run, name="live-run", history=[{"data": {"name": "live", "origin": "simulation"}}])
    coarse = replace(data, sampling=Sampling(), config={"pattern": "ab12"})
    here = {"name": "near", "origin": "captures", "train": ["near_A"]}  # other captures under the same name
    other = replace(run, name="of two words", history=[{"data": here}])
    for dataset in (data, coarse, replace(data, origin="simulation")):
        commands = Commands(dataset, [run, file, come, live, other], "test", named_setup("hard-far"))
        lines = commands.again() + commands.published()
        parsed = [_parsed(line, monkeypatch) for line in lines if not line.startswith("#")]
        assert [type(one).__name__ for one in parsed].count("ReportCommand") == 1
    again = "\n".join(Commands(data, [run, file, come, live, other], "test").again())
    assert "evnlos report epnp mine near-frame-sequence live-run 'of two words' --data near --split" in again
    assert "--out near-frame-sequence" not in again and "--out near-frame-sequence" in "\n".join(
        commands.published()
    )
    assert "evnlos import near_1 near_2 --out old --sampling.height 32" in again
    assert "# sim-2.yaml: settings of hash ab12 of 1 simulated objects" in again  # `sim` is another one
    assert "evnlos simulate --config sim-2.yaml --out sim-2" in again and "--data sim-2" in again
    assert "evnlos train --simulate live.yaml" in again and "evnlos import near_A --out near-2" in again
    seen = replace(coarse, split={"train": ["near_A", "near_B"], "validation": [], "test": ["near_G"]})
    lines = Commands(seen, [run], "test").again()
    assert lines[0] == "evnlos calibrate near_A near_B --out calibrated"
    assert "evnlos import near_A near_B near_G --out near --test near_G --pattern calibrated" in lines[1]
    # A pre-training that is a run of the page, too, is listed once, under its own name.
    before = replace(run, name="before", history=STEPS[:1])
    lines = Commands(data, [before, file, replace(file, name="second")], "test").again()
    assert sum(line.startswith("evnlos train") for line in lines) == 1
    for name in ("mine", "second"):
        assert f"evnlos finetune --data old --weights before --config {name}.yaml --out {name}" in lines


def test_report_and_reconstruct_take_a_calibrated_folder_and_say_what_else(tmp_path, capsys) -> None:
    folder = tmp_path / "near_setup"
    folder.mkdir()
    transport = RadiometricSetup(roughness=0.07)
    save_yaml(Simulation(setup=transport), folder / "setup.yaml")
    for given in (folder, folder / "setup.yaml"):
        assert named_setup(given).setup == transport
        assert named_setup(given).word == named_setup(given).name == "near_setup"
        assert lit_setup(given) == transport
    save_yaml(Simulation(), tmp_path / "mine.yaml")
    save_yaml(Simulation(), folder / "dataset.yaml")
    assert named_setup(tmp_path / "mine.yaml").word == "mine.yaml"
    assert named_setup(folder / "dataset.yaml").word == "near_setup/dataset.yaml"
    assert named_setup("main-near").word == "main-near"
    with pytest.raises(SystemExit):
        main(["reconstruct", str(tmp_path), "--setup", "main-near", "--out", str(tmp_path / "out")])
    said = capsys.readouterr().err
    assert "error: --setup main-near states neither the light nor the cameras of a recording; give" in said
    assert "`calibrate` wrote" in said and said.count("\n") == 1
    assert lit_setup("worn") == named_setup("worn").setup and lit_setup(tmp_path / "mine.yaml") == PaperSetup()
    assert not (tmp_path / "out").exists()


def test_the_page_explains_its_words_and_fits_a_phone_and_paper(made, tmp_path) -> None:
    path = write_report(tmp_path / "report.html", *made, [])
    page = path.read_text()
    for word in ("EPNP", "E2E", "fusion", "sequence", "PSNR", "PSNR in the box", "SSIM", "MS-SSIM"):
        assert f">{word}</dt>" in page.split("<h2>Words</h2>")[1]
    links = re.findall(r"href='#([^']+)'", page)
    assert "word-gmsd" in links and len(links) == len(set(links))  # at its first use, and only there
    assert all(page.count(f"id='{one}'") == 1 for one in links)
    tables = dict(re.findall(r"<h2>(?:<a[^>]*>)?(SSIM|GMSD)(?:</a>)?</h2>.*?class=better>([^<]*)<", page))
    assert tables == {"SSIM": "&uarr; higher is better", "GMSD": "&darr; lower is better"}
    if missing():
        pytest.skip(missing())
    (tmp_path / "profile").mkdir()
    wide = "return document.documentElement.scrollWidth"
    shown = (
        "return [...document.querySelectorAll('details pre')].map(one => one.getBoundingClientRect().height)"
    )
    many = [replace(made[1][0], name=f"run-{k}") for k in range(11)]  # three columns and one for each run
    wide_page = write_report(tmp_path / "wide.html", made[0], many, [])
    with Chromium(tmp_path / "profile") as browser:
        browser.open(wide_page.as_uri())
        browser.devtools(
            "Emulation.setDeviceMetricsOverride", width=1280, height=800, deviceScaleFactor=1, mobile=False
        )
        hidden = "const one = document.querySelector('.tiles'); return one.scrollWidth - one.clientWidth"
        assert browser.run(hidden) <= 0
        browser.open(path.as_uri())
        browser.devtools(
            "Emulation.setDeviceMetricsOverride", width=390, height=800, deviceScaleFactor=1, mobile=True
        )
        assert browser.run(wide) <= 390
        closed = "return document.querySelector('details').getBoundingClientRect().height"
        before = browser.run(closed)
        browser.devtools("Emulation.setEmulatedMedia", media="print")
        assert min(browser.run(shown)) > 20 and browser.run(closed) > before + 20


def test_the_plot_of_what_a_setup_shows_ends_where_the_values_do() -> None:
    values = torch.tensor([10.0, 1.0, 0.1, 1e-5, 1e-2, 1e-4, 1e-9])
    points = spectrum_points(values)
    assert [x for x, _ in points] == [1, 2, 3, 4, 5]
    assert [y for _, y in points] == pytest.approx([1, 0, -1, -3, -2], abs=1e-6)
    assert spectrum_points(torch.zeros(4)) == []


@pytest.mark.parametrize("name", ["main-near", "hard-far", "aperture-near"])
@pytest.mark.parametrize("angle", [30.0, -30.0])
def test_the_drawing_sketches_what_hides_the_object_and_nothing_else(name, angle) -> None:
    setup = replace(setup_preset(name), camera_angle_deg=angle)
    drawn = setup_drawing(setup, travel_m=0.16, target_size_m=0.08).svg
    assert drawn.count(PARTITION) == 1 and (">occluder</text>" in drawn) == (name == "aperture-near")
    lines = [
        [tuple(float(v) for v in one.split(",")) for one in points.split()]
        for points in re.findall(r"polyline points='([^']*)'", drawn)
    ]
    (hides,) = re.findall(r"polyline points='([^']*)'[^>]*partition", drawn)
    hides = [tuple(float(v) for v in one.split(",")) for one in hides.split()]
    way, sights = lines[0], lines[2:4]
    eye = sights[0][0]
    ends = [one[1] for one in sights]
    assert all(_cross(hides, (eye, end)) for end in way)  # neither end of the way is seen
    assert not any(_cross(hides, (eye, end)) for end in ends)  # the wall is
    assert not any(_cross(hides, (one, end)) for one in way for end in ends)  # and is lit


def test_without_a_camera_nothing_is_sketched() -> None:
    assert PARTITION not in setup_drawing(PaperSetup()).svg
    assert "is not drawn" in setup_section("paper", PaperSetup())


def _cross(one, other) -> bool:
    """Return whether two segments of (x, y) ends cross."""

    def side(a, b, c) -> float:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    return side(*one, other[0]) * side(*one, other[1]) < 0 and side(*other, one[0]) * side(*other, one[1]) < 0


def _parsed(line: str, monkeypatch: pytest.MonkeyPatch):
    """Return the command that a line is read as, without running it; settings are those of the default."""
    program, verb, *rest = shlex.split(line)
    parsed = []
    monkeypatch.setattr(command_of(verb), "run", lambda command: parsed.append(command))
    monkeypatch.setattr("evnlos.config.load_yaml", lambda kind, _: kind())
    main([verb, *rest])
    assert program == "evnlos" and len(parsed) == 1 and not any(word in ("", ".") for word in rest)
    return parsed[0]


def test_the_page_of_the_demo_says_what_renders_its_captures_again(tmp_path, monkeypatch) -> None:
    """Its work is left out: what matters are the notes that the page gets."""
    notes, folder = list[str](), tmp_path / "lab_A"
    folder.mkdir()
    (folder / "capture.yaml").write_text("camera: {width: 8, height: 4}\n")
    for name, made in {
        "data.lab.render_captures": [folder],
        "experiment.run_study": None,
        "experiment.read_records": [],
        "experiment.gain_table": "",
        "report.collect_results": (None, []),
        "report.to_text": "",
    }.items():
        monkeypatch.setattr(f"evnlos.{name}", lambda *_, made=made, **__: made)
    monkeypatch.setattr("evnlos.report.write_report", lambda *given, **_: notes.extend(given[3]))
    demo = Demo(tmp_path / "demo", test=("A",), calibrate=False, seed=7)
    run_demo(demo)
    (command,) = [one.partition("again by: ")[2] for one in notes if "evnlos lab" in one]
    assert _parsed(command, monkeypatch).settings == demo.lab


def test_weights_are_called_by_run_file_or_published_name(tmp_path, monkeypatch) -> None:
    run = tmp_path / "runs" / "epnp"
    run.mkdir(parents=True)
    (run / "weights.safetensors").touch()
    (tmp_path / "mine.safetensors").touch()
    monkeypatch.chdir(run)
    assert named(Path("near-frame-sequence")) == ("near-frame-sequence", True)
    assert named(run) == named(Path()) == named(Path("weights.safetensors")) == ("epnp", False)
    assert named(tmp_path / "mine.safetensors") == ("mine", False)
    (run / "near-frame-sequence").mkdir()
    assert named(Path("near-frame-sequence")) == (
        "near-frame-sequence",
        False,
    )  # a folder of that name comes first


def test_weights_without_a_log_leave_no_empty_section(made, tmp_path) -> None:
    data, runs = made
    shown = write_report(tmp_path / "a.html", data, runs, []).read_text().split("<h2>Training</h2>")[1]
    assert shown.startswith("<p class=dim>No curve, for") and "epnp, e2e." in shown.split("</p>")[0]
    logged = replace(runs[0], log=[{"epoch": 1, "loss": 0.5}, {"epoch": 2, "loss": 0.25}])
    shown = write_report(tmp_path / "b.html", data, [logged], []).read_text().split("<h2>Training</h2>")[1]
    assert shown.startswith("<svg") and "No curve" not in shown


def test_the_page_says_how_far_to_believe_each_run(made, tmp_path) -> None:
    data, runs = made
    assert "How far to believe" not in write_report(tmp_path / "plain.html", data, runs, []).read_text()
    said = [ConfidenceCheck("near_G", 0.62, 0.7, 0.62, True, 0.81, 0.93, 0.2), _unmeasured("near_K")]
    on_sequences = replace(
        runs[0], sees_sequence=True, evaluation=replace(runs[0].evaluation, confidence_checks=said)
    )
    page = write_report(tmp_path / "report.html", data, [*runs, on_sequences], []).read_text()
    shown = page.split("How far to believe them")[1].split("</table>")[0]
    assert "EPNP sequence frame" in shown and "E2E frame" not in shown
    assert "<td>G</td><td>62%</td><td>81%</td>" in shown
    assert "<td>K</td><td>nothing measured</td><td>-30%</td>" in shown
    assert "96%" in shown and "0.60" in shown  # means of coverage and length
    # A run on sequences is compared with runs on sequences alone.
    assert ">EPNP sequence frame</text>" in page and list(gains_of([*runs, on_sequences])) == ["frame"]


def _unmeasured(name: str) -> ConfidenceCheck:
    return ConfidenceCheck(name, 0.0, 0.01, None, False, -0.3, 0.99, 1.0)


def test_the_page_leads_with_three_objects_and_the_verdict(made, tmp_path) -> None:
    """The best, the median and the worst object, truth beside image, and one verdict; tables are folded."""
    data, runs = made
    limits = identify(load_setup("main-near"), AnalysisSettings(cells=8, height=12, width=20, writers=1))
    page = html.unescape(write_report(tmp_path / "report.html", data, runs, [], limits=limits).read_text())
    lead = page.split("</h1>")[1].split("<p class=dim>evnlos ")[0]
    assert re.findall(r"<figcaption>(\w+): (\w), ", lead) == [("best", "G"), ("worst", "K")]
    assert f"{limits.wall[1:]}.</b>" in lead and GUESSED[None][1:] in lead
    # Of three objects there is a median; truth is on the left.
    first = runs[0].evaluation
    k = np.arange(3 * POSITIONS) % len(first.truth)
    levels = torch.tensor([0.5, 0.9, 0.7]).repeat_interleave(POSITIONS)[:, None, None]
    image, truth, names = (
        levels * first.truth[k],
        first.truth[k],
        np.repeat(["near_1", "near_2", "near_3"], POSITIONS),
    )
    said = [ConfidenceCheck("near_1", 0.6, 0.7, 0.6, True, 0.8, 0.9, 0.2)] * 2 + [_unmeasured("near_3")]
    run = replace(runs[0], evaluation=Evaluation(image, truth, names, score(image, truth), {}))
    for checks, words in ((said, (GUESSED[True], GUESSED[False])), (said[:2], (GUESSED[True],))):
        one = replace(run, evaluation=replace(run.evaluation, confidence_checks=checks))
        lead = html.unescape(lead_section([one], None))
        assert re.findall(r"(\w+): (\w), [\d.]+ dB</figcaption>", lead) == [
            ("best", "2"),
            ("median", "3"),
            ("worst", "1"),
        ]
        assert f"f 2 of {len(checks)} sequences something was measured" in lead
        assert [one for one in GUESSED.values() if one[1:] in lead] == list(words)
    shown = re.search(r"src='data:image/png;base64,([^']+)'", lead)[1]
    pair = np.asarray(Image.open(io.BytesIO(base64.b64decode(shown))).convert("L"))
    assert pair[:, :48].max() == 255 and pair[:, -48:].max() in (229, 230)
    # What is folded is closed, and all tables are but that of PSNR.
    open_page = re.sub(r"<details>.*?</details>", "", page, flags=re.DOTALL)
    assert "<details open" not in page and open_page.count("<table") == 1 < page.count("<table")
    assert "class=strips" in page and "class=strips" not in open_page
    assert "<table" in open_page.split("<h2>PSNR, dB</h2>")[1].split("<h2>")[0]


def test_the_worst_images_are_of_several_objects() -> None:
    gain = np.array([-5.0, -4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0])
    names = np.array(["a", "a", "a", "b", "b", "b", "c", "c"])
    assert worst_images(gain, names) == [0, 1, 3, 4, 6, 7]
    assert worst_images(gain, np.full(8, "a")) == list(range(6))  # one object: all are of it
    assert worst_images(gain[:2], names[:2]) == [0, 1]


def test_without_a_setup_the_page_says_how_to_name_it(made, tmp_path) -> None:
    page = write_report(tmp_path / "report.html", *made, []).read_text()
    assert "evnlos report --setup SETUP.yaml" in page and "What this setup can show" not in page


def test_the_drawing_of_a_setup_is_to_scale() -> None:
    from xml.dom.minidom import parseString

    for setup in (RadiometricSetup(distance_m=0.3), PaperSetup(distance_m=0.5)):
        drawing = parseString(setup_drawing(setup, travel_m=0.16, target_size_m=0.08).svg)
        lines = [one.getAttribute("points") for one in drawing.getElementsByTagName("polyline")]
        way, target = (np.array([[float(v) for v in p.split(",")] for p in line.split()]) for line in lines[:2])
        wall = np.array([[float(v) for v in p.split(",")] for p in lines[-1].split()])
        length = float(np.ptp(target[:, 0]))
        assert np.ptp(way[:, 0]) == pytest.approx(3 * length, abs=0.3)  # 24 cm beside 8 cm
        assert target[0, 1] - wall[0, 1] == pytest.approx(length * setup.distance_m / 0.08, rel=0.01)


@pytest.mark.parametrize("value", [0.0, 18.5, -3e9])
def test_a_run_of_one_epoch_has_a_curve(value: float) -> None:
    drawing = curves_svg({"run": [(1.0, value)]}, "epoch", "dB")
    assert "nan" not in drawing and drawing.count("<polyline") == 1


def test_layers_that_name_no_objects_have_seen_none() -> None:
    data: Any = SimpleNamespace(origin="simulated", objects=lambda _: ("a", "b"))
    history = [{"data": {"origin": "simulated"}}, {"data": {"origin": "simulated", "train": ["b", "c"]}}]
    assert seen_in_training(history[:1], data, "test") == []
    assert seen_in_training(history, data, "test") == ["b"]
