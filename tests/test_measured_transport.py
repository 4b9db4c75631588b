"""A setup's own light transport: planned, rendered by our simulator, imported, simulated, inverted."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save

from evnlos.analysis import AnalysisSettings, identify
from evnlos.calibration.scan import (
    Patterns,
    ScanCamera,
    ScanImport,
    ScanPlan,
    choose_denoising,
    estimate_scan,
    import_scan,
    lit_cells,
    rehearse_scan,
    write_plan,
)
from evnlos.calibration.scan.folder import read_scan_info
from evnlos.calibration.scan.importer import fill_bad
from evnlos.calibration.scan.matrix import moved
from evnlos.calibration.scan.plan import spread_points
from evnlos.cameras import FrameCamera
from evnlos.cli import main
from evnlos.config import save_yaml
from evnlos.data import SensorSize, Simulation, simulate_object
from evnlos.errors import ConfigError, DataError, EvnlosError
from evnlos.inverse import Inversion, read_photograph
from evnlos.inverse.inversion import chosen_degree
from evnlos.optics import MatrixTransport
from evnlos.scene import HandwritingGlyphs, LineMotion, Scene, Target, TargetPlane
from evnlos.setups import MeasuredSetup, RadiometricSetup
from evnlos.setups.files import MEASUREMENT, About, Measurement, write_measurement
from evnlos.types import Plane

SHAPE = (24, 40)
PLANE = Plane(6, 12, 0.01)
SETUP = RadiometricSetup(roughness=0.1, cell_m=0.01, strip_m=(0.12, 0.06), ambient=0.03)
CAMERA = FrameCamera(bit_depth=16, black_level=1024, full_well_e=1e9, read_noise_e=0, prnu=0, dsnu_e=0)
SCALE = (65535 - 1024) / 65535  # white levels of the image to one of light


def setup_matrix(level: float) -> np.ndarray:
    """Return the setup's matrix [H W, cells] whose largest entry is `level` white levels."""
    matrix = SETUP.matrix(SHAPE, PLANE).numpy()
    return matrix * (level / matrix.max())


def with_read_noise(sigma: float) -> FrameCamera:
    return replace(CAMERA, read_noise_e=sigma * CAMERA.full_well_e)


def record(
    folder: Path, plan: ScanPlan, matrix: np.ndarray, camera: FrameCamera, shape=SHAPE, change=None
) -> None:
    """Write a plan and the images that `camera` takes of it; `change` may alter the light of a frame."""
    write_plan(plan, folder)
    save_yaml(replace(read_scan_info(folder), white_dn=65535), folder / "scan.yaml")
    rehearse_scan(folder, matrix, shape, camera, seed=7, change=change)


def small_plan(**changes) -> ScanPlan:
    return ScanPlan(**{"plane": (0.12, 0.06), "pitch": 0.01, "dark_every": 8, **changes})


@pytest.fixture(scope="module")
def noisy(tmp_path_factory) -> dict[str, Path]:
    """The same setup scanned by raster and by Hadamard patterns, with the same noise of a frame."""
    folders = {}
    for pattern in ("raster", "hadamard"):
        folders[pattern] = tmp_path_factory.mktemp("scan") / pattern
        record(folders[pattern], small_plan(pattern=pattern), setup_matrix(0.02), with_read_noise(0.004))
    return folders


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> tuple[Path, Path]:
    """A scan with little noise, and its transport."""
    folder = tmp_path_factory.mktemp("scan") / "clean"
    own = SETUP.transport(SHAPE).matrix.double().numpy() * SETUP.gain
    record(folder, small_plan(exposure_s=0.02), own, with_read_noise(2e-5))
    out = folder / "transport.safetensors"
    write_measurement(out, import_scan(folder).measurement)
    return folder, out


def rms(x) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(x, np.float64)))))


@pytest.mark.parametrize("cells", [1, 5, 72, 103])
def test_cells_are_told_apart(cells: int) -> None:
    patterns = Patterns("hadamard", cells)
    light = np.random.default_rng(0).random((cells, 4)).astype(np.float32)
    np.testing.assert_allclose(patterns.separate(patterns.lit.astype(np.float32) @ light), light, atol=2e-5)
    inverse = np.linalg.pinv(patterns.lit.astype(float))  # what `separate` is, slowly
    assert patterns.noise_factor == pytest.approx(np.linalg.norm(inverse, axis=1).mean(), rel=1e-9)
    assert patterns.offset_factor == pytest.approx(inverse.sum(axis=1).mean(), rel=1e-9)


