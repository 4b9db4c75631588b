"""What a simulation will take, from one object that is really simulated."""

from __future__ import annotations

import resource
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from evnlos.dataset.pool import processes
from evnlos.dataset.shard import write_shard
from evnlos.dataset.simulate import Simulation, simulate_object
from evnlos.errors import ConfigError


@dataclass(frozen=True)
class Estimate:
    """Cost of a simulation.

    Args:
        objects: Objects to simulate here.
        cpu_s: CPU time of one object, seconds, the first one's preparation left out.
        shard_bytes: Size of one shard.
        worker_bytes: Peak memory of the process that simulated it.
        workers: Processes.
        events: Events of the object.
    """

    objects: int
    cpu_s: float
    shard_bytes: int
    worker_bytes: int
    workers: int
    events: int

    def lines(self, out: Path) -> list[str]:
        """Return what a user wants to know before the start."""
        place = next(path for path in (out, *out.resolve().parents) if path.is_dir())
        free = shutil.disk_usage(place).free
        wall_s = self.objects * self.cpu_s / self.workers
        return [
            f"objects: {self.objects}, {self.cpu_s:.2f} s of CPU and {self.events:,} events each",
            f"time: about {_clock(wall_s)} with {self.workers} processes of one thread on as many free cores",
            f"disk: about {_size(self.objects * self.shard_bytes)}; {_size(free)} are free",
            f"memory: about {_size(self.workers * self.worker_bytes)}",
        ]


def estimate(config: Simulation, workers: int = 0, share: tuple[int, int] = (1, 1)) -> Estimate:
    """Simulate the middle object of a share twice, the first time to compile and to fill caches.

    Args:
        config: The settings.
        workers: Processes; 0 means one for each core.
        share: (i, n), as in `simulate`.

    Raises:
        ConfigError: A number of workers below 0, or a share without an object.
    """
    names = config.glyphs.objects()[share[0] - 1 :: share[1]]
    if not names:
        raise ConfigError(
            f"share {share[0]}/{share[1]} of {len(config.glyphs.objects())} objects is empty; give fewer shares"
        )
    at_once = processes(workers, len(names))
    name = names[len(names) // 2]
    simulate_object(config, name)
    began = time.process_time()
    samples, events = simulate_object(config, name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "object.h5"
        write_shard(path, samples, {"object": name}, events if config.keep_events else None)
        size = path.stat().st_size
    spent = time.process_time() - began
    unit = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    return Estimate(len(names), spent, size, peak, at_once, len(events))


def _clock(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def _size(count: float) -> str:
    return f"{count / 1e6:.0f} MB" if count < 1e9 else f"{count / 1e9:.1f} GB"
