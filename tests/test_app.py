"""The page: what it shows, what it refuses, and the page itself in a real browser."""

import asyncio
import importlib.util
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import pytest

import chromium
from evnlos import Events, machine, untrusted
from evnlos.analysis.identify import GUESSED
from evnlos.app.controls import (
    CHARACTERS,
    FILMS,
    INK_SIDE,
    PRESETS,
    Controls,
    drawn,
    link_of,
    picked,
    settings_of,
    simulate_film,
    simulate_sequence,
)
from evnlos.app.page import Wanted, build_page, simulated
from evnlos.app.serve import Server, middleware, running
from evnlos.app.views import (
    Networks,
    event_views,
    film_truth,
    found_views,
    from_each_frame,
    from_film,
    from_weights,
    from_whole_sequence,
    limits_of,
    message_box,
    own_networks,
    seen_views,
    verdict_box,
)
from evnlos.cli import main
from evnlos.data import Sampling
from evnlos.errors import ConfigError, DataError, MissingDependencyError
from evnlos.models import load_weights
from evnlos.plot.figures import CloudSize, cloud_images, signed_images, smaller, time_slices

SMALL = Controls(columns=24)


def test_a_sequence_is_the_same_bytes_for_the_same_settings(app_sequence) -> None:
    again = simulate_sequence(SMALL, picked("R"))
    assert again.events == app_sequence.events and len(app_sequence.events) > 300
    np.testing.assert_array_equal(again.frames, app_sequence.frames)
    assert simulate_sequence(replace(SMALL, seed=2), picked("R")).events != app_sequence.events


def test_settings_do_what_they_say(app_sequence) -> None:
    faster = simulate_sequence(replace(SMALL, speed_m_s=0.04), picked("R"))
    assert faster.times_s[-1] == pytest.approx(app_sequence.times_s[-1] / 2)
    higher = simulate_sequence(replace(SMALL, threshold_on=0.3, threshold_off=0.3), picked("R"))
    assert len(higher.events) < 0.7 * len(app_sequence.events)
    assert (
        simulate_sequence(replace(SMALL, ambient=0.4), picked("R")).frames.min() > app_sequence.frames.max() / 2
    )
    usual, noisy = (Controls(frame_noise=n).simulation().frame_camera for n in (1.0, 3.0))
    for level in (0.0, 0.3):
        # Shot and read noise in white levels, both three times as strong.
        own, more = ((c.full_well_e * level + c.read_noise_e**2) ** 0.5 / c.full_well_e for c in (usual, noisy))
        assert more == pytest.approx(3 * own)


@pytest.mark.parametrize("name", ["roughness", "distance_m", "speed_m_s", "ambient", "threshold_on", "columns"])
def test_settings_out_of_range_are_one_line(name: str) -> None:
    for wrong in (-1.0, 1e9, float("nan"), None):
        with pytest.raises(ConfigError, match=name):
            replace(SMALL, **{name: wrong})


def test_a_drawing_is_a_target() -> None:
    ink = np.zeros((INK_SIDE, INK_SIDE), np.uint8)
    ink[4:9, 10:] = 255
    target = drawn(ink.tobytes().hex())
    np.testing.assert_array_equal(target.mask, ink / np.float32(255))
    assert simulate_sequence(SMALL, target).truth(Sampling()).max() > 0.9
    for wrong in ("", "00" * INK_SIDE**2, "ff", "zz" * INK_SIDE**2, "FF" * INK_SIDE**2, "f" * 10**6):
        with pytest.raises(DataError):
            drawn(wrong)
    with pytest.raises(ConfigError, match="hidden character"):
        picked("RR")
    assert picked(CHARACTERS[0]).mask.any()


def test_a_plane_that_changes_is_a_film() -> None:
    polished = replace(SMALL, roughness=0.02)
    for name in FILMS:
        recorded = simulate_film(polished, name)
        assert len(recorded) == 40 and len(recorded.events) > 100 and recorded.truth(Sampling()) is None
        again = simulate_film(polished, name)
        assert again.events == recorded.events and again.frames.tobytes() == recorded.frames.tobytes()
        truth, found = film_truth(recorded), from_film(recorded, "frames")
        assert found.images.shape == truth.shape == (40, 16, 16) and found.psnr_db.shape == (40,)
        assert found.psnr_db.mean() > found.black_db.mean() + 4
        changes, true = (one - one.mean(axis=0) for one in (found.images, truth))
        assert np.corrcoef(changes.ravel(), true.ravel())[0, 1] > 0.7
    for evidence in ("events", "both"):
        seen = from_film(recorded, evidence)
        assert seen.images.shape == truth.shape and "90 % intervals hold" in seen.note
        assert seen.psnr_db.mean() > seen.black_db.mean()
    with pytest.raises(ConfigError, match="hidden film is 'R'; give closing hand or screen that fades"):
        simulate_film(SMALL, "R")
    with pytest.raises(DataError, match="setup"):
        from_film(replace(recorded, simulation=None), "frames")


