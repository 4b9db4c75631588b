"""How many threads there are, and how they wait for each other."""

import os


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
