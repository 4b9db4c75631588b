"""The torch path against v2e's own events and against the numba kernels; nothing depends on the batch."""

from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from evnlos.cameras import EventPixel, simulate_batch, simulate_events
from evnlos.cameras import on_device as _torch_batch
from evnlos.cameras.pixels import torch_v2e as _torch_v2e
from evnlos.cameras.pixels.torch_noise import fill, random_word, stream_word
from evnlos.cameras.random_numbers import exponential_field, jitter_offset, normal_field
from evnlos.errors import ConfigError, DataError
from evnlos.types import derive_seed
from test_event_pixel_v2e import CLEAN, PIXELS, STORED, _case, _multiset, _video

CPU = torch.device("cpu")


def _shared(a, b):
    """Return the share of events that two streams have in common."""
    a, b = _multiset(a), _multiset(b)
    return sum((a & b).values()) / max(sum(a.values()), sum(b.values()))


@pytest.mark.parametrize("seed", [0, 7, 2**63, 2**64 - 1])
def test_random_numbers_are_those_of_the_kernels(seed):
    out = torch.empty(1, 3000, dtype=torch.float64)
    assert np.array_equal(fill(out, "exponential", [seed], 6)[0], exponential_field(np.uint64(seed), 6, 3000))
    normal = fill(out, "normal", [seed], 1)[0].numpy()
    assert np.abs(normal - normal_field(np.uint64(seed), 1, 3000)).max() < 1e-15
    words = random_word(stream_word([seed], 5, CPU), torch.arange(50), torch.tensor(9)) & 4095
    assert words.tolist() == [jitter_offset(np.uint64(seed), block, 9) for block in range(50)]


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
@pytest.mark.parametrize("name", CLEAN + STORED)
def test_the_events_are_v2es_own_one_by_one(shared_data, name, kind):
    frames, times, pixel, stored = _case(shared_data / "v2e", name)
    maps = (stored["pos_thres"], stored["neg_thres"]) if name in STORED else None
    clips = torch.from_numpy(frames.astype(kind))[None]
    theirs = stored["events"].astype(np.float64)
    columns = np.rint(theirs[:, 0] * 1e6).astype(int), theirs[:, 1].astype(int), theirs[:, 2].astype(int)
    truth = Counter(zip(*(c.tolist() for c in columns), (theirs[:, 3] > 0).tolist(), strict=True))
    assert _multiset(simulate_batch(clips, times, pixel, thresholds=maps)[0]) == truth
    single = _multiset(simulate_batch(clips, times, pixel, thresholds=maps, dtype=torch.float32)[0])
    assert sum((single & truth).values()) >= 0.9995 * max(len(theirs), sum(single.values()))


@pytest.mark.parametrize("name", PIXELS)
@pytest.mark.parametrize("kind", [np.uint8, np.float32, np.float64])
def test_a_batch_is_the_numba_kernel_clip_by_clip(name, kind):
    steps = 24 if "refractory" in name else 75  # these run step by step, the others in blocks of 32
    videos = [_video(seed, steps=steps, height=7, width=90) for seed in range(3)]
    times, pixel = videos[0][1], PIXELS[name]
    clips = np.stack([np.clip(frames, 0, 255) for frames, _ in videos]).astype(kind)
    batch = simulate_batch(torch.from_numpy(clips), times, pixel, [5, 6, 2**64 - 1])
    for clip, events, seed in zip(clips, batch, [5, 6, 2**64 - 1], strict=True):
        assert events == simulate_events(clip, times, pixel, mode="v2e", seed=seed) and len(events) > 300
    single = simulate_batch(torch.from_numpy(clips), times, pixel, [5, 6, 2**64 - 1], dtype=torch.float32)
    assert min(_shared(a, b) for a, b in zip(batch, single, strict=True)) > 0.999


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    cutoff=st.sampled_from([0.0, 3.0, 60.0, 400.0]),
    on=st.floats(0.03, 0.5),
    off=st.floats(0.03, 0.5),
    noise=st.sampled_from([0.0, 0.2, 25.0]),
    refractory=st.sampled_from([0.0, 1e-3]),
    kind=st.sampled_from([np.uint8, np.float64]),
    steps=st.integers(1, 70),
)
def test_it_is_the_numba_kernel_on_any_input(seed, cutoff, on, off, noise, refractory, kind, steps):
    frames, times = _video(seed, steps=steps, height=2, width=9)
    frames = np.clip(frames, 0, 255).astype(kind)
    pixel = EventPixel(on, off, 0.02 if noise else 0, cutoff, noise, noise, refractory_s=refractory)
    numba = simulate_events(frames, times, pixel, mode="v2e", seed=seed)
    assert numba == simulate_events(frames, times, pixel, mode="v2e", seed=seed, backend="torch")


