"""A corner as a camera: closed forms of the light, the exact estimate, tracks, and no track without a mover."""

import json
import math
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from PIL import Image

from evnlos.cameras import FrameCamera
from evnlos.cameras.video import film
from evnlos.cameras.video_files import from_light, to_light, write_video
from evnlos.cli import main
from evnlos.errors import ConfigError, DataError
from evnlos.inverse import FloorSector, Penumbra, Prior, estimate_corner, noise_of, read_penumbra
from evnlos.optics import (
    TWO_WALKERS,
    CornerFloor,
    CornerScene,
    EdgeOperator,
    Occluder,
    Walker,
    edge_irradiance,
    floor_bearing,
    strip_response,
)
from evnlos.optics.view import visibility
from evnlos.tracking import BearingTracking, track_bearings


def hidden_rectangle(points, base, low, high, count=200):
    """Return the irradiance by a rectangle as a sum over small cells, each seen or not: slow and obvious."""
    s, z = ((np.arange(count) + 0.5) / count for _ in range(2))
    z = low + (high - low) * z
    place = base[0] + s[:, None] * (base[1] - base[0])
    along = (base[1] - base[0]) / np.linalg.norm(base[1] - base[0])
    normal = np.array([-along[1], along[0]])
    area = np.linalg.norm(base[1] - base[0]) * (high - low) / count**2
    total = np.zeros(len(points))
    for p, (px, py) in enumerate(points):
        way = place - (px, py)
        crossing = px + way[:, 0] * -py / way[:, 1]
        seen = crossing > 0 if py < 0 else np.ones(count, bool)
        r2 = (way**2).sum(axis=1)[:, None] + z**2
        total[p] = (seen[:, None] * np.abs(way @ normal)[:, None] * z / r2**2).sum() * area
    return total


def test_a_rectangle_behind_the_edge_is_the_sum_of_its_cells() -> None:
    draw = np.random.default_rng(1)
    for _ in range(6):
        points = np.column_stack([draw.uniform(-1, 1, 5), draw.uniform(-1, -0.1, 5)])
        base = np.column_stack([draw.uniform(-2, 2, 2), draw.uniform(0.5, 2, 2)])
        before = points.copy(), base.copy()
        exact = edge_irradiance(points, base, (0.3, 1.9))
        np.testing.assert_allclose(exact, hidden_rectangle(points, base, 0.3, 1.9), rtol=0.03, atol=2e-5)
        assert (points == before[0]).all() and (base == before[1]).all()


def test_a_rectangle_has_the_view_factor_of_textbooks() -> None:
    """Element on the floor under the corner of an upright rectangle: Howell's catalogue, configuration B-4."""
    for a, h, d in ((0.7, 1.3, 0.9), (2.0, 0.4, 0.3)):
        by_hand = (math.atan(a / d) - d / math.hypot(d, h) * math.atan(a / math.hypot(d, h))) / (2 * math.pi)
        found = edge_irradiance([[1e-12, -1e-9]], [[1e-12, d], [a, d]], (0.0, h))[0] / math.pi
        assert found == pytest.approx(by_hand, rel=1e-6)


def test_the_edge_hides_what_an_occluding_polygon_hides() -> None:
    """The same question put to the visibility of `optics.view`, with the wall as a polygon over the floor."""
    draw = np.random.default_rng(2)
    points = np.column_stack([draw.uniform(-1, 1, 40), draw.uniform(-1, -0.05, 40)])
    wall = Occluder(((-50.0, 0.0, 1e-6), (0.0, 0.0, 1e-6), (0.0, 0.0, 0.9), (-50.0, 0.0, 0.9)))
    x, y = draw.uniform(-2, 2, 30), draw.uniform(0.2, 2, 30)
    seen = visibility(*(torch.from_numpy(v) for v in (points, x, y)), 0.9, [wall]).numpy()
    bearing = np.arctan2(y, x)
    assert (seen == (bearing[None] < floor_bearing(points)[:, None])).all()


