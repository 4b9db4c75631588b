"""A film of a hidden plane that changes, against whole covariances; its intervals hold the truth."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from evnlos.cameras import EventCamera, EventPixel, FrameCamera
from evnlos.cli import main
from evnlos.data import read_capture
from evnlos.errors import ConfigError, DataError
from evnlos.events import write_events
from evnlos.inverse import (
    FilmFrames,
    FilmPrior,
    Gradient,
    NormalEquations,
    estimate_event_film,
    estimate_film,
    film_plane,
    record_of,
    smooth_modes,
)
from evnlos.inverse.event_film import FilmLight, FilmRows, film_equations
from evnlos.live.sources import SourceOptions, film_of, open_live
from evnlos.models import FilmSolver, RunningFilm, estimate_film_of
from evnlos.optics import FilmWall, MatrixTransport
from evnlos.scene import Film, closing_hand
from evnlos.setups import load_setup
from evnlos.types import Plane

PLANE = Plane(4, 5, 0.01)
TIMES = np.array([0.0, 0.1, 0.2, 0.35, 0.4, 0.6])


def draw(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


def covariances(prior: FilmPrior, operator: MatrixTransport, static: float, noise: float):
    """Return covariances of the film [T C, T C] and of the data, and the map between them.

    Slow reference: modes by singular values, nothing eliminated.
    """
    blank = torch.eye(20, dtype=torch.float64).reshape(20, 4, 5)
    smooth = Gradient("dark").adjoint(Gradient("dark")(blank)).reshape(20, 20).numpy()
    kernel = np.linalg.inv(smooth + (PLANE.pitch_m / prior.length_m) ** 2 * np.eye(20))
    root = np.linalg.cholesky(kernel / kernel.diagonal().mean())
    matrix = operator.matrix.numpy()
    basis = root @ np.linalg.svd(matrix @ root)[2].T  # [C, K]
    slope = Gradient("dark")(torch.from_numpy(basis.T.copy()).unflatten(1, (4, 5))).square().sum(dim=(1, 2, 3))
    wave = np.sqrt(slope.numpy() / (basis**2).sum(axis=0)) / PLANE.pitch_m
    apart = np.abs(TIMES[:, None] - TIMES)
    film = sum(
        np.kron(
            np.exp(-apart * prior.speed_m_s * wave[k]) + prior.resting**2, np.outer(basis[:, k], basis[:, k])
        )
        for k in range(20)
    )
    film = prior.deviation**2 * np.asarray(film)
    whole = np.kron(np.eye(len(TIMES)), matrix)
    offset = np.kron(np.ones((len(TIMES), len(TIMES))), np.eye(len(matrix)))
    data = whole @ film @ whole.T + noise**2 * (np.eye(len(whole)) + static**2 * offset)
    return film, data, whole


@pytest.mark.parametrize("static", [0.0, 2.0])
def test_the_film_is_the_posterior_of_whole_covariances(static: float) -> None:
    prior, noise = FilmPrior(0.4, 0.7, 0.03, 0.004), 0.05
    operator = MatrixTransport(torch.from_numpy(draw(24, 20) / 5), PLANE, (4, 6))
    frames = torch.from_numpy(draw(6, 4, 6, seed=1) * 0.2)
    kept = frames.clone()
    found = estimate_film(operator, frames, TIMES, torch.full((4, 6), noise), static=static, prior=prior)
    assert torch.equal(frames, kept)
    noise *= found.noise_factor
    film, data, whole = covariances(prior, operator, static, noise)
    gain = film @ whole.T @ np.linalg.inv(data)
    mean = gain @ frames.numpy().reshape(-1)
    variance = (film - gain @ whole @ film).diagonal()
    np.testing.assert_allclose(found.mean.reshape(-1), mean, atol=1e-8)
    np.testing.assert_allclose(found.deviation.reshape(-1) ** 2, variance, rtol=1e-6)
    empty = noise**2 * (np.eye(len(data)) + static**2 * np.kron(np.ones((6, 6)), np.eye(24)))
    y = frames.numpy().reshape(-1)

    def log_density(covariance: np.ndarray) -> float:
        return -0.5 * float(y @ np.linalg.solve(covariance, y) + np.linalg.slogdet(covariance)[1])

    assert found.evidence == pytest.approx(log_density(data) - log_density(empty), rel=1e-7)


def test_a_series_of_a_mode_is_that_of_its_covariance() -> None:
    gain, keep = (
        np.array([0.0, 0.5, 30.0]),
        np.exp(-np.array([0.0, 0.1, 0.3, 0.2, 0.1])[:, None] * [1.0, 2.0, 9.0]),
    )
    z = draw(5, 3) * 3
    found = smooth_modes(z, gain, keep, 1.5, 0.4)
    total = 0.0
    for k, g in enumerate(gain):
        steps = np.cumsum(-np.log(keep[:, k]))
        signal = np.exp(-np.abs(steps[:, None] - steps)) + 1.5**2
        data = g * g * signal + np.eye(5) + 0.4**2
        back = g * signal @ np.linalg.inv(data)
        np.testing.assert_allclose(found.mean[:, k], back @ z[:, k], atol=1e-11)
        np.testing.assert_allclose(found.variance[:, k], (signal - g * back @ signal).diagonal(), rtol=1e-9)
        total -= 0.5 * (z[:, k] @ np.linalg.solve(data, z[:, k]) + np.linalg.slogdet(2 * np.pi * data)[1])
    assert found.log_likelihood == pytest.approx(total, rel=1e-10)


def test_intervals_hold_films_of_the_prior_and_the_likelihood_finds_it() -> None:
    """Of films drawn from the prior, 90 % intervals hold 90 %, also where the frames choose the prior."""
    truth = FilmPrior(0.4, 0.7, 0.01, 0.02)
    operator = MatrixTransport(torch.from_numpy(draw(24, 20) / 5), PLANE, (4, 6))
    film, _, _ = covariances(truth, operator, 0.0, 0.05)
    root = np.linalg.cholesky(film + 1e-12 * np.eye(len(film)))
    held, errors = {"given": [], "found": []}, []
    for seed in range(20):
        x = (root @ draw(len(film), seed=seed)).reshape(6, 4, 5)
        frames = operator(torch.from_numpy(x)) + 0.05 * torch.from_numpy(draw(6, 4, 6, seed=seed + 100))
        for name, prior in (("given", truth), ("found", None)):
            estimate = estimate_film(operator, frames, TIMES, torch.full((4, 6), 0.05), static=0.0, prior=prior)
            low, high = estimate.interval()
            held[name].append(((x >= low) & (x <= high)).mean())
            if prior is None:
                errors.append(np.log(estimate.prior.deviation * np.hypot(1, estimate.prior.resting) / 0.488))
    assert np.mean(held["given"]) == pytest.approx(0.9, abs=0.03)
    assert np.mean(held["found"]) == pytest.approx(0.88, abs=0.05)
    assert abs(np.mean(errors)) < 0.3


def test_noise_that_is_stated_too_low_is_found() -> None:
    operator = MatrixTransport(torch.from_numpy(draw(60, 4)), Plane(2, 2, 0.01), (6, 10))
    frames = torch.from_numpy(0.3 * draw(40, 6, 10, seed=3))
    found = estimate_film(operator, frames, np.arange(40) / 10, torch.full((6, 10), 0.1))
    assert found.noise_factor == pytest.approx(3.0, rel=0.05)


def test_offsets_of_pixels_are_found_and_taken_for_no_light_of_the_plane() -> None:
    """Ambient light that nobody knows and a camera's pattern: twenty times the noise in all."""
    truth, shape = FilmPrior(0.4, 0.7, 0.01, 0.02), (8, 12)
    operator = MatrixTransport(torch.from_numpy(draw(96, 20) / 5), PLANE, shape)
    film, _, _ = covariances(truth, operator, 0.0, 0.05)
    root, noise = np.linalg.cholesky(film + 1e-12 * np.eye(len(film))), torch.full(shape, 0.05)
    errors, covered = [], []
    for seed in range(4):
        x = (root @ draw(len(film), seed=seed)).reshape(6, 4, 5)
        frames = operator(torch.from_numpy(x)) + 0.05 * torch.from_numpy(draw(6, *shape, seed=seed + 20))
        clean = estimate_film(operator, frames, TIMES, noise)
        shifted = frames + torch.from_numpy(draw(*shape, seed=seed + 40))
        found = estimate_film(operator, shifted, TIMES, noise)
        assert clean.static < 0.5 and found.static == pytest.approx(20, rel=0.3)
        fixed = estimate_film(operator, shifted, TIMES, noise, static=1.0)
        errors.append([float(np.square(one.mean - x).mean()) for one in (clean, found, fixed)])
        covered.append((np.abs(found.mean - x) < 1.645 * found.deviation).mean())
    small, middle, large = np.mean(errors, axis=0)
    assert small < middle < 0.5 * large and np.mean(covered) > 0.8


