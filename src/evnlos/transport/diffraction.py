"""Step A of the paper: propagate the scene as a field and take its modulus; not linear in the scene."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from evnlos.errors import ConfigError
from evnlos.transport.angular_spectrum import angular_spectrum, check_lengths, sampling_limit_m
from evnlos.transport.operator import Transport
from evnlos.types import Plane

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
        wave_pitch_m: Pitch that the propagation sees, metres; None is the plane's own. A pitch of about 10 um
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
    wave_pitch_m: float | None = None
    field: str = "intensity"
    result: str = "modulus"
    pad: float = 2.0

    def __post_init__(self) -> None:
        check_lengths(wavelength_m=self.wavelength_m, distance_m=self.distance_m, wave_pitch_m=self.pitch_m)
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
        return self.source.pitch_m if self.wave_pitch_m is None else self.wave_pitch_m

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
