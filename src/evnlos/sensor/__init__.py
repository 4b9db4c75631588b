"""What a camera makes of the light on the wall: frames and events."""

from evnlos.sensor.event_camera import EventCamera
from evnlos.sensor.frame_camera import FrameCamera
from evnlos.sensor.pixel import EventPixel
from evnlos.sensor.presets import pixel_preset
from evnlos.sensor.simulate import simulate_batch, simulate_events
from evnlos.sensor.stream import EventStream

__all__ = [
    "EventCamera",
    "EventPixel",
    "EventStream",
    "FrameCamera",
    "pixel_preset",
    "simulate_batch",
    "simulate_events",
]