def test_a_plan_says_what_to_show(tmp_path) -> None:
    plan = small_plan(pattern="hadamard", display=(640, 400), display_pitch=0.00025)
    files = write_plan(plan, tmp_path / "display")
    shown = np.asarray(Image.open(tmp_path / "display" / "patterns" / "00003.png"))
    info = read_scan_info(tmp_path / "display")
    lit = lit_cells(info, 3)
    assert shown.shape == (400, 640)
    assert len(files) == info.patterns.count + 2
    middle = shown[200 - 120 : 200 + 120, 320 - 240 : 320 + 240].reshape(6, 40, 12, 40)[:, 39, :, 0]
    np.testing.assert_array_equal(middle, lit)
    assert shown.mean() == pytest.approx(lit.mean() * 240 * 480 / shown.size)
    with pytest.raises(DataError, match="not an empty"):
        write_plan(plan, tmp_path / "display")
    write_plan(small_plan(center=(0.01, 0.0)), tmp_path / "led")
    with (tmp_path / "led" / "places.csv").open() as file:
        places = list(csv.DictReader(file))
    assert len(places) == 72
    assert (float(places[0]["x_m"]), float(places[0]["y_m"])) == pytest.approx((-0.045, -0.025))
    assert spread_points(PLANE, 5)[:3] == ((3, 6), (0, 0), (0, 11))
    assert len(set(spread_points(PLANE, 100))) == 72


def test_estimate_follows_the_camera() -> None:
    found = small_plan(exposure_s=0.1, overhead_s=0.4).estimate()
    assert found.seconds == pytest.approx(found.scan_frames * 0.5)
    dim = ScanCamera(full_level=0.1, read_noise_e=100.0)
    additive = estimate_scan(Patterns("raster", 787), dim, 0.01, 2, 1600, 26, 0.1)
    assert additive.other_noise < additive.noise / 8
    assert any("hadamard patterns would" in note for note in additive.notes)
    bright = ScanCamera(read_noise_e=0.0, bit_depth=16)  # a matte wall and shot noise: nothing to gain
    scan_frame = estimate_scan(Patterns("raster", 787), bright, 0.01, 2, 1600, 10**6, 0.1)
    assert scan_frame.other_noise == pytest.approx(np.sqrt(2) * scan_frame.noise, rel=0.01)
    for wrong in ({"pitch": 0.0}, {"display": (100, 100)}, {"repeats": 0}, {"plane": (0.001, 0.1)}):
        with pytest.raises(ConfigError):
            small_plan(**{"pattern": "raster", **wrong})


def test_import_recovers_the_matrix_within_its_noise(noisy) -> None:
    truth = setup_matrix(0.02) * SCALE
    errors = {}
    for pattern, folder in noisy.items():
        found = import_scan(folder, ScanImport(denoise=False))
        measured = found.measurement
        error = measured.matrix.numpy() - truth
        errors[pattern] = rms(error)
        assert rms(error) == pytest.approx(rms(measured.noise), rel=0.04)
        per_pixel = np.sqrt((error**2).mean(axis=1)) / measured.noise.numpy().ravel()
        assert 0.75 < np.median(per_pixel) < 1.25
        assert found.linearity is None or found.linearity == pytest.approx(1, abs=0.1)
        assert abs(found.agreement.gain) < 0.04
        assert measured.dark.numpy() == pytest.approx(1024 / 65535 + 0.02 * SCALE, abs=4e-3)
        own = small_plan(pattern=pattern, camera=ScanCamera(0.8, None, 1e9, 4e6, 16)).estimate()
        assert own.noise * own.cell_level * SCALE == pytest.approx(rms(error), rel=0.1)
    # Harwit and Sloane: (q + 1) / (2 sqrt q) times less noise where noise does not depend on the light.
    order = Patterns("hadamard", PLANE.height * PLANE.width).count
    assert errors["raster"] / errors["hadamard"] == pytest.approx((order + 1) / (2 * order**0.5), rel=0.08)