def test_the_penumbra_of_a_far_strip_is_a_ramp_and_the_far_operator_its_limit() -> None:
    theta = np.radians(np.arange(20.0, 150.0, 0.5))
    points = 0.01 * np.column_stack([-np.cos(theta), -np.sin(theta)])
    middle, width, far = math.radians(80.0), math.radians(6.0), 40.0
    ends = [middle + width / 2, middle - width / 2]
    base = far * np.column_stack([np.cos(ends), np.sin(ends)])
    light = edge_irradiance(points, base, (0.0, 400.0))
    edges = np.arange(20.0, 150.1, 0.5)
    ramp = strip_response(edges, 80.0, 6.0)
    np.testing.assert_allclose(light / light[-1], np.clip((np.degrees(theta) - 77.0) / 6.0, 0, 1), atol=2e-3)
    x = (np.abs(0.5 * (edges[1:] + edges[:-1]) - 80.0) < 3.0) / 6.0
    np.testing.assert_allclose(EdgeOperator(edges).forward(x), ramp, atol=1e-12)


def test_operator_and_adjoint_are_transposes_and_the_matrix_is_the_integral() -> None:
    draw = np.random.default_rng(3)
    edges = np.cumsum(draw.uniform(0.2, 2.0, 24))
    operator = EdgeOperator(edges)
    x, y = draw.standard_normal((2, 23))
    assert operator.forward(x) @ y == pytest.approx(x @ operator.adjoint(y), rel=1e-12)
    slow = np.zeros((23, 23))
    for b in range(23):
        theta = edges[b] + (np.arange(2000) + 0.5) / 2000 * (edges[b + 1] - edges[b])
        for j in range(23):
            slow[b, j] = np.clip(theta - edges[j], 0, edges[j + 1] - edges[j]).mean()
    np.testing.assert_allclose(operator.matrix(), slow, atol=1e-6)


def a_penumbra(change: np.ndarray, variance: np.ndarray, step_s: float = 0.1) -> Penumbra:
    steps, bins = change.shape
    return Penumbra(
        np.linspace(10.0, 10.0 + 3.0 * bins, bins + 1), step_s * np.arange(steps), change, variance,
        np.ones(steps), np.zeros((steps, 2)), 0.0, 1.0, 0.5, steps,
    )  # fmt: skip


def test_the_estimate_is_the_posterior_of_a_dense_gaussian() -> None:
    """All unknowns at once: the image, the steady part of each bin, gain and slope of each step."""
    draw = np.random.default_rng(4)
    steps, bins = 7, 9
    variance = draw.uniform(0.5, 2.0, bins) * 1e-4
    change = 1e-2 * draw.standard_normal((steps, bins))
    change[3] = np.nan  # a lost step
    penumbra = a_penumbra(change, variance)
    prior = Prior(2e-3, 8.0, 0.4)
    found = estimate_corner(penumbra, prior)
    middle = found.bearings_deg
    near = np.exp(-np.abs(middle[:, None] - middle) / prior.length_deg)
    late = np.exp(-np.abs(penumbra.times_s[:, None] - penumbra.times_s) / prior.memory_s)
    covariance = prior.deviation**2 * np.kron(late, near)
    matrix = EdgeOperator(penumbra.edges_deg).matrix()
    known = [t for t in range(steps) if t != 3]
    pick = np.eye(steps)[known]
    whole = np.kron(pick, matrix)  # [known bins, steps bins]
    steady = np.kron(np.ones((len(known), 1)), np.eye(bins))
    moving = np.kron(np.eye(len(known)), np.stack([np.ones(bins), middle - middle.mean()], axis=1))
    nuisance = np.concatenate([steady, moving], axis=1)
    noise = np.kron(np.eye(len(known)), np.diag(variance))
    broad = 1e6 * 1e-4  # flat to all intents
    cov_y = whole @ covariance @ whole.T + noise + broad * nuisance @ nuisance.T
    gain = covariance @ whole.T @ np.linalg.inv(cov_y)
    mean = gain @ change[known].ravel()
    deviation = np.sqrt(np.diag(covariance - gain @ whole @ covariance))
    np.testing.assert_allclose(found.mean.ravel(), mean, atol=2e-4 * prior.deviation)
    np.testing.assert_allclose(found.deviation.ravel(), deviation, rtol=1e-4)

    def evidence(cov: np.ndarray) -> float:
        data = change[known].ravel()
        return float(-0.5 * (data @ np.linalg.solve(cov, data) + np.linalg.slogdet(cov)[1]))

    null = noise + broad * nuisance @ nuisance.T
    assert found.evidence == pytest.approx(evidence(cov_y) - evidence(null), abs=1e-3)


