"""How exactly does a recording tell the hidden object's motion, against the path, the wall and the light?

    python benchmarks/tracking.py            # all, minutes
    python benchmarks/tracking.py curve      # the paths whose name starts so
    python benchmarks/tracking.py retreat    # from 28 cm to 32 cm, frames alone: error of the distance, mm rms
    python benchmarks/tracking.py coverage   # 40 random paths; also: coverage turn, coverage depth turn
    python benchmarks/tracking.py coverage camera  # the same with the frame camera's noise in uneven light
    python benchmarks/tracking.py coverage events  # the same by events alone; also: events depth turn 20
    python benchmarks/tracking.py captures SETUP CAPTURE...  # of captures whose motion is stated
    python benchmarks/tracking.py images 12  # so many sequences; motion known, found, ignored; also: 12 depth
    python benchmarks/tracking.py several 8  # so many pairs of crossing letters, each together and alone
    python benchmarks/tracking.py several 8 cover  # the second letter hides the first where it shines

Simulated sequences of a handwritten letter at 0.3 m, 48 x 32 pixels, 21 frames in 8 s. Error of the position:
root mean square about its mean, in stroke widths; of the speed: root mean square over the true speed's, per
cent; "frames": without events.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.analysis import track_psnr
from evnlos.cameras import EventCamera, EventPixel, FrameCamera
from evnlos.cli.invert_captures import linear_setup
from evnlos.data import CaptureInfo, read_capture
from evnlos.data.capture import Capture
from evnlos.data.capture_info import CameraInfo
from evnlos.errors import EvnlosError
from evnlos.inverse.operators import Gradient, normal_matrix
from evnlos.inverse.sequence_problem import strip_of
from evnlos.metrics import psnr
from evnlos.optics import FilmWall
from evnlos.scene import Film, HandwritingGlyphs, LineMotion, PathMotion, Scene, SeveralTargets
from evnlos.scene.handwriting import signed_distance
from evnlos.setups import RadiometricSetup
from evnlos.tracking import (
    Tracking,
    Tracks,
    fit_motion,
    plane_map,
    register,
    static_light,
    temporal_noise,
    track_capture,
    track_events,
    track_frames,
    track_several,
)
from evnlos.tracking.motion_fit import Fit, Lights
from evnlos.types import Events, Irradiance, Plane

SENSOR, SENSOR_SMALL, SECONDS, FRAMES = (32, 48), (24, 36), 8.0, 21
PIXEL = EventPixel(0.18, 0.21, 0.04, 40.0, 0.0, 0.3, 0.0)
CAMERA = FrameCamera(exposure_s=0.016, full_well_e=10_000.0, read_noise_e=48.0, prnu=0.02, dsnu_e=38.0)
SETUP = RadiometricSetup(
    cell_m=0.005, strip_m=(0.28, 0.16), gain=0.7, ambient=0.055, ambient_gradient=(0.1, 0.0)
)
T = np.linspace(0, SECONDS, 17)
PATHS = {
    "line": LineMotion(),
    "curve": PathMotion(
        tuple(T), tuple(zip(-0.08 * np.cos(np.pi * T / 8), 0.03 * np.sin(0.9 * T), strict=True))
    ),
    "accelerating": PathMotion((0.0, 4.0, 8.0), ((-0.08, 0.0), (-0.05, 0.0), (0.08, 0.0))),
    "start and stop": PathMotion((1.5, 3.0, 5.0, 6.5), ((-0.06, 0.0), (0.0, 0.0), (0.0, 0.0), (0.06, 0.0))),
}


def measured(path: str, setup: RadiometricSetup, camera: FrameCamera, pixel: EventPixel) -> str:
    target = HandwritingGlyphs().target("writer03_R")
    inside = signed_distance(target.mask, 40)
    # The mean distance to the edge of a stroke is a quarter of its width.
    stroke = -4 * float(inside[inside < 0].mean()) * target.size_m / len(target.mask)
    scene = Scene(target, PATHS[path], SECONDS)
    wall = setup.resized(SENSOR).observe(scene)
    times = np.linspace(0, SECONDS, FRAMES)
    frames = camera.capture(wall, times, seed=1) / np.float32(255)
    events = EventCamera(pixel).record(wall, 0.0, SECONDS, seed=2)
    columns = []
    for settings in (Tracking(), Tracking(events=False)):
        track = track_frames(frames, times, events, setup, settings)
        truth = scene.motion.position_m(track.time_s)
        error = track.position - truth
        error = np.sqrt(np.square(error - error.mean(axis=0)).sum(axis=1).mean())
        after, before = (scene.motion.position_m(track.time_s + dt) for dt in (1e-4, -1e-4))
        rate = np.hypot(*((after - before) / 2e-4).T)
        off = np.sqrt(np.mean((track.speed - rate) ** 2) / np.mean(rate**2))
        columns.append(f"{error / stroke:9.3f} {100 * off:7.1f}")
    return "   ".join(columns)


def retreating(setup: RadiometricSetup, light: float) -> str:
    """Return errors where the target retreats from the wall on its way; events do not take part."""
    target, motion = HandwritingGlyphs().target("writer03_R"), PATHS["line"]
    times, away_m = np.linspace(0, SECONDS, FRAMES), np.linspace(0.28, 0.32, FRAMES)
    cells, own = setup.source(), setup.transport(SENSOR).matrix
    scale = light * setup.gain * float(own.sum() / setup.matrix(SENSOR, cells, torch.float32).sum())
    fixed = replace(setup, target_offset_m=setup.offset_m())
    shown = torch.from_numpy(target.rasterise(cells, motion.position_m(times))).float().flatten(1)
    seen = [
        (replace(fixed, distance_m=d).matrix(SENSOR, cells, torch.float32) @ strip).reshape(SENSOR)
        for d, strip in zip(away_m.tolist(), shown, strict=True)
    ]
    noise = np.random.default_rng(4).standard_normal((FRAMES, *SENSOR))
    frames = 0.05 * light + scale * torch.stack(seen).numpy() + 4e-3 * noise
    track = track_frames(frames, times, None, setup, Tracking(depth=True))
    assert track.distance is not None
    error = np.log(track.distance.distance_m / away_m)
    where = track.position - motion.position_m(track.time_s)
    where = np.sqrt(np.square(where - where.mean(axis=0)).sum(axis=1).mean())
    off, stated = 300 * error.std(), 1e3 * track.distance.distance_sigma.mean()
    return f"distance off by {off:.2f} mm, stated {stated:.2f} mm; position off by {1e3 * where:.2f} mm"


def drawn_sequence(seed: int, words: list[str]) -> tuple[RadiometricSetup, Scene, NDArray, NDArray, NDArray]:
    """Return setup, scene, times [N], frames [N, h, w], and the true middles of the light [N, 2], metres."""
    setup = SETUP if "camera" in words else replace(SETUP, ambient_gradient=(0.0, 0.0))
    setup, glyphs, draw = setup.resized((24, 36)), HandwritingGlyphs(), np.random.default_rng(seed)
    times, knots = np.linspace(0.2, 7.8, FRAMES), tuple(np.linspace(0, SECONDS, 5).tolist())
    target = glyphs.target(f"writer{seed % 8:02d}_{'ABDEFHJLNPRSTUVXYZ'[seed % 18]}")
    points = tuple((x + 0.008 * draw.normal(), 0.01 * draw.normal()) for x in np.linspace(-0.06, 0.06, 5))
    away = np.exp(draw.uniform(-0.12, 0.12, 5) if "depth" in words else np.zeros(5))
    away *= setup.distance_m / np.exp(np.log(PathMotion(knots, points, tuple(away)).pose(times).z_m).mean())
    turn = tuple(draw.uniform(-35, 35, 5)) if "turn" in words else 0.0
    scene = Scene(target, PathMotion(knots, points, tuple(away) if "depth" in words else None, turn), SECONDS)
    wall = setup.observe(scene)
    if "camera" in words:
        frames = CAMERA.capture(wall, times, seed=seed) / np.float32(255)
    else:
        frames = wall.irradiance(times).numpy() + 4e-3 * draw.standard_normal((FRAMES, 24, 36))
    return setup, scene, times, frames, scene.light_m(times)


def images(sequences: int, depth: bool) -> None:
    """Print the PSNR of one image of a whole sequence, by what is known of its motion, and what it costs.

    The sequences of `coverage camera`, upright or turning, at the setup's distance or not; 32 x 32 cells by the
    solver of `track`, scored as the command does. "known": at the true poses; "found": as `track` writes it,
    blind; "path alone": at the true places, taken for upright at the setup's distance; "static": taken for at
    rest in the middle of its path; "mean letter": the mean image of the run's other letters. In brackets 95 %
    of the mean over sequences, by bootstrap. CPU: processor time of the fit with its image, and of the image.
    With `depth` the targets retreat, too; that takes minutes.
    """
    print("| motion | known | found | known less found | path alone | static | mean letter | CPU, s |")
    print("|" + "---|" * 8)
    for words in [["depth", "turn"]] if depth else [[], ["turn"]]:
        rows, truths = [], []
        for seed in range(sequences):
            setup, scene, times, frames, where = drawn_sequence(seed, [*words, "camera"])
            settings = Tracking(depth="depth" in words, turning="turn" in words)
            noise, ambient = temporal_noise(frames), static_light(frames)
            light = torch.from_numpy(frames - ambient)
            start_m = plane_map(setup, SENSOR_SMALL, 0.1)(register(frames, ambient, noise).place_px)
            begun = time.process_time()
            found = fit_motion(
                light,
                setup,
                start_m,
                noise,
                0.1,
                depth=settings.depth,
                turning=settings.turning,
                image_cells=32,
            )
            spent = time.process_time() - begun
            pose = scene.pose(times)
            turn = pose.rotation_rad - pose.rotation_rad.mean()
            away = np.log(pose.z_m / setup.distance_m) if settings.depth else np.zeros(FRAMES)
            known = np.column_stack([where, away, turn])
            ways = [
                known,
                known * [1, 1, 0, 0],
                np.broadcast_to(known.mean(axis=0) * [1, 1, 0, 0], known.shape),
            ]
            solved, costs = zip(*[solve_at(light, setup, one, noise) for one in ways], strict=True)
            db = [
                track_psnr(scene, image, 0.1, times) for image in (solved[0], found.target.numpy(), *solved[1:])
            ]
            rows.append([*db[:2], db[0] - db[1], *db[2:], spent, costs[0]])
            true = scene.target.turned(float(pose.rotation_rad.mean()))
            truths.append((scene, times, true.rasterise(Plane(32, 32, 0.1 / 32), -true.light_m)))
        total = np.sum([one for _, _, one in truths], axis=0)
        blind = [track_psnr(s, (total - one) / (len(truths) - 1), 0.1, t) for s, t, one in truths]
        table = np.array(rows)
        cells = [mean_95(one) for one in (*table.T[:5], np.array(blind))]
        cost = f"{table[:, 5].mean():.1f}, {table[:, 6].mean():.2f}"
        print(f"| {' and '.join(words) or 'in its plane'} | {' | '.join(cells)} | {cost} |", flush=True)


def solve_at(
    light: torch.Tensor, setup: RadiometricSetup, pose: NDArray, noise: float
) -> tuple[NDArray, float]:
    """Return the image [32, 32] that `track` would solve at poses [N, 4], and its processor time, seconds.

    Poses are x, y, ln(distance / own), turn.
    """
    plane = Plane(32, 32, 0.1 / 32)
    reach = np.concatenate([pose[:, :2] + 0.05, pose[:, :2] - 0.05])
    lights = Lights(setup, strip_of(reach, plane), SENSOR_SMALL, bool(pose[:, 2].any()), 2)
    prior = 3.0 * noise**2 * normal_matrix(Gradient("dark"), torch.zeros(plane.shape).double())
    begun = time.process_time()
    fit = Fit(plane, lights, np.array(pose), [0, 1], np.array([1.0, 1.0, 0.3, 0.025]))
    image = fit.step(lights.seen(light), prior)[0].numpy()
    return image, time.process_time() - begun


def mean_95(values: NDArray) -> str:
    """Return the mean and, in brackets, its 95 % interval by 2000 bootstrap draws."""
    draws = np.random.default_rng(0).choice(values, (2000, len(values))).mean(axis=1)
    low, high = np.quantile(draws, [0.025, 0.975])
    return f"{values.mean():.2f} ({low:.2f} to {high:.2f})"


def coverage(words: list[str], sequences: int = 40) -> None:
    """Print how often the truth lies in the 90 % intervals of x, y, distance and turn, and the largest errors.

    Each sequence has another letter, path and noise (0.4 % of white); 36 x 24 pixels, 21 frames in 8 s, no
    events. The mean distance is the setup's, as no recording tells it. "camera": noise and fixed pattern of the
    frame camera, another one each time, and ambient light that falls off by a tenth. "events": events alone, of
    72 x 48 pixels with the thresholds, their mismatch and the noise events of `PIXEL`.
    """
    within, most = [], []
    for seed in range(sequences):
        setup, scene, times, frames, where = drawn_sequence(seed, words)
        pose, target = scene.pose(times), scene.target
        settings = Tracking(depth="depth" in words, turning="turn" in words)
        if "events" in words:
            seen = replace(setup.resized((48, 72)), pixel=PIXEL)
            events = EventCamera(PIXEL).record(seen.observe(scene), 0.0, SECONDS, seed=seed)
            span = float(times[0]), float(times[-1])
            track = track_events(events, span, seen, replace(settings, target_size_m=0.1))
            where, times = scene.light_m(track.frame_time_s), track.frame_time_s
            at = np.searchsorted(track.time_s, times)
            pose = scene.pose(times)
        else:
            track, at = track_frames(frames, times, None, setup, settings), np.arange(FRAMES)
        off, stated = [1e3 * (track.position[at] - where)], [1e3 * track.position_sigma[at]]
        if track.distance is not None:
            off.append(100 * (track.distance.distance_m / pose.z_m - 1)[:, None])
            stated.append(100 * (track.distance.distance_sigma / track.distance.distance_m)[:, None])
        if track.turn is not None:
            degrees = np.degrees(pose.rotation_rad - pose.rotation_rad.mean())
            off.append((track.turn.rotation_deg - degrees)[:, None])
            stated.append(track.turn.rotation_sigma[:, None])
        error, sigma = np.concatenate(off, axis=1), np.concatenate(stated, axis=1)
        within.append((np.abs(error) < 1.645 * sigma).mean(axis=0))
        most.append(np.abs(error).max(axis=0))
        print(target.name, within[-1].round(2), most[-1].round(2), flush=True)
    print(
        "x, y, mm; distance, %; turn, degrees, where asked for: within the 90 % interval",
        np.mean(within, axis=0).round(3),
    )
    print(
        "largest error of a frame: median",
        np.median(most, axis=0).round(2),
        "most",
        np.max(most, axis=0).round(2),
    )


def on_captures(word: str, folders: list[str]) -> None:
    """Print how often the true places lie in the 90 % intervals of x and y, and the errors; without events."""
    setup, within = linear_setup(Path(word)), []
    print(f"{'capture':12}  within the 90 % interval x, y   error x, y, mm rms   stated x, y, mm")
    for folder in folders:
        capture = read_capture(folder, needs_events=False)
        assert capture.scene is not None
        track = track_capture(capture, setup, Tracking(events=False))
        error, sigma = track.position - capture.scene.light_m(track.time_s), track.position_sigma
        within.append((np.abs(error) < 1.645 * sigma).mean(axis=0))
        off, stated = 1e3 * np.sqrt(np.square(error).mean(axis=0)), 1e3 * sigma.mean(axis=0)
        print(f"{capture.name:12}  {within[-1].round(2)}  {off.round(3)}  {stated.round(3)}", flush=True)
    print("mean", np.mean(within, axis=0).round(3))


def still(setup: RadiometricSetup) -> FilmWall:
    """Return the wall of a setup behind which nothing is."""
    plane = Plane(2, 2, 0.04)
    dark = Film(np.zeros((1, 2, 2), np.float32), [0.0])
    return FilmWall(setup.operator(plane), dark, ambient=setup.ambient_light())


def assessed(found: Tracks, scenes: list[Scene], times: NDArray) -> list[tuple[float, float, NDArray]]:
    """Return of each letter the nearest path's error, mm rms, its image's PSNR, dB, and its true image."""
    side, rows = found.images.shape[-1], []
    for scene in scenes:
        mask, size = scene.target.mask.astype(float), scene.target.size_m
        at = ((np.arange(len(mask)) + 0.5) / len(mask) - 0.5) * size
        middle = np.array([mask.sum(0) @ at, mask.sum(1) @ at]) / mask.sum()
        truth = scene.target.rasterise(Plane(side, side, found.size_m / side), -middle)
        path = scene.motion.position_m(times) + middle
        off = [np.sqrt(np.square(one.position - path).sum(axis=1).mean()) for one in found.tracks]
        image = torch.from_numpy(found.images[int(np.argmin(off))]).clamp(0, 1).float()
        rows.append((1e3 * min(off), float(psnr(image, torch.from_numpy(truth))), truth))
    return rows


def several(pairs: int, cover: bool) -> None:
    """Print what two crossing letters cost each other: number found, error of the paths, PSNR of the images.

    Two letters at a time go opposite ways on bent paths that cross; 36 x 24 pixels, 21 frames in 8 s, the noise
    and fixed pattern of the camera above. "alone", in brackets, is the same letter on the same path with the
    same noise, through the same solver; "ln" is that of the evidence of 1, 2, ... objects over one less. The
    blind baseline is the mean image of the other letters.
    """
    setup, glyphs = SETUP.resized((24, 36)), HandwritingGlyphs(characters="HSU7ABDEFJLNPRTVXYZ")
    times, knots = np.linspace(0.2, 7.8, FRAMES), tuple(np.linspace(0, SECONDS, 5).tolist())
    settings, numbers, rows, truths = Tracking(targets="auto"), [], [], []

    def followed(wall: Irradiance, seed: int) -> Tracks:
        frames = CAMERA.capture(wall, times, seed=seed)
        empty = Events.empty(36, 24)
        times_us = np.round(1e6 * times).astype(np.int64)
        capture = Capture("several", CaptureInfo(CameraInfo(36, 24), None), empty, frames, times_us, None)
        return track_several(capture, setup, settings)

    for seed in range(pairs):
        draw = np.random.default_rng(seed)
        letters = draw.permutation(list("HSU7" if seed % 2 == 0 else "ABDEFJLNPRTVXYZ"))[:2]
        scenes = []
        for way, letter in zip((1, -1), letters, strict=True):
            height = draw.uniform(-0.03, 0.03, 2)
            points = [
                (way * 0.065 * s + 0.008 * draw.normal(), height @ [1 - s, 1 + s] / 2 + 0.006 * draw.normal())
                for s in np.linspace(-1, 1, 5)
            ]
            inside = [(float(np.clip(x, -0.095, 0.095)), float(np.clip(y, -0.038, 0.038))) for x, y in points]
            target = glyphs.target(f"writer{draw.integers(0, 8):02d}_{letter}")
            scenes.append(Scene(target, PathMotion(knots, tuple(inside)), SECONDS))
        both = followed(setup.observe_all(SeveralTargets(tuple(scenes), cover)), seed)
        alone = [followed(setup.observe(one), seed) for one in scenes]
        numbers += [(2, len(both.tracks)), *((1, len(one.tracks)) for one in alone)]
        gap = np.linalg.norm(
            scenes[0].motion.position_m(times) - scenes[1].motion.position_m(times), axis=1
        ).min()
        print(f"pair {seed}: {1e3 * gap:.0f} mm at the nearest, ln {np.round(both.gains).astype(int)}", end="")
        for k, (off, db, truth) in enumerate(assessed(both, scenes, times) if both.tracks else []):
            ((off_alone, db_alone, _),) = assessed(alone[k], [scenes[k]], times)
            rows.append((off, off_alone, db, db_alone))
            truths.append(truth)
            print(
                f"; {letters[k]} {off:.2f} mm (alone {off_alone:.2f}), {db:.2f} dB (alone {db_alone:.2f})",
                end="",
            )
        print(flush=True)
    for seed in range(pairs // 2):
        numbers.append((0, len(followed(still(setup), 1000 + seed).tracks)))
    for many in (0, 1, 2):
        found = [k for true, k in numbers if true == many]
        print(f"{many} there: {sum(k == many for k in found)} of {len(found)} times {many} found")
    off, off_alone, db, db_alone = np.array(rows).T
    loss = db_alone - db
    draws = np.random.default_rng(0).choice(loss, (2000, len(loss))).mean(axis=1)
    low, high = np.quantile(draws, [0.025, 0.975])
    print(f"path, mm rms: together {off.mean():.2f}, alone {off_alone.mean():.2f}")
    print(f"PSNR, dB: together {db.mean():.2f}, alone {db_alone.mean():.2f}")
    print(f"loss, dB: mean {loss.mean():.2f} (95 % {low:.2f} to {high:.2f}), most {loss.max():.2f}")
    total = np.sum(truths, axis=0)
    blind = [10 * np.log10(1 / np.mean(((total - one) / (len(truths) - 1) - one) ** 2)) for one in truths]
    print(f"blind: {np.mean(blind):.2f} dB")


def main() -> None:
    if sys.argv[1:2] == ["several"]:
        several(int((sys.argv[2:3] or ["8"])[0]), "cover" in sys.argv[2:])
        return
    if sys.argv[1:2] == ["images"]:
        images(int((sys.argv[2:3] or ["12"])[0]), "depth" in sys.argv[2:])
        return
    if sys.argv[1:2] == ["captures"]:
        on_captures(sys.argv[2], sys.argv[3:])
        return
    if sys.argv[1:2] == ["coverage"]:
        words = sys.argv[2:]
        coverage(words, int(next((one for one in words if one.isdigit()), "40")))
        return
    rows = [(name, "roughness 0.05", SETUP, CAMERA, PIXEL) for name in PATHS]
    rows += [("curve", f"roughness {r}", replace(SETUP, roughness=r), CAMERA, PIXEL) for r in (0.02, 0.1)]
    for factor in (0.1, 0.02):
        dim = replace(SETUP, gain=SETUP.gain * factor, ambient=SETUP.ambient * factor)
        rows.append(("curve", f"light x {factor}", dim, CAMERA, PIXEL))
    rows.append(("curve", "ambient 0.5", replace(SETUP, gain=0.4, ambient=0.5), CAMERA, PIXEL))
    chosen = sys.argv[1] if len(sys.argv) > 1 else ""
    print(f"{'path':15} {'':15}  position   speed %   frames: position   speed %")
    for path, what, setup, camera, pixel in rows:
        if path.startswith(chosen):
            try:
                print(f"{path:15} {what:15} {measured(path, setup, camera, pixel)}", flush=True)
            except EvnlosError as error:
                print(f"{path:15} {what:15} {error}", flush=True)
    ways = [(f"roughness {r}", replace(SETUP, roughness=r), 1.0) for r in (0.02, 0.05, 0.1)]
    for what, setup, light in [*ways, ("light x 0.3", SETUP, 0.3)]:
        if "retreat".startswith(chosen):
            print(f"{'retreat':15} {what:15} {retreating(setup, light)}", flush=True)


if __name__ == "__main__":
    main()
