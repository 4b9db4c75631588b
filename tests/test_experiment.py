"""Experiments: resumable, honest about what was held out, and put into tables that say what the records say."""

import importlib
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from evnlos.cli import main
from evnlos.config import load_yaml, save_yaml
from evnlos.data import (
    Dataset,
    FixedPattern,
    NlosDataset,
    Sampling,
    SensorSize,
    Simulation,
    character_of,
    open_dataset,
    read_shard,
    save_pattern,
    write_shard,
)
from evnlos.data.simulate import split_of
from evnlos.errors import CalibrationError, ConfigError, DataError
from evnlos.experiment import (
    STUDIES,
    Arm,
    Place,
    Record,
    Study,
    captures_of,
    character_table,
    checks_table,
    difference,
    folds_of,
    gain_table,
    merge_folds,
    on_sequences,
    read_records,
    retrieved,
    run_studies,
    run_study,
    summary_table,
    write_record,
)
from evnlos.inverse import EVENT_ERRORS, EVENT_ERRORS_FILE, AboutErrors
from evnlos.models import (
    DrawnTargets,
    FrameOperator,
    SequenceConfig,
    UNetConfig,
    drawn_targets,
    layers_of,
    load_weights,
)
from evnlos.plot.figures import draw_scores
from evnlos.scene import FontGlyphs, HandwritingGlyphs
from evnlos.setups import RadiometricSetup, load_setup
from evnlos.training import Training, best_shown
from evnlos.types import Plane, derive_seed
from watching import Watch

SAMPLING = Sampling(height=32, width=48, pitch_m=0.005, scored_rows=24)
SMALL = Training(epochs=1, network=UNetConfig(width=4, depth=1, rank=8))
ARMS = (
    Arm("E2E", "none", None, SMALL, sampling=SAMPLING),
    Arm("simulation only", "calibrated", SMALL, None, sampling=SAMPLING),
    Arm("EPNP", "calibrated", SMALL, SMALL, sampling=SAMPLING),
)
STUDY = Study("captures", "lab", ARMS, ("fusion",), (0, 1), ("4",), writers=1)


@pytest.fixture(scope="module")
def place(tiny_captures, tmp_path_factory) -> Place:
    """A place whose setup is calibrated already, with few objects to simulate."""
    out = tmp_path_factory.mktemp("experiment")
    setup = out / "setups" / "lab"
    setup.mkdir(parents=True)
    simulation = Simulation(
        glyphs=HandwritingGlyphs(characters="AB"),
        setup=RadiometricSetup(cell_m=0.01, gain=0.7, ambient=0.06, sensor=SensorSize(48, 72)),
        positions=8,
        validation=0.0,
    )
    save_yaml(simulation, setup / "setup.yaml")
    save_yaml(simulation, setup / "training.yaml")
    flat = FixedPattern(np.ones((48, 72), np.float32), np.zeros((48, 72), np.float32))
    save_pattern(flat, setup / "pattern.safetensors")
    return Place(tuple(tiny_captures), out, workers=1)


@pytest.fixture
def apart(place, tmp_path) -> Place:
    """A copy of the place as it is, for a test whose runs no other test shall see."""
    return replace(place, out=Path(shutil.copytree(place.out, tmp_path / "apart")))


@pytest.fixture(scope="module")
def records(place) -> list[Record]:
    return run_study(STUDY, place)


def test_every_arm_seed_and_refinement_has_its_record(records, place) -> None:
    found = {(r.arm, r.seed) for r in records}
    single = {(arm, seed) for arm in ("E2E", "simulation only", "EPNP") for seed in (0, 1, -1)}
    refined = {(f"{arm} + consistency", seed) for arm in ("simulation only", "EPNP") for seed in (0, 1, -1)}
    blind = {("linear, captures", 0), ("linear, simulation", 0)}
    assert found == single | refined | blind
    assert {r.name for r in read_records(place.out / "records" / "captures")} == {r.name for r in records}
    for record in records:
        assert set(record.scores["psnr_db"]) == {"lab_4"} == set(record.positions)
        assert record.scores["psnr_db"]["lab_4"] == pytest.approx(np.mean(record.positions["lab_4"]), abs=1e-3)
        assert {"zero", "mean", "placed", "nearest"} <= set(record.baselines)
        by = {name: np.mean(list(table["psnr_db"].values())) for name, table in record.baselines.items()}
        assert by["placed"] > by["mean"]  # the motion is known


