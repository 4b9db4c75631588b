"""Parallel work: a pool of processes that survives the death of a worker, or a Dask cluster.

- The same tasks on a Dask cluster: many machines that share a file system.
"""

from __future__ import annotations

import io
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import wait as wait_for
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, TypeVar

from evnlos.errors import ConfigError, EvnlosError, MissingDependencyError
from evnlos.machine import children_undisturbed, cores, one_thread

Task = TypeVar("Task")
Result = TypeVar("Result")
Engine = Callable[[Callable[[Any], str], Iterable[Any], int], Generator[str, None, None]]
"""Runs a function on each task with so many processes, and yields the results as they come."""

_TRIES = 3
_AGAIN_S = 0.02
_GRACE_S = 5.0  # in which a worker may leave what it writes


def processes(workers: int, tasks: int) -> int:
    """Return how many processes `workers` asks for: that many, or one for each core, but not more than tasks.

    Raises:
        ConfigError: A number below 0.
    """
    if workers < 0:
        raise ConfigError(f"workers is {workers}; give 0 (one for each core) or more")
    return min(workers or cores(), tasks)


def run_tasks(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    workers: int,
    after: Sequence[Collection[int]] | None = None,
) -> Generator[Result, None, None]:
    """Run `function` on each task and yield the results as they come.

    Args:
        function: A picklable function of one task; it writes its own file and returns its name.
        tasks: The tasks, in the order in which they start.
        workers: Processes; 1 runs everything in this process, 0 means one for each core.
        after: Of each task, the numbers of those before it in the list that must be done before it starts;
            None: nothing waits for anything.

    Raises:
        ConfigError: A number of workers below 0.
        EvnlosError: A task broke its worker three times (killed, out of memory); other errors pass through.
    """
    pending = list(tasks)
    workers = processes(workers, len(pending))
    if workers <= 1:
        yield from _run_here(function, pending)
        return
    tries = [0] * len(pending)
    left = set(range(len(pending)))
    after = after or [()] * len(pending)
    while left:
        flying: dict[Future, int] = {}
        try:
            with _workers(workers) as (pool, ahead):
                yield from _drain(pool, function, pending, left, after, flying, ahead)
        except BrokenProcessPool:
            # The pool can't say which task killed the worker: all that were in flight get a try more.
            for i in flying.values():
                tries[i] += 1
            if max(tries) >= _TRIES:
                raise EvnlosError(
                    f"a worker process died {_TRIES} times (killed, or out of memory?); "
                    "run again with fewer at a time (--workers, --trainings): what is finished is kept"
                ) from None


def run_in_order(
    function: Callable[[Task], Result], tasks: Iterable[Task], workers: int
) -> Generator[Result, None, None]:
    """Run `function` on each task ahead of its use and yield the results in the order of the tasks.

    Args:
        function: A picklable function of one task.
        tasks: The tasks.
        workers: Processes; 1 runs each task in this process when its result is requested, 0 means one a core.

    Raises:
        ConfigError: A number of workers below 0.
        EvnlosError: A worker died; other errors pass through.
    """
    pending = list(tasks)
    workers = processes(workers, len(pending))
    if workers <= 1:
        yield from _run_here(function, pending)
        return
    try:
        with _workers(workers) as (pool, ahead):
            flying: deque[Future] = deque()
            for task in pending:
                flying.append(pool.submit(function, task))
                if len(flying) >= ahead:
                    yield flying.popleft().result()
            while flying:
                yield flying.popleft().result()
    except BrokenProcessPool:
        raise EvnlosError(
            "a worker process died (killed, or out of memory?); run the command again with fewer --workers"
        ) from None


@contextmanager
def workers_kept() -> Iterator[None]:
    """Let the processes of one call within the block serve the next, with what they have imported and prepared.

    They are one for each core; calls that ask for more have their own, and so have calls within others.
    """
    global _kept
    if _kept is not None:
        yield
        return
    _kept = []
    try:
        yield
    finally:
        at_rest, _kept = _kept, None
        for one in at_rest:
            one.end()


class _Worker(SpawnProcess):
    """A process that does not hear Ctrl-C, from its first instant on."""

    def start(self) -> None:
        resource_tracker.ensure_running()  # it unblocks the signal when it starts
        with children_undisturbed():
            super().start()


class _Workers(SpawnContext):
    """Where the processes of one pool come from, and which they are: the pool misses one that a signal met."""

    def __init__(self) -> None:
        super().__init__()
        self.started = list[_Worker]()
        self.Process = self._worker  # type: ignore[assignment]

    def _worker(self, *args: Any, **kwargs: Any) -> _Worker:
        self.started.append(_Worker(*args, **kwargs))
        return self.started[-1]


