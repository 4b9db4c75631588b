"""How a wall reflects: matte (Lambert) or rough metal (GGX microfacets)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch

from evnlos.errors import ConfigError

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
