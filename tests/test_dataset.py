"""Samples on disk: area averaging, shards, simulation for any number of workers, resume, splits."""

import pickle
import signal
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils.data import DataLoader

from evnlos.config import config_hash, save_yaml
from evnlos.data import (
    Dataset,
    NlosDataset,
    Samples,
    Simulation,
    as_modality,
    live_dataset,
    open_dataset,
    randomized,
    read_shard,
    reduce_by_area,
    simulate,
    write_shard,
)
from evnlos.data.pool import run_tasks
from evnlos.data.simulate import drawn_for, split_of
from evnlos.data.simulations import find_faults, repair
from evnlos.errors import ConfigError, DataError, EvnlosError
from evnlos.models import UNetConfig
from evnlos.scene import HandwritingGlyphs
from evnlos.setups import RadiometricSetup
from evnlos.training import Training, train
from evnlos.training.source import DiskSource, ProcessGroup
from watching import Watch, always_die, die_once, stopped


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.h5"))}


@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 40), st.integers(1, 40), st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_area_averaging_is_the_mean_over_each_cell(h: int, w: int, hh: int, ww: int, seed: int) -> None:
    image = np.random.default_rng(seed).random((h, w)).astype(np.float32)
    before = image.copy()
    # A grid that both divide: repeat, then average whole blocks.
    fine = np.repeat(np.repeat(image.astype(np.float64), hh, axis=0), ww, axis=1)
    expected = fine.reshape(hh, h, ww, w).mean(axis=(1, 3))
    np.testing.assert_allclose(reduce_by_area(image, (hh, ww)), expected, atol=2e-6)
    np.testing.assert_array_equal(image, before)


def test_a_sample_shows_the_target_where_it_is(tiny_dataset) -> None:
    samples, attributes = read_shard(tiny_dataset.shard("writer00_T"))
    sampling = tiny_dataset.sampling
    assert samples.frame.shape == (8, 32, 48)
    assert samples.surface.shape == (8, 2, 32, 48)
    assert attributes["object"] == "writer00_T"
    np.testing.assert_allclose(samples.time_s, np.arange(1, 9))
    np.testing.assert_allclose(samples.position_m[:, 0], -0.08 + 0.02 * np.arange(1, 9), atol=1e-12)
    assert 0 < samples.frame.max() <= 1
    assert samples.surface.min() >= 0
    assert samples.event_count.sum() > 100
    # The truth's centre of light moves as the target does, 2 cm a position.
    x = (np.arange(48) - 23.5) * sampling.pitch_m
    centre = (samples.truth * x).sum(axis=(1, 2)) / samples.truth.sum(axis=(1, 2))
    np.testing.assert_allclose(np.diff(centre), 0.02, atol=2e-4)
    # And so does the spot in the frame, in the same direction.
    spot = samples.frame - np.median(samples.frame, axis=(1, 2), keepdims=True)
    spot = np.where(spot > 0.3 * spot.max(), spot, 0)
    assert (np.diff((spot * np.arange(48)).sum(axis=(1, 2)) / spot.sum(axis=(1, 2))) > 1).all()


def test_shards_are_the_same_bytes_for_any_number_of_workers(tiny, tiny_dataset, tmp_path) -> None:
    watch = Watch()
    simulate(tiny, tmp_path / "two", workers=2, progress=watch)
    assert sorted(watch.results) == sorted(tiny_dataset.objects())
    assert [step.done for step in watch.steps] == list(range(17))
    assert contents(tmp_path / "two") == contents(tiny_dataset.folder)


def test_a_run_goes_on_where_it_was(tiny, tiny_dataset, tmp_path) -> None:
    folder = tmp_path / "again"
    first = stopped(simulate, tiny, folder, after=2)
    assert len(open_dataset(folder).missing()) == 14
    watch = Watch()
    assert simulate(tiny, folder, progress=watch).missing() == []
    assert not set(first) & set(watch.results)
    assert contents(folder) == contents(tiny_dataset.folder)


