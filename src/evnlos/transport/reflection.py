"""Step B of the paper: diffuse reflection as a convolution with the tPSF; linear, with an adjoint."""

from __future__ import annotations

import torch

from evnlos.errors import ConfigError
from evnlos.transport.operator import LinearTransport
from evnlos.types import Plane


class DiffuseReflection(LinearTransport):
    """Convolution with a kernel over the whole plane: nothing is cut off at the borders.

    The result lives on a plane larger by k - 1 samples a side, with the same middle; beyond it the exact result
    is zero. So sum(result) = sum(scene) sum(kernel).

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