def test_the_command_prints_tables_and_draws_them(records, apart, monkeypatch, capsys) -> None:
    asked = list[Study]()
    monkeypatch.setattr("evnlos.experiment.run_studies", lambda studies, *_: asked.extend(studies))
    root, out = str(apart.captures[0].parent), str(apart.out)
    options = ["--captures", root, "--captures-of", "lab", "--out", out, "--test", "4"]
    main(["experiment", "captures", *options, "--modalities", "fusion"])
    assert [(study.setup, study.test, study.modalities) for study in asked] == [("lab", ("4",), ("fusion",))]
    said = capsys.readouterr().out
    assert "| sees | strongest E2E |" in said and "best linear estimate, lab" in said
    assert (apart.out / "captures-lab-test.md").read_text() == said.removesuffix("\n")
    with Image.open(apart.out / "captures-lab-test.png") as drawn:
        assert min(drawn.size) > 200
    with pytest.raises(DataError, match="no record of a network"):
        draw_scores([record for record in records if record.seed < 0], "psnr_db", apart.out / "none.png")


def test_a_second_run_does_nothing_again(records, place) -> None:
    before = {path: path.stat().st_mtime_ns for path in place.out.rglob("*") if path.is_file()}
    assert run_study(STUDY, place) == []
    after = {path: path.stat().st_mtime_ns for path in place.out.rglob("*") if path.is_file()}
    assert after == before


def test_single_positions_are_scored_averaged_where_asked(records, apart) -> None:
    study = replace(STUDY, arms=ARMS[:1], seeds=(0,), average=True)
    (new,) = run_study(study, apart)
    (single,) = [one for one in records if (one.arm, one.seed) == ("E2E", 0)]
    assert new.arm == "E2E, averaged" and new.settings["run"] == single.settings["run"]
    assert new.scores["psnr_db"]["lab_4"] != single.scores["psnr_db"]["lab_4"]
    assert run_study(study, apart) == []


def test_the_drawn_target_that_explains_a_sequence_best_is_a_baseline(apart) -> None:
    """Frames of two simulated glyphs under another light: the search finds each of them."""
    study = replace(STUDY, name="search", arms=ARMS[1:2], modalities=("frame",), seeds=(0,), retrieval=True)
    found = {record.arm: record for record in run_study(study, apart)}
    assert set(found) == {"simulation only", "simulation only + consistency", "retrieval"}
    assert found["retrieval"].settings["simulation"] and run_study(study, apart) == []
    made = open_dataset(next((apart.out / "simulations").iterdir()))
    operator = FrameOperator(load_setup(apart.out / "setups" / "lab"), SAMPLING)
    (dimmer := apart.out / "dimmer").mkdir()
    names = made.objects()
    for name in names:
        samples, attributes = read_shard(made.shard(name))
        frame = 0.4 * (samples.frame - samples.frame.mean(axis=0)) + np.linspace(0, 0.3, 48, dtype=np.float32)
        write_shard(dimmer / f"{name}.h5", replace(samples, frame=frame), attributes)
    seen = Dataset(dimmer, "captures", SAMPLING, {"test": names})
    config = load_yaml(Simulation, apart.out / "setups" / "lab" / "training.yaml")
    fine = Plane(64, 64, 0.08 / 64)
    masks = [config.glyphs.target(name, derive_seed(config.seed, "glyph")).rasterise(fine) for name in names]
    about = drawn_targets(apart.out / "setups" / "lab").about
    targets = DrawnTargets(about, torch.from_numpy(np.stack(masks)))
    truth = NlosDataset(made, "all", "frame").truth.float()
    # 30 dB and not more: the truth itself is among the targets, and is bent a little towards the noise
    assert (retrieved(targets, seen, "test", operator) - truth).square().mean() < 1e-3


def test_other_networks_under_the_name_of_a_record_are_scored_anew(records, apart) -> None:
    """After a change of the settings the folder still holds the records of before."""
    arm = replace(ARMS[0], finetuning=replace(SMALL, epochs=2))
    study = replace(STUDY, arms=(arm,), seeds=(0,), refine=False)
    (new,) = [one for one in run_study(study, apart) if one.arm == arm.name]
    (old,) = [one for one in records if one.name == new.name]
    (now,) = [one for one in read_records(apart.out / "records") if one.name == new.name]
    assert now.settings["run"] == new.settings["run"] != old.settings["run"]
    assert run_study(study, apart) == []


