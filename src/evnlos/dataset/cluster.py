"""The same tasks on a Dask cluster: many machines that share a file system."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import TypeVar

from evnlos.dataset.pool import processes
from evnlos.errors import EvnlosError, MissingDependencyError

Task = TypeVar("Task")
Result = TypeVar("Result")
_RETRIES = 3


def run_on_dask(
    function: Callable[[Task], Result], tasks: Iterable[Task], workers: int = 0, scheduler: str | None = None
) -> Generator[Result, None, None]:
    """Run `function` on each task on a Dask cluster and yield the results as they come.

    A task whose worker dies is run again elsewhere; it writes its own file atomically, so nothing is half done.

    Args:
        function: A picklable function of one task; it writes its own file, on a file system that all machines
            share, and returns its name.
        tasks: The tasks.
        workers: Processes of a cluster on this machine, 0 = one for each core; not for a given scheduler.
        scheduler: Address of a running scheduler, e.g. tcp://node1:8786; None starts a cluster here.

    Raises:
        MissingDependencyError: Dask is not installed.
        ConfigError: A number of workers below 0.
        EvnlosError: The scheduler does not answer, or a task killed its worker again and again.
    """
    try:
        from dask.config import set as set_option
        from distributed import Client, KilledWorker, LocalCluster, as_completed
    except ImportError:
        raise MissingDependencyError(
            'a Dask cluster needs the extra "cluster": pip install "evnlos[cluster]"'
        ) from None
    pending = list(tasks)
    at_once = processes(workers, len(pending))
    if not pending:
        return
    set_option({"distributed.scheduler.allowed-failures": _RETRIES})
    cluster = None
    try:
        if scheduler is None:
            cluster = LocalCluster(
                n_workers=at_once,
                threads_per_worker=1,
                dashboard_address="",
                silence_logs=50,
            )
        client = Client(cluster or scheduler, timeout=20)
    except (OSError, TimeoutError, ValueError) as error:
        raise EvnlosError(
            f"the Dask scheduler {scheduler} does not answer ({' '.join(str(error).split())[:120]}); "
            "start one with `dask scheduler`, or leave --scheduler out for a cluster on this machine"
        ) from None
    try:
        futures = client.map(function, pending, pure=False)
        for future in as_completed(futures):
            try:
                yield future.result()
            except KilledWorker:
                raise EvnlosError(
                    f"a task killed its worker {_RETRIES + 1} times (out of memory?); finished shards are "
                    "kept: give the workers more memory and run the command again"
                ) from None
    finally:
        client.close()
        if cluster is not None:
            cluster.close()
