"""Reading characters, telling memory from sight, and intervals for differences."""

import json
import os
import random
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save
from scipy.ndimage import map_coordinates

import evnlos.analysis
from evnlos import EvnlosError
from evnlos.analysis import confusion
from evnlos.analysis.evaluate import compare_with_training
from evnlos.analysis.scores import CHARACTERS, load_reader, paired_difference, read_characters
from evnlos.data import Dataset, NlosDataset, Sampling, import_captures, read_shard, simulate
from evnlos.metrics import psnr
from evnlos.models import on_target_plane
from evnlos.scene import FontGlyphs, find_font
from evnlos.scene.handwriting import FACES
from evnlos.tensor_file import read_sealed
from evnlos.types import Plane
from train_classifier import HELD, PACKAGES, captured, faces, measure, printed, train_reader

CANVAS = Plane(64, 96, 0.0025)


def read_all(family: str) -> tuple[list[str], list[str], list[str]]:
    """Return the characters of a typeface, what is read of them, and what is read at wrong places."""
    glyphs = FontGlyphs(family=family)
    names = glyphs.objects()
    x = np.linspace(-0.07, 0.07, len(names))
    places = np.stack([x, 0.01 * np.sin(40 * x)], axis=1)
    pictures = torch.from_numpy(
        np.stack([glyphs.target(n).rasterise(CANVAS, place) for n, place in zip(names, places, strict=True)])
    )
    found, elsewhere = (
        read_characters(on_target_plane(pictures, CANVAS, where)) for where in (places, -places)
    )
    return [name[-1] for name in names], found, elsewhere


def share(truth: list[str], found: list[str]) -> float:
    return float(np.mean([a == b for a, b in zip(truth, found, strict=True)]))


def test_the_reader_reads_targets_wherever_they_are() -> None:
    truth, found, elsewhere = read_all("Kalam Bold")
    assert share(truth, found) >= 0.94  # O and 0 of one typeface, and the like
    assert share(truth, elsewhere) < 0.5


def test_the_reader_reads_a_typeface_that_it_never_saw() -> None:
    if find_font("Comic Neue Bold").note:
        pytest.skip("Comic Neue is not installed (Debian package fonts-comic-neue)")
    truth, found, _ = read_all("Comic Neue Bold")
    assert share(truth, found) >= 0.97  # 36 of 36 when it was trained


def test_the_reader_reads_the_true_images_of_the_captures(shared_data) -> None:
    """None of its faces draws them; 32 of 32 when it was trained, none of them for another."""
    shares, words = measure(load_reader(), captured(shared_data / "captures"))
    assert shares["clean"] >= 0.95, words
    assert words == "none" or shares["clean"] < 1


def test_no_face_that_the_reader_learned_draws_what_it_reads() -> None:
    """Neither the families of the pre-training nor that of the captures; files are named after their family."""
    drawn = {name.split()[0].lower() for name in (*FACES["both"], "Comic Neue")}
    learned = {file.lower() for files in (PACKAGES | HELD).values() for file in files}
    assert len(learned) > 40 and not [file for file in learned if file.startswith(tuple(drawn))]
    about = json.loads(read_sealed(Path(evnlos.analysis.__file__).with_name("classifier.safetensors"))[0])
    assert set(about["trained_on"].split(", ")) == {file for files in PACKAGES.values() for file in files}


def test_what_is_taken_for_another_character_is_said_in_shares() -> None:
    seen = [{"near_G": {"G": 3, "C": 1}, "near_K": {"K": 4}}, {"near_G": {"C": 2, "G": 1, "6": 1}}]
    assert confusion(seen) == "G as C 38%, G as 6 12%" and confusion([]) == ""
    many = {"near_G": dict.fromkeys("ABCDEFHIJK", 10)}
    assert confusion([many]).endswith("G as I 10%, 2 more")


def test_training_a_reader_repeats_itself_and_learns() -> None:
    first, second = (train_reader(("Kalam",), epochs=16) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))
    (known, none), (unknown, words) = (
        measure(first, printed((face,))) for face in ("Kalam", "Permanent Marker")
    )
    assert known["clean"] == 1 and none == "none"
    assert 3 / len(CHARACTERS) < unknown["clean"] < 1 and " as " in words


def test_faces_that_are_not_there_name_their_package(tmp_path) -> None:
    with pytest.raises(SystemExit, match="install the Debian package fonts-play"):
        faces({"fonts-play": ("Play-Bold.ttf",)}, tmp_path)


def test_a_file_of_something_else_is_refused(tmp_path) -> None:
    path = tmp_path / "r.safetensors"
    path.write_bytes(b"nonsense")
    with pytest.raises(EvnlosError, match="no character reader"):
        load_reader(path)


