"""Files of strangers on the page: shown, or refused in one line, and nothing of them stays."""

import stat
import threading
import time
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from evnlos.app.page import uploaded
from evnlos.app.upload import MOST_FILES, read_upload, read_upload_apart, unpack_zip
from evnlos.app.views import Networks
from evnlos.errors import DataError
from evnlos.events import write_events
from evnlos.models import load_weights
from evnlos.untrusted import Child

MB = 1_000_000


def archive(path: Path, *names: str, content: bytes = b"x", mode: int = 0) -> Path:
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        warnings.simplefilter("ignore")  # of names that are there twice
        for name in names:
            entry = zipfile.ZipInfo(name)
            entry.external_attr, entry.compress_type = mode << 16, zipfile.ZIP_DEFLATED
            made.writestr(entry, content)
    return path


@pytest.mark.parametrize(
    "name",
    ["../evil", "a/../../evil", "/evil", "a/../evil", "..\\evil", "C:\\evil", "C:evil", "\\\\host\\evil"],
)
def test_no_name_in_a_zip_leads_out(name: str, tmp_path) -> None:
    with pytest.raises(DataError, match="leads out"):
        unpack_zip(archive(tmp_path / "z.zip", "good", name), tmp_path / "in" / "side", MB)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["z.zip"]


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR, stat.S_IFSOCK])
def test_links_and_devices_are_refused(kind: int, tmp_path) -> None:
    path = archive(tmp_path / "z.zip", "link", content=b"/etc/passwd", mode=kind | 0o777)
    with pytest.raises(DataError, match="link or a device"):
        unpack_zip(path, tmp_path / "out", MB)


def test_sizes_in_a_zip_are_not_believed(tmp_path) -> None:
    path = archive(tmp_path / "bomb.zip", "zeros", content=bytes(20 * MB))
    assert path.stat().st_size < MB / 10
    with pytest.raises(DataError, match="unpacks to more than 1 MB"):
        unpack_zip(path, tmp_path / "a", MB)
    assert sum(p.stat().st_size for p in (tmp_path / "a").rglob("*")) <= MB
    # The same with headers that claim a single byte.
    lying = bytearray(path.read_bytes())
    for mark, offset in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
        at = lying.index(mark) + offset
        lying[at : at + 4] = (1).to_bytes(4, "little")
    path.write_bytes(lying)
    with pytest.raises(DataError):
        unpack_zip(path, tmp_path / "b", MB)
    assert sum(p.stat().st_size for p in (tmp_path / "b").rglob("*")) <= MB
    # Many small files add up.
    path = archive(tmp_path / "many.zip", *(f"{k}" for k in range(12)), content=bytes(100_000))
    with pytest.raises(DataError, match="more than 1 MB"):
        unpack_zip(path, tmp_path / "c", MB)