@pytest.mark.parametrize("name", ["all noise", "refractory and noise"])
def test_nothing_depends_on_batch_tile_group_or_layout(name, monkeypatch):
    steps = 20 if "refractory" in name else 70
    videos = [_video(seed, steps=steps, height=10, width=70) for seed in range(5)]
    clips = torch.from_numpy(np.stack([np.clip(frames, 0, 255) for frames, _ in videos]).astype(np.uint8))
    times, pixel = videos[0][1], PIXELS[name]
    batch = simulate_batch(clips, times, pixel, 3)
    for n, events in enumerate(batch):
        seed = derive_seed(3, "clip", n)
        assert simulate_batch(clips[n : n + 1], times, pixel, [seed])[0] == events
    for tile in (1, 300, 1500):
        assert simulate_batch(clips, times, pixel, 3, tile_px=tile) == batch
    strided = clips.repeat_interleave(2, 3)[..., ::2]
    assert simulate_batch(strided, times, pixel, 3) == batch
    flipped = np.ascontiguousarray(clips.numpy()[:, :, ::-1])
    flipped.flags.writeable = False
    assert simulate_batch(flipped[:, :, ::-1], times, pixel, 3) == batch
    monkeypatch.setattr(_torch_batch, "_GROUP_CPU", 1400)
    assert simulate_batch(clips, times, pixel, 3) == batch
    if not pixel.refractory_s:
        monkeypatch.setattr(_torch_v2e, "STEPS", 9)
        assert simulate_batch(clips, times, pixel, 3) == batch


def test_a_light_that_ends_earlier_changes_nothing_before():
    frames, times = _video(1, steps=100, height=6, width=50)
    whole = simulate_batch(frames[None], times, PIXELS["all noise"], [4])[0]
    part = simulate_batch(frames[None, :61], times[:61], PIXELS["all noise"], [4])[0]
    assert len(part) and part == whole[: len(part)] and whole.t_us[len(part)] > times[60] * 1e6 - 1


def test_clips_are_only_read_and_may_need_gradients():
    for kind in (torch.uint8, torch.float32, torch.float64):
        clips = torch.from_numpy(np.clip(_video(1)[0], 0, 255)[None]).to(kind)
        before, times = clips.clone(), _video(1)[1]
        if kind.is_floating_point:
            clips.requires_grad_()
        events = simulate_batch(clips, times, PIXELS["all noise"])[0]
        assert len(events) > 100 and torch.equal(clips, before)


def test_short_clips_and_other_containers():
    still = np.full((2, 3, 4, 5), 60)
    pixel = PIXELS["clean"]
    assert [len(e) for e in simulate_batch(still[:, :1], [0.0], pixel)] == [0, 0]
    assert [len(e) for e in simulate_batch(still[:, :0], [], pixel)] == [0, 0]
    assert simulate_batch(still[:0], [0.0, 0.1, 0.2], pixel) == []
    clips = np.rint(np.random.default_rng(0).uniform(0, 255, still.shape))
    bytes_ = simulate_batch(clips.astype(np.uint8), [0.0, 0.1, 0.2], pixel)
    assert bytes_ == simulate_batch(clips.astype(int).tolist(), [0.0, 0.1, 0.2], pixel)
    times = torch.tensor([0.0, 0.1, 0.2], dtype=torch.float64)
    assert bytes_ == simulate_batch(torch.tensor(clips).to(torch.int32), times, pixel)
    assert len(bytes_[0]) > 100


GOOD = np.full((2, 3, 4, 5), 60.0)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"clips": GOOD[0]}, DataError, "shape"),
        ({"clips": GOOD[..., :0]}, DataError, "pixel"),
        ({"clips": GOOD.astype(complex)}, DataError, "dtype"),
        ({"clips": np.where(GOOD > 0, np.nan, 0)}, DataError, "NaN"),
        ({"clips": -GOOD}, DataError, "negative"),
        ({"clips": [["a"]]}, DataError, "numbers"),
        ({"clips": torch.zeros(2, 3, 4, 5, dtype=torch.complex64)}, DataError, "dtype"),
        ({"times_s": [0.0, 0.2, 0.1]}, DataError, "ascend"),
        ({"times_s": [0.0, 0.1]}, DataError, "one time"),
        ({"seeds": [1]}, ConfigError, "one a clip"),
        ({"seeds": [1, -1]}, ConfigError, "seed"),
        ({"seeds": 0.5}, ConfigError, "seeds"),
        ({"seeds": True}, ConfigError, "seeds"),
        ({"dtype": torch.float16}, ConfigError, "dtype"),
        ({"tile_px": 0}, ConfigError, "tile_px"),
        ({"thresholds": (np.zeros((4, 5)), np.ones((4, 5)))}, ConfigError, "thresholds"),
        ({"pixel": EventPixel(jitter_s=1e-3)}, ConfigError, "jitter"),
        ({"pixel": "davis346"}, ConfigError, "EventPixel"),
    ],
)
def test_mistakes_are_told_in_one_sentence(change, error, words):
    with pytest.raises(error, match=words) as caught:
        simulate_batch(**{"clips": GOOD, "times_s": [0.0, 0.1, 0.2], **change})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "options",
    [
        {"backend": "jax"},
        {"backend": "torch"},
        {"backend": "torch", "mode": "v2e", "pixel": EventPixel(hot_pixel_fraction=0.1)},
        {"device": "cpu"},
    ],
)
def test_simulate_events_refuses_backends_it_has_not(options):
    with pytest.raises(ConfigError):
        simulate_events(GOOD[0], [0.0, 0.1, 0.2], **options)
