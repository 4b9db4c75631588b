"""Which channel inverts better without learning, two frames or the events between them, and in which light?
And what does the likelihood of a whole sequence cost?

    python benchmarks/inversion.py
    python benchmarks/inversion.py --likelihood --write benchmarks/results/likelihood.md
    python benchmarks/inversion.py --maps

A character on the setup "main" (rough aluminium of roughness 0.05, 0.3 m), 30 x 48 pixels in both cameras. The
unknown is the scene's change between two instants 0.8 s apart, 16 mm of travel (paper Eq. event_fm1 and
event_fm3, without the time surface): from the difference of two frames, and from the signed event count times
the threshold, linearised at the mean of the two frames. "exact" is the true change of log light, without noise:
what the linearisation alone costs. All by Tikhonov with the gradient towards a dark border, regularization by
leaving out blocks of the wall; r is Pearson's correlation of the found change with the true one, mean of R, K
and G.

`--likelihood` solves simulated sequences of 160 x 100 pixels behind the published setup of `near` (8 s, 40
frames, a letter of an unseen hand) as `evnlos invert --from events` and `--from both` do, with thresholds that
make once, twice and four times as many events. Processor time of one thread, the light path aside, and the
memory that the process held at most while it solved, over what it held before; each in a process of its own.

`--maps` asks what it is worth to know the sensor, of the same sequences: letters of two sensors, whose pixels
differ by 10 and 20 % of a threshold, 3 of 1000 of them hot. Each is fitted as `evnlos pixel fit` does, to 5 s
of a sine of 2 Hz and 10 s of constant light. The letters are solved with the fitted pixel: without its maps,
without the events of its hot pixels, and with its thresholds, too. PSNR over the target plane (expected), and
how many cells are in the 90 % interval.
"""

import argparse
import re
import sys
import time
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
import torch

from evnlos.calibration import KnownLight, LitFile, Manifest, PixelFitSettings, fit_known_light, waveform
from evnlos.cameras import EventCamera, EventPixel, FrameCamera, PixelMaps, simulate_events
from evnlos.config import from_dict
from evnlos.data import Capture, CaptureInfo
from evnlos.events import write_events
from evnlos.inverse import Gradient, LogChange, SequenceLights, log_change, tikhonov
from evnlos.inverse.event_images import event_prior
from evnlos.machine import one_thread
from evnlos.models import estimate_target
from evnlos.optics import MatrixTransport
from evnlos.scene import HandwritingGlyphs, Scene
from evnlos.setups import RadiometricSetup, Setup, load_setup
from machine import machine

LETTERS, SENSORS = "HSE", ((0.02, 11), (0.04, 12))  # mismatch in log units, and pattern_seed
LIGHTS = (KnownLight("sine", 60.0, 2.0, 0.7), 5.0), (KnownLight("static", 60.0), 10.0)

SHAPE = (30, 48)
TIMES_S = (3.6, 4.4)
NEAR = Path(__file__).parents[1] / "packages/evnlos-weights/src/evnlos_weights/near.yaml"
SENSOR, SECONDS, FRAMES, THRESHOLD = (100, 160), 8.0, 40, 0.2
Evidence = Literal["events", "both"]


def correlation(image: torch.Tensor, truth: torch.Tensor) -> float:
    return float(torch.corrcoef(torch.stack([image.flatten(), truth.flatten()]))[0, 1])


