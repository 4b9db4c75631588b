"""Pages of the documentation site that are made from the code; Markdown as the site needs it.

MkDocs calls the functions `on_...` while it builds (`hooks` in mkdocs.yml). Made pages are never files:
a page for each command from its own help, for each room from its list of names, for each example, notebook and
benchmark; and in a written page, where a comment such as `<!-- settings: evnlos.data.CaptureInfo -->` stands,
the table that it asks for.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import importlib
import inspect
import io
import json
import os
import pkgutil
import re
import textwrap
import types
import typing
from pathlib import Path
from typing import Any
from unittest import mock

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent
COLUMNS = "96"
"""Width of the commands' help, characters."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the made pages where the navigation has their name in braces."""
    made = {
        "{commands}": [f"commands/{verb}.md" for verb in verbs()],
        "{rooms}": [f"api/{room}.md" for room in rooms()],
        "{gallery}": [f"gallery/{path.stem}.md" for path in examples()],
        "{benchmarks}": [f"benchmarks/{path.name}" for path in benchmarks()],
    }

    def filled(entries: list[Any]) -> list[Any]:
        found = []
        for entry in entries:
            if isinstance(entry, dict):
                found.append({k: filled(v) if isinstance(v, list) else v for k, v in entry.items()})
            else:
                found += made.get(entry, [entry])
        return found

    config.nav = filled(config.nav or [])
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the made pages."""
    pages = {"contributing.md": (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")}
    pages |= {f"commands/{verb}.md": command_page(verb) for verb in verbs()}
    pages |= {f"api/{room}.md": room_page(room) for room in rooms()}
    pages |= {f"gallery/{path.stem}.md": example_page(path) for path in examples()}
    pages |= {f"benchmarks/{path.name}": path.read_text(encoding="utf-8") for path in benchmarks()}
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill in what comments ask for, lead links to pages of the site, part lists from text."""
    depth = "../" * page.file.src_uri.count("/")
    text = re.sub(r"<!-- (\w+)(?:: (.*?))? -->", lambda found: _filled(found, depth), markdown)
    text = re.sub(r"\]\(([^)#\s]+)(#[^)]*)?\)", lambda found: site_link(found, page.file.src_uri, depth), text)
    return lists_apart(text)


def _filled(found: re.Match[str], depth: str) -> str:
    make = {
        "settings": settings_tables,
        "kinds": kinds_tables,
        "presets": lambda _: presets_table(),
        "formats": lambda _: formats_table(),
        "setups": lambda _: setups_table(),
        "commands": lambda _: commands_table(depth),
        "rooms": lambda _: rooms_table(depth),
        "gallery": lambda _: thumbnails(depth),
        "metrics": lambda _: words_list(),
    }.get(found[1])
    return make(found[2]) if make else found[0]


def site_link(found: re.Match[str], source: str, depth: str) -> str:
    """Return a Markdown link's end with its target in the site."""
    target, anchor = found[1], found[2] or ""
    if "://" in target or target.startswith(("mailto:", "data:")):
        return found[0]
    folder = {"contributing.md": ROOT, "benchmarks": ROOT / "benchmarks" / "results"}.get(
        source.split("/")[0], ROOT / "docs"
    )
    path = Path(os.path.normpath(folder / target))
    if not path.exists() or path.is_dir() or not path.is_relative_to(ROOT):
        return found[0]  # to a made page, or dead: MkDocs says so
    place = path.relative_to(ROOT)
    if place.parts[0] in ("examples", "notebooks"):
        new = f"gallery/{place.stem}.md"
    elif place.parts[:2] == ("benchmarks", "results") and place.suffix == ".md":
        new = f"benchmarks/{place.name}"
    elif place.parts[0] == "docs":
        new = place.relative_to("docs").as_posix()
    else:
        new = {"CONTRIBUTING.md": "contributing.md", "README.md": "README.md"}.get(place.as_posix(), "")
    return f"]({depth}{new}{anchor})" if new else found[0]


def lists_apart(text: str) -> str:
    """Return Markdown with an empty line before each list, and after each heading.

    Example:
        >>> lists_apart("Three:\\n- one\\n- two")
        'Three:\\n\\n- one\\n- two'
    """
    found: list[str] = []
    fenced = False
    for line in text.split("\n"):
        before = found[-1] if found else ""
        fenced ^= line.lstrip().startswith("```")
        is_item = re.match(r"([-*+]|\d+\.) ", line)
        goes_on = re.match(r"([-*+]|\d+\.) |\s", before)
        heads = re.match(r"#{1,6} ", before) and line.strip()
        if not fenced and before.strip() and ((is_item and not goes_on) or heads):
            found.append("")
        found.append(line)
    return "\n".join(found)


