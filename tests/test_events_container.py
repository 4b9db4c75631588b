"""`Events` and `Plane`: what they accept, what they refuse, what they leave alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evnlos.errors import DataError
from evnlos.types import Events, Plane


def four() -> Events:
    return Events([1, 2, 2, 9], [0, 3, 1, 2], [1, 0, 1, 1], [True, False, True, True], width=4, height=2)


@pytest.mark.parametrize("p", [[True, False, True], [1, 0, 1], [1, -1, 1], np.array([1, -1, 1], np.int8)])
def test_polarity_conventions_are_one(p):
    events = Events([0, 1, 2], [0, 0, 0], [0, 0, 0], p, width=1, height=1)
    assert events.p.dtype == np.bool_
    assert events.p.tolist() == [True, False, True]


def test_columns_have_their_types():
    events = four()
    assert [column.dtype for column in events.columns().values()] == [np.int64, np.uint16, np.uint16, np.bool_]
    assert all(column.flags.c_contiguous for column in events.columns().values())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"x": [0, 4, 0, 0]}, "4 pixels wide"),
        ({"y": [0, 2, 0, 0]}, "2 pixels high"),
        ({"x": [0, -1, 0, 0]}, "outside 0"),
        ({"x": [0, 70_000, 0, 0]}, "70000"),
        ({"t_us": [1, 3, 2, 9]}, "backwards at event 2"),
        ({"t_us": [1, 2, 2]}, "3"),
        ({"t_us": [0.5, 1, 2, 3]}, "float"),
        ({"p": [0, 1, 2, 0]}, "polarity"),
        ({"x": [[0, 0, 0, 0]]}, "dimensions"),
        ({"width": 0}, "width"),
        ({"height": 70_000}, "height"),
        ({"adc": [1, 2]}, "adc"),
        ({"polarity_known": [True]}, "polarity_known"),
    ],
)
def test_wrong_columns_are_refused_in_one_line(change, said):
    columns = {
        "t_us": [1, 2, 2, 9],
        "x": [0, 3, 1, 2],
        "y": [1, 0, 1, 1],
        "p": [1, 0, 1, 1],
        "width": 4,
        "height": 2,
    }
    with pytest.raises(DataError, match=said) as raised:
        Events(**(columns | change))
    assert "\n" not in str(raised.value)


def test_between_is_open_below_and_closed_above():
    assert four().between(1, 2).t_us.tolist() == [2, 2]
    assert len(four().between(9, 100)) == 0


def test_selection_keeps_optional_columns():
    events = Events([1, 2], [0, 0], [0, 0], [1, 0], width=1, height=1, adc=[7, 8], polarity_known=[True, False])
    chosen = events[np.array([False, True])]
    assert chosen.adc is not None and chosen.adc.tolist() == [8]
    assert chosen.polarity_known is not None and chosen.polarity_known.tolist() == [False]
    assert events[1:] == chosen
    with pytest.raises(DataError, match="slice"):
        events[0]  # type: ignore[index]


def test_an_array_of_events_has_a_field_for_each_column():
    events = four()
    found = np.asarray(events)
    assert found.shape == (4,) and list(found.dtype.names) == list(events.columns())
    for name, column in events.columns().items():
        np.testing.assert_array_equal(found[name], column)
        assert found[name].dtype == column.dtype
    assert np.array(events[:0]).shape == (0,)
    if np.lib.NumpyVersion(np.__version__) >= "2.0.0":
        with pytest.raises(ValueError, match="is a copy"):
            np.array(events, copy=False)


def test_equality_sees_geometry_and_columns():
    assert four() == four()
    assert four() != four()[:3]
    assert Events.empty(4, 2) != Events.empty(2, 4)
    assert len(Events.empty(4, 2)) == 0 and Events.empty(4, 2).duration_us == 0


def test_inputs_are_not_written():
    t = np.array([3, 4], np.int32)
    p = np.array([1, -1], np.int8)
    Events(t, [0, 0], [0, 0], p, width=1, height=1)
    assert t.tolist() == [3, 4] and p.tolist() == [1, -1]


@given(st.lists(st.integers(-(2**62), 2**62), max_size=30))
def test_any_ascending_times_are_held(times):
    times = sorted(times)
    zeros = np.zeros(len(times), np.uint16)
    events = Events(np.array(times, np.int64), zeros, zeros, zeros.astype(bool), width=1, height=1)
    assert events.t_us.tolist() == times


def test_plane_coordinates_are_centred():
    plane = Plane(2, 3, 0.5, center_m=(1.0, 0.0))
    assert plane.x_m.tolist() == [0.5, 1.0, 1.5]
    assert plane.y_m.tolist() == [-0.25, 0.25]
    with pytest.raises(DataError):
        Plane(0, 3, 0.5)
    with pytest.raises(DataError):
        Plane(1, 1, float("nan"))


def test_parts_are_joined_and_tonic_takes_and_gives_them() -> None:
    events = Events([1, 5, 5, 9], [0, 3, 1, 2], [1, 0, 1, 0], [1, 0, 0, 1], 4, 2, adc=[1, 2, 3, 4])
    assert Events.concatenate([events[:1], events[1:3], events[3:]]) == events
    plain = Events(events.t_us, events.x, events.y, events.p, 4, 2)
    wrong = {"at least one": [], "one kind": [events, plain], "backwards": [events[2:], events[:2]]}
    for text, parts in wrong.items():
        with pytest.raises(DataError, match=text):
            Events.concatenate(parts)
    array = plain.to_tonic()
    assert array.dtype.names == ("x", "y", "t", "p") and array["t"].tolist() == [1, 5, 5, 9]
    assert Events.from_tonic(array, (4, 2, 2)) == plain
    with pytest.raises(DataError, match="no field p"):
        Events.from_tonic(array[["x", "y", "t"]], (4, 2, 2))