def test_a_dataset_that_an_older_version_began_is_taken_up_and_stays_whole(tiny, tmp_path) -> None:
    folder = tmp_path / "old"
    (first,) = stopped(simulate, tiny, folder, after=1)
    page = yaml.safe_load((folder / "dataset.yaml").read_text())
    config = page["config"]
    config["glyphs"]["plate"] = config["glyphs"].pop("target_plane")
    config["rigs"] = config.pop("setups")
    open_dataset(folder).shard(first).unlink()  # its hash is that of today's words
    old = {key: value for key, value in page.items() if key in {item.name for item in fields(Dataset)}}
    save_yaml({**old, "config_hash": config_hash(config)}, folder / "dataset.yaml")
    with pytest.raises(DataError, match=r"other settings \(config.seed: 0 -> 1; split"):
        simulate(replace(tiny, seed=1), folder)
    simulate(tiny, folder)
    found = open_dataset(folder)
    assert find_faults(found) == [] and len(found.objects()) == 16
    found.shard(first).unlink()
    repair(found, find_faults(found))
    assert find_faults(open_dataset(folder)) == []


def test_a_killed_run_leaves_no_half_shard(tiny, tiny_dataset, tmp_path) -> None:
    save_yaml(tiny, tmp_path / "tiny.yaml")
    command = [
        sys.executable,
        "-m",
        "evnlos",
        "simulate",
        "--config",
        "tiny.yaml",
        "--out",
        "d",
        "--workers",
        "1",
    ]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while (
        len(list((tmp_path / "d").glob("*.h5"))) < 3 and process.poll() is None and time.monotonic() < deadline
    ):
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    found = contents(tmp_path / "d")
    assert 3 <= len(found) <= 16
    assert found.items() <= contents(tiny_dataset.folder).items()
    simulate(tiny, tmp_path / "d")
    assert contents(tmp_path / "d") == contents(tiny_dataset.folder)


def test_a_folder_of_other_settings_is_refused(tiny, tiny_dataset) -> None:
    with pytest.raises(DataError, match=r"positions: 8 -> 9"):
        simulate(replace(tiny, positions=9), tiny_dataset.folder)


def test_splits_are_by_object(tiny_dataset) -> None:
    train, held_out = set(tiny_dataset.objects("train")), set(tiny_dataset.objects("validation"))
    assert (len(train), len(held_out)) == (13, 3)
    assert not train & held_out
    with pytest.raises(DataError, match="no objects in split 'test'"):
        tiny_dataset.objects("test")


def test_held_out_characters_are_matched_exactly(tiny) -> None:
    glyphs = HandwritingGlyphs(characters="03ufUF?", writers=2)
    asked = replace(tiny, glyphs=glyphs, validation=0.0, held_out="?U")
    split = split_of(asked)
    assert split["test"] == ["writer00_U", "writer00_u003f", "writer01_U", "writer01_u003f"]
    assert split["train"] == [name for name in glyphs.objects() if name not in split["test"]]


@pytest.mark.parametrize("text", ["Z", "AZ", "A B", "a", "u0041"])
def test_a_held_out_character_that_no_object_shows_is_an_error(text: str, tiny, tmp_path) -> None:
    config = replace(tiny, held_out=text)
    with pytest.raises(ConfigError) as caught:
        simulate(config, tmp_path / "d")
    assert repr(next(c for c in text if c not in "AB")) in str(caught.value)
    assert not (tmp_path / "d").exists()
    with pytest.raises(ConfigError):
        live_dataset(config)


@pytest.mark.parametrize("wrong", [{"workers": -1}, {"share": (0, 2)}, {"share": (3, 2)}])
def test_a_simulation_that_cannot_be_makes_no_folder(wrong: dict, tiny, tmp_path) -> None:
    with pytest.raises(ConfigError):
        simulate(tiny, tmp_path / "d", **wrong)
    assert not (tmp_path / "d").exists()


