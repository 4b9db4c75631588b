"""The differentiable pixel: its limit is the event pixel, its mean that over phases, its gradients are true."""

import math

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from evnlos.cameras import EventPixel, simulate_events
from evnlos.cameras.surrogate import filter_output, soft_counts, soft_events, soft_surface
from evnlos.errors import ConfigError, DataError
from evnlos.events import time_surface

HARD = 1e-7


def _light(seed, steps=1501, height=4, width=6, span_s=0.6, swing=0.8):
    """Return smooth random light, float64 [T, H, W], around 55 DN, and its times."""
    draw = np.random.default_rng(seed)
    times = np.linspace(0, span_s, steps)
    logs = np.full((steps, height, width), 4.0)
    for rate in (2, 3, 7, 11):
        phase = draw.uniform(0, 2 * np.pi, (height, width))
        size = draw.uniform(0, swing / math.sqrt(rate), (height, width))
        logs += size * np.sin(2 * np.pi * rate * times[:, None, None] + phase)
    return torch.from_numpy(np.exp(logs)), times


def _pixel(on, off, cutoff):
    return EventPixel(
        on, off, threshold_sigma=0, cutoff_hz=cutoff, leak_rate_hz=0, shot_noise_rate_hz=0, initial_phase="rest"
    )


def _count(events, edges_us):
    """Return hard counts [bins, 2, H, W], channel 0 ON; an event on an edge belongs to the bin before it."""
    counts = np.zeros((len(edges_us) - 1, 2, events.height, events.width))
    bins = np.searchsorted(edges_us, events.t_us, side="left") - 1
    np.add.at(counts, (bins, 1 - events.p.astype(int), events.y, events.x), 1)
    return counts


@pytest.mark.parametrize(("on", "off"), [(0.15, 0.15), (0.2, 0.12), (0.1, 0.3)])
@pytest.mark.parametrize("cutoff", [0.0, 15.0, 60.0])
def test_the_limit_of_a_narrow_phase_is_the_exact_pixel(on, off, cutoff):
    light, times = _light(1)
    hard = _count(simulate_events(light, times, _pixel(on, off, cutoff)), np.array([-1, 600_000]))[0]
    soft = soft_events(light, times, on, off, cutoff, phase_width=HARD).sum(0).numpy()
    assert hard.sum() > 200 and np.abs(soft - hard).max() < 1e-6


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32), on=st.floats(0.04, 0.4), off=st.floats(0.04, 0.4), cutoff=st.floats(0.5, 300)
)
@example(seed=3859, on=0.25, off=0.125, cutoff=7.0)  # ends a step at 15699.4996 us, stamped 15700
@example(seed=17215, on=0.04, off=0.25, cutoff=84.0)  # ends a step 88.000003 thresholds up
def test_the_limit_with_the_euler_filter_is_the_v2e_pixel_step_by_step(seed, on, off, cutoff):
    draw = np.random.default_rng(seed)
    light = torch.from_numpy(np.clip(draw.normal(0, 25, (12, 3, 5)).cumsum(0) + draw.uniform(0, 200), 0, 300))
    times = np.cumsum(draw.uniform(2e-4, 4e-3, 12))
    events = simulate_events(light, times, _pixel(on, off, cutoff), mode="v2e")
    edges = np.rint(times * 1e6)
    hard = _count(events, edges + 1)  # an event at the end of a step may be stamped a microsecond late
    a_little = np.array([1.0, 1 - 5e-5, 1 + 5e-5])  # v2e's log light is float32: more than it rounds
    soft, less, more = (
        soft_events(light, times, on * by, off * by, cutoff, phase_width=HARD, response="euler").numpy()
        for by in a_little
    )
    certain = ((soft == less) & (soft == more)).all((0, 1))  # [H, W]: no step ends so close to an event
    assert certain.mean() > 0.5
    assert np.abs(soft - hard)[..., certain].max() < 1e-6


