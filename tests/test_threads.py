"""Threads of parallel loops sleep while they wait, unless the user has chosen otherwise."""

import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from threadpoolctl import threadpool_info

from evnlos.cli import VERBS, main
from evnlos.data.pool import run_in_order, run_tasks, workers_kept
from evnlos.errors import ConfigError, EvnlosError
from evnlos.machine import cores, undisturbed


@pytest.mark.parametrize(("chosen", "expected"), [(None, "PASSIVE"), ("active", "active")])
def test_a_command_sets_the_policy_before_pytorch_reads_it(chosen: str | None, expected: str) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    environment |= {"OMP_WAIT_POLICY": chosen} if chosen else {}
    script = (
        "import os, sys, importlib.abc\n"
        "class Watch(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name in ('torch', 'numba'): print(name, os.environ.get('OMP_WAIT_POLICY'))\n"
        "sys.meta_path.insert(0, Watch())\n"
        "sys.argv = ['evnlos', 'doctor']\n"
        "from evnlos.cli import main\n"
        "main()\n"
    )
    found = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    lines = [line for line in found.stdout.splitlines() if line.startswith(("torch ", "numba "))]
    assert any(line.startswith("torch ") for line in lines)
    assert all(line.endswith(f" {expected}") for line in lines)


def test_importing_the_package_changes_nothing_in_the_process() -> None:
    """Neither variables nor threads, warnings, signals, hooks or the state of anybody's random numbers."""
    script = """
import importlib, logging, os, pkgutil, random, signal, sys, warnings
import h5py, numba, numpy, scipy, tyro, PIL.Image, torch

def state():
    return {
        "environment": dict(os.environ),
        "folder": os.getcwd(),
        "warnings": list(warnings.filters),
        "signals": [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGPIPE)],
        "hooks": (sys.excepthook, sys.displayhook, sys.getrecursionlimit()),
        "logging": (list(logging.root.handlers), logging.root.level),
        "torch": (torch.get_num_threads(), torch.get_default_dtype(), torch.is_grad_enabled()),
        "random": (random.getstate(), str(numpy.random.get_state()), torch.random.get_rng_state().tolist()),
        "numpy": numpy.geterr(),
    }

before = state()
import evnlos
for module in pkgutil.walk_packages(evnlos.__path__, "evnlos."):
    if module.name.rpartition(".")[2] not in ("__main__", "_aedat4_child"):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            assert error.name in ("deepinv", "gradio", "starlette"), error
after = state()
print([key for key in before if before[key] != after[key]])
"""
    environment = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    found = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=300
    )
    assert found.stdout.strip() == "[]", found.stdout + found.stderr


def _threads(module: str) -> list[int]:
    """Return how many threads each library of a process has, after an import."""
    importlib.import_module(module)
    return [torch.get_num_threads(), *(pool["num_threads"] for pool in threadpool_info())]


