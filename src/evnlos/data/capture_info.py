"""What `capture.yaml` says about a capture, and the commented one that a new capture folder begins with."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from evnlos.cameras import LogCodes
from evnlos.config import from_dict, read_yaml
from evnlos.errors import ConfigError, DataError
from evnlos.events.files.registry import find_format
from evnlos.events.recording import Recording
from evnlos.files import write_atomically
from evnlos.types import COLOURS, LUMA_601, Colour, Mosaic
from evnlos.untrusted import MOST_SENSOR_PIXELS


@dataclass(frozen=True)
class CameraInfo:
    """The event camera that watched the wall, and the frames beside it."""

    width: int
    """Sensor width, pixels."""
    height: int
    """Sensor height, pixels."""
    name: str = "unknown"
    """Maker and model."""
    frame_rate_hz: float | None = None
    """Frames per second, hertz; the frames' times where they carry none (frame 0 at 0 on the frames' clock)."""
    exposure_s: float | None = None
    """Exposure of a frame, seconds."""
    clock_mhz: int | None = None
    """Clock of a CeleX-V sensor, MHz, where the file's name does not say it."""
    mosaic: Mosaic | None = None
    """Colour filters of the frame camera, whose files are raw: two pixels of the first row, two below."""
    colour: Colour | None = None
    """Colour of the frames and of the target's image that is used; null is all of them, as grey."""
    white_balance: tuple[float, float, float] | None = None
    """Red, green and blue of a white target behind the filters, up to a factor; null is alike."""
    event_mosaic: Mosaic | None = None
    """Colour filters on the pixels of the event camera, as `mosaic`; null where each sees all of the light."""
    white_dn: int | None = None
    """Digital number of white in files of 16 bits (frames, dark, flat), 4095 for 12 bits; null is 65535."""
    log: LogCodes | None = None
    """Codes of frames of logarithmic pixels (CeleX-V, mode F); null where their numbers grow as the light."""
    tone: Literal["srgb", "rec709"] | None = None
    """Tone curve of frames, dark and flat (phone, webcam); null where their numbers grow as the light."""

    def __post_init__(self) -> None:
        sides = f"camera is {self.width} x {self.height} pixels"
        if not (1 <= self.width <= 65_536 and 1 <= self.height <= 65_536):
            raise ConfigError(f"{sides}; give sides of 1 to 65536")
        if self.width * self.height > MOST_SENSOR_PIXELS:
            raise ConfigError(f"{sides}; at most {MOST_SENSOR_PIXELS:,} are read")
        if self.white_balance is not None and not all(0 < one < math.inf for one in self.white_balance):
            raise ConfigError(f"camera.white_balance is {self.white_balance}; give three numbers above 0")
        if self.white_dn is not None and not 256 <= self.white_dn <= 65_535:
            raise ConfigError(f"camera.white_dn is {self.white_dn}; give 256 to 65535, of frames of 16 bits")
        if self.tone and (raw := self.mosaic or self.log or self.white_dn):
            raise ConfigError(f"camera.tone is {self.tone}, and what is raw ({raw}) has no tone; leave one out")

    @property
    def balance(self) -> float:
        """What a white target has in the frames as they are used, over what it has as grey (Rec. 601)."""
        return 1.0 if self.colour is None else balances(self.white_balance)[COLOURS.index(self.colour)]


def balances(white: tuple[float, float, float] | None) -> list[float]:
    """Return red, green and blue of a white target over its grey, from those up to a factor; None is alike."""
    white = white or (1.0, 1.0, 1.0)
    return [one * sum(LUMA_601) / sum(map(math.prod, zip(LUMA_601, white, strict=True))) for one in white]


@dataclass(frozen=True)
class TargetInfo:
    """The hidden target, where it is known."""

    name: str
    """What it shows, e.g. a letter."""
    mask: str | None = None
    """Image of the target, a file in the folder; white shines."""
    size_m: float = 0.08
    """Side of the target plane, metres."""


@dataclass(frozen=True)
class MotionInfo:
    """A straight, steady motion: the target's centre is at start_m + speed (t - start_us) along `direction`."""

    start_m: float | tuple[float, float]
    """Centre at `start_us` relative to the middle of the travel: along the direction, or (x, y), metres."""
    speed_m_s: float
    """Speed, metres per second."""
    direction: tuple[float, float] = (1.0, 0.0)
    """Direction (x to the right, y downwards)."""
    start_us: int = 0
    """Instant of the start on the events' clock, microseconds: it ties the truth to the capture."""
    retreat_m_s: float = 0.0
    """Speed away from the wall, metres per second; at the start it is `setup.distance_m` away."""
    spin_deg_s: float = 0.0
    """Turn in its plane from upright at the start, clockwise, degrees per second."""


