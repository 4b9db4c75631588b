"""A differentiable event pixel: soft event counts and time surfaces with gradients for light and pixel.

Seen from the filter's output P, a pixel with thresholds theta+ and theta- is a play (a gear with slack). A band
[V, U] holds P while nothing happens; P pushes it along, and a coordinate x counts how far in thresholds:

    P > U:   x <- x + (P - U) / theta+,   U <- P,  V <- P - gap
    P < V:   x <- x - (V - P) / theta-,   V <- P,  U <- P + gap

from x = 1/2, U = P + theta+ / 2, V = P - theta- / 2. An ON event is an integer that x passes upwards, an OFF
event one that it passes downwards; with gap = theta- + frac(x) (theta+ - theta-) this is the hard pixel, event
for event: the number of events of a step is the change of floor(x).

The surrogate is the mean of that number over pixels whose reference starts anywhere within `phase_width` w
thresholds, P - B = v theta with v uniform in -w/2..w/2. The mean replaces floor(x) by the staircase

    stair(x) = m - 1/2 + clamp((x - m) / w, -1/2, 1/2),   m the integer nearest to x,

which is continuous, with ramps of width w, and frac(x) by x - stair(x). With w = 1 the staircase is a line:
E[ON] = (how far P pushes the band upwards) / theta+. With w -> 0 the count is the hard one. For equal
thresholds the mean is exact; for unequal ones all phases share one gap, the mean of theirs.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from evnlos.cameras.event_model import KNEE_DN, KNEE_SLOPE, MIN_THRESHOLD
from evnlos.cameras.streams import check_times
from evnlos.errors import ConfigError, DataError

Parameter = float | Tensor
"""A number, or a tensor that broadcasts against [..., H, W], for gradients and for maps over the pixels."""
Response = Literal["exact", "euler"]
"""The response to log light that is a line within the step, or v2e's recurrence."""
Kind = Literal["sum", "last"]
"""What a surface keeps: all events, decayed, or the last one."""


def filter_output(
    light: Tensor, times_s: ArrayLike | Tensor, cutoff_hz: Parameter, response: Response = "exact"
) -> Tensor:
    """Return the filter's output P at the frames, with gradients.

    With d P / d t = r (L - P), r = 2 pi fc (I + 20) / 275, and L the log light (linear below 20 DN):

    - "exact": L is a line within a step and r its mean of both ends, x = r d:
      P_k = L_k - (L_k - L_(k-1)) (1 - exp(-x)) / x + (P_(k-1) - L_(k-1)) exp(-x);
    - "euler": P_k = (1 - w) P_(k-1) + w L_k, w = min(r_k d, 1), as v2e has it.

    Args:
        light: Light in DN (255 = white), floating point [..., T, H, W].
        times_s: Instants of the frames, [T], seconds, ascending.
        cutoff_hz: Corner frequency at white, hertz; the number 0 = no filter.
        response: "exact" or "euler".

    Returns:
        P in log units, [..., T, H, W]; P = L at the first frame.

    Raises:
        DataError: Wrong shapes, or times that do not ascend.
        ConfigError: A cutoff below 0, or an unknown response.

    Example:
        >>> light = torch.tensor([50.0, 100.0, 100.0])[:, None, None]
        >>> [round(v, 3) for v in filter_output(light, [0.0, 0.01, 0.02], 15.0).flatten().tolist()]
        [3.912, 4.014, 4.213]
    """
    if not isinstance(light, Tensor) or not light.is_floating_point() or light.ndim < 3:
        raise DataError("light must be a floating-point tensor [..., T, H, W], 255 = white")
    times = check_times(times_s, light.shape[-3])
    if response not in get_args(Response):
        raise ConfigError(f'response is {response!r}; give "exact" or "euler"')
    _require("cutoff_hz", cutoff_hz, 0.0)
    logs = torch.where(light <= KNEE_DN, light * KNEE_SLOPE, light.clamp(min=KNEE_DN).log())
    if not isinstance(cutoff_hz, Tensor) and cutoff_hz == 0:
        return logs
    rates = 2 * math.pi * cutoff_hz * (light + 20.0) / 275.0
    logs_k, rates_k = logs.unbind(-3), rates.unbind(-3)
    outputs = [logs_k[0]]
    for k in range(1, len(times)):
        delta, now, before = float(times[k] - times[k - 1]), logs_k[k], logs_k[k - 1]
        if response == "euler":
            outputs.append(torch.lerp(outputs[-1], now, (rates_k[k] * delta).clamp(max=1.0)))
            continue
        x = 0.5 * (rates_k[k] + rates_k[k - 1]) * delta
        passed = -torch.expm1(-x)
        outputs.append(now - (now - before) * (passed / x) + (outputs[-1] - before) * (1.0 - passed))
    return torch.stack(outputs, -3)