def test_a_film_stands_on_the_page_beside_the_truth() -> None:
    first, between, second = simulated(SMALL, "closing hand", Networks())
    assert between == (second[0], first[1])
    for title in (">Hidden plane<", ">Wall<", ">Events<", ">Film, frames<", ">Space-time cloud<"):
        assert title in first[0] and title in second[0]
    for title in (">Film, events<", ">Film, both<"):
        assert title not in first[0] and title in second[0]
    assert 'aria-label="Image of the film"' in first[0] and "image 21 of 40" in first[0]
    assert "Network" not in second[0] and "dB, black" in second[0]


def test_classical_images_beat_black_and_the_whole_sequence_beats_one_frame(app_sequence) -> None:
    whole, single = from_whole_sequence(app_sequence), from_each_frame(app_sequence)
    middle = slice(10, 30)
    assert whole.psnr_db[middle].mean() > single.psnr_db[middle].mean() + 0.5
    assert single.psnr_db[middle].mean() > single.black_db[middle].mean() + 1.5
    matte = simulate_sequence(replace(SMALL, wall="matte"), picked("R"))
    assert from_whole_sequence(matte).psnr_db[middle].mean() < whole.psnr_db[middle].mean() - 1.0
    with pytest.raises(DataError, match="setup"):
        from_each_frame(replace(app_sequence, simulation=None))


def test_networks_see_what_they_were_trained_on(app_sequence, app_weights) -> None:
    named = own_networks((app_weights["fusion"].parent, app_weights["event"])).of(app_sequence)
    assert list(named) == ["fusion-run", "event-run"]
    found = from_weights(app_sequence, "fusion-run", named["fusion-run"])
    assert found.images.shape == (40, 12, 24) and found.psnr_db.shape == (40,)
    blind = replace(app_sequence, frames=None)
    assert from_weights(blind, "event-run", named["event-run"]).images.shape == (40, 12, 24)
    with pytest.raises(DataError, match="has none"):
        from_weights(blind, "fusion-run", named["fusion-run"])
    with pytest.raises(DataError):
        own_networks((Path("nowhere"),))


def test_networks_of_the_package_see_more_than_least_squares(app_sequence) -> None:
    """The camera is half as fine as the one that they were trained on."""
    named = Networks().of(app_sequence)
    assert list(named) == ["network, frames", "network, events", "network, both"]
    found = {name: from_weights(app_sequence, name, one) for name, one in named.items()}
    single = from_each_frame(app_sequence).psnr_db.mean()
    for name in ("network, frames", "network, both"):
        assert found[name].psnr_db.mean() > single + 2, name
        assert "all frames" in found[name].note and "agree on" in found[name].note
        assert any(guessed in found[name].note for guessed in GUESSED.values())


def test_images_of_a_wall_that_networks_do_not_know_are_refused_by_its_frames() -> None:
    networks, noted = Networks(), {}
    for name, setup in (("own", SMALL), ("rough", replace(SMALL, roughness=0.2))):
        recorded = simulate_sequence(setup, picked("R"))
        wall = networks.wall_of(recorded)
        network = networks.of(recorded)["network, frames"]
        noted[name] = from_weights(recorded, "frames", network, wall).note
        assert "agree on" in from_weights(recorded, "frames", network).note  # the images alone do not tell
    assert "agree on" in noted["own"] and "nothing measured" in noted["rough"]


def test_only_networks_of_the_package_bring_a_wall_for_recordings(app_sequence, app_weights) -> None:
    package, own = Networks(), own_networks((app_weights["event"],))
    recording = replace(app_sequence, simulation=None)
    assert package.wall_of(app_sequence) is not None and own.wall_of(app_sequence) is not None
    assert package.wall_of(recording) is not None and own.wall_of(recording) is None
    assert package.wall_of(replace(recording, motion=None)) is None
    assert package.wall_of(replace(app_sequence, frames=None)) is None


