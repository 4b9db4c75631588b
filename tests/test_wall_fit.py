"""The fit of walls of any kind, on captures rendered by an independent light path."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from evnlos.calibration import Calibration, CaptureSet, fit_setup, steadied, steps_table
from evnlos.calibration.captures import moved_along
from evnlos.calibration.wall_fit import (
    FREEDOMS,
    Unknowns,
    WallState,
    evenly_lit,
    grouped,
    normal_equations,
    start_at,
    wall_data,
)
from evnlos.calibration.wall_rest import correction_of, pixel_sensitivity, uneven_wall
from evnlos.calibration.wall_search import fit_wall, travelled
from evnlos.data import Capture, CaptureInfo
from evnlos.data.capture_info import CameraInfo, MotionInfo, TargetInfo
from evnlos.errors import ConfigError, DataError
from evnlos.lab import LitCells, Lobe, Optics, Reflection, cast, fill_throughput
from evnlos.optics.facets import Pose, SlopeTable
from evnlos.optics.radiometric import torchs_threads
from evnlos.report.sections import setup_section
from evnlos.scene import FontGlyphs
from evnlos.setups import RadiometricSetup
from evnlos.types import Events, Plane

SHAPE = (30, 48)
PLANE = Plane(32, 96, 0.0025)
KNOWN = RadiometricSetup(distance_m=0.3)
SHINING = 0.25  # brightness of a bar below the target


def operator(bent: float = 0.0, corner: float = 0.0) -> np.ndarray:
    """What pixels see of cells of a wall with two lobes, by code that shares nothing with the fit, [P, C].

    `corner` is the share by which the lens moves the corner's ray outwards.
    """
    optics = Optics(
        SHAPE, 0.62, math.radians(28), 0.0, 0.0, math.radians(31), (corner, 0), 0.0, 0.6, 0.15, (bent, 0.0), 4
    )
    rays = cast(optics)
    reflection = Reflection((Lobe("ggx", 0.6, 0.06, 0.06), Lobe("beckmann", 0.4, 0.08, 0.2)), matte=0.02)
    y, x = np.meshgrid(WIDE.y_m, WIDE.x_m, indexing="ij")
    cells = LitCells(x.ravel() - 0.165, y.ravel() + 0.004, np.full(x.size, WIDE.pitch_m**2), 0.3)
    out = np.zeros((SHAPE[0] * SHAPE[1], x.size), np.float32)
    with torchs_threads():
        fill_throughput(out, rays, cells, reflection.table(), np.zeros((0, 4)))
    return out


WIDE = Plane(56, 96, 0.0025)  # taller than the target: room for the bar


def capture_set_of(characters: str, matrix: np.ndarray, shining: float = 0.0, seed: int = 0) -> CaptureSet:
    """Captures of 11 frames: the target, a bar that moves along, ambient light, noise, 8 bits."""
    rng = np.random.default_rng(seed)
    glyphs = FontGlyphs(family="kalam", characters=characters)
    full = matrix @ np.ones(matrix.shape[1], np.float32)
    gain = 3.0 / float(full.max())
    captures = []
    bar = np.zeros(WIDE.shape, np.float32)
    for name in glyphs.objects():
        target = glyphs.target(name, 0)
        info = CaptureInfo(
            CameraInfo(SHAPE[1], SHAPE[0], "rendered", 2.0, 0.01),
            motion=MotionInfo((-0.05, 0.0), 0.02, (1.0, 0.0), 0),
            target=TargetInfo(name, "target.png", 0.08),
            setup={"distance_m": 0.3},
        )
        times = np.arange(11) * 500_000
        empty = Events.empty(SHAPE[1], SHAPE[0])
        capture = Capture(name, info, empty, np.zeros((11, *SHAPE), np.uint8), times, target)
        motion = capture.motion
        assert motion is not None
        places = motion.position_m(times * 1e-6)
        drawn = target.rasterise(WIDE, places)
        for k, (x, _) in enumerate(places):
            bar[:] = 0
            bar[46:52, np.abs(WIDE.x_m - x) < 0.02] = shining
            drawn[k] += bar
        light = gain * drawn.reshape(11, -1) @ matrix.T + 0.05
        noisy = np.clip(light + rng.normal(0, 0.004, light.shape), 0, 1)
        captures.append(replace(capture, frames=np.round(255 * noisy).astype(np.uint8).reshape(11, *SHAPE)))
    return CaptureSet(tuple(captures), 0.08)


@pytest.fixture(scope="module")
def rendered():
    matrix = operator(bent=0.8)
    gain = 3.0 / float((matrix @ np.ones(matrix.shape[1], np.float32)).max())
    return (
        capture_set_of("ABDEHLOTX", matrix, SHINING),
        capture_set_of("KRZ4", matrix, SHINING, seed=1),
        gain * matrix,
    )


@pytest.fixture(scope="module")
def fitted(rendered):
    return fit_wall(rendered[0], rendered[1], KNOWN, columns=48)


def test_the_operator_comes_back(rendered, fitted):
    # Two lobes, a bent wall, vignetting: what the fit says of any image is what the camera would see.
    truth = rendered[2].reshape(-1, *WIDE.shape)[:, 12:44].reshape(SHAPE[0] * SHAPE[1], -1)
    setup = fitted.optics.setup
    assert setup.source() == Plane(32, 72, 0.0025)
    found = setup.matrix(SHAPE, PLANE).numpy()
    reached = np.abs(PLANE.x_m) < 0.09  # where the targets were
    away = (found - truth).reshape(-1, 32, 96)[..., reached]
    assert np.linalg.norm(away) < 0.06 * np.linalg.norm(truth.reshape(-1, 32, 96)[..., reached])
    start = fitted.optics.before.matrix(SHAPE, PLANE).numpy()
    assert np.linalg.norm((start - truth).reshape(-1, 32, 96)[..., reached]) > 3 * np.linalg.norm(away)


def test_each_step_says_what_it_explains(fitted) -> None:
    steps = fitted.optics.setup.steps()
    assert steps and {name for name, (_, kept) in steps.items() if kept} == set(fitted.rest.kept)
    shares = {name: share for name, (share, _) in steps.items()}
    assert shares == pytest.approx(fitted.rest.explained, abs=1e-3)
    assert "Steps of the wall&#x27;s fit" in (page := setup_section("bent", fitted.optics.setup))
    assert f"light that travels along {100 * shares['light that travels along']:.1f} % (kept)" in page
    simulation = SimpleNamespace(setup=fitted.optics.setup)
    lines = steps_table(SimpleNamespace(simulation=simulation)).splitlines()  # type: ignore[arg-type]
    assert len(lines) == 1 + len(steps) and lines[-1].split()[-1] == "kept"


def test_what_moves_along_is_simulated(rendered, fitted):
    assert "light that travels along" in fitted.rest.kept
    places = np.stack([np.linspace(-0.04, 0.04, 9), np.zeros(9)], axis=1)
    bars = np.zeros((9, *WIDE.shape))
    for bar, (x, _) in zip(bars, places, strict=True):
        bar[46:52, np.abs(WIDE.x_m - x) < 0.02] = SHINING
    truth = bars.reshape(9, -1) @ rendered[2].T
    scene = rendered[0].scenes[0]
    found = fitted.optics.setup.observe(scene).light_along(places).flatten(1).numpy()
    # Light that stays the same at all places can't be told from ambient light.
    truth, found = truth - truth.mean(axis=0), found - found.mean(axis=0)
    assert np.linalg.norm(found - truth) < 0.5 * np.linalg.norm(truth)


def test_intervals_hold_the_truth(fitted):
    truth = {"camera_distance_m": 0.62, "camera_angle_deg": 28.0, "field_of_view_deg": 31.0, "distance_m": 0.3}
    for parameter, error in zip(fitted.optics.parameters, fitted.optics.error, strict=True):
        if parameter.name in truth:
            assert abs(getattr(fitted.optics.setup, parameter.name) - truth[parameter.name]) < 3 * error, (
                parameter.name
            )


def test_what_is_measured_holds_and_tells_the_distortion_of_the_lens():
    # Pose, slopes and distortion make up for each other: only where the camera's place is known is a lens seen.
    corner = 0.12
    matrix = operator(corner=corner)
    fit, held = capture_set_of("ABDEHLOTX", matrix), capture_set_of("KRZ4", matrix, seed=1)
    measured = {
        "camera_distance_m": (0.62, 0.003),
        "camera_angle_deg": (28.0, 0.3),
        "field_of_view_deg": (31.0, 0.2),
        "target_offset_m.0": (-0.165, 0.001),
        "target_offset_m.1": (0.004, 0.001),
    }
    found = fit_wall(fit, held, KNOWN, measured=measured, columns=36).optics
    assert abs(found.setup.camera_distance_m - 0.62) < 0.006
    assert abs(found.setup.camera_angle_deg - 28.0) < 0.6
    assert abs(found.setup.target_offset_m[0] + 0.165) < 0.002
    truth = corner / (1 + (SHAPE[0] / SHAPE[1]) ** 2)  # at the left and right border
    error = dict(zip([p.name for p in found.parameters], found.error, strict=True))["distortion"]
    assert 0.3 * truth < found.setup.distortion < truth + error


@pytest.mark.parametrize(
    ("measured", "words"),
    [
        ({"camera_distanc_m": (0.6, 0.01)}, "camera_distance_m"),
        ({"camera_angle_deg": (30.0, 0.0)}, "above 0"),
        ({"field_of_view_deg": (-3.0, 1.0)}, "above 0"),
        ({"distance_m": (math.nan, 1.0)}, "nan"),
    ],
)
def test_measurements_that_cannot_be_are_refused(measured, words):
    with pytest.raises(ConfigError, match=words):
        fit_setup([], Calibration(measured=measured))


@pytest.mark.parametrize(
    ("rows", "columns", "words"),
    [(1, -1, "the other way round; mirror"), (-1, 1, "upside down; "), (-1, -1, "turned by 180 degrees; ")],
)
def test_turned_frames_are_refused(rendered, rows: int, columns: int, words: str) -> None:
    fit, held, _ = rendered
    turned = [
        replace(
            one,
            captures=tuple(
                replace(c, frames=np.ascontiguousarray(c.frames[:, ::rows, ::columns])) for c in one.captures
            ),
        )
        for one in (fit, held)
    ]
    with pytest.raises(DataError, match=words):
        fit_wall(turned[0], turned[1], KNOWN, columns=24)


def test_frames_that_do_not_follow_the_targets_are_refused(rendered):
    fit, held, _ = rendered
    names = [c.target for c in fit.captures]
    noise = np.random.default_rng(5)
    wrong = tuple(
        replace(c, frames=noise.integers(20, 40, c.frames.shape).astype(np.uint8), target=t)
        for c, t in zip(fit.captures, names, strict=True)
    )
    with pytest.raises(DataError, match="explain"):
        fit_wall(CaptureSet(wrong, 0.08), held, KNOWN, columns=24)


def test_normal_equations_are_those_of_the_residual(rendered):
    data = wall_data(rendered[0], 16, travelled(rendered[0], rendered[1], 0.01), every=4)
    pose = Pose(target_offset_m=(-0.17, 0.0))
    state, left = start_at(data, pose)
    assert 0 < left < 0.5
    unknowns = Unknowns(FREEDOMS, state, pose)
    column, count, size = unknowns.column, unknowns.count, unknowns.size
    now = state.residual(data)
    gram, right = normal_equations(data, state, unknowns, now)

    def at(k: int, step: float) -> np.ndarray:
        """Residual after a step of one unknown."""
        if k < len(FREEDOMS):
            return replace(state, pose=FREEDOMS[k].moved(pose, step)).residual(data)
        k -= len(FREEDOMS)
        if k < count:
            log_density = state.table.log_density + step * (column == k)
            return replace(state, table=state.table._replace(log_density=log_density)).residual(data)
        k -= count
        if k < 5:
            return WallState(pose, state.table, step * np.eye(5)[k]).residual(data)
        matte = state.table.matte + step * unknowns.matte
        return replace(state, table=state.table._replace(matte=matte)).residual(data)

    middle = len(FREEDOMS) + column[state.table.nodes // 2, state.table.nodes // 2]
    chosen = [0, 5, middle, middle - 1, size - 4, size - 1]
    jac = np.stack([(now - at(k, 1e-4 if k >= 10 else FREEDOMS[k].step)).ravel() for k in chosen], axis=1)
    jac /= np.array([1e-4 if k >= 10 else FREEDOMS[k].step for k in chosen])
    size = np.linalg.norm(jac, axis=0)
    found, expected = gram[np.ix_(chosen, chosen)], jac.T @ jac
    assert np.abs((found - expected) / np.outer(size, size)).max() < 2e-3
    assert np.abs((right[chosen] - jac.T @ now.ravel()) / size).max() < 5e-3 * np.linalg.norm(now)


def test_light_that_all_captures_share_takes_no_part(rendered):
    data = wall_data(rendered[0], 16, PLANE, every=2)
    assert data.group.max() == 4  # five places, the same in all captures
    lit = data.seen + np.random.default_rng(6).normal(0, 1, (len(data.seen), 5))[:, data.group]
    np.testing.assert_allclose(data.shared_removed(lit), data.shared_removed(data.seen), atol=1e-12)


def test_places_are_shared_only_where_most_captures_share_them():
    places = np.tile(np.linspace(-0.05, 0.05, 6), 5)[:, None] * np.array([1.0, 0.0])
    capture = np.repeat(np.arange(5), 6)
    assert grouped(places, capture).max() == 5
    assert grouped(places + np.random.default_rng(0).uniform(0, 0.02, places.shape), capture).max() == 0
    assert grouped(places[:18], capture[:18]).max() == 0  # three captures tell too little


def test_texture_and_operator_errors_are_told_from_noise(rendered):
    data = wall_data(rendered[0], 16, PLANE, every=2)
    state = WallState(
        Pose(target_offset_m=(-0.17, 0.0)),
        SlopeTable.of_lobes(np.array([[0.1, 0.1]]), np.array([2e3]), scale=0.1),
    )
    rng = np.random.default_rng(7)
    light = state.light(data)
    texture = rng.normal(1, 0.05, len(light))
    noisy = replace(data, seen=light * texture[:, None] + rng.normal(0, 1e-4 * light.max(), light.shape))
    ratio, precision = pixel_sensitivity(noisy, light)
    bright = precision > 10
    assert bright.sum() > 30
    np.testing.assert_allclose(ratio[bright], texture[bright], atol=0.03)
    # An error of the operator that is linear in the image is found, and predicts other images.
    weights = np.sin(40 * np.add.outer(PLANE.y_m, PLANE.x_m)).ravel() * 1e-3
    pictures = [np.zeros((PLANE.height * PLANE.width, d.seen.shape[1])) for d in (data, data)]
    for n in range(data.seen.shape[1]):
        part = slice(*data.images.starts[n : n + 2])
        pictures[0][data.images.cell[part], n] = data.images.light[part]
    wrong = light + np.linspace(0, 1, len(light))[:, None] * (weights @ pictures[0])
    own = replace(data, seen=wrong)
    left, right, after = correction_of(own, light, own, light)
    before = ((own.shared_removed(wrong - light)) ** 2 * own.weight[:, None]).sum()
    assert after.sum() < 0.02 * before
    assert math.isfinite(float((left @ right).sum()))


def test_an_uneven_wall_is_found_from_what_it_shifts(rendered):
    """Tilts of some thousandths that change over the image, and texture, behind noise."""
    data, held = (wall_data(rendered[0], 32, PLANE, every=2, first=k) for k in (0, 1))
    state = WallState(
        Pose(target_offset_m=(-0.17, 0.0)),
        SlopeTable.of_lobes(np.array([[0.1, 0.1]]), np.array([2e3]), scale=0.1),
    )
    rng = np.random.default_rng(8)
    x, y = (np.interp(v, (v.min(), v.max()), (0, 2 * np.pi)) for v in (data.columns, data.rows))
    tilt, texture = 4e-3 * np.stack([np.sin(x), np.cos(y)], axis=1), 1 + 0.05 * np.sin(x + y)
    seen = [state.light(one, tilt=tilt) * texture[:, None] for one in (data, held)]
    noise = 2e-4 * seen[0].max()
    own, other = (
        replace(one, seen=light + rng.normal(0, noise, light.shape))
        for one, light in zip((data, held), seen, strict=True)
    )
    plain = [state.light(one) for one in (own, other)]
    shares, _, found, after, textured = uneven_wall(own, other, state, *plain)
    bright = plain[0].mean(axis=1) > np.median(plain[0].mean(axis=1))
    for part, true in zip(found.T, (texture - 1, *tilt.T), strict=True):
        assert np.corrcoef(part[bright], true[bright])[0, 1] > 0.8
        assert 0.6 < np.polyfit(true[bright], part[bright], 1)[0] < 1.1
    before = (other.shared_removed(other.seen - plain[1]) ** 2 * other.weight[:, None]).sum()
    assert after.sum() < 0.15 * before and after.sum() < 0.5 * textured.sum()
    assert after.sum() < 1.1 * min(squares.sum() for squares in shares.values())  # it is nearly linear


def test_a_setup_follows_its_files(fitted):
    setup = fitted.optics.setup
    assert Path(setup.file).is_file()
    assert setup.fitted().about.notes["kept"] == list(fitted.rest.kept)


def drifting(captures: CaptureSet, factors: list[float]) -> CaptureSet:
    """Captures whose ambient light, 0.05 of white in those of this file, is so many times as much."""
    own = [
        replace(one, frames=(one.frames.astype(int) + round(255 * 0.05 * (factor - 1))).astype(np.uint8))
        for one, factor in zip(captures.captures, factors, strict=True)
    ]
    return replace(captures, captures=tuple(own))


def test_ambient_light_that_changes_from_capture_to_capture_is_told_and_taken_off(rendered, fitted) -> None:
    """By whole digital numbers, 12.75 of which are the ambient light."""
    factors = (
        [1 + step / 12.75 for step in (-3, -2, -1, 0, 0, 0, 1, 2, 4)],
        [1 - 4 / 12.75, 1, 1, 1 + 3 / 12.75],
    )
    plain, setup = rendered[:2], fitted.optics.setup
    assert steadied(*plain, setup) is None
    moved = [drifting(one, own) for one, own in zip(plain, factors, strict=True)]
    found = steadied(moved[0], moved[1], setup)
    assert found is not None
    for one, own, before in zip(found, factors, plain, strict=True):
        assert {(each.target, each.ahead_m, each.speed) for each in one.own} == {(1.0, 0.0, 1.0)}
        assert [each.ambient for each in one.own] == pytest.approx(own, abs=0.03)
        away = one.frames().astype(float) - before.frames()
        assert abs(away.mean()) < 0.3 and np.abs(away).max() <= 1
        assert one.names == before.names


def brightened(captures: CaptureSet, factors: list[float]) -> CaptureSet:
    """Captures exposed for so many times as long."""
    own = [
        replace(one, frames=np.rint(one.frames * factor).clip(0, 255).astype(np.uint8))
        for one, factor in zip(captures.captures, factors, strict=True)
    ]
    return replace(captures, captures=tuple(own))


def test_exposures_that_differ_from_capture_to_capture_are_told_and_taken_off(rendered, fitted) -> None:
    factors = ([0.85, 0.9, 0.95, 1.0, 1.0, 1.0, 1.05, 1.1, 1.15], [0.88, 1.0, 1.0, 1.12])
    plain, setup = rendered[:2], fitted.optics.setup
    moved = [brightened(one, own) for one, own in zip(plain, factors, strict=True)]
    found = steadied(moved[0], moved[1], setup)
    assert found is not None
    for one, own, before in zip(found, factors, plain, strict=True):
        assert [each.target for each in one.own] == pytest.approx(own, abs=0.02)
        assert [each.ambient for each in one.own] == pytest.approx(own, abs=0.03)
        away = one.frames().astype(float) - before.frames()
        assert abs(away.mean()) < 0.5 and np.abs(away).max() <= 4
    # What is left of a second look adds up with the first.
    again = [brightened(one, [1.1] + [1.0] * (len(one.captures) - 1)) for one in found]
    twice = steadied(again[0], again[1], setup)
    assert twice is not None
    for one, own in zip(twice, factors, strict=True):
        assert one.own[0][:2] == pytest.approx((1.1 * own[0], 1.1 * own[0]), abs=0.03)


def misnoted(captures: CaptureSet, ahead_m: list[float], speeds: list[float]) -> CaptureSet:
    """The same frames with notes that place the targets behind where they are, as much too slow."""
    own = []
    for k, one in enumerate(captures.captures):
        motion, times = captures.motions[k], captures.times_s(k)
        noted = moved_along(motion, -ahead_m[k], 1 / speeds[k], (times[0] + times[-1]) / 2)
        info = replace(one.info.motion, start_m=noted.start_m, speed_m_s=noted.speed_m_s)
        own.append(replace(one, info=replace(one.info, motion=info)))
    return replace(captures, captures=tuple(own))


def test_places_and_speeds_that_are_not_as_noted_are_told_and_taken_off(rendered, fitted) -> None:
    """Targets started by hand, by a few millimetres beside the others'."""
    ahead_m = [3e-3, -2e-3, 0.0, 1e-3, -3e-3, 0.0, 2e-3, -1e-3, 0.0], [2e-3, -2e-3, 1e-3, -1e-3]
    speeds = [1.0, 1.03, 0.97, 1.0, 1.0, 0.98, 1.02, 1.0, 1.0], [1.0, 1.03, 0.97, 1.0]
    plain, setup = rendered[:2], fitted.optics.setup
    moved = [misnoted(*one) for one in zip(plain, ahead_m, speeds, strict=True)]
    found = steadied(moved[0], moved[1], setup)
    assert found is not None
    for one, ahead, speed, before, noted in zip(found, ahead_m, speeds, plain, moved, strict=True):
        assert [each.ahead_m for each in one.own] == pytest.approx(ahead, abs=6e-4)
        assert [each.speed for each in one.own] == pytest.approx(speed, abs=0.02)
        assert {(each.target, each.ambient_growth) for each in one.own} == {(1.0, 0.0)}
        away, off = ([m.position_m(before.times_s(0)) for m in which.motions] for which in (one, noted))
        true = np.array([m.position_m(before.times_s(0)) for m in before.motions])
        assert np.square(away - true).mean() < 0.1 * np.square(off - true).mean()
        assert (one.frames() == before.frames()).all()