def test_a_study_is_estimated_first_and_can_be_forced(records, place, monkeypatch) -> None:
    def refuse(*_: object) -> None:
        raise DataError("needs 9 GB of memory")

    monkeypatch.setattr(sys.modules["evnlos.data.simulate"], "check_memory", refuse)
    with pytest.raises(DataError, match="GB of memory"):
        run_study(STUDY, place)
    assert run_study(STUDY, replace(place, force=True)) == []


def test_an_augmented_arm_learns_from_more_and_is_scored_on_the_same(records, apart) -> None:
    arm = replace(ARMS[0], name="E2E augmented", augment=True)
    study = replace(STUDY, name="more", arms=(arm,), modalities=("frame",), seeds=(0,))
    (new,) = run_study(study, apart)
    learned = open_dataset(apart.out / "recorded" / new.settings["captures"])
    plain = open_dataset(
        next(path for path in (apart.out / "recorded").iterdir() if "augmented" not in path.name)
    )
    assert set(learned.objects("train")) > set(plain.objects("train"))
    assert learned.objects("test") == plain.objects("test") == list(new.scores["psnr_db"])
    assert (
        load_weights(apart.out / "runs" / new.settings["run"]).history[-1]["data"]["name"]
        == learned.folder.name
    )
    assert run_study(study, apart) == []
    with pytest.raises(ConfigError, match="only an end-to-end training is augmented"):
        replace(ARMS[2], augment=True)


def test_networks_trained_at_a_time_are_those_trained_one_by_one(records, place, tmp_path) -> None:
    for part in ("setups", "simulations", "recorded"):
        shutil.copytree(place.out / part, tmp_path / part)
    study = replace(STUDY, seeds=(0,))
    watch = Watch()
    found = run_study(study, replace(place, out=tmp_path, trainings=2), watch)
    # Pre-training and E2E, then fine-tuning; the pre-training once for two arms.
    together = [step.done for step in watch.steps if step.what == "train networks"]
    assert together == [0, 1, 2, 3]
    alone = {(r.arm, r.seed): r for r in records}
    assert {r.arm for r in found} == {arm for arm, _ in alone}
    for record in found:
        one = alone[record.arm, record.seed]
        assert record.settings.get("run") == one.settings.get("run")
        assert record.positions["lab_4"] == pytest.approx(one.positions["lab_4"], abs=0.02)


def test_fewer_than_no_processes_are_refused(tmp_path) -> None:
    for name in ("workers", "trainings"):
        with pytest.raises(ConfigError, match=f"{name} is -1"):
            Place((), tmp_path, **{name: -1})


def test_arms_share_what_they_have_in_common(records, place) -> None:
    names = [path.name for path in (place.out / "runs").iterdir()]
    assert len([name for name in names if "pretrained" in name]) == 2  # one a seed, for two arms
    assert len(list((place.out / "simulations").iterdir())) == 1
    assert len(list((place.out / "recorded").iterdir())) == 1


def test_arms_begin_with_installed_layers(records, apart, tmp_path, monkeypatch) -> None:
    trained = next(path for path in (apart.out / "runs").iterdir() if "pretrained" in path.name)
    monkeypatch.setenv("EVNLOS_WEIGHTS", str(tmp_path))
    (name,) = layers_of("any", "fusion")
    before = replace(SMALL, refit_embedding=True)
    arms = (Arm("from layers", "calibrated", before, SMALL, "any", sampling=SAMPLING),)
    study = replace(STUDY, name="layers", arms=arms, seeds=(0,))
    with pytest.raises(DataError, match=name):
        run_study(study, apart)
    shutil.copy(trained / "weights.safetensors", tmp_path / f"{name}.safetensors")
    (record,) = [r for r in run_study(study, apart) if r.arm == "from layers" and r.seed == 0]
    assert [len(load_weights(apart.out / "runs" / record.settings["run"]).history)] == [3]


def test_a_study_begins_with_layers_where_its_networks_are_like_them() -> None:
    study = replace(STUDIES["sequence"]("near"), modalities=("frame",))
    begun = {arm.name: arm for arm in study.begun_with("generic").arms}
    for before in study.arms:
        arm = begun[before.name]
        if before.pretraining is None or before.name in study.asked_for:  # end to end, or of another kind
            assert arm == before
        else:
            assert arm.start == "generic" and arm.first_training("frame").refit_embedding
            assert arm.first_training("frame").network.width == 32 != before.pretraining.network.width
            assert arm.anew == before.pretraining and arm.finetuning == before.finetuning
    with pytest.raises(ConfigError, match="no network of captures"):
        STUDIES["captures"]("near").begun_with("generic")
    with pytest.raises(DataError, match="nothing-frame-sequence"):
        study.begun_with("nothing")


