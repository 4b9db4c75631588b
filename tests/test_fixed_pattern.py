"""A camera's fixed pattern: found in noise, taken from frames, kept in a file that cannot lie."""

import numpy as np
import pytest
from safetensors.numpy import save_file

from evnlos.calibration.frame_model import most_probable_pattern
from evnlos.data import (
    FixedPattern,
    Sampling,
    import_captures,
    load_pattern,
    open_dataset,
    read_shard,
    save_pattern,
)
from evnlos.errors import DataError

SIZE = (12, 40, 60)


@pytest.fixture
def pattern() -> FixedPattern:
    draw = np.random.default_rng(1)
    sensitivity = 1 + 0.02 * draw.standard_normal(SIZE[1:])
    return FixedPattern(sensitivity.astype(np.float32), (0.01 * draw.random(SIZE[1:])).astype(np.float32))


def test_correction_undoes_the_camera(pattern) -> None:
    light = np.random.default_rng(0).random(SIZE)
    seen = 255 * (pattern.sensitivity * light + pattern.offset)
    np.testing.assert_allclose(pattern.correct(seen, 255), light, atol=1e-5)


def test_a_dead_pixel_does_not_become_infinite(pattern) -> None:
    pattern.sensitivity[0, 0] = 0.0
    assert np.isfinite(pattern.correct(np.ones(SIZE), 1.0)).all()


def test_the_most_probable_pattern_is_as_good_as_it_says() -> None:
    draw = np.random.default_rng(3)
    shape, temporal, prnu, dsnu = (300, 30, 40), 3.0, 0.02, 2.0
    # The light swings on the right side of the sensor only: on the left nothing tells g from h.
    signal = 60 + 80 * draw.random(shape) * np.linspace(0, 1, shape[2])
    g, h = prnu * draw.standard_normal(shape[1:]), dsnu * draw.standard_normal(shape[1:])
    residual = g * signal + h + temporal * draw.standard_normal(shape)
    found, (left_g, left_h) = most_probable_pattern(residual, signal, temporal, prnu, dsnu, 255.0)
    error_g, error_h = found.sensitivity - 1 - g, found.offset * 255 - h
    swing = signal.var(axis=0)
    assert np.sqrt(np.average(error_g**2, weights=swing)) == pytest.approx(left_g, rel=0.1)
    assert (error_g * signal.mean(axis=0) + error_h).std() == pytest.approx(left_h, rel=0.1)
    assert left_g < prnu / 2 and left_h < dsnu / 5


def test_no_spread_leaves_nothing_to_correct() -> None:
    noise = np.random.default_rng(0).standard_normal((20, 6, 7))
    found, left = most_probable_pattern(noise, np.full((20, 6, 7), 50.0), 1.0, 0.0, 0.0, 255.0)
    np.testing.assert_allclose(found.sensitivity, 1, atol=1e-6)
    np.testing.assert_allclose(found.offset, 0, atol=1e-6)
    assert left == (0.0, 0.0)


def test_a_file_gives_back_the_same_pattern(pattern, tmp_path) -> None:
    save_pattern(pattern, tmp_path / "pattern.safetensors")
    again = load_pattern(tmp_path)
    np.testing.assert_array_equal(again.sensitivity, pattern.sensitivity)
    assert again.digest == pattern.digest


def test_wrong_files_and_frames_are_named(pattern, tmp_path) -> None:
    with pytest.raises(DataError, match="evnlos calibrate"):
        load_pattern(tmp_path)
    path = tmp_path / "pattern.safetensors"
    path.write_bytes(b"nonsense")
    with pytest.raises(DataError, match="no fixed pattern"):
        load_pattern(path)
    save_file({"sensitivity": np.ones((3, 4), np.float32)}, path)
    with pytest.raises(DataError, match="no fixed pattern"):
        load_pattern(path)
    save_file({"sensitivity": np.ones((3, 4), np.float32), "offset": np.ones((4, 3), np.float32)}, path)
    with pytest.raises(DataError, match="no images of one size"):
        load_pattern(path)
    save_file({"sensitivity": np.full((3, 4), np.nan), "offset": np.ones((3, 4))}, path)
    with pytest.raises(DataError, match="NaN or infinity"):
        load_pattern(path)
    with pytest.raises(DataError, match="60 x 40 pixels"):
        pattern.correct(np.ones((2, 5, 6)), 255)


def test_an_import_takes_the_pattern_from_the_frames(tiny_captures, tmp_path) -> None:
    sampling = Sampling(height=24, width=36, pitch_m=0.006, scored_rows=18)
    offset = np.full((48, 72), 0.03, np.float32)
    shifted = FixedPattern(np.full((48, 72), 2.0, np.float32), offset)
    for name, pattern in (("plain", None), ("corrected", shifted)):
        import_captures(tiny_captures, tmp_path / name, sampling, pattern=pattern)
    plain, corrected = (open_dataset(tmp_path / name) for name in ("plain", "corrected"))
    name = plain.objects()[0]
    one, other = (read_shard(d.shard(name))[0] for d in (plain, corrected))
    np.testing.assert_allclose(other.frame, (one.frame - 0.03) / 2, atol=2e-4)  # stored in half precision
    np.testing.assert_array_equal(other.surface, one.surface)
    with pytest.raises(DataError, match="pattern"):
        import_captures(tiny_captures, tmp_path / "plain", sampling, pattern=shifted)
