"""The event form of the inverse problem: changes of log light as a linear function of the hidden scene."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike

from evnlos.errors import ConfigError, DataError
from evnlos.events import event_histogram
from evnlos.sensor.pixel import EventPixel
from evnlos.solver.operators import LinearOperator
from evnlos.types import Events


class LogChange:
    """The change of the wall's log light, A dx / I0, for a change dx of the hidden scene.

    The paper writes E_map = A x^m + B_s, x^m the scene's change (Eq. event_fm1), and with x^m linear in x as
    A* x (Eq. event_fm2). With x^m = (T - 1) x for a shift T of a scene that moves as a whole, A* is A (T - 1) /
    I0. Log light is not linear: ln(I0 + d) - ln I0 = d / I0 up to (d / I0)^2 / 2.

    Args:
        operator: A, from scene to wall, in the unit of `irradiance`.
        irradiance: I0, the mean wall image with all ambient light, [H, W], above 0.
        shift_cells: Cells (x, y) by which the scene moves between the two instants; None: the operator takes
            dx itself. What leaves the image is lost.

    Raises:
        DataError: The irradiance is not above 0 everywhere.
        ConfigError: The shift is (0, 0).

    Example:
        >>> from evnlos.transport import MatrixTransport
        >>> from evnlos.types import Plane
        >>> identity = MatrixTransport(torch.eye(3), Plane(1, 3, 0.01), (1, 3))
        >>> event = LogChange(identity, torch.full((1, 3), 2.0), (1, 0))
        >>> event(torch.tensor([[0.2, 0.0, 0.0]]))
        tensor([[-0.1000,  0.1000,  0.0000]])
    """

    def __init__(
        self, operator: LinearOperator, irradiance: torch.Tensor, shift_cells: tuple[int, int] | None = None
    ) -> None:
        if not bool((torch.isfinite(irradiance) & (irradiance > 0)).all()):
            raise DataError("LogChange.irradiance holds values that are not above 0; add the ambient light")
        if shift_cells == (0, 0):
            raise ConfigError("LogChange.shift_cells is (0, 0); a scene at rest makes no events")
        self.operator, self.irradiance, self.shift_cells = operator, irradiance, shift_cells

    def __call__(self, scene: torch.Tensor, /) -> torch.Tensor:
        """Return the change of log light [..., H, W]."""
        moved = scene if self.shift_cells is None else shifted(scene, self.shift_cells) - scene
        return self.operator(moved) / self.irradiance.to(scene)

    def adjoint(self, image: torch.Tensor, /) -> torch.Tensor:
        """Return the transpose, [..., h, w]."""
        scene = self.operator.adjoint(image / self.irradiance.to(image))
        if self.shift_cells is None:
            return scene
        return shifted(scene, (-self.shift_cells[0], -self.shift_cells[1])) - scene


def shifted(image: torch.Tensor, cells: tuple[int, int]) -> torch.Tensor:
    """Return images [..., h, w] moved by (x, y) whole cells, dark where nothing moves in.

    Example:
        >>> shifted(torch.tensor([[1.0, 2.0, 3.0]]), (1, 0))
        tensor([[0., 1., 2.]])
    """
    x, y = cells
    height, width = image.shape[-2:]
    out = torch.zeros_like(image)
    if abs(x) < width and abs(y) < height:
        out[..., max(y, 0) : height + min(y, 0), max(x, 0) : width + min(x, 0)] = image[
            ..., max(-y, 0) : height + min(-y, 0), max(-x, 0) : width + min(-x, 0)
        ]
    return out


def log_change(events: Events, edges_us: ArrayLike, pixel: EventPixel) -> torch.Tensor:
    """Return the change of log light that the events count: ON times its threshold less OFF times its own.

    Each pixel's sum is within about a threshold of the true change, less what the low-pass filter holds back,
    plus what the leak adds.

    Args:
        events: The stream.
        edges_us: Edges of the intervals, [N + 1], microseconds.
        pixel: The thresholds.

    Returns:
        float32 [N, H, W], log units.

    Example:
        >>> events = Events([1, 2, 3], [0, 0, 1], [0, 0, 0], [True, True, False], 2, 1)
        >>> log_change(events, [0, 5], EventPixel(threshold_on=0.2, threshold_off=0.1))
        tensor([[[ 0.4000, -0.1000]]])
    """
    counts = torch.from_numpy(event_histogram(events, np.asarray(edges_us)))  # [N, 2, H, W]
    return pixel.threshold_on * counts[:, 0] - pixel.threshold_off * counts[:, 1]
