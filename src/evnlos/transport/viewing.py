"""Sampling a wall image through a view: the linear operator that a camera's geometry is."""

from __future__ import annotations

import math

import torch

from evnlos.transport.operator import LinearTransport
from evnlos.transport.view import View
from evnlos.types import Plane

_MAX_SAMPLES = 8  # per pixel and axis


class Viewing(LinearTransport):
    """Bilinear sampling of a wall plane at the points that a camera's pixels see, averaged over each pixel.

    Outside the plane the wall is dark. With `samples` = 1 a pixel is its centre; more samples average over its
    area, which keeps a coarse camera from aliasing a finely sampled wall.

    Args:
        source: Plane of the wall image.
        view: The camera's view.
        samples: Points a pixel and axis; None takes as many as the pixel is wide in samples of the plane.
    """

    def __init__(self, source: Plane, view: View, samples: int | None = None) -> None:
        self.source = source
        self.view = view
        if samples is None:
            # The rounding allowance keeps a pixel of exactly one sample from counting as two.
            footprint = float(view.pixel_size_m().mean()) / source.pitch_m
            samples = min(_MAX_SAMPLES, max(1, math.ceil(footprint * (1 - 1e-6))))
        self.samples = samples
        offsets = [(k + 0.5) / samples - 0.5 for k in range(samples)]
        taps = [_bilinear(source, view.wall_points_m(du, dv)) for dv in offsets for du in offsets]
        self._index = torch.cat([index for index, _ in taps])  # [taps, H W]
        self._weight = torch.cat([weight for _, weight in taps]) / samples**2

    @property
    def shape(self) -> tuple[int, int]:
        """Size of the camera image."""
        return self.view.shape

    def _forward(self, scene: torch.Tensor) -> torch.Tensor:
        flat = scene.flatten(-2)  # [..., h w]
        index, weight = self._index.to(scene.device), self._weight.to(scene)
        image = torch.zeros(*flat.shape[:-1], index.shape[1], dtype=scene.dtype, device=scene.device)
        for tap, share in zip(index, weight, strict=True):
            image = image + flat[..., tap] * share
        return image.unflatten(-1, self.shape)

    def _adjoint(self, image: torch.Tensor) -> torch.Tensor:
        flat = image.flatten(-2)  # [..., H W]
        index, weight = self._index.to(image.device), self._weight.to(image)
        size = self.source.height * self.source.width
        scene = torch.zeros(*flat.shape[:-1], size, dtype=image.dtype, device=image.device)
        for tap, share in zip(index, weight, strict=True):
            scene = scene.index_add(-1, tap, flat * share)
        return scene.unflatten(-1, self.source.shape)


def _bilinear(plane: Plane, points_m: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return indices and weights [4, points] of bilinear interpolation; weights outside the plane are zero."""
    x, y = points_m.reshape(-1, 2).unbind(-1)
    column = (x - plane.center_m[0]) / plane.pitch_m + (plane.width - 1) / 2
    row = (y - plane.center_m[1]) / plane.pitch_m + (plane.height - 1) / 2
    left, top = column.floor(), row.floor()
    indices, weights = [], []
    for dy in (0, 1):
        for dx in (0, 1):
            c, r = left + dx, top + dy
            weight = (1 - (column - c).abs()) * (1 - (row - r).abs())
            inside = (c >= 0) & (c < plane.width) & (r >= 0) & (r < plane.height)
            weights.append(torch.where(inside, weight, torch.zeros_like(weight)))
            index = r.clamp(0, plane.height - 1) * plane.width + c.clamp(0, plane.width - 1)
            indices.append(index.long())
    return torch.stack(indices), torch.stack(weights)
