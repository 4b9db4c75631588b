"""What a mismatch costs: rows from a demo's records and calibration, margins, and setups that are refused."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from evnlos.calibration import CALIBRATION_VALUES_FILE
from evnlos.demo import ROBUST, Demo, run_demo
from evnlos.errors import CalibrationError, ConfigError, DataError
from evnlos.experiment import Record, Study, write_record
from evnlos.models import layers_of
from evnlos.studies import finding, lead_figure, leads_of, mismatch_table, run_mismatch

CAPTURE = "camera: {name: a camera, width: 40, height: 25}\n"
LEFT = {
    "frames fit": {"before": 0.5, "after": 0.04, "noise": 0.03},
    "frames held out": {"before": 0.5, "after": 0.09, "noise": 0.03},
    "frames held out, without pattern": {"before": 0.5, "after": 0.07, "noise": 0.035},
    "surfaces fit": {"before": 0.9, "after": 0.3, "noise": 0.3},
    "surfaces held out": {"before": 0.9, "after": 0.97, "noise": 0.36},
}


def keep(out: Path, seed: int, scores: dict[tuple[str, str], float], warnings: list[str]) -> None:
    """Write a demo's folder as it would be with such scores."""
    for (arm, modality), value in scores.items():
        mean = {"mean": {"psnr_db": {"x_G": 13.0, "x_K": 14.0}}}
        means = {"psnr_db": {"x_G": value - 1, "x_K": value + 1}}
        positions = {"x_G": [value - 1, value - 1], "x_K": [value + 1, value + 1]}
        record = Record("demo", "demo", arm, modality, seed, "test", means, positions, mean, {}, {})
        write_record(record, out / "records" / "demo")
    setup = out / "setups" / "demo"
    setup.mkdir(parents=True, exist_ok=True)
    (setup / CALIBRATION_VALUES_FILE).write_text(
        json.dumps({"residuals": LEFT, "warnings": warnings, "expectation": "ahead"})
    )


def test_a_row_holds_residuals_the_strongest_e2e_and_the_lead_of_epnp(tmp_path):
    scores = {
        ("E2E", "frame"): 20.0,
        ("E2E augmented", "frame"): 20.5,
        ("simulation only", "frame"): 18.0,
        ("EPNP", "frame"): 22.0,
    }
    keep(tmp_path / "a-seed0", 0, scores, ["the wall may be of another kind"])
    keep(tmp_path / "a-seed1", 1, {key: value + 1 for key, value in scores.items()}, [])
    found = finding("a", [tmp_path / "a-seed0", tmp_path / "a-seed1"])
    assert found.best_e2e("frame") == pytest.approx(21.0)
    assert found.of("EPNP", "frame") == pytest.approx(22.5)
    assert math.isnan(found.of("EPNP", "event")) and math.isnan(found.best_e2e("event"))
    assert found.left == {"frames": (0.07, 0.035), "surfaces": (0.97, 0.36)}
    text = mismatch_table([found])
    assert "| a | frame | 7.0 / 3.5 | 13.50 | 21.00 | 18.50 | 22.50 | +1.50 [+0.50, +2.50] |" in text
    assert "EPNP - E2E +1.50 dB in the mean, +1.50 at least (a); simulation only - mean image +5.00" in text
    assert "warned of the wall may be of another kind" in text


def test_the_least_lead_is_named(tmp_path):
    for name, lead in (("one", 2.0), ("two", -0.5)):
        scores = {("E2E", "event"): 16.0, ("simulation only", "event"): 15.0, ("EPNP", "event"): 16.0 + lead}
        keep(tmp_path / name, 0, scores, [])
    text = mismatch_table([finding(name, [tmp_path / name]) for name in ("one", "two")])
    assert "EPNP - E2E +0.75 dB in the mean, -0.50 at least (two)" in text
    assert "| two | event | 97.0 / 36.0 |" in text
    assert "- two: the calibration warned of nothing; it expected: ahead." in text


def test_the_leads_are_drawn_as_the_table_has_them(tmp_path):
    scores = {("E2E", "frame"): 20.0, ("simulation only", "frame"): 18.0, ("EPNP", "frame"): 22.0}
    keep(tmp_path / "one", 0, scores, [])
    keep(tmp_path / "two", 0, scores | {("E2E", "event"): 16.0, ("EPNP", "event"): 15.5}, [])
    keep(tmp_path / "no", 0, {("EPNP", "frame"): 22.0}, [])
    leads = leads_of([finding(name, [tmp_path / name]) for name in ("one", "two", "no")])
    assert set(leads) == {("one", "frame"), ("two", "frame"), ("two", "event")}
    assert leads["one", "frame"] == pytest.approx((20.0, 18.0, 22.0, 2.0, 2.0, 2.0))
    pytest.importorskip("matplotlib")
    left, right = lead_figure(leads).axes
    assert [label.get_text() for label in left.get_yticklabels()] == ["one", "two"]
    drawn = sorted(float(line.get_xdata()[0]) for line in right.lines if line.get_marker() == "o")
    assert drawn == pytest.approx([-0.5, 2.0, 2.0])
    alone = lead_figure({("one", "event"): leads["one", "frame"]}).axes[0].get_legend()  # no frames
    assert [text.get_text() for text in alone.get_texts()] == ["E2E", "simulation only", "EPNP"]
    with pytest.raises(DataError, match="no setup has both"):
        lead_figure({})