def test_samples_are_read_when_they_are_asked_for(tiny_dataset) -> None:
    lazy, loaded = (NlosDataset(tiny_dataset, "train", "fusion") for _ in range(2))
    assert len(lazy) == len(loaded) == len(loaded.load().inputs)
    for index in (
        0,
        7,
        8,
        len(lazy) - 1,
        -1,
        slice(6, 20, 3),
        torch.tensor([40, 3, 3, 99, 0]),
        torch.arange(0),
    ):
        for one, other in zip(lazy[index], loaded[index], strict=True):
            assert one.dtype == torch.float32
            torch.testing.assert_close(one, other, rtol=0, atol=0)
    with pytest.raises(IndexError):
        lazy[len(lazy)]
    assert not lazy.in_memory
    assert len(pickle.dumps(loaded)) == len(pickle.dumps(lazy)) < 30_000  # workers get no maps
    assert loaded.bytes() == loaded.inputs.nbytes + loaded.truth.nbytes == lazy.bytes()


@pytest.mark.parametrize("way", [{"num_workers": 0}, {"num_workers": 2, "multiprocessing_context": "spawn"}])
def test_a_data_loader_with_workers_just_works(way: dict, tiny_dataset) -> None:
    samples = NlosDataset(tiny_dataset, "train", "event")
    batches = list(DataLoader(samples, batch_size=30, **way))
    assert not samples.in_memory
    for parts, whole in zip(zip(*batches, strict=True), samples[:], strict=True):
        assert torch.equal(torch.cat(parts), whole)


