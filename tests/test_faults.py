"""What can go wrong on a long run: damaged shards, full disks, two runs in one folder, ctrl-C."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from evnlos import Events, EvnlosError, open_dataset, write_events
from evnlos.cli import main
from evnlos.config import save_yaml
from evnlos.data import SensorSize, Simulation, simulate, simulate_object
from evnlos.data.simulate import drawn_for
from evnlos.data.simulations import estimate, find_faults
from evnlos.files import directory_lock, is_empty
from evnlos.machine import Step
from evnlos.setups import RadiometricSetup
from watching import StoppedError, Watch, alive, stopped

COMMAND = [sys.executable, "-m", "evnlos"]
TINY_RUN = ["train", "--epochs", "2", "--network.width", "8", "--network.depth", "2", "--network.shuffle", "1"]
TINY_RUN += ["--precision", "float32"]


@pytest.fixture
def copy(tiny_dataset, tmp_path):
    """A dataset that a test may damage."""
    shutil.copytree(tiny_dataset.folder, tmp_path / "copy")
    return open_dataset(tmp_path / "copy")


@pytest.fixture(scope="module")
def settings(tiny, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("settings") / "tiny.yaml"
    save_yaml(tiny, path)
    return path


@pytest.fixture(scope="module")
def tiny_run(tiny_dataset, tmp_path_factory) -> Path:
    """A training that nobody disturbed."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    in_a_new_process([*TINY_RUN, "--data", str(tiny_dataset.folder), "--out", str(out)])
    return out


def in_a_new_process(arguments: list[str]) -> None:
    """Run a command as a user does: libraries that other tests loaded may change how numbers are rounded."""
    subprocess.run([sys.executable, "-m", "evnlos", *arguments], check=True, capture_output=True, timeout=300)


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if not path.name.startswith(".")}


DEAD = 4_194_304  # more than any process has for a number


def unfinished(path: Path, owner: int) -> Path:
    """Return the name under which a process of this machine writes a file."""
    return path.with_name(f".{path.name}.{socket.gethostname()}.{owner}.0123abcd.part")


