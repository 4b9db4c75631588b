"""Fixtures that several test files use."""

import os
import sys
import zipfile
from pathlib import Path

# One thread a process, here and in the programs that tests start: several processes test at once, and
# threads that wait for each other at every operation would make them many times slower. The line stands
# before the first import of torch and numba.
os.environ["OMP_NUM_THREADS"] = "1"

import hypothesis
import pytest
import tyro  # noqa: F401  Its import reads all builtins, and stumbles over what a doctest leaves as `_`.

# Bytecode is kept beside the sources, where numba keeps what it compiles: without it each of the hundreds of
# programs that tests start would compile the package anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

ROOT = Path(__file__).resolve().parent.parent


SLOW = {
    "test_cluster", "test_distributed", "test_examples", "test_experiment", "test_faults",
    "test_generalization", "test_interop_deepinv", "test_live_training", "test_mitsuba_oracle",
    "test_notebooks", "test_open_core",
}  # fmt: skip
"""Files of whole studies and trainings, and of programs that they start."""


THOROUGH = (
    "test_app.py::test_drawings_and_uploads_in_a_real_browser",
    "test_app_upload.py::test_a_recording_is_shown[.csv]",
    "test_app_upload.py::test_a_recording_is_shown[.h5]",
    "test_app_upload.py::test_a_recording_is_shown[.npz]",
    "test_brownian.py::test_exit_of_a_drifting_walk_has_its_closed_forms[1-0.0-40.0]",
    "test_capture_check.py::test_rates_of_false_alarms_and_of_shifts_that_are_found",
    "test_capture_check.py::test_a_polarity_of_a_higher_threshold_is_no_clock_offset[1.4-0.0-5.0]",
    "test_capture_check.py::test_a_tenth_of_a_second_is_found_beside_other_captures[near]",
    "test_circuit.py::test_noise_is_as_frequent_at_first_as_later[1e-14-0.15-0.15-0.0-0.0-3]",
    "test_circuit.py::test_noise_is_as_frequent_at_first_as_later[1e-14-0.15-0.15-0.1-0.02-3]",
    "test_circuit.py::test_noise_is_as_frequent_at_first_as_later[3e-15-0.1-0.1-0.1-0.02-3]",
    "test_circuit.py::test_noise_is_as_frequent_at_first_as_later[1e-14-0.2-0.2-0.5-0.0-3]",
    "test_circuit.py::test_noise_is_as_frequent_at_first_as_later[1e-14-0.15-0.15-0.0-0.0-1]",
    "test_circuit.py::test_noise_is_as_frequent_at_first_as_later[1e-14-0.19-0.23-0.1-0.012-3]",
    "test_circuit.py::test_noise_is_as_frequent_at_first_as_later[1e-14-0.2-0.2-0.5-0.0-1]",
    "test_circuit.py::test_noise_is_as_frequent_at_first_as_later[5e-14-0.15-0.15-0.1-0.02-3]",
    "test_circuit.py::test_noise_events_come_at_stated_rates[1e-13-0.15-0.04-500]",
    "test_circuit.py::test_noise_events_come_at_stated_rates[1e-14-0.2-0.06-500]",
    "test_circuit.py::test_noise_rates_are_those_of_small_steps[0.1]",
    "test_cluster.py::test_a_killed_worker_costs_nothing_but_time",
    "test_cluster.py::test_the_command_starts_a_cluster_of_its_own",
    "test_command_line.py::test_words_that_do_not_fit_are_one_line_whatever_the_terminal_shows[ascii]",
    "test_distributed.py::test_two_processes_survive_a_kill",
    "test_experiment.py::test_the_papers_simulated_experiment_runs_on_a_small_scale",
    "test_event_likelihood.py::test_events_reach_the_bound_and_their_intervals_cover[many noise events]",
    "test_event_likelihood.py::test_events_reach_the_bound_and_their_intervals_cover[slow noise]",
    "test_event_models.py::test_a_sensor_of_the_usual_law_keeps_it",
    "test_event_models.py::test_a_circuit_in_dim_light_is_told",
    "test_event_motion.py::test_a_capture_of_constant_distance_is_not_identified",
    "test_event_motion.py::test_a_target_is_solved_from_a_path_that_nobody_stated[frames]",
    "test_faults.py::test_a_killed_conversion_ends_with_the_same_bytes[.csv]",
    "test_faults.py::test_a_killed_conversion_ends_with_the_same_bytes[.h5]",
    "test_faults.py::test_a_killed_conversion_ends_with_the_same_bytes[.npz]",
    "test_faults.py::test_a_killed_import_ends_with_the_same_bytes[1]",
    "test_faults.py::test_a_killed_import_ends_with_the_same_bytes[2]",
    "test_faults.py::test_a_killed_import_ends_with_the_same_bytes[4]",
    "test_faults.py::test_a_killed_training_ends_with_the_same_bytes[1-0]",
    "test_faults.py::test_a_killed_training_ends_with_the_same_bytes[2-0]",
    "test_faults.py::test_a_killed_training_ends_with_the_same_bytes[3-1]",
    "test_faults.py::test_a_killed_training_ends_with_the_same_bytes[4-1]",
    "test_faults.py::test_a_killed_training_ends_with_the_same_bytes[5-2]",
    "test_faults.py::test_workers_end_with_their_parent[15-False-at work]",
    "test_faults.py::test_workers_end_with_their_parent[15-False-starting]",
    "test_faults.py::test_workers_end_with_their_parent[9-False-at work]",
    "test_faults.py::test_workers_end_with_their_parent[9-False-starting]",
    "test_mitsuba_oracle.py::test_two_per_cent_of_gain_are_found[GGX 0.3, post]",
    "test_pixel_fit.py::test_many_pixels_of_real_recordings_embarrass_nobody",
    "test_tracking.py::test_approach_and_retreat_are_found[0.0]",
    "test_tracking.py::test_the_page_on_motion_says_what_the_command_prints[near_G]",
)
"""What takes long and repeats at another instant, format or number what a quicker test does."""


