"""Ctrl-C and the wish to end, held back while something runs that must not break off in its middle."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


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
