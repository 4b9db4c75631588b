"""The transmission point-spread function (tPSF) that stands for diffuse reflection (paper Eq. 18)."""

from __future__ import annotations

import math

import torch

from evnlos.errors import ConfigError
from evnlos.transport.angular_spectrum import check_lengths

_MAX_KERNEL = 4097  # samples a side; larger means that the length scale and the pitch do not belong together


def tpsf_profile(
    rho: torch.Tensor, t: float = 2.0, mean_free_path: float = 0.8, terms: int = 64
) -> torch.Tensor:
    """Return H(rho) as the paper prints it, sign included: with the paper's t and <l> it is negative
    everywhere.

    H(rho) = tau / (2 pi) sum over odd k of a_k / (a_k^2 + rho^2)^(3/2), a_k = <l> + k t, tau = t / <l>. The
    pairs k = +-1, +-3, ... up to `terms` pairs are summed; the rest is replaced by its integral (see
    `tpsf_truncation`).

    Args:
        rho: Lateral distance in the unit of `t` and `mean_free_path`, [...], float32 or float64.
        t: Thickness of the equivalent slab, above 0.
        mean_free_path: Scattering mean free path <l>, above 0; an odd multiple of t puts a pole on the axis.
        terms: Pairs of terms that are summed one by one, 1 or more.

    Returns:
        H, [...], in the dtype of `rho`; the sum itself runs in float64.

    Raises:
        ConfigError: A parameter is not positive or <l> is an odd multiple of t.

    Example:
        >>> h = tpsf_profile(torch.tensor([0.0, 2.0], dtype=torch.float64))
        >>> [round(v, 4) for v in h.tolist()]
        [-0.234, -0.0168]
    """
    _check(t, mean_free_path, terms)
    squared = rho.to(torch.float64) ** 2
    total = torch.zeros_like(squared)
    for pair in range(terms):
        k = 2 * pair + 1
        for a in (mean_free_path + k * t, mean_free_path - k * t):
            total = total + a / (a * a + squared) ** 1.5
    # The k-th pair is an integral of a derivative over 2 <l>; the midpoint rule turns the tail into this
    # difference.
    edge = 2 * terms * t
    near, far = (edge - mean_free_path) ** 2 + squared, (edge + mean_free_path) ** 2 + squared
    total = total + (far**-0.5 - near**-0.5) / (2 * t)
    return (total * (t / mean_free_path / (2 * math.pi))).to(rho.dtype)


def tpsf_truncation(t: float = 2.0, mean_free_path: float = 0.8, terms: int = 64) -> float:
    """Return a bound of the absolute error of `tpsf_profile` by its finite sum, at any rho.

    The error of the midpoint rule over the tail is at most 3 <l> t / c^4 with c = 2 terms t - <l>, because the
    third derivative of a / (a^2 + rho^2)^(3/2) never exceeds 24 / a^5; times tau / (2 pi).

    Args:
        t: Thickness of the slab.
        mean_free_path: Scattering mean free path <l>.
        terms: Pairs of terms that are summed.

    Returns:
        Bound, in the unit of H; infinite while the summed terms do not reach beyond <l>.

    Example:
        >>> tpsf_truncation() < 5e-10
        True
    """
    _check(t, mean_free_path, terms)
    reach = 2 * terms * t - mean_free_path
    if reach <= 0:
        return math.inf
    return t / mean_free_path / (2 * math.pi) * 3 * mean_free_path * t / reach**4


def tpsf_kernel(
    pitch_m: float = 1.0,
    length_m: float | None = None,
    *,
    t: float = 2.0,
    mean_free_path: float = 0.8,
    rho_max: float = 2.0,
    points: int = 100,
    terms: int = 64,
    taper: float = 0.0,
    dtype: torch.dtype = torch.float64,
) -> torch.Tensor:
    """Return the tPSF as a convolution kernel: a disc, divided by its own (negative) sum, so that it adds up to
    1.

    Args:
        pitch_m: Distance between samples, metres.
        length_m: Length of one unit of rho on the wall, metres; by default the paper's `points` samples reach
            from 0 to `rho_max`.
        t: Thickness of the equivalent slab, in units of rho.
        mean_free_path: Scattering mean free path <l>, in units of rho.
        rho_max: Radius of the disc, in units of rho.
        points: Samples from 0 to `rho_max` when `length_m` is not given, 2 or more.
        terms: Pairs of terms of the sum.
        taper: Outer fraction of the radius over which the kernel is brought to zero by a raised cosine, 0..1; 0
            is the paper's hard edge, whose kink makes the operator look better conditioned than it is.
        dtype: Floating-point type of the kernel.

    Returns:
        Kernel [k, k], k odd, non-negative, sum 1.

    Raises:
        ConfigError: A parameter is out of range, or the kernel would have more than 4097 samples a side.

    Example:
        >>> kernel = tpsf_kernel()
        >>> kernel.shape, round(kernel.sum().item(), 12), bool((kernel >= 0).all())
        (torch.Size([199, 199]), 1.0, True)
    """
    check_lengths(pitch_m=pitch_m)
    if points < 2:
        raise ConfigError(f"points is {points}; the profile needs 2 or more")
    if not rho_max > 0:
        raise ConfigError(f"rho_max is {rho_max}; give a radius above 0")
    if not 0 <= taper <= 1:
        raise ConfigError(f"taper is {taper}; give a fraction of the radius, 0 to 1")
    step = rho_max / (points - 1)  # rho a sample
    if length_m is not None:
        check_lengths(length_m=length_m)
        step = pitch_m / length_m
    radius = math.floor(rho_max / step * (1 + 1e-12))
    if 2 * radius + 1 > _MAX_KERNEL:
        raise ConfigError(
            f"the tPSF spans {2 * radius + 1} samples, above {_MAX_KERNEL}; raise pitch_m or lower length_m"
        )
    offset = torch.arange(-radius, radius + 1, dtype=torch.float64) * step
    rho = (offset[:, None] ** 2 + offset**2).sqrt()
    # Few radii are distinct on a grid; the sum over k is the costly part.
    distinct, where = torch.unique(rho, return_inverse=True)
    weight = (distinct <= rho_max * (1 + 1e-12)).to(torch.float64)
    if taper > 0:
        into = ((distinct / rho_max - (1 - taper)) / taper).clamp(0, 1)
        weight = weight * (0.5 + 0.5 * torch.cos(math.pi * into))
    kernel = (tpsf_profile(distinct, t, mean_free_path, terms) * weight)[where]
    total = kernel.sum()
    if not abs(total.item()) > 0:
        raise ConfigError(
            f"the tPSF with t={t}, mean_free_path={mean_free_path} has no sum; it cannot be normalised"
        )
    return (kernel / total).to(dtype)


def _check(t: float, mean_free_path: float, terms: int) -> None:
    for name, value in (("t", t), ("mean_free_path", mean_free_path)):
        if not (math.isfinite(value) and value > 0):
            raise ConfigError(f"{name} is {value}; give a positive, finite number")
    if terms < 1:
        raise ConfigError(f"terms is {terms}; sum 1 pair or more")
    ratio = mean_free_path / t
    if abs(ratio - round(ratio)) < 1e-9 and round(ratio) % 2 == 1:
        raise ConfigError(f"mean_free_path is {ratio:.0f} t, a pole of the tPSF; choose another value")
