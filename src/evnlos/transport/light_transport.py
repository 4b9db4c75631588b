"""The radiometric transport without its matrix: blocks of rows are made, used and forgotten."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch

from evnlos.transport.brdf import Brdf
from evnlos.transport.occluder import Occluder
from evnlos.transport.operator import LinearTransport
from evnlos.transport.patches import Patches
from evnlos.transport.radiometric import light_transport_matrix
from evnlos.transport.view import View
from evnlos.types import Plane

_BLOCK = 2**22  # entries of the matrix in memory at a time


class LightTransport(LinearTransport):
    """`light_transport_matrix` as an operator in bounded memory, for planes whose matrix would not fit.

    Every application makes the entries anew: use `MatrixTransport` where the matrix fits.

    Args:
        seen: The camera's view, or wall patches (matte walls only).
        source: The target's plane or cells.
        distance_m: Distance from wall to target, metres.
        brdf: How the wall reflects.
        offset_m: Where the target plane's origin lies over the wall (x, y), metres.
        occluders: Opaque polygons between wall and target.
        emission: Radiance of each cell at brightness 1, [h, w].
        emission_exponent: Extra fall of the emission with its angle in both axes.
        block: Entries of the matrix to hold at a time.
    """

    def __init__(
        self,
        seen: View | Plane | Patches,
        source: Plane | Patches,
        distance_m: float,
        brdf: Brdf,
        *,
        offset_m: tuple[float, float] = (0.0, 0.0),
        occluders: Sequence[Occluder] = (),
        emission: torch.Tensor | None = None,
        emission_exponent: tuple[float, float] = (0.0, 0.0),
        block: int = _BLOCK,
    ) -> None:
        self.seen = seen
        self.source = source
        self.distance_m = distance_m
        self.brdf = brdf
        self._options = {
            "offset_m": offset_m,
            "occluders": occluders,
            "emission": emission,
            "emission_exponent": emission_exponent,
        }
        self._rows = max(1, block // (source.height * source.width))

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the image, or of the plane of wall patches."""
        return self.seen.shape

    def _blocks(self, like: torch.Tensor) -> Iterator[tuple[slice, torch.Tensor]]:
        pixels = self.shape[0] * self.shape[1]
        for start in range(0, pixels, self._rows):
            rows = slice(start, min(start + self._rows, pixels))
            block = light_transport_matrix(
                self.seen,
                self.source,
                self.distance_m,
                self.brdf,
                rows=rows,
                dtype=like.dtype,
                device=like.device,
                **self._options,
            )
            yield rows, block

    def _forward(self, scene: torch.Tensor) -> torch.Tensor:
        flat = scene.flatten(-2)  # [..., h w]
        image = torch.cat([flat @ block.mT for _, block in self._blocks(scene)], dim=-1)
        return image.unflatten(-1, self.shape)

    def _adjoint(self, image: torch.Tensor) -> torch.Tensor:
        flat = image.flatten(-2)  # [..., H W]
        scene = sum(flat[..., rows] @ block for rows, block in self._blocks(image))
        assert isinstance(scene, torch.Tensor)  # a view has at least one pixel
        return scene.unflatten(-1, self.source.shape)
