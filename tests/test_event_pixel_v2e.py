"""The frame-stepped pixel against v2e's own events, and against the model written out in plain loops."""

import json
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from event_pixel_reference import reference_v2e
from evnlos.cameras import EventPixel, EventStream, simulate_events

CLEAN = ["s_clean", "s_clean_nolp", "s_clean_asym", "s_dark_clean", "t_flash_clean", "t_flash_clean_nolp"]
STORED = ["s_mismatch_seed1", "s_mismatch_seed2"]
NOISY = [("s_seed_paper", 8), ("s_noisy", 4), ("s_leakonly", 2), ("s_shotonly", 2)]


def _case(folder, name):
    """Return frames, times, pixel and v2e's own arrays of a stored case."""
    params = json.loads((folder / "meta.json").read_text())[name]["params"]
    source = "8x8x12_flash" if name.startswith("t_") else "96x60x200_u8"
    if "dark" in name:
        source = "96x60x200_dark_u8"
    given = np.load(folder / f"in_{source}.npz")
    pixel = EventPixel(
        threshold_on=params["pos_thres"],
        threshold_off=params["neg_thres"],
        threshold_sigma=params["sigma_thres"],
        cutoff_hz=params["cutoff_hz"],
        leak_rate_hz=params["leak_rate_hz"],
        shot_noise_rate_hz=params["shot_noise_rate_hz"],
        refractory_s=params["refractory_period_s"],
    )
    return given["frames"], given["t"], pixel, np.load(folder / f"{name}.npz")


def _multiset(events):
    return Counter(
        zip(events.t_us.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True)
    )