def compare(gain: float, ambient: float, character: str, seed: int = 0) -> dict[str, float]:
    """Return r of each channel for one character in one light."""
    scene = Scene(HandwritingGlyphs().target(f"writer03_{character}"))
    setup = RadiometricSetup(cell_m=0.005, strip_m=(0.24, 0.08), gain=gain, ambient=ambient)
    wall = setup.resized(SHAPE).observe(scene)
    operator = MatrixTransport(gain * wall.transport.matrix.double(), wall.transport.source, SHAPE)
    first, last = (torch.from_numpy(scene.truth(wall.transport.source, t)).double() for t in TIMES_S)

    frames = FrameCamera(exposure_s=0.016).capture(wall, np.array(TIMES_S), seed=seed)
    before, after = torch.from_numpy(frames.astype(np.float64) / 255)
    pixel = EventPixel()
    events = EventCamera(pixel).record(wall, *TIMES_S, seed=seed)
    edges_us = [int(1e6 * t) for t in TIMES_S]
    counted = log_change(events, edges_us, pixel)[0].double()
    linear = LogChange(operator, ((before + after) / 2).clamp(min=0.5 / 255))
    dark, bright = (wall.irradiance(t).double() for t in TIMES_S)
    exact = LogChange(operator, (dark + bright) / 2)
    options = {"prior": Gradient("dark"), "rule": "cv"}
    solved = {
        "frames": tikhonov(operator, after - before, **options),
        "events": tikhonov(linear, counted, **options),
        "exact": tikhonov(exact, torch.log(bright / dark), **options),
    }
    row = {name: correlation(solution.image, last - first) for name, solution in solved.items()}
    return row | {"events per pixel": len(events) / (SHAPE[0] * SHAPE[1])}


def sequence(setup: Setup, lights: SequenceLights, name: str = "R") -> Capture:
    """Return a capture of a letter behind a setup."""
    info = from_dict(
        CaptureInfo,
        {
            "camera": {"height": SENSOR[0], "width": SENSOR[1]},
            "motion": {"start_m": -0.08, "speed_m_s": 0.02},
        },
        source="a benchmark",
    )
    times_us = np.arange(FRAMES + 1) * int(1e6 * SECONDS / FRAMES)
    blank = np.zeros((len(times_us), *SENSOR), np.uint8)
    empty = Capture("letter", info, simulate_events(blank[:2], [0.0, SECONDS]), blank, times_us, None)
    basis, motion = event_prior(setup, info.target_size_m, 120), empty.motion
    assert motion is not None
    light = lights.of(setup.seen_by(SENSOR), basis, motion.in_its_plane(), (0.0, SECONDS), SENSOR)
    letter = HandwritingGlyphs().target(f"writer03_{name}").rasterise(basis.target_plane)
    seen = np.maximum(light(basis.coefficients(letter.astype(np.float64))), 1e-3)
    video = np.ascontiguousarray(255 * seen.T.reshape(-1, *SENSOR), np.float32)
    events = simulate_events(video, light.times_s, setup.pixel, seed=1)
    everywhere = np.arange(len(seen))
    at = [light.at(seen, everywhere, np.full(len(seen), 1e-6 * t)).reshape(SENSOR) for t in times_us]
    return replace(empty, events=events, frames=setup.frame_camera.expose(np.array(at), 1))


def pixels(threshold: float) -> Setup:
    """Return the setup of `near` with such thresholds, log units, and few noise events."""
    setup = load_setup(NEAR)
    changes = {"threshold_on": threshold, "threshold_off": threshold, "shot_noise_rate_hz": 0.02}
    return replace(setup, pixel=replace(setup.pixel, **changes, threshold_sigma=0.2 * threshold))


