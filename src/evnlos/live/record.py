"""The pictures of a live run as a video: mp4 where PyAV is installed, else an animated PNG."""

from __future__ import annotations

import queue
import threading
from contextlib import ExitStack, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from evnlos.errors import DataError
from evnlos.files import LOCK, check_folder, claim, is_empty, new_file
from evnlos.live.engine import Picture
from evnlos.live.panels import side_by_side

_WAITING = 64  # pictures that may wait for the encoder
_LEAST_S = 0.039  # between two pictures of the video, 25 a second: the cores are for the network
_MOST_ANIMATED = 3000  # pictures of an animated PNG, which is held in memory until it is written
_LAST_MS = 100  # how long the last picture of an animation stays


class _Encoder(Protocol):
    def add(self, sheet: NDArray[np.uint8], time_ms: int) -> bool: ...

    def finish(self) -> None: ...


class Recorder:
    """A sink that writes a video beside the run, in a thread of its own; a context that ends with the file.

    The video holds at most 25 pictures a second, at the times at which they were made. Where the encoder can't
    follow, pictures are left out and counted.

    Args:
        folder: Where to write `video.mp4`, or `video.png` without PyAV; new or empty.

    Attributes:
        path: The video.
        recorded: Pictures in it.
        left_out: Pictures that should be in it and are not.

    Raises:
        DataError: The folder holds files already, or another process is at work in it.
    """

    def __init__(self, folder: Path) -> None:
        self._held = ExitStack()
        self._held.enter_context(claim(folder, check=lambda: check_folder(folder)))
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
        """Take a picture without waiting."""
        if picture.made_s - self._last_s < _LEAST_S:
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
    """An mp4 file with a time stamp of its own for each picture."""

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
    """An animated PNG, whose pictures are held until the end."""

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
