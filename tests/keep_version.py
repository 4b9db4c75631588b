"""Keep small files of this version, which later ones must read: dataset, run, weights, setup, capture.

    python tests/keep_version.py 0.2.0

writes `tests/upgrade/0.2.0`; run it once, before that version is tagged. `tests/test_upgrade.py`
reads them all.
"""

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np

from evnlos.analysis import evaluate
from evnlos.config import save_yaml
from evnlos.data import (
    Sampling,
    SensorSize,
    Simulation,
    open_dataset,
    read_capture,
    read_shard,
    simulate,
)
from evnlos.data.lab import Lab, render_captures
from evnlos.models import UNetConfig, load_weights
from evnlos.scene import FontGlyphs, HandwritingGlyphs
from evnlos.setups import PaperSetup, RadiometricSetup, load_setup
from evnlos.training import Training, train

UPGRADE = Path(__file__).parent / "upgrade"
SENSOR = SensorSize(24, 36)
SIMULATION = Simulation(
    glyphs=HandwritingGlyphs(characters="AL", writers=2),
    setup=PaperSetup(tpsf_length_m=0.004, pitch_m=2e-3, gain=2.0, field_of_view_m=0.3, sensor=SENSOR),
    sampling=Sampling(height=16, width=24, pitch_m=0.01, scored_rows=12),
    positions=4,
    vary={"setup.gain": (1.5, 2.0)},
)
LAB = Lab(
    glyphs=FontGlyphs(family="kalam", characters="A"),
    setup=RadiometricSetup(cell_m=0.02, gain=0.7, ambient=0.06, sensor=SENSOR),
    frame_rate_hz=1.0,
)


def answers(folder: Path) -> dict:
    """Return what the files of a version say: means of samples, how its network scores, setup and capture."""
    dataset = open_dataset(folder / "dataset")
    samples = [read_shard(dataset.shard(name))[0] for name in dataset.objects()]
    scores = evaluate(load_weights(folder / "run"), dataset, "all").scores.mean()
    capture = read_capture(next((folder / "captures").glob("*/capture.yaml")).parent)
    setup = load_setup(folder / "setup.yaml")
    return {
        "frames": [round(float(np.mean(one.frame)), 4) for one in samples],
        "surfaces": [round(float(np.mean(one.surface)), 4) for one in samples],
        "truth": [round(float(np.mean(one.truth)), 4) for one in samples],
        "psnr_db": round(float(scores["psnr_db"]), 1),
        "setup": [setup.kind, setup.tpsf_length_m, setup.gain, setup.sensor.height, setup.pixel.kind],
        "capture": [len(capture.events), *capture.frames.shape],
    }


def main() -> None:
    if len(sys.argv) != 2 or re.fullmatch(r"\d+\.\d+\.\d+", sys.argv[1]) is None:
        sys.exit("give the version that comes next, e.g. 0.2.0")
    folder = UPGRADE / sys.argv[1]
    if folder.exists():
        sys.exit(f"{folder} exists; a version's files never change")
    dataset = simulate(SIMULATION, folder / "dataset", workers=1)
    train(dataset, Training(epochs=1, network=UNetConfig(width=4, depth=1, rank=0)), folder / "run")
    (folder / "run" / "checkpoint.safetensors").unlink(missing_ok=True)
    render_captures(LAB, folder / "captures", workers=1)
    save_yaml(SIMULATION, folder / "setup.yaml")
    for lock in folder.rglob(".lock*"):
        lock.unlink() if lock.is_file() else shutil.rmtree(lock)
    (folder / "answers.json").write_text(json.dumps(answers(folder), indent=1) + "\n")


if __name__ == "__main__":
    main()
