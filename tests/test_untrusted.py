"""A stranger's file runs nothing and reads no other file; a folder that is refused loses nothing."""

import ast
import os
import random
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from safetensors import safe_open
from safetensors.torch import save

import evnlos
from evnlos import EvnlosError, read_events
from evnlos.cameras.video import open_video
from evnlos.cli import main
from evnlos.data import FixedPattern, Sampling, load_pattern, read_capture, save_pattern
from evnlos.events import read_triggers
from evnlos.models import UNetConfig, Weights, load_weights, save_weights
from evnlos.scene import read_sd19_image
from evnlos.setups.files import (
    MEASUREMENT,
    WALL,
    About,
    AboutWall,
    FittedWall,
    Measurement,
    write_fitted,
    write_measurement,
)
from evnlos.tensor_file import sealed_bytes
from evnlos.training.settings import load_checkpoint, save_checkpoint
from evnlos.types import Plane
from evnlos.untrusted import open_image, open_regular

POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 72 48\n%%EndComments\n0 0 moveto showpage\n"
COUNT = 40
SAMPLING = Sampling(height=8, width=8, pitch_m=0.01, scored_rows=8)
CAMERA = {"width": 72, "height": 48, "frame_rate_hz": 25.0}


@pytest.fixture
def ghostscript(tmp_path: Path, monkeypatch) -> Path:
    """Put a stand-in for Ghostscript on the path; the file that is returned is there once it ran."""
    from PIL import EpsImagePlugin

    ran, program = tmp_path / "ran", tmp_path / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {ran}\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)
    return ran


def copied(capture: Path, folder: Path) -> Path:
    shutil.copytree(capture, folder)
    return folder


def described(folder: Path, **settings: Any) -> Path:
    """Return a capture folder whose page says something else."""
    page = folder / "capture.yaml"
    page.write_text(yaml.safe_dump(yaml.safe_load(page.read_text()) | settings))
    return folder


@pytest.mark.parametrize("what", ["frame", "mask", "dark", "dots", "folder of frames", "animation", "sd19"])
def test_a_program_named_as_an_image_is_not_run(what: str, tiny_captures, tmp_path, ghostscript) -> None:
    folder = copied(tiny_captures[0], tmp_path / "capture_folder")
    trap = folder / "trap.png"
    trap.write_bytes(POSTSCRIPT)
    read: Callable[[Path], object] = read_capture
    given = folder
    if what == "frame":
        table = folder / "frames.csv"
        rows = table.read_text().splitlines()
        table.write_text("\n".join([*rows[:-1], rows[-1].split(",")[0] + ",trap.png"]) + "\n")
    elif what == "mask":
        described(folder, target={"name": "A", "mask": "trap.png"})
    elif what == "dark":
        described(folder, dark="trap.png")
    elif what == "dots":
        dots = {"rows": 3, "columns": 4, "frame": "trap.png", "events": "events.raw"}
        described(folder, registration={"dots": dots})
    elif what == "folder of frames":
        (folder / "many").mkdir()
        for number in range(3):
            shutil.copy(trap, folder / "many" / f"{number}.png")
        described(folder, frames="many", camera=CAMERA)
    elif what == "animation":
        read, given = open_video, trap
    else:
        read, given = read_sd19_image, trap
    with pytest.raises(EvnlosError) as caught:
        read(given)
    assert "\n" not in str(caught.value)
    assert not ghostscript.exists()


@pytest.mark.parametrize("ending", ["png", "jpg", "tif", "bmp", "gif", "webp", "ppm", "pgm"])
def test_the_images_that_cameras_write_are_read(ending: str, tmp_path) -> None:
    picture = np.arange(48, dtype=np.uint8).reshape(6, 8)
    Image.fromarray(picture).save(tmp_path / f"a.{ending}")
    with open_image(tmp_path / f"a.{ending}") as image:
        assert image.size == (8, 6)
        assert np.abs(np.asarray(image.convert("L")).astype(int) - picture).max() < 12