# Commands


def verbs() -> list[str]:
    """Return the verbs of the command line."""
    from evnlos.cli import VERBS

    return list(VERBS)


def help_of(verb: str) -> str:
    """Return what `evnlos VERB --help` prints."""
    from evnlos.cli import main

    out = io.StringIO()
    with (
        mock.patch.dict(os.environ, COLUMNS=COLUMNS, NO_COLOR="1"),
        contextlib.redirect_stdout(out),
        contextlib.suppress(SystemExit),
    ):
        main([verb, "--help"])
    if not out.getvalue():
        raise PluginError(f"evnlos {verb} --help prints nothing")
    return re.sub(r"\x1b\[[\d;]*m", "", out.getvalue()).rstrip()


def command_page(verb: str) -> str:
    """Return the page of a command: what its help says, in the help's own layout."""
    from evnlos.cli.main import summary_of

    return f"# evnlos {verb}\n\n{summary_of(verb)}\n\n```text\n{help_of(verb)}\n```\n"


def commands_table(depth: str) -> str:
    """Return all commands with their one sentence."""
    from evnlos.cli.main import summary_of

    rows = "".join(
        f"| [`evnlos {verb}`]({depth}commands/{verb}.md) | {_cell(summary_of(verb))} |\n" for verb in verbs()
    )
    return f"| command | what it does |\n|---|---|\n{rows}"


# Python


def rooms() -> list[str]:
    """Return the public rooms of the package that list names, the package itself first."""
    import evnlos

    with_names = [
        name
        for _, name, is_room in pkgutil.iter_modules(evnlos.__path__)
        if is_room and name != "cli" and getattr(importlib.import_module(f"evnlos.{name}"), "__all__", ())
    ]
    return ["evnlos", *with_names, "metrics", "errors", "types"]


def names_of(room: str) -> list[tuple[str, Any]]:
    """Return the names that a room lists, and what they are."""
    module = importlib.import_module(room if room == "evnlos" else f"evnlos.{room}")
    listed = getattr(module, "__all__", None)
    if listed is None:
        listed = [
            name
            for name, thing in vars(module).items()
            if not name.startswith("_") and getattr(thing, "__module__", "") == module.__name__
        ]
    return [(name, getattr(module, name)) for name in listed if not name.startswith("__")]


def room_page(room: str) -> str:
    """Return the page of a room: its docstring and each name with signature and docstring, or its value."""
    module = importlib.import_module(room if room == "evnlos" else f"evnlos.{room}")
    text = [f"# {module.__name__}\n", inspect.getdoc(module) or "", ""]
    if room == "evnlos":
        text.append("The names that are used most; each is also in its room, where it is explained.\n")
        return "\n".join(
            [*text, *(f"- [`{name}`][{_home(thing)}]" for name, thing in names_of(room) if _home(thing))]
        )
    for name, thing in names_of(room):
        if home := _home(thing):
            text.append(f"::: {home}\n")
        else:
            text += [f"## {name}", f"`{name}`: {type(thing).__name__}\n"]
    return "\n".join(text)


def _home(thing: Any) -> str:
    """Return where a function or class is defined, e.g. evnlos.events.surface.time_surface; "" for a value."""
    module = getattr(thing, "__module__", "") or ""
    if (
        inspect.isroutine(thing)
        or inspect.isclass(thing)
        or hasattr(thing, "__wrapped__")
        or hasattr(thing, "py_func")
    ):
        return f"{module}.{thing.__qualname__}" if module.startswith("evnlos") else ""
    return ""


def rooms_table(depth: str) -> str:
    """Return the rooms with the first sentence of each."""
    rows = ""
    for room in rooms():
        module = importlib.import_module(room if room == "evnlos" else f"evnlos.{room}")
        first = (inspect.getdoc(module) or "").split("\n\n")[0].replace("\n", " ")
        rows += f"| [`{module.__name__}`]({depth}api/{room}.md) | {_cell(first)} | {len(names_of(room))} |\n"
    return f"| room | what is in it | names |\n|---|---|---|\n{rows}"