def test_memory_does_not_grow_with_the_dataset(tmp_path) -> None:
    """Samples of 300 MB, in a process of their own: its peak grows by some of them only."""
    steps, shape = 20, (200, 300)
    maps = np.zeros((steps, *shape), np.float32)
    one = Samples(maps, np.stack([maps, maps], axis=1), maps, np.arange(20.0), None, np.zeros(20, np.int64))
    for k in range(30):
        write_shard(tmp_path / f"o_{k:02d}.h5", one, {"object": f"o_{k:02d}"})
    code = """
import resource, sys
from pathlib import Path
from evnlos.data import Dataset, NlosDataset, Sampling
folder = Path(sys.argv[1])
names = sorted(path.stem for path in folder.glob("*.h5"))
data = Dataset(folder, "captures", Sampling(), {"train": names})
NlosDataset(data, "train", "fusion")[0]
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
samples = NlosDataset(data, "train", "fusion")
for k in range(0, len(samples), 3):
    samples[k]
assert samples.bytes() > 280e6
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    done = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 30_000  # kB


def test_a_dataset_larger_than_the_memory_is_trained_on_from_disk(tiny_dataset, monkeypatch) -> None:
    process_group = ProcessGroup(0, 1, torch.device("cpu"))
    held = DiskSource(NlosDataset(tiny_dataset, "train", "fusion"), 32, 5, process_group)
    monkeypatch.setattr("evnlos.data.loader.free_memory", lambda: 1000)
    samples = NlosDataset(tiny_dataset, "train", "fusion")
    read = DiskSource(samples, 32, 5, process_group)
    for one, other in zip(held.batches(3), read.batches(3), strict=True):
        assert torch.equal(one.seen, other.seen) and torch.equal(one.truth, other.truth)
        assert (one.share, one.weight) == (other.share, other.weight)
    torch.testing.assert_close(read.mean_image(), held.mean_image(), rtol=0, atol=1e-6)
    for one, other in zip(held.subset(50), read.subset(50), strict=True):
        assert np.array_equal(one, other)
    assert not samples.in_memory


def test_a_flipped_bit_in_a_shard_is_found(tiny_dataset, tmp_path) -> None:
    samples, attributes = read_shard(tiny_dataset.shard("writer00_A"))
    write_shard(tmp_path / "s.h5", samples, attributes)
    clean = (tmp_path / "s.h5").read_bytes()
    start = clean.find(b"\x78\x01") + 40  # inside the first gzip chunk
    rng = np.random.default_rng(0)
    for place in rng.integers(start, len(clean) // 2, 8):
        broken = bytearray(clean)
        broken[place] ^= 1 << int(rng.integers(8))
        (tmp_path / "b.h5").write_bytes(broken)
        try:
            again, _ = read_shard(tmp_path / "b.h5")
        except DataError as error:
            assert "damaged" in str(error) or "not a shard" in str(error)
        else:  # the bit lay in space that holds nothing
            np.testing.assert_array_equal(again.frame, samples.frame)
            np.testing.assert_array_equal(again.surface, samples.surface)
    with pytest.raises(DataError, match="damaged"):
        (tmp_path / "b.h5").write_bytes(clean[: len(clean) // 2])
        read_shard(tmp_path / "b.h5")


def test_modalities_are_one_switch(tiny_dataset) -> None:
    sets = {
        modality: NlosDataset(tiny_dataset, "validation", modality) for modality in ("frame", "event", "fusion")
    }
    assert [d.inputs.shape[1] for d in sets.values()] == [1, 2, 3]
    np.testing.assert_array_equal(sets["fusion"].inputs[:, :1], sets["frame"].inputs)
    np.testing.assert_array_equal(sets["fusion"].inputs[:, 1:], sets["event"].inputs)
    seen, truth = sets["fusion"][5]
    assert (seen.shape, truth.shape) == ((3, 32, 48), (1, 32, 48))
    with pytest.raises(ConfigError, match="modality"):
        as_modality("sound")


def test_the_trace_stands_beside_the_surface_and_networks_of_single_time_steps_see_it(tiny, tmp_path) -> None:
    sampling = replace(tiny.sampling, surface="sae-trace")
    glyphs = replace(tiny.glyphs, characters="AB", writers=1)
    made = simulate(replace(tiny, glyphs=glyphs, sampling=sampling, validation=0.0), tmp_path / "data")
    plain = as_modality("event")
    both, alone = (NlosDataset(made, "train", one) for one in (plain.seeing("sae-trace"), plain))
    np.testing.assert_array_equal(both.inputs[:, :2], alone.inputs)
    assert both.inputs.shape[1] == 4 and both.inputs[:, 2:].any()
    assert pickle.loads(pickle.dumps(both)).modality.layout == {"events": 2, "trace": 2}
    assert as_modality("frame").seeing("sae-trace") == as_modality("frame") != plain == plain.seeing("sae")
    settings = Training(modality="event", epochs=1, network=UNetConfig(width=8, depth=1, rank=8))
    trained = train(made, settings, tmp_path / "run").load()
    assert trained.modality.layout == {"events": 2, "trace": 2} and trained.modality.name == "event"


def test_a_network_is_given_levels_as_they_were_measured() -> None:
    frame, surface = np.random.default_rng(0).random((2, 8, 8)), np.random.default_rng(1).random((2, 2, 8, 8))
    seen = as_modality("fusion").inputs(frame, surface).numpy()
    np.testing.assert_allclose(seen[:, 0], frame, atol=1e-6)
    np.testing.assert_allclose(seen[:, 1:], surface, atol=1e-6)


def test_the_pool_survives_the_death_of_a_worker(tmp_path) -> None:
    assert sorted(run_tasks(die_once, [(tmp_path / "died", i) for i in range(6)], 2)) == list(range(6))
    with pytest.raises(EvnlosError, match="died 3 times"):
        list(run_tasks(always_die, range(4), 2))


@pytest.mark.parametrize("workers", [1, 2])
def test_a_task_waits_for_those_that_it_needs(tmp_path, workers) -> None:
    tasks = [(tmp_path / str(number), [tmp_path / str(n) for n in needs]) for number, needs in enumerate(NEEDS)]
    assert sorted(run_tasks(write_after, tasks, workers, NEEDS)) == [str(n) for n in range(len(NEEDS))]


NEEDS = [set(), {0}, set(), {0, 2}, {1, 3}, set()]


def write_after(task) -> str:
    path, needed = task
    assert all(other.is_file() for other in needed)
    path.write_text("done")
    return path.name


def test_no_dataset_and_overlapping_splits(tmp_path) -> None:
    with pytest.raises(DataError, match="no dataset"):
        open_dataset(tmp_path)
    about = {"origin": "simulation", "sampling": {}, "version": "0"}
    save_yaml({**about, "split": {"train": ["a"], "test": ["a"]}}, tmp_path / "dataset.yaml")
    with pytest.raises(DataError, match="two splits"):
        open_dataset(tmp_path)
    save_yaml({**about, "split": {"train": ["../a"]}}, tmp_path / "dataset.yaml")
    with pytest.raises(DataError, match="out of the folder"):
        open_dataset(tmp_path)


def test_bytes_do_not_depend_on_who_holds_the_objects_of_the_file(tiny_dataset, tmp_path, monkeypatch) -> None:
    import h5py

    name = tiny_dataset.objects()[0]
    samples, attributes = read_shard(tiny_dataset.shard(name))
    held, create = [], h5py.File.create_dataset
    monkeypatch.setattr(
        h5py.File, "create_dataset", lambda *a, **k: (held.append(create(*a, **k)), held[-1])[1]
    )
    write_shard(tmp_path / "held.h5", samples, attributes)
    assert len(held) == 6
    assert (tmp_path / "held.h5").read_bytes() == tiny_dataset.shard(name).read_bytes()


def test_optics_are_drawn_for_groups_of_objects_and_light_for_each() -> None:
    config = Simulation(
        setup=RadiometricSetup(),
        vary={"setup.roughness": (0.03, 0.08), "setup.gain": (0.5, 1.5), "setup.pixel.cutoff_hz": (10, 90)},
        setups=3,
    )
    names = config.glyphs.objects()[:40]
    drawn = [drawn_for(config, name) for name in names]
    assert len({d.setup.roughness for d in drawn}) == 3
    assert len({d.setup.gain for d in drawn}) == len({d.pixel.cutoff_hz for d in drawn}) == 40
    own = [drawn_for(replace(config, setups=0), name) for name in names]
    assert len({d.setup.roughness for d in own}) == 40
    with pytest.raises(ConfigError, match="setups"):
        Simulation(setups=-1)


def test_a_randomized_simulation_draws_sensors_and_walls_from_wide_ranges():
    narrow = Simulation(
        setup=RadiometricSetup(distance_m=0.3),
        vary={"setup.gain": (0.9, 1.1), "setup.pixel.threshold_on": (0.01, 2.0)},
        setups=2,
    )
    wide = randomized(narrow)
    assert wide.vary["setup.pixel.threshold_on"] == (0.01, 2.0)  # was wider already
    low, high = wide.vary["setup.gain"]
    assert low == pytest.approx(0.8 * narrow.setup.gain) and high == 1.1
    value = narrow.setup.roughness
    assert wide.vary["setup.roughness"] == pytest.approx((0.8 * value, 1.2 * value))
    places = [one for one in narrow.setup.parameters() if one.role == "place"]
    assert places
    for one in places:
        assert wide.vary[f"setup.{one.name}"] == pytest.approx((one.value - 0.002, one.value + 0.002))
    assert wide.setups == 6 and randomized(wide) == wide and narrow.setups == 2
    pixels = randomized(narrow, walls=False)
    assert pixels.vary["setup.gain"] == (0.9, 1.1) and pixels.setup == narrow.setup and pixels.setups == 2
    ranges = {n: r for n, r in wide.vary.items() if n.startswith("setup.pixel.")}
    assert pixels.vary == {**narrow.vary, **ranges}
    drawn = {drawn_for(wide, name).setup.pixel.threshold_off for name in ("a", "b", "c")}
    assert len(drawn) == 3
