"""Setups: wall, geometry, ambient light and cameras in one object, from names, files and measurements."""

from evnlos.setups.base import Layout, OperatorNoise, Parameter, SensorSize, Setup, stated_distance_m
from evnlos.setups.files import CALIBRATED_FILE, TRAINING_FILE, calibrated_file
from evnlos.setups.fitted import FittedSetup
from evnlos.setups.load import (
    ROOMS,
    NamedSetup,
    lit_setup,
    load_setup,
    named_setup,
    setup_names,
    setup_preset,
    stated_target_m,
)
from evnlos.setups.measured import MeasuredSetup
from evnlos.setups.paper import PaperSetup
from evnlos.setups.radiometric import RadiometricSetup
from evnlos.setups.room import RoomSetup

__all__ = [
    "CALIBRATED_FILE",
    "ROOMS",
    "TRAINING_FILE",
    "FittedSetup",
    "Layout",
    "MeasuredSetup",
    "NamedSetup",
    "OperatorNoise",
    "PaperSetup",
    "Parameter",
    "RadiometricSetup",
    "RoomSetup",
    "SensorSize",
    "Setup",
    "calibrated_file",
    "lit_setup",
    "load_setup",
    "named_setup",
    "setup_names",
    "setup_preset",
    "stated_distance_m",
    "stated_target_m",
]