@dataclass(frozen=True)
class OtherInfo(TargetInfo):
    """Another target that was there at the same time, with its motion."""

    motion: MotionInfo | None = None
    """Its motion, where it is known."""


@dataclass(frozen=True)
class AlignmentInfo:
    """How the frames' clock becomes the events': event time = frame time + offset."""

    offset_us: int | Literal["auto"] = 0
    """Offset, microseconds, or auto: found from what both saw change at once (a blink, a jerk)."""
    search_s: float = 1.0
    """Largest offset that auto looks at, seconds."""
    blocks: int = 8
    """Blocks of pixels along the longer side that auto compares; 1 for cameras that see different things."""
    trigger_channel: int | None = None
    """Input of the event camera that frame exposures are wired to: frame k is at its k-th rising edge."""

    def __post_init__(self) -> None:
        if not 0 < self.search_s <= 60:
            raise ConfigError(f"alignment.search_s is {self.search_s}; give more than 0 and at most 60 s")
        if self.trigger_channel is not None and self.offset_us == "auto":
            raise ConfigError("alignment has a trigger_channel and offset_us: auto; give one of them")


@dataclass(frozen=True)
class DotsInfo:
    """A grid of dots that both cameras saw: bright in a frame, blinking for the events."""

    rows: int
    """Rows of dots."""
    columns: int
    """Dots per row."""
    frame: str
    """Image of the grid by the frame camera, a file in the folder."""
    events: str
    """Recording of the blinking grid by the event camera, a file in the folder."""