def test_a_film_is_known_at_every_instant_and_its_wall_is_linear() -> None:
    images = np.stack([closing_hand(0.0, 8), closing_hand(1.0, 8)])
    film = Film(images, [1.0, 3.0])
    np.testing.assert_allclose(film.at(1.5), 0.75 * images[0] + 0.25 * images[1], atol=1e-6)
    np.testing.assert_array_equal(film.at([0.0, 9.0]), images)
    operator = MatrixTransport(torch.from_numpy(np.abs(draw(12, 64))), Plane(8, 8, 0.01), (3, 4))
    wall = FilmWall(operator, film, ambient=0.25)
    light = operator(torch.from_numpy(film.at([1.5, 2.0]).astype(np.float64))) + 0.25
    torch.testing.assert_close(wall.irradiance([1.5, 2.0]).double(), light, rtol=1e-6, atol=0)
    assert wall.irradiance(2.0).shape == wall.shape == (3, 4)
    assert FrameCamera().capture(wall, [1.0, 2.0]).shape == (2, 3, 4)


def test_a_fist_is_smaller_than_a_hand() -> None:
    areas = [closing_hand(closed).mean() for closed in (0.0, 0.3, 0.6, 1.0)]
    assert areas == sorted(areas, reverse=True)
    assert areas[-1] < 0.75 * areas[0]


