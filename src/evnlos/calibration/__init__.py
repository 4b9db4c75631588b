"""Fitting the simulator to captures of a rig."""

from evnlos.calibration.captures import Shots, read_shots
from evnlos.calibration.event_fit import PixelFit, fit_pixel
from evnlos.calibration.fit import Example, RigFit, fit_rig
from evnlos.calibration.frame_model import FrameModel, Light
from evnlos.calibration.frame_noise import FrameNoise, fit_frame_noise
from evnlos.calibration.residual import Residual
from evnlos.calibration.settings import Calibration
from evnlos.calibration.summary import (
    FIGURES_FILE,
    RIG_FILE,
    figures,
    residual_table,
    rows_of,
    table,
    warnings_of,
    write_rig,
)
from evnlos.calibration.transport_fit import TransportFit, fit_transport

__all__ = [
    "FIGURES_FILE",
    "RIG_FILE",
    "Calibration",
    "Example",
    "FrameModel",
    "FrameNoise",
    "Light",
    "PixelFit",
    "Residual",
    "RigFit",
    "Shots",
    "TransportFit",
    "figures",
    "fit_frame_noise",
    "fit_pixel",
    "fit_rig",
    "fit_transport",
    "read_shots",
    "residual_table",
    "rows_of",
    "table",
    "warnings_of",
    "write_rig",
]
