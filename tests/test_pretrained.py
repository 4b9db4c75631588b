"""Where pretrained networks are found: a folder of the user, an installed distribution; else one line."""

import hashlib
import shutil
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from evnlos.errors import ConfigError, DataError
from evnlos.models import load_weights, published, published_for, published_setup
from evnlos.setups import load_setup

ROOT = Path(__file__).resolve().parent.parent
DISTRIBUTION = ROOT / "packages" / "evnlos-weights"
FILES = DISTRIBUTION / "src" / "evnlos_weights"
NAME = "page-frame-sequence"


@pytest.fixture
def nothing_installed(monkeypatch):
    """As on a machine without the weights: no entry point, no checkout, no variable."""
    import sys

    module = sys.modules["evnlos.models.weights"]
    monkeypatch.setattr(module, "_CHECKOUT", Path("none"))
    monkeypatch.setattr(module, "entry_points", lambda group: [])
    monkeypatch.delenv("EVNLOS_WEIGHTS", raising=False)
    return module


def test_every_file_of_the_distribution_is_the_one_that_its_list_names() -> None:
    lines = (FILES / "SHA256SUMS").read_text().splitlines()
    stated = {name: digest for digest, name in (line.split() for line in lines)}
    there = {path.name: path for path in FILES.glob("*.safetensors")}
    assert set(stated) == set(there) and {path.stem for path in there.values()} == set(published())
    for name, path in there.items():
        assert hashlib.sha256(path.read_bytes()).hexdigest() == stated[name]


@pytest.mark.parametrize("setup", ["near", "far"])
def test_weights_of_sequences_bring_the_setup_that_they_see_through(setup) -> None:
    """Whole, and without what one sensor's captures showed of its errors: the next sensor has others."""
    for modality in ("frame", "event", "fusion"):
        assert load_weights(f"{setup}-{modality}-sequence").sampling.setup == str(FILES / setup)
    assert load_setup(str(FILES / setup)).is_linear
    assert sorted(path.name for path in (FILES / setup).iterdir()) == ["setup.yaml", "wall.safetensors"]


def test_the_core_holds_no_weights_and_stays_small() -> None:
    files = [path for path in (ROOT / "src").rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    assert sum(path.stat().st_size for path in files) < 10e6  # a wheel is no larger than its files
    assert [path.name for path in files if path.suffix == ".safetensors"] == ["classifier.safetensors"]
    assert "weights" not in " ".join(
        tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    )
    about = tomllib.loads((DISTRIBUTION / "pyproject.toml").read_text())
    assert about["project"]["entry-points"]["evnlos.weights"] == {"published": "evnlos_weights"}
    assert "dependencies" not in about["project"]


def test_a_folder_in_the_variable_comes_before_what_is_installed(tmp_path, monkeypatch) -> None:
    other = published()["page-event-sequence"]
    shutil.copy(other, tmp_path / f"{NAME}.safetensors")
    (tmp_path / "SHA256SUMS").write_text(
        f"{hashlib.sha256(other.read_bytes()).hexdigest()}  {NAME}.safetensors\n"
    )
    monkeypatch.setenv("EVNLOS_WEIGHTS", str(tmp_path))
    assert published()[NAME] == tmp_path / f"{NAME}.safetensors"
    assert load_weights(NAME).modality.name == "event"
    assert published_setup("near-frame") == FILES / "near.yaml"
    (tmp_path / "SHA256SUMS").write_text(f"{'0' * 64}  {NAME}.safetensors\n")
    with pytest.raises(DataError, match="SHA-256 is not the one in SHA256SUMS"):
        load_weights(NAME)
    monkeypatch.setenv("EVNLOS_WEIGHTS", str(tmp_path / "none"))
    with pytest.raises(ConfigError, match="which is no folder"):
        published()


def test_a_sealed_file_has_to_be_the_one_that_is_stated_too(tmp_path, monkeypatch) -> None:
    """Another network's file fits its own digest under any name."""
    shutil.copy(FILES / "far-event-sequence.safetensors", tmp_path / "near-event-sequence.safetensors")
    monkeypatch.setenv("EVNLOS_WEIGHTS", str(tmp_path))
    assert load_weights("near-event-sequence").is_sealed  # none is stated
    shutil.copy(FILES / "SHA256SUMS", tmp_path)
    with pytest.raises(DataError, match="SHA-256 is not the one in SHA256SUMS"):
        load_weights("near-event-sequence")


def test_an_installed_distribution_is_found_by_its_entry_point(nothing_installed, monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(FILES.parent))
    point = EntryPoint("published", "evnlos_weights", "evnlos.weights")
    monkeypatch.setattr(
        nothing_installed, "entry_points", lambda group: [point] if group == point.group else []
    )
    assert published()["near-frame"] == FILES / "near-frame.safetensors"
    assert load_weights(NAME).network.sees_sequence
    lost = EntryPoint("published", "evnlos_no_such_package", "evnlos.weights")
    monkeypatch.setattr(nothing_installed, "entry_points", lambda group: [lost])
    with pytest.raises(ConfigError, match="evnlos_no_such_package can't be imported"):
        published()


def test_without_weights_one_line_names_all_ways(nothing_installed) -> None:
    assert published() == {}
    for ask in (lambda: load_weights(NAME), lambda: published_for(0.3, "frame", is_motion_known=True)):
        with pytest.raises(DataError) as caught:
            ask()
        text = str(caught.value)
        assert all(
            way in text for way in ("a weights file", "a run", "install evnlos-weights", "EVNLOS_WEIGHTS")
        )
        assert "\n" not in text


def test_weights_under_their_names_of_before_load(tmp_path, monkeypatch) -> None:
    file = tmp_path / "page-frame-pass.safetensors"
    shutil.copy(FILES / f"{NAME}.safetensors", file)
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    (tmp_path / "SHA256SUMS").write_text(f"{digest}  {file.name}\n")
    monkeypatch.setenv("EVNLOS_WEIGHTS", str(tmp_path))
    assert published()[NAME].parent == tmp_path
    assert load_weights("page-frame-pass").network.sees_sequence
