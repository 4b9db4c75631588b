"""How far a verb is: one small protocol for everything that takes long, and the progress bars that speak it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from tqdm import tqdm


@dataclass(frozen=True)
class Step:
    """Where a piece of work stands.

    Args:
        what: The piece of work, e.g. "train near-frame".
        done: Units that are done, those of an earlier, interrupted run included.
        total: Units of the whole piece.
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
            self._bar = tqdm(total=step.total, initial=step.done, desc=step.what, unit=f" {step.unit}")
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