def test_a_fine_tuning_learns_from_the_events_that_its_start_draws_best(apart) -> None:
    """Errors that captures are said to share are taken from their events, or not: the network tells."""
    setup, shown = apart.out / "setups" / "lab", replace(SAMPLING, surface="likelihood")
    names, draw = tuple(f"other_{k}" for k in range(5)), torch.Generator().manual_seed(0)
    errors = {
        "errors": 1e4 * (1 + torch.rand(5, 240, generator=draw)),  # far from any that the sensor has
        "roots": torch.eye(240).repeat(5, 1, 1),
        "light": torch.full((5,), 0.1),
    }
    EVENT_ERRORS.write(setup / EVENT_ERRORS_FILE, errors, AboutErrors(names, 1.0))
    pre = replace(SMALL, network=SequenceConfig(width=4, depth=1, rank=8, ridge_multipliers=(1.0,)))
    arms = tuple(replace(arm, pretraining=pre, sampling=shown) for arm in ARMS[1:])
    study = replace(STUDY, name="events", arms=arms, modalities=("event",), seeds=(0,))
    found = {record.arm: record for record in run_study(study, apart)}
    made = [open_dataset(path) for path in (apart.out / "recorded").iterdir()]
    recorded = {one.sampling.surface: one for one in made if one.sampling.is_solved}
    wrong, right = recorded.pop("likelihood"), recorded.pop("corrected")
    start = apart.out / "runs" / found["simulation only"].settings["run"]
    assert best_shown((wrong, right), start) is best_shown((right, wrong), start) is wrong
    for record in found.values():
        assert record.settings["captures"] == wrong.folder.name
        assert load_weights(apart.out / "runs" / record.settings["run"]).sampling.surface == "likelihood"
    for name in wrong.objects():  # as if the errors were those of the sensor
        shards = wrong.shard(name), right.shard(name)
        contents = [shard.read_bytes() for shard in shards]
        for shard, content in zip(shards, reversed(contents), strict=True):
            shard.write_bytes(content)
    assert best_shown((wrong, right), start) is right
    again = {record.arm: record for record in run_study(replace(study, name="swapped", seeds=(1,)), apart)}
    assert again["EPNP"].settings["captures"] == right.folder.name
    assert load_weights(apart.out / "runs" / again["EPNP"].settings["run"]).sampling.surface == "corrected"
    assert again["simulation only"].settings["captures"] == wrong.folder.name


def test_an_ensemble_is_the_mean_of_its_images(records) -> None:
    """Squared error is convex: the mean image is at least as good as the mean error of its members."""
    by = {(r.arm, r.seed): np.array(r.positions["lab_4"]) for r in records}
    error = {key: 10 ** (-psnr / 10) for key, psnr in by.items()}
    for arm in ("E2E", "EPNP"):
        members = (error[arm, 0] + error[arm, 1]) / 2
        assert (error[arm, -1] <= members * (1 + 1e-3)).all()


def test_validation_leaves_the_test_characters_unread(apart) -> None:
    study = replace(STUDY, name="choose", arms=ARMS[:1], seeds=(0,), validation=("L",))
    (apart.out / "setups" / "lab").rename(apart.out / "setups" / "lab-without-L")
    found = run_study(study, apart)
    assert [r.split for r in found] == ["validation"]
    recorded = open_dataset(apart.out / "recorded" / found[0].settings["captures"])
    assert sorted(recorded.objects()) == ["lab_A", "lab_L", "lab_T"]
    assert recorded.objects("validation") == ["lab_L"]


def test_what_is_validated_on_was_not_calibrated_with(apart, monkeypatch) -> None:
    """Pre-training draws the known targets of the calibration again: it must not know those that are scored."""

    def fit(captures, settings, progress):
        raise DataError(" ".join(settings.exclude))

    monkeypatch.setattr("evnlos.experiment.run.fit_setup", fit)
    study = replace(STUDY, arms=ARMS[1:2], seeds=(0,), validation=("L",))
    with pytest.raises(CalibrationError, match=r"^4 L$"):
        run_study(study, apart)


