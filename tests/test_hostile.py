"""Hostile settings, captures and names: one clean line, soon, in little memory."""

import json
import os
import random
import resource
import shutil
import struct
import subprocess
import sys
import threading
import time
import zipfile
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from PIL import Image

from evnlos import EvnlosError, read_events, write_events
from evnlos.app.upload import read_upload
from evnlos.cli import main
from evnlos.config import config_hash, load_yaml, read_yaml, to_dict
from evnlos.data import Simulation, open_dataset, read_capture
from evnlos.data.simulate import object_bytes
from evnlos.data.simulations import find_faults
from evnlos.errors import ConfigError, printable
from evnlos.events.recording import Recording, summarise
from evnlos.inverse import read_photograph
from evnlos.models import UNetConfig
from evnlos.types import Events
from evnlos.untrusted import MOST_SENSOR_PIXELS

CAMERA = {"width": 72, "height": 48, "frame_rate_hz": 25.0}


def described(folder: Path, **settings: Any) -> Path:
    """Return a capture folder whose page says something else."""
    page = folder / "capture.yaml"
    page.write_text(yaml.safe_dump(yaml.safe_load(page.read_text()) | settings))
    return folder


@pytest.fixture
def capture_folder(tiny_captures, tmp_path) -> Path:
    shutil.copytree(tiny_captures[0], tmp_path / "capture_folder")
    return tmp_path / "capture_folder"