@pytest.mark.parametrize(
    ("images", "times"),
    [(np.zeros((2, 3, 3)), [0.0]), (np.zeros((2, 3, 3)), [1.0, 1.0]), (-np.ones((1, 3, 3)), [0.0])],
)
def test_films_that_are_none_are_refused(images: np.ndarray, times: list[float]) -> None:
    with pytest.raises(DataError):
        Film(images, times)


def test_what_does_not_fit_is_refused() -> None:
    operator = MatrixTransport(torch.from_numpy(draw(24, 20)), PLANE, (4, 6))
    frames, noise = torch.zeros(6, 4, 6), torch.ones(4, 6)
    with pytest.raises(DataError):
        estimate_film(operator, frames[:, :3], TIMES, noise)
    with pytest.raises(DataError):
        estimate_film(operator, frames, TIMES[::-1], noise)
    with pytest.raises(DataError):
        estimate_film(operator, frames, TIMES, 0 * noise)
    with pytest.raises(DataError):
        estimate_film(operator, torch.full_like(frames, float("nan")), TIMES, noise)
    with pytest.raises(ConfigError):
        estimate_film(operator, frames, TIMES, noise, static=-1.0)
    with pytest.raises(ConfigError):
        estimate_film(operator, frames, TIMES, noise, prior=FilmPrior(0.0, 1.0, 1.0, 1.0))
    with pytest.raises(ConfigError):
        closing_hand(1.5)
    with pytest.raises(DataError):
        FilmWall(operator, Film(np.zeros((1, 3, 3)), [0.0]))


@pytest.mark.parametrize("spread", [0.0, 0.1])
def test_sums_over_the_nodes_are_those_of_whole_rows(spread: float) -> None:
    """Slow reference: each row as a vector over all nodes and modes."""
    rng = np.random.default_rng(5)
    pixels, nodes, modes, count = 300, 6, 3, 900
    light = FilmLight.of(draw(pixels, modes), np.ones((pixels, 1)), np.arange(nodes) / 10, (20, 15))
    pixel, group = np.sort(rng.integers(0, pixels, count)), rng.integers(-1, 2, count)
    group = np.where(group < 0, -1, 2 * pixel + group)
    pixel, group = (column[np.lexsort((group, pixel))] for column in (pixel, group))
    node, slope = rng.integers(0, nodes - 1, (count, 2)), draw(count, 4, seed=1)
    weight, residual = rng.uniform(0.5, 2, count), draw(count, seed=2)
    found = film_equations(
        FilmRows(pixel, node, slope, weight, residual, group), light, np.full(2 * pixels, spread)
    )
    tau = np.zeros((count, nodes))
    for k, at in enumerate((node[:, 0], node[:, 0] + 1, node[:, 1], node[:, 1] + 1)):
        np.add.at(tau, (np.arange(count), at), slope[:, k])
    rows = (tau[:, :, None] * light.left[pixel][:, None]).reshape(count, -1)
    whole, own = NormalEquations.empty(nodes * modes), group >= 0
    whole.add(rows[~own], weight[~own], residual[~own], group[~own], 0.0)
    whole.add(rows[own], weight[own], residual[own], group[own], spread)
    assert found.information == pytest.approx(whole.information, abs=1e-4)
    assert found.score == pytest.approx(whole.score, abs=1e-9)