def test_damage_is_found_named_and_repaired(copy, tiny_dataset, capsys) -> None:
    names = copy.objects()
    changed, cut, swapped, gone = (copy.shard(name) for name in names[:4])
    content = bytearray(changed.read_bytes())
    content[len(content) // 2] ^= 4
    changed.write_bytes(content)
    cut.write_bytes(cut.read_bytes()[:2000])
    shutil.copy(copy.shard(names[5]), swapped)
    gone.unlink()
    with pytest.raises(SystemExit):
        main(["verify", str(copy.folder)])
    out, err = capsys.readouterr()
    for path, reason in (
        (changed, ""),
        (cut, "truncated"),
        (swapped, f"object {names[5]!r}"),
        (gone, "missing"),
    ):
        assert any(str(path) in line and reason in line for line in out.splitlines()), out
    assert f"4 of {len(names)} shards are faulty" in err
    with pytest.raises(SystemExit):
        main(["verify", str(copy.folder), "--json"])
    assert set(json.loads(capsys.readouterr().out)["faults"]) == set(names[:4])
    main(["verify", str(copy.folder), "--repair", "--workers", "1"])
    assert "4 of 4" in capsys.readouterr().out
    assert bytes_of(copy.folder) == bytes_of(tiny_dataset.folder)
    main(["verify", str(copy.folder)])
    assert "all whole" in capsys.readouterr().out


def test_a_shard_of_other_settings_is_found(copy, tiny, tmp_path) -> None:
    from dataclasses import replace

    other = replace(tiny, seed=7)
    (name,) = stopped(simulate, other, tmp_path / "other", after=1)
    shutil.copy(tmp_path / "other" / f"{name}.h5", copy.shard(name))
    assert [(fault.name, fault.reason) for fault in find_faults(copy)] == [
        (name, "it was made with other settings")
    ]


def test_settings_changed_by_hand_are_not_repaired_with(copy, capsys) -> None:
    page = copy.folder / "dataset.yaml"
    page.write_text(page.read_text().replace("duration_s: 8.0", "duration_s: 7.0"))
    copy.shard(copy.objects()[0]).unlink()
    with pytest.raises(SystemExit):
        main(["verify", str(copy.folder), "--repair"])
    assert "was changed" in capsys.readouterr().err


def test_shares_made_apart_are_the_dataset(tiny, tiny_dataset, tmp_path) -> None:
    watch = Watch()
    for i in (2, 3, 1):
        simulate(tiny, tmp_path / "d", 1, (i, 3), progress=watch)
    assert sorted(watch.results) == sorted(tiny_dataset.objects())
    assert bytes_of(tmp_path / "d") == bytes_of(tiny_dataset.folder)
    with pytest.raises(EvnlosError, match="share 4 of 3"):
        simulate(tiny, tmp_path / "d", 1, (4, 3))


@pytest.mark.parametrize("text", ["0/3", "4/3", "x", "1"])
def test_a_share_that_is_none_is_one_line(text: str, settings, tmp_path, capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["simulate", "--config", str(settings), "--out", str(tmp_path / "d"), "--shard", text])
    assert stop.value.code == 2
    assert "--shard" in capsys.readouterr().err
    assert not (tmp_path / "d").exists()


def test_a_dry_run_says_what_it_would_take_and_writes_nothing(settings, tiny_dataset, tmp_path, capsys) -> None:
    main(["simulate", "--config", str(settings), "--out", str(tmp_path / "d"), "--dry-run"])
    out = capsys.readouterr().out
    assert f"objects: {len(tiny_dataset.objects())}" in out
    assert {line.split(":")[0] for line in out.splitlines()} == {"objects", "time", "disk", "memory"}
    assert not (tmp_path / "d").exists()


def test_a_dry_run_counts_the_walls_that_are_drawn(tmp_path, monkeypatch) -> None:
    """Every draw of the optics is prepared anew; that takes longer than the objects before it."""
    spent, seen = [0.0], set[Simulation]()

    def simulated(config: Simulation, name: str):
        wall = drawn_for(config, name).setup
        spent[0] += 1 if wall in seen else 80
        seen.add(wall)
        return samples, events

    walls = {"setup.roughness": (0.05, 0.1)}
    config = Simulation(
        setup=RadiometricSetup(cell_m=0.02, sensor=SensorSize(12, 20)), positions=1, vary=walls, setups=2
    )
    samples, events = simulate_object(config, config.glyphs.objects()[0])
    monkeypatch.setattr("evnlos.data.simulations.simulate_object", simulated)
    monkeypatch.setattr("evnlos.data.simulations.time.process_time", lambda: spent[0])
    found = estimate(config, workers=3)
    objects = len(config.glyphs.objects())
    assert (found.cpu_s, found.preparation_s, found.walls) == (1, 79, 6)
    lines = found.lines(tmp_path)
    assert "walls: 6 to prepare, 79.00 s of CPU each" in lines
    minutes, without = (f"time: about {(objects + n * 79) / 180:.0f} min with 3 processes" for n in (6, 0))
    assert minutes in " ".join(lines) and minutes != without
    assert estimate(replace(config, setups=0), workers=3).walls == objects
    one = estimate(replace(config, vary={}), workers=3)  # whose light path each process renders
    assert (one.cpu_s, one.preparation_s, one.walls) == (1, 79, 3)
    assert estimate(replace(config, vary={}), workers=3).walls == 0  # rendered before: nothing to tell


def test_a_dry_run_needs_no_module_that_windows_lacks(tiny, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "resource", None)
    assert "memory: not known on this system" in estimate(tiny, workers=1).lines(tmp_path)


def test_a_folder_has_one_run_at_a_time(tiny, tmp_path) -> None:
    folder = tmp_path / "d"
    command = [*COMMAND, "simulate", "--out", str(folder)]
    seconds, watch = [], Watch(1)

    def run_a_second_time(step: Step) -> None:
        if not seconds:
            seconds.append(subprocess.run(command, capture_output=True, text=True, timeout=120))
        watch(step)

    with pytest.raises(StoppedError):
        simulate(tiny, folder, progress=run_a_second_time)
    assert seconds[0].returncode == 2
    assert "another process is at work" in seconds[0].stderr
    with directory_lock(folder):
        pass
    with directory_lock(tmp_path / "new"):
        assert is_empty(tmp_path / "new")


def test_what_a_killed_process_left_half_written_is_swept(tiny, tiny_dataset, tmp_path) -> None:
    folder = tmp_path / "d"
    stopped(simulate, tiny, folder, after=1)
    left = unfinished(folder / "x.h5", DEAD)
    elsewhere = left.with_name(left.name.replace(f".{socket.gethostname()}.", ".another-machine."))
    alive = unfinished(folder / "y.h5", os.getpid())
    theirs = folder / ".draft.tmp"
    for path in (left, elsewhere, alive, theirs):
        path.write_bytes(b"half")
    simulate(tiny, folder)
    assert [path.exists() for path in (left, elsewhere, alive, theirs)] == [False, False, True, True]
    for path in (alive, theirs):
        path.unlink()
    assert bytes_of(folder) == bytes_of(tiny_dataset.folder)


def test_a_full_disk_is_one_line_and_nothing_is_lost(settings, tiny_dataset, tmp_path, capsys) -> None:
    place = tmp_path / "small"
    place.mkdir()
    size = sum(len(content) for content in bytes_of(tiny_dataset.folder).values())
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size // 2}", "tmpfs", str(place)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("mounting a small tmpfs needs root")
    try:
        words = ["simulate", "--config", str(settings), "--workers", "1", "--out", str(place / "d")]
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 2
        said = capsys.readouterr().err
        says = [line for line in said.splitlines() if line.startswith("evnlos simulate: error")]
        assert len(says) == 1 and "No space left" in says[0]
        whole = bytes_of(tiny_dataset.folder)
        kept = bytes_of(place / "d")
        assert 1 < len(kept) < len(whole)
        assert all(whole[name] == content for name, content in kept.items())
        assert not list((place / "d").glob(".*.part"))
        subprocess.run(["mount", "-o", f"remount,size={4 * size}", str(place)], check=True)
        main(words)
        assert bytes_of(place / "d") == whole
    finally:
        subprocess.run(["umount", str(place)], check=True)


def test_a_full_disk_leaves_no_half_of_a_reconstruction(app_weights, tiny_captures, tmp_path, capsys) -> None:
    from crash import small_disk

    place = tmp_path / "small"
    place.mkdir()
    command = ["reconstruct", str(tiny_captures[0]), "--weights", str(app_weights["event"])]
    command += ["--out", str(place / "r")]
    with small_disk(place, 16_384) as is_small:
        if not is_small:
            pytest.skip("mounting a small tmpfs needs root")
        with pytest.raises(SystemExit) as ended:
            main(command)
        assert ended.value.code == 2
        said = capsys.readouterr().err.splitlines()
        assert len([line for line in said if line.startswith("evnlos reconstruct: error")]) == 1
        assert "No space left" in said[-1]
        assert list(place.iterdir()) == []
        subprocess.run(["mount", "-o", "remount,size=16m", str(place)], check=True)
        main(command)
        assert len(list((place / "r").glob("position_*.png"))) == 8


def test_two_at_once_into_one_folder_are_one_result_and_one_line(app_weights, tiny_captures, tmp_path) -> None:
    """Both used to end well, and the images of one capture were gone."""
    words = ["--weights", str(app_weights["event"]), "--out"]
    alone = []
    for number, capture in enumerate(tiny_captures[:2]):
        main(["reconstruct", str(capture), *words, str(tmp_path / f"alone{number}")])
        alone.append(np.load(tmp_path / f"alone{number}" / "reconstruction.npy"))
    assert not np.allclose(*alone, atol=1e-3)
    both = [
        subprocess.Popen(
            [*COMMAND, "reconstruct", str(capture), *words, str(tmp_path / "m")],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for capture in tiny_captures[:2]
    ]
    errors = [process.communicate(timeout=300)[1] for process in both]
    codes = [process.returncode for process in both]
    assert sorted(codes) == [0, 2], errors
    winner, loser = codes.index(0), codes.index(2)
    said = [line for line in errors[loser].splitlines() if line.startswith("evnlos reconstruct: error")]
    assert len(said) == 1 and "Traceback" not in errors[loser]
    assert "another process is at work" in said[0] or "not an empty folder" in said[0]
    whole = {path.name for path in (tmp_path / f"alone{winner}").iterdir()}
    assert {path.name for path in (tmp_path / "m").iterdir()} == whole
    found = np.load(tmp_path / "m" / "reconstruction.npy")
    np.testing.assert_allclose(found, alone[winner], atol=1e-3)
    assert {path.name for path in tmp_path.iterdir()} == {"alone0", "alone1", "m"}


def test_ctrl_c_ends_all_processes_within_seconds(settings, tmp_path) -> None:
    folder = tmp_path / "d"
    command = [*COMMAND, "simulate", "--config", str(settings), "--workers", "2", "--out", str(folder)]
    # a suite that runs in the background of a shell ignores the signal, and so would its children
    listens = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=listens
    )
    deadline = time.monotonic() + 90
    while not list(folder.glob("*.h5")) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does it: to the whole group
    began = time.monotonic()
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "run the same command again" in err
    assert "Traceback" not in err
    assert time.monotonic() - began < 20
    while alive(process.pid) and time.monotonic() - began < 20:
        time.sleep(0.1)
    assert not alive(process.pid)


@pytest.mark.parametrize(
    ("number", "to_all", "moment"),
    [
        (signal.SIGTERM, False, "starting"),
        (signal.SIGKILL, False, "starting"),
        (signal.SIGINT, True, "starting"),
        (signal.SIGKILL, False, "at work"),
        (signal.SIGTERM, False, "at work"),
    ],
)
def test_workers_end_with_their_parent(number, to_all: bool, moment: str, settings, tmp_path) -> None:
    """They used to wait for work for ever, and to print tracebacks at Ctrl-C while they started."""
    folder = tmp_path / "d"
    command = [*COMMAND, "simulate", "--config", str(settings), "--workers", "2", "--out", str(folder)]
    listens = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=listens
    )
    deadline = time.monotonic() + 90
    while len(alive(process.pid)) < 4 and time.monotonic() < deadline:  # itself, two workers and the tracker
        time.sleep(0.02)
    while moment == "at work" and not list(folder.glob("*.h5")) and time.monotonic() < deadline:
        time.sleep(0.02)
    (os.killpg if to_all else os.kill)(process.pid, number)
    began = time.monotonic()
    while alive(process.pid) and time.monotonic() - began < 20:
        time.sleep(0.05)
    left = alive(process.pid)
    for one in left:
        os.kill(one, signal.SIGKILL)
    assert not left
    _, err = process.communicate(timeout=20)
    if number != signal.SIGKILL:
        assert process.returncode == 128 + number
        assert "run the same command again" in err.splitlines()[-1]
        assert "Traceback" not in err
    assert not list(folder.glob(".*.part"))


