"""The steps that the camera chooses time the events of the paper's scene to a quarter of a millisecond, rms."""

from dataclasses import replace

import numpy as np

from evnlos.cameras import EventCamera
from evnlos.data.simulations import paper
from evnlos.scene import Scene
from evnlos.types import Events, derive_seed

SHAPE = (8, 960)  # rows of the middle, pixels of the paper's size
SPAN_S = (3.0, 5.0)


def by_pixel(events: Events) -> tuple[np.ndarray, np.ndarray]:
    """Return events as (pixel and polarity, time in us), ordered by both."""
    key = (events.y.astype(np.int64) * SHAPE[1] + events.x) * 2 + events.p
    order = np.lexsort((events.t_us, key))
    return key[order], events.t_us[order]


def test_chosen_steps_time_events_to_a_quarter_of_a_millisecond_rms() -> None:
    config = paper()
    target = config.glyphs.target(config.glyphs.objects()[0], derive_seed(config.seed, "glyph"))
    wall = config.setup.seen_by(SHAPE).observe(Scene(target, config.motion, config.duration_s))
    pixel = replace(config.pixel, leak_rate_hz=0.0, shot_noise_rate_hz=0.0, initial_phase="rest")
    fine = by_pixel(EventCamera(pixel, time_step_s=0.5e-3).record(wall, *SPAN_S, seed=1))
    found = by_pixel(EventCamera(pixel).record(wall, *SPAN_S, seed=1))
    counts = [np.bincount(keys, minlength=2 * SHAPE[0] * SHAPE[1]) for keys, _ in (fine, found)]
    alike = counts[0] == counts[1]
    assert counts[0].sum() > 30_000
    assert alike.mean() > 0.999
    error_ms = (found[1][alike[found[0]]] - fine[1][alike[fine[0]]]) / 1000
    assert np.sqrt(np.mean(error_ms**2)) < 0.25, np.sqrt(np.mean(error_ms**2))
    assert np.percentile(np.abs(error_ms), 99) < 0.5
    # steps of 50 ms, four pixels, are distinguished
    coarse = by_pixel(EventCamera(pixel, time_step_s=50e-3).record(wall, *SPAN_S, seed=1))
    same = np.bincount(coarse[0], minlength=len(alike)) == counts[0]
    coarse_ms = (coarse[1][same[coarse[0]]] - fine[1][same[fine[0]]]) / 1000
    assert np.percentile(np.abs(coarse_ms), 99) > 0.5
