"""Files and folders are whole or not there: full disks, devices, two processes, what a dead one left."""

import os
import resource
import stat
import subprocess
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from evnlos import Events, EvnlosError, read_events, write_events
from evnlos.events import write_aedat4
from evnlos.files import directory_lock, new_file, new_folder, write_atomically

MOST_BYTES = 40_000


def limited(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python where no file may grow beyond `MOST_BYTES`: what a full disk is to a program."""
    limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (MOST_BYTES, MOST_BYTES))
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=120, preexec_fn=limit
    )


def many_events(count: int = 200_000) -> Events:
    draw = np.random.default_rng(0)
    return Events(
        np.sort(draw.integers(0, 10**7, count)),
        draw.integers(0, 1280, count),
        draw.integers(0, 800, count),
        draw.integers(0, 2, count).astype(bool),
        width=1280,
        height=800,
    )


FULL = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_files import many_events
from evnlos import EvnlosError, write_events
folder, events = Path(sys.argv[1]), many_events()
for name in ("a.h5", "a.aedat4", "a.npz", "a.csv", "a.raw", "a_100M.bin"):
    try:
        write_events(folder / name, (events[i : i + 70_000] for i in range(0, len(events), 70_000)))
    except EvnlosError as error:
        print(name, error)
"""


def test_event_files_on_a_full_disk_are_one_line_and_nothing_is_left(tmp_path) -> None:
    """HDF5 used to end in a segmentation fault: the library can't give up a file that it failed to write."""
    full = limited(FULL, str(tmp_path), str(Path(__file__).parent))
    assert full.returncode == 0, full.stderr[-2000:]
    lines = full.stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["a.h5", "a.aedat4", "a.npz", "a.csv", "a.raw", "a_100M.bin"]
    assert all("writing failed" in line and "[Errno 27] File too large" in line for line in lines), lines
    assert full.stderr == ""
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_not_on_the_disk_does_not_get_its_name(tmp_path, monkeypatch) -> None:
    """A file system may say only at the end that there is no space: delayed allocation, quotas, networks."""

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    write_atomically(tmp_path / "a.txt", b"before")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_atomically(tmp_path / "a.txt", b"after")
    with pytest.raises(EvnlosError, match="No space"):
        write_events(tmp_path / "b.h5", many_events(10))
    with pytest.raises(OSError, match="No space"), new_folder(tmp_path / "c") as draft:
        (draft / "x").write_bytes(b"x")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_bytes() == b"before"


def test_folders_above_a_file_are_made_and_go_again_where_it_fails(tmp_path) -> None:
    write_atomically(tmp_path / "a/b/c.txt", b"whole")
    assert (tmp_path / "a/b/c.txt").read_bytes() == b"whole"
    with pytest.raises(ZeroDivisionError), new_file(tmp_path / "a/d/e/f") as temporary:
        temporary.write_bytes(bytes(1 // 0))
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["b"]


def test_an_error_names_the_file_and_not_the_draft(tmp_path, monkeypatch) -> None:
    def refused(self: Path, content: bytes) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "write_bytes", refused)
    with pytest.raises(OSError) as caught:
        write_atomically(tmp_path / "x.png", b"")
    assert str(caught.value) == f"[Errno 13] Permission denied: {str(tmp_path / 'x.png')!r}"


def test_an_error_in_the_middle_of_a_file_leaves_none(tmp_path) -> None:
    events = many_events(10)
    with pytest.raises(EvnlosError, match="frames"):
        write_aedat4(tmp_path / "a.aedat4", events, np.zeros((2, 4, 4), np.uint8), np.array([0]))
    with pytest.raises(ZeroDivisionError), new_file(tmp_path / "b") as temporary:
        temporary.write_bytes(bytes(1 // 0))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["device", "pipe", "folder", "link to a device"])
def test_what_is_no_plain_file_is_not_replaced(kind: str, tmp_path) -> None:
    path = tmp_path / "x.csv"
    try:
        if kind == "device":
            os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        elif kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        else:
            path.symlink_to("/dev/null")
    except PermissionError:
        pytest.skip("making a device needs root")
    before = path.lstat()
    with pytest.raises(EvnlosError, match="no plain file"):
        write_atomically(path, b"x")
    with pytest.raises(EvnlosError, match="no plain file"):
        write_events(path, many_events(10))
    assert path.lstat().st_mode == before.st_mode
    assert list(tmp_path.iterdir()) == [path]


def test_a_new_folder_is_there_whole_or_not_at_all(tmp_path) -> None:
    out = tmp_path / "out"
    with suppress(ZeroDivisionError), new_folder(out) as draft:
        (draft / "a").write_bytes(b"a")
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
    with new_folder(out) as draft:
        (draft / "a").write_bytes(b"a")
        assert not out.exists()
        with pytest.raises(EvnlosError, match="another process is at work"), new_folder(out):
            pass
    assert [path.name for path in out.iterdir()] == ["a"]
    with pytest.raises(EvnlosError, match="not an empty folder"), new_folder(out):
        pass


def test_an_empty_folder_stays_and_is_filled(tmp_path) -> None:
    out = tmp_path / "out"
    out.mkdir(mode=0o750)
    number = out.stat().st_ino
    with suppress(ZeroDivisionError), new_folder(out) as draft:
        (draft / "a").write_bytes(b"a")
        raise ZeroDivisionError
    assert list(out.iterdir()) == []
    with new_folder(out) as draft:
        (draft / "a").write_bytes(b"a")
        with pytest.raises(EvnlosError, match="another process is at work"), new_folder(out):
            pass
    assert [path.name for path in out.iterdir()] == ["a"]
    assert out.stat().st_ino == number


DIES = """
import os, sys
from evnlos.files import new_file, new_folder
with new_file(sys.argv[1] + "/file") as temporary, new_folder(sys.argv[1] + "/folder") as draft:
    temporary.write_bytes(b"half")
    (draft / "half").write_bytes(b"half")
    os.kill(os.getpid(), 9)
"""


def test_what_a_dead_process_left_goes_with_the_next(tmp_path) -> None:
    subprocess.run([sys.executable, "-c", DIES, str(tmp_path)], timeout=60)
    assert len(list(tmp_path.iterdir())) == 2
    with new_file(tmp_path / "file") as temporary:
        temporary.write_bytes(b"whole")
    with new_folder(tmp_path / "folder") as draft:
        (draft / "whole").write_bytes(b"whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["whole"]


def test_a_folder_that_nothing_came_into_goes_again(tmp_path) -> None:
    there = tmp_path / "there"
    there.mkdir()
    for folder in (tmp_path / "new" / "d", there):
        with suppress(ZeroDivisionError), directory_lock(folder):
            raise ZeroDivisionError
        with suppress(ZeroDivisionError), new_folder(folder / "e"):
            raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == [there] and not list(there.iterdir())
    with suppress(ZeroDivisionError), directory_lock(there):
        (there / "begun").write_text("half")
        raise ZeroDivisionError
    assert {one.name for one in there.iterdir()} == {".lock", "begun"}


def test_shares_exclude_the_whole_and_not_each_other(tmp_path) -> None:
    """Else the whole would sweep away what a share is writing."""
    folder = tmp_path / "d"
    with directory_lock(folder, "1-of-2"), directory_lock(folder, "2-of-2"):
        for part in ("", "1-of-2"):
            with pytest.raises(EvnlosError, match="another process is at work"), directory_lock(folder, part):
                pass
    with (
        directory_lock(folder),
        pytest.raises(EvnlosError, match="another process"),
        directory_lock(folder, "1-of-2"),
    ):
        pass
    with directory_lock(folder, "1-of-2"):
        pass


def test_hdf5_that_outgrows_its_times_is_whole(tmp_path) -> None:
    """Reads its own file back while it is written."""
    first, late = many_events(70_000), many_events(10)
    moved = Events(late.t_us + 2**33, late.x, late.y, late.p, width=1280, height=800)
    write_events(tmp_path / "a.h5", [first, moved])
    back = read_events(tmp_path / "a.h5")
    assert np.array_equal(back.t_us, np.concatenate([first.t_us, moved.t_us]))