def test_few_captures_are_nested_and_keep_the_test(apart) -> None:
    kept = []
    for count in (1, 2):
        arm = replace(ARMS[0], name=f"{count} captures", captures=count)
        found = run_study(replace(STUDY, name="few", arms=(arm,), seeds=(0,)), apart)
        recorded = open_dataset(apart.out / "recorded" / found[0].settings["captures"])
        assert recorded.objects("test") == ["lab_4"] and len(recorded.objects("train")) == count
        kept.append(set(recorded.objects("train")))
    assert kept[0] < kept[1]
    with pytest.raises(DataError, match="9 captures"):
        run_study(replace(STUDY, arms=(replace(ARMS[0], captures=9),)), apart)


def test_captures_that_no_setup_fits_say_so(tiny_captures, tmp_path) -> None:
    place = Place(tuple(tiny_captures[:1]), tmp_path)
    with pytest.raises(CalibrationError, match="capture"):
        run_study(replace(STUDY, test=()), place)


def test_folds_test_every_character_once_and_each_half_is_calibrated_to_the_other() -> None:
    characters = "ABCDEFGHIJ"
    folds = folds_of(STUDY, 4, characters)
    assert sorted(c for fold in folds for c in fold.test) == list(characters)
    for half in ("lab-a", "lab-b"):
        own = [fold for fold in folds if fold.setup == half]
        tested = {c for fold in own for c in fold.test}
        assert len(own) == 2 and own[0].calibration == own[1].calibration
        assert tested == set(own[0].calibration.exclude)
    assert len({fold.name for fold in folds}) == 4
    for wrong in (1, 3, 12):
        with pytest.raises(ConfigError, match=f"folds is {wrong}"):
            folds_of(STUDY, wrong, characters)


def test_folds_are_trained_and_scored_apart(apart) -> None:
    for half in ("lab-a", "lab-b"):
        shutil.copytree(apart.out / "setups" / "lab", apart.out / "setups" / half)
    characters = [character_of(folder.name) for folder in apart.captures]
    study = replace(STUDY, name="few", arms=ARMS[:1], seeds=(0,), refine=False)
    watch = Watch()
    assert len(run_studies(folds_of(study, 2, characters), replace(apart, trainings=2), watch)) == 2
    assert [step.done for step in watch.steps if step.what == "prepare folds"] == [0, 1]
    (merged,) = merge_folds(read_records(apart.out / "records" / "few-folds"), "lab")
    assert {character_of(name) for name in merged.scores["psnr_db"]} == set(characters)
    assert len(set(merged.settings["runs"])) == 2


def test_records_of_folds_are_one_record_of_all_characters() -> None:
    def record(setup: str, name: str, psnr: float, seed: int = 0) -> Record:
        scores = {"psnr_db": {name: psnr}}
        checks = {"read": float(psnr > 20)}
        return Record(
            "s-folds/1-of-2",
            setup,
            "EPNP",
            "frame",
            seed,
            "test",
            scores,
            {name: [psnr]},
            {"mean": scores},
            checks,
            {},
        )

    parts = [
        record("lab-a", "lab_A", 19.0),
        record("lab-b", "lab_B", 23.0),
        record("lab-a", "lab_A", 1.0, seed=1),
    ]
    (one,) = merge_folds([*parts, record("other-a", "other_A", 5.0)], "lab")
    assert one.scores == {"psnr_db": {"lab_A": 19.0, "lab_B": 23.0}} == one.baselines["mean"]
    assert (one.setup, one.study, one.checks) == ("lab", "s-folds", {"read": 0.5})
    assert one.positions == {"lab_A": [19.0], "lab_B": [23.0]}


def test_wrong_plans_are_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match="pre-training needs a simulation"):
        Arm("x", "none", SMALL, None)
    with pytest.raises(ConfigError, match="pre-training needs a simulation"):
        Arm("x", "calibrated", None, SMALL)
    with pytest.raises(ConfigError, match="trains nothing"):
        Arm("x", "none", None, None)
    with pytest.raises(ConfigError, match="captures is 0"):
        Arm("x", "none", None, SMALL, captures=0)
    with pytest.raises(ConfigError, match="no arm"):
        Study("x")
    with pytest.raises(ConfigError, match="two arms"):
        Study("x", arms=(ARMS[0], ARMS[0]))
    with pytest.raises(ConfigError, match="not for both"):
        Study("x", arms=ARMS, validation=("4",), test=("4",))
    with pytest.raises(DataError, match="no captures near_"):
        captures_of(tmp_path, "near")