def test_the_verdict_tells_a_mirror_from_a_matte_wall() -> None:
    shown = [limits_of(replace(SMALL, **one).simulation()) for one in ({"roughness": 0.02}, {"wall": "matte"})]
    assert "measured" in shown[0].wall and "not from the measurement" not in shown[0].wall
    assert "not from the measurement" in shown[1].wall
    for one in shown:
        assert one.wall[1:] in unescape(verdict_box(one)) and "dB" in verdict_box(one)


def test_a_sheet_holds_every_position_and_asks_nobody(app_sequence, app_weights) -> None:
    own = Networks({"net": load_weights(app_weights["event"])})
    first, between, second = simulated(SMALL, picked("R"), own)
    assert between == (second[0], first[1])
    assert "Looking at it" in first[1] and "Looking at it" not in second[1]
    assert ">Net<" in second[0] and ">Net<" not in first[0]
    for text in (*first, *second):
        assert not re.findall(r"(?:src|href|url)\s*[=(]\s*['\"]?(?!data:)[a-z]", text)
        assert "http" not in re.sub(r"base64,[^)]*", "", text)
    assert first[0] == next(simulated(SMALL, picked("R"), Networks()))[0]
    views = seen_views(app_sequence) + found_views([from_each_frame(app_sequence)]) + event_views(app_sequence)
    for view in views:
        assert len(view.pictures) == (1 if view.cursor else 40)
        assert view.pictures.dtype == np.uint8 and view.pictures.any()
        assert len(view.captions) in (0, 40)


def built_page(gradio: Any, scratch: Path) -> Any:
    """Return the page, without networks and not served."""

    async def build() -> Any:  # in a loop, or Gradio makes one and leaves it open
        return build_page(gradio, ("", ""), Controls(), Networks({}), scratch, 10_000)

    return asyncio.run(build())


def test_a_number_beside_a_slider_keeps_to_its_ends(tmp_path) -> None:
    gradio = pytest.importorskip("gradio")
    page = built_page(gradio, tmp_path)
    sliders = [one for one in page.blocks.values() if isinstance(one, gradio.Slider)]
    assert len(sliders) > 5
    for one in sliders:
        assert one.preprocess(1e6) == one.maximum and one.preprocess(-1e6) == one.minimum


def test_the_page_leaves_out_what_comes_of_a_removed_upload(tmp_path, monkeypatch) -> None:
    gradio = pytest.importorskip("gradio")
    monkeypatch.setattr("evnlos.app.page.uploaded", lambda path, *_: (f"sheet of {path}", "message"))
    page, visitor = built_page(gradio, tmp_path), SimpleNamespace(session_hash="one")
    (file,) = [one for one in page.blocks.values() if isinstance(one, gradio.File)]
    begin, read = [one.fn for one in page.fns.values() if file in one.inputs]
    how = "moves as a whole", 20, 14, visitor
    begin("a.raw", *how)
    assert read("a.raw", *how) == ("sheet of a.raw", "message")
    for then in (None, "b.raw"):
        assert begin(then, *how)[0] == ""
        assert "sheet" not in str(read("a.raw", *how))
    assert read("b.raw", *how)[0] == "sheet of b.raw"
    begin("b.raw", "rests and changes its picture", 20, 14, visitor)
    assert "sheet" not in str(read("b.raw", *how))


def test_what_comes_of_a_removed_upload_is_not_shown() -> None:
    wanted = Wanted(most=2)
    wanted.note("one", "a.raw")
    assert wanted.is_still("one", "a.raw")
    wanted.note("one", None)
    assert not wanted.is_still("one", "a.raw") and wanted.is_still("one", None)
    wanted.note("one", "b.raw")
    assert not wanted.is_still("one", "a.raw") and wanted.is_still("one", "b.raw")
    wanted.note("two", "c.raw")
    wanted.note("three", "d.raw")
    assert wanted.is_still("one", "a.raw")  # forgotten
    assert not wanted.is_still("two", "a.raw")


def test_a_message_is_text() -> None:
    box = message_box("<script>alert(1)</script>\nsecond line")
    assert "<script>" not in box and "\n" not in box and "&lt;script&gt;" in box


def test_the_cloud_shows_each_event_once_as_present() -> None:
    events = Events([5, 15, 25], [0, 3, 1], [0, 1, 1], [1, 0, 1], width=4, height=2)
    pictures, colours = cloud_images(events, np.array([0, 10, 20, 30]), CloudSize(160, 96))
    for k, now in enumerate((6, 7, 6)):
        assert (pictures[k] == now).any() and not (pictures[k] == 13 - now).any()
    assert not (pictures[2] == 3).any() and (pictures[0] == 3).any()
    assert colours.shape == (8, 4)
    blank, _ = cloud_images(Events.empty(4, 2), np.array([0, 10]))
    assert not (blank >= 3).any()
    with pytest.raises(DataError, match="64"):
        CloudSize(10, 10)


