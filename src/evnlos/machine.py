"""What a process may use of its machine, and by which names others reach it.

- How many threads there are, and how they wait for each other.
- Ctrl-C and the wish to end, held back while something runs that must not break off in its middle.
- Names of this machine: which requests come from its own browsers, and which addresses can be listened on.
"""

from __future__ import annotations

import errno
import ipaddress
import os
import queue
import re
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from evnlos.errors import ConfigError


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


_PATIENCE_S = 2.0  # for the name of a machine; a resolver that nobody answers takes half a minute to say so
_HEADER = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^\s:\[\]@/]+)(?::\d+)?")


def is_local(host: str) -> bool:
    """Return whether a host is this machine itself, which nobody else can reach.

    Example:
        >>> is_local("127.0.0.1"), is_local("[::1]"), is_local("localhost"), is_local("0.0.0.0")
        (True, True, True, False)
    """
    try:
        return host.lower() == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def names_this_machine(header: str, own: str = "127.0.0.1") -> bool:
    """Return whether a request's Host header names this machine.

    A page from elsewhere may have made its own name lead here; its requests carry that name. The port says
    nothing more, and another one is what a forwarded port has.

    Args:
        header: The header, with or without a port.
        own: Further name that the server listens under.

    Example:
        >>> names_this_machine("localhost:8765"), names_this_machine("evil.example:8765")
        (True, False)
    """
    found = _HEADER.fullmatch(header)
    return found is not None and (is_local(found[1]) or found[1].lower() == own.lower())


def listening_address(host: str, port: int) -> str:
    """Return the address of a host of this machine, after a try to listen there.

    Args:
        host: Name or address.
        port: Port; 0 is any.

    Raises:
        ConfigError: The host is not known, is another machine, or the port is taken.
    """
    family, address = _resolved(host)
    try:
        with socket.socket(family) as probe:
            if os.name == "posix":  # as servers do; elsewhere it would let two listen on one port
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((address, port))
    except OSError as error:
        if error.errno == errno.EADDRNOTAVAIL:
            raise ConfigError(
                f"{host} is no address of this machine; give 127.0.0.1, or 0.0.0.0 to let the network in"
            ) from None
        wrong = "is in use" if error.errno == errno.EADDRINUSE else f"can't be had ({error.strerror})"
        raise ConfigError(f"port {port} {wrong}; give another --port, or 0 for a free one") from None
    return address


def _resolved(host: str) -> tuple[socket.AddressFamily, str]:
    """Return family and address of a host, asked for in a thread that may be left behind."""
    found: queue.SimpleQueue[tuple[socket.AddressFamily, str] | None] = queue.SimpleQueue()

    def ask() -> None:
        try:
            family, _, _, _, place = socket.getaddrinfo(host.strip("[]"), None, type=socket.SOCK_STREAM)[0]
            found.put((family, str(place[0])))
        except (OSError, UnicodeError):  # a label that is empty or too long
            found.put(None)

    threading.Thread(target=ask, name="resolver", daemon=True).start()
    try:
        answer = found.get(timeout=_PATIENCE_S)
    except queue.Empty:
        answer = None
    if answer is None:
        raise ConfigError(f"host {host!r} is not known; give 127.0.0.1, or 0.0.0.0 to let the network in")
    return answer
