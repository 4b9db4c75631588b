"""Batches and tensors of representations are those of the single streams, and images of intensities."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from evnlos.errors import DataError
from evnlos.events import (
    EventWindows,
    event_batch,
    event_frame,
    event_histogram,
    events_from_tensors,
    events_to_tensors,
    intensity_map,
    threshold_ordinal_surface,
    time_surface,
    voxel_grid,
)
from evnlos.types import Events


def stream(seed: int, count: int = 500) -> Events:
    draw = np.random.default_rng(seed)
    return Events(
        np.sort(draw.integers(0, 10_000, count)), draw.integers(0, 13, count), draw.integers(0, 9, count),
        draw.integers(0, 2, count), 13, 9, adc=draw.integers(0, 4096, count),
    )  # fmt: skip


SINGLE = {
    "histogram": ({}, lambda e: event_histogram(e)[0]),
    "frame": ({"mode": "last"}, lambda e: event_frame(e, mode="last")),
    "voxel": ({"bins": 5, "start_us": 0, "stop_us": 10_000}, lambda e: voxel_grid(e, 5, 0, 10_000)),
    "surface": (
        {"tau_us": 3e3, "stop_us": 10_000, "mode": "context", "radius": 2},
        lambda e: time_surface(e, [-1, 10_000], 3e3, "context", radius=2)[0],
    ),
    "ordinal": ({"radius": 2}, lambda e: threshold_ordinal_surface(e, 2)[None]),
    "intensity": ({}, lambda e: intensity_map(e)),
}


@pytest.mark.parametrize("name", SINGLE)
def test_a_batch_is_its_streams(name):
    options, single = SINGLE[name]
    streams = [stream(seed) for seed in range(3)] + [stream(9, 0)]
    before = [{key: column.copy() for key, column in events.columns().items()} for events in streams]
    batch = event_batch(streams, name, **options)
    assert batch.ndim == 4 and len(batch) == 4 and batch.shape[2:] == (9, 13)
    for maps, events in zip(batch, streams, strict=True):
        np.testing.assert_array_equal(maps.numpy(), single(events))
    for events, columns in zip(streams, before, strict=True):
        for key, column in events.columns().items():
            np.testing.assert_array_equal(column, columns[key])
    batch += 1  # a tensor of its own
    np.testing.assert_array_equal(event_batch(streams, name, **options).numpy() + 1, batch.numpy())


def test_every_way_to_write_a_polarity_is_the_same():
    base = stream(1)
    columns = base.t_us, base.x, base.y
    forms = [base.p, base.p.astype(np.int8), np.where(base.p, 1, -1)]
    for name in ("histogram", "frame", "voxel"):
        options = {"bins": 4} if name == "voxel" else {}
        maps = [
            event_batch(
                [events_from_tensors(*map(torch.tensor, (*columns, form)), width=13, height=9)], name, **options
            )
            for form in forms
        ]
        assert all(torch.equal(maps[0], other) for other in maps[1:]), name


def test_columns_to_tensors_and_back():
    events = stream(2)
    tensors = events_to_tensors(events)
    assert tensors["t_us"].dtype == torch.int64 and tensors["p"].dtype == torch.bool
    back = events_from_tensors(*(tensors[name] for name in ("t_us", "x", "y", "p")), width=13, height=9)
    for name in ("t_us", "x", "y", "p"):
        np.testing.assert_array_equal(getattr(back, name), getattr(events, name))
    tensors["t_us"] += 1
    np.testing.assert_array_equal(events.t_us, stream(2).t_us)


def test_wrong_batches():
    with pytest.raises(DataError, match="at least one"):
        event_batch([])
    with pytest.raises(DataError, match="one size"):
        event_batch([stream(0), Events.empty(4, 4)])
    with pytest.raises(DataError, match="histogram, frame"):
        event_batch([stream(0)], "picture")
    with pytest.raises(DataError, match="bins"):
        event_batch([stream(0)], "histogram", bins=3)
    with pytest.raises(DataError, match=r"^voxel needs bins=; give e\.g\. bins=5$"):
        event_batch([stream(0)], "voxel")
    with pytest.raises(DataError, match=r"^surface needs tau_us=; give e\.g\. tau_us=30000$"):
        event_batch([stream(0)], "surface")
    assert event_batch([stream(0)], "voxel", bins=5).shape == (1, 5, 9, 13)
    assert event_batch([stream(0)], "surface", tau_us=30_000).shape == (1, 2, 9, 13)


def slow_intensity(events: Events, edges, carry: bool, empty: float):
    out = []
    for low, high in pairwise(edges):
        picture = np.full(events.shape, empty, np.float32)
        for t, x, y, adc in zip(events.t_us, events.x, events.y, events.adc, strict=True):
            if t <= high and (carry or t > low):
                picture[y, x] = np.float32(adc) / np.float32(4095)
        out.append(picture)
    return np.stack(out)


@pytest.mark.parametrize("carry", [True, False])
def test_intensity_map_equals_the_slow_one(carry):
    events = stream(3, 200)
    edges = [2_000, 4_000, 4_001, 9_000]
    np.testing.assert_array_equal(
        intensity_map(events, edges, carry=carry, empty=np.nan), slow_intensity(events, edges, carry, np.nan)
    )


def test_intensity_of_a_recording_is_the_last_word_of_each_pixel(shared_data):
    from evnlos.events import read_events

    events = read_events(shared_data / "celex" / "blob_EI_100M.bin")
    picture = intensity_map(events)[0]
    _, first_from_behind = np.unique((events.y.astype(int) * 1280 + events.x)[::-1], return_index=True)
    last = len(events) - 1 - first_from_behind
    np.testing.assert_allclose(picture[events.y[last], events.x[last]] * 4095, events.adc[last], atol=1e-2)
    assert (picture > 0).sum() <= len(last)
    with pytest.raises(DataError, match="adc"):
        intensity_map(Events.empty(3, 3))


def test_windows_are_slices_by_time_and_a_loader_takes_them() -> None:
    events = stream(3)
    windows = EventWindows(events, 2000, "voxel", bins=4, start_us=0)
    assert len(windows) == int(events.t_us[-1]) // 2000
    for k in range(len(windows)):
        part = events.between(2000 * k, 2000 * (k + 1))
        np.testing.assert_array_equal(windows[k], voxel_grid(part, bins=4))
    batches = list(torch.utils.data.DataLoader(windows, batch_size=2, num_workers=1))
    np.testing.assert_array_equal(
        torch.cat(batches).numpy(), np.stack([windows[k] for k in range(len(windows))])
    )
    overlapping = EventWindows(events, 2000, stride_us=500, transform=len)
    first = int(events.t_us[0]) - 1
    assert overlapping[1] == len(events.between(first + 500, first + 2500)) and overlapping[-1] > 0
    with pytest.raises(DataError, match=r"'e\.raw' is no stream of events; give evnlos\.read_events\(FILE\)"):
        EventWindows("e.raw", 5)  # type: ignore[arg-type]
    for wrong in (lambda: EventWindows(events[:0], 5), lambda: EventWindows(events, 0)):
        with pytest.raises(DataError, match="positive lengths"):
            wrong()
    with pytest.raises(IndexError):
        windows[len(windows)]


def test_windows_tell_a_wrong_map_at_once() -> None:
    events = Events([1, 5, 9, 14], [0, 1, 0, 1], [0, 0, 0, 0], [1, 0, 1, 1], width=2, height=1)
    for name, options in (("voxl", {}), ("voxel", {}), ("voxel", {"bin": 5})):
        with pytest.raises(DataError):
            EventWindows(events, 5, name, **options)