def test_a_worker_has_one_thread_in_every_library(monkeypatch) -> None:
    """Those loaded before the worker starts its first task, and those loaded by it."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    assert _own_threads("numpy") > 1 or cores() == 1
    for counts in run_tasks(_threads, ["scipy.linalg"] * 2, 2):
        assert len(counts) >= 3  # PyTorch, NumPy's and SciPy's linear algebra
        assert set(counts) == {1}


def test_this_process_has_its_threads_again_after_a_task() -> None:
    before = [pool["num_threads"] for pool in threadpool_info()]
    for counts in run_tasks(_threads, ["numpy"] * 2, 1):
        assert 1 in counts
        assert [pool["num_threads"] for pool in threadpool_info()] == before


@pytest.mark.parametrize("run", [run_tasks, run_in_order])
def test_fewer_workers_than_none_are_refused(run) -> None:
    with pytest.raises(ConfigError, match="workers is -1; give 0"):
        list(run(abs, [1, 2], -1))


def _own_threads(module: str) -> int:
    """Return the most threads of a library of a new process of its own, without any limit."""
    code = f"import {module}, threadpoolctl as t; print(max(p['num_threads'] for p in t.threadpool_info()))"
    return int(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)


def test_ctrl_c_waits_for_work_that_must_not_break_off() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a script's background ignores it
    done = []
    with pytest.raises(KeyboardInterrupt), undisturbed():
        signal.raise_signal(signal.SIGINT)
        done.append("work")
    assert done == ["work"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler


class _HalfMade:
    """What fails as it goes where a signal left it half made, as handles of C libraries do."""

    def __init__(self, begun: Path) -> None:
        begun.touch()
        until = time.monotonic() + 30.0
        while time.monotonic() < until:
            pass
        self.handle = 1

    def __del__(self) -> None:
        del self.handle


def _lose(begun: Path | None) -> None:
    """Lose an exception as C extensions do where they let none out: what `sys.excepthook` shows."""
    if begun is None:
        return
    begun.touch()
    try:
        time.sleep(60)
    except SystemExit:
        try:
            raise ValueError("closed file")
        except ValueError:
            sys.excepthook(*sys.exc_info())
        raise


class _Freed:
    """What frees itself slowly, where Python lets no exception out."""

    def __init__(self, begun: Path) -> None:
        self.begun = begun

    def __del__(self) -> None:
        self.begun.touch()
        until = time.monotonic() + 1.0
        while time.monotonic() < until:
            pass


def _make(begun: Path | None) -> None:
    if begun is not None:
        _HalfMade(begun)


def _free(begun: Path | None) -> None:
    if begun is not None:
        one = _Freed(begun)
        del one
        time.sleep(60)


def _leave_pool(folder: Path, work: Callable[[Path | None], None]) -> None:
    """Leave a pool while its tasks make or free something."""
    tasks = [folder / "0", folder / "1"]
    pool = run_tasks(work, [None, *tasks], 2)
    next(pool)
    while not all(task.exists() for task in tasks):
        time.sleep(0.01)
    began = time.monotonic()
    pool.close()
    assert time.monotonic() - began < 4  # killed after 5 s
    assert not multiprocessing.active_children()


def _interrupted_command(folder: Path) -> None:
    """Run a command that makes something when Ctrl-C comes."""
    doctor = SimpleNamespace(run=lambda: _HalfMade(folder / "begun"))
    sys.modules["evnlos.cli.toy"] = SimpleNamespace(Doctor=lambda json: doctor)  # type: ignore[assignment]
    VERBS["doctor"] = "toy.Doctor"

    def interrupt() -> None:
        while not (folder / "begun").exists():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=interrupt, daemon=True).start()
    main(["doctor"])


@pytest.mark.skipif(os.name == "nt", reason="Windows ends processes without a signal")
def test_a_command_that_is_interrupted_while_it_makes_something_ends_in_one_line(tmp_path: Path) -> None:
    code = (
        f"import test_threads as t; from pathlib import Path; t._interrupted_command(Path({str(tmp_path)!r}))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 130
    assert ended.stderr == "evnlos doctor: interrupted; run the same command again\n"


@pytest.mark.skipif(os.name == "nt", reason="Windows ends processes without a signal")
@pytest.mark.parametrize("work", ["_make", "_lose", "_free"])
def test_a_worker_that_is_struck_at_its_work_ends_in_silence(work, tmp_path) -> None:
    code = (
        f"import test_threads as t; from pathlib import Path; t._leave_pool(Path({str(tmp_path)!r}), t.{work})"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 0, ended.stderr
    assert "Traceback" not in ended.stderr


def _process(_: int) -> int:
    return os.getpid()


def _end(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def test_processes_that_are_kept_serve_the_next_call_and_end_with_the_block() -> None:
    with workers_kept():
        first = set(run_tasks(_process, range(6), 2))
        with workers_kept():  # an experiment within a demo
            second = set(run_tasks(_process, range(6), 2))
        assert first & second  # of two, one may have done all of a call
        with pytest.raises(EvnlosError, match="died 3 times"):
            list(run_tasks(_end, [0, 1], 2))
        assert set(run_tasks(_process, range(6), 2)).isdisjoint(first | second)  # a broken pool is not kept
        assert multiprocessing.active_children()
    assert not multiprocessing.active_children()
    assert set(run_tasks(_process, range(2), 2)) and not multiprocessing.active_children()


def test_no_more_tasks_run_at_a_time_than_asked_for_among_kept_processes(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("evnlos.data.pool.cores", lambda: 4)
    with workers_kept():
        list(run_tasks(_process, range(4), 4))
        at_once = list(run_tasks(partial(_beside, tmp_path), range(6), 2))
    assert 1 <= max(at_once) <= 2


def _beside(folder: Path, number: int) -> int:
    """Return how many run at a time."""
    mine = folder / str(number)
    mine.touch()
    time.sleep(0.2)
    count = len(list(folder.iterdir()))
    mine.unlink()
    return count