def test_other_strange_zips_are_one_line(tmp_path) -> None:
    whole = archive(tmp_path / "good.zip", "a/b", "c", content=bytes(range(256)) * 9).read_bytes()
    assert [p.name for p in unpack_zip(tmp_path / "good.zip", tmp_path / "good", MB)] == ["b", "c"]
    for k, content in enumerate(
        (whole[:-30], whole[: len(whole) // 2], b"PK\x03\x04", b"", whole[:40] + bytes(20) + whole[60:])
    ):
        path = tmp_path / f"{k}.zip"
        path.write_bytes(content)
        with pytest.raises(DataError):
            unpack_zip(path, tmp_path / f"out{k}", MB)
    for name, names, message in (
        ("twice", ("a", "a"), "twice"),
        ("both", ("a", "a/b"), "twice|cannot be unpacked"),
        ("many", tuple(str(k) for k in range(MOST_FILES + 1)), "at most 5000"),
        ("long", ("n" * 5000,), "cannot be unpacked"),
    ):
        with pytest.raises(DataError, match=message):
            unpack_zip(archive(tmp_path / f"{name}.zip", *names), tmp_path / name, MB)
    # A list of files that would fill the memory before it could be counted.
    huge = bytearray(whole)
    huge[-10:-6] = (1 << 30).to_bytes(4, "little")
    (tmp_path / "huge.zip").write_bytes(huge)
    with pytest.raises(DataError, match="too many files"):
        unpack_zip(tmp_path / "huge.zip", tmp_path / "huge", MB)
    locked = bytearray(whole)
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        locked[locked.index(mark) + offset] |= 1
    (tmp_path / "locked.zip").write_bytes(locked)
    with pytest.raises(DataError, match="encrypted"):
        unpack_zip(tmp_path / "locked.zip", tmp_path / "locked", MB)


def test_a_capture_is_shown_and_reconstructed_and_nothing_stays(zipped_capture, app_weights, tmp_path) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    found = read_upload(zipped_capture, scratch, 10 * MB)
    assert (
        len(found) == 8
        and found.motion is not None
        and found.target is not None
        and found.frames.shape == (8, 48, 72)
    )
    pictures, message = uploaded(
        str(zipped_capture), scratch, 10 * MB, Networks({"net": load_weights(app_weights["fusion"])})
    )
    for title in (">Hidden object<", ">Wall<", ">Events<", ">Net<", ">Space-time cloud<"):
        assert title in pictures
    assert "ev-note" in message and "events from" in message
    # Those of the package see it where it says how its target moved.
    packaged = uploaded(str(zipped_capture), scratch, 10 * MB, Networks())[0]
    assert all(f">Network, {seen}<" in packaged for seen in ("frames", "events", "both"))
    still = replace(found, motion=None)
    assert not Networks().of(still) and list(Networks().of(replace(found, frames=None))) == ["network, events"]
    assert list(scratch.iterdir()) == []


def test_what_rests_and_changes_is_shown_as_a_film(zipped_capture, app_sequence, tmp_path) -> None:
    given = str(zipped_capture), tmp_path, 10 * MB, Networks()
    pictures, message = uploaded(*given, rests=True, sides_m=(0.2, 0.1))
    assert ">Film, frames<" in pictures and ">Network" not in pictures
    assert "film of a plane of 20 cm x 10 cm" in message and "ev-note" in message
    unstated = tmp_path / "unstated.zip"
    with zipfile.ZipFile(zipped_capture) as whole, zipfile.ZipFile(unstated, "w") as made:
        for name in whole.namelist():
            content = whole.read(name)
            if name.endswith("capture.yaml"):
                about = yaml.safe_load(content)
                del about["motion"]
                content = yaml.safe_dump(about).encode()
            made.writestr(name, content)
    assert ">Film, frames<" in uploaded(str(unstated), *given[1:])[0]
    message = uploaded(str(unstated), *given[1:], sides_m=(0.0, 0.1))[1]
    assert "0 x 0.1 m of 16 cells; give sides above 0" in message and 'role="alert"' in message
    write_events(tmp_path / "walk.raw", app_sequence.events)
    assert "without frames there is no film" in uploaded(str(tmp_path / "walk.raw"), *given[1:], rests=True)[1]


@pytest.mark.parametrize("suffix", [".raw", ".npz", ".csv", ".h5"])
def test_a_recording_is_shown(suffix: str, app_sequence, app_weights, tmp_path) -> None:
    path = tmp_path / f"walk{suffix}"
    write_events(path, app_sequence.events)
    found = read_upload(path, tmp_path, 10 * MB)
    assert found.events == app_sequence.events and len(found) == 40 and found.frames is None
    networks = Networks({name: load_weights(one) for name, one in app_weights.items()})
    pictures, message = uploaded(str(path), tmp_path, 10 * MB, networks)
    assert ">Event<" in pictures and ">Fusion<" not in pictures and ">Wall<" not in pictures
    assert "fusion looks at frames" in message
    assert "start the page with --weights" in uploaded(str(path), tmp_path, 10 * MB, Networks())[1]
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


def test_bad_uploads_are_one_line_without_this_machines_folders(
    app_sequence, zipped_capture, tmp_path, monkeypatch
) -> None:
    def said(name: str, content: bytes, limit: int = MB) -> str:
        path = tmp_path / name
        path.write_bytes(content)
        pictures, message = uploaded(str(path), tmp_path, limit, Networks())
        assert pictures == "" and 'role="alert"' in message and str(tmp_path) not in message
        return message

    assert "--upload-mb" in said("large.raw", bytes(2 * MB))
    assert "unpacks to more" in said(
        "bomb.zip", archive(tmp_path / "b", "capture.yaml", content=bytes(9 * MB)).read_bytes()
    )
    assert "capture.yaml" in said("none.zip", archive(tmp_path / "n", "a.txt").read_bytes())
    monkeypatch.setattr("evnlos.app.page.read_upload_apart", read_upload)  # the others without a new process
    assert "leads out" in said("slip.zip", archive(tmp_path / "s", "../capture.yaml").read_bytes())
    assert "no known event format" in said("noise.bin", bytes(range(256)) * 40)
    said("empty.raw", b"")
    outside = b"camera: {width: 8, height: 8}\nevents: ../../../etc/passwd\nframes: frames.csv\n"
    assert "outside" in said("out.zip", archive(tmp_path / "o", "c/capture.yaml", content=outside).read_bytes())
    vast = outside.replace(b"8", b"60000")
    assert "at most" in said("vast.zip", archive(tmp_path / "v", "c/capture.yaml", content=vast).read_bytes())
    assert "no file yet" in uploaded(None, tmp_path, MB, Networks())[1]
    monkeypatch.setattr("evnlos.app.upload.MOST_EVENTS", 100)
    with pytest.raises(DataError, match="100 events or more"):
        read_upload(zipped_capture, tmp_path, 10 * MB)
    write_events(tmp_path / "long.npz", app_sequence.events)
    cut = read_upload(tmp_path / "long.npz", tmp_path, 10 * MB)
    assert len(cut.events) == 100 and "only the first 100" in cut.notes[-1]


SLOW = """
import runpy, sys, time
if "slow" in sys.argv[1]:
    time.sleep(1000)
runpy.run_path({program!r}, run_name="__main__")
"""


def reader(tmp_path: Path, monkeypatch, text: str) -> None:
    """Let another program read the uploads, and give it less time."""
    from evnlos.app import upload

    other = tmp_path / "reader.py"
    other.write_text(text.format(program=upload.__file__))
    monkeypatch.setattr(upload, "Child", lambda _, words, seconds: Child(other, words, min(seconds, 15)))


def test_what_a_process_of_its_own_reads_is_the_same(zipped_capture, app_sequence, tmp_path) -> None:
    write_events(tmp_path / "walk.raw", app_sequence.events)
    for path in (zipped_capture, tmp_path / "walk.raw"):
        here, apart = read_upload(path, tmp_path, 10 * MB), read_upload_apart(path, tmp_path, 10 * MB)
        assert here.events == apart.events and here.edges_us.tolist() == apart.edges_us.tolist()
        assert (here.frames is None) == (apart.frames is None)
        assert here.frames is None or (here.frames.tobytes(), here.frames.dtype) == (
            apart.frames.tobytes(),
            apart.frames.dtype,
        )
        for name in ("name", "peak", "motion", "target", "distance_m", "notes"):
            assert getattr(here, name) == getattr(apart, name), name


def test_an_upload_that_hangs_holds_nobody(app_sequence, tmp_path, monkeypatch) -> None:
    reader(tmp_path, monkeypatch, SLOW)
    for name in ("slow.raw", "walk.raw"):
        write_events(tmp_path / name, app_sequence.events)
    said: list[tuple[str, str]] = []
    hangs = threading.Thread(
        target=lambda: said.append(uploaded(str(tmp_path / "slow.raw"), tmp_path, MB, Networks()))
    )
    hangs.start()
    began = time.monotonic()
    pictures, _ = uploaded(str(tmp_path / "walk.raw"), tmp_path, MB, Networks())
    assert pictures
    assert hangs.is_alive(), f"the other was answered after {time.monotonic() - began:.0f} s only"
    hangs.join(60)
    assert said[0][0] == "" and "longer than" in said[0][1]
    assert {one.name for one in tmp_path.iterdir()} == {"reader.py", "slow.raw", "walk.raw"}


@pytest.mark.parametrize(
    "text",
    [
        "import os\nos.kill(os.getpid(), 9)",
        "import os\nos.abort()",
        "raise MemoryError",
        "print('{{\"arrays\": [')",
        "x = bytearray(1 << 20)\nprint('half a line', end='')",
    ],
)
def test_a_reader_that_dies_is_one_line(text: str, app_sequence, tmp_path, monkeypatch) -> None:
    reader(tmp_path, monkeypatch, text)
    write_events(tmp_path / "walk.raw", app_sequence.events)
    pictures, message = uploaded(str(tmp_path / "walk.raw"), tmp_path, MB, Networks())
    assert pictures == "" and 'role="alert"' in message and str(tmp_path) not in message
    with pytest.raises(DataError):
        read_upload_apart(tmp_path / "walk.raw", tmp_path, MB)
    assert {one.name for one in tmp_path.iterdir()} == {"reader.py", "walk.raw"}


def test_an_upload_may_not_take_all_memory(app_sequence, tmp_path, monkeypatch) -> None:
    reader(
        tmp_path,
        monkeypatch,
        "import sys\nfrom evnlos.untrusted import limit_this_process\n"
        "limit_this_process(int(sys.argv[4]), int(sys.argv[5]))\nbytearray(4 << 30)",
    )
    write_events(tmp_path / "walk.raw", app_sequence.events)
    with pytest.raises(DataError, match="MemoryError"):
        read_upload_apart(tmp_path / "walk.raw", tmp_path, MB)