def test_slices_count_the_events_of_the_middle() -> None:
    events = Events([1, 5, 9], [8, 8, 0], [8, 0, 8], [1, 1, 0], width=16, height=16)
    over_x, over_y = time_slices(events, np.array([0, 10]), bins=10)
    assert over_x.sum() == 2 and over_x[0, 8, 1] == 1 and over_x[1, 0, 9] == 1
    assert over_y.sum() == 2 and over_y[0, 8, 1] == 1 and over_y[0, 0, 5] == 1
    with pytest.raises(DataError, match="bins"):
        time_slices(events, np.array([0, 10]), bins=0)
    assert not signed_images(np.zeros((2, 3, 3))).any()


def test_a_large_sensor_is_made_small_without_losing_events() -> None:
    draw = np.random.default_rng(0)
    x, y = draw.integers(0, 1281, 100), draw.integers(0, 720, 100)
    events = Events(np.arange(100), x, y, draw.integers(0, 2, 100), width=1281, height=720)
    small = smaller(events, 320)
    assert (small.width, small.height) == (257, 144) and len(small) == 100
    np.testing.assert_array_equal(small.x, x // 5)
    assert smaller(small, 320) is small


def test_a_server_refuses_what_cannot_be() -> None:
    for wrong in ({"port": 70_000}, {"upload_mb": 0}, {"upload_mb": float("nan")}):
        with pytest.raises(ConfigError):
            Server(**wrong)
    assert Server().host == "127.0.0.1"


def test_without_gradio_the_page_says_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "gradio", None)
    steps = list[machine.Step]()
    failing = running(Server(port=0), progress=steps.append)
    with pytest.raises(MissingDependencyError, match=r"evnlos\[app\]"), failing:
        pass
    assert [(step.done, step.total, step.within) for step in steps] == [(0, 3, "libraries")]


@pytest.mark.parametrize(("host", "is_open"), [("127.0.0.1", False), ("localhost", False), ("0.0.0.0", True)])
def test_a_page_that_is_open_to_the_network_says_so(host: str, is_open: bool, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "gradio", None)  # the word comes before the page is made
    with pytest.raises(SystemExit):
        main(["app", "--host", host, "--port", "0"])
    said = capsys.readouterr().err.splitlines()
    warned = [line for line in said if "asks for no password" in line]
    assert len(warned) == is_open
    assert not warned or warned[0].startswith(f"warning: --host {host} opens the page to the network")


def test_a_host_or_port_that_can_not_be_had_is_one_line_at_once() -> None:
    began_s = time.monotonic()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for server, words in (
            (Server(host="nonsense.invalid"), "host 'nonsense.invalid' is not known; give 127.0.0.1"),
            (Server(host="a" * 64), "is not known"),
            (Server(host="192.0.2.1"), "192.0.2.1 is no address of this machine; give"),
            (Server(port=port), f"port {port} is in use; give another --port, or 0 for a free one"),
        ):
            with pytest.raises(ConfigError) as stop, running(server):
                pass
            assert words in str(stop.value) and "\n" not in str(stop.value)
    assert time.monotonic() - began_s < 10


def test_a_resolver_that_does_not_answer_is_not_waited_for(monkeypatch) -> None:
    answer = threading.Event()

    def slow(*_: object, **__: object) -> None:
        answer.wait(60)
        raise OSError

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    with pytest.raises(ConfigError, match="is not known"):
        machine.listening_address("slow.example", 0)
    answer.set()


def test_names_of_this_machine() -> None:
    for name in ("127.0.0.1:7860", "localhost", "LOCALHOST:1", "[::1]:7860", "127.8.9.1"):
        assert untrusted.names_this_machine(name)
    for name in (
        "evil.example",
        "127.0.0.1.evil.example",
        "localhost.evil.example:7860",
        "",
        "::1",
        "a@localhost",
    ):
        assert not untrusted.names_this_machine(name)
    assert untrusted.names_this_machine("Lab:7860", own="lab") and not untrusted.names_this_machine("lab:7860")


