"""What a process may use of its machine, how far its work is, and where others reach it.

- How many threads there are, and how they wait; Ctrl-C, held back from what must not break off in its middle.
- How far a piece of work is: one small protocol for all that takes long, and progress bars that speak it.
- Which addresses of this machine can be listened on.
"""

from __future__ import annotations

import errno
import json
import os
import queue
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from evnlos.errors import ConfigError

if TYPE_CHECKING:
    from tqdm import tqdm

T = TypeVar("T")


def sleep_while_waiting() -> None:
    """Let threads of parallel loops sleep while they wait, unless the user has chosen.

    By default a thread that is done spins until the slowest one is: `docs/performance.md` has the figures.
    PyTorch and numba read the variable at their import; the program `evnlos` calls this, no library does.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def cores() -> int:
    """Return how many cores this process may use: fewer than there are in a job or container that limits it."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def one_thread() -> None:
    """Give this process one thread in every library: where there are several, processes are the parallelism.

    NumPy counts its threads apart from PyTorch's, and more than cores make small products many times slower.
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

    For libraries that lose their state where a call from C raises, as HDF5 does. Nothing in another thread.
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

    A started process takes over which signals are blocked.
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
        within: What is at work now: a text, or a function that looks it up and returns, before the text, how
            many units the unfinished ones amount to.
    """

    what: str
    done: int
    total: int
    unit: str = "steps"
    result: Any = None
    within: str | Callable[[], tuple[float, str]] = ""


Progress: TypeAlias = Callable[[Step], None]
"""Called by a verb when a piece of work begins and after each unit of it; what it raises stops the verb."""


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


_noted = ""


def note(text: str) -> None:
    """Say what is at work within the unit that progress shows, until its next step.

    Args:
        text: E.g. the trial of a fit; what computes need not know who watches.
    """
    global _noted
    _noted = text


PROGRESS = "EVNLOS_PROGRESS"
"""Environment variable: how progress is shown, one of `SHOWN`."""
SHOWN = ("auto", "bar", "lines", "json", "none")
"""auto: bar on a terminal, else lines; lines and json: a line every `LINE_S` seconds; none: nothing."""
LINE_S = 5.0
"""Seconds between two lines of progress; what takes less says nothing."""
_BEAT_S = 0.5