def test_denoising_helps_by_what_it_says_or_is_left_out(noisy, clean) -> None:
    truth = setup_matrix(0.02) * SCALE
    for folder in noisy.values():
        found = import_scan(folder)
        assert found.denoising.applied
        gained = rms(found.raw.numpy() - truth) / rms(found.measurement.matrix.numpy() - truth)
        assert gained == pytest.approx(found.denoising.gain, rel=0.2)
        assert gained > 1.3
        assert rms(found.measurement.matrix.numpy() - truth) == pytest.approx(
            rms(found.measurement.noise), rel=0.2
        )
    folder, _ = clean
    found = import_scan(folder)
    own = SETUP.transport(SHAPE).matrix.double().numpy() * SETUP.gain * SCALE
    assert rms(found.measurement.matrix.numpy() - own) <= 1.02 * rms(found.raw.numpy() - own)


def test_denoising_leaves_a_rough_matrix_alone() -> None:
    rng = np.random.default_rng(1)
    truth = rng.standard_normal((200, 48))  # nothing smooth, nothing of low rank
    first, second = (torch.from_numpy(truth + 0.3 * rng.standard_normal(truth.shape)) for _ in range(2))
    how = choose_denoising(first, second, Plane(6, 8, 0.01), (1, 1))
    assert not how.applied
    assert "tenth" in how.reason
    smooth = np.ones((200, 1)) @ np.ones((1, 48))
    first, second = (torch.from_numpy(smooth + 0.3 * rng.standard_normal(smooth.shape)) for _ in range(2))
    assert choose_denoising(first, second, Plane(6, 8, 0.01), (1, 1)).gain > 3


def test_one_repeat_is_not_denoised(tmp_path) -> None:
    record(
        tmp_path / "one", small_plan(repeats=1, pattern="hadamard"), setup_matrix(0.02), with_read_noise(0.002)
    )
    found = import_scan(tmp_path / "one")
    assert not found.denoising.applied
    assert any("one repeat" in warning for warning in found.warnings)
    error = found.measurement.matrix.numpy() - setup_matrix(0.02) * SCALE
    assert rms(error) == pytest.approx(rms(found.measurement.noise), rel=0.1)


@pytest.mark.parametrize("shape", [SHAPE, (17, 29)])
def test_adjoint_of_a_measured_transport(clean, shape) -> None:
    setup = MeasuredSetup(file=str(clean[1]))
    operator = setup.transport(shape)
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(3, *PLANE.shape, generator=draw, dtype=torch.float64)
    y = torch.randn(3, *shape, generator=draw, dtype=torch.float64)
    left, right = (operator(x) * y).sum(), (x * operator.adjoint(y)).sum()
    assert float(left) == pytest.approx(float(right), rel=1e-10)
    finer = Plane(12, 24, 0.005)
    split = setup.matrix(shape, finer).unflatten(1, (6, 2, 12, 2)).sum(dim=(2, 4)).flatten(1)
    torch.testing.assert_close(split, operator.matrix.double())
    with pytest.raises(ConfigError, match="scan a larger plane"):
        setup.matrix(shape, Plane(6, 20, 0.01))
    with pytest.raises(ConfigError, match="24 x 40 pixels"):
        setup.transport((25, 40))


def test_simulation_of_the_measured_setup_is_that_of_the_true_one(clean) -> None:
    _, file = clean
    measured = MeasuredSetup(file=str(file), gain=1 / SCALE, dark_frames=False, ambient=0.03)
    mask = np.zeros((8, 8), np.float32)
    mask[:, 2:4], mask[6:, 2:7] = 1, 1
    scene = Scene(Target("L", mask, 0.04), LineMotion((-0.03, 0.0)), 3.0)
    times = np.linspace(0, 3, 9)
    ours, true = (setup.resized(SHAPE).observe(scene).irradiance(times).numpy() for setup in (measured, SETUP))
    light = true - 0.03
    assert rms(ours - true) < 2e-3 * light.max()
    assert np.abs(ours - true).max() < 1e-2 * light.max()
    one, other = (measured.resized(SHAPE).observe(scene) for _ in range(2))
    assert one.transport.matrix is other.transport.matrix  # one for all objects
    config = Simulation(
        HandwritingGlyphs(characters="L", writers=1, target_plane=TargetPlane(size_m=0.04)),
        motion=LineMotion((-0.02, 0.0)),
        duration_s=2.0,
        positions=4,
        setup=replace(SETUP, sensor=SensorSize(*SHAPE)),
    )
    name = config.glyphs.objects()[0]
    samples = [
        simulate_object(replace(config, setup=setup.resized(SHAPE)), name)[0] for setup in (SETUP, measured)
    ]
    frames = [one.frame.astype(np.float32) for one in samples]
    assert rms(frames[0] - frames[1]) < 1 / 255  # 8 bits and noise of their own
    counts = [one.event_count.sum() for one in samples]
    assert counts[0] == pytest.approx(counts[1], rel=0.05)
    with pytest.raises(ConfigError, match="scan at least"):
        measured.resized(SHAPE).observe(Scene(scene.target, LineMotion(speed_m_s=0.1), 4.0))


