"""How weak may a person's light on the floor be, and what do compression, drift and shake of the camera do?

Films simulated corners (320 x 240 pixels, 8 bit, 15 frames per second, 20 s, one person there and back), looks
past them, and prints how often the person is found, how far the bearings are off, and how often the stated 90 %
intervals hold. A rival stands beside it: the bearing of the largest slope of the same floor's change.

    python benchmarks/corner.py
    python benchmarks/corner.py --write benchmarks/results/corner.md
"""

from __future__ import annotations

import argparse
import os
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

from evnlos.cameras import FrameCamera  # noqa: E402
from evnlos.cameras.video import film, open_video  # noqa: E402
from evnlos.cameras.video_files import to_light, write_video  # noqa: E402
from evnlos.data.frames import homography_from_points  # noqa: E402
from evnlos.inverse import FloorSector, Penumbra, read_penumbra  # noqa: E402
from evnlos.optics import CornerFloor, CornerScene  # noqa: E402
from evnlos.tracking import track_bearings  # noqa: E402
from machine import machine  # noqa: E402

FPS, SECONDS = 15.0, 20.0


def sector_of(floor: CornerFloor) -> FloorSector:
    """Return the sector that the simulator marks, its floor put upright."""
    marks = {name: np.array(value) for name, value in floor.marks().items()}
    tile = [(0, 0), (0.6, 0), (0.6, 0.6), (0, 0.6)]
    matrix = homography_from_points(marks["floor"].reshape(4, 2), tile)
    points = [(float(marks[name][0]), float(marks[name][1])) for name in ("edge", "wall", "end")]
    return FloorSector(points[0], points[1], points[2], tuple(tuple(row) for row in matrix.tolist()))


def seen(scene: CornerScene, seed: int, quality: int | None = None) -> Penumbra:
    """Film a corner and read its floor, through a file where it is compressed."""
    floor = CornerFloor(scene)
    box, index, bearings = sector_of(floor).pixels(floor.shape)
    times = (np.arange(round(SECONDS * FPS)) / FPS).tolist()
    shots = film(floor, FrameCamera(0.0, bit_depth=12), times, "srgb", seed)
    if quality is None:
        left, top, right, bottom = box
        part = (to_light(shot[top:bottom, left:right], "srgb") for shot in shots)
        return read_penumbra(zip(times, part, strict=True), index, bearings)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "corner.mp4"
        write_video(path, shots, FPS, quality)
        return read_penumbra(open_video(path, tone="srgb").part(box), index, bearings)


def steepest(penumbra: Penumbra) -> np.ndarray:
    """Return the bearing of the largest slope of each step, the change smoothed over 5 degrees, degrees."""
    middle = 0.5 * (penumbra.edges_deg[1:] + penumbra.edges_deg[:-1])
    kernel = np.exp(-0.5 * (np.arange(-12, 13) / 4) ** 2)
    slope = np.gradient(penumbra.change, axis=1)
    smooth = np.stack([np.convolve(row, kernel, "same") for row in slope])
    return middle[4 + np.argmax(smooth[:, 4:-4], axis=1)]


def row(title: str, scene: CornerScene, seeds: range, quality: int | None = None) -> str:
    """Return a line of the table."""
    found, tracks, off, within, rival, there, sigma, limits, noise = 0, 0, [], [], [], [], [], [], []
    for seed in seeds:
        penumbra = seen(replace(scene, seed=seed), seed, quality)
        result = track_bearings(penumbra)
        tracks += len(result.tracks)
        noise.append(result.noise_factor)
        if not scene.walkers or not scene.contrast:
            limits.append(result.limit)
            continue
        truth = scene.bearings_deg(penumbra.times_s)[0]
        known = np.isfinite(truth)
        rival.append(steepest(penumbra)[known] - truth[known])
        if not result.tracks:
            limits.append(result.limit)
            continue
        found += 1
        best = result.tracks[0]
        error = best.bearing_deg - truth
        both = np.isfinite(error)
        off.append(error[both])
        within.append(np.abs(error[both]) <= 1.645 * best.deviation_deg[both])
        there.append(best.there[known].mean())
        sigma.append(best.step_sigma)
    rms = f"{np.sqrt(np.mean(np.concatenate(off) ** 2)):.2f}" if off else "-"
    bias = f"{np.mean(np.concatenate(off)):+.2f}" if off else "-"
    held = f"{100 * np.concatenate(within).mean():.0f} %" if within else "-"
    other = f"{np.sqrt(np.mean(np.concatenate(rival) ** 2)):.1f}" if rival else "-"
    share = f"{100 * np.mean(there):.0f} %" if there else "-"
    stands = f"{np.mean(sigma):.1f}" if sigma else "-"
    limit = f"{100 * np.nanmean(limits):.2g} %" if limits and np.isfinite(limits).any() else "-"
    people = len(scene.walkers) if scene.contrast else 0
    hits = f"{found} of {len(seeds)}" if people else "-"
    extra = tracks - found
    fields = title, hits, extra, stands, share, rms, bias, held, other, limit, f"{np.mean(noise):.1f}"
    line = f"| {' | '.join(map(str, fields))} |"
    print(line, flush=True)
    return line


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", type=Path, help="also write the table to this file")
    parser.add_argument("--seeds", type=int, default=3, help="videos of each kind")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    seeds, base = range(arguments.seeds), CornerScene()
    lines = ["# A corner as a camera", "", machine("av"), ""]
    lines += [
        "| video | found | other tracks | sigma per 0.1 s | of the time | rms, deg | bias, deg "
        "| in 90 % interval | steepest slope, rms, deg | would be found | noise factor |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for contrast in (0.1, 0.03, 0.01, 0.003, 0.001, 0.0003):
        lines.append(row(f"contrast {100 * contrast:g} %", replace(base, contrast=contrast), seeds))
    for quality in (5, 10, 18, 23):
        lines.append(row(f"1 %, H.264 at CRF {quality}", base, range(1), quality))
    lines.append(row("1 %, gain swings by 5 %", replace(base, drift=0.05), seeds))
    lines.append(row("1 %, camera shakes by 0.3 px", replace(base, shake_px=0.3), seeds))
    lines.append(row("1 %, floor without texture", replace(base, texture=0.0), seeds))
    lines.append(row("nobody", replace(base, walkers=(), size=(160, 120)), range(6 * arguments.seeds)))
    lines.append(row("nobody, H.264 at CRF 23", replace(base, walkers=()), range(1), 23))
    lines.append(
        row("nobody, gain 5 %, shake 0.3 px", replace(base, walkers=(), drift=0.05, shake_px=0.3), seeds)
    )
    text = "\n".join(lines) + "\n"
    if arguments.write:
        arguments.write.write_text(text)


if __name__ == "__main__":
    main()
