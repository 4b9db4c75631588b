"""The images of a live run: as a page of this machine, and as a video.

- An image and what it was made of, side by side.
- The images of a live run as a page of this machine: one file, a stream of server-sent events, no more.
- The images of a live run as a video: mp4 where PyAV is installed, else an animated PNG.
"""

from __future__ import annotations

import json
import queue
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from fractions import Fraction
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from evnlos.errors import ConfigError, DataError
from evnlos.files import LOCK, check_folder, directory_lock, is_empty, new_file
from evnlos.live.run import Picture
from evnlos.report.pictures import data_uri, grey, png, polarity, stretched
from evnlos.untrusted import names_this_machine

_HEIGHT_PX, _GAP_PX = 256, 8


def panels(picture: Picture) -> dict[str, NDArray[np.uint8]]:
    """Return what there is to see, by name, in the order of the light path: uint8 [H, W] or [H, W, 3]."""
    shown = {"wall": stretched(picture.frame)} if picture.frame is not None else {}
    shown["events"] = polarity(picture.surface)
    shown |= {} if picture.image is None else {"reconstruction": grey(picture.image)}
    return shown | ({picture.beside.title: grey(picture.beside.image)} if picture.beside else {})


def side_by_side(picture: Picture) -> NDArray[np.uint8]:
    """Return the panels as one colour image [H, W, 3] of even sides, each magnified to about 256 rows."""
    shown = panels(picture).values()
    row = [one if one.ndim == 3 else np.repeat(one[..., None], 3, axis=-1) for one in shown]
    row = [one.repeat(k := max(1, round(_HEIGHT_PX / len(one))), axis=0).repeat(k, axis=1) for one in row]
    rows = max(len(one) + len(one) % 2 for one in row)
    row = [np.pad(one, ((0, rows - len(one)), (0, _GAP_PX), (0, 0)), constant_values=128) for one in row]
    sheet = np.concatenate(row, axis=1)[:, :-_GAP_PX]
    return np.pad(sheet, ((0, 0), (0, sheet.shape[1] % 2), (0, 0)), mode="edge")  # video codecs take even sides


_HOST = "127.0.0.1"
_MOST_VIEWERS = 8
_LEAST_S = 0.033  # between two images of a page: faster than eyes follow would cost the network's time
_SILENT_S = 10.0  # in which a request must be whole, and a viewer take what is sent
_BEAT_S = 1.0  # longest time without a message, by which a viewer that left is noticed
_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'"
)


