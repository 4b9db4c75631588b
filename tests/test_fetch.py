"""Published files: checked, whole or not there, from a server, a mirror or a folder; nothing by itself."""

import json
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

import pytest

from evnlos.cli import main
from evnlos.errors import DataError
from evnlos.files import fetch_file, published_list, write_list


class Quiet(SimpleHTTPRequestHandler):
    asked: ClassVar[list[str]] = []

    def do_GET(self) -> None:
        self.asked.append(self.path)
        super().do_GET()

    def log_message(self, format: str, *args: object) -> None: ...


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "published" / "captures"
    for name in ("near_R", "near_G"):
        (place / name).mkdir(parents=True)
        (place / name / "capture.yaml").write_text(f"name: {name}\n")
    (place / "near_R" / "events à b.raw").write_bytes(bytes(range(256)) * 9000)
    write_list(place)
    return place.parent


@pytest.fixture
def server(folder: Path):
    Quiet.asked = []
    one = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=one.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{one.server_port}"
    one.shutdown()
    one.server_close()
    thread.join(5)


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch) -> Path:
    place = tmp_path / "here"
    place.mkdir()
    monkeypatch.chdir(place)
    monkeypatch.delenv("EVNLOS_DATA", raising=False)
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    return place


def fails(words: list[str], capsys) -> str:
    with pytest.raises(SystemExit) as end:
        main(["fetch", *words])
    said = capsys.readouterr().err
    assert end.value.code == 2 and said.count("\n") == 1, said
    return said


@pytest.mark.parametrize("way", ["server", "folder"])
def test_files_come_as_they_were_published(way, folder, server, here, capsys) -> None:
    address = server if way == "server" else str(folder)
    main(["fetch", "captures", "--address", address, "--json"])
    found = json.loads(capsys.readouterr().out)
    assert (found["files"], found["fetched"]) == (3, 3)
    for path in (folder / "captures").rglob("*.*"):
        assert (here / "captures" / path.relative_to(folder / "captures")).read_bytes() == path.read_bytes()
    assert found["bytes"] == sum(p.stat().st_size for p in (here / "captures").rglob("*.*"))
    main(["fetch", "captures", "--address", address])  # again: nothing is loaded twice
    assert "0 of them fetched" in capsys.readouterr().out


def test_a_part_and_a_list(server, here, capsys) -> None:
    main(["fetch", "captures", "near_G", "--address", server])
    assert [p.name for p in (here / "captures").iterdir()] == ["near_G"]
    capsys.readouterr()
    Quiet.asked.clear()
    main(["fetch", "captures", "--address", server, "--list"])
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["there", "-", "-"]
    assert Quiet.asked == ["/captures/SHA256SUMS"]
    assert "near_G, near_R" in fails(["captures", "near", "--address", server], capsys)


def test_a_mirror_stands_in(server, capsys) -> None:
    main(["fetch", "captures", "--address", "http://127.0.0.1:9", "/nowhere", server])
    assert "3 files as published" in capsys.readouterr().out


def test_where_nothing_is_reachable_one_line_says_so(here, capsys, monkeypatch) -> None:
    assert "set EVNLOS_DATA" in fails(["weights"], capsys)
    monkeypatch.setenv("EVNLOS_DATA", "http://127.0.0.1:9")
    said = fails(["weights"], capsys)
    assert "no published weights can be reached" in said and "http://127.0.0.1:9" in said
    assert "https://, http:// or a folder" in fails(["weights", "--address", "ftp://127.0.0.1"], capsys)
    assert "is no address" in fails(["weights", "--address", "http://127.0.0.1:port"], capsys)
    assert list(here.iterdir()) == []


def test_what_was_replaced_is_refused(server, folder, here, capsys) -> None:
    (folder / "captures" / "near_G" / "capture.yaml").write_text("name: other\n")
    assert "is not the listed file" in fails(["captures", "--address", server], capsys)
    assert [p for p in (here / "captures").rglob("*") if p.is_file()] == []


def test_own_files_are_not_replaced(server, here, capsys) -> None:
    (here / "captures" / "near_G").mkdir(parents=True)
    mine = here / "captures" / "near_G" / "capture.yaml"
    mine.write_text("mine")
    assert "--force replaces it" in fails(["captures", "--address", server], capsys)
    assert mine.read_text() == "mine"
    main(["fetch", "captures", "--address", server, "--force"])
    assert mine.read_text() == "name: near_G\n"


@pytest.mark.parametrize("name", ["../x", "/etc/x", "a/../../x", "C:/x", "a//x", "."])
def test_a_list_that_leads_out_of_its_folder_is_refused(name, folder) -> None:
    (folder / "captures" / "SHA256SUMS").write_text(f"{'0' * 64}  {name}\n")
    with pytest.raises(DataError, match=r"outside its folder|no list"):
        published_list(str(folder), "captures")


def test_a_list_that_is_none(folder, server) -> None:
    (folder / "captures" / "SHA256SUMS").write_text("<html>404</html>\n")
    with pytest.raises(DataError, match="no list"):
        published_list(server, "captures")


def test_a_file_without_end_is_refused(folder, server, tmp_path) -> None:
    listed = published_list(server, "captures")
    name = "near_R/events à b.raw"
    with pytest.raises(DataError, match="larger than"):
        fetch_file(server, "captures", name, listed[name], tmp_path / "x", 1000)
    assert [p for p in (tmp_path / "x").rglob("*") if p.is_file()] == []
