"""Draw the table of results from its records: PSNR of each method from frames, events and both, with intervals.

python tools/draw_results.py        # docs/figures/results_near.png
"""

import json
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parent.parent
RECORDS = ROOT / "benchmarks" / "results" / "experiments"
METHODS = {
    "linear, 28 captures": "captures/near-test-linear-captures",
    "E2E, one position": "captures/near-test-e2e",
    "simulation only, one position": "captures/near-test-simulation-only",
    "EPNP, one position": "captures/near-test-epnp",
    "E2E, sequence": "joint/near-test-e2e-joint",
    "simulation only, sequence": "joint/near-test-simulation-only-joint",
    "EPNP, sequence": "joint/near-test-epnp-joint",
    "EPNP, sequence + consistency": "joint/near-test-epnp-joint-consistency",
}
COLOURS = {"frame": "#0072b2", "event": "#d55e00", "fusion": "#009e73"}


def scores(method: str, modality: str) -> np.ndarray:
    """Return the PSNR of each seed and test character, dB, [seeds, characters]; empty without a record."""
    found = [
        list(json.loads(path.read_text(encoding="utf-8"))["scores"]["psnr_db"].values())
        for seed in range(3)
        if (path := RECORDS / f"{METHODS[method]}-{modality}-seed{seed}.json").exists()
    ]
    return np.array(found)


def main() -> None:
    """Draw each method's mean as a mark, its four characters as dots, the seeds' deviation as a bar."""
    figure, axes = plt.subplots(figsize=(8, 5.2), layout="constrained")
    for row, method in enumerate(METHODS):
        for k, (modality, colour) in enumerate(COLOURS.items()):
            values = scores(method, modality)
            if not values.size:
                continue
            y = -row - 0.24 * (k - 1)
            seeds, characters = values.mean(axis=1), values.mean(axis=0)
            axes.plot(characters, np.full(len(characters), y), ".", color=colour, alpha=0.4, ms=6)
            deviation = seeds.std(ddof=1) if len(seeds) > 1 else 0.0
            label = modality if row == len(METHODS) - 2 else None
            axes.errorbar(seeds.mean(), y, xerr=deviation, fmt="o", color=colour, ms=6, capsize=3, label=label)
    axes.axvline(13.73, color="#888888", ls="--", lw=1)
    axes.text(13.65, 0.45, "mean image", ha="right", va="bottom", color="#666666", fontsize=9)
    axes.set_yticks(-np.arange(len(METHODS)), list(METHODS))
    axes.set_xlabel("PSNR, dB (four held-out characters; marks: mean; bars: deviation over three seeds)")
    axes.legend(loc="upper right", frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="x", alpha=0.25)
    figure.savefig(ROOT / "docs" / "figures" / "results_near.png", dpi=110)


if __name__ == "__main__":
    main()
