"""Do the 95 % intervals of `evnlos pixel fit` hold the truth 95 % of the time?

    python benchmarks/pixel_fit_coverage.py --draws 40 --out coverage.jsonl

For each model, pixels of settings drawn at random see a slow and a fast sine (2 and 20 Hz, contrast 0.7 about
60 DN) and two constant levels (5 and 120 DN); the model is fitted, and each interval either holds the truth or
does not. "At most" holds what is below its bound; what is "not identified" claims nothing and is counted apart.
Each draw is a line in the file as soon as it is done, so that the run may be stopped and continued.
"""

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from evnlos.calibration.pixel_fit import (
    CANDIDATES,
    MISMATCH,
    PixelFitSettings,
    fit_candidate,
    panels_of,
)
from evnlos.calibration.pixel_light import KnownLight, LitRecording, waveform
from evnlos.calibration.pixel_statistics import simulated_events
from evnlos.types import Events, derive_seed

SHARED = {"threshold_on": (0.12, 0.4), "threshold_off": (0.12, 0.4), MISMATCH: (0.03, 0.15)}
TRUTHS = {
    "continuous": {"cutoff_hz": (15.0, 300.0), "leak_rate_hz": (0.05, 1.0), "shot_noise_rate_hz": (0.2, 5.0)},
    "brownian": {
        "dark_dn": (2.0, 30.0),
        "leak_rate_hz": (0.05, 0.5),
        "leak_rate_per_dn_hz": (1e-3, 1e-2),
        "photon_noise": (0.1, 0.6),
    },
    "circuit": {
        "photocurrent_a_per_dn": (5e-16, 1e-14),
        "leak_rate_hz": (0.05, 1.0),
        "noise_factor": (0.7, 1.5),
    },
}
PIXELS = 100
LIGHTS = (
    (KnownLight("sine", 60.0, 2.0, 0.7), 4.0),
    (KnownLight("sine", 60.0, 20.0, 0.7), 0.5),
    (KnownLight("static", 5.0), 6.0),
    (KnownLight("static", 120.0), 6.0),
)


def one_draw(name: str, number: int, root: int) -> dict:
    """Return truth and intervals of a draw; root: seed of all draws."""
    seed = derive_seed(root, name, number)
    draw = np.random.default_rng(seed)
    ranges = SHARED | TRUTHS[name]
    truth = {key: math.exp(draw.uniform(math.log(low), math.log(high))) for key, (low, high) in ranges.items()}
    ratio = truth[MISMATCH]
    truth["threshold_sigma"] = ratio * 0.5 * (truth["threshold_on"] + truth["threshold_off"])
    start = CANDIDATES[name][0]
    pixel = replace(start, **{key: value for key, value in truth.items() if key != MISMATCH})
    recordings = []
    for light, seconds in LIGHTS:
        times, level = waveform(light, max(seconds, 1.0 / light.frequency_hz))
        lit = np.repeat(level[:, None].astype(np.float32), PIXELS, axis=1)[:, None]
        recordings.append(LitRecording(np.ascontiguousarray(lit), times, Events.empty(PIXELS, 1), known=light))
    events = simulated_events(recordings, pixel, derive_seed(seed, "recorded"))
    panels = panels_of([replace(one, events=found) for one, found in zip(recordings, events, strict=True)])
    begin, cpu = time.time(), time.process_time()
    fit = fit_candidate(name, panels, PixelFitSettings(seed=number))
    found = {one.name: [truth[one.name], one.value, one.low, one.high, one.state] for one in fit.estimates}
    return {
        "model": name,
        "draw": number,
        "misfit": fit.misfit,
        "seconds": time.time() - begin,
        "cpu_s": time.process_time() - cpu,
        "found": found,
    }


def table(lines: list[dict]) -> str:
    """Return the coverage of each number of each model."""
    rows = ["model        number                   inside  of  not identified  median width / value"]
    for name in dict.fromkeys(line["model"] for line in lines):
        mine = [line["found"] for line in lines if line["model"] == name]
        hits = tries = 0
        for key in mine[0]:
            told = [one[key] for one in mine if one[key][4] != "not identified"]
            inside = sum(
                (low <= true or state == "at most") and true <= high for true, _, low, high, state in told
            )
            width = np.median([(high - low) / value for _, value, low, high, _ in told]) if told else math.nan
            hits, tries = hits + inside, tries + len(told)
            rows.append(f"{name:12} {key:24} {inside:6} {len(told):3} {len(mine) - len(told):15} {width:21.3f}")
        share = 100 * hits / max(tries, 1)
        rows.append(f"{name:12} {'all':24} {hits:6} {tries:3}  = {share:.1f} % of {len(mine)} draws")
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument(
        "--seed", type=int, default=20261123, help="of all draws; another has a file of its own"
    )
    parser.add_argument("--models", nargs="+", default=list(TRUTHS))
    parser.add_argument("--out", type=Path, default=Path("pixel_fit_coverage.jsonl"))
    options = parser.parse_args()
    lines = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out.exists() else []
    done = {(line["model"], line["draw"]) for line in lines}
    for number in range(options.draws):
        for name in options.models:
            if (name, number) in done:
                continue
            lines.append(one_draw(name, number, options.seed))
            with options.out.open("a") as file:
                file.write(json.dumps(lines[-1]) + "\n")
    print(table(lines))


if __name__ == "__main__":
    main()
