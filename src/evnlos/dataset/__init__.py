"""Samples on disk: simulate them, import them from captures, split them, load them."""

from evnlos.dataset.capture import Capture, read_capture
from evnlos.dataset.capture_info import CaptureInfo
from evnlos.dataset.check_picture import check_picture
from evnlos.dataset.fixed_pattern import PATTERN_FILE, FixedPattern, load_pattern, save_pattern
from evnlos.dataset.importer import capture_samples, character_of, import_captures
from evnlos.dataset.live import LiveDataset, live_dataset
from evnlos.dataset.loader import CHANNELS, PARADIGMS, HeldSamples, NlosDataset, Paradigm, network_input
from evnlos.dataset.sampling import Samples, Sampling, make_samples, reduce_by_area
from evnlos.dataset.shard import read_shard, write_shard
from evnlos.dataset.simulate import SensorSize, Simulation, simulate, simulate_object
from evnlos.dataset.store import Dataset, create_dataset, open_dataset

__all__ = [
    "CHANNELS",
    "PARADIGMS",
    "PATTERN_FILE",
    "Capture",
    "CaptureInfo",
    "Dataset",
    "FixedPattern",
    "HeldSamples",
    "LiveDataset",
    "NlosDataset",
    "Paradigm",
    "Samples",
    "Sampling",
    "SensorSize",
    "Simulation",
    "capture_samples",
    "character_of",
    "check_picture",
    "create_dataset",
    "import_captures",
    "live_dataset",
    "load_pattern",
    "make_samples",
    "network_input",
    "open_dataset",
    "read_capture",
    "read_shard",
    "reduce_by_area",
    "save_pattern",
    "simulate",
    "simulate_object",
    "write_shard",
]