def fails(words: list[str], capsys, match: str = "") -> str:
    """Run a command that has to end in one line, and return the line."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert said.count("\n") == 1, said
    assert match in said
    return said


@pytest.mark.parametrize(
    "text",
    [
        "seed: 2001-99-99\n",
        "seed: " + "9" * 5000 + "\n",
        "setup: {a: [" + ",".join(["1"] * 900_000) + "]}\n",
        "\n".join(f"k{number}: {number}" for number in range(100_000)),
        "a: " + "x" * 10_000_000,
        "x" * 1_000_000 + ": 1\n",
        "a: &a [1]\nb: *a\n",
        "a: " + "[" * 5000 + "]" * 5000,
        "{a: " * 3000 + "1" + "}" * 3000,
        "? [1, 2]\n: 3\n",
        "a: !!python/object/apply:os.system [id]\n",
        "a: \x00\n",
        "\ufeff- 1\n",
        "a: 1\n\ta: 2\n",
        "0x" + "f" * 6000 + ": 1\n",
        "seed: 1:2:3:99999999999999999999\n",
        "seed: !!int\n",
        "seed: !!float abc\n",
        "seed: 1e999999999999\n",
    ],
    ids=lambda text: text[:20].strip().encode("unicode_escape").decode(),
)
def test_a_strange_page_is_one_line_at_once(text: str, tmp_path) -> None:
    (tmp_path / "page.yaml").write_text(text, encoding="utf-8")
    began = os.times().user
    with pytest.raises(EvnlosError) as caught:
        load_yaml(Simulation, tmp_path / "page.yaml")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 5000
    assert os.times().user - began < 5


def test_yaml_that_people_write_is_read_as_before(tmp_path) -> None:
    text = "a: 1.5\nb: [1, two, null, true, 1e-3, 0x1F, .inf]\nc: {d: 'x: y', e: 2001-01-02}\n'1': ü\n"
    (tmp_path / "a.yaml").write_text(text, encoding="utf-8")
    assert read_yaml(tmp_path / "a.yaml") == yaml.load(text, yaml.SafeLoader)


@pytest.mark.parametrize("name", ["capture.yaml", "frames.csv", "mask", "events", "frames.mp4", "dark"])
def test_a_pipe_in_a_capture_is_not_waited_for(name: str, capture_folder) -> None:
    path = capture_folder / name
    if name == "mask":
        described(capture_folder, target={"name": "A", "mask": "mask"})
    elif name not in ("capture.yaml", "frames.csv"):
        described(capture_folder, **{name.removesuffix(".mp4"): name}, camera=CAMERA)
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    refused: list[EvnlosError] = []

    def read() -> None:
        try:
            read_capture(capture_folder)
        except EvnlosError as error:
            refused.append(error)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(20)
    assert refused


@pytest.mark.parametrize("words", [["simulate", "--out", "o", "--config"], ["info"], ["weights"]])
def test_a_pipe_on_the_command_line_is_not_waited_for(words: list[str], tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe")
    ended = subprocess.run(
        [sys.executable, "-m", "evnlos", *words, "pipe"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1


@pytest.mark.parametrize("how", ["array", "picture", "table"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_frames_that_hold_no_numbers_are_refused_by_name(how: str, value: float, capture_folder) -> None:
    frames = np.full((3, 48, 72), 100.0, np.float32)
    frames[1, 5, 7] = value
    if how == "array":
        np.save(capture_folder / "bad.npy", frames)
        described(capture_folder, frames="bad.npy", camera=CAMERA)
    else:
        (capture_folder / "many").mkdir()
        for number, frame in enumerate(frames):
            Image.fromarray(frame).save(capture_folder / "many" / f"bad_{number}.tif")
        described(capture_folder, frames="many", camera=CAMERA)
    if how == "table":
        (capture_folder / "bad.csv").write_text("t_us,file\n0,many/bad_0.tif\n9,many/bad_1.tif\n")
        described(capture_folder, frames="bad.csv")
    with pytest.raises(EvnlosError, match="NaN or infinity") as caught:
        read_capture(capture_folder)
    assert "frame 1" in str(caught.value) or "bad_1" in str(caught.value)


def test_control_characters_are_written_out() -> None:
    assert printable("a\x1b]0;x\x07b\nc\u202ed\x9b\ud800") == r"a\x1b]0;x\x07b\nc\u202ed\x9b\ud800"
    assert printable("a\n\tb\x1b", lines=True) == "a\n\tb\\x1b"
    assert printable("Grüße, 世界, 1 µm") == "Grüße, 世界, 1 µm"
    assert str(ConfigError("a\nb")) == r"a\nb"
    assert len(str(ConfigError("x" * 10**7))) < 5000


def test_names_do_not_reach_the_terminal_raw(capture_folder, tmp_path, capsys) -> None:
    bad = "\x1b]0;x\x07\nsecond line"
    described(capture_folder, **{f"unknown{bad}": 1})
    assert "\x1b" not in fails(["capture", "check", str(capture_folder)], capsys)
    assert "\x1b" not in fails(["info", str(tmp_path / bad)], capsys)
    shutil.copy(next(capture_folder.glob("events*")), tmp_path / f"e{bad}.raw")
    main(["info", str(tmp_path / f"e{bad}.raw")])
    said = capsys.readouterr()
    assert "\x1b" not in said.out + said.err
    assert r"\x1b]0;x\x07\nsecond line.raw" in said.out


def test_weights_with_control_codes_are_shown_plainly(tmp_path, capsys) -> None:
    from evnlos.data import Sampling
    from evnlos.models import Weights, save_weights

    history = [{"data": {"name": "\x1b]0;x\x07\nevil", "origin": "simulation"}}]
    sampling = Sampling(height=8, width=8, pitch_m=0.01, scored_rows=8)
    network = UNetConfig(width=4, depth=1, shuffle=1, rank=0).build("frame", sampling)
    save_weights(tmp_path / "w.safetensors", Weights(network, history))
    main(["weights", str(tmp_path / "w.safetensors")])
    out = capsys.readouterr().out
    assert "\x1b" not in out
    assert r"\nevil" in out


@pytest.mark.parametrize("change", [("duration_s: 8.0", "duration_s: 3.0"), ("- ", "- x")])
def test_a_changed_page_of_a_dataset_is_found(change, tiny_dataset, tmp_path, capsys) -> None:
    folder = tmp_path / "d"
    shutil.copytree(tiny_dataset.folder, folder)
    assert find_faults(open_dataset(folder)) == []
    page = folder / "dataset.yaml"
    assert change[0] in page.read_text()
    page.write_text(page.read_text().replace(*change, 1))
    assert find_faults(open_dataset(folder))[-1].name == "dataset.yaml"
    with pytest.raises(SystemExit):
        main(["verify", str(folder)])
    assert "dataset.yaml: it is not as it was written" in capsys.readouterr().out


def test_no_flipped_byte_of_a_page_goes_unseen(tiny_dataset, tmp_path) -> None:
    whole = (tiny_dataset.folder / "dataset.yaml").read_bytes()
    expected = yaml.safe_load(whole)
    folder = tmp_path / "d"
    shutil.copytree(tiny_dataset.folder, folder)
    for place in range(0, len(whole), 29):
        changed = bytearray(whole)
        changed[place] ^= 1 << (place % 7)
        (folder / "dataset.yaml").write_bytes(changed)
        try:
            dataset = open_dataset(folder)
        except EvnlosError:
            continue
        from evnlos.data.store import is_page_changed

        assert is_page_changed(dataset) or yaml.safe_load(bytes(changed)) == expected, place


@pytest.mark.parametrize(
    "line", ['{"epoch": "one"}', '{"epoch": 1, "loss": NaN}', "[1]", "1", "{", '{"loss": 1}']
)
def test_a_garbled_log_of_a_training_is_one_line(line: str, tiny_dataset, tmp_path) -> None:
    from evnlos.models import Weights, save_weights
    from evnlos.report import collect_results

    network = UNetConfig(width=4, depth=1, rank=0).build("frame", tiny_dataset.sampling)
    save_weights(tmp_path / "weights.safetensors", Weights(network))
    (tmp_path / "metrics.jsonl").write_text(json.dumps({"epoch": 1, "loss": 0.5}) + f"\n{line}\n")
    with pytest.raises(EvnlosError, match="not a training log"):
        collect_results([tmp_path], tiny_dataset.folder, "all")


def test_small_images_are_scored_without_haarpsi() -> None:
    import torch

    from evnlos.analysis.scores import score

    pictures = torch.rand(3, 12, 24)
    found = score(pictures, pictures.clone())
    assert found.haarpsi is None
    assert found.mean()["haarpsi"] is None
    assert score(torch.rand(1, 16, 24), torch.rand(1, 16, 24)).haarpsi is not None


ROOM = 1 << 30


@pytest.fixture
def bounded_memory():
    """Refuse the process more than a gigabyte above what it has: a claim that is believed fails here."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + ROOM, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def claiming(path: Path, width: int, height: int, count: int = 3) -> Path:
    """Write a few events of a sensor that claims to be huge."""
    zeros = np.zeros(count, np.uint16)
    events = Events(np.arange(count), zeros, zeros, np.ones(count, bool), 4, 4)
    write_events(path, events)
    if path.suffix == ".h5":
        with h5py.File(path, "r+") as file:
            for holder in (file, file["events"]):
                if "width" in holder.attrs:
                    holder.attrs["width"], holder.attrs["height"] = width, height
    return path


