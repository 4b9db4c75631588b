"""What an older version wrote, this one reads, and it says the same: dataset, run, weights, setup, capture."""

import hashlib
import json
import shutil
from pathlib import Path

import pytest

from evnlos.cli import main
from evnlos.models import load_weights, published
from keep_version import UPGRADE, answers

VERSIONS = sorted(path for path in UPGRADE.iterdir() if path.is_dir())


@pytest.fixture(params=VERSIONS, ids=lambda path: path.name)
def version(request, tmp_path) -> Path:
    return shutil.copytree(request.param, tmp_path / "of before")  # nothing is written into what is kept


def test_there_are_files_of_a_version() -> None:
    assert VERSIONS


def test_files_of_a_version_say_what_they_said_then(version) -> None:
    stated, now = json.loads((version / "answers.json").read_text()), answers(version)
    assert stated.keys() == now.keys()
    for name in stated.keys() - {"psnr_db"}:
        assert now[name] == stated[name], name
    assert now["psnr_db"] == pytest.approx(stated["psnr_db"], abs=0.2)  # of another processor


def test_work_goes_on_with_files_of_a_version(version, tmp_path, capsys) -> None:
    main(["verify", str(version / "dataset")])
    assert "all whole" in capsys.readouterr().out
    run, again = str(version / "run"), str(tmp_path / "again")
    main(["finetune", "--weights", run, "--data", str(version / "dataset"), "--out", again, "--epochs", "1"])
    capsys.readouterr()
    main(["weights", again, "--json"])
    assert json.loads(capsys.readouterr().out)


def test_published_weights_of_a_version_reconstruct(version, tmp_path, monkeypatch, capsys) -> None:
    folder = tmp_path / "published"
    folder.mkdir()
    file = shutil.copy(version / "run" / "weights.safetensors", folder / "old-frame.safetensors")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    (folder / "SHA256SUMS").write_text(f"{digest}  {file.name}\n")
    monkeypatch.setenv("EVNLOS_WEIGHTS", str(folder))
    assert published()["old-frame"] == file
    assert load_weights("old-frame").sampling == load_weights(version / "run").sampling
    main(["weights", "old-frame", "--json"])
    assert json.loads(capsys.readouterr().out)


def test_a_file_that_is_damaged_is_noticed(version, capsys) -> None:
    shard = next((version / "dataset").glob("*.h5"))
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 0xFF
    shard.write_bytes(bytes(content))
    with pytest.raises(SystemExit):
        main(["verify", str(version / "dataset")])
