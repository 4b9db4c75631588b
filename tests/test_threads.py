"""Threads of parallel loops sleep while they wait, unless the user has chosen otherwise."""

import importlib
import os
import subprocess
import sys

import pytest
import torch
from threadpoolctl import threadpool_info

from evnlos.dataset.pool import run_in_order, run_tasks
from evnlos.errors import ConfigError
from evnlos.threads import cores


@pytest.mark.parametrize(("chosen", "expected"), [(None, "PASSIVE"), ("active", "active")])
def test_the_policy_is_set_before_pytorch_reads_it(chosen: str | None, expected: str) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    environment |= {"OMP_WAIT_POLICY": chosen} if chosen else {}
    script = (
        "import os, sys, importlib.abc\n"
        "class Watch(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name in ('torch', 'numba'): print(name, os.environ.get('OMP_WAIT_POLICY'))\n"
        "sys.meta_path.insert(0, Watch())\n"
        "from evnlos import train\n"
    )
    found = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    lines = found.stdout.split("\n")[:-1]
    assert any(line.startswith("torch ") for line in lines)
    assert all(line.endswith(f" {expected}") for line in lines)


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
