"""Versions come from git tags, and what is released is checked: tools/distributions.py, on small checkouts."""

import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
pytestmark = pytest.mark.skipif(
    shutil.which("git") is None or importlib.util.find_spec("setuptools_scm") is None,
    reason="git and setuptools-scm are needed",
)


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("distributions", ROOT / "tools" / "distributions.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def git(folder: Path, *words: str) -> None:
    who = {f"GIT_{one}_{what}": "a@b.invalid" for one in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    alone = {"GIT_CONFIG_GLOBAL": os.devnull, "GIT_CONFIG_SYSTEM": os.devnull}
    subprocess.run(["git", *words], cwd=folder, check=True, capture_output=True, env=os.environ | who | alone)


@pytest.fixture
def checkout(tmp_path) -> Path:
    folder = tmp_path / "checkout"
    folder.mkdir()
    shutil.copy(ROOT / "pyproject.toml", folder)
    (folder / "CHANGELOG.md").write_text("# Changelog\n\n## 1.2.3, 2026-01-31\n- New.\n")
    (folder / "CITATION.cff").write_text("version: 1.2.3\n")
    kept = folder / "tests" / "upgrade" / "1.2.3" / "answers.json"
    kept.parent.mkdir(parents=True)
    kept.write_text("{}")
    git(folder, "init", "-q")
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "first")
    return folder


def test_the_version_is_that_of_the_tag(tool, checkout, tmp_path) -> None:
    assert ".dev1+" in tool.version_of(checkout)  # without tags
    git(checkout, "tag", "v1.2.3")
    assert tool.version_of(checkout) == "1.2.3"
    git(checkout, "commit", "-q", "--allow-empty", "-m", "second")
    assert tool.version_of(checkout).startswith("1.2.4.dev1+")
    git(checkout, "commit", "-q", "--allow-empty", "-m", "third")
    shallow = tmp_path / "shallow"
    git(tmp_path, "clone", "-q", "--depth", "1", checkout.as_uri(), str(shallow))
    assert ".dev" in tool.version_of(shallow)
    shutil.rmtree(checkout / ".git")
    assert tool.version_of(checkout) == "0.1.0.dev0"


def test_a_release_is_clean_tagged_and_described(tool, checkout) -> None:
    git(checkout, "tag", "v1.2.3")
    assert tool.release_faults(checkout, "1.2.3") == []
    assert "no release" in tool.release_faults(checkout, "1.2.4.dev1+gabc")[0]
    assert len(tool.release_faults(checkout, "1.2.4")) == 3  # changelog, citation, files to upgrade from
    (checkout / "CITATION.cff").write_text("version: 1.2.2\n")
    faults = " ".join(tool.release_faults(checkout, "1.2.3"))
    assert "not committed" in faults and "CITATION.cff" in faults and "CHANGELOG" not in faults


def test_an_sdist_carries_its_version_and_no_weights(tool, tmp_path, monkeypatch) -> None:
    sdist, wheel = tool.build_core(tmp_path, "9.8.7")  # the wheel is built from the sdist, where no git is
    assert (sdist.name, wheel.name) == ("evnlos-9.8.7.tar.gz", "evnlos-9.8.7-py3-none-any.whl")
    tool.check_core(sdist, wheel, "9.8.7")
    with pytest.raises(SystemExit, match=r"Version: 9\.8\.7 where 9\.8\.8"):
        tool.check_core(sdist, wheel, "9.8.8")
    with monkeypatch.context() as limits, pytest.raises(SystemExit, match=r"MB; at most 0\.001$"):
        limits.setattr(tool, "MOST_BYTES", 1000)
        tool.check_core(sdist, wheel, "9.8.7")
    tool.write_sums(tmp_path)
    listed = dict(reversed(line.split()) for line in (tmp_path / "SHA256SUMS").read_text().splitlines())
    assert listed.keys() == {sdist.name, wheel.name}
    assert listed[wheel.name] == hashlib.sha256(wheel.read_bytes()).hexdigest()


METADATA = "evnlos_weights-0.1.0.dist-info/METADATA"


def test_weights_are_those_of_their_sums(tool, tmp_path, monkeypatch) -> None:
    wheel, content = tmp_path / "w.whl", {"near-frame.safetensors": b"weights", "near.yaml": b"kind: paper"}
    content |= {"near/setup.yaml": b"kind: fitted", "near/wall.safetensors": b"wall"}
    told = "Metadata-Version: 2.4\nName: evnlos-weights\nVersion: 0.1.0\nLicense-Expression: MIT\n"
    for total, is_right in ((hashlib.sha256(b"weights").hexdigest(), True), ("0" * 64, False)):
        with zipfile.ZipFile(wheel, "w") as archive:
            for name, data in content.items():
                archive.writestr(f"evnlos_weights/{name}", data)
            archive.writestr("evnlos_weights/SHA256SUMS", f"{total}  near-frame.safetensors\n")
            archive.writestr(METADATA, told)
        if is_right:
            tool.check_weights(wheel)
            with monkeypatch.context() as limits, pytest.raises(SystemExit, match="MB; at most 0"):
                limits.setattr(tool, "MOST_BYTES_OF_WEIGHTS", 100)
                tool.check_weights(wheel)
        else:
            with pytest.raises(SystemExit, match="not the file"):
                tool.check_weights(wheel)
    for right, wrong in (("0.1.0", "0.0.9"), ("evnlos-weights", "weights"), ("MIT", "GPL")):
        with zipfile.ZipFile(wheel, "w") as archive:
            for name, data in content.items():
                archive.writestr(f"evnlos_weights/{name}", data)
            archive.writestr("evnlos_weights/SHA256SUMS", "")
            archive.writestr(METADATA, told.replace(right, wrong))
        with pytest.raises(SystemExit, match=f"{wrong} where {right} is right"):
            tool.check_weights(wheel)


def test_files_to_upgrade_from_need_a_version() -> None:
    call = [sys.executable, str(ROOT / "tests" / "keep_version.py"), "0.2"]
    done = subprocess.run(call, capture_output=True, text=True)
    assert done.returncode == 1 and "e.g. 0.2.0" in done.stderr