def test_in_the_background_of_a_script_ctrl_c_is_ignored_and_sigterm_is_not(settings, tmp_path) -> None:
    folder = tmp_path / "d"
    command = [*COMMAND, "simulate", "--config", str(settings), "--workers", "2", "--out", str(folder)]
    deaf = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=deaf
    )
    for delay_s in (0.05, 0.3, 0.8):  # as it starts, too
        time.sleep(delay_s)
        process.send_signal(signal.SIGINT)
    deadline = time.monotonic() + 90
    while not list(folder.glob("*.h5")) and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    time.sleep(0.2)
    assert process.poll() is None
    process.terminate()
    _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM, err
    assert "terminated; run the same command again" in err and "Traceback" not in err
    until = time.monotonic() + 20
    while alive(process.pid) and time.monotonic() < until:
        time.sleep(0.05)
    assert not alive(process.pid)


AHEAD = """
import time
from evnlos.data.pool import run_in_order
if __name__ == "__main__":
    list(run_in_order(time.sleep, [1000, 1000], 2))
"""
"""What `train --simulate` does, whose workers make samples ahead of their use."""


def test_workers_that_run_ahead_end_with_a_parent_that_is_killed(tmp_path) -> None:
    (tmp_path / "ahead.py").write_text(AHEAD)
    process = subprocess.Popen([sys.executable, str(tmp_path / "ahead.py")], start_new_session=True)
    until = time.monotonic() + 90
    while len(alive(process.pid)) < 4 and time.monotonic() < until:  # itself, two workers and the tracker
        time.sleep(0.05)
    assert len(alive(process.pid)) == 4
    process.kill()
    process.wait(10)
    until = time.monotonic() + 30
    while (left := alive(process.pid)) and time.monotonic() < until:
        time.sleep(0.05)
    for one in left:
        os.kill(one, signal.SIGKILL)
    assert not left


