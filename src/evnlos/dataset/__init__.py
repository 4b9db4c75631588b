"""Samples on disk: simulate them, import them from captures, split them, load them."""

from evnlos.dataset.capture import Capture, read_capture
from evnlos.dataset.capture_info import CaptureInfo
from evnlos.dataset.check_picture import check_picture
from evnlos.dataset.fixed_pattern import PATTERN_FILE, FixedPattern, load_pattern, save_pattern
from evnlos.dataset.importer import capture_samples, character_of, import_captures
from evnlos.dataset.live import LiveDataset, live_dataset
from evnlos.dataset.loader import HeldSamples, NlosDataset
from evnlos.dataset.modality import (
    MODALITIES,
    STANDARD_MODALITIES,
    ChannelGroup,
    Modality,
    as_modality,
    modality_order,
)
from evnlos.dataset.sampling import Samples, Sampling, make_samples, reduce_by_area
from evnlos.dataset.shard import ShardIndex, read_shard, read_shard_index, write_shard
from evnlos.dataset.simulate import SensorSize, Simulation, simulate, simulate_object
from evnlos.dataset.store import Dataset, create_dataset, open_dataset

__all__ = [
    "MODALITIES",
    "PATTERN_FILE",
    "STANDARD_MODALITIES",
    "Capture",
    "CaptureInfo",
    "ChannelGroup",
    "Dataset",
    "FixedPattern",
    "HeldSamples",
    "LiveDataset",
    "Modality",
    "NlosDataset",
    "Samples",
    "Sampling",
    "SensorSize",
    "ShardIndex",
    "Simulation",
    "as_modality",
    "capture_samples",
    "character_of",
    "check_picture",
    "create_dataset",
    "import_captures",
    "live_dataset",
    "load_pattern",
    "make_samples",
    "modality_order",
    "open_dataset",
    "read_capture",
    "read_shard",
    "read_shard_index",
    "reduce_by_area",
    "save_pattern",
    "simulate",
    "simulate_object",
    "write_shard",
]