def test_events_tell_a_film_and_frames_beside_them_more() -> None:
    """Two lights that brighten and fade in turn."""
    plane, shape, times = Plane(5, 5, 0.02), (12, 16), np.linspace(0, 3, 31)
    y, x = (a.ravel() for a in np.meshgrid(plane.y_m, plane.x_m, indexing="ij"))
    rows, columns = (
        a.ravel() for a in np.meshgrid(*(np.linspace(-0.06, 0.06, n) for n in shape), indexing="ij")
    )
    far = np.square(rows[:, None] - y) + np.square(columns[:, None] - x)
    operator = MatrixTransport(torch.from_numpy(0.05 * np.exp(-far / 2 / 0.02**2)), plane, shape)
    strength = 0.5 + 0.5 * np.sin(2 * np.pi * times / 1.5)
    images = np.zeros((31, 5, 5), np.float32)
    images[:, :, :2], images[:, 1:4, 3:] = strength[:, None, None], 1 - strength[:, None, None]
    still = torch.full(shape, 0.1, dtype=torch.float64)
    wall = FilmWall(operator, Film(images, times), ambient=still)
    pixel = EventPixel(0.1, 0.1, threshold_sigma=0.01, cutoff_hz=0, leak_rate_hz=0, shot_noise_rate_hz=0.05)
    law = pixel.known_law(30.0)
    record = record_of(EventCamera(pixel).record(wall, 0.0, 3.0, seed=1), law, (0.0, 3.0), 0.4)
    camera = FrameCamera(prnu=0, dsnu_e=0)
    seen = torch.from_numpy(camera.capture(wall, times, 1) / camera.white) - still
    noise = camera.noise_variance(seen.mean(dim=0) + still).sqrt()
    alone = estimate_film(operator, seen[::3], times[::3], noise)
    frames = FilmFrames(operator, seen[::3], noise, alone)
    each = {
        "events": estimate_event_film(operator, still, record, law, times),
        "both": estimate_event_film(operator, still, record, law, times, frames=frames),
    }
    error = {name: float(np.square(one.mean - images).mean()) for name, one in each.items()}
    between = np.stack([np.interp(times, times[::3], one) for one in alone.mean.reshape(11, -1).T], axis=1)
    assert error["events"] < 0.35 * np.square(images - images.mean(axis=0)).mean()
    assert error["both"] < min(error["events"], float(np.square(between.reshape(images.shape) - images).mean()))
    for one in each.values():  # sharp edges, of which the prior knows nothing
        low, high = one.interval()
        assert ((images >= low) & (images <= high)).mean() > 0.75
    with pytest.raises(DataError):
        estimate_event_film(operator, still, record, law, times**2)
    with pytest.raises(DataError):
        estimate_event_film(operator, still[:5], record, law, times)
    with pytest.raises(DataError):
        estimate_event_film(operator, still, record, law, np.linspace(0, 3, 400))


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Film]:
    """Return the folder of setup.yaml and of a capture, `hand`, of a hand that closes, and the film."""
    tmp_path = tmp_path_factory.mktemp("changing")
    settings = {
        "kind": "radiometric",
        "strip_m": [0.1, 0.1],
        "roughness": 0.05,
        "sensor": {"height": 20, "width": 32},
    }
    settings["frame_camera"] = {"exposure_s": 0.016, "prnu": 0.0, "dsnu_e": 0.0}
    (tmp_path / "setup.yaml").write_text(yaml.safe_dump({"setup": settings}))
    setup = load_setup(tmp_path / "setup.yaml")
    film = Film(np.stack([closing_hand(closed, 16) for closed in (0.0, 1.0)]), [0.2, 1.0])
    plane = Plane(16, 16, 0.1 / 16)
    times = np.arange(12) / 10
    wall = FilmWall(setup.operator(plane), film, ambient=setup.ambient_light())
    folder = tmp_path / "hand"
    folder.mkdir()
    table = ["t_us,file"]
    for k, frame in enumerate(setup.frame_camera.capture(wall, times)):
        Image.fromarray(frame).save(folder / f"{k}.png")
        table.append(f"{round(1e6 * times[k])},{k}.png")
    (folder / "frames.csv").write_text("\n".join(table))
    write_events(folder / "events.npz", EventCamera(setup.pixel).record(wall, 0.0, 1.1, seed=1))
    about = {"camera": {"name": "simulated", "width": 32, "height": 20}, "events": "events.npz"}
    (folder / "capture.yaml").write_text(yaml.safe_dump(about))
    return tmp_path, film


