"""`evnlos weights`: what a weights file is, where it comes from, and a smaller copy to hand on."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from evnlos.errors import ConfigError, DataError, printable
from evnlos.model import Weights, describe_network, load_weights, published, save_weights, with_rank

_MOST_NAMED = 8  # of more objects, the worst and the best are named


@dataclass(frozen=True)
class WeightsCommand:
    """Show what weights see, how they were trained and on what, or list those that come with the package."""

    weights: Annotated[Path | None, tyro.conf.Positional] = None
    """Weights file, run's folder, or name of published weights; none lists the published ones."""
    half: Path | None = None
    """File for a copy in half precision, half as large; it must not exist."""
    rank: int | None = None
    """Components of the linear embedding that the copy keeps, the strongest; none keeps all."""
    scores: Path | None = None
    """What `evnlos evaluate --json` printed of these weights, to be kept in the copy."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Read the weights, print, and write the copy where one is asked for."""
        if self.half is None and (self.rank is not None or self.scores is not None):
            raise ConfigError("--rank and --scores are of a copy; give its file with --half")
        if self.weights is None:
            if self.half is not None:
                raise ConfigError("--half copies one file of weights; say which")
            self._list()
            return
        loaded = load_weights(self.weights)
        if self.half is not None:
            if self.half.exists():
                raise DataError(f"{self.half} exists; give --half another name")
            if self.rank is not None:
                loaded = with_rank(loaded, self.rank)
            loaded = replace(loaded, scores=_scores(self.scores) if self.scores else loaded.scores)
            save_weights(self.half, loaded, torch.float16)
        found = describe(loaded)
        print(json.dumps(found) if self.json else to_text(str(self.weights), found))
        if self.half is not None and not self.json:
            print(f"{self.half}: half precision, {self.half.stat().st_size / 1e6:.1f} MB")

    def _list(self) -> None:
        found = {name: describe(load_weights(path)) for name, path in published().items()}
        if self.json:
            print(json.dumps(found))
            return
        print("\n".join(to_text(name, about) for name, about in found.items()) or "no weights are published")


def _scores(path: Path) -> dict[str, Any]:
    """Return what a reader of weights wants of an evaluation: on what, how good, and the baselines."""
    try:
        found = json.loads(path.read_text())
        baselines = {name: one["overall"] for name, one in found["baselines"].items()}
        objects = {one["character"]: one["psnr_db"] for one in found["characters"].values()}
        kept = {name: found[name] for name in ("data", "split", "images", "overall", "checks")}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path} is not what `evnlos evaluate --json` prints: {error!r}"[:300]) from None
    return kept | {"data": Path(kept["data"]).name, "psnr_db": objects, "baselines": baselines}


def describe(weights: Weights) -> dict[str, Any]:
    """Return what a user of the weights must know, as plain values."""
    state = weights.network.state_dict().values()
    return {
        **describe_network(weights.network),
        "sees_sequence": weights.network.sees_sequence,
        "parameters": sum(p.numel() for p in weights.network.parameters()),
        "numbers": sum(value.numel() for value in state),
        "history": weights.history,
        "confidence": weights.confidence is not None,
        "scores": weights.scores,
        "digest": weights.is_sealed,
    }


def to_text(name: str, found: dict[str, Any]) -> str:
    """Return the description as lines for people."""
    sees = "whole sequences" if found["sees_sequence"] else "one time step at a time"
    sampling = found["sampling"]
    lines = [
        f"{name}: {found['modality']}, {found['network']['kind']}: {sees}; {found['parameters']:,} trained "
        f"parameters, {found['numbers'] - found['parameters']:,} numbers in closed form",
        f"  maps {sampling.get('width')} x {sampling.get('height')}, pitch {sampling.get('pitch_m')} m, "
        f"surface {sampling.get('surface')}, tau {sampling.get('tau_s')} s",
    ]
    for number, step in enumerate(found["history"], start=1):
        data, plan = step.get("data", {}), step.get("settings", {})
        lines.append(
            f"  {number}. {data.get('origin')} {data.get('name')}: {len(data.get('train', []))} objects, "
            f"{plan.get('epochs')} epochs at {plan.get('learning_rate')}, seed {plan.get('seed')}"
        )
    if not found["digest"]:
        lines.append("  without a digest, as earlier versions wrote them: damage to the numbers goes unseen")
    if found["scores"]:
        lines.append(_score_line(found["scores"]))
    return "\n".join(map(printable, lines))


def _score_line(scores: dict[str, Any]) -> str:
    """Return one line on how good the weights were found to be; a stranger's file may say anything there."""
    try:
        named, between = list(scores["psnr_db"].items()), ", "
        if len(named) > _MOST_NAMED:
            ranked = sorted(named, key=lambda pair: pair[1])
            named, between = [ranked[0], ranked[-1]], " to "
        each = between.join(f"{name} {value:.2f}" for name, value in named)
        return f"  {scores['overall']['psnr_db']:.2f} dB on {scores['data']}, {scores['split']}: {each}"
    except (KeyError, TypeError, ValueError, AttributeError):
        return "  its scores are not what this version writes"