DIES = """
import os, signal, sys
from pathlib import Path
from evnlos.cli import main
left, rename = int(sys.argv[1]), Path.replace
def dying(path, target):
    global left
    left -= 1
    if not left:
        os.kill(os.getpid(), signal.SIGKILL)
    return rename(path, target)
Path.replace = dying
main(sys.argv[2:])
"""
"""A command that is killed just before its n-th file gets its name: the worst moment there is."""


def dies_at(rename: int, arguments: list[str]) -> None:
    """Run a command until kill -9 at its n-th rename."""
    run = subprocess.run(
        [sys.executable, "-c", DIES, str(rename), *arguments], capture_output=True, text=True, timeout=120
    )
    assert run.returncode == -signal.SIGKILL, run.stderr


@pytest.mark.parametrize("rename", [1, 2, 4])
def test_a_killed_import_ends_with_the_same_bytes(rename: int, tiny_captures, tmp_path) -> None:
    """Renames: dataset.yaml, then check image and shard of each capture."""
    arguments = ["import", *map(str, tiny_captures), "--sampling.height", "32", "--sampling.width", "48"]
    arguments += ["--sampling.scored-rows", "24", "--test", "4", "--out"]
    main([*arguments, str(tmp_path / "whole")])
    dies_at(rename, [*arguments, str(tmp_path / "killed")])
    assert len(list((tmp_path / "killed").glob("*.h5"))) == max(0, rename - 2) // 2
    main([*arguments, str(tmp_path / "killed")])
    for part in ("", "checks"):
        whole = {
            path.name: path.read_bytes() for path in (tmp_path / "whole" / part).iterdir() if path.is_file()
        }
        again = {
            path.name: path.read_bytes() for path in (tmp_path / "killed" / part).iterdir() if path.is_file()
        }
        assert whole == again
    assert len(list((tmp_path / "killed").glob("*.h5"))) == 4


