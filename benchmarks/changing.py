"""How much better is a film of a hidden plane that changes than the best image of something rigid?

    python benchmarks/changing.py [SEED...]    # of several seeds the mean, and the standard error of the gain
    python benchmarks/changing.py events       # from events, and from few frames with events between them
    python benchmarks/changing.py newest       # what `evnlos live --changing` shows: the newest image alone

Rough aluminium at 0.3 m, 32 x 48 pixels, a plane of 10 cm, 6 s at 10 frames per second, noise of the default
frame camera with its fixed pattern taken off, ambient light 0.05. The wall is rendered from cells of 1.6 mm
and solved on cells of 3.1 mm. PSNR of the film on the solver's cells, clipped to 0..1, mean over the frames,
dB.

Baselines, each with whatever the truth can give it: "blind" is the mean image of the other films; "static" one
Tikhonov image of the mean frame; "rigid" one image that moves along the true path of the film's light
(`SequenceProblem`); "frame by frame" Tikhonov of each frame. The three take the regularization weight that is
best by the truth. "limit" is the mean of the true film: nothing that rests does better. "film"
(`estimate_film`) sees the frames alone; "covered" is the share of its cells that lie within the stated 90 %
intervals; "film over rigid" is over the better one of "static" and "rigid".

`events`: seed 0, a pixel with thresholds of 0.2 (spread 0.03), 0.1 noise events per second. "few frames" is the
film of 2 frames per second, on a line between them; "few frames, events" the one estimate of both.

`newest`: seed 0, frames; the image of the instant, made of the newest second, of the newest 3 s, and of all so
far (`RunningFilm`), mean over the instants 1, 1.5, ... 5.5 s, beside the film of the whole at these instants.
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.cameras import EventCamera, EventPixel, FrameCamera
from evnlos.inverse import (
    FilmEstimate,
    FilmFrames,
    Gradient,
    Problem,
    SequenceOperator,
    SequenceProblem,
    estimate_event_film,
    estimate_film,
    record_of,
)
from evnlos.inverse.sequence_problem import matrix_of, strip_of
from evnlos.inverse.tikhonov import Spectrum
from evnlos.metrics import psnr
from evnlos.models import FilmSolver, RunningFilm
from evnlos.optics import FilmWall, MatrixTransport
from evnlos.scene import Film, closing_hand, drawing
from evnlos.setups import RadiometricSetup
from evnlos.types import Events, Plane

SIDE, SHAPE, SECONDS, RATE_HZ, AMBIENT = 64, (32, 48), 6.0, 10.0, 0.05
FINE, COARSE = Plane(SIDE, SIDE, 0.1 / SIDE), Plane(SIDE // 2, SIDE // 2, 0.2 / SIDE)
WEIGHTS = np.logspace(-9, 0, 37)


def hand() -> Film:
    """Return a hand that closes and opens every 3 s."""
    times = np.arange(0, SECONDS + 0.01, 0.02)
    return Film(np.stack([closing_hand(0.5 - 0.5 * np.cos(2 * np.pi * t / 3), SIDE) for t in times]), times)


def show() -> Film:
    """Return a screen that fades from one icon to the next within 0.3 s, every second."""
    icons = [
        drawing(kind, 0, 0, SIDE)
        for kind in ("icon", "person", "vehicle", "doodle", "icon", "person", "vehicle")
    ]
    times = [t for k in range(len(icons)) for t in (k - 0.15, k + 0.15)]
    images = [icon for k in range(len(icons)) for icon in (icons[k - 1] if k else icons[0], icons[k])]
    return Film(np.stack(images), times)


def parts() -> Film:
    """Return a disc that circles, a bar that grows and one that blinks: nothing common in their motions."""
    times = np.arange(0, SECONDS + 0.01, 0.02)
    y, x = (v[:, None] if k == 0 else v for k, v in enumerate([(np.arange(SIDE) + 0.5) / SIDE * 2 - 1] * 2))
    images = []
    for t in times:
        turn = 2 * np.pi * t / 4
        disc = (x + 0.5 * np.cos(turn)) ** 2 + (y + 0.5 * np.sin(turn)) ** 2 < 0.2**2
        bar = (np.abs(x - 0.85) < 0.1) & (y > 0.8 - 1.6 * (t / SECONDS))
        blink = (np.abs(y + 0.85) < 0.1) & (np.abs(x) < 0.5)
        images.append(np.maximum(disc | bar, blink * (0.5 + 0.5 * np.sin(2 * np.pi * t / 1.5))))
    return Film(np.stack(images).astype(np.float32), times)


FILMS: dict[str, Callable[[], Film]] = {"hand closes": hand, "screen fades": show, "parts move apart": parts}


def coarse(images: NDArray) -> torch.Tensor:
    """Return images [T, h, w] on the solver's cells."""
    return torch.nn.functional.avg_pool2d(torch.from_numpy(images).double()[:, None], 2)[:, 0]