@pytest.mark.parametrize("name", STUDIES)
def test_presets_are_whole(name) -> None:
    study = STUDIES[name]("near")
    assert study.name == name and study.test == ("G", "K", "4", "9") and len(study.arms) >= 2
    assert set(study.asked_for) < {arm.name for arm in study.arms}


@pytest.mark.parametrize("name", ["frozen", "capture-count", "surface", "thresholds", "loss", "width"])
def test_a_study_of_single_positions_has_a_sequence_twin(name) -> None:
    single, twin = STUDIES[name]("near"), on_sequences(STUDIES[name]("near"))
    arms = [arm for arm in single.arms if arm.sampling.surface != "sae-trace"]  # which sequences do not see
    assert twin.name == f"{name}-sequence" and [a.name for a in twin.arms] == [a.name for a in arms]
    for before, after in zip(arms, twin.arms, strict=True):
        first, was = after.pretraining or after.finetuning, before.pretraining or before.finetuning
        assert (
            first.network.kind == "sequence"
            and first.network.width == was.network.width
            and first.epochs > was.epochs
        )
        assert first.loss == was.loss and after.captures == before.captures and after.vary == before.vary
        if after.pretraining and after.finetuning:
            assert (
                after.finetuning.freeze == before.finetuning.freeze and after.finetuning.network.kind == "unet"
            )


def test_what_has_no_embedding_has_no_sequence_twin() -> None:
    with pytest.raises(ConfigError, match="'E2E plain' has no linear embedding"):
        on_sequences(STUDIES["captures"]("near"))


def made(arm: str, seed: int, shift: float) -> Record:
    positions = {"near_G": [20.0 + shift, 22.0 + shift], "near_K": [18.0 + shift, 19.0 + 3 * shift]}
    means = {name: float(np.mean(values)) for name, values in positions.items()}
    base = {"zero": {"psnr_db": {"near_G": 13.0, "near_K": 14.0}}}
    return Record(
        "s", "near", arm, "frame", seed, "test", {"psnr_db": means}, positions, base, {"read": 0.5}, {}
    )


def test_tables_say_what_the_records_say(tmp_path) -> None:
    every = [made("E2E", 0, 0.0), made("E2E", 1, 0.2), made("EPNP", 0, 2.0), made("EPNP", 1, 2.2)]
    for record in every:
        write_record(record, tmp_path)
    again = read_records(tmp_path)
    assert sorted(r.name for r in again) == sorted(r.name for r in every)
    gain = difference(again, "EPNP", "E2E", "frame")
    assert gain.mean == pytest.approx((2 + 2 + 2 + 6) / 4) and gain.low <= gain.mean <= gain.high
    text = summary_table(again)
    e2e = np.mean([np.mean([21, 18.5]), np.mean([21.2, 18.9])])
    assert f"| E2E | {e2e:.2f} +- 0.21 |" in text and "| all-black | 13.50 |" in text
    assert "| G |" in character_table(again, ("E2E", "EPNP")) and "**23.10**" in character_table(
        again, ("E2E", "EPNP")
    )
    table = gain_table(again)
    assert f"| frame | E2E | {e2e:.2f} | {e2e + gain.mean:.2f} | {gain} |" in table
    assert "| E2E frame | 50 % |" in checks_table(again)


def test_a_broken_record_is_named(tmp_path) -> None:
    with pytest.raises(DataError, match="no records"):
        read_records(tmp_path)
    (tmp_path / "bad.json").write_text(json.dumps({"arm": "x"}))
    with pytest.raises(DataError, match=r"bad\.json"):
        read_records(tmp_path)


