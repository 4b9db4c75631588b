"""`evnlos weights`: what a weights file is, where it comes from, and a smaller copy to hand on."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from evnlos.config import to_dict
from evnlos.errors import DataError
from evnlos.model import JointNetwork, Weights, load_weights, save_weights


@dataclass(frozen=True)
class Command:
    """Show what weights see, how they were trained and on what; write a copy in half precision to share."""

    weights: Annotated[Path, tyro.conf.Positional]
    """Weights file, or a run's folder."""
    half: Path | None = None
    """File for a copy in half precision, half as large; it must not exist."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Read the weights, print, and write the copy where one is asked for."""
        loaded = load_weights(self.weights)
        if self.half is not None:
            if self.half.exists():
                raise DataError(f"{self.half} exists; give --half another name")
            save_weights(self.half, loaded, torch.float16)
        found = describe(loaded)
        print(json.dumps(found) if self.json else to_text(str(self.weights), found))
        if self.half is not None and not self.json:
            print(f"{self.half}: half precision, {self.half.stat().st_size / 1e6:.1f} MB")


def describe(weights: Weights) -> dict[str, Any]:
    """Return what a user of the weights must know, as plain values."""
    state = weights.network.state_dict().values()
    return {
        "paradigm": weights.paradigm,
        "joint": isinstance(weights.network, JointNetwork),
        "parameters": sum(p.numel() for p in weights.network.parameters()),
        "numbers": sum(value.numel() for value in state),
        "network": to_dict(weights.network.config),
        "sampling": weights.sampling,
        "history": weights.history,
    }


def to_text(name: str, found: dict[str, Any]) -> str:
    """Return the description as lines for people."""
    sees = "a whole pass" if found["joint"] else "one position at a time"
    sampling = found["sampling"]
    lines = [
        f"{name}: {found['paradigm']}, {sees}; {found['parameters']:,} trained parameters, "
        f"{found['numbers'] - found['parameters']:,} numbers in closed form",
        f"  maps {sampling.get('width')} x {sampling.get('height')}, pitch {sampling.get('pitch_m')} m, "
        f"surface {sampling.get('surface')}, tau {sampling.get('tau_s')} s",
    ]
    for number, step in enumerate(found["history"], start=1):
        data, plan = step.get("data", {}), step.get("settings", {})
        lines.append(
            f"  {number}. {data.get('origin')} {data.get('name')}: {len(data.get('train', []))} objects, "
            f"{plan.get('epochs')} epochs at {plan.get('learning_rate')}, seed {plan.get('seed')}"
        )
    return "\n".join(lines)
