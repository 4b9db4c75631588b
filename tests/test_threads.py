"""Threads of parallel loops sleep while they wait, unless the user has chosen otherwise."""

import os
import subprocess
import sys

import pytest


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