class Page:
    """A sink that shows the newest image to browsers on this machine; a context that ends with the server.

    An image is encoded when a viewer asks for it, in the server's threads; a viewer that is slow misses
    images and holds nobody up.

    Args:
        status: Returns what is shown beside the image, as plain values.
        port: Port on 127.0.0.1; 0 takes a free one.
        title: What is shown, for the head of the page.
        again: Set when a viewer wishes the replay to begin again; None where that can't be.

    Attributes:
        url: Address of the page.
        seen: Set when the first viewer has come.
        viewers: Places for viewers; a request that finds none is answered with 503.

    Raises:
        ConfigError: The port can't be used.
    """

    def __init__(
        self,
        status: Callable[[], dict[str, Any]],
        port: int = 0,
        title: str = "live",
        again: threading.Event | None = None,
    ) -> None:
        self._status, self._title, self.again = status, title, again
        self._changed, self._encoding, self._ended = threading.Condition(), threading.Lock(), False
        self._picture: Picture | None = None
        self._message: tuple[int, bytes] = (-1, b"")
        self.viewers = threading.BoundedSemaphore(_MOST_VIEWERS)
        self.seen = threading.Event()
        try:
            self._server = _Server((_HOST, port), _handler(self))
        except (OSError, OverflowError) as error:
            raise ConfigError(f"port {port} can't be used ({error}); give another, or 0 for any") from None
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
        """Take an image without waiting."""
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
        """Return what is shown beside the image."""
        return {"title": self._title, "ended": self._ended, "again": self.again is not None, **self._status()}

    def stream(self, write: Callable[[bytes], object]) -> None:
        """Write messages until the run ends or the viewer leaves: each image, or a sign of life."""
        shown, ended, beat_s = -1, False, 0.0  # the first message comes at once
        while not ended:
            began_s = time.monotonic()
            with self._changed:
                self._changed.wait_for(lambda shown=shown: self._ended or self._number() > shown, beat_s)
                picture, ended = self._picture, self._ended
            if picture is not None and picture.number > shown:
                write(b"event: image\ndata: " + self._encoded(picture) + b"\n\n")
                shown = picture.number
            write(b"event: state\ndata: " + json.dumps(self.state()).encode() + b"\n\n")
            self.seen.set()
            beat_s = _BEAT_S
            time.sleep(max(0.0, _LEAST_S - (time.monotonic() - began_s)))

    def _number(self) -> int:
        return -1 if self._picture is None else self._picture.number

    def _encoded(self, picture: Picture) -> bytes:
        """Return an image as one line of JSON; encoded once for all viewers."""
        with self._encoding:
            if self._message[0] != picture.number:
                latency, age_s = picture.timing.oldest_s, picture.beside_age_s
                about = {
                    "number": picture.number,
                    "t_s": round(picture.t_us / 1e6, 4),
                    "latency_ms": round(latency * 1e3, 1) if latency == latency else None,
                    "beside_age_s": None if age_s is None else round(age_s, 2),
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
        """The page, its stream, the state as JSON, and the wish for a new beginning."""

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

        def do_POST(self) -> None:
            """Begin the replay again, for a page of this machine."""
            host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
            if not names_this_machine(host) or origin not in (None, f"http://{host}"):
                self.send_error(403)
            elif self.path != "/again" or page.again is None:
                self.send_error(404)
            else:
                page.again.set()
                self._send("text/plain", b"")

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


_WAITING = 64  # images that may wait for the encoder
_RECORD_LEAST_S = 0.039  # between two images of the video, 25 a second: the cores are for the network
_MOST_ANIMATED = 3000  # images of an animated PNG, which is held in memory until it is written
_LAST_MS = 100  # how long the last image of an animation stays


class _Encoder(Protocol):
    def add(self, sheet: NDArray[np.uint8], time_ms: int) -> bool: ...

    def finish(self) -> None: ...


class Recorder:
    """A sink that writes a video beside the run, in a thread of its own; a context that ends with the file.

    The video holds at most 25 images per second, at the times at which they were made. Where the encoder
    can't follow, images are left out and counted.

    Args:
        folder: Where to write `video.mp4`, or `video.png` without PyAV; new or empty.

    Attributes:
        path: The video.
        recorded: Images in it.
        left_out: Images that should be in it and are not.

    Raises:
        DataError: The folder holds files already, or another process is at work in it.
    """

    def __init__(self, folder: Path) -> None:
        self._held = ExitStack()
        self._held.enter_context(directory_lock(folder, check=lambda: check_folder(folder)))
        av = _pyav()
        self.path = folder / ("video.png" if av is None else "video.mp4")
        self.recorded = self.left_out = 0
        self._encoder: _Encoder = _Animation(self.path) if av is None else _Movie(self.path, av)
        self._pictures: queue.Queue[Picture | None] = queue.Queue(_WAITING)
        self._first_s: float | None = None
        self._last_s = float("-inf")
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._encode, name="recorder", daemon=True)
        self._thread.start()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self._pictures.put(None)
        self._thread.join()
        folder = self.path.parent
        with suppress(OSError):
            if is_empty(folder):  # nothing is left where nothing was recorded
                (folder / LOCK).unlink()
                folder.rmdir()
        self._held.close()
        if self._error is not None:
            raise DataError(f"{self.path}: the video could not be written ({self._error}); check the disk")

    def show(self, picture: Picture) -> None:
        """Take an image without waiting."""
        if picture.made_s - self._last_s < _RECORD_LEAST_S:
            return
        self._last_s = picture.made_s
        try:
            self._pictures.put_nowait(picture)
        except queue.Full:
            self.left_out += 1

    def _encode(self) -> None:
        while (picture := self._pictures.get()) is not None:
            if self._error is not None:
                self.left_out += 1
                continue
            self._first_s = picture.made_s if self._first_s is None else self._first_s
            try:
                added = self._encoder.add(side_by_side(picture), round((picture.made_s - self._first_s) * 1e3))
                self.recorded += added
                self.left_out += not added
            except Exception as error:  # of codec or disk; told when the run ends
                self._error = error
        try:
            self._encoder.finish()
        except Exception as error:
            self._error = self._error or error


def _pyav() -> Any:
    try:
        import av
    except ImportError:
        return None
    return av


class _Movie:
    """An mp4 file with a time stamp of its own for each image."""

    def __init__(self, path: Path, av: Any) -> None:
        self._av, self._file = av, new_file(path)
        self._container: Any = None
        self._stream: Any = None
        self._last_ms = -1

    def add(self, sheet: NDArray[np.uint8], time_ms: int) -> bool:
        if self._container is None:
            self._begin(self._file.__enter__(), sheet.shape[1], sheet.shape[0])
        self._last_ms = max(time_ms, self._last_ms + 1)
        frame = self._av.VideoFrame.from_ndarray(sheet, format="rgb24")
        frame.pts, frame.time_base = self._last_ms, Fraction(1, 1000)
        self._container.mux(self._stream.encode(frame))  # pyright: ignore[reportOptionalMemberAccess]
        return True

    def _begin(self, temporary: Path, width: int, height: int) -> None:
        has_h264 = "libx264" in self._av.codecs_available
        self._container = self._av.open(str(temporary), "w", format="mp4")
        options = {"preset": "ultrafast", "tune": "zerolatency", "crf": "18"} if has_h264 else {}
        stream = self._container.add_stream("libx264" if has_h264 else "mpeg4", rate=1000, options=options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        stream.codec_context.thread_count = 1  # the other cores are the network's
        self._stream = stream

    def finish(self) -> None:
        if self._container is None:
            return
        with ExitStack() as leaving:
            leaving.push(self._file)  # at the end: the file gets its name, or goes
            leaving.callback(self._container.close)
            self._container.mux(self._stream.encode())


class _Animation:
    """An animated PNG, whose images are held until the end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._images: list[Image.Image] = []
        self._times_ms: list[int] = []

    def add(self, sheet: NDArray[np.uint8], time_ms: int) -> bool:
        if len(self._images) >= _MOST_ANIMATED:
            return False
        palette = Image.fromarray(sheet).quantize(256)  # a third of the memory
        self._images.append(palette)
        self._times_ms.append(time_ms)
        return True

    def finish(self) -> None:
        if not self._images:
            return
        pauses = [max(int(p), 1) for p in np.diff([*self._times_ms, self._times_ms[-1] + _LAST_MS])]
        first, *others = self._images
        with new_file(self._path) as temporary:
            first.save(temporary, "PNG", save_all=True, append_images=others, duration=pauses, loop=0)
