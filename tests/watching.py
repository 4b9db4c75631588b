"""Watching verbs and commands: a `progress` that keeps every step and may stop, processes that live and die."""

import os
import signal
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from evnlos.machine import Step


class StoppedError(Exception):
    pass


@dataclass
class Watch:
    stop_after: int | None = None
    """Results after which the verb is stopped; None: never."""
    steps: list[Step] = field(default_factory=list)

    def __call__(self, step: Step) -> None:
        self.steps.append(step)
        if self.stop_after is not None and len(self.results) >= self.stop_after:
            raise StoppedError

    @property
    def results(self) -> list:
        return [step.result for step in self.steps if step.result is not None]


def stopped(verb, *arguments, after: int, **settings) -> list:
    """Run a verb until it has brought so many results, and return them."""
    watch = Watch(after)
    with pytest.raises(StoppedError):
        verb(*arguments, progress=watch, **settings)
    return watch.results


def alive(group: int) -> list[int]:
    """Return the processes of a group that still run; those that only wait to be reaped do not."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, their_group = path.read_text().rsplit(")", 1)[1].split()[:3]
        except OSError:
            continue
        if int(their_group) == group and state != "Z":
            found.append(int(path.parent.name))
    return found


def die_once(task: tuple[Path, int]) -> int:
    """Kill the worker that has task 2 first."""
    flag, number = task
    if number == 2 and not flag.exists():
        flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def always_die(number: int) -> int:
    """Kill each worker that has task 1."""
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number
