"""Where the target plane is among the pixels of a canvas, and sequences of targets that are newly drawn on it.

- The target plane among the pixels of the canvas, and the way there and back.
- Targets to draw: those of a calibrated setup's training, drawn once, bent anew each time.
- What a network of whole sequences sees of them, in closed form: nothing is rendered or recorded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from evnlos.config import config_hash, load_yaml, to_dict
from evnlos.data import Sampling, Simulation
from evnlos.data.pool import run_in_order
from evnlos.errors import ConfigError, DataError
from evnlos.inverse.event_images import event_errors, event_prior
from evnlos.inverse.prior import ScoreErrors, root_of
from evnlos.inverse.sequence_light import EVENT_PRIORS
from evnlos.machine import Progress, counted, silent
from evnlos.models.confidence import on_canvas
from evnlos.scene import TRAIN_WRITERS, Glyphs, HandwritingGlyphs
from evnlos.setups import TRAINING_FILE, load_setup
from evnlos.tensor_file import TensorFile
from evnlos.types import Plane, derive_seed, target_side_m

if TYPE_CHECKING:
    from evnlos.models.sequence import PooledFrames

_MARGIN = 1.25
"""Side of the square that is drawn over that of the target plane in its middle."""

FINER = 2
"""Pixels of that square per pixel of the canvas: positions between pixels tell more than one of them does."""

_CELLS = 4  # the square's side is a multiple of so many pixels
_MOST_PIXELS = 4096  # along the square's side


class TargetGrid:
    """The square around the target plane's centre, `FINER` than the canvas, and the way there and back.

    Args:
        sampling: Size of the maps and their pitch on the target's canvas.

    Raises:
        ConfigError: The pitch is too fine for the square that is drawn.
    """

    def __init__(self, sampling: Sampling) -> None:
        self.pitch_m = pitch_m = sampling.pitch_m / FINER
        self.side = max(1, round(_MARGIN * target_side_m(sampling.canvas) / pitch_m / _CELLS)) * _CELLS
        if self.side > _MOST_PIXELS:
            least_m = sampling.pitch_m * self.side / _MOST_PIXELS
            raise ConfigError(
                f"Sampling.pitch_m is {sampling.pitch_m}; a sequence network takes {least_m:.1g} m or more here"
            )
        # On the CPU wherever the layers are: the first arithmetic on the device "meta" imports for seconds.
        across = (torch.arange(self.side, device="cpu") + 0.5 - self.side / 2) * pitch_m
        self._place_m = torch.stack(torch.meshgrid(across, across, indexing="xy"), dim=-1)  # [P, P, 2]
        self._canvas_m = torch.tensor([sampling.width, sampling.height], device="cpu") * sampling.pitch_m
        self._side_m, self._canvas = self.side * pitch_m, sampling.canvas

    def seen(self, images: Tensor, position_m: Tensor) -> tuple[Tensor, Tensor]:
        """Return images [N, S, H, W] as seen from the plane, [N, S, P, P], and where, bool [N, P, P].

        Args:
            images: Images of the canvas.
            position_m: The plane's centre on the canvas at each, (x, y) in metres, [N, 2].
        """
        grid, inside = self._grid(images, position_m)
        moved = F.grid_sample(images, grid, padding_mode="border", align_corners=False)
        return moved * inside[:, None], inside

    def inside(self, images: Tensor, position_m: Tensor) -> Tensor:
        """Return which pixels of the plane lie on the canvas at each position, bool [N, P, P]."""
        return self._grid(images, position_m)[1]

    def _grid(self, images: Tensor, position_m: Tensor) -> tuple[Tensor, Tensor]:
        place = self._place_m + position_m.float().cpu()[:, None, None]  # [N, P, P, 2]
        grid = (place / (self._canvas_m / 2)).to(images.device)  # -1..1 from edge to edge
        return grid, (grid.abs() <= 1).all(dim=-1)

    def means(
        self,
        inputs: Tensor,
        position_m: Tensor,
        kept: Tensor,
        images_of: Callable[[Tensor], Tensor] | None,
    ) -> Tensor | None:
        """Return what subsets of the time steps show, [K, S, P, P]; a pixel is the mean where it is seen.

        Args:
            inputs: What was recorded, [N, C, H, W].
            position_m: The plane's centre on the canvas at each, (x, y) in metres, [N, 2].
            kept: 1 where a subset has a time step, else 0, [K, N].
            images_of: Maps some of the inputs to S images of the canvas each; None: nothing is shown.

        Raises:
            DataError: The plane is off the canvas at all time steps of a subset.
        """
        total = seen = torch.zeros((), device=inputs.device)
        for start in range(0, len(inputs), 64):
            part = slice(start, start + 64)
            weights = kept[:, part].to(inputs.device)
            if images_of is not None:
                light, inside = self.seen(images_of(inputs[part]), position_m[part])
                total = total + torch.tensordot(weights.to(light), light, dims=1)
            else:
                inside = self.inside(inputs, position_m[part])
            seen = seen + torch.tensordot(weights, inside.float(), dims=1)
        if not bool((seen > 0).flatten(1).any(dim=1).all()):
            raise DataError(
                "the target plane is off the canvas at every time step; give positions within the travel"
            )
        return None if images_of is None else total / seen[:, None].clamp_min(1)

    def mean(self, images: Tensor, position_m: Tensor) -> Tensor:
        """Return the plane [P, P] that images [N, H, W] of all positions show: their mean."""
        light, inside = self.seen(images[:, None].float(), position_m)
        return light.sum(dim=0)[0] / inside.sum(dim=0).clamp_min(1)

    def on_canvas(self, plane: Tensor, position_m: Tensor) -> Tensor:
        """Return the target plane [P, P] on the canvas at each position [N, 2], metres: images [N, H, W].

        Each pixel is the mean of `FINER` x `FINER` samples.
        """
        canvas = self._canvas
        fine = Plane(canvas.height * FINER, canvas.width * FINER, canvas.pitch_m / FINER)
        return F.avg_pool2d(on_canvas(plane, fine, position_m, self._side_m), FINER)

    def of_target(self, target: Tensor, size_m: float) -> Tensor:
        """Return targets [..., h, h] of a side in metres as seen on the square, [..., P, P]; 0 beside them."""
        places = (self._place_m / (size_m / 2)).to(target)[None]
        images = target.reshape(1, -1, *target.shape[-2:])
        return F.grid_sample(images, places, align_corners=False).reshape(*target.shape[:-2], *2 * [self.side])

    def target_of(self, planes: Tensor, size_m: float, cells: int) -> Tensor:
        """Return the targets of a side in metres on so many cells, [B, h, h], that planes [B, P, P] show."""
        share = size_m / self._side_m
        affine = torch.tensor([[share, 0.0, 0.0], [0.0, share, 0.0]]).expand(len(planes), -1, -1).to(planes)
        grid = F.affine_grid(affine, [len(planes), 1, 2 * cells, 2 * cells], align_corners=False)
        return F.avg_pool2d(F.grid_sample(planes[:, None], grid, align_corners=False), 2)[:, 0]


DRAWN_FILE = "drawn.safetensors"
"""Targets that were drawn for the training behind a setup, in its folder."""

_POPULATIONS = 4  # of writers: what is bent anew is not as good as new, and more take long to draw
_SIDE, _AT_ONCE, _COUNT = 64, 32, 8  # pixels of one; drawn at a time; subsets of the time steps
_TURN, _WIDTH, _HEIGHT, _SLANT, _PLACE, _BEND = 0.08, 0.07, 0.05, 0.12, 0.016, 0.03
_ALIKE = 4  # captures nearest in light
_MOST_KNOWN = 64  # sequences that tell errors
_WAVES = 5  # knots along a side of the field that bends


@dataclass(frozen=True)
class AboutDrawn:
    """Description of a file of drawn targets."""

    glyphs: str
    """Hash of the settings that they were drawn by."""
    size_m: float
    """Side of the targets, metres."""


@dataclass(frozen=True, eq=False)
class DrawnTargets:
    """Targets to learn from: masks, float16 [M, h, h], 0..1, and their side in metres."""

    about: AboutDrawn
    masks: Tensor


DRAWN = TensorFile(
    "evnlos-drawn-targets-1",
    ("masks",),
    AboutDrawn,
    DrawnTargets,
    "drawn targets",
    "the file that a training behind a setup of `evnlos calibrate` writes to its folder",
)
"""Drawn targets on disk."""


def drawn_targets(setup: str | Path, workers: int = 1, progress: Progress = silent) -> DrawnTargets:
    """Return the targets to learn from behind a setup; where they are missing they are drawn and kept there.

    They are those of its `training.yaml`, letters and digits of many writers, by all writers for training of
    four populations: five and a half thousand. No known target is among them, so that captures of it tell how
    well what was learned holds.

    Args:
        setup: Folder of `evnlos calibrate`.
        workers: Processes that draw; 0 is one for each core.
        progress: Called with the number of targets that are drawn.

    Raises:
        ConfigError: The folder says nothing of what to learn from.
    """
    folder = folder_of(setup)
    if not (folder / TRAINING_FILE).is_file():
        raise ConfigError(
            f"{setup or 'no setup'} has no {TRAINING_FILE}, which says what targets to draw; make the samples "
            "with --sampling.setup FOLDER of `evnlos calibrate`, or leave --drawn at 0"
        )
    simulation = load_yaml(Simulation, folder / TRAINING_FILE)
    glyphs, seeds = simulation.glyphs, [simulation.seed]
    if isinstance(glyphs, HandwritingGlyphs):
        glyphs = replace(glyphs, first_writer=0, writers=TRAIN_WRITERS, known="", redrawn=0)
        seeds = [derive_seed(simulation.seed, "population", number) for number in range(_POPULATIONS)]
    key = config_hash(to_dict(glyphs) | {"seeds": seeds})
    path = folder / DRAWN_FILE
    if path.is_file():
        found = DRAWN.load(path, "")
        if found.about.glyphs == key:
            return found
    names = glyphs.objects()
    sheets = [names[k : k + _AT_ONCE] for k in range(0, len(names), _AT_ONCE)]
    parts = run_in_order(partial(masks_of, glyphs), list(product(seeds, sheets)), workers)
    total = len(seeds) * len(names)
    pairs = counted(chain.from_iterable(parts), progress, "draw targets", total, "targets")
    masks, sizes = zip(*pairs, strict=True)
    found = DrawnTargets(AboutDrawn(key, float(sizes[0])), torch.from_numpy(np.stack(masks)).half())
    with suppress(OSError):  # where nothing can be kept they are drawn anew each time
        DRAWN.write(path, {"masks": found.masks}, found.about)
    return found


def folder_of(setup: str | Path) -> Path:
    """Return the folder of a setup that is named by it or by its file."""
    path = Path(setup)
    return path.parent if path.is_file() else path


def masks_of(glyphs: Glyphs, sheet: tuple[int, list[str]]) -> list[tuple[NDArray, float]]:
    """Return mask and side of some targets.

    Args:
        glyphs: Their set.
        sheet: Seed of the population, names.
    """
    seed, names = sheet
    found = list[tuple[NDArray, float]]()
    for name in names:
        target = glyphs.target(name, seed)
        side = target.size_m / _SIDE
        found.append((target.rasterise(Plane(_SIDE, _SIDE, side)).astype(np.float32), target.size_m))
    return found


def bent(planes: Tensor, generator: torch.Generator) -> Tensor:
    """Return planes [B, P, P] turned, stretched, slanted, moved and bent a little, each at random."""
    count = len(planes)

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=generator)

    turn, slant = _TURN * normal(), _SLANT * normal()
    wide, high = torch.exp(_WIDTH * normal()), torch.exp(_HEIGHT * normal())
    rows = [turn.cos() * wide, slant - turn.sin() * high, turn.sin() * wide, turn.cos() * high]
    affine = torch.cat([torch.stack(rows, dim=1).unflatten(1, (2, 2)), _PLACE * normal(2, 1)], dim=2)
    grid = F.affine_grid(affine, [count, 1, *planes.shape[1:]], align_corners=False)
    field = _BEND * normal(2, _WAVES, _WAVES)
    field = F.interpolate(field, planes.shape[1:], mode="bicubic", align_corners=False)
    grid = grid + field.permute(0, 2, 3, 1)
    return F.grid_sample(planes[:, None], grid, align_corners=False)[:, 0].clamp(0, 1)


@dataclass(frozen=True, eq=False)
class KnownSequence:
    """A sequence of a known target: frames and truth [N, H, W], places [N, 2], and what solves its frames.

    What the solver has learned from this very sequence would hide its errors: give one that has not.
    """

    frames: Tensor
    truth: Tensor
    position_m: Tensor
    solver: PooledFrames


def known_sequences(
    frames: Tensor,
    truth: Tensor,
    position_m: Tensor,
    names: NDArray[np.str_],
    solver: PooledFrames,
    own: Mapping[str, PooledFrames],
) -> list[KnownSequence]:
    """Return sequences of known targets, at most 64.

    Args:
        frames: Of all of them, white levels, [N, H, W].
        truth: True images on the canvas, [N, H, W].
        position_m: The target's centre at each, [N, 2].
        names: Sequence of each, [N].
        solver: Solves their frames,
        own: but for those that it has learned from: by their names.
    """
    found, every = list[KnownSequence](), list(dict.fromkeys(names.tolist()))
    for name in every[:: -(-len(every) // _MOST_KNOWN)]:
        mine = torch.from_numpy(np.flatnonzero(names == name))
        found.append(KnownSequence(frames[mine], truth[mine], position_m[mine], own.get(name, solver).cpu()))
    return found


def subsets(steps: int, count: int, draw: np.random.Generator) -> Tensor:
    """Return subsets of the time steps, [K, N]: all, every other, then at least a quarter at random.

    Args:
        steps: N.
        count: K.
        draw: Draws those at random.
    """
    kept = torch.zeros(count, steps)
    for number in range(count):
        chosen: NDArray[np.int64] | slice = slice(0, None, 1 + (number == 1))
        if number > 1 and steps > 1:
            few = int(draw.integers(max(1, steps // 4), steps + 1))
            chosen = draw.permutation(steps)[:few]
        kept[number, chosen] = 1
    return kept


class DrawnFrames:
    """What the frames of newly drawn targets say, solved: b = M x + what known targets show that is missed.

    Args:
        solver: What they are solved with.
        known: Sequences of known targets, cut to as many time steps as nine in ten have; shorter ones tell
            nothing. New targets go the way that is nearest to all of theirs.
        grid: The square that is drawn.
    """

    def __init__(self, solver: PooledFrames, known: Sequence[KnownSequence], grid: TargetGrid) -> None:
        steps = sorted(len(one.frames) for one in known)[len(known) // 10]
        alike = [one for one in known if len(one.frames) >= steps]
        self._solver, self._grid = solver, grid
        self.kept = subsets(steps, _COUNT, np.random.default_rng(0))
        ways = torch.stack([one.position_m[:steps] for one in alike])
        apart = torch.cdist(ways.flatten(1).double(), ways.flatten(1).double()).sum(dim=1)
        places = ways[int(apart.argmin())]
        cells = Plane(grid.side // FINER, grid.side // FINER, grid.pitch_m * FINER)
        self._seen, self._base, self._information = solver.foreseen(cells, places, self.kept)
        missed = [
            one.solver.errors(one.frames[:steps], one.truth[:steps], way, self.kept)
            for one, way in zip(alike, ways, strict=True)
        ]
        # Of A + 1, so that what is not seen scatters too; with the root of A alone networks learn no more.
        roots = root_of(self._information.numpy() + np.eye(self._information.shape[-1]))
        units = np.linalg.solve(roots, torch.stack(missed, dim=2).numpy())  # [K, k, C]
        self._errors = [ScoreErrors.of(mine.T) for mine in units]
        self._roots = torch.from_numpy(roots)

    def __call__(self, planes: Tensor, generator: torch.Generator) -> Tensor:
        """Return the maps of planes [B, P, P], [B, S, P, P]: of all time steps, or of some."""
        some = torch.rand((), generator=generator) < 0.5
        k = int(torch.randint(len(self.kept), (), generator=generator)) if some else 0
        cells = F.avg_pool2d(planes[:, None], FINER).flatten(1)
        missed = self._errors[k].draw(len(cells), generator) @ self._roots[k]
        score = (cells @ self._seen[k].T).double() + self._base[k] + missed
        return self._solver.maps(self._information[k], score, self._grid)


class DrawnEvents:
    """What the events of newly drawn targets say, solved: b = A z + what captures show that is missed.

    A is that of one of the four captures whose targets are nearest in light.

    Args:
        sampling: Names the setup, and says whether its errors are taken from events (`corrected`).
        grid: The square that is drawn.
        scale: Brings images to the scale that the network sees, [B, 2, P, P] -> the same.
        position_m: Places of the target in a sequence, [N, 2].

    Raises:
        DataError: The setup's folder says nothing of its errors.
    """

    def __init__(
        self, sampling: Sampling, grid: TargetGrid, scale: Callable[[Tensor], Tensor], position_m: Tensor
    ) -> None:
        known = event_errors(folder_of(sampling.setup), "leave --drawn at 0")
        self._prior = event_prior(load_setup(sampling.setup), target_side_m(sampling.canvas))
        self._grid, self._scale = grid, scale
        self._errors = ScoreErrors.of(known.errors.double().numpy(), 1.0)
        self._roots, self._log_light = known.roots.double(), known.light.log()
        corrected = sampling.surface == "corrected"  # which has lost what all share
        if corrected:
            self._errors = replace(self._errors, mean=np.zeros_like(self._errors.mean))
        told = known.told(corrected=corrected)
        self._back = torch.from_numpy(np.stack([one.solutions(EVENT_PRIORS) for one in told]))  # [C, n, k, k]
        spot = torch.zeros(grid.side, grid.side)
        spot[grid.side // 2, grid.side // 2] = 1
        spread = grid.mean(grid.on_canvas(spot, position_m), position_m)  # by the pixels of the canvas
        near = slice(grid.side // 2 - 4, grid.side // 2 + 5)
        self._blur = (spread[near, near] / spread.sum()).flip(-1, -2)[None, None]

    def __call__(self, planes: Tensor, generator: torch.Generator) -> Tensor:
        """Return the solved images of planes [B, P, P], [B, 2, P, P]."""
        prior, size_m = self._prior, self._prior.target_plane.extent_m[0]
        inner = self._grid.target_of(planes, size_m, prior.target_plane.height)
        z = torch.from_numpy(prior.coefficients(inner.double().numpy()))
        like = self._like(inner, generator)
        errors = self._errors.draw(len(z), generator)
        score = torch.einsum("bkl,bl->bk", self._roots[like], z) + errors  # R^-1 b
        found = torch.einsum("bnkl,bl->bnk", self._back[like], score)
        images = torch.from_numpy(prior.image(found.numpy())).clamp(0, 1)
        seen = self._grid.of_target(images.float(), size_m)
        return self._scale(F.conv2d(seen.flatten(0, 1)[:, None], self._blur, padding="same").view_as(seen))

    def _like(self, targets: Tensor, generator: torch.Generator) -> Tensor:
        """Return the capture whose information targets [B, h, h] have: one of those as bright as they are."""
        apart = (targets.flatten(1).mean(dim=1).clamp_min(1e-6).log()[:, None] - self._log_light).abs()
        few = apart.argsort(dim=1)[:, :_ALIKE]
        chosen = torch.randint(few.shape[1], (len(few), 1), generator=generator)
        return few.gather(1, chosen)[:, 0]


class DrawnSequences:
    """Sequences of newly drawn targets as a network sees them, without end.

    Args:
        targets: What is drawn.
        grid: The square that is drawn.
        parts: Make the channels of planes, in their order.
    """

    def __init__(
        self,
        targets: DrawnTargets,
        grid: TargetGrid,
        parts: Sequence[Callable[[Tensor, torch.Generator], Tensor]],
    ) -> None:
        self._targets, self._grid, self._parts = targets, grid, parts

    def batch(self, count: int, seed: int) -> tuple[Tensor, Tensor]:
        """Return inputs [B, S, P, P] and true images [B, 1, P, P], float32; the same for the same seed."""
        generator = torch.Generator().manual_seed(seed)
        masks, size_m = self._targets.masks, self._targets.about.size_m
        chosen = torch.randint(len(masks), (count,), generator=generator)
        planes = bent(self._grid.of_target(masks[chosen].float(), size_m), generator)
        return torch.cat([part(planes, generator) for part in self._parts], dim=1), planes[:, None]
