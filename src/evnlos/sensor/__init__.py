"""What a camera makes of the light on the wall: frames and events."""

from evnlos.sensor.brownian import BrownianPixel
from evnlos.sensor.celex import CelexCamera
from evnlos.sensor.circuit import CircuitPixel
from evnlos.sensor.event_camera import EventCamera
from evnlos.sensor.event_model import EVENT_MODELS, EventModel, PixelSettings
from evnlos.sensor.frame_camera import FrameCamera
from evnlos.sensor.pixel import EventPixel, V2ePixel
from evnlos.sensor.presets import pixel_preset
from evnlos.sensor.readout import FlickeringWall, ReadoutPixel
from evnlos.sensor.simulate import simulate_batch, simulate_events
from evnlos.sensor.stream import EventStream

__all__ = [
    "EVENT_MODELS",
    "BrownianPixel",
    "CelexCamera",
    "CircuitPixel",
    "EventCamera",
    "EventModel",
    "EventPixel",
    "EventStream",
    "FlickeringWall",
    "FrameCamera",
    "PixelSettings",
    "ReadoutPixel",
    "V2ePixel",
    "pixel_preset",
    "simulate_batch",
    "simulate_events",
]