@pytest.mark.parametrize(("own", "codes"), [("127.0.0.1", [200, 403]), (None, [200, 200])])
def test_foreign_names_are_refused_unless_the_network_is_let_in(own: str | None, codes: list[int]) -> None:
    pytest.importorskip("starlette")

    async def page(scope, receive, send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"<body></body>"})

    app, found = page, []
    for one in reversed(middleware("<script></script>", own)):
        app = one.cls(app, *one.args, **one.kwargs)

    async def send(message) -> None:
        found.append(message)

    for name in (b"localhost:7860", b"evil.example:7860"):
        asyncio.run(app({"type": "http", "path": "/x", "headers": [(b"host", name)]}, None, send))
    assert [message["status"] for message in found if message["type"] == "http.response.start"] == codes
    if own is not None:
        found.clear()
        asyncio.run(
            app({"type": "websocket", "path": "/", "headers": [(b"host", b"evil.example")]}, None, send)
        )
        assert found == [{"type": "websocket.close", "code": 1008}]


def answered(app, **scope) -> int:
    """Return the status that an ASGI app answers with."""
    found = []

    async def send(message) -> None:
        found.append(message)

    asyncio.run(app({"type": "http", "method": "POST", "path": "/gradio_api/upload", **scope}, None, send))
    return next(message["status"] for message in found if message["type"] == "http.response.start")


def test_other_sites_may_not_send_and_uploads_are_bounded(tmp_path) -> None:
    pytest.importorskip("starlette")

    async def page(scope, receive, send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    app = page
    for one in reversed(middleware("", "127.0.0.1", tmp_path, 1000)):
        app = one.cls(app, *one.args, **one.kwargs)

    def asked(length: int | None = 10, path: str = "/gradio_api/upload", **headers: str) -> int:
        given = {"host": "localhost:7860", **headers} | (
            {} if length is None else {"content-length": str(length)}
        )
        raw = [(name.replace("_", "-").encode(), value.encode()) for name, value in given.items()]
        return answered(app, headers=raw, path=path)

    assert asked() == 200  # a program, which says nothing
    assert asked(origin="http://localhost:7860", sec_fetch_site="same-origin") == 200
    assert asked(origin="http://localhost:7860") == 200
    assert asked(origin="http://evil.example") == 403
    assert asked(origin="http://localhost:9999") == 403  # another page of this machine
    assert asked(origin="null") == 403
    assert asked(sec_fetch_site="cross-site") == 403
    assert asked(sec_fetch_site="same-site") == 403
    assert asked(None) == 411
    assert asked(5_000_000, path="/gradio_api/queue/join") == 413
    assert asked(9_000) == 200
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "file").write_bytes(bytes(9_000))
    assert asked(900) == 200
    assert asked(2_000) == 507


def test_what_a_request_says_of_a_proxy_is_not_believed() -> None:
    pytest.importorskip("starlette")
    seen: list[dict[bytes, bytes]] = []

    async def page(scope, receive, send) -> None:
        seen.append(dict(scope["headers"]))
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    def asked(proxy: str, **headers: str) -> int:
        app = page
        for one in reversed(middleware("", "127.0.0.1", proxy=proxy)):
            app = one.cls(app, *one.args, **one.kwargs)
        given = {"host": "127.0.0.1", "content-length": "1", **headers}
        raw = [(name.replace("_", "-").encode(), value.encode()) for name, value in given.items()]
        return answered(app, headers=raw)

    told = {"x_forwarded_host": "evil.example", "X_Forwarded_Proto": "https", "x_gradio_server": "http://evil"}
    assert asked("", **told) == 200
    assert set(seen[0]) == {b"host", b"content-length"}
    assert asked("", origin="http://evil.example", x_forwarded_host="evil.example") == 403
    assert asked("https://nlos.example.org", origin="https://nlos.example.org") == 200
    assert asked("https://nlos.example.org", origin="https://evil.example") == 403
    for wrong in ("nlos.example.org", "https://a b", "javascript:x", "https://a\n"):
        with pytest.raises(ConfigError):
            Server(proxy=wrong)


