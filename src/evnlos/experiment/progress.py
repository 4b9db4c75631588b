"""A progress bar for each piece of an experiment."""

from __future__ import annotations

from collections.abc import Iterable

from tqdm import tqdm

from evnlos.experiment.study import Record, Step


def show(steps: Iterable[Step]) -> list[Record]:
    """Run the steps to the end under progress bars and return the records that they brought."""
    bar: tqdm | None = None
    what, records = "", []
    for step in steps:
        if bar is None or step.what != what:
            if bar is not None:
                bar.close()
            what, bar = step.what, tqdm(total=step.total, desc=step.what)
        bar.n = step.part
        bar.refresh()
        if step.record is not None:
            records.append(step.record)
    if bar is not None:
        bar.close()
    return records
