"""A pool of processes that survives the death of a worker: lost tasks are run again."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

from evnlos.errors import ConfigError, EvnlosError
from evnlos.threads import cores, one_thread

Task = TypeVar("Task")
Result = TypeVar("Result")
Engine = Callable[[Callable[[Any], str], Iterable[Any], int], Iterator[str]]
"""Runs a function on each task with so many processes, and yields the results as they come."""

_TRIES = 3


def processes(workers: int, tasks: int) -> int:
    """Return how many processes `workers` asks for: that many, or one for each core, but not more than tasks.

    Raises:
        ConfigError: A number below 0.
    """
    if workers < 0:
        raise ConfigError(f"workers is {workers}; give 0 (one for each core) or more")
    return min(workers or cores(), tasks)


def run_tasks(function: Callable[[Task], Result], tasks: Iterable[Task], workers: int) -> Iterator[Result]:
    """Run `function` on each task and yield the results as they come.

    Args:
        function: A picklable function of one task; it writes its own file and returns its name.
        tasks: The tasks, in the order in which they start.
        workers: Processes; 1 runs everything in this process, 0 means one for each core.

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
    while left:
        with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), one_thread) as pool:
            try:
                yield from _drain(pool, function, pending, left, workers)
            except BrokenProcessPool:
                # The pool can't say which task killed the worker: all that were in flight get a try more.
                first = sorted(left)[: 2 * workers]
                for i in first:
                    tries[i] += 1
                if max(tries) >= _TRIES:
                    raise EvnlosError(
                        f"a worker process died {_TRIES} times (killed, or out of memory?); "
                        "run again with fewer at a time (--workers, --trainings): what is finished is kept"
                    ) from None
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


def run_in_order(function: Callable[[Task], Result], tasks: Iterable[Task], workers: int) -> Iterator[Result]:
    """Run `function` on each task ahead of its use and yield the results in the order of the tasks.

    Args:
        function: A picklable function of one task.
        tasks: The tasks.
        workers: Processes; 1 runs each task in this process when its result is asked for, 0 means one a core.

    Raises:
        ConfigError: A number of workers below 0.
        EvnlosError: A worker died; other errors pass through.
    """
    pending = list(tasks)
    workers = processes(workers, len(pending))
    if workers <= 1:
        yield from _run_here(function, pending)
        return
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), one_thread)
    try:
        flying: deque[Future] = deque()
        for task in pending:
            flying.append(pool.submit(function, task))
            if len(flying) >= 2 * workers:
                yield flying.popleft().result()
        while flying:
            yield flying.popleft().result()
    except BrokenProcessPool:
        raise EvnlosError(
            "a worker process died (killed, or out of memory?); run the command again with fewer --workers"
        ) from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _run_here(function: Callable[[Task], Result], tasks: list[Task]) -> Iterator[Result]:
    """Run tasks one by one in this process, with one thread of NumPy's linear algebra for small products."""
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
    workers: int,
) -> Iterator[Result]:
    """Keep twice as many tasks in flight as there are workers, so that memory stays bounded."""
    queue = iter(sorted(left))
    flying: dict[Future, int] = {}
    while True:
        for i in queue:
            flying[pool.submit(function, tasks[i])] = i
            if len(flying) >= 2 * workers:
                break
        if not flying:
            return
        done, _ = wait(flying, return_when=FIRST_COMPLETED)
        for future in done:
            i = flying.pop(future)
            result = future.result()
            left.discard(i)
            yield result
