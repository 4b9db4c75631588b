"""What goes into a problem: frames of a recording, changes counted by events, a prior of the target.

- The event form of the inverse problem: changes of log light as a linear function of the hidden scene.
- The frames of a recording made ready for the problem of a whole sequence: the object's light alone, at a
working size.
- What hidden targets look like: a Gaussian prior from some characters, and others to test it on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.cameras.pixel import EventPixel
from evnlos.data.sampling import FixedPattern, reduce_by_area
from evnlos.errors import ConfigError, DataError
from evnlos.events import event_histogram
from evnlos.inverse.operators import LinearOperator
from evnlos.scene import TRAIN_WRITERS, HandwritingGlyphs, Target
from evnlos.setups import Setup
from evnlos.types import Events, Plane


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
        >>> from evnlos.optics import MatrixTransport
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


def object_light(
    frames: NDArray,
    peak: int,
    setup: Setup,
    shape: tuple[int, int],
    pattern: FixedPattern | None = None,
) -> torch.Tensor:
    """Return frames less the setup's ambient light, reduced by area averaging.

    Args:
        frames: Digital numbers [N, H, W].
        peak: Largest digital number.
        setup: The setup that says how much ambient light there is.
        shape: Size (h, w) of the result, pixels.
        pattern: The camera's fixed pattern, to be taken off first.

    Returns:
        White levels, float32 [N, h, w]; noise makes some of them negative.
    """
    levels = frames / np.float32(peak) if pattern is None else pattern.correct(frames, peak)
    size = (frames.shape[-2], frames.shape[-1])
    return torch.from_numpy(reduce_by_area(levels - setup.ambient_light(size).numpy(), shape))


def position_subsets(count: int, positions: int, subsets: int) -> list[NDArray[np.int64]]:
    """Return up to `subsets` different, equally spaced choices of `positions` out of `count`.

    Raises:
        ConfigError: Fewer than one position, or more than there are.

    Example:
        >>> [one.tolist() for one in position_subsets(40, 2, 2)]
        [[5, 25], [15, 35]]
    """
    if not 1 <= positions <= count or subsets < 1:
        raise ConfigError(
            f"{positions} positions of {count} in {subsets} subsets; give 1 to {count}, and 1 or more"
        )
    found: dict[tuple[int, ...], NDArray[np.int64]] = {}
    for k in range(subsets):
        chosen = np.floor((np.arange(positions) + (k + 0.5) / subsets) * count / positions).astype(np.int64)
        found.setdefault(tuple(chosen.tolist()), chosen)
    return list(found.values())


TEST_CHARACTERS = "AGKS249"
"""Characters that the prior never sees, from writers that it never sees."""
TRAIN_CHARACTERS = "BCDEFHIJLMNOPQRTUVWXYZ0135678"
"""Characters of the prior."""
TYPICAL = "G"
"""The character whose Picard plot is shown."""
_TEST_WRITERS = 2
_RIDGE = 1e-3  # white part of the prior, share of its mean variance: no shape is impossible


@dataclass(frozen=True, eq=False)
class TargetPrior:
    """Targets to learn a prior from, and others to test on, drawn on the same cells.

    Args:
        mean: Mean training target, float64 [n], 0..1.
        root: R with R R^T their covariance and a small white part, float64 [n, n].
        test: Test targets, float64 [M, n].
        names: Their names, [M].
        stroke_m: Median stroke width of the test targets, metres.
    """

    mean: torch.Tensor
    root: torch.Tensor
    test: torch.Tensor
    names: tuple[str, ...]
    stroke_m: float

    @property
    def typical(self) -> int:
        """Number of the test target that stands for all."""
        return next(i for i, name in enumerate(self.names) if name.endswith(f"_{TYPICAL}"))


@lru_cache(maxsize=2)
def handwritten_targets(target_plane: Plane, writers: int = 6) -> TargetPrior:
    """Return NIST-like handwriting as prior and test.

    Training targets are also moved by a cell each way, so that the prior does not know the place to a cell.

    Args:
        target_plane: Cells of the target plane, square.
        writers: Writers of the training targets.
    """
    training = HandwritingGlyphs(characters=TRAIN_CHARACTERS, writers=writers)
    drawn = np.stack([training.target(name).rasterise(target_plane) for name in training.objects()]).astype(
        np.float64
    )
    moved = [np.roll(drawn, (dy, dx), axis=(1, 2)) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    samples = torch.from_numpy(np.concatenate(moved)).flatten(1)  # [9 N, n]
    mean = samples.mean(dim=0)
    covariance = torch.cov(samples.mT)
    variance, axes = torch.linalg.eigh(covariance)
    root = axes * (variance.clamp(min=0) + _RIDGE * variance.mean()).sqrt()
    testing = HandwritingGlyphs(characters=TEST_CHARACTERS, writers=_TEST_WRITERS, first_writer=TRAIN_WRITERS)
    targets = [testing.target(name) for name in testing.objects()]
    test = torch.from_numpy(np.stack([one.rasterise(target_plane) for one in targets])).double().flatten(1)
    stroke = float(np.median([stroke_width_m(one) for one in targets]))
    return TargetPrior(mean, root, test, tuple(testing.objects()), stroke)


def stroke_width_m(target: Target) -> float:
    """Return the mean width of a target's strokes, metres: twice their area over the length of their border.

    A stroke of width w and length l has the area w l and, but for its ends, a border of 2 l. The border's
    length is the total variation of the mask.

    Example:
        >>> bar = np.zeros((100, 100)); bar[:, 40:50] = 1
        >>> round(stroke_width_m(Target("bar", bar, 0.1)), 4)
        0.01
    """
    mask = target.mask.astype(np.float64)
    pixel_m = target.size_m / mask.shape[0]
    border = float(np.hypot(*_slopes(mask)).sum())
    return 2 * float(mask.sum()) / max(border, 1e-12) * pixel_m


def _slopes(mask: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return forward differences along y and x, [S, S]."""
    return np.diff(mask, axis=0, append=mask[-1:]), np.diff(mask, axis=1, append=mask[:, -1:])
