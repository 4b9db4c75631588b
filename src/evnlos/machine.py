"""What a process may use of its machine, how far its work is, and by which names others reach it.

- How many threads there are, and how they wait for each other.
- Ctrl-C and the wish to end, held back while something runs that must not break off in its middle.
- How far a piece of work is: one small protocol for all that takes long, and progress bars that speak it.
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
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from evnlos.errors import ConfigError

if TYPE_CHECKING:
    from tqdm import tqdm

T = TypeVar("T")


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


@dataclass(frozen=True)
class Step:
    """Where a piece of work stands.

    Args:
        what: The piece of work, e.g. "train near-frame".
        done: Units that are done, those of an earlier, interrupted run included.
        total: Units of the whole piece; 0 where nobody knows.
        unit: What is counted, e.g. "epochs".
        result: What the last unit brought (an object's name, an epoch's record, a score); None for the first
            step of a piece, which only says where it begins.
    """

    what: str
    done: int
    total: int
    unit: str = "steps"
    result: Any = None


Progress: TypeAlias = Callable[[Step], None]
"""Called by a verb when a piece of work begins and after each unit of it. What it raises stops the verb, which
keeps what is finished; run it again to go on."""


def silent(step: Step) -> None:
    """Take a step and do nothing: the `progress` of a verb that nobody watches."""


def counted(
    things: Iterable[T], progress: Progress, what: str, total: int, unit: str = "frames"
) -> Iterator[T]:
    """Yield things, and tell after each how many have gone by.

    Args:
        things: What is counted.
        progress: Told the steps.
        what: The piece of work.
        total: How many there are; 0 where nobody knows.
        unit: What they are.
    """
    progress(Step(what, 0, total, unit))
    for done, thing in enumerate(things, 1):
        yield thing
        progress(Step(what, done, total, unit))


class ProgressBars:
    """A bar on stderr for each piece of work, one after the other; use it as a context manager.

    Args:
        quiet: Show nothing.

    Example:
        >>> with ProgressBars(quiet=True) as progress:
        ...     progress(Step("simulate letters", 3, 26, "objects"))
    """

    def __init__(self, quiet: bool = False) -> None:
        self._quiet, self._what, self._bar = quiet, "", None

    _bar: tqdm | None

    def __call__(self, step: Step) -> None:
        """Move the bar of the step's piece of work; open it where it is a new one."""
        if self._quiet:
            return
        if self._bar is None or step.what != self._what:
            from tqdm import tqdm

            self.close()
            self._what = step.what
            self._bar = tqdm(total=step.total or None, initial=step.done, desc=step.what, unit=f" {step.unit}")
        self._bar.n = step.done
        if isinstance(step.result, Mapping):
            values = {key: step.result[key] for key in ("loss", "psnr_db") if key in step.result}
            self._bar.set_postfix(values, refresh=False)
        self._bar.refresh()

    def close(self) -> None:
        """Leave the last bar as it stands."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def __enter__(self) -> ProgressBars:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


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