def test_the_command_names_what_is_wrong(tmp_path, capsys) -> None:
    for arguments, word in (
        (["capture"], "captures, paper"),
        (["captures", "--arms", "EPMP"], "EPNP"),
        (["captures"], "no captures near_"),
        (["objects", "--writers", "5"], "--writers 5 would change nothing"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(["experiment", *arguments, "--captures", str(tmp_path), "--out", str(tmp_path / "o")])
        error = capsys.readouterr().err
        assert stop.value.code == 2 and word in error and len(error.strip().splitlines()) == 1
    assert not Path(tmp_path / "o").exists()


def test_the_papers_simulated_experiment_runs_on_a_small_scale(tmp_path, monkeypatch) -> None:
    from evnlos.data.simulations import paper

    simulated = importlib.import_module("evnlos.studies")

    sets = simulated.simulations(simulated.Simulated(tmp_path))
    assert [len(c.glyphs.objects()) for c in sets.values()] == [39 * 26, 26, 36]
    assert split_of(sets["nist"])["test"] == sets["nist"].glyphs.objects()
    assert [name[-1] for name in split_of(sets["comic"])["test"]] == ["G", "K", "4", "9"]

    small = replace(
        paper(),
        setup=replace(paper().setup, sensor=SensorSize(20, 30)),
        positions=4,
        sampling=SAMPLING,
        validation=0.0,
    )
    monkeypatch.setattr(
        simulated,
        "simulations",
        lambda _: {
            "train": replace(small, glyphs=HandwritingGlyphs(characters="AB", writers=1)),
            "nist": replace(
                small, glyphs=HandwritingGlyphs(characters="A", first_writer=39, writers=1), held_out="A"
            ),
            "comic": replace(small, glyphs=FontGlyphs(family="kalam", characters="AGT"), held_out="G"),
        },
    )
    settings = simulated.Simulated(
        tmp_path,
        pretraining=SMALL,
        finetuning=SMALL,
        end_to_end=SMALL,
        modalities=("frame",),
        seeds=(0,),
        workers=1,
    )
    found = simulated.run_simulated(settings)
    assert [(r.setup, r.arm) for r in found] == [
        ("nist", "pre-trained"),
        ("comic", "pre-trained"),
        ("comic", "EPNP"),
        ("comic", "E2E"),
    ]
    assert [list(r.positions) for r in found[1:]] == [["kalam_G"]] * 3
    assert simulated.run_simulated(settings) == []


def test_simulated_objects_tell_the_confidence_where_others_are_drawn(place, monkeypatch) -> None:
    """Of a hundred objects a twentieth held out is fewer than the eight that tell a confidence."""
    kept = list[float]()

    def refuse(config: Simulation, *_: object, **__: object) -> None:
        kept.append(config.validation)
        raise DataError("enough")

    monkeypatch.setattr(sys.modules["evnlos.experiment.run"], "simulate", refuse)
    for drawn in (0, 8):
        arm = replace(ARMS[1], pretraining=replace(SMALL, drawn=drawn))
        with pytest.raises(DataError, match="enough"):
            run_study(replace(STUDY, arms=(arm,)), place)
    assert kept == [0.0, 0.3]


def test_a_pattern_that_stays_is_in_captures_and_in_the_simulation(apart) -> None:
    """The calibrated camera's own, not the little that stays after correction; another one for each object."""
    setup = apart.out / "setups" / "lab"
    fitted = load_yaml(Simulation, setup / "setup.yaml")
    camera = replace(fitted.frame_camera, prnu=0.03, pattern_seed=7)
    save_yaml(replace(fitted, setup=replace(fitted.setup, frame_camera=camera)), setup / "setup.yaml")
    save_pattern(
        FixedPattern(np.full((48, 72), 2, np.float32), np.zeros((48, 72), np.float32)),
        setup / "pattern.safetensors",
    )
    study = replace(STUDY, modalities=("frame",), seeds=(0,), arms=ARMS[1:2])
    new = [record for one in (study, study.with_pattern()) for record in run_study(one, apart)]
    found = {record.study: record for record in new if record.arm == "simulation only"}
    assert {"captures", "captures-pattern"} == set(found)
    kept, taken = (
        load_weights(apart.out / "runs" / found[name].settings["run"]).history[-1]["data"]["name"]
        for name in ("captures-pattern", "captures")
    )
    told = {path.name: open_dataset(path).config["setup"] for path in (apart.out / "simulations").iterdir()}
    assert (told[kept]["frame_camera"]["prnu"], told[kept]["frame_camera"]["pattern_seed"]) == (0.03, None)
    assert told[taken]["frame_camera"]["prnu"] == fitted.frame_camera.prnu != 0.03
    bright, dark = (
        open_dataset(apart.out / "recorded" / found[name].settings["captures"])
        for name in ("captures-pattern", "captures")
    )
    seen = [NlosDataset(one, "test", "frame").inputs.float().mean() for one in (bright, dark)]
    assert seen[0] == pytest.approx(2 * float(seen[1]), rel=0.01)
