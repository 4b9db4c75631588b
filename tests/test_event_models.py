"""Laws of all event models, and which of them a sensor follows: chosen on recordings that no fit has seen."""

import math
from dataclasses import replace

import numpy as np
import pytest

from evnlos.calibration import fit_pixel
from evnlos.calibration.event_fit import CONTINUOUS, choose_pixel
from evnlos.calibration.event_models import figures_of, is_better, is_near, misfit
from evnlos.calibration.event_statistics import Recording, thinned
from evnlos.cameras import (
    EVENT_MODELS,
    BrownianPixel,
    CircuitPixel,
    EventPixel,
    EventStream,
    ReadoutPixel,
    V2ePixel,
    simulate_events,
)
from evnlos.types import Events

SHAPE = (60, 48)

ONE_POLE = "circuit, one pole"
OURS = sorted(kind for kind in EVENT_MODELS if EVENT_MODELS[kind].__module__.startswith("evnlos."))
MODELS = [*OURS, ONE_POLE]


def events_of(kind, light, times, blocks=(), **options):
    """Return the events of a model's pixels as they come, of light that comes in blocks."""
    chosen = {
        ONE_POLE: CircuitPixel(poles=1),
        "readout": ReadoutPixel(event_s=2e-6),
        "v2e": V2ePixel(shot_noise_rate_hz=2.0),
    }
    pixel = chosen[kind] if kind in chosen else EVENT_MODELS[kind]()
    stream = EventStream(pixel, (light.shape[1], light.shape[2]), **options)
    for frames, instants in zip(np.split(light, blocks), np.split(times, blocks), strict=True):
        stream.push(frames, instants)
    return stream.finish()


def columns(events):
    return np.stack([events.t_us, events.x, events.y, events.p])


@pytest.mark.parametrize("kind", MODELS)
def test_events_are_a_function_of_light_and_seed_alone(kind) -> None:
    """The same for any blocks, tiles and threads; others for another seed; in order, within the recording."""
    times = np.linspace(0.0, 0.4, 81)
    phase = np.arange(35).reshape(5, 7) / 35 + 5 * times[:, None, None]
    light = (60 + 50 * np.sin(2 * np.pi * phase)).astype(np.float32)
    whole = events_of(kind, light, times, seed=1)
    assert len(whole) > 300 and 0.2 < whole.p.mean() < 0.8
    assert whole.t_us.min() >= 0 and whole.t_us.max() <= 400_000 and (np.diff(whole.t_us) >= 0).all()
    for options in ({"blocks": range(1, 81)}, {"blocks": (30, 31, 70)}, {"tile_px": 6}, {"threads": 2}):
        np.testing.assert_array_equal(columns(events_of(kind, light, times, seed=1, **options)), columns(whole))
    other = events_of(kind, light, times, seed=2)
    assert columns(other).shape != columns(whole).shape or (columns(other) != columns(whole)).any()


@pytest.mark.parametrize("kind", MODELS)
def test_thresholds_that_are_given_are_those_of_the_pixels(kind) -> None:
    """Light that rises by 1.2 log units: four events at 0.27, at most one at 1.5."""
    times = np.linspace(0.0, 0.5, 101)
    light = np.float32(60.0 * np.exp(2.4 * times))[:, None, None] * np.ones((32, 2), np.float32)
    on = np.broadcast_to([0.27, 1.5], (32, 2))
    events = events_of(kind, light, times, seed=1, thresholds=(on, np.full((32, 2), 1.5)))
    assert 3.4 < np.median(np.bincount(events.y[events.x == 0], minlength=32)) < 4.6
    assert np.bincount(events.y[events.x == 1], minlength=32).max() <= 1


def recording(pixel, seed: int, stride: int = 1) -> Recording:
    """Four seconds of a bright spot that crosses an uneven background, on each `stride`-th row and column."""
    times = np.linspace(0.0, 4.0, 121)
    y, x = np.mgrid[: SHAPE[0] : stride, : SHAPE[1] : stride]
    place = 4 + 10 * times[:, None, None]
    spot = np.exp(-((x - place) ** 2 + (y - 15 - 10 * seed) ** 2) / 80)
    light = (6 + 0.3 * x + 120 * spot).astype(np.float32)
    return Recording(light, times, simulate_events(light, times, pixel, seed=seed))