def test_intervals_of_the_image_hold_for_images_of_the_prior_and_its_evidence_finds_it() -> None:
    draw = np.random.default_rng(5)
    steps, bins = 120, 30
    blank = a_penumbra(np.zeros((steps, bins)), np.full(bins, 4e-6))
    middle = 0.5 * (blank.edges_deg[1:] + blank.edges_deg[:-1])
    near = np.linalg.cholesky(np.exp(-np.abs(middle[:, None] - middle) / 8.0) + 1e-9 * np.eye(bins))
    keep = math.exp(-0.1 / 1.0)
    x = np.zeros((steps, bins))
    x[0] = near @ draw.standard_normal(bins)
    for t in range(1, steps):
        x[t] = keep * x[t - 1] + math.sqrt(1 - keep**2) * near @ draw.standard_normal(bins)
    x *= 3e-4
    y = EdgeOperator(blank.edges_deg).forward(x) + 2e-3 * draw.standard_normal(x.shape)
    found = estimate_corner(a_penumbra(y - y.mean(axis=0), np.full(bins, 4e-6)))
    assert 0.5 < found.prior.deviation / 3e-4 < 2 and 0.4 < found.prior.memory_s < 2.5
    assert 0.85 < (np.abs(found.mean - x) <= 1.645 * found.deviation).mean() < 0.94
    assert found.evidence > 50


def marks_of(floor: CornerFloor) -> FloorSector:
    from evnlos.data.frames import homography_from_points

    marks = floor.marks()
    tile = [(0, 0), (0.6, 0), (0.6, 0.6), (0, 0.6)]
    matrix = homography_from_points(np.array(marks["floor"]).reshape(4, 2), tile)
    edge, wall, end = (tuple(marks[name]) for name in ("edge", "wall", "end"))
    return FloorSector(edge, wall, end, tuple(tuple(row) for row in matrix.tolist()))


def shots(scene: CornerScene, seconds: float, seed: int, fps: float = 10.0) -> Iterator:
    floor = CornerFloor(scene)
    times = (np.arange(round(seconds * fps)) / fps).tolist()
    camera = FrameCamera(0.0, bit_depth=12)
    yield from zip(times, film(floor, camera, times, "srgb", seed), strict=True)


def read(scene: CornerScene, seconds: float = 14.0, seed: int = 1, **options) -> Penumbra:
    box, index, bearing = marks_of(CornerFloor(scene)).pixels((scene.size[1], scene.size[0]))
    left, top, right, bottom = box
    frames = ((t, to_light(shot[top:bottom, left:right], "srgb")) for t, shot in shots(scene, seconds, seed))
    return read_penumbra(frames, index, bearing, **options)


SMALL = CornerScene(size=(160, 120))


@pytest.fixture(scope="module")
def one() -> Penumbra:
    return read(SMALL)


def check_track(penumbra: Penumbra, scene: CornerScene, rms_deg: float) -> None:
    found = track_bearings(penumbra)
    (track,) = found.tracks
    error = track.bearing_deg - scene.bearings_deg(penumbra.times_s)[0]
    error, deviation = error[np.isfinite(error)], track.deviation_deg[np.isfinite(error)]
    assert len(error) > 0.85 * np.isfinite(scene.bearings_deg(penumbra.times_s)).sum()
    assert math.sqrt(np.mean(error**2)) < rms_deg
    assert (np.abs(error) <= 1.645 * deviation).mean() > 0.8
    low, high = track.interval_90
    shown = np.isfinite(low)
    assert (low[shown] < high[shown]).all() and track.score > track.threshold


def test_a_person_of_one_per_cent_in_eight_bits_is_tracked(one) -> None:
    check_track(one, SMALL, 2.0)


def test_without_texture_and_with_a_gain_that_drifts_the_track_stays() -> None:
    for scene in (
        CornerScene(size=(160, 120), texture=0.0),
        CornerScene(size=(160, 120), drift=0.05, seed=2),
    ):
        penumbra = read(scene, 9.0)
        check_track(penumbra, scene, 2.2)
        if scene.drift:
            truth = 1 + 0.05 * np.sin(2 * np.pi * penumbra.times_s / 7)
            told = penumbra.gain / penumbra.gain.mean()
            assert np.corrcoef(told, truth)[0, 1] > 0.99


def test_a_shaken_camera_is_measured() -> None:
    scene = CornerScene(size=(160, 120), shake_px=0.3, contrast=0.0)
    penumbra = read(scene, 8.0)
    floor = CornerFloor(scene)
    truth = np.array([floor.shake(t) for t in penumbra.times_s])
    both = [np.corrcoef(penumbra.shift_px[:, k], truth[:, k])[0, 1] for k in (0, 1)]
    assert min(both) > 0.9


