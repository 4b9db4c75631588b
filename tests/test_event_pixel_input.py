"""Bad settings and bad light: one clear error each."""

import numpy as np
import pytest
import torch

from evnlos.cameras import EventPixel, EventStream, simulate_events
from evnlos.errors import ConfigError, DataError, EvnlosError

GOOD = np.full((3, 4, 5), 60.0)
TIMES = [0.0, 0.1, 0.2]
MAP = np.full((4, 5), 0.15)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("threshold_on", 0.0),
        ("threshold_off", -0.1),
        ("threshold_on", float("nan")),
        ("threshold_sigma", -1.0),
        ("cutoff_hz", -1.0),
        ("leak_rate_hz", float("inf")),
        ("shot_noise_rate_hz", -0.1),
        ("refractory_s", -1e-3),
        ("hot_pixel_fraction", 1.5),
        ("jitter_s", -1.0),
        ("cutoff_hz", "15"),
        ("cutoff_hz", True),
    ],
)
def test_pixel_refuses(field, value):
    with pytest.raises(ConfigError, match=field) as caught:
        EventPixel(**{field: value})
    assert "\n" not in str(caught.value)


def _nan(where):
    frames = GOOD.copy()
    frames[1, 2, 3] = where
    return frames


@pytest.mark.parametrize("mode", ["exact", "v2e"])
@pytest.mark.parametrize(
    ("frames", "times", "words"),
    [
        (_nan(np.nan), TIMES, "NaN"),
        (_nan(np.inf), TIMES, "infinity"),
        (_nan(-0.5), TIMES, "negative"),
        (GOOD, [0.0, 0.2, 0.1], "ascend"),
        (GOOD, [0.0, 0.1, 0.1], "ascend"),
        (GOOD, [0.0, np.nan, 0.1], "NaN"),
        (GOOD, [0.0, 0.1], "one time"),
        (GOOD, ["a", "b", "c"], "numbers"),
        (GOOD[0], TIMES, "shape"),
        (GOOD[:, :, :0], TIMES, "pixel"),
        (GOOD.astype(complex), TIMES, "dtype"),
    ],
)
def test_light_and_times_are_checked(mode, frames, times, words):
    with pytest.raises(DataError, match=words) as caught:
        simulate_events(frames, times, EventPixel(), mode=mode)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "options",
    [
        {"mode": "fast"},
        {"seed": -1},
        {"seed": 0.5},
        {"threads": 0},
        {"tile_px": 0},
        {"thresholds": (MAP, np.zeros((4, 5)))},
        {"thresholds": (MAP, MAP[:3])},
        {"thresholds": (MAP, np.full((4, 5), np.nan))},
        {"thresholds": MAP},
        {"pixel": "davis346"},
        {"mode": "v2e", "pixel": EventPixel(jitter_s=1e-4)},
        {"mode": "v2e", "pixel": EventPixel(hot_pixel_fraction=0.1)},
    ],
)
def test_options_are_checked(options):
    with pytest.raises(EvnlosError) as caught:
        simulate_events(GOOD, TIMES, **{"pixel": EventPixel(), **options})
    assert isinstance(caught.value, ConfigError) and "\n" not in str(caught.value)


def test_a_stream_refuses_a_block_from_the_past_and_keeps_its_state():
    stream = EventStream(EventPixel(), (4, 5))
    stream.push(GOOD, TIMES)
    with pytest.raises(DataError, match="ascend"):
        stream.push(GOOD, TIMES)
    with pytest.raises(DataError, match="4, 5"):
        stream.push(GOOD[:, :3], [0.3, 0.4, 0.5])
    stream.push(GOOD, [0.3, 0.4, 0.5])
    assert stream.finish().shape == (4, 5)


@pytest.mark.parametrize("mode", ["exact", "v2e"])
def test_short_videos_and_other_containers(mode):
    assert len(simulate_events(GOOD[:1], [0.0], EventPixel(), mode=mode)) == 0
    assert len(simulate_events(GOOD[:0], [], EventPixel(), mode=mode)) == 0
    video = np.random.default_rng(0).uniform(0, 255, GOOD.shape).astype(np.float32)
    from_numpy = simulate_events(video, TIMES, EventPixel(), mode=mode)
    assert len(from_numpy) > 10
    assert from_numpy == simulate_events(
        torch.tensor(video), torch.tensor(TIMES, dtype=torch.float64), mode=mode
    )
    strided = np.asfortranarray(np.repeat(video, 2, axis=2))[:, :, ::2]
    assert from_numpy == simulate_events(strided, TIMES, EventPixel(), mode=mode)
    whole = np.rint(video)
    assert simulate_events(whole, TIMES, mode=mode) == simulate_events(whole.astype(int), TIMES, mode=mode)
