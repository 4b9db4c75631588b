"""The pictures of a live run as a page of this machine: one file, a stream of server-sent events, no more."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

from evnlos.errors import ConfigError
from evnlos.hosts import names_this_machine
from evnlos.live.engine import Picture
from evnlos.live.panels import panels
from evnlos.report.pictures import data_uri, png

_HOST = "127.0.0.1"
_MOST_VIEWERS = 8
_LEAST_S = 0.033  # between two pictures of a page: faster than eyes follow would cost the network's time
_SILENT_S = 10.0  # in which a request must be whole, and a viewer take what is sent
_BEAT_S = 1.0  # longest time without a message, by which a viewer that left is noticed
_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'"
)


class Page:
    """A sink that shows the newest picture to browsers on this machine; a context that ends with the server.

    A picture is encoded when a viewer asks for it, in the server's threads; a viewer that is slow misses
    pictures and holds nobody up.

    Args:
        status: Returns what is shown beside the picture, as plain values.
        port: Port on 127.0.0.1; 0 takes a free one.
        title: What is shown, for the head of the page.

    Attributes:
        url: Address of the page.
        seen: Set when the first viewer has come.
        viewers: Places for viewers; a request that finds none is answered with 503.

    Raises:
        ConfigError: The port can't be used.
    """

    def __init__(self, status: Callable[[], dict[str, Any]], port: int = 0, title: str = "live") -> None:
        self._status, self._title = status, title
        self._changed = threading.Condition()
        self._picture: Picture | None = None
        self._message: tuple[int, bytes] = (-1, b"")
        self._encoding = threading.Lock()
        self._ended = False
        self.viewers = threading.BoundedSemaphore(_MOST_VIEWERS)
        self.seen = threading.Event()
        try:
            self._server = _Server((_HOST, port), _handler(self))
        except (OSError, OverflowError) as error:
            raise ConfigError(
                f"port {port} can't be used ({error}); give another one, or 0 for a free one"
            ) from None
        self._server.daemon_threads = True
        self._server.block_on_close = False
        self.port: int = self._server.server_address[1]
        self.url = f"http://{_HOST}:{self.port}/"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="page", daemon=True
        )
        self._thread.start()

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def show(self, picture: Picture) -> None:
        """Take a picture without waiting."""
        with self._changed:
            self._picture = picture
            self._changed.notify_all()

    def wait_for_viewer(self, stop: Callable[[], bool]) -> None:
        """Wait until a browser shows the page, or `stop` says not to."""
        while not stop() and not self.seen.wait(0.1):
            pass

    def html(self) -> bytes:
        """Return the page."""
        return files("evnlos.live").joinpath("page.html").read_bytes()

    def state(self) -> dict[str, Any]:
        """Return what is shown beside the picture."""
        return {"title": self._title, "ended": self._ended, **self._status()}

    def stream(self, write: Callable[[bytes], object]) -> None:
        """Write messages until the run ends or the viewer leaves: each picture, or a sign of life."""
        shown, ended, beat_s = -1, False, 0.0  # the first message comes at once
        while not ended:
            began_s = time.monotonic()
            with self._changed:
                self._changed.wait_for(lambda shown=shown: self._ended or self._number() > shown, beat_s)
                picture, ended = self._picture, self._ended
            if picture is not None and picture.number > shown:
                write(b"event: picture\ndata: " + self._encoded(picture) + b"\n\n")
                shown = picture.number
            write(b"event: state\ndata: " + json.dumps(self.state()).encode() + b"\n\n")
            self.seen.set()
            beat_s = _BEAT_S
            time.sleep(max(0.0, _LEAST_S - (time.monotonic() - began_s)))

    def _number(self) -> int:
        return -1 if self._picture is None else self._picture.number

    def _encoded(self, picture: Picture) -> bytes:
        """Return a picture as one line of JSON; encoded once for all viewers."""
        with self._encoding:
            if self._message[0] != picture.number:
                latency = picture.timing.oldest_s
                about = {
                    "number": picture.number,
                    "t_s": round(picture.t_us / 1e6, 4),
                    "latency_ms": round(latency * 1e3, 1) if latency == latency else None,
                    "panels": {name: data_uri(png(panel)) for name, panel in panels(picture).items()},
                }
                self._message = picture.number, json.dumps(about).encode()
            return self._message[1]


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of viewers that left or fell silent."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


def _handler(page: Page) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """Three addresses: the page, its stream, and the state as JSON."""

        timeout = _SILENT_S

        def do_GET(self) -> None:
            """Answer a request of this machine."""
            if not names_this_machine(self.headers.get("Host", "")):
                self.send_error(403)  # a page from elsewhere under a name that leads here
            elif self.path == "/":
                self._send("text/html; charset=utf-8", page.html())
            elif self.path == "/state.json":
                self._send("application/json", json.dumps(page.state()).encode())
            elif self.path == "/stream":
                if not page.viewers.acquire(blocking=False):
                    self.send_error(503, "All places for viewers are taken; close another tab")
                    return
                try:
                    self._head("text/event-stream")
                    page.stream(self._write)
                finally:
                    page.viewers.release()
            else:
                self.send_error(404)

        def _head(self, kind: str, length: int | None = None) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Cache-Control", "no-store")
            self.send_header("Content-Security-Policy", _POLICY)
            self.send_header("X-Content-Type-Options", "nosniff")
            if length is not None:
                self.send_header("Content-Length", str(length))
            self.end_headers()

        def _send(self, kind: str, content: bytes) -> None:
            self._head(kind, len(content))
            self.wfile.write(content)

        def _write(self, content: bytes) -> None:
            self.wfile.write(content)
            self.wfile.flush()

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing: the terminal is for the run."""

    return Handler