def soft_events(
    light: Tensor,
    times_s: ArrayLike | Tensor,
    threshold_on: Parameter = 0.15,
    threshold_off: Parameter = 0.15,
    cutoff_hz: Parameter = 15.0,
    *,
    phase_width: float = 1.0,
    response: Response = "exact",
) -> Tensor:
    """Return soft event counts per step and pixel, differentiable in light, thresholds and cutoff.

    Args:
        light: Light in DN (255 = white), floating point [..., T, H, W].
        times_s: Instants of the frames, [T], seconds, ascending.
        threshold_on: Contrast threshold of ON events, log units.
        threshold_off: Contrast threshold of OFF events, log units.
        cutoff_hz: Corner frequency of the low-pass filter at white, hertz; the number 0 = no filter.
        phase_width: Width w of the distribution of the starting phase, above 0 to 1 thresholds: 1 gives the
            mean over all phases, and gradients wherever P moves the band; small values approach the hard count.
        response: "exact" for `simulate_events` in its mode "exact", "euler" for its mode "v2e".

    Returns:
        Counts, [..., T - 1, 2, H, W], channel 0 brighter (ON), channel 1 darker (OFF).

    Raises:
        DataError: Wrong shapes, or times that do not ascend.
        ConfigError: A parameter outside its range.

    Example:
        >>> light = torch.linspace(50, 200, 4)[:, None, None]
        >>> counts = soft_events(light, [0.0, 0.1, 0.2, 0.3], cutoff_hz=0.0)
        >>> [round(v, 3) for v in counts[:, 0, 0, 0].tolist()]
        [4.121, 2.703, 1.918]
    """
    for name, value in (("threshold_on", threshold_on), ("threshold_off", threshold_off)):
        _require(name, value, MIN_THRESHOLD)
    if not 0.0 < phase_width <= 1.0:
        raise ConfigError(f"phase_width is {phase_width:g}; give a width above 0, at most 1 threshold")
    signal = filter_output(light, times_s, cutoff_hz, response).unbind(-3)
    x = torch.full_like(signal[0], 0.5)
    high, low = signal[0] + 0.5 * threshold_on, signal[0] - 0.5 * threshold_off
    stairs, counts = _stair(x, phase_width), []
    for output in signal[1:]:
        rise, fall = (output - high).clamp(min=0.0), (low - output).clamp(min=0.0)
        x = x + rise / threshold_on - fall / threshold_off
        before, stairs = stairs, _stair(x, phase_width)
        counts.append(torch.stack([stairs - before, before - stairs], -3).clamp(min=0.0))  # [..., 2, H, W]
        gap = threshold_off + (x - stairs) * (threshold_on - threshold_off)
        rises, falls = output > high, output < low
        high = torch.where(rises, output, torch.where(falls, output + gap, high))
        low = torch.where(falls, output, torch.where(rises, output - gap, low))
    if not counts:
        return light.new_zeros((*light.shape[:-3], 0, 2, *light.shape[-2:]))
    return torch.stack(counts, -4)


def soft_counts(events: Tensor, times_s: ArrayLike | Tensor, edges_s: ArrayLike | Tensor) -> Tensor:
    """Return soft counts a time bin; the events of a step are spread evenly over it.

    Args:
        events: What `soft_events` returned, [..., T - 1, 2, H, W].
        times_s: Instants of the frames, [T], seconds.
        edges_s: Edges of the bins, [bins + 1], seconds, ascending.

    Returns:
        Counts, [..., bins, 2, H, W].

    Raises:
        DataError: Times or edges that do not ascend or do not fit.
    """
    times = torch.from_numpy(check_times(times_s, events.shape[-4] + 1))
    edges = torch.from_numpy(check_times(edges_s, len(torch.as_tensor(edges_s))))
    stop = torch.minimum(times[None, 1:], edges[1:, None])
    start = torch.maximum(times[None, :-1], edges[:-1, None])
    share = ((stop - start).clamp(min=0.0) / times.diff()).to(events)  # [bins, T - 1]
    return torch.einsum("bt,...tchw->...bchw", share, events)


def soft_surface(events: Tensor, times_s: ArrayLike | Tensor, tau_s: Parameter, kind: Kind = "last") -> Tensor:
    """Return soft time surfaces at the last frame, differentiable in the events and in tau.

    With n the soft count of a step of duration d, whose events are spread evenly over it:

    - "last": S <- (1 - min(n, 1)) exp(-d / tau) S + min(n, 1) m, which for hard counts is the surface of active
      events exp(-(t - t_last) / tau);
    - "sum": S <- exp(-d / tau) S + n m, for hard counts the sum over all events,

    m = (1 - exp(-d / tau)) tau / d being the mean decay of an event within the step.

    Args:
        events: What `soft_events` returned, [..., T - 1, 2, H, W].
        times_s: Instants of the frames, [T], seconds.
        tau_s: Time constant, seconds, above 0.
        kind: "last" or "sum".

    Returns:
        Surfaces, [..., 2, H, W].

    Raises:
        DataError: Times that do not ascend or do not fit.
        ConfigError: An unknown kind, or a time constant that is not positive.
    """
    if kind not in get_args(Kind):
        raise ConfigError(f'kind is {kind!r}; give "last" or "sum"')
    _require("tau_s", tau_s, 1e-9)
    times = check_times(times_s, events.shape[-4] + 1)
    surface = torch.zeros_like(events[..., 0, :, :, :]) if events.shape[-4] else events.sum(-4)
    for k, number in enumerate(events.unbind(-4)):
        x = torch.as_tensor((times[k + 1] - times[k]) / tau_s, dtype=events.dtype, device=events.device)
        decay, mean = torch.exp(-x), -torch.expm1(-x) / x
        taken = number.clamp(max=1.0) if kind == "last" else number
        kept = 1.0 - taken if kind == "last" else 1.0
        surface = kept * decay * surface + taken * mean
    return surface


def _stair(x: Tensor, width: float) -> Tensor:
    """Return the mean of floor(x + v) over v uniform within +-width / 2."""
    nearest = x.detach().round()
    return nearest - 0.5 + ((x - nearest) / width).clamp(-0.5, 0.5)


def _require(name: str, value: Parameter, least: float) -> None:
    """Refuse a parameter below its least value."""
    lowest = float(value.detach().min()) if isinstance(value, Tensor) else float(value)
    if not (math.isfinite(lowest) and lowest >= least):
        raise ConfigError(f"{name} is {lowest:g}; give at least {least:g}")