def test_nobody_is_seen_where_nobody_moves() -> None:
    """White noise: few of ten videos have a track at five per cent; a simulated empty corner has none."""
    draw = np.random.default_rng(6)
    settings = BearingTracking(false_alarms=0.05)
    tracks = 0
    for k in range(10):
        change = 1e-3 * draw.standard_normal((40, 40))
        found = track_bearings(a_penumbra(change - change.mean(axis=0), np.full(40, 1e-6)), settings)
        tracks += len(found.tracks)
        if k == 0:
            assert 0 < found.limit < 1e-2 and found.next_score < 0
    assert tracks <= 2  # 0.5 are expected at most; three or more happen once in eighty
    assert not track_bearings(read(CornerScene(size=(160, 120), walkers=(), drift=0.03), 8.0)).tracks


def test_what_the_limit_says_would_be_seen_is_seen() -> None:
    draw = np.random.default_rng(7)
    variance = np.full(60, 1e-6)
    noise = 1e-3 * draw.standard_normal((60, 60))
    blank = a_penumbra(noise - noise.mean(axis=0), variance)
    limit = track_bearings(blank).limit
    way = np.linspace(40.0, 160.0, 60)
    for factor, count in ((2.0, 1), (0.2, 0)):
        change = noise + factor * limit * strip_response(blank.edges_deg, way, 6.0)
        assert len(track_bearings(a_penumbra(change - change.mean(axis=0), variance)).tracks) == count


def test_two_people_whose_bearings_cross_are_two_tracks() -> None:
    scene = CornerScene(size=(160, 120), walkers=TWO_WALKERS, contrast=0.05)
    penumbra = read(scene, 16.0)
    found = track_bearings(penumbra)
    assert len(found.tracks) == 2
    truth = scene.bearings_deg(penumbra.times_s)
    for track in found.tracks:
        off = np.nanmedian(np.abs(track.bearing_deg - truth), axis=1)
        assert off.min() < 3


def test_noise_is_measured_whatever_the_gain_and_also_where_it_has_a_memory() -> None:
    draw = np.random.default_rng(8)
    predicted = draw.uniform(0.5, 2.0, 80) * 1e-6
    white = np.sqrt(predicted) * draw.standard_normal((300, 80))
    gain = 0.02 * np.sin(np.arange(300) / 20)[:, None]
    before = white.copy()
    assert noise_of(white + gain, predicted)[1] == pytest.approx(1, abs=0.15)
    assert (white == before).all()
    slow = np.sqrt(predicted) * np.repeat(draw.standard_normal((30, 80)), 10, axis=0)
    assert noise_of(slow, predicted)[1] > 5


def test_frames_in_pieces_give_what_the_whole_gives() -> None:
    """Steps of several frames, read one by one from a generator, equal those of a slow sum over the stack."""
    stack = [(t, to_light(shot, "srgb")) for t, shot in shots(SMALL, 5.0, 3, fps=20.0)]
    sector = marks_of(CornerFloor(SMALL))
    (left, top, right, bottom), index, bearing = sector.pixels((120, 160))
    part = [(t, light[top:bottom, left:right]) for t, light in stack]
    streamed = read_penumbra(iter(part), index, bearing, step_s=0.1)
    listed = read_penumbra(part, index, bearing, step_s=0.1)
    np.testing.assert_array_equal(streamed.change, listed.change)
    assert streamed.frames == 100 and streamed.change.shape[0] == 50
    whole = (120, 160)
    moved = np.arange(whole[0] * whole[1]).reshape(whole)[top:bottom, left:right].ravel()[index]
    uncut = read_penumbra(stack, moved, bearing, step_s=0.1)
    np.testing.assert_allclose(uncut.change, listed.change, atol=1e-9)


def test_something_on_the_floor_itself_is_left_out() -> None:
    sector = marks_of(CornerFloor(SMALL))
    box, index, bearing = sector.pixels((120, 160))
    left, top, right, bottom = box

    def frames() -> Iterator:
        for t, shot in shots(SMALL, 8.0, 1):
            light = to_light(shot[top:bottom, left:right], "srgb").copy()
            if 7.0 <= t < 7.5:
                light[40:100, 40:100] *= 0.6  # a shadow
            yield t, light

    penumbra = read_penumbra(frames(), index, bearing)
    assert penumbra.disturbed == pytest.approx(5 / 80) and penumbra.lost.sum() == 5
    assert np.isfinite(estimate_corner(penumbra).mean).all()