class ProgressBars:
    """Shows on stderr how far each piece of work is, one after the other; use it as a context manager.

    What is shown moves by itself: time passes, and what is at work within a unit is looked up, or noted.

    Args:
        quiet: Show nothing.

    Example:
        >>> with ProgressBars(quiet=True) as progress:
        ...     progress(Step("simulate letters", 3, 26, "objects"))
    """

    def __init__(self, quiet: bool = False) -> None:
        self._how = "none" if quiet else _progress_shown()
        self._step: Step | None = None
        self._began = self._said = self._first = 0.0
        self._bar: tqdm | None = None
        self._lock, self._end = threading.RLock(), threading.Event()
        self._beats: threading.Thread | None = None

    def __call__(self, step: Step) -> None:
        """Show a step; a new piece of work begins where its name is another one."""
        note("")
        is_done = 0 < step.total <= step.done
        if self._how == "none" or (is_done and (self._step is None or step.what != self._step.what)):
            return  # nothing of it is left to do
        with self._lock:
            if self._step is None or step.what != self._step.what:
                self._finish()
                self._began = self._said = time.monotonic()
                self._first = step.done
            self._step = step
            if not is_done or self._how == "bar":  # of lines, how a piece ended is the last
                self._show()
            if is_done:  # what comes next, progress within this one's too, is no part of it
                self._finish()
                self._step = None
        if self._beats is None:
            self._beats = threading.Thread(target=self._beat, name="progress", daemon=True)
            self._beats.start()

    @contextmanager
    def stage(self, what: str, within: str, done: int = 0, total: int = 1) -> Iterator[None]:
        """Show a stage that says nothing itself while it lasts.

        Args:
            what: The piece of work.
            within: What this stage of it does.
            done: Stages before it.
            total: All stages.
        """
        self(Step(what, done, total, "stages", within=within))
        yield
        self(Step(what, done + 1, total, "stages"))

    def _beat(self) -> None:
        while not self._end.wait(_BEAT_S):
            _compiling_since()  # tells only who listens when it begins, before the first line too
            with self._lock:
                self._show()

    def _show(self) -> None:
        step, now = self._step, time.monotonic()
        if step is None or (self._how != "bar" and now - self._said < LINE_S):
            return
        if self._how != "bar":
            self._said = now
            self._say(*self._state(step, now))
            return
        if self._bar is None:
            from tqdm import tqdm  # `disable=False` would overrule TQDM_DISABLE

            self._bar = tqdm(total=step.total or None, initial=step.done, desc=step.what, unit=f" {step.unit}")
        done, text = self._state(step, now)
        self._bar.n = round(done, 2) if done != step.done else step.done
        values = step.result if isinstance(step.result, Mapping) else {}
        scores = [f"{key}={values[key]}" for key in ("loss", "psnr_db") if key in values]
        self._bar.set_postfix_str(", ".join([*scores, *([text] if text else [])]), refresh=False)
        self._bar.refresh()

    def _state(self, step: Step, now: float) -> tuple[float, str]:
        """Return how many units are done, unfinished ones by their part, and what is at work."""
        part, text = (0.0, step.within) if isinstance(step.within, str) else step.within()
        since = _compiling_since()
        compiling = "compiling, once per installation" if since is not None and now - since > 1 else ""
        text = "; ".join(one for one in (text, _noted, compiling) if one)
        return min(step.done + part, step.total) if step.total else step.done, text

    def _say(self, done: float, text: str) -> None:
        assert self._step is not None
        step, passed = self._step, self._said - self._began
        speed = (done - self._first) / passed
        alike = step.unit != "stages" or callable(step.within)  # stages last as long as they do
        left = (step.total - done) / speed if speed > 0 and step.total and alike else None
        if self._how == "json":
            said = {"what": step.what, "done": step.done, "total": step.total, "unit": step.unit}
            said |= {"within": text, "elapsed_s": round(passed, 1)}
            line = json.dumps({"progress": said | {"left_s": None if left is None else round(left, 1)}})
        else:
            of = f" of {step.total}" if step.total else ""
            rest = "" if left is None else f", about {_duration(left)} left"
            work = f" ({text})" if text else ""
            line = f"{step.what}: {step.done}{of} {step.unit}{work}, {_duration(passed)}{rest}"
        print(line, file=sys.stderr, flush=True)

    def _finish(self) -> None:
        """Leave the last bar as it stands; a piece that said something says how it ended."""
        if self._bar is not None:
            self._bar.set_postfix_str("", refresh=True)
            self._bar.close()
            self._bar = None
        elif self._step is not None and self._said > self._began:
            self._said = time.monotonic()
            self._say(self._step.done, "")

    def __enter__(self) -> ProgressBars:
        return self

    def __exit__(self, *_: object) -> None:
        """Show how the last piece ended, and nothing further."""
        self._end.set()
        with self._lock:
            self._finish()
            self._step = None


_chosen: str | None = None


def show_progress(how: str | None) -> None:
    """Choose how this process shows progress from now on.

    Args:
        how: One of `SHOWN`; None leaves it to EVNLOS_PROGRESS.
    """
    global _chosen
    _chosen = how


def _progress_shown() -> str:
    """Return how progress is shown in this process: bar, lines, json or none."""
    how = _chosen or os.environ.get(PROGRESS) or "auto"
    if how not in SHOWN:
        raise ConfigError(f"{PROGRESS} is {how!r}; give one of {', '.join(SHOWN)}")
    if os.environ.get("TQDM_DISABLE", "") not in ("", "0") and how in ("auto", "bar", "lines"):
        return "none"
    if how != "auto":
        return how
    return "bar" if hasattr(sys.stderr, "isatty") and sys.stderr.isatty() else "lines"


def _duration(seconds: float) -> str:
    """Return a time as people say it: 8 s, 1 min 35 s, 2 h 1 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


_compilations = list[float]()
"""When each compilation that is going on began; empty where none is."""
_is_listening = False


def _compiling_since() -> float | None:
    """Return since when numba compiles; None where it does not. The first call only begins to look."""
    global _is_listening
    if not _is_listening and hasattr(sys.modules.get("numba"), "njit"):
        from numba.core import event

        class Compilations(event.Listener):
            def on_start(self, event: Any) -> None:
                _compilations.append(time.monotonic())

            def on_end(self, event: Any) -> None:
                if _compilations:
                    _compilations.pop()

        event.register("numba:compile", Compilations())
        _is_listening = True
    return next(iter(_compilations), None)


_GIVE_HOST = "give 127.0.0.1, or 0.0.0.0 to let the network in"
_PATIENCE_S = 2.0  # for the name of a machine; a resolver that nobody answers takes half a minute to say so


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
            raise ConfigError(f"{host} is no address of this machine; {_GIVE_HOST}") from None
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
    answer = None
    with suppress(queue.Empty):
        answer = found.get(timeout=_PATIENCE_S)
    if answer is None:
        raise ConfigError(f"host {host!r} is not known; {_GIVE_HOST}")
    return answer