def decibel(found: torch.Tensor, truth: torch.Tensor) -> float:
    return float(psnr(found.clamp(0, 1), truth).mean())


def path_of(truth: torch.Tensor) -> NDArray:
    """Return the middle of the light of each true frame, relative to the mean, [T, 2], metres."""
    light = truth.sum(dim=(1, 2)).clamp(min=1e-9)
    places = [
        (truth.sum(dim=1 + k) * torch.from_numpy(axis)).sum(dim=1) / light
        for k, axis in enumerate((COARSE.x_m, COARSE.y_m))
    ]
    found = torch.stack(places, dim=1).numpy()
    return found - found.mean(axis=0)


@lru_cache(maxsize=4)
def operator_of(setup: RadiometricSetup, plane: Plane) -> MatrixTransport:
    return matrix_of(setup.operator(plane))


def compare(name: str, seed: int, roughness: float) -> dict[str, float]:
    """Return the PSNR of each method for one film, dB, and the coverage of the stated intervals."""
    setup = RadiometricSetup(roughness=roughness, strip_m=(0.1, 0.1), ambient=AMBIENT).resized(SHAPE)
    film, camera = FILMS[name](), FrameCamera(exposure_s=0.016)
    wall = FilmWall(operator_of(setup, FINE), film, ambient=setup.ambient_light())
    times = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ + 0.02
    seen = camera.capture(wall, times, seed).astype(np.float64) / camera.white
    sensitivity, offset_e = camera.fixed_pattern(SHAPE, seed)
    frames = torch.from_numpy((seen - offset_e / camera.full_well_e) / sensitivity)
    light = frames - setup.ambient_light().double()
    truth = coarse(film.at(times))
    operator = operator_of(setup, COARSE)
    noise = camera.noise_variance(frames.mean(dim=0)).sqrt()

    def best(images: Callable[[float], torch.Tensor], scale: float) -> float:
        return max(decibel(images(scale * weight).expand_as(truth), truth) for weight in WEIGHTS.tolist())

    prior = Gradient("dark")
    still = Spectrum(Problem(operator, light.mean(dim=0)), prior)
    each = Spectrum(Problem(operator, light), prior)
    places = path_of(truth)
    strip = operator_of(setup, strip_of(places, COARSE))
    sight = SequenceOperator(strip, COARSE, places)
    problem = SequenceProblem(sight, 1.0)

    assert isinstance(strip.source, Plane)
    plane = strip.source

    def rigid(weight: float) -> torch.Tensor:
        return on_plane(sight.drawn(problem.tikhonov(light, weight).image), plane)

    others = [coarse(FILMS[other]().at(times)).mean(dim=0) for other in FILMS if other != name]
    found = estimate_film(operator, light, times, noise)
    low, high = (torch.from_numpy(bound) for bound in found.interval())
    return {
        "blind": decibel(torch.stack(others).mean(dim=0).expand_as(truth), truth),
        "static": best(still.image, still.scale),
        "rigid": best(rigid, problem.scale),
        "limit": decibel(truth.mean(dim=0).expand_as(truth), truth),
        "frame by frame": best(each.image, each.scale),
        "film": decibel(torch.from_numpy(found.mean), truth),
        "covered": float(((truth >= low) & (truth <= high)).double().mean()),
    }


PIXEL = EventPixel(0.2, 0.2, threshold_sigma=0.03, cutoff_hz=100, leak_rate_hz=0, shot_noise_rate_hz=0.1)
FEW = slice(0, None, 5)


def compare_events(name: str, seed: int, roughness: float) -> list[str]:
    """Return PSNR, dB, and coverage of films from frames, events, few frames, and few frames with events."""
    setup = RadiometricSetup(roughness=roughness, strip_m=(0.1, 0.1), ambient=AMBIENT).resized(SHAPE)
    wall = FilmWall(operator_of(setup, FINE), film := FILMS[name](), ambient=setup.ambient_light())
    times = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ + 0.02
    span = float(times[0]), float(times[-1])
    camera, law, still = (
        FrameCamera(exposure_s=0.016, prnu=0, dsnu_e=0),
        PIXEL.known_law(30.0),
        setup.ambient_light(),
    )
    events = EventCamera(PIXEL).record(wall, *span, seed=seed)
    frames = torch.from_numpy(camera.capture(wall, times, seed).astype(np.float64) / camera.white)
    noise, light = camera.noise_variance(frames.mean(dim=0)).sqrt(), frames - still.double()
    truth, operator, record = (
        coarse(film.at(times)),
        operator_of(setup, COARSE),
        record_of(events, law, span, 0.4),
    )

    def told(found: FilmEstimate) -> str:
        low, high = (torch.from_numpy(bound) for bound in found.interval())
        covered = float(((truth >= low) & (truth <= high)).double().mean())
        return f"{decibel(torch.from_numpy(found.mean), truth):.2f}, {100 * covered:.0f} %"

    few = estimate_film(operator, light[FEW], times[FEW], noise)
    between = [np.interp(times, times[FEW], cell) for cell in few.mean.reshape(len(few.mean), -1).T]
    beside = FilmFrames(operator, light[FEW], noise, few)
    seen = operator, still, record, law, times
    return [
        f"{len(events) / still.numel():.1f}",
        told(estimate_film(operator, light, times, noise)),
        told(estimate_event_film(*seen)),
        f"{decibel(torch.from_numpy(np.stack(between, axis=1)).reshape(truth.shape), truth):.2f}",
        told(estimate_event_film(*seen, frames=beside)),
    ]


