"""Threads of this process, and what must not be interrupted in it.

- How many threads there are, and how they wait for each other.
- Ctrl-C and the wish to end, held back while something runs that must not break off in its middle.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


def sleep_while_waiting() -> None:
    """Let threads of parallel loops sleep while they wait, unless the user has chosen.

    By default a thread that is done spins until the slowest one is. On cores that other programs use this takes
    the time away from it, and small loops take several times as long: `docs/performance.md` has the figures.
    PyTorch and numba read the variable once, at their import, so this comes before; processes that are started
    later inherit it. The program `evnlos` calls it; a library must not decide it for
    the program that imports it.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def cores() -> int:
    """Return how many cores this process may use: fewer than there are in a job or container that limits it."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def one_thread() -> None:
    """Give this process one thread in every library: where there are several, processes are the parallelism.

    The linear algebra of NumPy counts its threads apart from those of PyTorch, and more of them than cores make
    small products many times slower. What is loaded is told, what is loaded later reads the environment.
    """
    import torch
    from threadpoolctl import threadpool_limits

    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    threadpool_limits(1)
    torch.set_num_threads(1)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Hold back Ctrl-C and SIGTERM from a short piece of work; they come when it is done.

    For libraries that call Python from C and lose their state where that call raises, as HDF5 does on a file
    object. In another thread than the main one, where no signal is handled, this does nothing.
    """
    numbers, held = (signal.SIGINT, signal.SIGTERM), list[int]()
    handlers = {number: signal.getsignal(number) for number in numbers}
    if threading.current_thread() is not threading.main_thread() or None in handlers.values():
        yield
        return
    try:
        for number in numbers:
            signal.signal(number, lambda one, _: held.append(one))
        yield
    finally:
        for number in numbers:
            signal.signal(number, handlers[number])
    for number in held:
        signal.raise_signal(number)


@contextmanager
def children_undisturbed() -> Iterator[None]:
    """Hold back signals as `undisturbed` does, and Ctrl-C for ever from processes that are started meanwhile.

    A started process takes over which signals are blocked; one whose start breaks off tells it at length.
    """
    has_masks = hasattr(signal, "pthread_sigmask")  # not on Windows
    with undisturbed():  # another thread may hear a signal that is blocked here, and then it is handled here
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if has_masks else set()
        try:
            yield
        finally:
            if has_masks:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