def test_no_flipped_byte_of_the_reader_goes_unseen(tmp_path) -> None:
    own = Path(evnlos.analysis.__file__).with_name("classifier.safetensors")
    whole, draw = own.read_bytes(), random.Random(0)
    expected = load_reader().state_dict()
    places = [*range(0, 2000, 13), *(draw.randrange(len(whole)) for _ in range(200))]
    noticed = 0
    for number, place in enumerate(places):  # each its own name: what was read well is kept by its name
        path, changed = tmp_path / f"{number}.safetensors", bytearray(whole)
        changed[place] ^= 1 << draw.randrange(8)
        path.write_bytes(changed)
        try:
            found = load_reader(path).state_dict()
        except EvnlosError as error:
            assert "\n" not in str(error)
            noticed += 1
        else:
            assert all(torch.equal(found[name], value) for name, value in expected.items()), place
        path.unlink()
    assert noticed > 0.9 * len(places)


def test_a_reader_that_nothing_vouches_for_is_refused(tmp_path) -> None:
    path = tmp_path / "r.safetensors"
    state = {name: value.half() for name, value in load_reader().state_dict().items()}
    path.write_bytes(save(state, metadata={"evnlos": json.dumps({"characters": CHARACTERS})}))
    with pytest.raises(EvnlosError, match="nothing vouches"):
        load_reader(path)


@pytest.fixture(scope="module")
def tiny_recorded(tiny_captures, tmp_path_factory):
    out = tmp_path_factory.mktemp("memory") / "recorded"
    sampling = Sampling(height=32, width=48, scored_rows=24, pitch_m=0.005)
    return import_captures(tiny_captures, out, sampling, test=("4",))


def stacked(images: torch.Tensor, samples: NlosDataset, dataset: Dataset) -> tuple[torch.Tensor, np.ndarray]:
    """Return what `compare_with_training` does, written out over one stack of all training objects."""
    rows, pitch_m = dataset.sampling.scored, dataset.sampling.pitch_m
    inputs, pictures = [], []
    for name in dataset.objects("train"):
        known = read_shard(dataset.shard(name))[0]
        step = [int(((known.position_m - at) ** 2).sum(axis=1).argmin()) for at in samples.position_m]
        away_px = (samples.position_m - known.position_m[step]) / pitch_m
        height, width = known.truth.shape[1:]
        y, x = np.mgrid[:height, :width]
        moved = [
            map_coordinates(np.pad(known.truth[k], 1), [y - dy + 1, x - dx + 1], order=1, mode="constant")
            for k, (dx, dy) in zip(step, away_px, strict=True)
        ]
        pictures.append(torch.from_numpy(np.stack(moved)).float()[:, rows])
        inputs.append(samples.modality.inputs(known.frame, known.surface)[step])
    known_inputs, seen = torch.stack(inputs).double(), samples.inputs.double()
    frame, events = known_inputs[:, :, :1], known_inputs[:, :, 1:]
    size = torch.stack([frame.std(unbiased=False), *[events.square().mean().sqrt()] * 2])[:, None, None]
    owner = (((known_inputs - seen) / size) ** 2).flatten(2).mean(dim=2).argmin(dim=0)
    nearest = torch.stack([pictures[int(g)][n] for n, g in enumerate(owner)])
    truth = samples.truth.float()[:, rows]
    closest = torch.stack([psnr(images, one) for one in pictures]).amax(dim=0)
    return nearest, (psnr(images, truth) > closest).numpy()


