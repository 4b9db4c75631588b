"""Draw what the pages on results show: the table from its records, a film of learned results, a fine-tuning.

python tools/draw_results.py                                        # docs/figures/results_near.png
python tools/draw_results.py walls                                  # docs/figures/walls.png
python tools/draw_results.py film                                   # docs/figures/learned_film.webp
python tools/draw_results.py finetune mine near-frame mine-frame    # docs/figures/finetune.png
"""

import hashlib
import json
import re
import sys
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
    "E2E, its positions averaged": "sequence/near-test-e2e-single-positions-averaged",
    "simulation only, sequence": "sequence/near-test-simulation-only-sequence",
    "EPNP, sequence": "sequence/near-test-epnp-sequence",
    "EPNP, sequence + consistency": "sequence/near-test-epnp-sequence-consistency",
}
SEES = {"frames": "frame", "events": "event", "fusion": "fusion"}
WALLS = ROOT / "docs" / "walls.md"
COLOURS = {"frame": "#0072b2", "event": "#d55e00", "fusion": "#009e73"}


def scores(method: str, modality: str) -> np.ndarray:
    """Return the PSNR of each seed and test character, dB, [seeds, characters]; empty without a record."""
    found = [
        list(json.loads(path.read_text(encoding="utf-8"))["scores"]["psnr_db"].values())
        for seed in range(3)
        if (path := RECORDS / f"{METHODS[method]}-{modality}-seed{seed}.json").exists()
    ]
    return np.array(found)


def draw_film() -> None:
    """Draw hidden object, wall, linear and learned result of a simulated sequence, one position an image."""
    from PIL import Image

    from evnlos.app.controls import Controls, picked, simulate_sequence
    from evnlos.app.views import from_each_frame, from_weights, own_networks
    from evnlos.data import Sampling
    from evnlos.report.pictures import grey

    recorded = simulate_sequence(Controls(), picked("R"))
    networks = own_networks(())
    name, network = next(item for item in networks.of(recorded).items() if "frames" in item[0])
    learned = from_weights(recorded, name, network, networks.wall_of(recorded))
    truth, frames = recorded.truth(Sampling()), recorded.frames
    assert truth is not None and frames is not None
    columns = {
        "hidden object": grey(truth),
        "wall, as the camera sees it": grey(frames / recorded.peak, 0.05, 0.4),
        "linear, from one frame": grey(from_each_frame(recorded).images),
        "learned, from all frames": grey(learned.images),
    }
    pictures = []
    for k in range(len(truth)):
        figure, axes = plt.subplots(1, len(columns), figsize=(9.6, 1.75), layout="constrained")
        for axis, (title, images) in zip(axes, columns.items(), strict=True):
            axis.imshow(images[k], cmap="gray", vmin=0, vmax=255, aspect="equal")
            axis.set_title(title, fontsize=10)
            axis.set_axis_off()
        figure.canvas.draw()
        pictures.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3]))
        plt.close(figure)
    path = ROOT / "docs" / "figures" / "learned_film.webp"
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=120, loop=0, quality=60, method=6
    )


def draw_finetune(data: str, before: str, after: str) -> None:
    """Draw frame, both networks' images and truth of the middle position of each test character."""
    from evnlos.data import NlosDataset, open_dataset
    from evnlos.models import load_weights

    models = {"before": load_weights(before), "after fine-tuning": load_weights(after)}
    samples = {title: NlosDataset(open_dataset(data), "test", one.modality) for title, one in models.items()}
    images = {title: one.network.infer(samples[title].inputs) for title, one in models.items()}
    first = samples["before"]
    columns = {"frame of the wall": first.inputs[:, 0].float(), **images, "truth": first.truth.float()}
    names = np.unique(first.names)
    figure, axes = plt.subplots(len(names), len(columns), figsize=(8, 1.4 * len(names)), layout="constrained")
    for row, name in zip(axes, names, strict=True):
        places = np.flatnonzero(first.names == name)
        for axis, (title, pictures) in zip(row, columns.items(), strict=True):
            high = None if title.startswith("frame") else 1
            axis.imshow(pictures[places[len(places) // 2]].numpy(), cmap="gray", vmin=0, vmax=high)
            axis.set_axis_off()
            if name == names[0]:
                axis.set_title(title, fontsize=10)
    figure.savefig(ROOT / "docs" / "figures" / "finetune.png", dpi=110)


def main() -> None:
    """Draw the figure that is asked for."""
    match sys.argv[1:]:
        case []:
            draw_table()
        case ["walls"]:
            draw_walls()
        case ["film"]:
            draw_film()
        case ["finetune", data, before, after]:
            draw_finetune(data, before, after)
        case other:
            sys.exit(f"{' '.join(other)} is no figure; {__doc__}")


def draw_table() -> None:
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


def rows_of_rooms(page: str) -> dict[tuple[str, str], tuple[float, ...]]:
    """Return E2E, simulation only, EPNP, its lead and the ends of its interval, dB, by room and modality.

    Args:
        page: Text of the page on walls; the rows of its table of all rooms count.
    """
    room, found = "", dict[tuple[str, str], tuple[float, ...]]()
    for line in page.splitlines():
        cells = [cell.strip(" `") for cell in line.strip("|").split("|")]
        if len(cells) == 8 and cells[1] in SEES and cells[-1].endswith("]"):
            room = cells[0] or room
            values = re.findall(r"[+-]?[0-9.]+", " ".join(cells[4:]))
            found[room, SEES[cells[1]]] = tuple(float(value) for value in values)
    return found


def digest_of(rows: dict[tuple[str, str], tuple[float, ...]]) -> str:
    """Return what tells whether a figure shows these rows."""
    return hashlib.sha256(repr(sorted(rows.items())).encode()).hexdigest()[:16]


def draw_walls() -> None:
    """Draw PSNR of the three networks of each room, and the lead of EPNP with its 95 % interval."""
    from evnlos.studies import lead_figure

    rows = rows_of_rooms(WALLS.read_text(encoding="utf-8"))
    told = {"Description": digest_of(rows), "Software": None}
    lead_figure(rows).savefig(ROOT / "docs" / "figures" / "walls.png", dpi=110, metadata=told)


if __name__ == "__main__":
    main()