def _plain_multiset(listed, width):
    return Counter((round(t * 1e6), n % width, n // width, sign > 0) for t, n, sign in listed)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.float64])
@pytest.mark.parametrize("name", CLEAN + STORED)
def test_the_events_are_v2es_own_one_by_one(shared_data, name, dtype):
    frames, times, pixel, stored = _case(shared_data / "v2e", name)
    thresholds = (stored["pos_thres"], stored["neg_thres"]) if name in STORED else None
    events = simulate_events(frames.astype(dtype), times, pixel, mode="v2e", thresholds=thresholds)
    theirs = stored["events"].astype(np.float64)
    columns = np.rint(theirs[:, 0] * 1e6).astype(int), theirs[:, 1].astype(int), theirs[:, 2].astype(int)
    truth = Counter(zip(*(c.tolist() for c in columns), (theirs[:, 3] > 0).tolist(), strict=True))
    assert _multiset(events) == truth


@pytest.mark.parametrize(("family", "seeds"), NOISY)
def test_noise_has_v2es_statistics(shared_data, family, seeds):
    meta = json.loads((shared_data / "v2e" / "meta.json").read_text())
    theirs = np.array([[meta[f"{family}_seed{s}"][key] for key in ("on", "off")] for s in range(1, seeds + 1)])
    frames, times, pixel, _ = _case(shared_data / "v2e", f"{family}_seed1")
    ours = []
    for seed in range(8):
        events = simulate_events(frames, times, pixel, mode="v2e", seed=seed)
        ours.append([events.p.sum(), len(events) - events.p.sum()])
    ours = np.array(ours)
    # two stored seeds give no usable variance of their own: the model is one, so ours stands in for it
    spread = ours.var(0, ddof=1) if seeds < 4 else theirs.var(0, ddof=1)
    error = np.sqrt(spread / seeds + ours.var(0, ddof=1) / 8)
    assert (np.abs(ours.mean(0) - theirs.mean(0)) < 3 * error).all()
    ratio = [np.log(counts[:, 0] / counts[:, 1]) for counts in (ours, theirs)]
    spread = ratio[0].var(ddof=1) if seeds < 4 else ratio[1].var(ddof=1)
    assert abs(ratio[0].mean() - ratio[1].mean()) < 3 * np.sqrt(spread / seeds + ratio[0].var(ddof=1) / 8)


def _video(seed, steps=12, height=5, width=70, high=255.0):
    """Return a random walk of light and irregular times."""
    draw = np.random.default_rng(seed)
    walk = draw.normal(0, 25, (steps, height, width)).cumsum(0) + draw.uniform(0, high, (height, width))
    return np.clip(walk, 0, 300), np.cumsum(draw.uniform(2e-4, 4e-3, steps))


PIXELS = {
    "clean": EventPixel(0.15, 0.15, 0, 15, 0, 0),
    "asymmetric": EventPixel(0.2, 0.12, 0, 200, 0, 0),
    "mismatch": EventPixel(0.15, 0.15, 0.03, 60, 0, 0),
    "all noise": EventPixel(0.15, 0.2, 0.03, 60, 20, 30),
    "refractory": EventPixel(0.05, 0.05, 0, 200, 0, 0, refractory_s=1.3e-3),
    "refractory and noise": EventPixel(0.05, 0.07, 0.01, 200, 10, 20, refractory_s=1.3e-3),
}


@pytest.mark.parametrize("name", PIXELS)
@pytest.mark.parametrize("dtype", [np.float64, np.uint8])
def test_kernel_is_the_plain_loop(name, dtype):
    frames, times = _video(3)
    frames = np.clip(frames, 0, 255).astype(dtype)
    events = simulate_events(frames, times, PIXELS[name], mode="v2e", seed=5)
    plain = reference_v2e(frames, times, PIXELS[name], seed=5)
    assert len(plain) > 200
    assert _multiset(events) == _plain_multiset(plain, frames.shape[2])


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    cutoff=st.floats(0.5, 400),
    on=st.floats(0.03, 0.5),
    off=st.floats(0.03, 0.5),
    noise=st.sampled_from([0.0, 0.2, 25.0]),
)
def test_kernel_is_the_plain_loop_on_any_input(seed, cutoff, on, off, noise):
    frames, times = _video(seed, steps=6, height=2, width=9)
    pixel = EventPixel(on, off, 0.02 if noise else 0, cutoff, noise, noise)
    events = simulate_events(frames, times, pixel, mode="v2e", seed=seed)
    assert _multiset(events) == _plain_multiset(reference_v2e(frames, times, pixel, seed=seed), 9)


def test_the_refractory_period_bites_and_defers():
    frames, times = _video(3)
    pixel = PIXELS["refractory"]
    free = simulate_events(frames, times, EventPixel(0.05, 0.05, 0, 200, 0, 0), mode="v2e")
    held = simulate_events(frames, times, pixel, mode="v2e")
    assert 0.1 * len(free) < len(held) < 0.5 * len(free)
    order = np.lexsort([held.t_us, held.x, held.y])
    same = (np.diff(held.x[order].astype(int)) == 0) & (np.diff(held.y[order].astype(int)) == 0)
    gaps = np.diff(held.t_us[order])[same]
    # v2e lets events pass unfiltered in steps whose sub-times are further apart than the period
    assert np.mean(gaps >= 1300) > 0.99


def test_lookup_table_and_logarithm_give_the_same_events():
    frames, times = _video(9, steps=40)
    frames = np.clip(frames, 0, 255).astype(np.uint8)
    for pixel in PIXELS.values():
        table = simulate_events(frames, times, pixel, mode="v2e", seed=1)
        assert table == simulate_events(frames.astype(np.float64), times, pixel, mode="v2e", seed=1)


@pytest.mark.parametrize("name", PIXELS)
def test_same_bytes_for_any_tile_thread_and_block(name):
    frames, times = _video(11, steps=150, height=12, width=90)
    pixel = PIXELS[name]
    whole = simulate_events(frames, times, pixel, mode="v2e", seed=2, threads=1)
    assert whole == simulate_events(frames, times, pixel, mode="v2e", seed=2, threads=3, tile_px=256)
    stream = EventStream(pixel, frames.shape[1:], mode="v2e", seed=2)
    for first, last in ((0, 1), (1, 2), (2, 40), (40, 149), (149, 150)):
        stream.push(frames[first:last], times[first:last])
    assert whole == stream.finish()
    draws = pixel.threshold_sigma > 0 or pixel.leak_rate_hz > 0 or pixel.shot_noise_rate_hz > 0
    assert (whole != simulate_events(frames, times, pixel, mode="v2e", seed=3)) == draws


def test_frames_are_only_read():
    frames, times = _video(1)
    for dtype in (np.uint8, np.float32, np.float64):
        mine, clock = np.clip(frames, 0, 255).astype(dtype), times.copy()
        mine.flags.writeable = clock.flags.writeable = False
        simulate_events(mine, clock, PIXELS["all noise"], mode="v2e")
        simulate_events(mine, clock, PIXELS["all noise"])
