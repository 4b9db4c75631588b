"""Several processes train what one would: parts of a loss add up, and so do gradients under `torchrun`."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from evnlos import train
from evnlos.data import NlosDataset, live_dataset
from evnlos.errors import ConfigError
from evnlos.models import UNetConfig
from evnlos.training import LOSSES, Training
from evnlos.training.settings import light_of
from evnlos.training.source import DiskSource, ProcessGroup, SimulatedSource, process_group

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
SETTINGS = Training(
    epochs=2,
    batch_size=103,  # of 104 samples: in the second batch one process has no sample
    network=UNetConfig(width=8, depth=2, shuffle=1, rank=8),
    precision="float32",
)
FLAGS = ["--batch-size", "103", "--precision", "float32"]
FLAGS += ["--network.width", "8", "--network.depth", "2", "--network.shuffle", "1", "--network.rank", "8"]


@pytest.mark.parametrize("name", LOSSES)
def test_the_losses_of_parts_add_up_with_their_gradients(name: str) -> None:
    draw = torch.Generator().manual_seed(0)
    image = torch.rand(5, 1, 24, 32, generator=draw, dtype=torch.float64).requires_grad_()
    truth = (torch.rand(5, 1, 24, 32, generator=draw, dtype=torch.float64) > 0.9).double()
    whole = LOSSES[name](image, truth)
    (gradient,) = torch.autograd.grad(whole, image)
    light = sum(light_of(truth[part]) * (len(truth[part]) / 5) for part in (slice(0, 2), slice(2, 5)))
    parts = [
        LOSSES[name](image[part], truth[part], light) * (len(truth[part]) / 5)
        for part in (slice(0, 2), slice(2, 5))
    ]
    (pieces,) = torch.autograd.grad(sum(parts), image)
    assert sum(parts).item() == pytest.approx(whole.item(), rel=1e-12)
    torch.testing.assert_close(pieces, gradient, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_the_parts_of_a_batch_are_the_batch_of_one_process(size: int, tiny_dataset) -> None:
    samples = NlosDataset(tiny_dataset, "train", "frame")
    cpu = torch.device("cpu")
    alone = list(DiskSource(samples, 10, 3, ProcessGroup(0, 1, cpu)).batches(1))
    assert len(alone) == DiskSource(samples, 10, 3, ProcessGroup(0, 1, cpu)).steps
    assert sum(batch.weight for batch in alone) == pytest.approx(1)
    shared = [
        list(DiskSource(samples, 10, 3, ProcessGroup(rank, size, cpu)).batches(1)) for rank in range(size)
    ]
    for whole, *parts in zip(alone, *shared, strict=True):
        assert sum(part.share for part in parts) == pytest.approx(1)
        rows = torch.cat([part.truth for part in parts if part.share])
        found = sorted(row.sum().item() for row in rows)
        assert found == sorted(row.sum().item() for row in whole.truth)


ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}
QUIET = {"env": ENVIRONMENT, "capture_output": True, "text": True, "timeout": 240}


def two_processes(dataset) -> list[str]:
    """Return the command that trains with two processes, less its folder."""
    command = [*TORCHRUN, "-m", "evnlos", "train", *FLAGS, "--epochs", "2"]
    return [*command, "--data", str(dataset.folder), "--out"]


def test_two_processes_train_what_one_does(tiny_dataset, tmp_path) -> None:
    log = train(tiny_dataset, SETTINGS, tmp_path / "one").records
    done = subprocess.run([*two_processes(tiny_dataset), str(tmp_path / "two")], **QUIET)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("2 epochs") == 1  # one process speaks
    records = [json.loads(line) for line in (tmp_path / "two" / "metrics.jsonl").read_text().splitlines()]
    for one, two in zip(log, records, strict=True):
        assert two["loss"] == pytest.approx(one["loss"], abs=2e-5)
        assert two["psnr_db"] == pytest.approx(one["psnr_db"], abs=0.01)
    one, two = (load_file(tmp_path / name / "weights.safetensors") for name in ("one", "two"))
    moved = max((one[name] - two[name]).abs().max().item() for name in one)
    assert moved < 1e-4


def test_two_processes_survive_a_kill(tiny_dataset, tmp_path) -> None:
    command = two_processes(tiny_dataset)
    subprocess.run([*command, str(tmp_path / "two")], check=True, **QUIET)
    process = subprocess.Popen(
        [*command, str(tmp_path / "killed")],
        env=ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not (tmp_path / "killed" / "checkpoint.safetensors").exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "killed" / "weights.safetensors").exists()
    again = subprocess.run([*command, str(tmp_path / "killed")], **QUIET)
    assert again.returncode == 0, again.stderr
    two, killed = ((tmp_path / name / "weights.safetensors").read_bytes() for name in ("two", "killed"))
    assert two == killed


def test_a_training_without_torchrun_is_a_team_of_one(monkeypatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with process_group() as processes:
        assert (processes.rank, processes.size) == (0, 1)
        value = torch.ones(2)
        assert processes.total(value) is value
    assert not torch.distributed.is_initialized()


GROUP = """
import os, sys
import torch
from evnlos.training.source import process_group

with process_group() as processes:
    torch.manual_seed(processes.rank)
    network = torch.nn.Conv2d(3, 2, 3).to(memory_format=torch.channels_last)
    processes.share(network)
    assert processes.total(network.weight.detach()).equal(2 * network.weight)
    if processes.rank:
        network.weight.grad = torch.ones_like(network.weight)
    processes.average_gradients(network.parameters())
    assert network.weight.grad.eq(0.5).all() and network.bias.grad.eq(0).all()
    network(torch.ones(1, 3, 4, 4)).sum().backward()
    processes.wait()
threads = {open(f"/proc/self/task/{task}/comm").read().strip() for task in os.listdir("/proc/self/task")}
# In one call: two processes write to the same pipe.
sys.stdout.write(f"threads {sorted(name for name in threads if 'gloo' in name)}\\n")
"""


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="no /proc to count threads in")
def test_a_group_shares_weights_and_gradients_and_its_threads_end_with_it(tmp_path) -> None:
    """A thread of the group that is left when the interpreter ends may abort the process."""
    (tmp_path / "group.py").write_text(GROUP)
    done = subprocess.run([*TORCHRUN, str(tmp_path / "group.py")], **QUIET)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("threads []") == 2


def test_processes_simulate_other_objects_each(tiny) -> None:
    dataset = live_dataset(replace(tiny, positions=2))
    cpu = torch.device("cpu")
    with pytest.raises(ConfigError, match="batch_size that they divide"):
        SimulatedSource(dataset, "frame", 7, 0, ProcessGroup(0, 2, cpu))
    sides = [
        list(SimulatedSource(dataset, "frame", 6, 0, ProcessGroup(rank, 2, cpu)).batches(0)) for rank in (0, 1)
    ]
    # 13 objects: 6 each, one is left out; 2 samples each in batches of 3
    assert [len(side) for side in sides] == [4, 4]
    pictures = [np.concatenate([batch.truth.numpy() for batch in side]) for side in sides]
    keys = [{picture.tobytes() for picture in side} for side in pictures]
    assert len(keys[0]) == len(keys[1]) == 12
    assert not keys[0] & keys[1]
    for side in sides:
        assert sum(batch.weight for batch in side) == pytest.approx(1)