def test_the_command_makes_a_film_of_a_capture(
    hand: tuple[Path, Film], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    home, film = hand
    words = ["invert", str(home / "hand"), "--setup", str(home / "setup.yaml"), "--changing", "0.1", "0.1"]
    main([*words, "--cells", "16", "--out", str(tmp_path / "film.png"), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["cells"] == [16, 16]
    assert 0.9 < found["noise_factor"] < 1.15
    arrays = np.load(tmp_path / "film.npz")
    truth = film.at(arrays["times_s"])
    rest = truth - truth.mean(axis=0)
    assert ((arrays["film"] - truth) ** 2).mean() < 0.04
    assert np.corrcoef((arrays["film"] - arrays["film"].mean(axis=0)).ravel(), rest.ravel())[0, 1] > 0.7
    assert found["animation"] == str(tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as animation:
        assert animation.size == (128, 128) and animation.n_frames == len(truth)
    inside = np.abs(arrays["film"] - truth) <= 1.645 * arrays["film_deviation"]
    assert inside.mean() > 0.85
    with pytest.raises(SystemExit):
        main([*words, "--track"])
    for source in ("events", "both"):
        out = ["--cells", "16", "--from", source, "--out", str(tmp_path / f"{source}.png"), "--json"]
        main([*words, *out])
        seen = json.loads(capsys.readouterr().out)
        assert (seen["from"], seen["images"], seen["evidence"]) == (source, 12, None)
        course = np.load(tmp_path / f"{source}.npz")["film"]
        changes = (course - course.mean(axis=0)).ravel()
        assert np.corrcoef(changes, rest.ravel())[0, 1] > 0.6


def test_the_newest_image_while_it_is_seen_is_the_last_of_the_film(hand: tuple[Path, Film]) -> None:
    home, _ = hand
    setup, capture = load_setup(home / "setup.yaml"), read_capture(home / "hand")
    plane, times = film_plane((0.1, 0.1), 16), capture.frame_times_us
    for evidence, newest_s, first in (("frames", 3.0, 0), ("frames", 0.45, 7), ("events", 3.0, 0)):
        running = RunningFilm(FilmSolver(setup, plane), evidence, newest_s)
        assert running.newest() is None
        for k, frame in enumerate(capture.frames):
            events = capture.events.between(-1 if k == 0 else int(times[k - 1]), int(times[k]))
            running.add(events, int(times[k]), frame / np.float32(capture.peak))
        found, chosen = running.newest(), slice(first, None)
        cut = replace(capture, frames=capture.frames[chosen], frame_times_us=times[chosen])
        expected = estimate_film_of(cut, setup, plane, evidence)
        assert found is not None and found[1] == times[-1]
        np.testing.assert_allclose(found[0], expected.mean[-1], atol=0.02 if evidence == "events" else 1e-4)
        running.forget()
        assert running.newest() is None
    with pytest.raises(ConfigError, match=r"newest_s is 0.1; give 0\.3 seconds"):
        RunningFilm(FilmSolver(setup, plane), "frames", 0.1)


def test_a_live_run_shows_what_the_plane_shows_now(
    hand: tuple[Path, Film], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    home, film = hand
    words = ["live", str(home / "hand"), "--setup", str(home / "setup.yaml"), "--headless", "--json"]
    changing = ["--changing", "0.1", "0.1", "--cells", "16"]
    main([*words, *changing, "--speed", "0.5", "--out", str(tmp_path / "out")])
    shown = json.loads(capsys.readouterr().out)
    assert shown["weights"] is None and shown["modality"] == "no network" and shown["images"] > 20
    assert shown["beside"]["title"] == "plane that changes" and shown["beside"]["images"] >= 1
    assert shown["latency_ms"]["network"]["max"] < 5 and "film" in str(shown["verdict"])
    beside = film_of(load_setup(home / "setup.yaml"), film_plane((0.1, 0.1), 16), open_live(str(home / "hand")))
    beside.begin()
    for part in open_live(str(home / "hand"), SourceOptions(speed=100)).chunks(lambda: False):
        beside.add([part])
    beside.finish()
    beside.close()
    picture = beside.newest
    assert picture.t_us == 1_100_000 and picture.image.shape == (16, 16)
    assert np.square(picture.image - film.at(1.1)).mean() < 0.05
    for wrong, said in (
        (words, "give --changing WIDTH HEIGHT and --setup together"),
        (
            [*words, *changing[:3], "--cells", "1"],
            "0.1 x 0.1 m of 1 cells; give sides above 0 and 2 cells or more",
        ),
        ([*words, *changing, "--newest", "0"], "newest_s is 0; give 0.3 seconds or more"),
    ):
        with pytest.raises(SystemExit):
            main([*wrong, "--out", str(tmp_path / "none")])
        assert said in capsys.readouterr().err