def spoiled(folder: Path, source: Path, how: str) -> None:
    """Copy a scan and spoil it."""
    import shutil

    shutil.copytree(source, folder)
    table = folder / "frames.csv"
    lines = table.read_text().splitlines()
    lit = next(line for line in lines if line.startswith("5,1,"))
    file = folder / lit.rsplit(",", 1)[1]
    info = read_scan_info(folder)
    if how == "missing line":
        table.write_text("\n".join(line for line in lines if line != lit))
    elif how == "missing file":
        file.unlink()
    elif how == "twice":
        table.write_text("\n".join([*lines, lit]))
    elif how == "outside":
        table.write_text("\n".join([*lines[:2], "0,0,0.02,../../secret.png", *lines[3:]]))
    elif how == "link":
        file.unlink()
        (folder.parent / "secret.png").write_bytes(b"")
        file.symlink_to(folder.parent / "secret.png")
    elif how == "no dark":
        table.write_text("\n".join(line for line in lines if not line.startswith("dark,1")))
    elif how == "word":
        table.write_text("\n".join([*lines, "last,0,0.02,a.png"]))
    elif how == "too many":
        table.write_text("\n".join([*lines, "72,0,0.02,a.png"]))
    elif how == "saturated":
        image = np.asarray(Image.open(file)).copy()
        image[:4] = 65535
        Image.fromarray(image).save(file)
    elif how == "other size":
        Image.fromarray(np.zeros((5, 5), np.uint16)).save(file)
    elif how == "no image":
        file.write_bytes(b"PNG?")
    elif how == "swapped":
        other = next(line for line in lines if line.startswith("66,1,"))
        file.write_bytes((folder / other.rsplit(",", 1)[1]).read_bytes())
    elif how == "repeats":
        save_yaml(replace(info, repeats=3), folder / "scan.yaml")
    elif how == "unknown key":
        text = (folder / "scan.yaml").read_text()
        (folder / "scan.yaml").write_text(text.replace("exposure_s", "exposures_s"))
    elif how == "huge":
        text = (folder / "scan.yaml").read_text()
        (folder / "scan.yaml").write_text(text.replace("height: 6", "height: 1000000000"))


@pytest.mark.parametrize(
    ("how", "match"),
    [
        ("missing line", r"lists 143 images of patterns.*72 x 2 repeats = 144.*pattern 5 of repeat 1"),
        ("missing file", r"does not exist; .*frames.csv names it"),
        ("twice", "lists 1 images twice"),
        ("outside", "lies outside"),
        ("link", "lies outside"),
        ("no dark", "no dark frame of repeat 1"),
        ("word", "'last'.*write a number"),
        ("too many", "pattern 72; the scan has patterns 0 to 71"),
        ("saturated", r"16\.7 % of the pixels are saturated \(65535 DN\).*shorten exposure_s"),
        ("other size", "give images of one"),
        ("no image", "can't be read as an image"),
        ("swapped", r"pattern 5 differs between repeats 0 and 1 by \d+ %"),
        ("repeats", "pattern 0 of repeat 2"),
        ("unknown key", "perhaps you meant 'exposure_s'"),
        ("huge", "give 1 to 65536"),
    ],
)
def test_bad_folders_are_refused(clean, tmp_path, how, match) -> None:
    spoiled(tmp_path / "scan", clean[0], how)
    with pytest.raises(EvnlosError, match=match) as refused:
        import_scan(tmp_path / "scan")
    assert "\n" not in str(refused.value)


