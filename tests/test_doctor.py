"""The habits of the ecosystem: what is missing is named with its cure, and what was used can be cited."""

import json
import re
import tempfile
from pathlib import Path

import h5py
import pytest

from evnlos.cli import main
from evnlos.cli.about import ENTRIES, entries_for
from evnlos.config import save_yaml
from evnlos.data import Simulation
from evnlos.errors import DataError
from evnlos.setups import RadiometricSetup


def test_this_installation_is_whole(capsys) -> None:
    main(["doctor", "--json"])
    parts = {part["name"]: part for part in json.loads(capsys.readouterr().out)["parts"]}
    assert all(part["there"] for part in parts.values() if part["needed"])
    assert {"python", "torch", "numba", "hdf5", "fonts", "disk", "[aedat]", "[plot]"} <= set(parts)
    assert all(bool(part["cure"]) != part["there"] for part in parts.values())


def test_a_broken_part_is_named_and_the_exit_code_tells(monkeypatch, capsys) -> None:
    def full(dir: Path) -> None:
        raise OSError(28, "No space left on device", str(dir))

    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda _: False)
    monkeypatch.setattr(tempfile, "NamedTemporaryFile", full)
    with pytest.raises(SystemExit) as stop:
        main(["doctor"])
    shown = capsys.readouterr().out
    assert stop.value.code == 1
    assert re.search("^! BROKEN  hdf5: .*, checksums missing; reinstall h5py", shown, re.MULTILINE)
    assert "- without numba" in shown and "NUMBA_CACHE_DIR" in shown


def test_what_is_cited_is_what_was_used(tmp_path, capsys) -> None:
    save_yaml(Simulation(), tmp_path / "paper.yaml")
    save_yaml(Simulation(setup=RadiometricSetup()), tmp_path / "metal.yaml")
    save_yaml(Simulation(setup=RadiometricSetup(wall_material="lambert")), tmp_path / "matte.yaml")
    common = {"evnlos", "epnp", "event pixel", "time surface"}
    assert set(entries_for(tmp_path / "paper.yaml")) == common | {"angular spectrum"}
    assert set(entries_for(tmp_path / "metal.yaml")) == common | {"rough metal"}
    assert set(entries_for(tmp_path / "matte.yaml")) == common
    (tmp_path / "run").mkdir()
    save_yaml({"settings": {}, "data": {}}, tmp_path / "run" / "run.yaml")
    assert {"network", "optimiser", "ssim"} <= set(entries_for(tmp_path / "run"))
    with pytest.raises(DataError, match="no settings file"):
        entries_for(tmp_path / "nothing")
    main(["cite"])
    shown = capsys.readouterr().out
    assert all(text in shown for text in ENTRIES.values())


def test_the_entries_are_bibtex() -> None:
    keys = []
    for text in ENTRIES.values():
        for entry in text.split("\n\n"):
            found = re.match(r"@(\w+)\{(\w+),\n", entry)
            assert found and entry.endswith("\n}") and entry.count("{") == entry.count("}")
            keys.append(found[2])
    assert len(set(keys)) == len(keys)