BEGUN_SECOND = ("test_brownian", "test_circuit", "test_event_models")
"""Files with which the second of two processes begins: they compile other kernels than the first ones do."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Take `--thorough` and `--coverage`."""
    parser.addoption("--coverage", action="store_true", help="print the share of the statements that ran")
    parser.addoption("--thorough", action="store_true", help="run also what takes long and seldom breaks")


def pytest_configure(config: pytest.Config) -> None:
    """Draw the same examples in each run of the tests, and others in each thorough one."""
    hypothesis.settings.register_profile("the same", derandomize=True)
    if not config.getoption("--thorough"):
        hypothesis.settings.load_profile("the same")
    if config.getoption("--coverage"):
        from line_coverage import Coverage

        config.pluginmanager.register(Coverage())


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what takes long, what needs a GPU, and what needs the real data; leave out the thorough tests."""
    everything = config.args_source is not pytest.Config.ArgsSource.ARGS  # none named on the command line
    there = {item.nodeid.removeprefix("tests/") for item in items}
    lost = [name for name in THOROUGH if everything and "::" in name and name not in there]
    if lost:
        raise pytest.UsageError(f"THOROUGH names tests that are not there: {lost}")
    for item in items:
        name = item.nodeid.removeprefix("tests/")
        if name in THOROUGH or name.partition("::")[0] in THOROUGH:
            item.add_marker(pytest.mark.thorough)
        if item.path.stem in SLOW:
            item.add_marker(pytest.mark.slow)
        if "shared_data" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.shared)
        if "cuda" in item.name:
            item.add_marker(pytest.mark.gpu)
    if everything and not config.getoption("--thorough"):
        left_out = [item for item in items if item.get_closest_marker("thorough")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]
    if everything and "PYTEST_XDIST_WORKER" in os.environ:  # each process begins with its share of the list
        second = [item for item in items if item.path.stem in BEGUN_SECOND]
        others = [item for item in items if item.path.stem not in BEGUN_SECOND]
        half = len(items) // 2
        items[:] = [*others[:half], *second, *others[half:]]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real and independent data, or skip where it is not present."""
    folder = Path(os.environ.get("EVNLOS_SHARED", ROOT.parent / "shared")) / "data"
    if not folder.is_dir():
        pytest.skip(f"no shared data at {folder}")
    return folder


@pytest.fixture(scope="session")
def tiny():
    """Settings of a simulation that takes a second: 16 objects, 8 positions each, a small sensor."""
    from evnlos.data import Sampling, SensorSize, Simulation
    from evnlos.scene import HandwritingGlyphs
    from evnlos.setups import PaperSetup

    return Simulation(
        glyphs=HandwritingGlyphs(characters="ABCEFHLT", writers=2),
        setup=PaperSetup(
            tpsf_length_m=0.004, pitch_m=1e-3, gain=2.0, field_of_view_m=0.3, sensor=SensorSize(48, 72)
        ),
        sampling=Sampling(height=32, width=48, pitch_m=0.005, scored_rows=24),
        positions=8,
        validation=0.2,
        vary={"setup.gain": (1.5, 2.0)},
    )


@pytest.fixture(scope="session")
def tiny_dataset(tiny, tmp_path_factory):
    """A simulated dataset on disk that tests only read."""
    from evnlos.data import simulate

    return simulate(tiny, tmp_path_factory.mktemp("tiny") / "simulation")


@pytest.fixture(scope="session")
def tiny_captures(tmp_path_factory) -> list[Path]:
    """Four rendered captures of a small sensor, without any installed font."""
    from evnlos.data import SensorSize
    from evnlos.data.lab import Lab, render_captures
    from evnlos.scene import FontGlyphs
    from evnlos.setups import RadiometricSetup

    lab = Lab(
        glyphs=FontGlyphs(family="kalam", characters="ALT4"),
        setup=RadiometricSetup(cell_m=0.01, gain=0.7, ambient=0.06, sensor=SensorSize(48, 72)),
        frame_rate_hz=1.0,
    )
    return render_captures(lab, tmp_path_factory.mktemp("lab"))


@pytest.fixture(scope="session")
def app_sequence():
    """A sequence that the page simulates, at the smallest size."""
    from evnlos.app.controls import Controls, picked, simulate_sequence

    return simulate_sequence(Controls(columns=24), picked("R"))


@pytest.fixture(scope="session")
def app_weights(tmp_path_factory) -> dict[str, Path]:
    """Untrained weights of two modalities, for maps of the page's smallest size."""
    import torch

    from evnlos.data import Sampling
    from evnlos.models import UNetConfig, Weights, save_weights

    folder = tmp_path_factory.mktemp("weights")
    sampling, found = Sampling(height=16, width=24, pitch_m=0.01, scored_rows=12), {}
    for modality in ("fusion", "event"):
        torch.manual_seed(0)
        network = UNetConfig(width=4, depth=1, rank=0).build(modality, sampling).eval()
        found[modality] = folder / f"{modality}-run" / "weights.safetensors"
        found[modality].parent.mkdir()
        save_weights(found[modality], Weights(network))
    return found


@pytest.fixture(scope="session")
def zipped_capture(tiny_captures, tmp_path_factory) -> Path:
    """A capture folder as people zip it."""
    path = tmp_path_factory.mktemp("zip") / "capture.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for one in sorted(tiny_captures[0].rglob("*")):
            archive.write(one, one.relative_to(tiny_captures[0].parent))
    return path