BROWNIAN = BrownianPixel(
    0.15, 0.22, 0.01, dark_dn=8.0, leak_rate_hz=0.3, leak_rate_per_dn_hz=0.02, photon_noise=0.03
)
CONTINUOUS_PIXEL = EventPixel(0.18, 0.24, 0.02, 80.0, 0.05, 0.5, 0.0)


def chosen(pixel):
    """Return the usual model's fit, what is chosen, and the recordings that the fit has not seen."""
    fit, held = [recording(pixel, k) for k in (0, 1)], [recording(pixel, k) for k in (2, 3)]
    first = fit_pixel(fit, EventPixel())
    return first, choose_pixel(first, fit, held), held


def test_a_sensor_of_another_law_is_told_and_its_numbers_come_back() -> None:
    first, found, held = chosen(BROWNIAN)
    assert isinstance(found.pixel, BrownianPixel) and found.cutoff_range_hz is None
    assert found.pixel.threshold_on == pytest.approx(0.15, rel=0.2)
    assert found.pixel.threshold_off == pytest.approx(0.22, rel=0.2)
    few = [thinned(r) for r in held]
    truth, wrong = (misfit(few, pixel, 1).sum() for pixel in (BROWNIAN, first.pixel))
    assert misfit(few, found.pixel, 1).sum() < truth + 0.3 * (wrong - truth)
    assert set(found.compared) == {CONTINUOUS, "continuous, true logarithm", "brownian"}


def test_a_circuit_in_dim_light_is_told() -> None:
    """Its noise is slow, and larger where it is dark: no other model follows."""
    circuit = CircuitPixel(0.16, 0.2, 0.01, photocurrent_a_per_dn=1e-15, follower_a=3e-12, poles=1)
    first, found, held = chosen(circuit)
    assert isinstance(found.pixel, CircuitPixel) and ONE_POLE in found.compared
    few = [thinned(r) for r in held]
    truth, wrong = (misfit(few, pixel, 1).sum() for pixel in (circuit, first.pixel))
    assert misfit(few, found.pixel, 1).sum() < truth + 0.3 * (wrong - truth)


def test_a_sensor_of_the_usual_law_keeps_it() -> None:
    first, found, _ = chosen(CONTINUOUS_PIXEL)
    assert replace(found, compared={}) == first and ONE_POLE not in found.compared


def test_figures_are_rates_by_light_and_motion() -> None:
    one = recording(CONTINUOUS_PIXEL, 0)
    figures, behind = figures_of([one], [one.events])
    kept = one.events.t_us > one.settled_us
    # 3 levels x 3 motions x 2 polarities and two scatters; each event is in one class.
    assert len(figures) == 20 and behind[:18].sum() == kept.sum()
    empty = Events.empty(SHAPE[1], SHAPE[0])
    assert not figures_of([one], [empty])[0].any()


def test_thinning_keeps_light_and_events_of_the_same_pixels() -> None:
    one = recording(CONTINUOUS_PIXEL, 0)
    few = thinned(one, 720)
    assert few.light.shape == (121, 30, 24)
    np.testing.assert_array_equal(few.light[:, 3, 5], one.light[:, 6, 10])
    there = (one.events.x == 10) & (one.events.y == 6)
    np.testing.assert_array_equal(
        few.events.t_us[(few.events.x == 5) & (few.events.y == 3)], one.events.t_us[there]
    )


def test_a_model_must_be_better_by_more_than_chance() -> None:
    before = np.full(20, 10.0)
    assert is_better(before, before - 2) and not is_better(before, before - 0.4)
    assert not is_better(before, before - 2 + 8 * np.random.default_rng(0).normal(size=20))
    assert not is_better(before, before + 1) and math.isfinite(float(before.sum()))
    # Where the first is not of the sensor's kind, less is enough, but not nothing.
    assert is_better(before, before - 0.4, near=False) and not is_better(before, before - 0.1, near=False)


def test_a_model_is_near_what_a_sensor_of_its_kind_sends() -> None:
    """A circuit in dim light is not: its noise is slow, and makes most of its events."""
    dim = CircuitPixel(0.16, 0.2, 0.01, photocurrent_a_per_dn=1e-15, follower_a=3e-12)
    for pixel, is_of_its_kind in ((CONTINUOUS_PIXEL, True), (dim, False)):
        recorded = [recording(pixel, k, stride=2) for k in (0, 1)]
        found = fit_pixel(recorded, EventPixel()).pixel
        assert is_near(misfit(recorded, found, 1), recorded, found, 1) == is_of_its_kind