class DocstringSections(griffe.Extension):
    """What this package calls `Example:` is to Griffe a section `Examples:`, shown as code."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rename the section in one docstring."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"^( *)Example:$", r"\1Examples:", obj.docstring.value, flags=re.M)


# Settings


def settings_tables(name: str) -> str:
    """Return a table of each settings class that `name` (e.g. evnlos.data.CaptureInfo) is made of.

    Classes that a `kinds` comment shows on their own pages are named, not repeated.
    """
    first = _class(name)
    return f"\n## {first.__name__}\n\n{_said(first)}\n\n{_table(first)}{_nested([first])}"


def _nested(classes: list[Any]) -> str:
    """Return the tables of the settings classes within `classes`, each once."""
    seen, to_do, text = set(classes), list(classes), ""
    while to_do:
        for inner in _inner(to_do.pop(0)):
            if inner not in seen and not hasattr(inner, "registry"):
                seen.add(inner)
                to_do.append(inner)
                text += f"\n## {inner.__name__}\n\n{_said(inner)}\n\n{_table(inner)}"
    return text


def _said(cls: type) -> str:
    """Return a class's docstring without its arguments, which the table holds."""
    return inspect.cleandoc(cls.__doc__ or "").split("\n\nArgs:")[0]


def kinds_tables(name: str) -> str:
    """Return a table of each kind of a family of settings, e.g. evnlos.setups.Setup."""
    family = _class(name)
    kinds = {kind: family.class_for({"kind": kind}) for kind in family.registry}
    tables = "".join(f"\n## kind: {kind}\n\n{_said(cls)}\n\n{_table(cls)}" for kind, cls in kinds.items())
    return tables + _nested(list(kinds.values()))


def _class(name: str) -> Any:
    module, _, last = name.rpartition(".")
    return getattr(importlib.import_module(module), last)


def _table(cls: type) -> str:
    hints, said = typing.get_type_hints(cls), field_words(cls)
    rows = ""
    for field in dataclasses.fields(cls):
        if field.init:
            rows += (
                f"| `{field.name}` | {_cell(_type(hints[field.name]))} | {_cell(_default(field))} "
                f"| {_cell(said.get(field.name, ''))} |\n"
            )
    return f"| key | type | default | meaning |\n|---|---|---|---|\n{rows}"


def field_words(cls: type) -> dict[str, str]:
    """Return the sentence below each field of a dataclass, or that of `Args:` in its docstring."""
    said: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        for name, words in re.findall(
            r"^    (\w+): ((?:.|\n {8})*)", inspect.cleandoc(base.__doc__ or ""), re.M
        ):
            said[name] = " ".join(words.split())
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(body, ast.ClassDef)
        for node, after in zip(body.body, body.body[1:], strict=False):
            if (
                isinstance(node, ast.AnnAssign)
                and isinstance(node.target, ast.Name)
                and isinstance(after, ast.Expr)
                and isinstance(after.value, ast.Constant)
            ):
                said[node.target.id] = " ".join(str(after.value.value).split())
    return said


def _inner(cls: type) -> list[Any]:
    """Return the settings classes that the fields of a class are of."""
    found: list[Any] = []

    def look(hint: Any) -> None:
        if inspect.isclass(hint) and dataclasses.is_dataclass(hint):
            found.append(hint)
        for part in typing.get_args(hint):
            look(part)

    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        look(hints[field.name])
    return found