@dataclass(frozen=True)
class RegistrationInfo:
    """How frame pixels become event pixels; one of the three."""

    homography: tuple[tuple[float, float, float], ...] | None = None
    """Three rows of three numbers that map frame (x, y, 1) to event (x, y, 1), pixels."""
    points: tuple[tuple[float, float, float, float], ...] | None = None
    """At least four of (frame x, frame y, event x, event y), pixels."""
    dots: DotsInfo | None = None
    """A calibration capture of a grid of dots."""

    def __post_init__(self) -> None:
        given = [name for name in ("homography", "points", "dots") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ConfigError(f"registration: {' and '.join(given) or 'none'}; give homography, points or dots")


@dataclass(frozen=True)
class RegionInfo:
    """The part of the event camera's sensor that is used."""

    x: int
    """First column, pixels."""
    y: int
    """First row, pixels."""
    width: int
    """Columns, pixels."""
    height: int
    """Rows, pixels."""


@dataclass(frozen=True)
class FilterInfo:
    """Events that are left out."""

    hot_pixel_factor: float | None = None
    """A pixel with that many times the median of its surroundings is hot, e.g. 10; none = keep all."""
    flicker_hz: float | None = None
    """Frequency of flickering light, hertz: twice that of the mains; none = keep its events."""
    background_us: int | None = None
    """Events without 2 of that polarity from 4 pixels beside so near are noise, microseconds; none = keep."""


@dataclass(frozen=True)
class RecordingInfo:
    """How `evnlos capture record` made the recording; what the driver does not say is left out."""

    source: str
    """Camera or stream that was recorded."""
    begun: str
    """Start by the computer's clock, UTC, ISO 8601."""
    seconds: float
    """Length of the recording by the computer's clock, seconds."""
    events: int
    """Events."""
    frames: int
    """Frames."""
    clock: str
    """Clock of the event times."""
    ended_by: str | None = None
    """What ended it early."""
    serial: str | None = None
    """Serial number of the camera."""
    biases: dict[str, int] | None = None
    """Bias settings of the camera, by the driver's names and in its units."""
    temperature_c: tuple[float, float] | None = None
    """Temperature of the sensor or its board at the beginning and at the end, degrees Celsius."""
    light: tuple[float, float] | None = None
    """What the sensor's light meter read at the beginning and at the end, without a unit."""
    faults: dict[str, int] = field(default_factory=dict)
    """What the source lost or left out, by name."""


@dataclass(frozen=True)
class CaptureInfo:
    """What `capture.yaml` holds."""

    camera: CameraInfo
    """The camera."""
    events: str | None = "events.raw"
    """The event file, as the camera wrote it; null for a frame camera alone."""
    frames: str | None = "frames.csv"
    """Frames: a table t_us,file; a video; a folder of images; an AEDAT file or ROS bag, also that of `events`;
    a CeleX-V recording of mode F; null without any: time steps are then at `camera.frame_rate_hz` (30 Hz)."""
    events_topic: str | None = None
    """Stream of the event file, where it holds several (topics of a ROS bag); `evnlos info` lists them."""
    frames_topic: str | None = None
    """Stream of the frames, where their file holds several."""
    frames_turned: bool = False
    """Whether the frames are turned by 180 degrees against the events, as the CeleX-V program exports them."""
    target: TargetInfo | None = None
    """The target, where it is known."""
    motion: MotionInfo | None = None
    """Its motion, where it is known."""
    others: tuple[OtherInfo, ...] = ()
    """Other targets that were there too, where they are known."""
    cover: bool = False
    """Whether a later target hides those before it where it shines; else their light adds."""
    alignment: AlignmentInfo = field(default_factory=AlignmentInfo)
    """Clock of the frames."""
    registration: RegistrationInfo | None = None
    """Pixels of the frames; without it they are those of the events."""
    dark: str | None = None
    """Frame with the lens covered, a file in the folder, of the frame camera's size."""
    flat: str | None = None
    """Frame of an evenly lit surface, a file in the folder, of the frame camera's size."""
    roi: RegionInfo | None = None
    """Part of the event camera's sensor to use, after registration; none = all."""
    every: int | None = None
    """Each such row and column is used, of frames the mean; by default all of up to 300,000 pixels."""
    filters: FilterInfo = field(default_factory=FilterInfo)
    """Events to leave out."""
    setup: dict[str, Any] = field(default_factory=dict)
    """Notes about the setup: distance_m, wall, ambient."""
    recording: RecordingInfo | None = None
    """How it was recorded, where `evnlos capture record` did."""

    def __post_init__(self) -> None:
        if self.events is None and self.frames is None:
            raise ConfigError("events and frames are null; state one of them")
        if self.every is not None and not 1 <= self.every <= 16:
            raise ConfigError(f"every is {self.every}; give 1 (all rows and columns) to 16")
        if self.events is None and (self.camera.event_mosaic or self.alignment != AlignmentInfo()):
            raise ConfigError("events is null; leave out what is about them: alignment, camera.event_mosaic")
        linear = {f"camera.{name}": getattr(self.camera, name) for name in ("mosaic", "colour", "white_dn")}
        for name, value in (linear | {"dark": self.dark}).items() if self.camera.log is not None else ():
            if value is not None:
                raise ConfigError(f"{name} is {value}, and camera.log is of grey codes; leave one of them out")
        z_m = self.setup.get("distance_m")
        if z_m is not None and (type(z_m) not in (int, float) or not 0 < z_m < math.inf):
            raise ConfigError(f"setup.distance_m is {z_m!r}; give a finite number of metres above 0, or null")

    def check_cameras(self, name: str | Path, *, frames: bool, events: bool) -> None:
        """Raise `DataError` where a capture has no frames, or no events, and they are needed."""
        for is_needed, key, other in ((frames, "frames", "events"), (events, "events", "frames")):
            if is_needed and getattr(self, key) is None:
                raise DataError(f"{name} holds {other} alone ({key}: null in capture.yaml); this needs {key}")

    def in_colour(self, colour: Colour | None) -> CaptureInfo:
        """Return the same capture with one colour of its frames in use; None leaves it as it is described."""
        return self if colour is None else replace(self, camera=replace(self.camera, colour=colour))

    @property
    def target_size_m(self) -> float:
        """Side of the target plane, metres: the given one, or the usual one where none is."""
        return TargetInfo.size_m if self.target is None else self.target.size_m


def read_capture_info(
    folder: Path, *, events_topic: str | None = None, frames_topic: str | None = None
) -> CaptureInfo:
    """Read the `capture.yaml` of a folder, or describe one file that holds events and frames.

    Args:
        folder: The folder; or a recording of a camera with both kinds of pixels (ROS bag, AEDAT).
        events_topic: Stream of the events of a file that holds several.
        frames_topic: Stream of its frames.

    Raises:
        ConfigError: The description is missing, or has an unknown key or a wrong type.
        EventFileError: The file is damaged or holds no events.
    """
    if folder.is_file():
        return _info_of_recording(folder, events_topic, frames_topic)
    if not (path := folder / "capture.yaml").is_file():
        held = f" (it holds {n}: {folder}/*)" if (n := len([*folder.glob("*/capture.yaml")])) else ""
        raise ConfigError(f"{folder} holds no capture.yaml; give the folder of one capture{held}")
    others = (values := read_yaml(path)).get("others")
    for one in (values.get("target"), *(others if isinstance(others, list) else ())):  # digits are characters
        if isinstance(one, dict) and type(one.get("name")) is int:
            one["name"] = str(one["name"])
    try:
        return from_dict(CaptureInfo, values, source=str(path))
    except ConfigError as error:  # what is wrong in itself, such as both cameras null, names no file
        raise ConfigError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None


def _info_of_recording(path: Path, events_topic: str | None, frames_topic: str | None) -> CaptureInfo:
    """Describe a recording that holds events and frames of the same pixels and on the same clock."""
    has_frames = path.suffix != ".yaml" and find_format(path, wanted="a capture's folder or a recording").frames
    if not has_frames and (path.parent / "capture.yaml").is_file():
        raise ConfigError(f"{path} is one file of a capture; give its folder, {path.parent}")
    recording = Recording(path, topic=events_topic)
    if not recording.report.geometry_from:  # of some formats known with their first events
        next(recording.pieces(), None)
    camera = CameraInfo(*recording.shape[::-1], name=recording.report.format)
    return CaptureInfo(camera, path.name, path.name, events_topic=events_topic, frames_topic=frames_topic)


CAMERAS = {
    "davis346": ("iniVation DAVIS346", 346, 260, "events.aedat4", "events.aedat4"),
    "davis240": ("iniVation DAVIS240", 240, 180, "events.aedat", "frames"),
    "dvxplorer": ("iniVation DVXplorer", 640, 480, "events.aedat4", "frames"),
    "dvs128": ("iniVation DVS128", 128, 128, "events.aedat", "frames"),
    "evk4": ("Prophesee EVK4 (IMX636)", 1280, 720, "events.raw", "frames"),
    "evk3-hd": ("Prophesee EVK3 HD (IMX636)", 1280, 720, "events.raw", "frames"),
    "gen3-vga": ("Prophesee Gen3 VGA", 640, 480, "events.raw", "frames"),
    "centuryarks-vga": ("CenturyArks SilkyEvCam VGA", 640, 480, "events.raw", "frames"),
    "triton": ("Lucid Triton2 EVS (IMX636)", 1280, 720, "events.raw", "frames"),
    "celex-v": ("CelePixel CeleX-V", 1280, 800, "events.bin", "frames"),
}
"""Cameras by name: maker and model, columns and rows of the sensor, the usual names of events and frames."""


def begin_capture(folder: str | Path, width: int, height: int, name: str = "my camera", *files: str) -> Path:
    """Write a commented `capture.yaml` into a new or empty folder and return its path.

    Args:
        folder: The folder of the capture.
        width: Columns of the event camera's sensor, pixels.
        height: Rows, pixels.
        name: Maker and model; the frames of a CeleX-V are logarithmic.
        files: File of the events, and file or folder of the frames; by default events.raw and frames.

    Raises:
        DataError: The folder has a capture.yaml already, or is a file; or the size is none.
    """
    path = (folder := Path(folder)) / "capture.yaml"
    if wrong := next((one for one in (folder, *folder.parents) if one.exists() and not one.is_dir()), None):
        raise DataError(f"{wrong} is a file; give a folder for the capture")
    if path.exists():
        raise DataError(f"{path} exists; edit it, or give another folder")
    if width < 1 or height < 1:
        raise DataError(f"the sensor is {width} x {height} pixels; give its width and height")
    words = {"width": width, "height": height, "linear": "" if name == CAMERAS["celex-v"][0] else "# "}
    words["events"], words["frames"] = files or ("events.raw", "frames")
    template = Path(__file__).with_name("capture_template.yaml").read_text(encoding="utf-8")
    write_atomically(path, template.format(**words, name=" ".join(name.replace(":", " ").split())).encode())
    return path


def inside(folder: Path, name: str, by: str = "capture.yaml") -> Path:
    """Return the path of a file or folder of the capture; a name never leads out of its folder.

    Args:
        folder: The capture's or scan's folder.
        name: Path of the file below it.
        by: File of that folder that names it, for the message.

    Raises:
        DataError: It is no name, lies outside the folder, or does not exist.
    """
    try:
        there = (path := (folder / name).resolve()).exists()
    except (OSError, ValueError) as error:
        raise DataError(f"{folder}: {name[:80]!r} is no name of a file ({error})") from None
    if not path.is_relative_to(folder.resolve()):
        raise DataError(f"{folder}: {name!r} lies outside the capture folder; put the file into it")
    if not there:
        how = f"{folder / by} names it, or leaves its name to the default; null where there is no such thing"
        meant = f"{folder / by} takes {name} for the name of a file; write null where there is no such thing"
        raise DataError(meant if name.lower() == "none" else f"{path} does not exist; {how}")
    return path
