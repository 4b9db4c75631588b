"""Reading characters, telling memory from sight, and intervals for differences."""

import numpy as np
import pytest
import torch

from evnlos import EvnlosError
from evnlos.dataset import NlosDataset, Sampling, import_captures, open_dataset
from evnlos.evaluation.classifier import CHARACTERS, load_reader, read_characters
from evnlos.evaluation.classifier_training import train_reader
from evnlos.evaluation.intervals import paired_difference
from evnlos.evaluation.memory import Memory, nearer_to_truth, nearest_answer, recall
from evnlos.model import plates
from evnlos.scene import FontGlyphs, find_font
from evnlos.types import Plane

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
    found, elsewhere = (read_characters(plates(pictures, CANVAS, where)) for where in (places, -places))
    return [name[-1] for name in names], found, elsewhere


def share(truth: list[str], found: list[str]) -> float:
    return float(np.mean([a == b for a, b in zip(truth, found, strict=True)]))


def test_the_reader_reads_plates_wherever_they_are() -> None:
    truth, found, elsewhere = read_all("Kalam Bold")
    assert share(truth, found) >= 0.94  # O and 0 of one typeface, and the like
    assert share(truth, elsewhere) < 0.5


def test_the_reader_reads_a_typeface_that_it_never_saw() -> None:
    if find_font("Comic Neue Bold").note:
        pytest.skip("Comic Neue is not installed (Debian package fonts-comic-neue)")
    truth, found, _ = read_all("Comic Neue Bold")
    assert share(truth, found) >= 0.85  # 32 of 36 when it was trained


def test_training_a_reader_repeats_itself_and_learns() -> None:
    (first, about), (second, _) = (train_reader(writers=2, epochs=2, families=("Kalam",)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))
    assert about["accuracy_clean"] > 3 / len(CHARACTERS)


def test_a_file_of_something_else_is_refused(tmp_path) -> None:
    path = tmp_path / "r.safetensors"
    path.write_bytes(b"nonsense")
    with pytest.raises(EvnlosError, match="no character reader"):
        load_reader(path)


@pytest.fixture(scope="module")
def tiny_shots(tiny_captures, tmp_path_factory):
    out = tmp_path_factory.mktemp("memory") / "shots"
    sampling = Sampling(height=32, width=48, scored_rows=24, pitch_m=0.005)
    list(import_captures(tiny_captures, out, sampling, test=("4",)))
    return open_dataset(out)


def test_memory_lies_at_the_place_of_the_test_picture(tiny_shots) -> None:
    memory = recall(tiny_shots, "test", "fusion")
    assert memory is not None
    samples = NlosDataset(tiny_shots, "test", "fusion")
    trained = NlosDataset(tiny_shots, "train", "fusion")
    assert memory.truth.shape == (len(memory.names), *samples.truth.shape)
    # The same motion in every capture: nothing is left to move.
    first = trained.truth[trained.names == memory.names[0]].float()
    assert torch.allclose(memory.truth[0], first, atol=1e-3)
    answers = nearest_answer(memory, samples.inputs)
    assert answers.shape == samples.truth.shape
    assert not nearer_to_truth(answers, samples.truth.float(), memory.truth).any()
    assert nearer_to_truth(samples.truth.float(), samples.truth.float(), memory.truth).all()


def test_the_nearest_measurement_answers() -> None:
    inputs = torch.stack([torch.zeros(3, 1, 4, 4), torch.ones(3, 1, 4, 4)])
    truth = torch.stack([torch.full((3, 4, 4), 0.25), torch.full((3, 4, 4), 0.75)])
    asked = torch.tensor([0.1, 0.9, 0.4]).reshape(3, 1, 1, 1).expand(3, 1, 4, 4)
    answers = nearest_answer(Memory(["a", "b"], inputs, truth), asked)
    assert answers[:, 0, 0].tolist() == [0.25, 0.75, 0.25]


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


def test_interval_draws_objects_not_pictures() -> None:
    objects = np.repeat([0, 1], 50)
    wide = paired_difference(np.repeat([1.0, 3.0], 50), np.zeros(100), objects)
    assert (wide.mean, wide.low, wide.high) == (2.0, 1.0, 3.0)
    with pytest.raises(EvnlosError, match="one object a picture"):
        paired_difference([1.0, 2.0], [0.0, 0.0], [0])