def test_a_moved_camera_a_faded_light_and_a_gamma_are_told(tmp_path) -> None:
    matrix, quiet = setup_matrix(0.5), with_read_noise(0.002)

    def moving(light, scan_frame):
        return np.roll(light, 1, axis=1) if scan_frame.repeat else light

    def fading(light, scan_frame):
        return light * (0.88 if scan_frame.repeat else 1)

    for name, change, match in (("moved", moving, "shifted by"), ("faded", fading, r"-1[23] % of light")):
        record(tmp_path / name, small_plan(), matrix, quiet, change=change)
        with pytest.raises(DataError, match=match):
            import_scan(tmp_path / name)
    plan = small_plan()
    record(tmp_path / "gamma", plan, matrix, quiet)
    for scan_frame in plan.scan_frames():
        path = tmp_path / "gamma" / scan_frame.file
        linear = np.asarray(Image.open(path)) / 65535
        Image.fromarray(np.round(65535 * linear ** (1 / 2.2)).astype(np.uint16)).save(path)
    with pytest.raises(DataError, match="gamma"):
        import_scan(tmp_path / "gamma")


def test_hot_pixels_are_left_out(tmp_path) -> None:
    plan = small_plan()
    record(tmp_path / "hot", plan, setup_matrix(0.5), with_read_noise(1e-4))
    for scan_frame in plan.scan_frames():
        path = tmp_path / "hot" / scan_frame.file
        image = np.asarray(Image.open(path)).copy()
        image[10, 20] = 65535
        Image.fromarray(image).save(path)
    measured = import_scan(tmp_path / "hot").measurement
    assert measured.bad.nonzero().tolist() == [[10, 20]]
    row = measured.matrix.unflatten(0, SHAPE)[10, 20].numpy()
    true = setup_matrix(0.5).reshape(*SHAPE, -1)[10, 20] * SCALE
    assert np.abs(row - true).max() < 0.15 * true.max()
    images = np.zeros((1, 3, 3), np.float32)
    assert fill_bad(images, np.ones(9, bool), (3, 3)) is images


