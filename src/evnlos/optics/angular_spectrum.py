"""Free-space propagation between parallel planes by the angular spectrum of plane waves (paper Eq. 17).

- Step A of the paper: propagate the scene as a field and take its modulus; not linear in the scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch

from evnlos.errors import ConfigError, DataError
from evnlos.optics.operator import Transport
from evnlos.types import Plane

_BLOCK = 64  # rows transformed at a time: small enough for the cache, large enough for the vector units
_BLOCKED_FROM = 2**16  # padded samples from which transforming in blocks pays


def angular_spectrum(
    field: torch.Tensor,
    pitch_m: float,
    wavelength_m: float,
    distance_m: float,
    *,
    pad: float = 2.0,
    band_limit: bool = True,
    carrier: bool = False,
) -> torch.Tensor:
    """Propagate a monochromatic field from its plane to a parallel one.

    E(x, y) = F^-1{ F{U}(fx, fy) exp(j 2 pi z (sqrt(1/l^2 - f^2) - 1/l)) }, the Rayleigh-Sommerfeld solution
    without its carrier exp(j k z), which is a constant phase and would cost float32 all of its digits. The
    transfer function is limited to the band that its sampling can represent (Matsushima and Shimobaba, Opt.
    Express 17, 19662, 2009), made once in float64 and cached.

    Args:
        field: Amplitude, real or complex [..., H, W]; any device, float32 or float64 precision.
        pitch_m: Distance between samples, metres, above 0.
        wavelength_m: Wavelength, metres, above 0.
        distance_m: Distance, metres; negative propagates backwards.
        pad: Side of the zero-padded grid divided by that of the field, 1 or more; 2 keeps the circular
            convolution from wrapping round.
        band_limit: Whether to leave out the frequencies that the grid cannot represent at this distance.
        carrier: Whether to multiply the result by exp(j k z).

    Returns:
        Complex field [..., H, W] on the same grid.

    Raises:
        DataError: The field has fewer than two axes or holds integers.
        ConfigError: A length is not positive and finite, or `pad` is below 1.

    Example:
        >>> plane = torch.ones(8, 8, dtype=torch.float64)
        >>> moved = angular_spectrum(plane, 1e-3, 500e-9, 0.5, pad=1)
        >>> round(moved.abs().mean().item(), 6)
        1.0
    """
    if field.ndim < 2:
        raise DataError(f"field has shape {tuple(field.shape)}; give [..., H, W]")
    if not (field.is_floating_point() or field.is_complex()):
        raise DataError(f"field has dtype {field.dtype}; give real or complex floating point")
    check_lengths(pitch_m=pitch_m, wavelength_m=wavelength_m)
    if not math.isfinite(distance_m):
        raise ConfigError(f"distance_m is {distance_m}; give finite metres")
    if not pad >= 1:
        raise ConfigError(f"pad is {pad}; give 1 (no padding) or more")
    height, width = field.shape[-2:]
    padded = (math.ceil(height * pad), math.ceil(width * pad))
    dtype = torch.promote_types(field.dtype, torch.complex64)
    blocked = field.device.type == "cpu" and padded[0] * padded[1] >= _BLOCKED_FROM
    # The transposed grid's function is the transposed function: the blocked filter wants it that way.
    grid = padded[::-1] if blocked else padded
    transfer = transfer_function(grid, pitch_m, wavelength_m, distance_m, band_limit, dtype, field.device)
    start = field.to(dtype)
    if blocked:
        fields = [_filter_in_blocks(one, transfer) for one in start.reshape(-1, height, width)]
        moved = torch.stack(fields).reshape(start.shape) if fields else start.clone()
    else:
        moved = _filter(start, transfer)
    if carrier:
        # Reduced in float64 on the host; only the remaining angle meets the field's precision.
        turns = math.fmod(distance_m / wavelength_m, 1.0)
        moved = moved * complex(math.cos(2 * math.pi * turns), math.sin(2 * math.pi * turns))
    return moved


@lru_cache(maxsize=8)
def transfer_function(
    shape: tuple[int, int],
    pitch_m: float,
    wavelength_m: float,
    distance_m: float,
    band_limit: bool = True,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str = "cpu",
) -> torch.Tensor:
    """Return the carrier-free transfer function of free space on the grid of `torch.fft.fftfreq`.

    The phase is written as 2 pi z (-f^2 / (sqrt(1/l^2 - f^2) + 1/l)), which has no difference of large numbers.
    Evanescent waves decay in both directions: going backwards never amplifies them.

    Args:
        shape: Padded grid (H, W), samples.
        pitch_m: Distance between samples, metres.
        wavelength_m: Wavelength, metres.
        distance_m: Distance, metres, of either sign.
        band_limit: Whether to apply the band limit of Matsushima and Shimobaba.
        dtype: complex64 or complex128 of the result.
        device: Device of the result.

    Returns:
        Complex tensor [H, W]; shared through the cache, not to be written to.
    """
    height, width = shape
    # Factors of the two axes: the square root runs over one quadrant only.
    fy = torch.arange(height // 2 + 1, dtype=torch.float64) / (height * pitch_m)
    fx = torch.arange(width // 2 + 1, dtype=torch.float64) / (width * pitch_m)
    f2 = fy[:, None] ** 2 + fx**2
    k = 1.0 / wavelength_m
    under = k**2 - f2
    phase = f2.div_(under.clamp(min=0).sqrt_().add_(k)).mul_(-2 * math.pi * distance_m)
    magnitude = torch.ones_like(phase)
    if not bool((under >= 0).all()):
        decay = torch.exp(-2 * math.pi * abs(distance_m) * under.clamp(max=0).neg().sqrt())
        magnitude = torch.where(under >= 0, magnitude, decay)
        phase = torch.where(under >= 0, phase, torch.full_like(phase, -2 * math.pi * distance_m * k))
    if band_limit and distance_m != 0:
        limit_y, limit_x = (_frequency_limit(side * pitch_m, wavelength_m, distance_m) for side in shape)
        # The region where the phase is sampled finely enough is the intersection of two ellipses.
        inside = (fy[:, None] / limit_y) ** 2 + (fx * wavelength_m) ** 2 <= 1
        inside &= (fy[:, None] * wavelength_m) ** 2 + (fx / limit_x) ** 2 <= 1
        magnitude *= inside
    quadrant = torch.polar(magnitude, phase).to(dtype)
    rows, columns = (torch.arange(side) for side in shape)
    half = quadrant.index_select(0, torch.minimum(rows, height - rows))
    return half.index_select(1, torch.minimum(columns, width - columns)).to(device)


def _frequency_limit(side_m: float, wavelength_m: float, distance_m: float) -> float:
    """Return the highest frequency whose phase step between samples of spacing 1 / side stays below pi, 1/m."""
    return 1.0 / (wavelength_m * math.hypot(2.0 * distance_m / side_m, 1.0))


def _filter(field: torch.Tensor, transfer: torch.Tensor) -> torch.Tensor:
    """Multiply the zero-padded spectrum of `field` [..., H, W] by `transfer` and crop back.

    Rows that hold only padding are never transformed, nor rows that the crop would drop: with pad = 2 that is
    a quarter of the work.
    """
    height, width = field.shape[-2:]
    rows, columns = transfer.shape
    spectrum = torch.fft.fft(torch.fft.fft(field, n=columns, dim=-1), n=rows, dim=-2)
    moved = torch.fft.ifft(spectrum * transfer, dim=-2)[..., :height, :]
    return torch.fft.ifft(moved, dim=-1)[..., :width]


def _filter_in_blocks(field: torch.Tensor, transposed: torch.Tensor) -> torch.Tensor:
    """Do what `_filter` does to one field [H, W], a block of rows at a time and with columns turned into rows.

    Transforms of strided columns miss the cache; a transposed copy of one block does not.
    """
    height, width = field.shape
    columns, rows = transposed.shape
    spectrum = field.new_empty((columns, height))
    for start in range(0, height, _BLOCK):
        block = slice(start, start + _BLOCK)
        spectrum[:, block] = torch.fft.fft(field[block], n=columns).mT
    filtered = field.new_empty((height, columns))
    for start in range(0, columns, _BLOCK):
        block = slice(start, start + _BLOCK)
        part = torch.fft.fft(spectrum[block], n=rows) * transposed[block]
        filtered[:, block] = torch.fft.ifft(part)[:, :height].mT
    moved = torch.empty_like(field, memory_format=torch.contiguous_format)
    for start in range(0, height, _BLOCK):
        block = slice(start, start + _BLOCK)
        moved[block] = torch.fft.ifft(filtered[block])[:, :width]
    return moved


def fresnel_number(half_width_m: float, wavelength_m: float, distance_m: float) -> float:
    """Return the Fresnel number a^2 / (l z): far above 1 diffraction changes only the edges.

    Args:
        half_width_m: Half the width of the aperture, metres.
        wavelength_m: Wavelength, metres.
        distance_m: Distance, metres, not 0.

    Example:
        >>> round(fresnel_number(0.04, 500e-9, 0.5))
        6400
    """
    check_lengths(half_width_m=half_width_m, wavelength_m=wavelength_m, distance_m=abs(distance_m))
    return half_width_m**2 / (wavelength_m * abs(distance_m))


def sampling_limit_m(samples: int, pitch_m: float, wavelength_m: float, *, pad: float = 2.0) -> float:
    """Return the distance N_pad dx^2 / l beyond which the transfer function is undersampled and the band limit
    cuts.

    Args:
        samples: Samples along the side of the field, before padding.
        pitch_m: Distance between samples, metres.
        wavelength_m: Wavelength, metres.
        pad: Padding factor.

    Example:
        >>> round(sampling_limit_m(512, 10e-6, 500e-9), 4)
        0.2048
    """
    check_lengths(pitch_m=pitch_m, wavelength_m=wavelength_m)
    return math.ceil(samples * pad) * pitch_m**2 / wavelength_m


def blur_radius_px(pitch_m: float, wavelength_m: float, distance_m: float) -> float:
    """Return the radius sqrt(l z) of the first Fresnel zone in samples: the reach of the fringes at an edge.

    Args:
        pitch_m: Distance between samples, metres.
        wavelength_m: Wavelength, metres.
        distance_m: Distance, metres.

    Example:
        >>> round(blur_radius_px(8e-2 / 256, 500e-9, 0.5), 2)
        1.6
    """
    check_lengths(pitch_m=pitch_m, wavelength_m=wavelength_m)
    return math.sqrt(wavelength_m * abs(distance_m)) / pitch_m


def check_lengths(**lengths_m: float) -> None:
    """Refuse lengths that are not positive and finite, by name."""
    for name, value in lengths_m.items():
        if not (math.isfinite(value) and value > 0):
            raise ConfigError(f"{name} is {value}; give a positive, finite number of metres")


_LEAST_BAND = 16  # beyond so many sampling limits less than a sixteenth of the frequencies would be left


@dataclass(frozen=True)
class Diffraction(Transport):
    """Propagation over a distance, then |E| or |E|^2, on a plane of the same size (paper Eq. 17).

    The modulus makes this step non-linear, so it has no adjoint: the images of two objects do not add up to the
    image of both.

    Args:
        source: Plane on which the scene is sampled.
        wavelength_m: Wavelength, metres.
        distance_m: Distance to the wall, metres.
        field_step_m: Pitch that the propagation sees, metres; None is the plane's own. A pitch of about 10 um
            gives the visible fringes of a millimetre-sized target, the physical pitch of an 8 cm target almost
            none.
        field: "intensity" takes the scene as the field itself, as the paper prints; "amplitude" its square
            root.
        result: "modulus" is |E|, as the paper prints; "intensity" is |E|^2.
        pad: Zero padding of the propagation.

    Raises:
        ConfigError: A length is not positive, or `field` or `result` is unknown.
    """

    source: Plane  # pyright: ignore[reportIncompatibleVariableOverride] - frozen, so narrowing is safe
    wavelength_m: float = 500e-9
    distance_m: float = 0.5
    field_step_m: float | None = None
    field: str = "intensity"
    result: str = "modulus"
    pad: float = 2.0

    def __post_init__(self) -> None:
        check_lengths(wavelength_m=self.wavelength_m, distance_m=self.distance_m, field_step_m=self.pitch_m)
        for name, value, known in (
            ("field", self.field, ("intensity", "amplitude")),
            ("result", self.result, ("modulus", "intensity")),
        ):
            if value not in known:
                raise ConfigError(f"{name} is {value!r}; choose {known[0]!r} or {known[1]!r}")
        self._check_sampling()

    def _check_sampling(self) -> None:
        """Refuse a pitch so fine that the band limit would leave almost nothing of the scene."""
        limit = sampling_limit_m(min(self.source.shape), self.pitch_m, self.wavelength_m, pad=self.pad)
        if self.distance_m > _LEAST_BAND * limit:
            raise ConfigError(
                f"distance_m is {self.distance_m:g} m; samples of {self.pitch_m:g} m carry a field no farther "
                f"than {_LEAST_BAND * limit:g} m: raise the pitch or the number of samples"
            )

    @property
    def pitch_m(self) -> float:
        """Pitch of the propagation, metres."""
        return self.source.pitch_m if self.field_step_m is None else self.field_step_m

    @property
    def shape(self) -> tuple[int, int]:
        """Size of the result: that of the source."""
        return self.source.shape

    @property
    def output(self) -> Plane:
        """Plane of the result: that of the source, moved to the wall."""
        return self.source

    def _forward(self, scene: torch.Tensor) -> torch.Tensor:
        amplitude = scene if self.field == "intensity" else scene.clamp(min=0).sqrt()
        moved = angular_spectrum(amplitude, self.pitch_m, self.wavelength_m, self.distance_m, pad=self.pad)
        return moved.abs() if self.result == "modulus" else moved.real**2 + moved.imag**2