def test_light_that_grows_in_the_course_of_a_capture_is_told_and_taken_off(rendered, fitted) -> None:
    """A cloud, a lamp that warms up: ambient light by a third, the target's by a tenth."""
    plain, setup = rendered[:2], fitted.optics.setup
    ambient, target, moved = ([0.3, -0.3] * 7)[:9], ([0.1, -0.1, 0.0] * 3)[:9], []
    for capture, cloud, warm in zip(plain[0].captures, ambient, target, strict=True):
        late = np.linspace(-0.5, 0.5, len(capture.frames))[:, None, None]
        lit = (capture.frames - 12.75) * (1 + warm * late) + 12.75 * (1 + cloud * late)
        moved.append(replace(capture, frames=np.rint(lit).clip(0, 255).astype(np.uint8)))
    found = steadied(replace(plain[0], captures=tuple(moved)), plain[1], setup)
    assert found is not None
    assert [own.ambient_growth for own in found[0].own] == pytest.approx(ambient, abs=0.05)
    assert [own.target_growth for own in found[0].own] == pytest.approx(target, abs=0.05)
    assert [own.ambient_growth for own in found[1].own] == pytest.approx([0.0] * 4, abs=0.05)
    away = found[0].frames().astype(float) - plain[0].frames()
    assert abs(away.mean()) < 0.3 and np.sqrt(np.mean(away**2)) < 1


