"""The processes that train one network together, one a device, as `torchrun` starts them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn


@dataclass(frozen=True)
class Team:
    """This process and the others; a training without `torchrun` is a team of one.

    Args:
        rank: Number of this process, from 0; number 0 writes the run's folder.
        size: Number of processes.
        device: Where this process computes.
    """

    rank: int
    size: int
    device: torch.device

    def wait(self) -> None:
        """Return when every process has come here."""
        if self.size > 1:
            dist.barrier()

    def total(self, value: Tensor) -> Tensor:
        """Return the sum of the processes' values, the same on each; for a team of one the value itself."""
        if self.size > 1:
            value = value.clone()
            dist.all_reduce(value)
        return value

    def joined(self, network: nn.Module) -> nn.Module:
        """Return the network with its gradients averaged over the processes as they come."""
        if self.size == 1:
            return network
        ids = [self.device] if self.device.type == "cuda" else None
        return nn.parallel.DistributedDataParallel(network, device_ids=ids)


@contextmanager
def team() -> Iterator[Team]:
    """Join the processes that `torchrun` started (it sets RANK, WORLD_SIZE, LOCAL_RANK), for one training.

    A process that already belongs to a group of `torch.distributed` trains with that group and stays in it.
    """
    place, started = int(os.environ.get("LOCAL_RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)) > 1
    device = torch.device("cuda", place) if torch.cuda.is_available() else torch.device("cpu")
    if device.type == "cuda":
        torch.cuda.set_device(device)
    if dist.is_available() and dist.is_initialized():
        yield Team(dist.get_rank(), dist.get_world_size(), device)
    elif started:
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
        try:
            yield Team(dist.get_rank(), dist.get_world_size(), device)
        finally:
            dist.destroy_process_group()
    else:
        yield Team(0, 1, device)