def _type(hint: Any) -> str:
    """Return a type as a reader of YAML would say it."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_type(part) for part in parts)
    if origin is typing.Literal:
        return ", ".join(str(part) for part in parts)
    if origin is tuple:
        return f"list of {_type(parts[0])}" if parts[-1] is ... else f"[{', '.join(map(_type, parts))}]"
    if origin in (list, frozenset, set):
        return f"list of {_type(parts[0])}"
    if origin is dict:
        return f"mapping of {_type(parts[0])} to {_type(parts[1])}"
    words = {bool: "true or false", int: "whole number", float: "number", str: "text", type(None): "null"}
    if hint in words:
        return words[hint]
    if hasattr(hint, "registry"):
        return f"{hint.__name__}: any kind"
    if dataclasses.is_dataclass(hint):
        return f"[{hint.__name__}](#{hint.__name__.lower()})"
    return getattr(hint, "__name__", str(hint))


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is not dataclasses.MISSING:
        value = field.default
    elif field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    else:
        return "**needed**"
    if dataclasses.is_dataclass(value):
        return type(value).__name__
    return f"`{json.dumps(value, default=str)}`"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


# Lists of what there is


def presets_table() -> str:
    """Return the numbers of all presets of pixels, a column each, and where each comes from."""
    from evnlos.cameras import pixel_preset
    from evnlos.cameras.sensors import PRESETS

    made = {name: pixel_preset(name) for name in PRESETS}
    fields = dict.fromkeys(field.name for pixel in made.values() for field in dataclasses.fields(pixel))
    rows = "".join(
        f"| `{field}` | {' | '.join(_number(getattr(pixel, field, '')) for pixel in made.values())} |\n"
        for field in fields
    )
    notes = "".join(
        f"- `{name}`: {' '.join((inspect.getdoc(preset) or '').split('Example:')[0].split())}\n"
        for name, preset in PRESETS.items()
    )
    return f"| | {' | '.join(f'`{name}`' for name in made)} |\n|---|{'---|' * len(made)}\n{rows}\n{notes}"


def _number(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def formats_table() -> str:
    """Return the event file formats, and what can be done with each."""
    from evnlos.events.files.registry import FORMATS

    def yes(value: object) -> str:
        return "yes" if value else ""

    rows = "".join(
        f"| {one.name} | {' '.join(f'`{end}`' for end in one.suffixes)} | {yes(one.create)} "
        f"| {yes(one.frames)} | {yes(one.has_streams)} |\n"
        for one in FORMATS
    )
    return f"| format | file names | also written | frames | several streams |\n|---|---|---|---|---|\n{rows}"


def setups_table() -> str:
    """Return the named setups, with those of their settings that are not the same in all."""
    from evnlos.setups import ROOMS, load_setup, setup_names

    made = {name: load_setup(name) for name in setup_names() if name not in ROOMS}
    names = [field.name for field in dataclasses.fields(next(iter(made.values())))]
    differ = [one for one in names if len({repr(getattr(setup, one)) for setup in made.values()}) > 1]
    rows = "".join(
        f"| `{name}` | {' | '.join(_cell(_number(getattr(setup, one))) for one in differ)} |\n"
        for name, setup in made.items()
    )
    rooms = ", ".join(f"`{name}`" for name in ROOMS)
    heads = " | ".join(f"`{one}`" for one in differ)
    table = f"| name | {heads} |\n|---|{'---|' * len(differ)}\n{rows}"
    return f"{table}\nRooms, which the simulator cannot describe: {rooms}.\n"


def words_list() -> str:
    """Return the words that reports explain."""
    from evnlos.report.page import GLOSSARY

    return "".join(f"**{word}**: {said}\n\n" for word, said in GLOSSARY.values())


# Gallery


def examples() -> list[Path]:
    """Return the examples and the notebooks."""
    return [*sorted(ROOT.glob("examples/[0-9]*.py")), *sorted(ROOT.glob("notebooks/*.ipynb"))]


def benchmarks() -> list[Path]:
    """Return the tables that benchmarks wrote."""
    return sorted(ROOT.glob("benchmarks/results/*.md"))


def example_page(path: Path) -> str:
    """Return an example as a page: question, figure and code; a notebook with its outputs."""
    if path.suffix == ".ipynb":
        return notebook_page(path)
    source = path.read_text(encoding="utf-8")
    doc = ast.get_docstring(ast.parse(source)) or ""
    title, _, rest = doc.partition("\n\n")
    figure = _figure(path)
    shown = f"![{title.strip()}](../figures/{figure})\n\n" if figure else ""
    code = f'```python title="examples/{path.name}"\n{source}```\n'
    return f"# {title.strip().rstrip('.')}\n\n{shown}{rest}\n\n{code}"


def _figure(path: Path) -> str:
    """Return the name of the figure that an example says it draws, where the docs hold it."""
    names = re.findall(r"docs/figures/([\w.-]+)", path.read_text(encoding="utf-8"))
    return next((name for name in names if (ROOT / "docs" / "figures" / name).exists()), "")


def notebook_page(path: Path) -> str:
    """Return a notebook's cells as Markdown, with what they printed and drew."""
    text = ""
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            text += f"{source}\n\n"
            continue
        text += f"```python\n{source}\n```\n\n"
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/svg+xml" in data:
                text += f"<div>{''.join(data['image/svg+xml'])}</div>\n\n"
            elif "image/png" in data:
                image = "".join(data["image/png"]).replace("\n", "")
                text += f'<img alt="what the cell draws" src="data:image/png;base64,{image}">\n\n'
            elif printed := "".join(output.get("text", data.get("text/plain", []))):
                text += f"```text\n{printed.rstrip()}\n```\n\n"
    return text


def thumbnails(depth: str) -> str:
    """Return a card of each example and notebook, with its figure."""
    cards = ""
    for path in examples():
        page = example_page(path)
        title = page.partition("\n")[0].lstrip("# ")
        figure = _figure(path) if path.suffix == ".py" else ""
        image = f"[![{title}]({depth}figures/{figure})]({depth}gallery/{path.stem}.md)\n\n" if figure else ""
        cards += f'<div markdown="1">\n{image}[{title}]({depth}gallery/{path.stem}.md)\n\n</div>\n'
    return f'<div class="thumbs" markdown="1">\n{cards}</div>\n'
