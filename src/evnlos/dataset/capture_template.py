"""The commented `capture.yaml` that a new capture folder begins with."""

from __future__ import annotations

from pathlib import Path

from evnlos.errors import DataError
from evnlos.files import write_atomically

_TEMPLATE = """\
# One shot: a hidden target moves past, an event camera and a frame camera watch the wall.
# Lines that begin with # are notes, or settings that you may need; `evnlos capture check FOLDER` reads what you
# recorded and says what is wrong with it.

camera:
  name: {name}
  width: {width}             # pixels of the event camera's sensor
  height: {height}
  frame_rate_hz: 30.0        # of the frames, where their file carries no times
  # exposure_s: 0.01         # of a frame; the calibration blurs by it
  # clock_mhz: 100           # CeleX-V only, where the file's name does not say it

events: events.raw           # as the camera wrote it; the format is found from its content
frames: frames               # a folder of pictures, a video, a table t_us,file, or an AEDAT4 file
# frames_turned: true        # pictures that the CeleX-V program exported are turned by 180 degrees

# Clocks. Leave out where both files share one; otherwise one of:
# alignment: {{offset_us: 41000}}         # event time = frame time + offset
# alignment: {{trigger_channel: 0}}       # the frame camera's exposure is wired to the event camera
# alignment: {{offset_us: auto}}          # blink the light a few times, irregularly, at the start

# Pixels. Leave out where frames and events share a sensor; otherwise four points or more that both saw:
# registration: {{points: [[102, 80, 40, 33], [1180, 95, 601, 38], [1160, 690, 592, 440], [110, 702, 44, 446]]}}

# dark: dark.png             # a frame with the lens covered
# flat: flat.png             # a frame of an evenly lit surface
# roi: {{x: 0, y: 0, width: {width}, height: {height}}}
# filters: {{hot_pixel_factor: 10, background_us: 20000}}

# What was hidden: leave out when unknown. The mask is a picture of the plate, white shines.
# target: {{name: R, mask: target.png, plate_m: 0.08}}
# How it moved: the centre is at start_m + speed_m_s (t - start_us), relative to the middle of the travel.
# motion: {{start_m: -0.08, speed_m_s: 0.02, direction: [1, 0], start_us: 0}}

# Your notes about the rig; the calibration takes distance_m (target's plane to wall) as measured.
# rig: {{distance_m: 0.30, wall: rough aluminium, ambient: dark room}}
"""


def begin_capture(folder: str | Path, width: int, height: int, name: str = "my camera") -> Path:
    """Write a commented `capture.yaml` into a new or empty folder and return its path.

    Args:
        folder: The folder of the shot.
        width: Columns of the event camera's sensor, pixels.
        height: Rows, pixels.
        name: Maker and model.

    Raises:
        DataError: The folder has a capture.yaml already, or is a file; or the size is none.
    """
    folder = Path(folder)
    path = folder / "capture.yaml"
    if folder.exists() and not folder.is_dir():
        raise DataError(f"{folder} is a file; give a folder for the shot")
    if path.exists():
        raise DataError(f"{path} exists; edit it, or give another folder")
    if width < 1 or height < 1:
        raise DataError(f"the sensor is {width} x {height} pixels; give its width and height")
    folder.mkdir(parents=True, exist_ok=True)
    text = _TEMPLATE.format(name=name.replace("\n", " ").replace(":", " "), width=width, height=height)
    write_atomically(path, text.encode())
    return path