def test_a_search_tells_how_bright_each_target_is_beside_the_wall(rendered, fitted) -> None:
    """Also with steps in exposure that are as large as the differences between targets."""
    factors = [0.85, 0.9, 0.95, 1.0, 1.0, 1.0, 1.05, 1.1, 1.15]
    moved = replace(brightened(rendered[0], factors), drifts=True)
    data = wall_data(moved, 48, PLANE)
    own = fitted.search.state.gains(data)[np.searchsorted(data.capture, np.arange(9))]
    assert own / own.mean() == pytest.approx(np.array(factors) / np.mean(factors), abs=0.02)
    assert (fitted.search.state.gains(replace(data, drifts=False)) == 1).all()
    levelled = evenly_lit(moved, fitted.search.state, PLANE)
    away = levelled.frames() / np.mean(factors) - rendered[0].frames()
    assert np.abs(away.mean(axis=(1, 2))).max() < 1
    # What the captures of a wall leave without it is far more.
    state = fitted.search.state
    fixed = np.square(state.residual(replace(data, drifts=False))).sum()
    assert np.square(state.residual(data)).sum() < 0.3 * fixed


def test_what_a_fit_sees_of_drifting_captures_is_what_it_sees_of_steady_ones(rendered) -> None:
    steady = replace(rendered[1], drifts=True)
    moved = drifting(steady, [1 - 3 / 12.75, 1, 1 + 2 / 12.75, 1 + 4 / 12.75])
    one, other = (wall_data(captures, 48, PLANE) for captures in (steady, moved))
    same = np.allclose(one.shared_removed(one.seen), other.shared_removed(other.seen), atol=1e-6)
    assert same and np.ptp(other.seen.mean(axis=0) - one.seen.mean(axis=0)) > 0.02
    assert not np.allclose(one.seen, replace(one, drifts=False).shared_removed(one.seen))