class _Pool:
    """A pool of processes. They don't hear Ctrl-C, which a terminal sends to all: this process ends them."""

    def __init__(self, count: int) -> None:
        self.count, self._context = count, _Workers()
        self.executor = ProcessPoolExecutor(count, self._context, _begin)

    def end(self) -> None:
        """End the processes, also those that still start; what they are at is broken off."""
        running = self._context.started
        self.executor.shutdown(wait=False, cancel_futures=True)
        until = time.monotonic() + _GRACE_S
        while time.monotonic() < until and (running := [one for one in running if one.is_alive()]):
            for process in running:  # again and again: a task in the queue may begin after the first time
                process.terminate()
            wait_for([process.sentinel for process in running], _GRACE_S / 20)
        for process in running:
            process.kill()


_kept: list[_Pool] | None = None  # those at rest; None: each ends with the call that it is for


@contextmanager
def _workers(count: int) -> Iterator[tuple[ProcessPoolExecutor, int]]:
    """Give a pool for so many tasks at a time, and how many may be in flight; it ends with the block.

    It ends at once where the block is left early. Within `workers_kept` it goes on to the next block otherwise,
    and may have more processes: then no task waits in its queue, where an idle one would take it.
    """
    keeps = _kept is not None and count <= cores()
    pool = _kept.pop() if keeps and _kept else _Pool(cores() if keeps else count)
    try:
        yield pool.executor, 2 * count if pool.count == count else count
    except BaseException:
        pool.end()
        raise
    if keeps and _kept is not None:
        _kept.append(pool)
    else:
        pool.executor.shutdown()


@contextmanager
def one_worker() -> Iterator[Executor]:
    """Give a process beside this one that does one task after the other; left by an error it ends at once."""
    with _workers(1) as (executor, _):
        yield executor


def _begin() -> None:
    """Prepare a worker: one thread, an end that leaves no half-written file, and no life after its parent."""
    one_thread()
    signal.signal(signal.SIGTERM, _end)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), name="parent", daemon=True).start()


def _end(*_: object) -> None:
    """End the task at hand, and this worker with it."""
    sys.unraisablehook = _end_anew
    sys.excepthook = _told_nobody  # which C extensions call where they let no exception out
    sys.stderr = io.StringIO()  # what breaks as the signal strikes half-made things is no news
    sys.exit(128 + signal.SIGTERM)


def _told_nobody(*_: object) -> None:
    """Say nothing of an exception."""


def _end_anew(lost: Any) -> None:
    """End a moment later where the signal struck what lets no exception out, as a library's callback.

    Objects that the signal left half made may fail as they go: that is no news.
    """
    if lost.exc_type is not SystemExit:
        return
    again = threading.Timer(_AGAIN_S, signal.raise_signal, (signal.SIGTERM,))
    again.daemon = True
    try:
        again.start()
    except SystemExit:  # one more signal struck here
        if not again.is_alive():
            os._exit(128 + signal.SIGTERM)


def _end_with(parent: int) -> None:
    """End this process when its parent's end of a pipe is closed: by SIGTERM, and then at once."""
    wait_for([parent])
    until = time.monotonic() + _GRACE_S
    while time.monotonic() < until:
        signal.raise_signal(signal.SIGTERM)
        time.sleep(_GRACE_S / 20)
    os._exit(1)


def _run_here(function: Callable[[Task], Result], tasks: list[Task]) -> Iterator[Result]:
    """Run tasks one by one in this process, with one thread of NumPy's linear algebra for small products."""
    from threadpoolctl import ThreadpoolController  # which changes the process's environment

    libraries = ThreadpoolController()
    for task in tasks:
        with libraries.limit(limits=1, user_api="blas"):
            result = function(task)
        yield result


def _drain(
    pool: ProcessPoolExecutor,
    function: Callable[[Task], Result],
    tasks: list[Task],
    left: set[int],
    after: Sequence[Collection[int]],
    flying: dict[Future, int],
    ahead: int,
) -> Iterator[Result]:
    """Keep so many tasks in flight, so that memory stays bounded."""
    queue = sorted(left)
    while queue or flying:
        for i in [i for i in queue if left.isdisjoint(after[i])][: ahead - len(flying)]:
            flying[pool.submit(function, tasks[i])] = i
            queue.remove(i)
        done, _ = wait(flying, return_when=FIRST_COMPLETED)
        for future in done:
            result = future.result()
            left.discard(flying.pop(future))
            yield result


_RETRIES = 3
_PATIENCE_S = 20.0  # for a scheduler that does not answer


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
        client = Client(cluster or scheduler, timeout=_PATIENCE_S)
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