def test_each_setup_is_run_and_a_refusal_is_a_row(tmp_path, monkeypatch):
    for setup in ("flat", "odd"):
        for name in "AG":
            (tmp_path / "captures" / setup / f"{setup}_{name}").mkdir(parents=True)
            (tmp_path / "captures" / setup / f"{setup}_{name}" / "capture.yaml").write_text("x: 1")
    ran = []

    def demo(settings: Demo) -> None:
        ran.append((settings.out.name, [folder.name for folder in settings.captures], settings.seed))
        if settings.out.name.startswith("odd"):
            raise CalibrationError("no setup fits")
        keep(settings.out, settings.seed, {("E2E", "frame"): 1.0, ("EPNP", "frame"): 2.0}, [])

    monkeypatch.setattr("evnlos.studies.run_demo", demo)
    found = run_mismatch(Demo(out=tmp_path / "out"), (), tmp_path / "captures", seeds=(0, 3))
    assert ran == [
        ("flat-seed0", ["flat_A", "flat_G"], 0),
        ("flat-seed3", ["flat_A", "flat_G"], 3),
        ("odd-seed0", ["odd_A", "odd_G"], 0),
        ("odd-seed3", ["odd_A", "odd_G"], 3),
    ]
    assert [one.setup for one in found] == ["flat", "odd"] and found[1].refused == "no setup fits"
    written = (tmp_path / "out" / "mismatch.md").read_text()
    assert "| odd | refused: no setup fits |" in written and "| flat | frame |" in written


def test_robust_networks_stand_beside_the_others(tmp_path, monkeypatch):
    (tmp_path / "captures" / "flat" / "flat_A").mkdir(parents=True)
    (tmp_path / "captures" / "flat" / "flat_A" / "capture.yaml").write_text("x: 1")

    def demo(settings: Demo) -> None:
        drawn, gained = (ROBUST, 0.5) if settings.robust else ("", 0.0)
        scores = {(f"simulation only{drawn}", "frame"): 18 + gained, (f"EPNP{drawn}", "frame"): 22 + gained}
        keep(settings.out, settings.seed, {("E2E", "frame"): 20.0, **scores}, [])

    monkeypatch.setattr("evnlos.studies.run_demo", demo)
    found = run_mismatch(Demo(out=tmp_path / "out", robust=True), (), tmp_path / "captures")
    table = mismatch_table(found)
    assert "| EPNP - E2E | simulation only, robust | EPNP, robust |" in table
    assert "| 20.00 | 18.00 | 22.00 | +2.00 [+2.00, +2.00] | 18.50 | 22.50 |" in table


@pytest.mark.parametrize("start", ["generic", "nowhere", ""])
def test_the_pre_training_begins_with_layers_where_they_are_installed(tmp_path, monkeypatch, start):
    monkeypatch.setenv("EVNLOS_WEIGHTS", str(tmp_path))
    for name in layers_of("generic"):
        (tmp_path / f"{name}.safetensors").touch()
    (tmp_path / "a_A").mkdir()
    (tmp_path / "a_A" / "capture.yaml").write_text(CAPTURE)
    studies = []

    def stop(study: Study, *_) -> None:
        studies.append(study)
        raise CalibrationError("enough")

    monkeypatch.setattr("evnlos.experiment.run_study", stop)
    with pytest.raises(CalibrationError, match="enough"):
        run_demo(Demo(out=tmp_path / "out", captures=(tmp_path / "a_A",), start=start))
    begins = {arm.name: arm.start for arm in studies[0].arms}
    found = "generic" if start == "generic" else ""
    assert begins == {"simulation only": found, "EPNP": found, "E2E": "", "E2E, single positions": ""}
    plans = {arm.pretraining for arm in studies[0].arms if arm.pretraining}
    assert {(plan.refit_embedding, plan.epochs) for plan in plans} == {(bool(found), 4 if found else 8)}


def test_the_demo_trains_what_was_asked_for(tmp_path, monkeypatch):
    (tmp_path / "a_A").mkdir()
    (tmp_path / "a_A" / "capture.yaml").write_text(CAPTURE)

    def stop(study: Study, *_) -> None:
        raise CalibrationError(" ".join(study.modalities))

    monkeypatch.setattr("evnlos.experiment.run_study", stop)
    with pytest.raises(CalibrationError, match=r"^event;"):
        run_demo(Demo(out=tmp_path / "out", captures=(tmp_path / "a_A",), modalities=("event",)))
    with pytest.raises(ConfigError, match="modalities names none"):
        Demo(modalities=())


def one_lacks(folder: Path, what: str) -> Path:
    """Write two captures, one of them without events or frames."""
    for name, also in (("a_A", ""), ("a_B", f"{what}: null\n")):
        (folder / name).mkdir()
        (folder / name / "capture.yaml").write_text(also + CAPTURE)
    return folder


def test_the_demo_sees_frames_where_captures_have_no_events(tmp_path, monkeypatch):
    studies = []

    def stop(study: Study, *_) -> None:
        studies.append(study)
        raise CalibrationError("enough")

    monkeypatch.setattr("evnlos.experiment.run_study", stop)
    demo = Demo(out=tmp_path / "out", captures=(one_lacks(tmp_path, "events"),))
    with pytest.raises(CalibrationError, match="enough"):
        run_demo(demo)
    (study,) = studies
    assert study.modalities == ("frame",) and not study.calibration.events
    with pytest.raises(DataError, match="a_B holds frames alone, no events; give --modalities frame"):
        run_demo(replace(demo, modalities=("event",)))


def test_the_demo_refuses_captures_without_frames(tmp_path):
    with pytest.raises(DataError, match="a_B holds events alone"):
        run_demo(Demo(out=tmp_path / "out", captures=(one_lacks(tmp_path, "frames"),), modalities=("event",)))


def test_unknown_setups_and_empty_folders_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="setup 'flat' is unknown; give some of two-lobes"):
        run_mismatch(Demo(out=tmp_path), ("flat",))
    with pytest.raises(ConfigError, match="holds no folders of captures"):
        run_mismatch(Demo(out=tmp_path), (), tmp_path)