def test_the_page_may_not_be_framed() -> None:
    pytest.importorskip("starlette")
    found = []

    async def page(scope, receive, send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def send(message) -> None:
        found.append(message)

    policy = middleware("", None)[0]
    asyncio.run(policy.cls(page)({"type": "http", "path": "/x", "headers": []}, None, send))
    headers = dict(found[0]["headers"])
    assert headers[b"x-frame-options"] == b"DENY" and headers[b"x-content-type-options"] == b"nosniff"
    assert b"frame-ancestors 'none'" in headers[b"content-security-policy"]


def test_messages_name_no_folder_of_this_machine(tmp_path) -> None:
    from evnlos.app.page import uploaded

    folder = tmp_path / ("a" * 64)
    folder.mkdir()
    path = folder / "x.raw"
    path.write_bytes(b"rubbish")
    _, message = uploaded(str(path), tmp_path, 1000, None)  # type: ignore[arg-type]
    assert "x.raw" in message and "a" * 64 not in message and str(tmp_path) not in message


STARTING = """
import contextlib, tempfile, time
from evnlos.app import serve

@contextlib.contextmanager
def starting(server, weights, progress):
    with tempfile.TemporaryDirectory(prefix="evnlos-app-"):
        print("starting", flush=True)
        time.sleep(60)
        yield ""

serve.running = starting
serve.serve(serve.Server())
"""


def test_a_signal_while_it_starts_leaves_no_folder(tmp_path) -> None:
    call, environment = [sys.executable, "-c", STARTING], {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(call, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        assert process.stdout is not None and process.stdout.readline() == b"starting\n"
        assert len(list(tmp_path.iterdir())) == 1
        process.terminate()
        assert process.stdout.read() == b""
    assert process.returncode == 0
    assert not list(tmp_path.iterdir())


def strangers(addresses: list[str], home: str) -> list[str]:
    """Return the addresses that lead to another host."""
    own = {urlsplit(home).netloc}
    return [
        a[:200]
        for a in addresses
        if urlsplit(a).scheme not in ("data", "blob", "chrome", "chrome-untrusted")
        and urlsplit(a).netloc not in own
    ]


@contextmanager
def browsed(folder: Path, *words: str) -> Iterator[tuple[str, chromium.Chromium]]:
    """Give the address of a page that is served with further words of the command, and a browser."""
    if importlib.util.find_spec("gradio") is None:
        pytest.skip("gradio is not installed: pip install 'evnlos[app]'")
    if chromium.missing():
        pytest.skip(f"{chromium.missing()}: apt-get install chromium chromium-driver")
    with (
        chromium.page(folder, "--columns", "24", "--upload-mb", "2", *words) as home,
        chromium.Chromium(folder / "profile") as browser,
    ):
        yield home, browser


SEQUENCE_OF = "document.querySelector('.ev-sheet').dataset.sequence"


def test_the_page_in_a_real_browser(app_weights, tmp_path) -> None:
    """With a small network of its own; on a phone are those of the package."""
    with browsed(tmp_path, "--weights", str(app_weights["event"])) as (home, browser):
        assert urlsplit(home).hostname == "127.0.0.1"
        with pytest.raises(urllib.error.HTTPError) as stop:
            urllib.request.urlopen(urllib.request.Request(home, headers={"Host": "evil.example"}), timeout=60)
        assert stop.value.code == 403
        stop.value.close()
        browser.open(f"{home.rstrip('/')}/?__theme=dark")
        assert browser.wait(
            "const box = document.querySelector('.ev-before');"
            " return box ? getComputedStyle(box).backgroundColor : document.querySelector('.dark') && 'gone'"
        ) in ("rgb(10, 15, 30)", "gone")
        browser.open(home)
        # The images are there before Gradio is, and give way to its own.
        width = browser.wait("const p = document.querySelector('.ev-image'); return p && p.offsetWidth")
        assert width > 100
        marks = "performance.getEntriesByName('evnlos-sheet').map(mark => mark.startTime)"
        first, then = browser.wait(f"const m = {marks}; return m.length > 1 && m.slice(0, 2)")
        painted = browser.run("return performance.getEntriesByName('first-contentful-paint')[0].startTime")
        assert first < painted < then
        browser.wait("return !document.querySelector('.ev-before')")
        assert browser.run("return document.querySelectorAll('.ev-sheet').length") == 1
        # The slider answers in the page itself, by mouse and by key.
        browser.run("const s = document.querySelector('.ev-position'); s.value = 30; s.oninput()")
        assert browser.run("return document.querySelector('.ev-now').textContent").startswith(
            "position 31 of 40"
        )
        assert browser.run("return document.querySelector('.ev-sheet').style.getPropertyValue('--k')") == "30"
        browser.run("document.querySelector('.ev-position').focus()")
        browser.press("\ue012")  # left
        assert browser.run("return document.querySelector('.ev-now').textContent").startswith(
            "position 30 of 40"
        )
        browser.wait("return !document.querySelector('.ev-verdict').textContent.includes('Looking at it')")
        # A control simulates another sequence, looked at where the last one was.
        label = "Ambient light"
        before = browser.run(f"return {SEQUENCE_OF}")
        browser.run(f"document.querySelector('input[type=range][aria-label*=\"{label}\"]').focus()")
        browser.press("\ue014\ue014")  # right
        browser.wait(f"return {SEQUENCE_OF} !== {json.dumps(before)}")
        assert browser.run("return document.querySelector('.ev-now').textContent").startswith(
            "position 30 of 40"
        )
        assert browser.run("return document.querySelector('.ev-position').value") == "29"
        # A number typed beside a slider keeps to the slider's ends.
        box = "document.querySelector('input[type=number][aria-label*=\"Wall roughness\"]')"
        before = browser.run(f"return {SEQUENCE_OF}")
        typed = "b.value = 5; for (const t of ['input', 'change']) b.dispatchEvent(new Event(t, {bubbles: 1}))"
        browser.run(f"const b = {box}; {typed}")
        browser.wait(f"return {box}.value === '0.3'")
        browser.wait(f"return {SEQUENCE_OF} !== {json.dumps(before)}")
        asked = browser.requests()
        complaints = [one for one in browser.complaints() if "SEVERE" in one]
    assert len(asked) > 20 and strangers(asked, home) == []
    assert complaints == []


def test_the_page_on_a_phone_and_opened_by_a_link(tmp_path) -> None:
    with browsed(tmp_path) as (home, browser):
        browser.devtools(
            "Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True
        )
        browser.open(f"{home.rstrip('/')}/?character=G&roughness=0.02&distance_m=0.4")
        link = "document.querySelector('a.ev-button').href"
        browser.wait(
            f"return !document.querySelector('.ev-before') && {link}.endsWith"
            "('?character=G&roughness=0.02&distance_m=0.4') && 1"
        )
        numbers = "[...document.querySelectorAll('.ev-controls input[type=number]')].map(box => box.value)"
        assert browser.run(f"return {numbers}")[:2] == ["0.02", "40"]
        # Images come first, none is wider than the screen, and they stay while one scrolls to a slider.
        top = "document.querySelector('.ev-image').getBoundingClientRect().top"
        assert browser.run(f"return {top}") < 500
        assert browser.run("return document.documentElement.scrollWidth") <= 390
        slider = "document.querySelector('input[type=range][aria-label*=\"Ambient light\"]')"
        browser.run(f"{slider}.scrollIntoView({{block: 'end'}})")
        browser.wait(f"return {slider}.getBoundingClientRect().bottom < 845 && window.scrollY > 100")
        assert 0 <= browser.run(f"return {top}") < 400
        x, y = browser.run(
            f"const b = {slider}.getBoundingClientRect(); return [b.left + 20, b.top + b.height / 2]"
        )
        assert browser.run(f"return document.elementFromPoint({x}, {y}) === {slider}")
        # What is downloaded is an image.
        assert browser.run("return evnlosSave(document.querySelector('button[onclick*=Save]'))") > 10_000
        unnamed = (
            "[...document.querySelectorAll('input, button, canvas, a.ev-button')]"
            ".filter(one => one.offsetParent && !one.getAttribute('aria-label')"
            " && !one.closest('label') && !one.textContent.trim()).length"
        )
        assert browser.run(f"return {unnamed}") == 0
        browser.open(f"{home.rstrip('/')}/?roughness=9")
        browser.wait("return document.querySelector('.ev-message')?.textContent.includes('give 0.01 to 0.3')")


def test_a_link_says_the_settings_and_no_more() -> None:
    changed = Controls("matte", 0.02, 0.4, event_noise_hz=0.5)
    query = dict(parse_qsl(link_of(changed, "Q").removeprefix("?")))
    assert settings_of(query, Controls(columns=64)) == (replace(changed, columns=64), "Q", "")
    assert settings_of({"ink": "ff", "theme": "dark"}, Controls()) == (Controls(), "R", "ff")
    assert link_of(Controls(), ink="00") == "?ink=00"
    shown = link_of(Controls(), "closing hand")
    assert shown == "?film=closing+hand"
    assert settings_of(dict(parse_qsl(shown[1:])), Controls()) == (Controls(), "closing hand", "")
    for wrong in (
        {"roughness": "9"},
        {"roughness": "nan"},
        {"wall": "glass"},
        {"character": "??"},
        {"film": "R"},
        {"ambient": "x"},
    ):
        with pytest.raises(ConfigError):
            settings_of(wrong, Controls())
    for values in PRESETS.values():
        preset = replace(Controls(), **values)
        assert settings_of(dict(parse_qsl(link_of(preset, "R")[1:])), Controls())[0] == preset


def test_drawings_and_uploads_in_a_real_browser(zipped_capture, tmp_path) -> None:
    asked: list[str] = []
    with browsed(tmp_path) as (home, browser):
        browser.open(home)
        browser.wait(
            "return document.querySelector('.ev-play') && !document.querySelector('.ev-before')"
            " && document.querySelector('.ev-now').textContent"
        )
        # Playing moves by itself.
        browser.run("document.querySelector('.ev-play').click()")
        place = json.dumps(browser.run("return document.querySelector('.ev-now').textContent"))
        browser.wait(f"return document.querySelector('.ev-now').textContent !== {place}")
        browser.run("document.querySelector('.ev-play').click()")
        # A drawing becomes the hidden object.
        browser.run("document.querySelector('input[type=radio][value=\"Draw one\"]').click()")
        browser.wait("return document.querySelector('.ev-message')?.textContent.includes('drawing is empty')")
        x, y = browser.wait(
            "const b = document.querySelector('.ev-pen').getBoundingClientRect();"
            " return b.width && [b.left, b.top]"
        )
        before = browser.run(f"return {SEQUENCE_OF}")
        browser.drag([(int(x) + 40, int(y) + 40), (int(x) + 150, int(y) + 150)])
        browser.wait(f"return {SEQUENCE_OF} !== {json.dumps(before)}")
        # So does a plane that changes.
        browser.run("document.querySelector('input[type=radio][value=\"One that changes\"]').click()")
        label = "document.querySelector('.ev-position').getAttribute('aria-label')"
        browser.wait(f"return {label} === 'Image of the film' && {SEQUENCE_OF}.length")
        browser.wait("return document.querySelector('[aria-label*=\"What changes\"]')?.offsetWidth")
        # An upload is shown; one that is too large is refused.
        asked += browser.requests()
        browser.run(
            "[...document.querySelectorAll('[role=tab]')]"
            ".find(tab => tab.textContent.includes('recording')).click()"
        )
        browser.wait("return [...document.querySelectorAll('input[type=file]')].length")
        browser.give_file("input[type=file]", zipped_capture)
        browser.wait("return document.querySelectorAll('.ev-sheet').length === 2")
        assert not browser.run("return document.body.innerHTML.includes('ev-wrong')")
        (tmp_path / "large.raw").write_bytes(bytes(3_000_000))
        other = "button[aria-label=Clear], button[aria-label='Remove this file']"
        browser.run(f"document.querySelector({json.dumps(other)}).click()")
        browser.wait("return [...document.querySelectorAll('input[type=file]')].length")
        browser.give_file("input[type=file]", tmp_path / "large.raw")
        browser.wait("return document.body.innerText.includes('exceed the maximum allowed size')")
        assert "2 MB" in browser.run("return document.body.innerText")
        time.sleep(0.2)
        asked += browser.requests()
        complaints = [one for one in browser.complaints() if "SEVERE" in one]
        folders = [one for one in tmp_path.iterdir() if one.name.startswith("evnlos-app-")]
        uploads = {one.name for folder in folders for one in folder.rglob("*")}
        assert zipped_capture.name in uploads and "large.raw" not in uploads
    assert len(asked) > 20 and strangers(asked, home) == []
    assert complaints == []
    assert not [one for one in tmp_path.iterdir() if one.name.startswith("evnlos-app-")]


@pytest.mark.parametrize(
    ("path", "root", "changed"),
    [("/", "", True), ("/x/", "/x", True), ("/x", "/x", True), ("/config", "", False)],
)
def test_scripts_come_with_the_page_and_with_nothing_else(path, root, changed) -> None:

    page, sent = b"<body></body>", []

    async def app(scope, receive, send) -> None:
        headers = [(b"content-length", b"%d" % len(page))]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": page})

    async def send(message) -> None:
        sent.append(message)

    *_, scripts = middleware("<script>1</script>", None)
    wrapped = scripts.cls(app, *scripts.args, **scripts.kwargs)
    asyncio.run(wrapped({"type": "http", "path": path, "root_path": root}, None, send))
    body = sent[1]["body"]
    assert (body == b"<body><script>1</script></body>") == changed
    assert dict(sent[0]["headers"])[b"content-length"] == str(len(body)).encode()