@pytest.mark.parametrize(
    ("points", "told"),
    [
        (((300.0, 10.0), (10.0, 100.0), (20.0, 20.0)), "outside the image"),
        (((55.0, 55.0), (56.0, 55.0), (90.0, 20.0)), "give one 8 px off"),
        (((55.0, 55.0), (15.0, 105.0), (95.0, 5.0)), "10 to 179"),
    ],
)
def test_a_sector_that_cannot_be_is_refused(points, told) -> None:
    with pytest.raises(ConfigError, match=told):
        FloorSector(*points).pixels((120, 160))


def test_videos_that_cannot_serve_are_refused() -> None:
    index, bearing = np.arange(2000), np.linspace(2.0, 160.0, 2000)
    draw = np.random.default_rng(9)

    def video(level: float, frames: int = 40) -> list:
        return [(0.1 * k, np.clip(level + draw.normal(0, 1, (40, 50)), 0, 255)) for k in range(frames)]

    for frames, told in (
        (video(120, 9), "9 frames"),
        ([(t, 255.0 - 0.01 * light) for t, light in video(120)], "are bright|saturated"),
        (video(0.2), "brighter video"),
        ([(t, np.full((40, 50), 99.0)) for t, _ in video(1)], "all alike"),
    ):
        with pytest.raises(DataError, match=told):
            read_penumbra(frames, index, bearing)
    with pytest.raises(ConfigError, match="behind the wall"):
        Walker(((0.0, 1.0, 0.1), (1.0, 1.0, 2.0)))


def test_a_video_is_written_and_read_back_bit_for_bit(tmp_path) -> None:
    from evnlos.cameras.video import open_video

    draw = np.random.default_rng(10)
    frames = [draw.integers(0, 256, (24, 32), np.uint8) for _ in range(4)]
    for name, options in (("a.gif", {}), ("pictures", {"fps": 20.0})):
        write_video(tmp_path / name, iter(frames), 20.0)
        light = [light for _, light in open_video(tmp_path / name, **options)]
        assert (np.array(light) == np.array(frames)).all()
    codes = np.arange(256, dtype=np.uint8)[None]
    for tone in ("as-is", "srgb", "rec709"):
        assert (from_light(to_light(codes, tone), tone) == codes).all()
    video = open_video(tmp_path / "a.gif")
    part = next(light for _, light in video.part((3, 2, 11, 20)))
    assert (part == frames[0][2:20, 3:11]).all()


@pytest.mark.parametrize("fps", [1.0, 12.0, 15.0, 30.0, 45.0, 50.0])
def test_a_gif_keeps_the_times_of_its_frames(tmp_path, fps) -> None:
    from evnlos.cameras.video import open_video

    draw = np.random.default_rng(11)
    frames = [draw.integers(0, 256, (6, 8), np.uint8) for _ in range(90)]
    write_video(tmp_path / "a.gif", iter(frames), fps)
    times_s = [t for t, _ in open_video(tmp_path / "a.gif")]
    assert np.allclose(times_s, np.arange(90) / fps, atol=0.0051)
    with Image.open(tmp_path / "a.gif") as image:
        shown_ms = [image.info["duration"] for n in range(90) if image.seek(n) is None]
    assert abs(sum(shown_ms) - 90_000 / fps) <= 5 and min(shown_ms) >= 20


def test_a_gif_of_more_images_than_viewers_show_is_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"60 frames per second; a GIF has 50 at most: write \.mp4"):
        write_video(tmp_path / "a.gif", [np.zeros((6, 8), np.uint8)], 60.0)


def test_two_commands_show_somebody(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = "--simulate --scene.size 128 96 --scene.fps 8 --scene.seconds 8 --scene.contrast 0.05 --json"
    main(["corner", "door.gif", *words.split()])
    command = json.loads(capsys.readouterr().out)["command"].split()
    main([*command[1:], "--json"])
    found = json.loads(capsys.readouterr().out)
    assert len(found["tracks"]) == 1 and found["errors_deg"][0]["rms"] < 3
    assert found["in_words"][0].startswith("One moving person is seen behind the corner")
    assert (tmp_path / "corner" / "summary.json").is_file()
    with np.load(tmp_path / "corner" / "corner.npz") as arrays:
        assert arrays["picture"].shape == arrays["change"].shape
    with pytest.raises(SystemExit) as stop:
        main(["corner", "door.gif"])
    assert stop.value.code == 2 and "no --edge X Y, --wall X Y, --end X Y" in capsys.readouterr().err
