"""Settings: YAML round trips, unknown keys, wrong types, variation."""

import dataclasses
import math
from dataclasses import fields, replace

import numpy as np
import pytest

from evnlos.cameras import EventPixel, FrameCamera, PixelSettings
from evnlos.config import config_hash, differing_keys, from_dict, load_yaml, save_yaml, to_dict
from evnlos.data import Sampling, Simulation
from evnlos.data.lab import Lab
from evnlos.data.simulate import varied
from evnlos.data.simulations import PRESETS
from evnlos.errors import ConfigError, DataError
from evnlos.models import ReconstructorSettings
from evnlos.scene import LineMotion
from evnlos.setups import RadiometricSetup, Setup
from evnlos.training import Training, paper_finetuning, paper_pretraining

CONFIGS = [
    Simulation(),
    Simulation(setup=RadiometricSetup(), vary={"setup.pixel.threshold_on": (0.1, 0.2)}),
    *(preset() for preset in PRESETS.values()),
    Lab(),
    Training(),
    paper_pretraining(),
    paper_finetuning(),
]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: type(c).__name__)
def test_yaml_round_trip_is_exact(config: object, tmp_path) -> None:
    save_yaml(config, tmp_path / "c.yaml")
    again = load_yaml(type(config), tmp_path / "c.yaml")
    assert again == config
    assert config_hash(again) == config_hash(config)


def test_unknown_keys_name_the_nearest_setting() -> None:
    with pytest.raises(ConfigError, match=r"pixel\.treshold_on.*threshold_on"):
        from_dict(Simulation, {"pixel": {"treshold_on": 0.2}})
    with pytest.raises(ConfigError, match=r"no setup of kind 'magic'.*paper, radiometric"):
        from_dict(Simulation, {"transport": {"kind": "magic"}})
    with pytest.raises(ConfigError, match=r"setup\.rougness.*roughness"):
        from_dict(Simulation, {"transport": {"kind": "radiometric", "rougness": 0.1}})


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"positions": "many"}, "positions = 'many': give a whole number"),
        ({"positions": 2.5}, "positions = 2.5: give a whole number"),
        ({"duration_s": "long"}, "duration_s = 'long': give a number"),
        ({"setup": {"pixel": {"threshold_on": "big"}}}, "setup.pixel.threshold_on = 'big': give a number"),
        ({"sampling": {"surface": "x"}}, "sampling.surface = 'x': give 'sae', 'context', "),
        ({"setup": {"pixel": {"logarithm": "x"}}}, "setup.pixel.logarithm = 'x': give 'lin-log' or 'true'"),
        ({"sampling": 4}, "sampling = 4: give a mapping of names to values"),
        ({"vary": {"a": 3}}, "vary.a = 3: give a list"),
        ({"vary": {"a": [1, 2, 3]}}, r"vary.a = \[1, 2, 3\]: give at most 2 values"),
        ({"vary": {"a": [1]}}, "vary.a.1: a value is required here"),
        ({"positions": 0}, "at least 1"),
        ({"duration_s": -1.0}, "positive"),
        ({"pixel": {"threshold_on": 0.0}}, "threshold_on"),
        ({"pixel": {"threshold_on": float("nan")}}, "threshold_on"),
        ({"vary": {"setup.pixel.treshold_on": [0.1, 0.2]}}, "threshold_on"),
        ({"vary": {"setup.pixel.threshold_on": [0.3, 0.2]}}, "ascending"),
        ({"vary": {"sampling.surface": [0, 1]}}, "no number"),
        ({"vary": {"setup.pixel.threshold_on": [-0.3, 0.2]}}, "threshold_on"),
    ],
)
def test_wrong_values_are_one_line_errors(values: dict, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as caught:
        from_dict(Simulation, values)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [("[1, 2]", "mapping"), ("a: [", "not valid YAML: .* at line 2, column 1"), ("", "mapping")],
)
def test_wrong_yaml_files(text: str, says: str, tmp_path) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ConfigError, match=says):
        load_yaml(Training, tmp_path / "c.yaml")
    with pytest.raises(ConfigError, match="does not exist"):
        load_yaml(Training, tmp_path / "missing.yaml")


def test_variation_draws_within_range_and_by_name() -> None:
    config = Simulation()
    ranges = {"setup.pixel.threshold_on": (0.1, 0.2), "motion.start_m.0": (-0.09, -0.07)}
    drawn = [varied(config, ranges, 3, name) for name in "abcdefgh"]
    values = [d.pixel.threshold_on for d in drawn]
    assert all(0.1 <= v <= 0.2 for v in values)
    assert len(set(values)) == 8
    assert all(-0.09 <= d.motion.start_m[0] <= -0.07 and d.motion.start_m[1] == 0 for d in drawn)
    assert varied(config, ranges, 3, "a") == drawn[0]
    # One more range leaves the draws of the others as they were.
    assert varied(config, ranges | {"setup.pixel.cutoff_hz": (1, 2)}, 3, "a").pixel.threshold_on == values[0]
    assert config == Simulation()


def test_the_papers_settings() -> None:
    paper, pre, fine = PRESETS["paper"](), paper_pretraining(), paper_finetuning()
    assert len(paper.glyphs.objects()) == 39 * 26
    assert (paper.sensor.height, paper.sensor.width, paper.positions) == (600, 960, 40)
    assert dataclasses.astuple(paper.pixel)[:7] == (0.15, 0.15, 0.03, 15.0, 0.01, 0.0015, 0.0)
    assert paper.pixel == EventPixel()
    assert (paper.motion.speed_m_s, paper.glyphs.target_plane.size_m) == (0.02, 0.08)
    assert (paper.setup.tpsf_t, paper.setup.mean_free_path, paper.setup.kernel_radius) == (2.0, 0.8, 2.0)
    assert (pre.epochs, pre.batch_size, pre.learning_rate, pre.step_epoch, pre.loss) == (
        200,
        16,
        1e-4,
        100,
        "paper",
    )
    assert (fine.epochs, fine.batch_size, fine.learning_rate, fine.schedule) == (100, 16, 1e-5, "constant")


def test_differing_keys_are_named_with_both_values() -> None:
    ours, theirs = to_dict(Training(epochs=3)), to_dict(Training(epochs=4))
    assert differing_keys(ours, theirs) == ["epochs: 4 -> 3"]


def _classes() -> list[type]:
    """Return the settings classes that people build in Python, one of every kind."""
    families = (PixelSettings.registry, Setup.registry, ReconstructorSettings.registry)
    kinds = [family[kind] for family in families for kind in family if kind != "celex"]  # no number of its own
    return [Simulation, FrameCamera, LineMotion, Sampling, Lab, Training, *kinds]


@pytest.mark.parametrize("cls", _classes(), ids=lambda cls: cls.__name__)
def test_settings_that_are_built_in_python_have_their_ranges(cls: type) -> None:
    whole = cls()
    checked = 0
    for item in fields(cls):
        value = getattr(whole, item.name)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            continue
        for wrong in (math.nan, math.inf, -math.inf, 1e300, -1e300, np.float32(np.nan)):
            with pytest.raises((ConfigError, DataError)) as caught:
                replace(whole, **{item.name: wrong})
            assert "\n" not in str(caught.value)
            checked += 1
    assert checked


@pytest.mark.parametrize("name", ["distance_m", "camera_distance_m", "cell_m", "albedo", "field_of_view_deg"])
def test_lengths_are_never_negative(name: str) -> None:
    with pytest.raises(ConfigError, match="0 or a positive"):
        RadiometricSetup(**{name: -0.1})