def test_comparing_object_by_object_is_comparing_with_the_stack_of_all(tiny, tmp_path, monkeypatch):
    """Motions differ from object to object, so that images are moved by parts of a pixel."""
    config = replace(tiny, validation=0.0, held_out="T", vary={"motion.speed_m_s": (0.015, 0.02)})
    dataset = simulate(config, tmp_path / "d")
    samples = NlosDataset(dataset, "test", "fusion")
    truth = samples.truth.float()[:, dataset.sampling.scored]
    images = (truth + 0.3 * torch.rand(truth.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)
    nearest, nearer = stacked(images, samples, dataset)
    for together in (3, 128):
        room = sys.modules[compare_with_training.__module__]  # the room gives the function
        monkeypatch.setattr(room, "_TOGETHER", together)
        found = compare_with_training(images, samples, dataset, "test")
        assert found is not None
        torch.testing.assert_close(found.nearest, nearest, rtol=0, atol=2e-3)
        np.testing.assert_array_equal(found.nearer_to_truth, nearer)
    assert 0 < nearer.mean() <= 1


def test_the_truth_is_nearest_to_itself_and_a_memory_to_none(tiny_recorded) -> None:
    samples = NlosDataset(tiny_recorded, "test", "fusion")
    truth = samples.truth.float()[:, tiny_recorded.sampling.scored].contiguous()
    found = compare_with_training(truth, samples, tiny_recorded, "test")
    assert found is not None and found.nearer_to_truth.all() and found.nearest.shape == truth.shape
    again = compare_with_training(found.nearest, samples, tiny_recorded, "test")
    assert again is not None and not again.nearer_to_truth.any()


def test_what_is_kept_for_the_next_network_is_of_its_split(tiny, tmp_path) -> None:
    """Also where all files are of one instant, as on file systems that count whole seconds."""
    dataset = simulate(tiny, tmp_path / "d")
    one, other, *rest = dataset.objects()
    dataset = replace(dataset, split={"train": rest, "validation": [one], "test": [other]})
    for name in dataset.objects():
        os.utime(dataset.shard(name), (1e9, 1e9))
    for _ in range(2):
        for split in ("test", "validation"):
            samples = NlosDataset(dataset, split, "fusion")
            truth = samples.truth.float()[:, dataset.sampling.scored].contiguous()
            found = compare_with_training(truth, samples, dataset, split)
            nearest, _ = stacked(truth, samples, dataset)
            assert found is not None
            torch.testing.assert_close(found.nearest, nearest, rtol=0, atol=2e-3)


def test_comparing_takes_memory_for_one_object_at_a_time(tmp_path) -> None:
    """Forty training objects instead of four: the peak of a process of its own grows by their numbers alone."""
    code = """
import resource, sys
import numpy as np
from pathlib import Path
from evnlos.data import Dataset, NlosDataset, Sampling, Samples, write_shard
from evnlos.analysis.evaluate import compare_with_training
folder, count = Path(sys.argv[1]), int(sys.argv[2])
draw = np.random.default_rng(0)
names = [f"o_{k:02d}" for k in range(count + 1)]
at = np.stack([np.linspace(-0.07, 0.07, 20), np.zeros(20)], axis=1)
for name in names:
    maps = (draw.random((20, 8, 10)) > 0.5).repeat(10, axis=1).repeat(16, axis=2).astype(np.float32)
    both = np.stack([maps, maps], axis=1)
    write_shard(folder / f"{name}.h5", Samples(maps, both, maps, at[:, 0], at, np.zeros(20, np.int64)), {})
sampling = Sampling(height=80, width=160, scored_rows=80)
data = Dataset(folder, "captures", sampling, {"train": names[1:], "test": names[:1]})
samples = NlosDataset(data, "test", "fusion")
images = samples.truth.float()
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
compare_with_training(images, samples, data, "test")
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    grown = []
    for count in (4, 40):
        (tmp_path / str(count)).mkdir()
        call = [sys.executable, "-c", code, tmp_path / str(count), str(count)]
        grown.append(int(subprocess.run(call, capture_output=True, text=True, check=True).stdout))
    stack_kb = 40 * 20 * 4 * 80 * 160 * 4 / 1024  # inputs and images of forty objects, float32
    assert grown[1] < grown[0] + stack_kb / 4, (grown, stack_kb)


def test_interval_covers_as_often_as_it_says() -> None:
    draw = np.random.default_rng(0)
    objects, covered = np.repeat(np.arange(30), 4), 0
    for seed in range(200):
        effect = np.repeat(draw.normal(0.5, 1.0, 30), 4) + draw.normal(0, 0.3, 120)
        base = draw.normal(18, 2, 120)
        found = paired_difference(base + effect, base, objects, draws=1000, seed=seed)
        covered += found.low <= 0.5 <= found.high
    assert 0.88 <= covered / 200 <= 0.98
    assert found == paired_difference(base + effect, base, objects, draws=1000, seed=199)


def test_interval_over_seeds_covers_what_other_seeds_would_give() -> None:
    """Seeds differ by 0.5, as much as objects do here: an interval of objects alone would cover far less."""
    draw, covered, plain = np.random.default_rng(1), 0, 0
    objects = np.arange(30)
    for seed in range(200):
        base = draw.normal(18, 2, 30)
        a = base + 0.5 + draw.normal(0, 1, 30) + draw.normal(0, 0.5, (5, 1))
        b = base + draw.normal(0, 0.5, (5, 1))
        found = paired_difference(a, b, objects, draws=500, seed=seed)
        alone = paired_difference(a.mean(axis=0), b.mean(axis=0), objects, draws=500, seed=seed)
        covered += found.low <= 0.5 <= found.high
        plain += alone.low <= 0.5 <= alone.high
    assert 0.88 <= covered / 200 <= 0.99
    assert plain / 200 < 0.8


def test_interval_draws_objects_not_images() -> None:
    objects = np.repeat([0, 1], 50)
    wide = paired_difference(np.repeat([1.0, 3.0], 50), np.zeros(100), objects)
    assert (wide.mean, wide.low, wide.high) == (2.0, 1.0, 3.0)
    with pytest.raises(EvnlosError, match="one object an image"):
        paired_difference([1.0, 2.0], [0.0, 0.0], [0])