def test_memory_follows_the_events_not_the_claimed_sensor(tmp_path, bounded_memory, capsys) -> None:
    path = claiming(tmp_path / "a.h5", 20_000, 20_000)
    main(["info", str(path), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert (found["width"], found["events"], found["busiest_pixel"]) == (
        20_000,
        3,
        {"x": 0, "y": 0, "events": 3},
    )
    assert found["active_pixel_fraction"] == 0
    fails(["preview", str(path), "--out", str(tmp_path / "a.gif")], capsys, "20000 x 20000")
    with pytest.raises(EvnlosError, match="20000 x 20000"):
        read_upload(path, tmp_path, 10**9)


def test_a_sparse_count_is_that_of_a_full_one() -> None:
    draw = np.random.default_rng(0)
    side = int(np.sqrt(MOST_SENSOR_PIXELS)) + 1
    dense, sparse = list[Events](), list[Events]()
    for _ in range(5):
        columns = np.arange(400), draw.integers(0, 40, 400), draw.integers(0, 25, 400), np.ones(400, bool)
        dense.append(Events(*columns, 40, 25))
        sparse.append(Events(*columns, side, side))
        full, found = summarise(dense), summarise(sparse)
        assert (found.active_pixels, found.busiest) == (full.active_pixels, full.busiest)


def _image_of(path: Path, width: int, height: int) -> None:
    """Write a PNG whose rows compress to nothing, without ever holding it."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(width + 1)) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = chunk(b"IHDR", head), chunk(b"IDAT", rows), chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


HOMOGRAPHY = {"homography": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}


@pytest.mark.parametrize("count", [1, 40])
@pytest.mark.parametrize("side", [13_000, 5000])
def test_huge_images_are_refused_before_they_are_decoded(
    side: int, count: int, capture_folder, bounded_memory
) -> None:
    _image_of(capture_folder / "0.png", side, side)
    for number in range(1, count):
        shutil.copy(capture_folder / "0.png", capture_folder / f"{number}.png")
    lines = [f"{1000 * number},{number}.png" for number in range(count)]
    (capture_folder / "frames.csv").write_text("\n".join(["t_us,file", *lines]))
    described(capture_folder, registration=HOMOGRAPHY, frames="frames.csv")
    if side == 5000 and count == 1:
        return
    with pytest.raises(EvnlosError, match=r"pixels|memory"):
        read_capture(capture_folder)


def test_an_image_named_many_times_is_refused(capture_folder, bounded_memory) -> None:
    _image_of(capture_folder / "one.png", 72, 48)
    lines = [f"{number},one.png" for number in range(400_000)]
    (capture_folder / "frames.csv").write_text("\n".join(["t_us,file", *lines]))
    with pytest.raises(EvnlosError, match="name every image once"):
        read_capture(capture_folder)


@pytest.mark.parametrize("form", ["array", "animation"])
def test_frames_beyond_the_memory_are_refused(form: str, capture_folder, bounded_memory) -> None:
    if form == "array":
        name = "many.npy"
        with (capture_folder / name).open("wb") as file:
            head = {"descr": "|u1", "fortran_order": False, "shape": (400, 1000, 1000)}
            np.lib.format.write_array_header_1_0(file, head)
            file.truncate(file.tell() + 400_000_000)  # a hole, which takes no space
    else:
        name = "many.gif"
        many = [Image.new("L", (300, 300), number) for number in range(1, 20)]
        Image.new("L", (300, 300)).save(capture_folder / name, save_all=True, append_images=many)
    described(capture_folder, frames=name, registration=HOMOGRAPHY, camera=CAMERA)
    with pytest.raises(EvnlosError, match="memory"):
        read_capture(capture_folder, None if form == "array" else 1 << 20)


@pytest.mark.parametrize("sides", [(20_000, 20_000), (0, 5), (-1, 5), (10**30, 1)])
def test_a_camera_has_a_size(sides, capture_folder) -> None:
    described(capture_folder, camera={"width": sides[0], "height": sides[1]})
    with pytest.raises(EvnlosError):
        read_capture(capture_folder)


def test_a_chunk_of_many_events_is_unpacked_once_or_refused(tmp_path) -> None:
    count = 2_000_000
    columns = {
        "t": np.arange(count),
        "x": np.zeros(count, "u2"),
        "y": np.zeros(count, "u2"),
        "p": np.ones(count, "u1"),
    }
    for name, factor in (("large", 1), ("huge", 10)):
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            for key, values in columns.items():
                size = factor * count
                data = file.create_dataset(
                    f"events/{key}",
                    (size,),
                    values.dtype,
                    chunks=(size,),
                    compression="gzip",
                    compression_opts=1,
                )
                data[:count] = values
    began = time.process_time()
    pieces = Recording(tmp_path / "large.h5", width=4, height=4).pieces()
    assert sum(len(piece) for piece in pieces) == count
    assert time.process_time() - began < 10
    with pytest.raises(EvnlosError, match="chunks of 160 MB"):
        read_events(tmp_path / "huge.h5", width=4, height=4)


@pytest.mark.parametrize(
    "flags",
    [
        ["--fps", "1e-300"], ["--fps", "1e300"], ["--fps", "nan"], ["--fps", "0"], ["--slow-motion", "1e-300"],
        ["--slow-motion", "inf"], ["--white", "1e-300"], ["--scale", "16000x16000"], ["--scale", "1e300"],
        ["--scale", "1e-300"], ["--scale", "nan"], ["--scale", "x"], ["--scale", "99999x99999"],
    ],
    ids=" ".join,
)  # fmt: skip
def test_absurd_numbers_of_a_video_are_one_line(flags: list[str], tmp_path, capsys, bounded_memory) -> None:
    np.save(tmp_path / "v.npy", np.arange(3 * 48, dtype=np.uint8).reshape(3, 6, 8))
    words = ["events", str(tmp_path / "v.npy"), "--out", str(tmp_path / "o.h5"), *flags]
    fails(words if "--fps" in flags else [*words, "--fps", "10"], capsys)
    assert not (tmp_path / "o.h5").exists()


NUMBERS = [
    "1e300",
    "1e-300",
    ".inf",
    "-.inf",
    ".nan",
    "0",
    "-1",
    str(2**70),
    "9" * 5000,
    "[1]",
    "x",
    "true",
    "{}",
]


def _leaves(values: dict[str, Any], path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    found = []
    for key, value in values.items():
        found += _leaves(value, (*path, key)) if isinstance(value, dict) else [(*path, key)]
    return found


def test_settings_at_their_extremes_are_refused_or_fit(tmp_path, bounded_memory) -> None:
    """Each number of a simulation in turn; what is taken can be written, hashed and estimated."""
    whole = to_dict(Simulation())
    refused = 0
    for path in _leaves(whole):
        for number in NUMBERS:
            values: dict[str, Any] = {}
            inner = values
            for key in path[:-1]:
                inner = inner.setdefault(key, {})
                if "kind" in whole.get(key, {}):
                    inner["kind"] = whole[key].get("kind")
            inner[path[-1]] = "VALUE"
            text = yaml.safe_dump(values).replace("VALUE", number)
            (tmp_path / "s.yaml").write_text(text)
            try:
                found = load_yaml(Simulation, tmp_path / "s.yaml")
            except EvnlosError as error:
                assert "\n" not in str(error)
                refused += 1
                continue
            assert object_bytes(found) >= 0, (path, number)
            assert config_hash(found)
    assert refused > 300


@pytest.mark.parametrize(
    "settings",
    [{"sensor": {"height": 8192, "width": 8192}, "positions": 4000}, {"duration_s": 1e7}, {"positions": 10**9}],
)
def test_a_simulation_beyond_the_memory_is_refused_first(settings, tmp_path, capsys) -> None:
    (tmp_path / "s.yaml").write_text(yaml.safe_dump(settings))
    words = ["simulate", "--config", str(tmp_path / "s.yaml"), "--out", str(tmp_path / "d")]
    fails([*words, "--log-level", "error"], capsys, "memory")
    assert not (tmp_path / "d").exists()


LARGE = "setup: {kind: radiometric, cell_m: 0.001, sensor: {height: 2000, width: 2000}}"


@pytest.mark.parametrize(
    "words",
    [
        ["train", "--simulate", "s.yaml", "--out", "d"],
        ["lab", "--config", "s.yaml", "--out", "d"],
        [
            "events",
            "v.npy",
            "--fps",
            "1",
            "--pixel.leak-rate-hz",
            "1e6",
            "--scale",
            "2000x2000",
            "--out",
            "d.h5",
        ],
    ],
    ids=lambda words: words[0],
)
def test_every_simulation_is_estimated_first(words: list[str], tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("s.yaml").write_text(LARGE)
    np.save("v.npy", np.zeros((3, 4, 4), np.uint8))
    fails([*words, "--log-level", "error"], capsys, "GB of memory")
    assert {path.name for path in tmp_path.iterdir()} == {"s.yaml", "v.npy"}


class BegunError(Exception):
    pass


@pytest.mark.parametrize(
    "words",
    [
        ["experiment", "simulation", "--writers", "1", "--workers", "1"],
        ["experiment", "mismatch", "--setups", "torch", "--seeds", "0", "--workers", "1"],
        ["demo", "--workers", "1"],
    ],
    ids=lambda words: words[words[0] == "experiment"],
)
def test_experiments_are_estimated_first_and_can_be_forced(words, tmp_path, capsys, monkeypatch) -> None:
    def begun(*_: object) -> None:
        raise BegunError

    monkeypatch.setattr("evnlos.untrusted.memory_left", lambda: 1000)
    # By name: the package's attribute `simulate` is the function, not the module.
    monkeypatch.setattr(sys.modules["evnlos.data.simulate"], "scene_of", begun)
    monkeypatch.setattr("evnlos.data.lab.with_others", begun)
    with pytest.raises(SystemExit) as ended:
        main([*words, "--out", str(tmp_path / "o"), "--log-level", "error"])
    assert ended.value.code == 2
    assert "GB of memory" in capsys.readouterr().err.splitlines()[-1]
    with pytest.raises(BegunError):
        main([*words, "--out", str(tmp_path / "o"), "--log-level", "error", "--force"])


def test_a_repair_is_estimated_first_and_can_be_forced(tiny_dataset, tmp_path, capsys, monkeypatch) -> None:
    folder = tmp_path / "d"
    shutil.copytree(tiny_dataset.folder, folder)
    open_dataset(folder).shard(tiny_dataset.objects()[0]).unlink()
    monkeypatch.setattr("evnlos.untrusted.memory_left", lambda: 1000)
    with pytest.raises(SystemExit):
        main(["verify", str(folder), "--repair", "--workers", "1"])
    assert "GB of memory" in capsys.readouterr().err.splitlines()[-1]
    main(["verify", str(folder), "--repair", "--workers", "1", "--force"])
    assert find_faults(open_dataset(folder)) == []


@pytest.mark.parametrize("path", ["setup", "setup.pixel", "glyphs"])
def test_a_kind_in_a_file_brings_no_program(path: str, tmp_path, monkeypatch) -> None:
    """Only what is installed, or was registered before, has a name."""
    (tmp_path / "trap.py").write_text("class Trap:\n    kind = 'trap'\n")
    monkeypatch.syspath_prepend(tmp_path)
    for kind in ("trap", "trap:Trap", "trap.Trap", "trap.py", str(tmp_path / "trap.py")):
        values: dict[str, Any] = {"kind": kind}
        for key in reversed(path.split(".")):
            values = {key: values}
        (tmp_path / "s.yaml").write_text(yaml.safe_dump(values))
        with pytest.raises(ConfigError, match="kind") as caught:
            load_yaml(Simulation, tmp_path / "s.yaml")
        assert "\n" not in str(caught.value)
    assert "trap" not in sys.modules


def test_memory_that_is_not_enough_is_one_line(monkeypatch, capsys) -> None:
    def too_much(_: object) -> None:
        raise MemoryError

    monkeypatch.setattr("evnlos.cli.about.entries_for", too_much)
    fails(["cite"], capsys, "the memory that this process may use is not enough")


def test_more_processes_need_more_memory(tmp_path, monkeypatch) -> None:
    from evnlos.data import simulate
    from evnlos.data.lab import Lab, render_captures

    monkeypatch.setattr("evnlos.untrusted.memory_left", lambda: 4 * object_bytes(Simulation()))
    with pytest.raises(EvnlosError, match="fewer --workers"):
        simulate(Simulation(), tmp_path / "d", workers=3)
    monkeypatch.setattr("evnlos.untrusted.memory_left", lambda: 1000)
    with pytest.raises(EvnlosError, match="GB of memory"):
        render_captures(Lab(), tmp_path / "d")
    assert not (tmp_path / "d").exists()
    assert render_captures(Lab(), tmp_path / "d", names=[], force=True) == []


def test_a_video_of_too_many_pixels_is_refused_before_it_is_read(tmp_path, capsys) -> None:
    path = tmp_path / "v.npy"
    with path.open("wb") as file:
        header = {"descr": "|u1", "fortran_order": False, "shape": (2, 60_000, 60_000)}
        np.lib.format.write_array_header_1_0(file, header)
        file.truncate(file.tell() + 2 * 60_000**2)  # a sparse file: nothing is on the disk
    words = ["events", str(path), "--fps", "9", "--out", str(tmp_path / "e.h5")]
    fails(words, capsys, "at most 67,108,864")
    np.save(path, np.zeros((2, 4100, 4100), np.uint8))
    fails(words, capsys, "at most 16,777,216")
    assert {one.name for one in tmp_path.iterdir()} == {"v.npy"}


def test_a_film_of_too_many_pixels_is_refused_before_it_is_decoded(tmp_path, monkeypatch) -> None:
    av = pytest.importorskip("av")
    from evnlos.cameras.video import open_video

    with av.open(tmp_path / "v.avi", "w") as film:
        stream = film.add_stream("mjpeg", rate=5, width=64, height=48, pix_fmt="yuvj420p")
        for _ in range(3):
            film.mux(stream.encode(av.VideoFrame(64, 48, "yuvj420p")))
        film.mux(stream.encode(None))
    assert open_video(tmp_path / "v.avi").width == 64
    monkeypatch.setattr("evnlos.cameras.video_files.MOST_IMAGE_PIXELS", 1000)
    with pytest.raises(EvnlosError, match="at most 1,000"):
        open_video(tmp_path / "v.avi")


def _npz(path: Path, count: int, header: bytes | None = None) -> Path:
    """Write an event file whose columns are zeros, one of them perhaps under another header."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, dtype in (("t_us", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "|b1")):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                if header is not None and name == "p":
                    member.write(header)
                    for _ in range(256):
                        member.write(b" " * (1 << 20))
                    continue
                about = {"descr": dtype, "fortran_order": False, "shape": (count,)}
                np.lib.format.write_array_header_1_0(member, about)
                member.write(bytes(count * np.dtype(dtype).itemsize))
    return path


def test_events_of_an_archive_beyond_the_memory_are_refused_before_they_are_read(tmp_path, monkeypatch) -> None:
    path = _npz(tmp_path / "e.npz", 3_000_000)
    assert path.stat().st_size < 100_000
    monkeypatch.setattr("evnlos.untrusted.memory_left", lambda: 100_000_000)
    began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(EvnlosError, match="3,000,000 events"):
        read_events(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - began < 30_000
    assert sum(len(piece) for piece in Recording(path).pieces()) == 3_000_000


def test_a_header_of_megabytes_in_an_archive_is_not_read(tmp_path) -> None:
    path = _npz(tmp_path / "e.npz", 10, b"\x93NUMPY\x02\x00" + (256 << 20).to_bytes(4, "little"))
    began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(EvnlosError, match="NPY version"):
        read_events(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - began < 30_000


def photograph(**changes: Any) -> dict[str, Any]:
    axis = np.linspace(-0.2, 0.2, 8)
    arrays = {
        "wall": np.random.default_rng(0).random((8, 8)),
        "wall_x_m": axis, "wall_z_m": axis, "cell_x_m": axis[:4], "cell_z_m": axis[:4],
        "cell_size_m": np.array([0.1, 0.1]), "distance_m": np.array(1.0),
    }  # fmt: skip
    return {**arrays, **changes}


@pytest.mark.parametrize(
    "changes",
    [
        {"distance_m": np.array(np.nan)}, {"distance_m": np.array([1.0, 2.0])},
        {"wall": np.zeros((8, 8), complex)},
        {"wall": np.array(["a"])}, {"wall": np.full((8, 8), np.inf)}, {"cell_size_m": np.zeros(0)},
        {"cell_x_m": np.zeros((2, 2))}, {"wall_x_m": np.zeros(3)}, {"occluder_polygons_m": np.zeros(5)},
        {"emission_exponent": np.zeros(3)}, {"truth": np.zeros((9, 9))}, {"distance_m": np.array(0.0)},
        {"emission_exponent": np.array([-1.0, 0.0])},
        {"wall": np.zeros((8, 8))}, {"cell_size_m": np.array([1e300, 1e-300])}, {"wall": np.zeros((2, 3, 4))},
    ],
    ids=str,
)  # fmt: skip
def test_a_misshapen_photograph_is_one_line(changes, tmp_path, capsys) -> None:
    np.savez(tmp_path / "p.npz", **photograph(**changes))
    fails(["invert", str(tmp_path / "p.npz"), "--solvers", "tikhonov", "--out", str(tmp_path / "o")], capsys)


def test_a_damaged_photograph_is_a_result_or_one_line(tmp_path) -> None:
    np.savez_compressed(tmp_path / "p.npz", **photograph())
    whole, draw, refused = (tmp_path / "p.npz").read_bytes(), random.Random(0), 0
    read_photograph(tmp_path / "p.npz")
    for _ in range(150):
        changed = bytearray(whole)
        for _ in range(draw.choice((1, 2, 8))):
            changed[draw.randrange(len(whole))] = draw.randrange(256)
        (tmp_path / "d.npz").write_bytes(
            bytes(changed[: draw.choice((len(whole), draw.randrange(len(whole))))])
        )
        try:
            read_photograph(tmp_path / "d.npz")
        except EvnlosError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > 50


@pytest.mark.parametrize("offset", [2**62 + 1, 2**63, -(2**63), 2**70])
def test_a_clock_beyond_64_bits_is_refused(offset: int, capture_folder) -> None:
    described(capture_folder, alignment={"offset_us": offset})
    with pytest.raises(EvnlosError):
        read_capture(capture_folder)


def test_the_corpus_of_findings_ends_well(tmp_path) -> None:
    """Files that once ended in a traceback, took too much, or reached what no other did."""
    from fuzz_inputs import replay

    assert replay(tmp_path) == []


def test_hostile_inputs_of_every_kind_end_well(tmp_path) -> None:
    """A part of `python tests/fuzz_inputs.py`, whose list of 2,400 takes minutes."""
    from fuzz_inputs import run

    assert run(128, seed=7, base=tmp_path) == []
