"""A `progress` for tests: it keeps every step, and may stop the verb as a user's Ctrl-C would."""

from dataclasses import dataclass, field

import pytest

from evnlos.progress import Step


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
