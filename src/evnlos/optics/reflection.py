"""How a wall reflects: by the paper's tPSF, or by a BRDF.

- The transmission point-spread function (tPSF) that stands for diffuse reflection (paper Eq. 18).
- Step B of the paper: diffuse reflection as a convolution with the tPSF; linear, with an adjoint.
- How a wall reflects: matte (Lambert) or rough metal (GGX microfacets).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch

from evnlos.errors import ConfigError
from evnlos.optics.angular_spectrum import check_lengths
from evnlos.optics.operator import LinearTransport
from evnlos.types import Plane

_ROUGHEST = 2.0  # slope of the microfacets
_MAX_KERNEL = 4097  # samples per side; larger means that the length scale and the pitch do not belong together


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
    kernel_radius: float = 2.0,
    points: int = 100,
    terms: int = 64,
    window: float = 0.0,
    dtype: torch.dtype = torch.float64,
) -> torch.Tensor:
    """Return the tPSF as a convolution kernel: a disc, divided by its own (negative) sum, so that it adds up to
    1.

    Args:
        pitch_m: Distance between samples, metres.
        length_m: Length of one unit of rho on the wall, metres; by default the paper's `points` samples reach
            from 0 to `kernel_radius`.
        t: Thickness of the equivalent slab, in units of rho.
        mean_free_path: Scattering mean free path <l>, in units of rho.
        kernel_radius: Radius of the disc, in units of rho.
        points: Samples from 0 to `kernel_radius` when `length_m` is not given, 2 or more.
        terms: Pairs of terms of the sum.
        window: Outer fraction of the radius over which the kernel is brought to zero by a raised cosine, 0..1;
            0 is the paper's hard edge, whose kink makes the operator look better conditioned than it is.
        dtype: Floating-point type of the kernel.

    Returns:
        Kernel [k, k], k odd, non-negative, sum 1.

    Raises:
        ConfigError: A parameter is out of range, or the kernel would have more than 4097 samples per side.

    Example:
        >>> kernel = tpsf_kernel()
        >>> kernel.shape, round(kernel.sum().item(), 12), bool((kernel >= 0).all())
        (torch.Size([199, 199]), 1.0, True)
    """
    check_lengths(pitch_m=pitch_m)
    if points < 2:
        raise ConfigError(f"points is {points}; the profile needs 2 or more")
    if not 0 < kernel_radius < math.inf:
        raise ConfigError(f"kernel_radius is {kernel_radius}; give a finite radius above 0")
    if not 0 <= window <= 1:
        raise ConfigError(f"window is {window}; give a fraction of the radius, 0 to 1")
    step = kernel_radius / (points - 1)  # rho a sample
    if length_m is not None:
        check_lengths(length_m=length_m)
        step = pitch_m / length_m
    radius = math.floor(kernel_radius / step * (1 + 1e-12))
    if 2 * radius + 1 > _MAX_KERNEL:
        raise ConfigError(
            f"the tPSF spans {2 * radius + 1} samples, above {_MAX_KERNEL}; raise pitch_m or lower length_m"
        )
    offset = torch.arange(radius + 1, dtype=torch.float64) * step
    rho = (offset[:, None] ** 2 + offset**2).sqrt()  # of a quarter, which the others mirror
    # Few radii are distinct on a grid; the sum over k is the costly part.
    distinct, where = torch.unique(rho, return_inverse=True)
    weight = (distinct <= kernel_radius * (1 + 1e-12)).to(torch.float64)
    if window > 0:
        into = ((distinct / kernel_radius - (1 - window)) / window).clamp(0, 1)
        weight = weight * (0.5 + 0.5 * torch.cos(math.pi * into))
    quarter = (tpsf_profile(distinct, t, mean_free_path, terms) * weight)[where]
    half = torch.cat([quarter[1:].flip(0), quarter])
    kernel = torch.cat([half[:, 1:].flip(1), half], dim=1)
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


class DiffuseReflection(LinearTransport):
    """Convolution with a kernel over the whole plane: nothing is cut off at the borders.

    The result lives on a plane larger by k - 1 samples per side, with the same middle; beyond it the exact
    result is zero. So sum(result) = sum(scene) sum(kernel).

    Args:
        source: Plane on which the scene is sampled.
        kernel: Real tensor [k, l] with odd sides, for example `tpsf_kernel(source.pitch_m, length_m)`.

    Raises:
        ConfigError: The kernel is not a matrix with odd sides.
    """

    def __init__(self, source: Plane, kernel: torch.Tensor) -> None:
        if kernel.ndim != 2 or kernel.shape[0] % 2 == 0 or kernel.shape[1] % 2 == 0:
            raise ConfigError(f"the kernel is {tuple(kernel.shape)}; give [k, l] with odd sides")
        self.source = self._plane = source
        self.kernel = kernel

    @property
    def shape(self) -> tuple[int, int]:
        """Size of the full convolution."""
        return self.source.height + self.kernel.shape[0] - 1, self.source.width + self.kernel.shape[1] - 1

    @property
    def output(self) -> Plane:
        """Plane of the full convolution."""
        return Plane(*self.shape, self._plane.pitch_m, self._plane.center_m)

    def _forward(self, scene: torch.Tensor) -> torch.Tensor:
        height, width = self.shape
        size, spectrum = self._spectrum(scene)
        full = torch.fft.irfft2(torch.fft.rfft2(scene, s=size) * spectrum, s=size)
        return full[..., :height, :width]

    def _adjoint(self, image: torch.Tensor) -> torch.Tensor:
        size, spectrum = self._spectrum(image)
        full = torch.fft.irfft2(torch.fft.rfft2(image, s=size) * spectrum.conj(), s=size)
        return full[..., : self.source.height, : self.source.width]

    def _spectrum(self, like: torch.Tensor) -> tuple[tuple[int, int], torch.Tensor]:
        size = (_fast_length(self.shape[0]), _fast_length(self.shape[1]))
        return size, torch.fft.rfft2(self.kernel.to(like), s=size)


def _fast_length(least: int) -> int:
    """Return the smallest length from `least` up whose prime factors are 2, 3 and 5."""
    length = least
    while True:
        rest = length
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return length
        length += 1


# Unit vector as its components (x, y, z), z along the wall's normal: three arrays are faster than one with a
# short axis.
Direction = tuple[torch.Tensor, torch.Tensor, torch.Tensor]

# n and k of evaporated aluminium (Palik, Handbook of Optical Constants, 1985), by wavelength in metres.
ALUMINIUM = {450e-9: (0.618, 5.47), 500e-9: (0.769, 6.08), 550e-9: (0.958, 6.69), 650e-9: (1.47, 7.79)}


class Brdf(Protocol):
    """A bidirectional reflectance distribution function of two directions that point away from the wall."""

    @property
    def lobe(self) -> float:
        """Smallest width of the reflected lobe, as the slope of the microfacets; infinite for a matte wall."""
        ...

    def __call__(self, towards_light: Direction, towards_eye: Direction) -> torch.Tensor:
        """Return the BRDF, 1/sr, for directions with components [...]."""
        ...


@dataclass(frozen=True)
class Lambert:
    """A matte wall: f = albedo / pi.

    Args:
        albedo: Reflected share of the light, 0..1; a tensor carries its gradient.

    Raises:
        ConfigError: The albedo is outside 0..1.
    """

    albedo: float | torch.Tensor = 0.8

    def __post_init__(self) -> None:
        if not 0 <= self.albedo <= 1:
            raise ConfigError(f"albedo is {self.albedo}; give 0 to 1")

    @property
    def lobe(self) -> float:
        """Infinite: there is no lobe."""
        return math.inf

    def __call__(self, towards_light: Direction, towards_eye: Direction) -> torch.Tensor:
        """Return albedo / pi, broadcast over the directions."""
        return (towards_light[2] * towards_eye[2] > 0).to(towards_light[2]) * (self.albedo / math.pi)


@dataclass(frozen=True)
class GGX:
    """A rough conductor: f = D(h) G1(i) G1(o) F(i . h) / (4 cos i cos o) (Walter et al., EGSR 2007).

    D is the GGX distribution of the half vector, G1 Smith's masking of either direction, F the Fresnel
    reflectance of the metal for unpolarised light. Different roughness along x and y describes a brushed
    surface.

    Args:
        alpha: Roughness along x, above 0.
        alpha_y: Roughness along y; None is the same (isotropic).
        n: Real part of the metal's refractive index; the default is aluminium at 500 nm.
        k: Its extinction coefficient; any of the four may be a tensor with a gradient.

    Raises:
        ConfigError: A roughness or index is not positive.
    """

    alpha: float | torch.Tensor = 0.05
    alpha_y: float | torch.Tensor | None = None
    n: float | torch.Tensor = ALUMINIUM[500e-9][0]
    k: float | torch.Tensor = ALUMINIUM[500e-9][1]

    def __post_init__(self) -> None:
        for name in ("alpha", "alpha_y", "n"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigError(f"{name} is {value}; give a positive number")
            if name != "n" and value is not None and value > _ROUGHEST:
                raise ConfigError(
                    f"the roughness {name} is {value}; give up to {_ROUGHEST:g}: polished 0.005, brushed 0.1"
                )
        if not self.k >= 0:
            raise ConfigError(f"k is {self.k}; give 0 or more")

    @classmethod
    def aluminium(cls, alpha: float, wavelength_m: float, alpha_y: float | None = None) -> GGX:
        """Return rough aluminium at a wavelength of `ALUMINIUM`, metres: one call a colour channel."""
        for known, (n, k) in ALUMINIUM.items():
            if math.isclose(known, wavelength_m, rel_tol=1e-3):
                return cls(alpha, alpha_y, n, k)
        names = ", ".join(f"{known * 1e9:.0f}" for known in ALUMINIUM)
        raise ConfigError(f"no n and k of aluminium at {wavelength_m * 1e9:g} nm; choose {names} nm")

    @property
    def lobe(self) -> float:
        """The smaller roughness."""
        widths = (self.alpha, self.alpha if self.alpha_y is None else self.alpha_y)
        return min(float(torch.as_tensor(width).detach()) for width in widths)

    def __call__(self, towards_light: Direction, towards_eye: Direction) -> torch.Tensor:
        """Return the BRDF, 1/sr, for directions with components [...]."""
        ax, ay = self.alpha, self.alpha if self.alpha_y is None else self.alpha_y
        (ix, iy, iz), (ox, oy, oz) = towards_light, towards_eye
        hx, hy, hz = ix + ox, iy + oy, iz + oz
        squared = hx * hx + hy * hy + hz * hz
        # Slopes of the half vector need no normalisation; |i + o|^2 = 2 + 2 cos gives the Fresnel angle.
        stretched = (hx / ax) ** 2 + (hy / ay) ** 2 + hz * hz
        distribution = squared * squared / (math.pi * ax * ay * stretched * stretched)
        masking = _smith(ix, iy, iz, ax, ay) * _smith(ox, oy, oz, ax, ay)
        fresnel = conductor_fresnel(squared.sqrt() / 2, self.n, self.k)
        return distribution * masking * fresnel / (4 * iz * oz)


def _smith(
    x: torch.Tensor, y: torch.Tensor, z: torch.Tensor, ax: float | torch.Tensor, ay: float | torch.Tensor
) -> torch.Tensor:
    """Return Smith's G1 = 2 / (1 + sqrt(1 + (ax^2 x^2 + ay^2 y^2) / z^2))."""
    return 2 / (1 + torch.sqrt(1 + ((ax * x) ** 2 + (ay * y) ** 2) / (z * z)))


def conductor_fresnel(cosine: torch.Tensor, n: float | torch.Tensor, k: float | torch.Tensor) -> torch.Tensor:
    """Return the reflectance of a metal in air for unpolarised light.

    Args:
        cosine: Cosine of the angle of incidence, [...], 0..1.
        n: Real part of the refractive index.
        k: Extinction coefficient.

    Example:
        >>> round(conductor_fresnel(torch.tensor(1.0), 0.769, 6.08).item(), 3)
        0.923
    """
    c2 = cosine * cosine
    s2 = 1 - c2
    eta = n * n - k * k - s2
    both = torch.sqrt(eta * eta + 4 * n * n * k * k)
    a = torch.sqrt((both + eta) / 2)
    across = (both + c2 - 2 * a * cosine) / (both + c2 + 2 * a * cosine)
    along = across * (c2 * both + s2 * s2 - 2 * a * cosine * s2) / (c2 * both + s2 * s2 + 2 * a * cosine * s2)
    return (across + along) / 2