@pytest.mark.parametrize(("rename", "epochs"), [(1, 0), (2, 0), (3, 1), (4, 1), (5, 2)])
def test_a_killed_training_ends_with_the_same_bytes(rename, epochs, tiny_dataset, tiny_run, tmp_path) -> None:
    """Renames: run.yaml, checkpoint and metrics of the first epoch, metrics of the second, then the weights."""
    arguments = [*TINY_RUN, "--data", str(tiny_dataset.folder), "--out", str(tmp_path / "killed")]
    dies_at(rename, arguments)
    assert not (tmp_path / "killed" / "weights.safetensors").exists()
    if epochs:
        metrics = tmp_path / "killed" / "metrics.jsonl"
        assert (len(metrics.read_text().splitlines()) if metrics.exists() else 0) == rename - 3
    in_a_new_process(arguments)
    whole, killed = bytes_of(tiny_run), bytes_of(tmp_path / "killed")
    assert set(whole) == set(killed) == {"run.yaml", "metrics.jsonl", "weights.safetensors"}
    assert whole["weights.safetensors"] == killed["weights.safetensors"]
    assert whole["run.yaml"] == killed["run.yaml"]
    lines = [
        [{**json.loads(line), "seconds": 0} for line in files["metrics.jsonl"].splitlines()]
        for files in (whole, killed)
    ]
    assert lines[0] == lines[1]