def compare_newest(name: str, seed: int, roughness: float) -> list[float]:
    """Return PSNR, dB, of the newest image by the newest second, 3 s, and all, and of the whole film."""
    setup = RadiometricSetup(roughness=roughness, strip_m=(0.1, 0.1), ambient=AMBIENT).resized(SHAPE)
    wall = FilmWall(operator_of(setup, FINE), film := FILMS[name](), ambient=setup.ambient_light())
    times_us = np.arange(round(SECONDS * RATE_HZ)) * round(1e6 / RATE_HZ) + 20_000
    camera = FrameCamera(exposure_s=0.016, prnu=0, dsnu_e=0)
    frames = (camera.capture(wall, times_us * 1e-6, seed) / camera.white).astype(np.float32)
    truth, none, looked = coarse(film.at(times_us * 1e-6)), Events.empty(*SHAPE[::-1]), range(10, 60, 5)
    solver = FilmSolver(replace(setup, frame_camera=camera), COARSE)
    found: list[float] = []
    for newest_s in (1.0, 3.0, SECONDS):
        running, seen = RunningFilm(solver, "frames", newest_s), []
        for k, frame in enumerate(frames):
            running.add(none, int(times_us[k]), frame)
            if k in looked and (made := running.newest()):
                seen.append(decibel(torch.from_numpy(made[0])[None].double(), truth[k : k + 1]))
        found.append(float(np.mean(seen)))
    whole = solver.film(times_us * 1e-6, frames)
    return [*found, decibel(torch.from_numpy(whole.mean)[list(looked)], truth[list(looked)])]


def on_plane(strips: torch.Tensor, strip: Plane) -> torch.Tensor:
    """Return strips [T, h, w] on the solver's cells; the two differ by less than a cell."""
    y, x = (
        np.abs(a[:, None] - b).argmin(axis=0) for a, b in ((strip.y_m, COARSE.y_m), (strip.x_m, COARSE.x_m))
    )
    return strips[:, y][:, :, x]


def row(name: str, runs: list[dict[str, float]]) -> str:
    """Return the means over seeds; of several also the standard error of the gain over the best rigid image."""
    gains = np.array([run["film"] - max(run["static"], run["rigid"]) for run in runs])
    mean = {key: np.mean([run[key] for run in runs]) for key in runs[0]}
    cells = [f"{value:.2f}" for key, value in mean.items() if key != "covered"]
    error = f" +- {gains.std(ddof=1) / len(gains) ** 0.5:.2f}" if len(gains) > 1 else ""
    return f"| {name} | {' | '.join(cells)} | {gains.mean():+.2f}{error} | {100 * mean['covered']:.0f} % |"


if __name__ == "__main__":
    torch.set_num_threads(1)
    if sys.argv[1:] == ["events"]:
        print("| | events per pixel | frames | events | few frames | few frames, events |\n|" + "---|" * 6)
        for wall_roughness in (0.05, 0.02):
            for film_name in FILMS:
                cells = compare_events(film_name, 0, wall_roughness)
                print(f"| {film_name}, roughness {wall_roughness:g} | {' | '.join(cells)} |", flush=True)
        sys.exit()
    if sys.argv[1:] == ["newest"]:
        print("| | newest second | newest 3 s | all so far | film of the whole |\n|" + "---|" * 5)
        for wall_roughness in (0.05, 0.02):
            for film_name in FILMS:
                cells = [f"{one:.2f}" for one in compare_newest(film_name, 0, wall_roughness)]
                print(f"| {film_name}, roughness {wall_roughness:g} | {' | '.join(cells)} |", flush=True)
        sys.exit()
    print("| | blind | static | rigid | limit | frame by frame | film | film over rigid | covered |")
    print("|" + "---|" * 9)
    seeds = [int(word) for word in sys.argv[1:]] or [0]
    for wall_roughness in (0.05, 0.02):
        for film_name in FILMS:
            found = [compare(film_name, seed, wall_roughness) for seed in seeds]
            print(row(f"{film_name}, roughness {wall_roughness:g}", found), flush=True)
