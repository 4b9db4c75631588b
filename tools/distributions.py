"""Build what users install, look at what is in it, and make an environment of what the package declares.

    python tools/distributions.py --out dist                                # sdist, wheel, wheel of the weights
    python tools/distributions.py --out dist --release                      # the same, of a commit with a tag
    python tools/distributions.py --out build/declared/dist --environment build/declared/venv

The version is that of the git tag. The wheel is built from the sdist, so that it shows what the sdist lacks.
Sizes, names, metadata and the sums of the weights are checked, and SHA256SUMS is written beside the files. A
release also needs a clean checkout with a tag, a dated heading in the changelog, the version in CITATION.cff
and files of that version in tests/upgrade.

An environment is a fresh virtual one that holds the wheels and what their dependencies name, with what these
name in turn; nothing of an extra, nothing of development. The packages are those of the Python that runs this,
linked file by file, without an index.
"""

from __future__ import annotations

import argparse
import email
import email.message
import hashlib
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import venv
import zipfile
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
WEIGHTS = ROOT / "packages" / "evnlos-weights"
MOST_BYTES = 10_000_000
MOST_BYTES_OF_WEIGHTS = 100_000_000  # about the most that package indexes take in a file
IN_WHEEL = (
    "evnlos/py.typed",
    "evnlos/__init__.pyi",
    "evnlos/live/page.html",
    "evnlos/app/page.css",
    "evnlos/app/page.js",
    "evnlos/app/opening.js",
    "evnlos/report/style.css",
    "evnlos/analysis/classifier.safetensors",
)
IN_WEIGHTS = tuple(
    f"evnlos_weights/{name}"
    for name in (
        "SHA256SUMS",
        "near-frame.safetensors",
        "near.yaml",
        "near/setup.yaml",
        "near/wall.safetensors",
    )
)
READER = "analysis/classifier.safetensors"  # reads characters for a score; what is published lies elsewhere
BUILD = "import sys, setuptools.build_meta as backend; print(getattr(backend, sys.argv[1])(sys.argv[2]))"