def test_files_of_strangers_are_opened_in_one_place() -> None:
    root = Path(evnlos.__file__).parent
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call) or path.name == "untrusted.py":
                continue
            call = ast.unparse(node.func)
            mode = ast.unparse(node.args[1]) if len(node.args) > 1 else ""
            assert not call.endswith("Image.open"), path
            assert not (call.endswith("h5py.File") and mode != "'w'"), path
            assert not (call.endswith("av.open") and mode != "'w'"), path


def columns(file: h5py.File) -> None:
    file["events/t"] = np.arange(COUNT)
    file["events/x"] = np.zeros(COUNT, np.uint16)
    file["events/y"] = np.zeros(COUNT, np.uint16)
    file["events/p"] = np.ones(COUNT, np.uint8)


def _external(file: h5py.File) -> None:
    del file["events/x"]
    file["events"].create_dataset("x", (COUNT,), "u1", external=[("secret.bin", 0, COUNT)])


def _external_link(file: h5py.File) -> None:
    del file["events/x"]
    file["events/x"] = h5py.ExternalLink("secret.h5", "/events/y")


def _soft_link(file: h5py.File) -> None:
    del file["events/x"]
    file["events/x"] = h5py.SoftLink("/events/y")


def _linked_group(file: h5py.File) -> None:
    del file["events"]
    file["events"] = h5py.ExternalLink("secret.h5", "/events")


def _virtual(file: h5py.File) -> None:
    del file["events/x"]
    layout = h5py.VirtualLayout((COUNT,), np.uint16)
    layout[:] = h5py.VirtualSource("secret.h5", "events/y", (COUNT,))
    file["events"].create_virtual_dataset("x", layout)


def _offset(file: h5py.File) -> None:
    file.create_dataset("t_offset", (1,), np.int64, external=[("secret.bin", 0, 8)])


def _linked_offset(file: h5py.File) -> None:
    file["events/t_offset"] = h5py.ExternalLink("secret.h5", "/t_offset")


def _optional(file: h5py.File) -> None:
    file["events"].create_dataset("adc", (COUNT,), "u1", external=[("secret.bin", 0, COUNT)])


def _pipe(file: h5py.File) -> None:
    del file["events/x"]
    file["events"].create_dataset("x", (COUNT,), "u1", external=[("pipe", 0, COUNT)])


LEAKS = [
    _external, _external_link, _soft_link, _linked_group, _virtual, _offset, _linked_offset, _optional, _pipe,
]  # fmt: skip