def test_the_count_is_the_mean_over_all_phases():
    """A first frame elsewhere sets each pixel's reference: 2000 hard pixels with phases over +-theta / 2."""
    theta, phases = 0.15, (np.arange(2000) + 0.5) / 2000 - 0.5
    light, times = _light(3, steps=300, height=1, width=1, swing=2.0)
    start = light[0] * torch.from_numpy(np.exp(-theta * phases))  # [1, 2000]
    many = torch.cat([start[None], light.expand(-1, 1, 2000)])
    events = simulate_events(many, np.concatenate([[-1e-3], times]), _pixel(theta, theta, 0.0))
    edges = np.concatenate([[-10_000], np.arange(100, 700, 100) * 1000])
    mean = _count(events, edges).mean((2, 3))
    soft = soft_counts(soft_events(light, times, theta, theta, 0.0), times, np.arange(0, 700, 100) / 1000)
    assert mean.sum() > 30
    assert np.abs(soft[..., 0, 0].numpy() - mean).max() < 0.02


def test_unequal_thresholds_keep_the_mean_within_two_per_cent():
    light, times = _light(5, height=20, width=30)
    hard = _count(simulate_events(light, times, _pixel(0.1, 0.2, 15.0)), np.array([-1, 600_000]))[0]
    soft = soft_events(light, times, 0.1, 0.2, 15.0).sum(0).numpy()
    assert np.abs(soft.sum((1, 2)) / hard.sum((1, 2)) - 1).max() < 0.02


def test_a_rise_counts_its_height_over_the_threshold():
    light = torch.tensor([50.0, 80.0, 120.0, 200.0], dtype=torch.float64)[:, None, None]
    counts = soft_events(light, [0.0, 0.1, 0.2, 0.3], 0.1, 0.1, 0.0)[..., 0, 0]
    logs = light.flatten().log().numpy()
    expected = np.diff(np.maximum(logs - logs[0] - 0.05, 0)) / 0.1
    assert np.allclose(counts[:, 0].numpy(), expected, atol=1e-12) and counts[:, 1].abs().max() == 0


def test_the_filter_is_of_second_order_and_exact_for_a_step():
    light, times = _light(2, steps=1601)
    fine = filter_output(light, times, 20.0)[::16]
    for kind, order in (("exact", 2), ("euler", 1)):
        coarse = [filter_output(light[::n], times[::n], 20.0, kind)[:: 16 // n] for n in (4, 16)]
        errors = [float((output - fine).abs().max()) for output in coarse]
        assert abs(np.log2(errors[1] / errors[0]) / 2 - order) < 0.1
    assert torch.allclose(filter_output(light + 20, times, 0.0), (light + 20).log(), rtol=1e-14)
    step = torch.tensor([60.0, 200.0, 200.0], dtype=torch.float64)[:, None, None]
    last = filter_output(step, [0.0, 1e-9, 0.02], 15.0)[-1]
    decay = math.exp(-2 * math.pi * 15 * 220 / 275 * 0.02)
    assert abs(float(last) - (math.log(200) - math.log(200 / 60) * decay)) < 1e-6


@pytest.mark.parametrize("width", [1.0, 0.4])
@pytest.mark.parametrize("kind", ["exact", "euler"])
def test_gradients_are_those_of_finite_differences(width, kind):
    light, times = _light(4, steps=9, height=2, width=2, span_s=0.3)
    light = (light / 3).requires_grad_()  # on both sides of the knee of the logarithm
    params = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.21, 0.16, 18.0)]
    tau = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)

    def run(video, on, off, cutoff, tau_s):
        events = soft_events(video, times, on, off, cutoff, phase_width=width, response=kind)
        surfaces = [soft_surface(events, times, tau_s, kind) for kind in ("last", "sum")]
        return (soft_counts(events, times, [0.0, 0.14, 0.3]), *surfaces)

    assert torch.autograd.gradcheck(run, (light, *params, tau), eps=1e-7, atol=1e-5, rtol=1e-4)
    total = run(light, *params, tau)[0].sum()
    grads = torch.autograd.grad(total, (light, *params))
    assert all(torch.isfinite(g).all() and g.abs().max() > 0 for g in grads)
    assert grads[1] < 0 and grads[2] < 0 < grads[3]  # lower thresholds and more bandwidth: more events


