"""A few of the instants of `tests/crash.py`, which strikes at all commands that write."""

import pytest

from crash import Crashes, quick_commands


@pytest.fixture(scope="module")
def crashes(tmp_path_factory) -> Crashes:
    folder = tmp_path_factory.mktemp("crashes")
    return Crashes(quick_commands(folder), folder)


@pytest.mark.parametrize(("kind", "share"), [("kill", 0.9), ("interrupt", 0.8), ("full disk", 0.5)])
def test_nothing_is_lost_at_an_instant(crashes: Crashes, kind: str, share: float) -> None:
    assert crashes.strike(crashes.commands[0], kind, share).faults == []
