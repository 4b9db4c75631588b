"""What a camera makes of the light on the wall: frames and events."""

from evnlos.cameras.event_camera import EventCamera, EventStream, simulate_events
from evnlos.cameras.event_model import EVENT_MODELS, CrossingLaw, EventModel, PixelMaps, PixelSettings
from evnlos.cameras.frame_camera import (
    FrameCamera,
    FrameCameraSettings,
    LogFrameCamera,
    colour_filters,
    mosaicked,
    of_mosaic,
)
from evnlos.cameras.pixel import EventPixel, LogCodes, V2ePixel
from evnlos.cameras.pixels.arrays import PIXEL_MAPS_FILE, load_pixel_maps
from evnlos.cameras.pixels.brownian import BrownianPixel
from evnlos.cameras.pixels.circuit import CircuitPixel
from evnlos.cameras.pixels.readout import FlickeringWall, ReadoutPixel
from evnlos.cameras.sensors import CelexCamera, CelexPixel, load_pixel, pixel_preset

__all__ = [
    "EVENT_MODELS",
    "PIXEL_MAPS_FILE",
    "BrownianPixel",
    "CelexCamera",
    "CelexPixel",
    "CircuitPixel",
    "CrossingLaw",
    "EventCamera",
    "EventModel",
    "EventPixel",
    "EventStream",
    "FlickeringWall",
    "FrameCamera",
    "FrameCameraSettings",
    "LogCodes",
    "LogFrameCamera",
    "PixelMaps",
    "PixelSettings",
    "ReadoutPixel",
    "V2ePixel",
    "colour_filters",
    "load_pixel",
    "load_pixel_maps",
    "mosaicked",
    "of_mosaic",
    "pixel_preset",
    "simulate_events",
]