def test_surfaces_tend_to_those_of_the_hard_events():
    tau, end_us = 0.08, 600_000
    errors = []
    for steps in (601, 1201, 2401):
        light, times = _light(6, steps=steps)
        events = simulate_events(light, times, _pixel(0.15, 0.15, 15.0))
        soft = soft_events(light, times, phase_width=HARD)
        last = time_surface(events, [0, end_us], tau * 1e6)[0]
        total = np.zeros((2, 4, 6))
        ages = np.exp(-(end_us - events.t_us) * 1e-6 / tau)
        np.add.at(total, (1 - events.p.astype(int), events.y, events.x), ages)
        errors.append(
            [
                np.abs(soft_surface(soft, times, tau).numpy() - last).max(),
                np.abs(soft_surface(soft, times, tau, "sum").numpy() - total).max() / total.max(),
            ]
        )
        assert max(errors[-1]) < 0.6 / (steps - 1) / tau  # an event is known to half a step
    assert errors[2][0] < 0.5 * errors[0][0]


def test_a_batch_is_its_clips_and_counts_add_up():
    light, times = _light(7, steps=60, span_s=0.3)
    batch = torch.stack([light, light.flip(-1), 0.3 * light])[None]
    whole = soft_events(batch, times)
    assert whole.shape == (1, 3, 59, 2, 4, 6)
    assert torch.equal(whole[0, 1], soft_events(light.flip(-1), times))
    assert (whole >= 0).all() and (whole.amin(-3) == 0).all()  # never both polarities in a step
    binned = soft_counts(whole, times, [0.0, 0.05, 0.2, 0.3])
    assert torch.allclose(binned.sum(2), whole.sum(2)) and binned.shape == (1, 3, 3, 2, 4, 6)
    maps = soft_events(light, times, torch.full((4, 6), 0.15), torch.full((4, 6), 0.15))
    assert torch.allclose(maps, whole[0, 0], atol=1e-6)
    one = soft_events(light[:1], times[:1])
    assert one.shape == (0, 2, 4, 6) and soft_surface(one, times[:1], 0.1).abs().sum() == 0


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"light": torch.zeros(3, 4)}, DataError),
        ({"light": torch.zeros(3, 4, 5, dtype=torch.uint8)}, DataError),
        ({"times_s": [0.0, 0.2, 0.1]}, DataError),
        ({"times_s": [0.0, 0.2]}, DataError),
        ({"threshold_on": 0.0}, ConfigError),
        ({"threshold_off": torch.tensor(-0.1)}, ConfigError),
        ({"cutoff_hz": -1.0}, ConfigError),
        ({"cutoff_hz": float("nan")}, ConfigError),
        ({"phase_width": 0.0}, ConfigError),
        ({"phase_width": 1.5}, ConfigError),
        ({"response": "none"}, ConfigError),
    ],
)
def test_mistakes_are_told_in_one_sentence(options, error):
    with pytest.raises(error) as caught:
        soft_events(**{"light": torch.full((3, 4, 5), 60.0), "times_s": [0.0, 0.1, 0.2], **options})
    assert "\n" not in str(caught.value)


def test_surfaces_refuse_what_they_do_not_know():
    events = soft_events(torch.full((3, 4, 5), 60.0), [0.0, 0.1, 0.2])
    for bad in ({"tau_s": 0.0}, {"tau_s": 0.1, "kind": "max"}):
        with pytest.raises(ConfigError):
            soft_surface(events, [0.0, 0.1, 0.2], **bad)
    with pytest.raises(DataError):
        soft_counts(events, [0.0, 0.1, 0.2], [0.0, 0.2, 0.1])
