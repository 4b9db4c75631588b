"""Hostile inputs of many kinds: settings, YAML, captures, images, NPZ, HDF5, weights, packets, uploads.

    python tests/fuzz_inputs.py --count 2400 --seed 1
    python tests/fuzz_inputs.py --guided 300 --seed 1     # seconds; keeps what reaches new branches

Each input is made by a seeded generator, read as its kind is, and has to end in a result or one line of an
`EvnlosError`, within ten seconds and two gigabytes. Nothing may be executed (a stand-in for Ghostscript is on
the path), no file written or removed, and the bytes of a secret beside the input must not come out. Failures
are printed with the kind and the number that make them again (`--only KIND:NUMBER`); the exit code is then 1.
Guided, single files are mutated, in archives what is in them; a file that takes evnlos along a branch where
none went before becomes a seed of others. `tests/corpus` holds small seeds and findings, which the suite reads
again; `--keep FOLDER` writes those of a run, failures always.
`fuzz_event_files.py` does the same for the bytes of event files.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import random
import resource
import shutil
import signal
import socket
import struct
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import h5py
import numpy as np
import torch
import yaml
from PIL import Image
from safetensors.torch import load, save

from evnlos import EvnlosError, read_events, write_events
from evnlos.app.upload import read_upload
from evnlos.cameras.video import open_video
from evnlos.config import load_yaml, read_yaml, to_dict
from evnlos.data import Sampling, Simulation, load_pattern, read_capture, read_shard
from evnlos.data.lab import Lab
from evnlos.events.recording import Recording, summarise
from evnlos.inverse import read_photograph
from evnlos.live.engine import Engine
from evnlos.live.packet import Packet, pack
from evnlos.live.udp import UdpSource
from evnlos.models import UNetConfig, Weights, load_weights, save_weights
from evnlos.setups.files import MEASUREMENT, WALL
from evnlos.training import Training
from evnlos.types import Events

CORPUS = Path(__file__).parent / "corpus"
LIMIT_S, LIMIT_BYTES = 10, 2 << 30
SECRET = b"root:x:0:0:SECRET-OF-THE-MACHINE"
SCALARS = (
    "1e300", "1e-300", ".inf", ".nan", "0", "-1", "1.5", str(2**70), "9" * 5000, "2001-99-99", "[1, 2]", "[]",
    "{}", "{a: 1}", "x", "''", "null", "true", "'\\e]0;x\\a'", '"a\\nb"', "*a", "!!binary aa", "!!int", "1:2:3",
)  # fmt: skip
NAMES = (
    "../secret.png", "/etc/passwd", "secret", "a\0b", "a\nb", "\x1b[31m", "x" * 300, ".", "..", "", "pipe",
    "/dev/zero", "trap.png", "list.m3u8", "link.png", "~", "$(id)", "frames/", "C:x", "\u202egnp",
)  # fmt: skip
POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 72 48\n%%EndComments\nshowpage\n"


@dataclass(frozen=True)
class Material:
    """Whole files that inputs are made of."""

    folder: Path

    @property
    def capture(self) -> Path:
        return self.folder / "shot"

    @classmethod
    def made(cls, folder: Path) -> Material:
        shot = folder / "shot"
        shot.mkdir(parents=True)
        draw, count = np.random.default_rng(0), 400
        t, x, y = (
            np.sort(draw.integers(0, 300_000, count)),
            draw.integers(0, 72, count),
            draw.integers(0, 48, count),
        )
        events = Events(t, x.astype("u2"), y.astype("u2"), draw.random(count) < 0.5, 72, 48)
        write_events(shot / "events.raw", events)
        write_events(folder / "events.h5", events)
        write_events(folder / "events.npz", events)
        lines = ["t_us,file"]
        for number in range(5):
            Image.fromarray(draw.integers(0, 255, (48, 72)).astype(np.uint8)).save(shot / f"{number}.png")
            lines.append(f"{60_000 * number},{number}.png")
        (shot / "frames.csv").write_text("\n".join(lines))
        about = {"camera": {"width": 72, "height": 48, "frame_rate_hz": 16.0}, "setup": {"distance_m": 0.3}}
        about["target"] = {"name": "A", "mask": "0.png"}  # type: ignore[assignment]
        about["motion"] = {"start_m": 0.0, "speed_m_s": 0.02}
        about["alignment"] = {"offset_us": 0}
        (shot / "capture.yaml").write_text(yaml.safe_dump(about))
        torch.manual_seed(0)
        network = UNetConfig(width=4, depth=1, shuffle=1, rank=0).build("frame", Sampling(8, 8, 0.01, 8))
        save_weights(folder / "w.safetensors", Weights(network, [{"data": {"name": "d"}, "settings": {}}]))
        axis = np.linspace(-0.2, 0.2, 8)
        arrays = {"wall": draw.random((8, 8)), "wall_x_m": axis, "wall_z_m": axis, "cell_x_m": axis[:4]}
        arrays |= {"cell_z_m": axis[:4], "cell_size_m": np.array([0.1, 0.1]), "distance_m": np.array(1.0)}
        np.savez(folder / "photograph.npz", **arrays)
        with h5py.File(folder / "shard.h5", "w") as file:
            for name, shape in (("frame", (2, 8, 8)), ("surface", (2, 2, 8, 8)), ("truth", (2, 8, 8))):
                file.create_dataset(
                    name, data=draw.random(shape).astype(np.float16), fletcher32=True, chunks=True
                )
            file["time_s"], file["event_count"] = np.arange(2.0), np.arange(2)
        return cls(folder)


def flipped(content: bytes, draw: random.Random) -> bytes:
    """Return content that was cut, shifted or flipped somewhere, most often near its start."""
    changed, how = bytearray(content), draw.random()
    place = draw.randrange(max(len(content), 1))
    if how < 0.2 or not content:
        return content[:place]
    if how < 0.3:
        return content[:place] + draw.randbytes(draw.randrange(1, 64)) + content[place:]
    for _ in range(draw.choice((1, 2, 4, 16))):
        reach = min(len(content), 2000) if draw.random() < 0.7 else len(content)
        changed[draw.randrange(reach)] = draw.choice((0, 255, 127, draw.randrange(256)))
    return bytes(changed)


def _leaves(values: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for key, value in values.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, (*path, key))
        yield (*path, key)


def _with(values: dict[str, Any], path: tuple[str, ...], value: Any) -> dict[str, Any]:
    """Return values with one replaced, and the mappings around it."""
    inner = values.get(path[0])
    deeper = _with(inner if isinstance(inner, dict) else {}, path[1:], value) if len(path) > 1 else value
    return {**values, path[0]: deeper}


def settings(draw: random.Random, at: Path, _: Material) -> Callable[[], object]:
    cls = draw.choice((Simulation, Training, Lab))
    whole = to_dict(cls())
    values: dict[str, Any] = {}
    for number in range(draw.choice((1, 1, 2, 3))):
        path = draw.choice(list(_leaves(whole)))
        values = _with(values, path if draw.random() < 0.9 else (*path[:-1], path[-1] + "x"), f"VALUE{number}")
        for depth in range(1, len(path)):
            kind = _at(whole, (*path[:depth], "kind"))
            values = values if kind is None else _with(values, (*path[:depth], "kind"), kind)
    text = yaml.safe_dump(values)
    for number in range(3):
        text = text.replace(f"VALUE{number}", draw.choice(SCALARS))
    (at / "s.yaml").write_text(text)
    return lambda: load_yaml(cls, at / "s.yaml")


def _at(values: Any, path: tuple[str, ...]) -> Any:
    for key in path:
        values = values.get(key) if isinstance(values, dict) else None
    return values


def yaml_text(draw: random.Random, at: Path, material: Material) -> Callable[[], object]:
    many = draw.choice((10, 1000, 50_000))
    text = draw.choice(
        [
            "a: &a [x]\n" + "".join(f"b{i}: *a\n" for i in range(many)),
            "a: " + "[" * many + "]" * many,
            "{a: " * many + "1" + "}" * many,
            "\n".join(f"{'k' * draw.randrange(1, 30)}{i}: {i}" for i in range(many)),
            "a: '" + "\\x" * many,
            "? " * many,
            "- " * many,
            "a: |\n" + " x\n" * many,
            "%YAML 9.9\n---\na: 1\n",
            "a: 1\n---\nb: 2\n",
            f"seed: {draw.choice(SCALARS)}\n",
            yaml.safe_dump({draw.choice(NAMES): draw.choice(NAMES)}),
            "<<: {a: 1}\n<<: [1]\n",
        ]
    )
    content = text.encode("utf-8", "surrogatepass")
    if draw.random() < 0.5:
        content = flipped(
            (material.capture / "capture.yaml").read_bytes() if draw.random() < 0.5 else content, draw
        )
    (at / "p.yaml").write_bytes(content)
    return lambda: (read_yaml(at / "p.yaml"), load_yaml(Simulation, at / "p.yaml"))


def _trapped(folder: Path, draw: random.Random) -> None:
    """Put what an attacker may name into a folder."""
    (folder / "trap.png").write_bytes(POSTSCRIPT)
    (folder / "link.png").symlink_to(folder.parent / "secret.png")
    os.mkfifo(folder / "pipe")
    (folder / "list.m3u8").write_text(f"#EXTM3U\n#EXTINF:1,\n{folder.parent / 'secret.ts'}\n#EXT-X-ENDLIST\n")
    np.save(folder / "a.npy", np.full((3, 48, 72), draw.choice((5.0, np.nan, np.inf, 1e38)), np.float32))


def capture(draw: random.Random, at: Path, material: Material) -> Callable[[], object]:
    folder = at / "shot"
    shutil.copytree(material.capture, folder)
    _trapped(folder, draw)
    page = folder / "capture.yaml"
    how = draw.random()
    if how < 0.35:
        values = yaml.safe_load(page.read_text())
        extra = ("events", "frames", "dark", "flat", "frames_turned", "roi", "filters", "registration", "setup")
        inner = {
            "roi": ("x", "y", "width", "height"), "filters": ("hot_pixel_factor", "background_us"),
            "registration": ("homography", "points", "dots"), "alignment": ("offset_us", "search_s", "blocks"),
        }  # fmt: skip
        path = draw.choice([*_leaves(values), *((name,) for name in extra)])
        path = (*path, draw.choice(inner[path[-1]])) if path[-1] in inner and draw.random() < 0.8 else path
        text = yaml.safe_dump(_with(values, path, "VALUE"))
        page.write_text(text.replace("VALUE", draw.choice(SCALARS)))
    elif how < 0.65:
        key = draw.choice(("events", "frames", "dark", "flat", "mask"))
        name = draw.choice((*NAMES, "a.npy"))
        values = yaml.safe_load(page.read_text())
        values = _with(values, ("target", "mask") if key == "mask" else (key,), name)
        page.write_text(yaml.safe_dump(values))
    elif how < 0.85:
        lines = (folder / "frames.csv").read_text().splitlines()
        cell = draw.choice((*NAMES, "0.png", "1.png"))
        time_us = draw.choice(("0", "-1", str(2**63), str(2**70), "x", "1e3", "", "9" * 5000, "60000"))
        lines[draw.randrange(len(lines))] = f"{time_us},{cell}"
        (folder / "frames.csv").write_text("\n".join(lines * draw.choice((1, 1, 1000))), errors="surrogatepass")
    else:
        path = draw.choice([one for one in folder.iterdir() if one.is_file() and not one.is_symlink()])
        path.write_bytes(flipped(path.read_bytes(), draw))
    return lambda: read_capture(folder)


def picture(draw: random.Random, at: Path, _: Material) -> Callable[[], object]:
    ending = draw.choice(("png", "gif", "tif", "webp", "bmp", "jpg", "ppm", "png"))
    mode = draw.choice(("L", "RGB", "P", "1", "RGBA", "I;16", "F"))
    image = Image.new("L", draw.choice([(1, 1), (72, 48), (300, 7)]), 9)
    path = at / f"p.{ending}"
    try:
        image.convert(mode).save(path)
    except (OSError, ValueError, KeyError):
        image.save(path)
    content = flipped(path.read_bytes(), draw)
    if ending == "png" and draw.random() < 0.4:  # a header that claims any size
        sides = draw.choice([(1 << 31) - 1, 20_000, 0, 65_536]), draw.choice([(1 << 31) - 1, 20_000, 1])
        content = path.read_bytes()[:16] + b"".join(side.to_bytes(4, "big") for side in sides) + content[24:]
    path.write_bytes(POSTSCRIPT if draw.random() < 0.1 else content)
    return lambda: [None for _ in open_video([path, path] if draw.random() < 0.5 else path, fps=10)]


def npz(draw: random.Random, at: Path, material: Material) -> Callable[[], object]:
    name = draw.choice(("photograph.npz", "events.npz"))
    path = at / name
    content = (material.folder / name).read_bytes()
    if draw.random() < 0.5:
        path.write_bytes(flipped(content, draw))
    else:
        with np.load(material.folder / name) as file:
            arrays = dict(file)
        key = draw.choice(list(arrays))
        strange = [
            np.zeros(0), np.array("x"), np.array(5 + 1j), np.full((3, 3), np.nan), np.zeros((2, 2, 2, 2)),
            np.array(1e300), np.array(-1), np.array(2**63, np.uint64), np.zeros(8, "S3"), np.zeros(400, "i8"),
        ]  # fmt: skip
        arrays[key] = draw.choice(strange)
        if draw.random() < 0.3:
            del arrays[draw.choice(list(arrays))]
        np.savez(path, **arrays)
    if name == "events.npz":
        return lambda: read_events(path)
    return lambda: read_photograph(path)


def hdf5(draw: random.Random, at: Path, material: Material) -> Callable[[], object]:
    name = draw.choice(("events.h5", "shard.h5"))
    path = at / name
    shutil.copy(material.folder / name, path)
    group = "events/" if name == "events.h5" else ""
    keys = [
        f"{group}{one}" for one in (("t", "x", "y", "p") if group else ("frame", "surface", "truth", "time_s"))
    ]
    key, count = draw.choice(keys), 400
    secret = str(at / "secret")
    with h5py.File(path, "r+") as file:
        del file[key]
        how = draw.randrange(12)
        if how == 0:
            file.create_dataset(key, (len(SECRET),), "u1", external=[(secret, 0, len(SECRET))])
        elif how == 1:
            file[key] = h5py.ExternalLink(str(material.folder / name), key)
        elif how == 2:
            file[key] = h5py.SoftLink("/" + draw.choice(keys))
        elif how == 3:
            layout = h5py.VirtualLayout((count,), "u1")
            layout[:] = h5py.VirtualSource(str(material.folder / name), key, (count,))
            file.create_virtual_dataset(key, layout)
        elif how == 4:
            size = draw.choice((10**6, 10**9, 10**12))
            file.create_dataset(key, (size,), "u2", chunks=(min(size, 10**6),), compression="gzip")
        elif how == 5:
            size = 30_000_000
            file.create_dataset(key, (size,), "i8", chunks=(size,), compression="gzip")
        elif how == 6:
            file.create_group(key)
        elif how == 7:
            file[key] = draw.choice(
                [np.zeros(count, "S5"), np.zeros((2, 2)), np.array(5), np.full(count, np.nan)]
            )
        elif how == 8:
            file[key] = np.full(count, draw.choice((-(2**63), 2**63 - 1, -1, 70_000)), np.int64)
        elif how == 9:
            file.create_dataset(key, (count,), "u1", external=[(str(at / "pipe"), 0, count)])
        elif how == 10:
            file.attrs["width"] = draw.choice([np.zeros(0), "x", 2**62, -1, np.nan, np.zeros((3, 3))])
            file.attrs["height"] = 5
        else:
            file[f"{group}t_offset"] = draw.choice([2**63 - 1, -(2**63), 1.5, "x", np.zeros(3)])
    if draw.random() < 0.2:
        path.write_bytes(flipped(path.read_bytes(), draw))
    if name == "shard.h5":
        return lambda: read_shard(path)
    return lambda: summarise(Recording(path, "salvage").pieces())


def weights(draw: random.Random, at: Path, material: Material) -> Callable[[], object]:
    path, content = at / "w.safetensors", (material.folder / "w.safetensors").read_bytes()
    how = draw.random()
    if how < 0.4:
        path.write_bytes(flipped(content, draw))
    else:
        tensors = load(content)
        length = int.from_bytes(content[:8], "little")
        about = json.loads(json.loads(content[8 : 8 + length])["__metadata__"]["evnlos"])
        if how < 0.7:
            name, value = draw.choice(list(tensors.items()))
            strange = [value.to(torch.complex64), value.to(torch.int8), value * torch.nan, value[..., :0]]
            tensors[name] = draw.choice([*strange, torch.zeros(3, 3), value.double() * 1e300])
            if draw.random() < 0.3:
                del tensors[name]
        else:
            values = [None, [], {}, "x", -1, 0, 1e300, float("nan"), 2**70, True, "a\nb", "\x1b[1m", [[[]]]]
            about = _with(about, draw.choice(list(_leaves(about))), draw.choice(values))
        path.write_bytes(save(tensors, metadata={"evnlos": json.dumps(about)}))

    def described() -> object:
        from evnlos.report.provenance import about_weights, weights_text

        return weights_text("w", about_weights(load_weights(path)))

    return described


def upload(draw: random.Random, at: Path, material: Material) -> Callable[[], object]:
    path = at / "u.zip"
    how = draw.random()
    if how < 0.25:
        kind = draw.choice((hdf5, npz))
        kind(draw, at, material)
        path = next(one for one in at.iterdir() if one.suffix in (".h5", ".npz"))
    else:
        (at / "inner").mkdir()
        (at / "inner" / "secret.png").write_bytes(SECRET)
        capture(draw, at / "inner", material)
        with zipfile.ZipFile(path, "w", draw.choice((zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED))) as archive:
            for one in sorted((at / "inner" / "shot").rglob("*")):
                if one.is_file() and not one.is_symlink():
                    archive.write(one, f"shot/{one.name}")
            if how < 0.5:
                strange = ("../x", "/x", "a/../../x", "shot/capture.yaml", "x" * 5000, "a\\b", "C:/x", ".")
                archive.writestr(draw.choice(strange), bytes(draw.choice((1, 10**6))))
        if how > 0.8:
            path.write_bytes(flipped(path.read_bytes(), draw))
    return lambda: read_upload(path, at, 20_000_000)


def datagrams_of(content: bytes) -> list[bytes]:
    """Return the packets of a file that holds each after its length in two bytes."""
    found, at = [], 0
    while at + 2 <= len(content):
        (size,) = struct.unpack_from("<H", content, at)
        found.append(content[at + 2 : at + 2 + size])
        at += 2 + size
    return found


@cache
def listener() -> Engine:
    """Return what makes images of packets; one for all inputs, for each tracing of a network keeps memory."""
    network = UNetConfig(width=4, depth=1, shuffle=1, rank=0).build("event", Sampling(8, 8, 0.01, 8))
    return Engine(Weights(network))


def listen(datagrams: list[bytes]) -> object:
    """Let `live` hear packets, and look at what it makes of them."""
    engine, source = listener(), UdpSource(idle_s=0.02)
    engine.begin()
    until = time.monotonic() + 0.5
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for data in datagrams:
            sender.sendto(data[:60_000], ("127.0.0.1", source.port))
    chunks = list(source.chunks(lambda: time.monotonic() > until))
    faults = source.faults()
    assert min(faults.values()) >= 0, faults
    return engine.see(chunks) if chunks else None


def packets(draw: random.Random, at: Path, _: Material) -> Callable[[], object]:
    found, at_us = [], 0
    for number in range(draw.choice((1, 3, 20))):
        count = draw.choice((0, 1, 50))
        times = np.sort(np.array([at_us + draw.randrange(1000) for _ in range(count)], np.int64))
        at_us += draw.choice((1000, 1000, 2**40))
        x, y = (np.array([draw.randrange(8) for _ in range(count)], np.uint16) for _ in range(2))
        events = Events(times, x, y, np.zeros(count, np.bool_), 8, 8)
        data = pack(Packet(draw.choice((number, number, 0, 2**31 - 1)), events, draw.random() < 0.1))
        found.append(flipped(data, draw) if draw.random() < 0.5 else data)
    (at / "p.udp").write_bytes(b"".join(struct.pack("<H", len(data)) + data for data in found))
    return lambda: listen(datagrams_of((at / "p.udp").read_bytes()))


KINDS: dict[str, Callable[[random.Random, Path, Material], Callable[[], object]]] = {
    one.__name__: one for one in (settings, yaml_text, capture, picture, npz, hdf5, weights, packets, upload)
}


def read_file(path: Path) -> object:
    """Read a file in every way that its ending allows; an error of one way does not keep it from the others."""
    ways: dict[str, list[Callable[[], object]]] = {
        ".yaml": [lambda: read_yaml(path), lambda: load_yaml(Simulation, path), lambda: load_yaml(Lab, path)],
        ".npz": [lambda: read_events(path), lambda: read_photograph(path)],
        ".h5": [lambda: summarise(Recording(path, "salvage").pieces()), lambda: read_shard(path)],
        ".safetensors": [
            lambda: load_weights(path), lambda: WALL.read(path), lambda: MEASUREMENT.read(path),
            lambda: load_pattern(path),
        ],
        ".zip": [lambda: read_upload(path, path.parent, 20_000_000)],
        ".udp": [lambda: listen(datagrams_of(path.read_bytes()))],
    }  # fmt: skip
    pictures: list[Callable[[], object]] = [lambda: [None for _ in open_video(path, fps=10)]]
    found, refused = [], None
    for way in ways.get(path.suffix, pictures):
        try:
            found.append(way())
        except EvnlosError as error:
            refused = error
    if refused is not None and not found:
        raise refused
    return found


class _TooLongError(Exception):
    """An input took more than the limit."""


def _late(*_: object) -> None:
    raise _TooLongError


def outcome(make: Callable[[Path], Callable[[], object]], base: Path) -> tuple[str, float]:
    """Make and read one input; return "read", "refused", or what went wrong, and the seconds it took.

    Args:
        make: Makes the input in a folder and returns what reads it.
        base: Where that folder is made.
    """
    with tempfile.TemporaryDirectory(dir=base) as folder:
        at = Path(folder)
        for name in ("secret", "secret.png"):
            (at / name).write_bytes(SECRET)
        os.mkfifo(at / "pipe")
        read = make(at)
        before = sorted(str(one) for one in at.rglob("*"))
        signal.signal(signal.SIGALRM, _late)
        signal.setitimer(signal.ITIMER_REAL, 12 * LIMIT_S)  # of a machine that may be busy elsewhere
        began = time.process_time()
        try:
            found = read()
            how = "the secret came out" if _holds_secret(found) else "read"
        except EvnlosError as error:
            text = str(error)
            how = (
                "refused" if "\n" not in text and text.isprintable() and len(text) < 5000 else f"line: {text!r}"
            )
        except _TooLongError:
            how = "it never ended"
        except BaseException as error:
            how = f"{type(error).__name__}: {error}"[:300]
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        spent = time.process_time() - began
        if spent > LIMIT_S:
            how = f"{how} after {spent:.0f} s"
        if sorted(str(one) for one in at.rglob("*")) != before:
            how = f"files were written or removed; {how}"
    return how, spent


def _holds_secret(found: object) -> bool:
    if isinstance(found, np.ndarray):
        return SECRET[:12] in found.tobytes()
    if isinstance(found, (list, tuple)):
        return any(_holds_secret(one) for one in found)
    if isinstance(found, Events):
        return any(_holds_secret(column.astype(np.uint8)) for column in found.columns().values())
    if hasattr(found, "__dataclass_fields__"):
        return any(_holds_secret(getattr(found, item.name)) for item in fields(found))  # type: ignore[arg-type]
    return False


@contextmanager
def bounded(base: Path | None, failures: list[str]) -> Iterator[tuple[Path, Material]]:
    """Give a folder and whole files while memory is bounded and a stand-in for Ghostscript waits to be run."""
    with tempfile.TemporaryDirectory(dir=base) as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        root = Path(folder)
        material = Material.made(root / "material")
        listen([pack(Packet(0, Events([1], [1], [1], [True], 8, 8)))])  # imports and compiles
        ran = root / "ran"
        (root / "bin").mkdir()
        (root / "bin" / "gs").write_text(f"#!/bin/sh\ntouch {ran}\nexit 1\n")
        (root / "bin" / "gs").chmod(0o755)
        path = os.environ["PATH"]
        os.environ["PATH"] = f"{root / 'bin'}{os.pathsep}{path}"
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limits = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + LIMIT_BYTES, limits[1]))
        try:
            yield root, material
        finally:
            resource.setrlimit(resource.RLIMIT_AS, limits)
            os.environ["PATH"] = path
        if ran.exists():
            failures.append("Ghostscript was run")


def run(count: int, seed: int, only: str | None = None, base: Path | None = None) -> list[str]:
    """Read `count` inputs, as many of each kind; return the failures, one line each."""
    failures: list[str] = []
    tally = {"read": 0, "refused": 0}
    with bounded(base, failures) as (root, material):
        for index in range(count):
            kind, number = list(KINDS)[index % len(KINDS)], index // len(KINDS)
            if only is not None and only != f"{kind}:{number}":
                continue
            draw = random.Random(f"{seed} {kind} {number}")
            how, _ = outcome(lambda at, kind=kind, draw=draw: KINDS[kind](draw, at, material), root)
            if how in tally:
                tally[how] += 1
            else:
                failures.append(f"{kind}:{number}: {how}")
    failures += [] if all(tally.values()) or only else [f"nothing to tell apart: {tally}"]
    return failures


class Tracer:
    """Notes which branches of evnlos were taken: pairs of lines that ran one after the other."""

    def __init__(self) -> None:
        self.taken: set[tuple[str, int, int]] = set()
        self._ours: dict[str, bool] = {}

    def __call__(self, frame: Any, event: str, argument: object) -> Any:
        name = frame.f_code.co_filename
        if not self._ours.setdefault(name, f"{os.sep}evnlos{os.sep}" in name):
            return None
        last = 0

        def line(frame: Any, event: str, argument: object) -> Any:
            nonlocal last
            if event == "line":
                self.taken.add((name, last, frame.f_lineno))
                last = frame.f_lineno
            return line

        return line


def mutated(name: str, content: bytes, draw: random.Random) -> bytes:
    """Return a changed file; of an archive most often one of the files in it is changed."""
    if not name.endswith((".zip", ".npz")) or draw.random() < 0.2:
        return flipped(content, draw)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            inside = {one.filename: archive.read(one) for one in archive.infolist()}
        chosen = draw.choice(list(inside))
        inside[chosen] = flipped(inside[chosen], draw)
        made = io.BytesIO()
        with warnings.catch_warnings(), zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
            warnings.simplefilter("ignore")
            for one, data in inside.items():
                archive.writestr(one, data)
        return made.getvalue()
    except Exception:  # an archive that is damaged already
        return flipped(content, draw)


def seeds(material: Material, root: Path) -> list[tuple[str, bytes]]:
    """Return whole files of every kind and the corpus, each with its name."""
    found = [(one.name, one.read_bytes()) for one in sorted(material.folder.iterdir()) if one.is_file()]
    found += [(one.name, one.read_bytes()) for one in sorted(material.capture.iterdir())[:3]]
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for one in sorted(material.capture.iterdir()):
            archive.write(one, f"shot/{one.name}")
    found.append(("shot.zip", packed.getvalue()))
    array = io.BytesIO()
    np.save(array, np.zeros((3, 4, 5), np.uint8))
    found.append(("a.npy", array.getvalue()))
    found.append(("s.yaml", yaml.safe_dump(to_dict(Simulation())).encode()))
    for kind in (picture, packets):
        for number in range(4):
            at = root / f"{kind.__name__}{number}"
            at.mkdir()
            kind(random.Random(number), at, material)
            found += [(one.name, one.read_bytes()) for one in at.iterdir()]
    corpus = [(one.name.partition("-")[2], one.read_bytes()) for one in sorted(CORPUS.iterdir())]
    return [pair for pair in found if not pair[0].endswith((".csv", ".raw"))] + corpus


def replay(base: Path | None = None) -> list[str]:
    """Read the corpus; return the failures, one line each."""
    failures: list[str] = []
    with bounded(base, failures) as (root, _):
        for path in sorted(CORPUS.iterdir()):

            def make(at: Path, path: Path = path) -> Callable[[], object]:
                copy = at / path.name.partition("-")[2]
                shutil.copy(path, copy)
                return lambda: read_file(copy)

            how, _ = outcome(make, root)
            failures += [] if how in ("read", "refused") else [f"{path.name}: {how}"]
    return failures


def guided(seconds: float, seed: int, keep: Path | None, most_bytes: int = 4000) -> list[str]:
    """Mutate files for so many seconds, guided by the branches that they take; return the failures."""
    failures, draw, tracer = list[str](), random.Random(seed), Tracer()
    with bounded(None, failures) as (root, material):
        known = seeds(material, root)
        for name, content in known:  # what is imported and compiled on the way is no part of an input
            (root / name).write_bytes(content)
            with suppress(EvnlosError):
                read_file(root / name)
        waiting, tried, kept, end = list(known), 0, 0, time.monotonic() + seconds
        while time.monotonic() < end:
            is_seed = bool(waiting)
            name, content = waiting.pop() if is_seed else draw.choice(known)
            content = content if is_seed else mutated(name, content, draw)
            before = len(tracer.taken)

            def make(at: Path, name: str = name, content: bytes = content) -> Callable[[], object]:
                (at / name).write_bytes(content)

                def read() -> object:
                    sys.settrace(tracer)
                    try:
                        return read_file(at / name)
                    finally:
                        sys.settrace(None)

                return read

            how, _ = outcome(make, root)
            tried += 1
            is_new, is_bad = len(tracer.taken) > before, how not in ("read", "refused")
            if is_new and not is_seed:
                known.append((name, content))
                kept += 1
            if is_bad:
                failures.append(f"{name}, input {tried}: {how}")
            if is_bad or (keep is not None and is_new and not is_seed and len(content) <= most_bytes):
                folder = keep or Path("fuzz_failures")
                folder.mkdir(parents=True, exist_ok=True)
                (folder / f"{seed}_{tried:05d}-{name}").write_bytes(content)
        print(f"{tried} files, {kept} kept, {len(tracer.taken)} branches")
    return failures


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(
        description="Feed hostile inputs to every reader but those of event bytes."
    )
    parser.add_argument("--count", type=int, default=2400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="one input, as a failure names it")
    parser.add_argument("--guided", type=float, help="seconds to mutate files, guided by what they reach")
    parser.add_argument("--keep", type=Path, help="folder for the small files that reached something new")
    given = parser.parse_args()
    began = time.perf_counter()
    if given.guided:
        failures = guided(given.guided, given.seed, given.keep)
        print("\n".join(failures) or "no failure", flush=True)
        sys.exit(bool(failures))
    failures = run(given.count, given.seed, given.only)
    print("\n".join(failures) or "no failure", flush=True)
    print(f"{given.count} inputs in {time.perf_counter() - began:.0f} s, {len(failures)} failures")
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
