"""`evnlos evaluate`: weights and dataset in, scores beside their baselines out."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evnlos.cli.notes import say
from evnlos.config import to_dict
from evnlos.dataset import open_dataset
from evnlos.evaluation import BASELINES, CHECKS
from evnlos.model.confidence import COVERAGE


@dataclass(frozen=True)
class EvaluateCommand:
    """Score a network on a split of a dataset, with the baselines beside it."""

    weights: Path
    """Weights file, or a run's folder."""
    data: Path
    """Folder of the dataset."""
    split: str | None = None
    """Split to score: test, validation, train or all; by default `test` where there is one, else `all`."""
    vgg: Path | None = None
    """torchvision's vgg16-397923af.pth for LPIPS; by default it is looked for in the torch hub cache."""
    lpips_heads: Path | None = None
    """The linear heads vgg.pth of LPIPS v0.1; by default those of an installed `lpips`."""
    setup: Path | None = None
    """The calibrated setup (the folder that `calibrate` wrote): the confidence then asks how much of the frames
    the pictures explain. Without it published weights take the setup that they were trained for."""
    positions: tuple[int, ...] = ()
    """Numbers of positions, e.g. 1 2 5 10 20 40: also how the image of a sequence network grows with them."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def run(self) -> None:
        """Evaluate and print."""
        from evnlos.evaluation import available_lpips, curve_over_positions, evaluate, load_lpips
        from evnlos.model import load_weights, published_rig
        from evnlos.report import refuse_seen, seen_in_training
        from evnlos.setups import calibrated_folder, load_setup

        dataset, weights = open_dataset(self.data), load_weights(self.weights)
        split = self.split or ("test" if dataset.split.get("test") else "all")
        refuse_seen(weights.history, dataset, split)
        metric = load_lpips(self.vgg, self.lpips_heads) if self.vgg or self.lpips_heads else available_lpips()
        curve = curve_over_positions(weights, dataset, split, self.positions) if self.positions else []
        word = calibrated_folder(self.setup) if self.setup else published_rig(self.weights)
        known = load_setup(word) if word else None
        found = evaluate(weights, dataset, split, metric, known).summary()
        about = {
            "weights": str(self.weights),
            "modality": weights.modality.name,
            "data": str(self.data),
            "split": split,
        }
        seen = seen_in_training(weights.history, dataset, split)
        if self.json:
            points = {"positions": [to_dict(point) for point in curve]} if curve else {}
            print(json.dumps(about | {"seen_in_training": seen} | found | points))
        else:
            _print_summary(about, found)
            if curve:
                print("| positions | choices of them | PSNR, dB |\n|---|---|---|")
                print("\n".join(f"| {p.positions} | {p.subsets} | {p.psnr_db:.2f} |" for p in curve))
            if seen:
                say(f"note: training saw {', '.join(seen)}; scores on them say nothing about unseen objects")


def _print_summary(about: dict[str, str], found: dict[str, Any]) -> None:
    print(
        f"{about['weights']} ({about['modality']}) on {about['data']}, split {about['split']}: "
        f"{found['images']} pictures"
    )
    names = list(found["overall"])
    rows = [["", *names]]
    rows += [[name, *(_cell(v[key]) for key in names)] for name, v in found["characters"].items()]
    rows.append(["all", *(_cell(found["overall"][key]) for key in names)])
    rows += [
        [BASELINES[n], *(_cell(v["overall"][key]) for key in names)] for n, v in found["baselines"].items()
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    print("\n".join("  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)) for row in rows))
    for name, share in found["checks"].items():
        print(f"{CHECKS[name]}: {share:.0%}")
    if worth := found["confidence"]:
        said = ("support", "skill", "measured", "coverage", "width")
        mean = {key: sum(one[key] for one in worth) / len(worth) for key in said}
        print(
            f"confidence: support {mean['support']:.0%} said, {mean['skill']:.0%} found; "
            f"{mean['measured']:.0%} of {len(worth)} passes said to be measured; intervals of "
            f"{COVERAGE:.0%} hold {mean['coverage']:.0%} of the pixels, mean length {mean['width']:.2f}"
        )


def _cell(value: float | None) -> str:
    return "not available" if value is None else f"{value:.3f}"
