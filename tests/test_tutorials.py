"""The commands of the tutorials run as their pages print them: in that order, in one folder, on less work.

Three tables say what differs from a reader's work: `LESS_WORK` makes numbers smaller that only decide how long
a command takes, `LEFT_OUT` names what does not run and why, `STAND_INS` makes what a reader brings.
"""

import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from evnlos import write_events
from evnlos.cli import VERBS, main
from test_cli_events import moving_bar, random_events
from test_video import write_container

ROOT = Path(__file__).resolve().parent.parent
LESS_WORK: tuple[tuple[str, str], ...] = (
    (r"ABCDEGHKLMRST479", "ABEGK49"),
    (r"ACEHOSTGK27", "ACEHGK"),
    (r"(lab --out captures)( --glyphs\.family \"Nunito Black\")?$", r"\1\2 --glyphs.characters ACEHOS27GK49"),
    (r"(lab .*)", r"\1 --frame-rate-hz 2 --setup.cell-m 0.01 --setup.sensor.height 36 --setup.sensor.width 54"),
    (r" captures/lab_H captures/lab_O captures/lab_S captures/lab_2 captures/lab_7", ""),
    (r"(calibrate captures/lab_A .*)", r"\1 --columns 24 --event-captures 1"),
    (r"(calibrate captures/\* .*)", r"\1 --columns 24 --no-events"),
    (r"(identify .*)", r"\1 --cells 12 --height 20 --width 32 --writers 2"),
    (r"(identify .*--bounds.*)", r"\1 --sequence.positions 4 --sequence.counts 1 4 --sequence.cells 12"),
    (r"(track .*)", r"\1 --columns 24 --cells 12"),
    (r" --glyphs\.writers 44", ""),
    (r"(simulate .*)", r"\1 --glyphs.writers 1 --glyphs.redrawn 1 --glyphs.characters AEH --workers 1"),
    (r"(train .*fusion.*)", r"\1 --epochs 1 --network.width 8 --network.depth 2"),
    (r"--epochs \d+", "--epochs 1"),
    (r"--network\.rank 512", "--network.rank 32"),
    (r"--pitch 0\.008", "--pitch 0.03"),
    (r"--hold-s 0\.3", "--hold-s 0.2"),
    (r"(scan import .*)", r"\1 --height 45 --width 80"),
)
"""Expressions over a command and what takes their place: fewer letters, frames, pixels, cells, writers and
epochs. One calibration of three also fits the event pixel; `test_calibration.py` has all of its fits."""
PLACEHOLDERS = {"SETUP.yaml": "main-near", "SETUP": "main-near", "FOLDER...": "captures/*"}
PLACEHOLDERS |= {"FILE": "captures/lab_A/events.raw"}
"""What stands for a name of the reader's."""
_PART = "the part of a command that the sentence is on"
LEFT_OUT: dict[str, str] = {
    "evnlos clean --background-ms 10": _PART,
    "evnlos events clip.mp4": _PART,
    "evnlos invert --colours": _PART,
    "evnlos import recording.bag --out data": "needs a ROS recording; test_capture_sources.py imports one",
    "evnlos live evk4": "needs a camera on a cable",
    "evnlos reconstruct new/lab_X --weights fine --setup setup": "stands below the table again, with its --out",
}
"""Commands that do not run here, and why."""


def tutorials() -> list[str]:
    """Return those pages with commands that begin the site or are tutorials, and how-tos of their kind."""
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    first = navigation[navigation.index("  - Start:\n") : navigation.index("  - How-to:\n")]
    names = [*re.findall(r"(\w+)\.md", first), "own_camera", "first_light", "event_files"]
    return [name for name in names if commands_of(name)]