def gaussian_wall(jacobian: np.ndarray, grow: float = 0.0) -> np.ndarray:
    """Return the matrix of a wall that shows a blob where the light is; `grow` widens it along x."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    columns = []
    for y in PLANE.y_m:
        for x in PLANE.x_m:
            du, dv = jacobian @ (x, y)
            width = 3.0 * (1 + grow * x)
            square = (u - SHAPE[1] / 2 - du) ** 2 + (v - SHAPE[0] / 2 - dv) ** 2
            columns.append(0.5 * np.exp(-square / (2 * width**2)).ravel())
    return np.stack(columns, axis=1)


def test_a_point_spread_function_stands_for_all_cells(tmp_path) -> None:
    jacobian = np.array([[150.0, 10.0], [-15.0, 140.0]])
    truth = gaussian_wall(jacobian)
    record(tmp_path / "psf", small_plan(pattern="points"), truth, with_read_noise(0.001))
    found = import_scan(tmp_path / "psf")
    assert found.psf.checked == 4
    np.testing.assert_allclose(np.array(found.psf.image_px_per_m), jacobian, atol=1.5)
    assert found.psf.error < 0.03 < found.psf.unmoved_error
    assert rms(found.measurement.matrix.numpy() - truth * SCALE) < 0.03 * rms(truth)
    assert found.measurement.about.magnification_px_m >= np.linalg.norm(jacobian, 2) * 0.99
    record(
        tmp_path / "grows", small_plan(pattern="points"), gaussian_wall(jacobian, 12.0), with_read_noise(0.001)
    )
    with pytest.raises(DataError, match="not shift-invariant; scan all cells"):
        import_scan(tmp_path / "grows")
    assert import_scan(tmp_path / "grows", ScanImport(psf_limit=2.0)).psf.error > 0.3
    record(tmp_path / "one", small_plan(pattern="points", points=1), truth, with_read_noise(0.001))
    with pytest.raises(DataError, match="state image_px_per_m"):
        import_scan(tmp_path / "one")
    info = read_scan_info(tmp_path / "one")
    save_yaml(
        replace(info, image_px_per_m=tuple(map(tuple, jacobian.tolist()))), tmp_path / "one" / "scan.yaml"
    )
    stated = import_scan(tmp_path / "one")
    assert rms(stated.measurement.matrix.numpy() - truth * SCALE) < 0.05 * rms(truth)
    assert any("was not checked" in warning for warning in stated.warnings)


def test_moved_is_a_shift() -> None:
    image = torch.rand(9, 13, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(moved(image, np.array([[2.0, 1.0]]))[0, 1:, 2:], image[:-1, :-2])


def small_measurement(**changes) -> Measurement:
    about = About(Plane(2, 3, 0.01), 4, 5, 100.0)
    parts = {"matrix": torch.rand(20, 6), "noise": torch.ones(4, 5), "dark": torch.zeros(4, 5)}
    return Measurement(about=about, **parts | changes)


def test_strange_files_are_refused(tmp_path) -> None:
    path = tmp_path / "t.safetensors"
    checksum = write_measurement(path, small_measurement())
    read = MEASUREMENT.read(path)
    assert read.about == small_measurement().about
    assert MeasuredSetup(file=str(path), checksum=checksum).source() == Plane(2, 3, 0.01)
    with pytest.raises(ConfigError, match="has the checksum"):
        MeasuredSetup(file=str(path), checksum="0" * 16).source()
    with pytest.raises(ConfigError, match="file is empty"):
        MeasuredSetup().source()
    with pytest.raises(ConfigError, match=r"ends in '\.h5'"):
        write_measurement(tmp_path / "t.h5", small_measurement())
    with pytest.raises(DataError, match="does not exist"):
        MEASUREMENT.read(tmp_path / "none.safetensors")
    for changes in (
        {"matrix": torch.rand(20, 7)},
        {"noise": -torch.ones(4, 5)},
        {"dark": torch.full((4, 5), torch.nan)},
    ):
        with pytest.raises(DataError):
            small_measurement(**changes)
    whole = path.read_bytes()
    refused = 0
    for number in range(60):
        draw = np.random.default_rng(number)
        spoiled = bytearray(whole[: draw.integers(1, len(whole))] if number % 3 == 0 else whole)
        for place in draw.integers(0, min(len(spoiled), 700), 8):
            spoiled[place] = draw.integers(256)
        path.write_bytes(bytes(spoiled))
        try:
            MEASUREMENT.read(path)
        except EvnlosError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > 50
    tensors = {"matrix": torch.rand(20, 6), "noise": torch.ones(4, 5), "dark": torch.zeros(4, 5)}
    about = {"plane": {"height": 10**9, "width": 10**9, "pitch_m": 0.01}, "height": 4, "width": 5}
    text = json.dumps({"format": "evnlos-transport-1", "about": about | {"magnification_px_m": 1.0}})
    path.write_bytes(save(tensors, metadata={"evnlos": text}))
    with pytest.raises(DataError, match="garbles its description"):
        MEASUREMENT.read(path)


def test_identify_tells_the_scan_s_own_noise(noisy, clean, tmp_path) -> None:
    settings = AnalysisSettings(target_size_m=0.06, cells=12, height=60, width=96, writers=1)
    found = identify(MeasuredSetup(file=str(clean[1]), gain=1 / SCALE), settings=settings)
    true = identify(replace(SETUP, strip_m=(0.12, 0.06)), settings=replace(settings, height=24, width=40))
    assert found.modes == pytest.approx(true.modes, abs=3)
    assert found.at_noise_std.psnr_db == pytest.approx(true.at_noise_std.psnr_db, abs=0.3)
    assert any("10.0 mm" in warning for warning in found.warnings)
    plain = tmp_path / "plain.safetensors"
    write_measurement(plain, import_scan(noisy["raster"], ScanImport(denoise=False)).measurement)
    rough = identify(MeasuredSetup(file=str(plain), gain=1 / SCALE), settings=settings)
    assert rough.modes > true.modes + 5  # noise looks like modes ...
    assert any("surely measured" in warning for warning in rough.warnings)  # ... and the report says so


def test_commands_from_plan_to_image(tmp_path, capsys) -> None:
    scan, out = tmp_path / "scan", tmp_path / "setup.safetensors"
    main(["scan", "plan", str(scan), "--plane", "0.12", "0.06", "--pattern", "hadamard", "--json"])
    planned = json.loads(capsys.readouterr().out)
    assert planned["scan_frames"] == 2 * (79 + 3) + 5
    import shutil

    shutil.rmtree(scan)
    matrix = setup_matrix(0.02)
    record(scan, small_plan(pattern="hadamard"), matrix, with_read_noise(2e-4))
    main(["scan", "import", str(scan), "--out", str(out), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert out.with_suffix(".png").stat().st_size > 10_000
    assert found["about"]["repeats"] == 2
    main(["identify", str(out), "--target-size-m", "0.06", "--cells", "8", "--writers", "1", "--json"])
    assert json.loads(capsys.readouterr().out)["modes_above_1e-2"] >= 5
    letter = np.zeros(PLANE.shape)
    letter[1:5, 3] = letter[4, 3:8] = 1
    for name, lit in (("wall", letter), ("dark", 0 * letter)):
        light = (matrix @ lit.ravel()).reshape(SHAPE) + 0.02
        frame = with_read_noise(2e-4).expose(light[None], seed=3)[0]
        Image.fromarray(frame).save(tmp_path / f"{name}.png")
    picture = tmp_path / "found.png"
    options = ["--dark", str(tmp_path / "dark.png"), "--setup", str(out), "--out", str(picture)]
    main(["invert", str(tmp_path / "wall.png"), *options, "--solver", "tikhonov", "--json"])
    assert json.loads(capsys.readouterr().out)["solutions"]["tikhonov"]["regularization"] > 0
    image = np.load(picture.with_suffix(".npz"))["tikhonov"][0]
    assert np.corrcoef(image.ravel(), letter.ravel())[0, 1] > 0.6
    with pytest.raises(SystemExit):
        main(["scan", "import", str(tmp_path / "none")])
    assert "does not exist" in capsys.readouterr().err


def test_whole_sequences_are_inverted_under_a_measured_setup(tiny_captures, tmp_path, capsys) -> None:
    shape = (48, 72)
    setup = RadiometricSetup(cell_m=0.01, gain=0.7, ambient=0.06, sensor=SensorSize(*shape))
    save_yaml(Simulation(setup=setup), tmp_path / "setup.yaml")
    matrix = setup.transport(shape).matrix * setup.gain
    flat = torch.full(shape, 0.06)
    measured = Measurement(matrix, torch.full(shape, 1e-4), flat, About(setup.source(), *shape, 400.0))
    write_measurement(tmp_path / "setup.safetensors", measured)
    pictures = []
    for name in ("setup.yaml", "setup.safetensors"):
        options = ["--cells", "8", "--solver", "tikhonov", "--out", str(tmp_path / f"{name}.png"), "--json"]
        main(["invert", str(tiny_captures[0]), "--setup", str(tmp_path / name), *options])
        rows = json.loads(capsys.readouterr().out)["rows"]
        found = np.load(tmp_path / f"{name}.npz")
        image = found[f"{tiny_captures[0].name}_tikhonov_{rows[0]['positions']}"]
        pictures.append((image, rows[0]["psnr_db"]))
    (ours, ours_db), (true, true_db) = pictures
    assert np.corrcoef(ours.ravel(), true.ravel())[0, 1] > 0.97
    assert ours_db == pytest.approx(true_db, abs=0.3)


def test_real_photograph_under_a_scanned_room(shared_data, tmp_path) -> None:
    """The published chair's room, scanned by our simulator with noise, inverts the real photograph."""
    photograph = read_photograph(shared_data / "periscopy" / "mushroom_chair.npz").binned(6)
    pitch, shape = 0.02, photograph.patches.shape
    plane = photograph.plane_of_screen(pitch)
    matrix = photograph.matrix(plane).numpy()
    matrix *= 0.8 / matrix.sum(axis=1).max()
    plan = ScanPlan((plane.width * pitch, plane.height * pitch), pitch, plane.center_m, "hadamard")
    record(tmp_path / "room", plan, matrix, with_read_noise(2e-3), shape)
    found = import_scan(tmp_path / "room")
    assert found.denoising.applied
    measured = found.measurement.matrix.double()
    operator = MatrixTransport(measured / torch.linalg.matrix_norm(measured, 2), plane, shape)
    wall = photograph.measurement()
    image = Inversion(operator, wall, chosen_degree(operator, wall)).solve("tikhonov").image
    seen = photograph.at_cells(image, plane).numpy()
    assert np.corrcoef(seen.ravel(), photograph.truth.numpy().ravel())[0, 1] > 0.65