def version_of(source: Path) -> str:
    """Return the version that the git tags of a checkout give, as setuptools-scm does."""
    call = [
        sys.executable,
        "-m",
        "setuptools_scm",
        "--root",
        str(source),
        "--config",
        str(source / "pyproject.toml"),
    ]
    done = subprocess.run(call, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{done.stderr}\n{source} has no version; pip install setuptools-scm")
    return done.stdout.split()[-1]


def release_faults(source: Path, version: str) -> list[str]:
    """Return what keeps a checkout from being released; nothing where all is there."""
    if re.fullmatch(r"\d+\.\d+\.\d+", version) is None:
        return [f"{version} is no release; commit all changes and tag the commit, e.g. git tag v0.2.0"]
    changed = subprocess.run(["git", "status", "--porcelain"], cwd=source, capture_output=True, text=True)
    heading = re.compile(rf"^## {re.escape(version)}, \d{{4}}-\d\d-\d\d$", re.MULTILINE)
    stated = re.compile(rf"^version: {re.escape(version)}$", re.MULTILINE)
    faults = {
        "the checkout has changes that are not committed": bool(changed.returncode or changed.stdout.strip()),
        f"CHANGELOG.md has no heading '## {version}, YYYY-MM-DD'": not heading.search(
            (source / "CHANGELOG.md").read_text(encoding="utf-8")
        ),
        f"CITATION.cff does not say 'version: {version}'": not stated.search(
            (source / "CITATION.cff").read_text(encoding="utf-8")
        ),
        f"tests/upgrade/{version} is missing: python tests/keep_version.py {version}": not (
            source / "tests" / "upgrade" / version / "answers.json"
        ).exists(),
    }
    return [text for text, is_wrong in faults.items() if is_wrong]


def built(kind: str, source: Path, out: Path, version: str = "") -> Path:
    """Return the sdist or wheel of a project's folder, made by its own backend without another environment."""
    call = [sys.executable, "-c", BUILD, f"build_{kind}", str(out.resolve())]
    known = {"SETUPTOOLS_SCM_PRETEND_VERSION_FOR_EVNLOS": version} if version else {}
    done = subprocess.run(call, cwd=source, capture_output=True, text=True, env=os.environ | known)
    if done.returncode:
        raise SystemExit(f"{done.stdout}{done.stderr}\n{source} gives no {kind}")
    return out / done.stdout.split()[-1]


def build_core(out: Path, version: str) -> tuple[Path, Path]:
    """Return the sdist, and the wheel that is built from it."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"  # what is built leaves nothing in the checkout
        ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
        shutil.copytree(ROOT / "src", copy / "src", ignore=ignored)
        for name in ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff"):
            shutil.copy2(ROOT / name, copy)
        sdist = built("sdist", copy, out, version)
        with tarfile.open(sdist) as archive:
            archive.extractall(folder, filter="data")
        return sdist, built("wheel", Path(folder) / sdist.name.removesuffix(".tar.gz"), out)


def check_core(sdist: Path, wheel: Path, version: str) -> None:
    """Raise where a file is lost, weights came along, the wheel is too large, or metadata is wrong."""
    with tarfile.open(sdist) as archive:
        names = archive.getnames()
        held = archive.extractfile(f"{sdist.name.removesuffix('.tar.gz')}/PKG-INFO")
        stated = [email.message_from_bytes(held.read() if held else b"")]
    check_metadata([*stated, metadata_of(wheel)], "evnlos", version)
    weights = [name for name in names if name.endswith(".safetensors") and not name.endswith(READER)]
    if weights:
        raise SystemExit(f"{sdist.name} holds weights: {', '.join(weights)}")
    modules = [one for one in (ROOT / "src" / "evnlos").rglob("*.py*") if one.suffix in (".py", ".pyi")]
    check_names(wheel, (*IN_WHEEL, *(one.relative_to(ROOT / "src").as_posix() for one in modules)))
    check_size(wheel, MOST_BYTES)


def metadata_of(wheel: Path) -> email.message.Message:
    """Return what a wheel says of itself."""
    with zipfile.ZipFile(wheel) as archive:
        metadata = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return email.message_from_bytes(archive.read(metadata))


def check_metadata(stated: list[email.message.Message], name: str, version: str) -> None:
    """Raise where name, version or licence are wrong."""
    for key, wanted in {"Name": name, "Version": version, "License-Expression": "MIT"}.items():
        if found := [one[key] for one in stated if one[key] != wanted]:
            raise SystemExit(f"the metadata says {key}: {found[0]} where {wanted} is right")


def check_size(wheel: Path, most: int) -> None:
    """Raise where a wheel is too large."""
    if wheel.stat().st_size >= most:
        raise SystemExit(f"{wheel.name} has {wheel.stat().st_size / 1e6:.1f} MB; at most {most / 1e6:g}")


def check_names(wheel: Path, wanted: tuple[str, ...]) -> None:
    """Raise where a wheel lacks files."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    if lost := [name for name in wanted if name not in names]:
        raise SystemExit(f"{wheel.name} lacks {', '.join(lost)}")


def check_weights(wheel: Path) -> None:
    """Raise where a wheel of weights is too large, lacks files, or has wrong metadata or sums."""
    check_names(wheel, IN_WEIGHTS)
    project = tomllib.loads((WEIGHTS / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    check_metadata([metadata_of(wheel)], project["name"], project["version"])
    check_size(wheel, MOST_BYTES_OF_WEIGHTS)
    with zipfile.ZipFile(wheel) as archive:
        for line in archive.read("evnlos_weights/SHA256SUMS").decode().splitlines():
            total, name = line.split()
            if hashlib.sha256(archive.read(f"evnlos_weights/{name}")).hexdigest() != total:
                raise SystemExit(f"{name} in {wheel.name} is not the file that its SHA256SUMS lists")


def write_sums(folder: Path) -> None:
    """Write SHA256SUMS of the files of a folder, as `sha256sum --check` reads it."""
    lines = [
        f"{hashlib.sha256(one.read_bytes()).hexdigest()}  {one.name}\n" for one in sorted(folder.iterdir())
    ]
    (folder / "SHA256SUMS").write_text("".join(lines), encoding="utf-8")


def closure(requirements: list[str]) -> dict[str, importlib.metadata.Distribution]:
    """Return the installed distributions that requirements name, with what these require in turn."""
    found: dict[str, importlib.metadata.Distribution] = {}
    looked: set[tuple[str, str]] = set()
    to_do = [Requirement(one) for one in requirements]
    while to_do:
        one = to_do.pop()
        if one.marker is not None and not one.marker.evaluate({"extra": ""}):
            continue
        name = canonicalize_name(one.name)
        for extra in ("", *one.extras):
            if (name, extra) in looked:
                continue
            looked.add((name, extra))
            found[name] = importlib.metadata.distribution(name)
            for text in found[name].requires or ():
                inner = Requirement(text)
                if inner.marker is None or inner.marker.evaluate({"extra": extra}):
                    inner.marker = None
                    to_do.append(inner)
    return found


def make_environment(wheel: Path, folder: Path, *others: Path) -> list[str]:
    """Make the environment anew, install the wheel and what needs only it, return what else is there."""
    shutil.rmtree(folder, ignore_errors=True)
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin" / "python"
    ask = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(subprocess.check_output([python, "-c", ask], text=True).strip())
    metadata = importlib.metadata.Distribution.at  # the METADATA of the wheel decides, not the checkout's
    with tempfile.TemporaryDirectory() as unpacked, zipfile.ZipFile(wheel) as archive:
        archive.extractall(unpacked, [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")])
        declared = metadata(next(Path(unpacked).glob("*.dist-info"))).requires or []
    needed = closure(declared)
    for one in needed.values():
        for file in one.files or ():
            if ".." in file.parts:
                continue  # a program beside the packages
            target = site / file
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(file.locate(), target)
            except FileNotFoundError:
                continue  # named, but never made: compiled files of other versions
            except OSError:
                shutil.copy2(file.locate(), target)
    pip = [sys.executable, "-m", "pip", "--python", str(python), "--disable-pip-version-check"]
    install = ["install", "--quiet", "--no-index", "--no-deps", "--no-compile", wheel, *others]
    subprocess.run([*pip, *install], check=True)
    subprocess.run([*pip, "check"], check=True)
    _take_compiled(site)
    return sorted(f"{name} {one.version}" for name, one in needed.items())


def _take_compiled(site: Path) -> None:
    """Take along what numba has compiled of the same sources in the checkout; it costs a minute otherwise."""
    for source in (ROOT / "src" / "evnlos").rglob("*.py"):
        copy = site / source.relative_to(ROOT / "src")
        os.utime(copy, ns=(source.stat().st_atime_ns, source.stat().st_mtime_ns))  # by which numba knows it
        for compiled in source.parent.glob(f"__pycache__/{source.stem}.*.nb[ci]"):
            (copy.parent / "__pycache__").mkdir(exist_ok=True)
            shutil.copy2(compiled, copy.parent / "__pycache__")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of what is built, made anew")
    parser.add_argument("--core", action="store_true", help="the package alone, without its weights")
    parser.add_argument("--release", action="store_true", help="refuse what is no release")
    parser.add_argument("--environment", type=Path, help="folder of the environment, made anew")
    asked = parser.parse_args()
    version = version_of(ROOT)
    if asked.release and (faults := release_faults(ROOT, version)):
        raise SystemExit("no release: " + "; ".join(faults))
    shutil.rmtree(asked.out, ignore_errors=True)
    asked.out.mkdir(parents=True)
    sdist, wheel = build_core(asked.out, version)
    check_core(sdist, wheel, version)
    others = []
    if not asked.core:
        with tempfile.TemporaryDirectory() as folder:
            copy = shutil.copytree(WEIGHTS, Path(folder) / "weights")
            others.append(built("wheel", copy, asked.out))
        check_weights(others[0])
    write_sums(asked.out)
    for one in sorted(asked.out.iterdir()):
        print(f"{one}: {one.stat().st_size / 1e6:.2f} MB")
    if asked.environment is not None:
        print(f"{asked.environment}: {', '.join(make_environment(wheel, asked.environment, *others))}")


if __name__ == "__main__":
    main()