@pytest.mark.parametrize("leak", LEAKS, ids=lambda leak: leak.__name__)
@pytest.mark.parametrize("how", ["events", "triggers", "info", "capture"])
def test_an_event_file_reads_no_other_file(
    leak, how: str, tiny_captures, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret.bin").write_bytes(b"root:x:0:0:" * 8)
    os.mkfifo(tmp_path / "pipe")
    with h5py.File("secret.h5", "w") as file:
        columns(file)
        file["t_offset"] = 77
    with h5py.File("leak.h5", "w") as file:
        columns(file)
        leak(file)
    if how == "info":
        with pytest.raises(SystemExit) as ended:
            main(["info", "leak.h5"])
        said = capsys.readouterr().err
        assert ended.value.code == 2
        assert said.count("\n") == 1
        return
    folder = described(copied(tiny_captures[0], tmp_path / "capture_folder"), events="leak.h5")
    shutil.copy("leak.h5", folder)
    read = {
        "events": lambda: read_events("leak.h5"),
        "triggers": lambda: read_triggers("leak.h5"),
        "capture": lambda: read_capture(folder),
    }
    with pytest.raises(EvnlosError, match=r"is a link|lie in other files") as caught:
        read[how]()
    assert "\n" not in str(caught.value)


def write_film(path: Path, values: range = range(8)) -> None:
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4" if path.suffix != ".ts" else "mpeg2video", rate=25)
        stream.width, stream.height, stream.pix_fmt = 72, 48, "yuv420p"
        for value in values:
            picture = np.full((48, 72, 3), 20 * value, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def playlists(film: Path) -> dict[str, str]:
    return {
        "x.m3u8": f"#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:2\n#EXTINF:1.8,\n{film}\n#EXT-X-ENDLIST\n",
        "y.m3u8": "#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:2\n"
        f"#EXTINF:1.8,\nfile://{film}\n#EXT-X-ENDLIST\n",
        "z.mp4": f"#EXTM3U\n#EXTINF:1.8,\n{film}\n#EXT-X-ENDLIST\n",
        "x.ffconcat": f"ffconcat version 1.0\nfile {film}\n",
        "x.sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 96\n",
        "x.mpd": f"<MPD><Period><AdaptationSet><Representation><BaseURL>{film}</BaseURL></Representation>"
        "</AdaptationSet></Period></MPD>",
    }


@pytest.mark.parametrize("name", playlists(Path()))
def test_a_playlist_shows_no_film_of_the_machine(name: str, tiny_captures, tmp_path) -> None:
    write_film(tmp_path / "film.ts")
    folder = copied(tiny_captures[0], tmp_path / "capture_folder")
    described(folder, frames=name, camera=CAMERA)
    (folder / name).write_text(playlists(tmp_path / "film.ts")[name])
    with pytest.raises(EvnlosError, match="not a video that FFmpeg reads") as caught:
        read_capture(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("ending", ["mp4", "mkv", "avi", "ts", "mov", "mpg", "ogv", "flv", "wmv", "nut"])
def test_the_containers_that_cameras_write_are_read(ending: str, tmp_path) -> None:
    if ending in ("mpg", "ogv", "flv", "wmv"):
        codec = {"mpg": "mpeg1video", "ogv": "libtheora", "flv": "flv", "wmv": "wmv2"}[ending]
        av = pytest.importorskip("av")
        if codec not in av.codecs_available:
            pytest.skip(f"this PyAV has no {codec}")
    path = tmp_path / f"film.{ending}"
    write_film(path) if ending not in ("mpg", "ogv", "flv", "wmv") else write_with(path, codec)
    light = [float(picture.mean()) for _, picture in open_video(path, fps=25)]
    assert len(light) >= 7
    assert light[0] == pytest.approx(0, abs=4)
    assert light[-1] > 100


def write_with(path: Path, codec: str) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 72, 48, "yuv420p"
        for value in range(8):
            picture = np.full((48, 72, 3), 20 * value, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def test_a_folder_of_frames_holds_its_own_images(tiny_captures, tmp_path) -> None:
    folder = copied(tiny_captures[0], tmp_path / "capture_folder")
    (folder / "many").mkdir()
    for number in range(3):
        Image.fromarray(np.full((48, 72), 40 * number, np.uint8)).save(tmp_path / f"{number}.png")
        (folder / "many" / f"{number}.png").symlink_to(tmp_path / f"{number}.png")
    described(folder, frames="many", camera=CAMERA)
    with pytest.raises(EvnlosError, match="outside the capture folder"):
        read_capture(folder)


def test_a_pipe_or_a_device_is_not_waited_for(tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        ended: list[BaseException] = []

        def opened(path: Path = path, ended: list[BaseException] = ended) -> None:
            try:
                open_regular(path)
            except OSError as error:
                ended.append(error)

        thread = threading.Thread(target=opened, daemon=True)
        thread.start()
        thread.join(5)
        assert ended, path
        assert isinstance(ended[0], IsADirectoryError) or "no plain file" in str(ended[0])


DEAD = f"{socket.gethostname()}.4194304.0123abcd.part"
"""How a file's name ends that a process of this machine wrote which is dead."""


def _files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize("verb", ["simulate", "train", "import", "finetune"])
def test_a_refused_folder_keeps_its_files(
    verb: str, tiny_captures, tiny_dataset, app_weights, tmp_path, capsys
) -> None:
    notes = tmp_path / "notes"
    notes.mkdir()
    for name in ("a", ".draft.tmp", ".a.xyz.tmp", ".dataset.yaml.tmp", ".run.yaml.k.tmp.txt", ".lock"):
        (notes / name).write_text(name)
    (notes / ".folder.x.tmp").mkdir()
    before = _files(notes)
    words = {
        "simulate": ["simulate", "--out", str(notes)],
        "train": ["train", "--data", str(tiny_dataset.folder), "--out", str(notes)],
        "finetune": [
            "finetune", "--data", str(tiny_dataset.folder), "--out", str(notes),
            "--weights", str(app_weights["event"]),
        ],
        "import": ["import", *map(str, tiny_captures), "--out", str(notes)],
    }  # fmt: skip
    with pytest.raises(SystemExit) as ended:
        main(words[verb])
    assert ended.value.code == 2
    assert "not empty" in capsys.readouterr().err
    assert _files(notes) == before


def test_only_half_written_files_of_its_own_are_swept(tiny, tiny_dataset, tmp_path) -> None:
    from evnlos.data import simulate

    folder = tmp_path / "d"
    shutil.copytree(tiny_dataset.folder, folder)
    name = tiny_dataset.objects()[0]
    own = [f".{name}.h5.{DEAD}", f".dataset.yaml.{DEAD}"]
    others = [".draft.tmp", f".{name}.h5.abc.tmp", f"{name}.{DEAD}", f".{DEAD}", f".{name}.h5.part"]
    for one in (*own, *others):
        (folder / one).write_text("half")
    (folder / ".x.tmp").mkdir()
    simulate(tiny, folder)
    left = {path.name for path in folder.iterdir()}
    assert not left & set(own)
    assert {*others, ".x.tmp"} <= left


def test_a_run_that_was_killed_at_its_first_file_goes_on(tiny, tmp_path) -> None:
    from evnlos.data import simulate

    folder = tmp_path / "d"
    folder.mkdir()
    (folder / ".lock").write_text("")
    (folder / f".dataset.yaml.{DEAD}").write_text("half")
    assert simulate(tiny, folder).missing() == []
    assert not list(folder.glob(".*.part"))


@pytest.fixture(scope="module")
def sealed(tmp_path_factory) -> tuple[Path, Path, torch.nn.Module, torch.optim.Adam]:
    """Return weights, a checkpoint, and what the checkpoint is of."""
    folder = tmp_path_factory.mktemp("sealed")
    torch.manual_seed(0)
    network = UNetConfig(width=4, depth=1, shuffle=1, rank=0).build("frame", SAMPLING)
    save_weights(folder / "w.safetensors", Weights(network, [{"data": {"name": "d"}}]))
    optimiser = torch.optim.Adam(network.parameters())
    network(torch.ones(1, 1, 8, 8)).sum().backward()
    optimiser.step()
    save_checkpoint(folder / "c.safetensors", network, optimiser, 3, [{"epoch": 3, "loss": 0.5}], "key")
    return folder / "w.safetensors", folder / "c.safetensors", network, optimiser


def content_of(weights: Weights) -> tuple[object, ...]:
    state = {name: value.numpy().tobytes() for name, value in weights.network.state_dict().items()}
    return weights.modality.name, weights.sampling, weights.history, weights.scores, state


def test_no_flipped_byte_of_weights_goes_unseen(sealed, tmp_path) -> None:
    whole, copy = sealed[0].read_bytes(), tmp_path / "w.safetensors"
    expected, draw = content_of(load_weights(sealed[0])), random.Random(0)
    places = [*range(0, 1200, 7), *(draw.randrange(len(whole)) for _ in range(200))]
    noticed = 0
    for place in places:
        changed = bytearray(whole)
        changed[place] ^= 1 << draw.randrange(8)
        copy.write_bytes(changed)
        try:
            found = content_of(load_weights(copy))
        except EvnlosError as error:
            assert "\n" not in str(error)
            noticed += 1
        else:
            assert found == expected, place
    assert noticed > 0.9 * len(places)


def test_no_flipped_byte_of_a_checkpoint_goes_unseen(sealed, tmp_path) -> None:
    whole, copy, draw = sealed[1].read_bytes(), tmp_path / "c.safetensors", random.Random(1)
    network, optimiser = sealed[2:]
    places = [*range(0, 1200, 7), *(draw.randrange(len(whole)) for _ in range(200))]
    noticed = 0
    for place in places:
        changed = bytearray(whole)
        changed[place] ^= 1 << draw.randrange(8)
        copy.write_bytes(changed)
        try:
            assert load_checkpoint(copy, network, optimiser, "key") == (3, [{"epoch": 3, "loss": 0.5}]), place
        except EvnlosError as error:
            assert "delete it to start afresh" in str(error)
            noticed += 1
    assert noticed > 0.9 * len(places)


def unsealed(path: Path, tensors: dict[str, torch.Tensor] | None = None) -> Path:
    """Write the weights again as earlier versions did, without a digest, perhaps with other tensors."""
    with safe_open(path, framework="pt") as file:
        about = file.metadata()["evnlos"]
        found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    other = path.with_name("unsealed.safetensors")
    other.write_bytes(save({**found, **(tensors or {})}, metadata={"evnlos": about}))
    return other


def test_weights_of_earlier_versions_load_and_say_that_nothing_vouches_for_them(
    sealed, tmp_path, capsys
) -> None:
    path = tmp_path / "w.safetensors"
    shutil.copy(sealed[0], path)
    assert load_weights(path).is_sealed
    main(["weights", str(path)])
    assert "without a digest" not in capsys.readouterr().out
    old = unsealed(path)
    assert not load_weights(old).is_sealed
    assert content_of(load_weights(old)) == content_of(load_weights(path))
    main(["weights", str(old)])
    assert "without a digest" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["nan", "inf", "complex", "integer", "boolean"])
def test_weights_that_are_no_finite_numbers_are_refused(kind: str, sealed, tmp_path) -> None:
    path = tmp_path / "w.safetensors"
    shutil.copy(sealed[0], path)
    bias = load_weights(path).network.state_dict()["unet.head.bias"]
    strange = {
        "nan": torch.full_like(bias, torch.nan),
        "inf": torch.full_like(bias, -torch.inf),
        "complex": bias.to(torch.complex64),
        "integer": bias.to(torch.int32),
        "boolean": bias > 0,
    }[kind]
    with pytest.raises(EvnlosError, match=r"NaN or infinity|floating-point") as caught:
        load_weights(unsealed(path, {"unet.head.bias": strange}))
    assert "\n" not in str(caught.value)


def test_a_network_that_diverged_is_not_written(sealed, tmp_path) -> None:
    weights = load_weights(sealed[0])
    for precision, value in ((torch.float32, torch.nan), (torch.float16, 1e6)):
        weights.network.get_parameter("unet.head.bias").data[:] = value
        with pytest.raises(EvnlosError, match="not written"):
            save_weights(tmp_path / "w.safetensors", weights, precision)
    assert not list(tmp_path.iterdir())


def test_published_weights_are_what_was_published(tmp_path, monkeypatch) -> None:
    from evnlos.models import published
    from evnlos.models import weights as module

    assert all(load_weights(name).is_sealed for name in published())
    name, path = min(published().items(), key=lambda pair: pair[1].stat().st_size)
    shutil.copy(path.parent / "SHA256SUMS", tmp_path)
    changed = bytearray(path.read_bytes())
    changed[-1000] ^= 1
    (tmp_path / path.name).write_bytes(changed)
    monkeypatch.setattr(module, "published", lambda: {name: tmp_path / path.name})
    with pytest.raises(EvnlosError, match="install"):
        load_weights(name)


def test_weights_of_ones_own_do_not_hide_published_ones(sealed, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("near-frame").mkdir()
    assert load_weights("near-frame").history  # a folder without weights hides nothing
    shutil.copy(sealed[0], "near-frame/weights.safetensors")
    with pytest.raises(EvnlosError, match="also lies in this folder"):
        load_weights("near-frame")
    assert content_of(load_weights(tmp_path / "near-frame")) == content_of(load_weights(sealed[0]))


def test_the_same_tensors_are_the_same_bytes() -> None:
    tensors = {"b": torch.arange(3.0), "a": torch.ones(2, 2)}
    assert len({sealed_bytes(tensors, '{"some": "thing"}') for _ in range(20)}) == 1


def _setup_files(folder: Path) -> dict[str, tuple[Path, Callable[[Path], tuple[Any, ...]]]]:
    """Write a measured transport, a fitted wall and a fixed pattern; return each with what reads it."""
    draw = np.random.default_rng(0)
    picture = draw.random((3, 4)).astype(np.float32)
    about = About(Plane(2, 3, 0.01), 4, 5, 100.0, notes={"checks": [1, 2]})
    measured = Measurement(torch.rand(20, 6), torch.ones(4, 5), torch.zeros(4, 5), about)
    write_measurement(folder / "t.safetensors", measured)
    plane = Plane(4, 3, 0.02)
    wall = FittedWall(
        draw.random((5, 5)), picture, picture, draw.random((8, 8)).astype(np.float32),
        draw.random((2, 3, 4)).astype(np.float32), draw.random((2, 12)).astype(np.float32),
        AboutWall(0.01, 0.1, 0.5, Plane(8, 8, 0.02), plane),
    )  # fmt: skip
    write_fitted(folder / "w.safetensors", wall)
    save_pattern(FixedPattern(picture, picture / 2), folder / "p.safetensors")

    def measurement(path: Path) -> tuple[Any, ...]:
        found = MEASUREMENT.read(path)
        return (found.about, *(one.numpy().tobytes() for one in (found.matrix, found.noise, found.dark)))

    def fitted(path: Path) -> tuple[Any, ...]:
        found = WALL.read(path)
        return (found.about, *(getattr(found, name).tobytes() for name in WALL.names))

    return {
        "measured transport": (folder / "t.safetensors", measurement),
        "fitted wall": (folder / "w.safetensors", fitted),
        "fixed pattern": (folder / "p.safetensors", lambda path: (load_pattern(path).digest,)),
    }


@pytest.mark.parametrize("kind", ["measured transport", "fitted wall", "fixed pattern"])
def test_no_flipped_byte_of_a_setup_s_file_goes_unseen(kind: str, tmp_path) -> None:
    path, read = _setup_files(tmp_path)[kind]
    whole, expected, draw = path.read_bytes(), read(path), random.Random(kind)
    places = [*range(len(whole)), *(draw.randrange(len(whole)) for _ in range(200))]
    noticed = 0
    for place in places:
        changed = bytearray(whole)
        changed[place] ^= 1 << draw.randrange(8)
        path.write_bytes(changed)
        try:
            assert read(path) == expected, place
        except EvnlosError as error:
            assert "\n" not in str(error)
            noticed += 1
    assert noticed > 0.9 * len(places)


@pytest.mark.parametrize("kind", ["measured transport", "fitted wall", "fixed pattern"])
def test_a_setup_s_file_without_a_digest_still_loads(kind: str, tmp_path) -> None:
    path, read = _setup_files(tmp_path)[kind]
    assert read(unsealed(path)) == read(path)


PARENT = """
import sys
from pathlib import Path
from evnlos.untrusted import Child
with Child(Path(sys.argv[1]), []) as child:
    print(child.take_json(), flush=True)
    child.take_json()
"""
SLEEPER = """
import os, time
from evnlos.untrusted import limit_this_process
limit_this_process(1 << 30, 60)
print(os.getpid(), flush=True)
time.sleep(1000)
"""


def test_a_child_ends_with_its_parent(tmp_path) -> None:
    (tmp_path / "sleeper.py").write_text(SLEEPER)
    call = [sys.executable, "-c", PARENT, str(tmp_path / "sleeper.py")]
    with subprocess.Popen(call, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.kill()
    until = time.monotonic() + 20
    while Path(f"/proc/{child}").exists() and time.monotonic() < until:
        if Path(f"/proc/{child}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":
            break
        time.sleep(0.05)
    else:
        assert not Path(f"/proc/{child}").exists()
