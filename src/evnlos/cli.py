"""The commands, one thin class a verb: flags and help come from the same dataclasses as the YAML files."""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro
from tqdm import tqdm

from evnlos.config import load_yaml
from evnlos.dataset import Sampling, Simulation
from evnlos.errors import ConfigError, EvnlosError
from evnlos.training import Training, paper_finetuning, paper_pretraining

Flat = tyro.conf.OmitArgPrefixes
Captures = Annotated[tuple[Path, ...], tyro.conf.Positional]