def held_mib(key: str) -> float:
    """Return what this process holds, MiB: now (`VmRSS`) or at most (`VmHWM`)."""
    found = re.search(rf"{key}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(found[1]) / 1024 if found else float("nan")


def cost(evidence: Evidence, threshold: float) -> tuple[int, float, float, float]:
    """Return events, seconds, MiB beside what was held before, and PSNR over the target plane, dB."""
    one_thread()
    lights = SequenceLights()
    setup = pixels(threshold)
    capture = sequence(setup, lights)
    before = held_mib("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the most that was held counts from now
    begun = time.process_time()
    found = estimate_target(capture, setup, evidence, lights=lights)
    seconds = time.process_time() - begun
    truth = HandwritingGlyphs().target("writer03_R").rasterise(found.plane)
    psnr = -10 * float(np.log10(np.square(found.image - truth).mean()))
    return len(capture.events), seconds, held_mib("VmHWM") - before, psnr


def costs() -> str:
    """Return the table of what the likelihood costs, as Markdown."""
    lines = ["# What the likelihood of a sequence costs", "", f"`python {' '.join(sys.argv)}`", ""]
    lines += [f"{machine()}; one thread, other work beside it", ""]
    lines += ["| from | events | seconds of one core | us per event | MiB | PSNR over the target, dB |"]
    lines += ["|---" * 6 + "|"]
    for evidence in ("events", "both"):
        for times in (1, 2, 4):
            with get_context("spawn").Pool(1) as pool:
                count, seconds, mib, psnr = pool.apply(cost, (evidence, THRESHOLD / times))
            each = f"{1e6 * seconds / count:.0f} | {mib:.0f} | {psnr:.2f}"
            lines.append(f"| {evidence} | {count:,} | {seconds:.1f} | {each} |")
            print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


def known_sensors() -> None:
    """Print the table of what it is worth to know the sensor."""
    near, lights = load_setup(NEAR), SequenceLights()
    print("| mismatch | letter | pixel alone | without hot pixels | thresholds, too |\n|" + "---|" * 5)
    for sigma, seed in SENSORS:
        own = {
            "shot_noise_rate_hz": 0.02,
            "initial_phase": "random",
            "pattern_seed": seed,
            "threshold_sigma": sigma,
        }
        pixel = replace(near.pixel, **own, hot_pixel_fraction=0.003, hot_pixel_rate_hz=20.0)
        with TemporaryDirectory() as folder:
            listed = []
            for k, (light, seconds) in enumerate(LIGHTS):
                times, level = waveform(light, seconds)
                video = np.tile(level.astype(np.float32)[:, None, None], (1, *SENSOR))
                write_events(Path(folder) / f"{k}.npz", simulate_events(video, times, pixel, seed=100 + k))
                listed.append(LitFile(str(Path(folder) / f"{k}.npz"), light))
            fit = fit_known_light(Manifest(tuple(listed)), PixelFitSettings(("continuous",)))
        assert fit.pixel is not None and fit.maps is not None
        setup, law = replace(near, pixel=fit.pixel), fit.pixel.known_law(60.0)
        numbers = law.threshold_on, law.threshold_off, law.threshold_sigma, law.threshold_sigma
        on, off, error_on, error_off = (np.full(SENSOR, value) for value in numbers)
        unknown = PixelMaps(on, off, error_on, error_off, fit.maps.hot)
        for name in LETTERS:
            capture, cells = sequence(replace(near, pixel=pixel), lights, name), list[str]()
            for maps in (None, unknown, fit.maps):
                found = estimate_target(capture, setup, "events", lights=lights, maps=maps)
                truth = HandwritingGlyphs().target(f"writer03_{name}").rasterise(found.plane)
                psnr = -10 * float(np.log10(np.square(found.image - truth).mean()))
                covered = float(((truth >= found.low) & (truth <= found.high)).mean())
                bound = -10 * float(np.log10(found.expected_error))
                cells.append(f"{psnr:.2f} dB ({bound:.2f}), {100 * covered:.0f} %")
            print(f"| {sigma} | {name} | {' | '.join(cells)} |", flush=True)


def channels() -> None:
    """Print the table of frames beside events."""
    names = None
    for gain, ambient in ((0.8, 0.02), (0.8, 0.2), (0.2, 0.02), (0.2, 0.2), (0.2, 0.7), (0.05, 0.02)):
        rows = [compare(gain, ambient, character) for character in "RKG"]
        if names is None:
            names = list(rows[0])
            print("| gain | ambient | " + " | ".join(names) + " |\n|" + "---|" * (2 + len(names)))
        cells = " | ".join(f"{np.mean([row[name] for row in rows]):.2f}" for name in names)
        print(f"| {gain} | {ambient} | {cells} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--likelihood", action="store_true", help="what the likelihood of a sequence costs")
    parser.add_argument("--maps", action="store_true", help="what it is worth to know the sensor")
    parser.add_argument("--write", type=Path, help="file for that table")
    asked = parser.parse_args()
    if asked.maps:
        known_sensors()
    elif asked.likelihood:
        page = costs()
        if asked.write:
            asked.write.write_text(page)
    else:
        channels()