def page_of(name: str) -> str:
    return (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


def commands_of(name: str) -> list[str]:
    """Return the commands of a page in its order, each once; of its sentences, what is more than a name."""
    text = re.sub(r"```.*?```", "", re.sub(r"\\\n\s*", " ", page_of(name)), flags=re.DOTALL)
    found = []
    for apart, within in re.findall(r"^    (evnlos .*)$|`(evnlos [^`]*)`", text, flags=re.MULTILINE):
        parts = [part.partition("#")[0].strip() for part in (apart or within).split("&&")]
        found += [part for part in parts if apart or not re.fullmatch(r"evnlos( [a-z]+){1,2}", part)]
    return list(dict.fromkeys(found))


def with_less_work(command: str) -> str:
    for name, ours in PLACEHOLDERS.items():
        command = command.replace(f" {name}", f" {ours}")
    for pattern, smaller in LESS_WORK:
        command = re.sub(pattern, smaller, command)
    return command


def run(command: str) -> None:
    """Run a command; a code other than 0 ends the test."""
    try:
        main(shlex.split(with_less_work(command))[1:])
    except SystemExit as stop:
        assert not stop.code, f"{command}\n  ended with {stop.code}; here it was {with_less_work(command)}"


def clips() -> None:
    """Six seconds of video, and a folder that holds them again."""
    write_container(Path("clip.mp4"), moving_bar(), list(range(0, 6000, 500)))
    Path("clips").mkdir()
    shutil.copy("clip.mp4", "clips/first.mp4")


def captures() -> None:
    """Captures of known characters, and a new one."""
    run("evnlos lab --out captures --glyphs.characters ACEHGK4")
    run("evnlos lab --out new --glyphs.characters X")


def recorded(folder: str) -> None:
    """Into a folder that `capture init` began: the files of a recording, its `capture.yaml` filled in."""
    shutil.copytree("captures/lab_A", folder, dirs_exist_ok=True)


STAND_INS: dict[tuple[str, str], Callable[[], object]] = {
    ("install", "evnlos events"): clips,
    ("events_for_pytorch", "evnlos events"): clips,
    ("coming_from", "evnlos events"): clips,
    ("coming_from", "evnlos info"): lambda: write_events("f.raw", random_events()),
    ("event_files", "evnlos info"): lambda: write_events("recording.raw", random_events()),
    ("setup_afternoon", "evnlos capture check try/A"): lambda: recorded("try/A"),
    ("own_camera", "evnlos identify"): captures,
    ("own_camera", "evnlos capture check try/A"): lambda: recorded("try/A"),
    ("own_camera", "evnlos capture check try/B"): lambda: recorded("try/B"),
}
"""By page, and by the beginning of the first command that needs it: what readers record, or have."""
EARLIER = {"evnlos scan rehearse tray --setup main-near": "evnlos scan import"}
"""Commands in place of the reader's work, and the command of the page that they run before."""


def in_order(name: str) -> list[str]:
    """Return the commands of a page that run, in the order in which they do."""
    commands = [command for command in commands_of(name) if command not in LEFT_OUT]
    for command in [command for command in commands if command in EARLIER]:
        commands.remove(command)
        place = next(k for k, other in enumerate(commands) if other.startswith(EARLIER[command]))
        commands.insert(place, command)
    return commands


@pytest.mark.parametrize("name", tutorials())
def test_the_commands_of_a_page_run(name: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for file, text in re.findall(r"file `(\w+\.yaml)`.*?```yaml\n(.*?)```", page_of(name), flags=re.DOTALL):
        Path(file).write_text(text, encoding="utf-8")
    stand_ins = {begin: make for (page, begin), make in STAND_INS.items() if page == name}
    for command in in_order(name):
        for begin in [begin for begin in stand_ins if command.startswith(begin)]:
            stand_ins.pop(begin)()
        run(command)
    assert not stand_ins


def test_the_tables_hold_what_pages_print() -> None:
    """What no page prints any more leaves them; most commands run, and each of these is a command."""
    printed = [command for name in tutorials() for command in commands_of(name)]
    assert {*LEFT_OUT, *EARLIER} <= set(printed) and len(LEFT_OUT) < len(printed) / 8
    for pattern in [*(pattern for pattern, _ in LESS_WORK), *(f" {re.escape(name)}" for name in PLACEHOLDERS)]:
        assert any(re.search(pattern, command) for command in printed), pattern
    assert all(command.split()[1] in [*VERBS, "--version"] for command in printed)
