"""Build what users install, look at what is in it, and make an environment of what the package declares.

    python tools/distributions.py --out dist                                # sdist, wheel, wheel of the weights
    python tools/distributions.py --out build/declared/dist --core --environment build/declared/venv

The wheel is built from the sdist, so that it shows what the sdist lacks. An environment is a fresh virtual one
that holds the wheel and what its dependencies name, with what these name in turn; nothing of an extra, nothing
of development. The packages are those of the Python that runs this, linked file by file: no index is asked.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
import zipfile
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
WEIGHTS = ROOT / "packages" / "evnlos-weights"
MOST_BYTES = 10_000_000
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
IN_WEIGHTS = tuple(f"evnlos_weights/{name}" for name in ("SHA256SUMS", "near-frame.safetensors", "near.yaml"))
READER = "analysis/classifier.safetensors"  # reads characters for a score; what is published lies elsewhere
BUILD = "import sys, setuptools.build_meta as backend; print(getattr(backend, sys.argv[1])(sys.argv[2]))"


def built(kind: str, source: Path, out: Path) -> Path:
    """Return the sdist or wheel of a project's folder, made by its own backend without another environment."""
    call = [sys.executable, "-c", BUILD, f"build_{kind}", str(out.resolve())]
    done = subprocess.run(call, cwd=source, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{done.stdout}{done.stderr}\n{source} gives no {kind}")
    return out / done.stdout.split()[-1]


def build_core(out: Path) -> tuple[Path, Path]:
    """Return the sdist, and the wheel that is built from it."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"  # what is built leaves nothing in the checkout
        ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
        shutil.copytree(ROOT / "src", copy / "src", ignore=ignored)
        for name in ("pyproject.toml", "README.md", "LICENSE"):
            shutil.copy2(ROOT / name, copy)
        sdist = built("sdist", copy, out)
        with tarfile.open(sdist) as archive:
            archive.extractall(folder, filter="data")
        return sdist, built("wheel", Path(folder) / sdist.name.removesuffix(".tar.gz"), out)


def check_core(sdist: Path, wheel: Path) -> None:
    """Raise where a file is lost, published weights came along, or the wheel is too large."""
    with tarfile.open(sdist) as archive:
        names = archive.getnames()
    weights = [name for name in names if name.endswith(".safetensors") and not name.endswith(READER)]
    if weights:
        raise SystemExit(f"{sdist.name} holds weights: {', '.join(weights)}")
    modules = [one for one in (ROOT / "src" / "evnlos").rglob("*.py*") if one.suffix in (".py", ".pyi")]
    check_names(wheel, (*IN_WHEEL, *(one.relative_to(ROOT / "src").as_posix() for one in modules)))
    if wheel.stat().st_size >= MOST_BYTES:
        raise SystemExit(f"{wheel.name} has {wheel.stat().st_size / 1e6:.1f} MB; at most {MOST_BYTES / 1e6:g}")


def check_names(wheel: Path, wanted: tuple[str, ...]) -> None:
    """Raise where a wheel lacks files."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    if lost := [name for name in wanted if name not in names]:
        raise SystemExit(f"{wheel.name} lacks {', '.join(lost)}")


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


def make_environment(wheel: Path, folder: Path) -> list[str]:
    """Make the environment anew, install the wheel, and return what else is in it."""
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
    subprocess.run([*pip, "install", "--quiet", "--no-index", "--no-deps", "--no-compile", wheel], check=True)
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
    parser.add_argument("--environment", type=Path, help="folder of the environment, made anew")
    asked = parser.parse_args()
    shutil.rmtree(asked.out, ignore_errors=True)
    asked.out.mkdir(parents=True)
    sdist, wheel = build_core(asked.out)
    check_core(sdist, wheel)
    if not asked.core:
        with tempfile.TemporaryDirectory() as folder:
            copy = shutil.copytree(WEIGHTS, Path(folder) / "weights")
            check_names(built("wheel", copy, asked.out), IN_WEIGHTS)
    for one in sorted(asked.out.iterdir()):
        print(f"{one}: {one.stat().st_size / 1e6:.2f} MB")
    if asked.environment is not None:
        print(f"{asked.environment}: {', '.join(make_environment(wheel, asked.environment))}")


if __name__ == "__main__":
    main()