@pytest.mark.parametrize("suffix", [".h5", ".raw", ".csv", ".npz", ".aedat4"])
def test_a_killed_conversion_ends_with_the_same_bytes(suffix: str, tmp_path) -> None:
    draw = np.random.default_rng(0)
    count = 5000
    events = Events(
        np.sort(draw.integers(0, 10**6, count)),
        draw.integers(0, 64, count),
        draw.integers(0, 48, count),
        draw.integers(0, 2, count).astype(bool),
        width=64,
        height=48,
    )
    write_events(tmp_path / "in.raw", events, format="EVT2")
    whole, killed = tmp_path / f"whole{suffix}", tmp_path / "b" / f"whole{suffix}"
    killed.parent.mkdir()
    main(["convert", str(tmp_path / "in.raw"), "--out", str(whole)])
    dies_at(1, ["convert", str(tmp_path / "in.raw"), "--out", str(killed)])
    assert not killed.exists() and len(list(killed.parent.iterdir())) == 1
    alive = next(killed.parent.iterdir())
    alive = alive.with_name(re.sub(r"\.\d+\.(\w+\.part)$", rf".{os.getpid()}.\1", alive.name))
    alive.write_bytes(b"of a process that lives")
    main(["convert", str(tmp_path / "in.raw"), "--out", str(killed)])
    assert killed.read_bytes() == whole.read_bytes()
    assert sorted(killed.parent.iterdir()) == sorted([alive, killed])  # what was left half-written is swept


def test_a_run_that_goes_on_with_other_threads_says_so(tiny_dataset, tiny_run, tmp_path) -> None:
    """Gradients are summed in another order then, and the weights are other bytes."""
    notes = (tiny_run / "run.yaml").read_text()
    assert "threads: 1" in notes
    out = tmp_path / "run"
    out.mkdir()
    (out / "run.yaml").write_text(notes.replace("threads: 1", "threads: 7"))
    command = [*COMMAND, *TINY_RUN, "--data", str(tiny_dataset.folder), "--out", str(out)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0
    said = [line for line in run.stderr.splitlines() if line.startswith("warning")]
    assert len(said) == 1 and "begun with 7 threads and goes on with 1" in said[0]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="limits of a process are those of Unix")
def test_a_whole_file_is_not_called_damaged_where_memory_is_limited(tmp_path) -> None:
    pytest.importorskip("aedat")
    import resource

    draw = np.random.default_rng(0)
    times = np.sort(draw.integers(0, 10**6, 100))
    events = Events(
        times, draw.integers(0, 64, 100), draw.integers(0, 48, 100), times % 2 == 0, width=64, height=48
    )
    write_events(tmp_path / "a.aedat4", events)
    limit = partial(resource.setrlimit, resource.RLIMIT_AS, (2_500_000_000, 2_500_000_000))
    read = subprocess.run(
        [*COMMAND, "info", str(tmp_path / "a.aedat4")],
        capture_output=True,
        text=True,
        timeout=120,
        preexec_fn=limit,
    )
    assert read.returncode == 0, read.stderr
