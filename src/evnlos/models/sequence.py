"""The reconstructor of whole sequences: all time steps seen from the target plane, pooled, one image of it.

- What all frames of a sequence say of the target, through the light path of a setup: closed form.
- The network behind what is pooled.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from evnlos.data import InMemoryDataset, Modality, NlosDataset, Sampling, as_modality
from evnlos.errors import ConfigError, DataError
from evnlos.inverse.operators import ridge_by_groups
from evnlos.inverse.prior import handwritten_prior
from evnlos.inverse.sequence_light import main_factors
from evnlos.inverse.sequence_problem import SequenceOperator
from evnlos.models.drawn import (
    DrawnEvents,
    DrawnFrames,
    DrawnSequences,
    TargetGrid,
    drawn_targets,
    known_sequences,
    subsets,
)
from evnlos.models.embedding import FrameOperator, InputNormalization, LinearEmbeddings, fit_input
from evnlos.models.reconstructor import RECONSTRUCTORS, Drawn, Reconstructor
from evnlos.models.unet import PARTS, PooledScale, ResidualUNet, UNetConfig
from evnlos.optics import MatrixTransport
from evnlos.setups import Setup, load_setup
from evnlos.types import Plane, derive_seed, target_side_m


@RECONSTRUCTORS.register
@dataclass(frozen=True)
class SequenceConfig(UNetConfig):
    """A network of whole sequences, which pools the linear embedding over the time steps: kind `sequence`."""

    kind: str = "sequence"
    """Kind of the reconstructor."""
    frames: Literal["embedding", "likelihood"] = "embedding"
    """How frames become images of the target: the mean of the linear `embedding` of each, or the targets that
    all frames together make most likely through the light path of the samples' setup (`likelihood`)."""
    prior_weights: tuple[float, ...] = (0.1, 0.5, 2.0, 10.0)
    """Weights of the prior over its own at which the frames are solved for the target, one image each; for
    `likelihood`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.prior_weights or not all(0 < weight < math.inf for weight in self.prior_weights):
            raise ConfigError(f"SequenceConfig.prior_weights is {self.prior_weights}; give some, all above 0")
        if not self.rank:
            raise ConfigError("SequenceConfig.rank is 0; a sequence network pools its embedding: give a rank")

    def build(self, modality: str | Modality, sampling: Sampling) -> Reconstructor:
        """Return a reconstructor of whole sequences with random weights."""
        return SequenceReconstructor(as_modality(modality), self, sampling)


_COEFFICIENTS, _CELLS_ACROSS = 150, 32  # of prior, target
_FEWEST = 8  # objects to tell gain, offset and noise from
_FEWEST_CAPTURES, _MOST_FRAMES, _PARTS = 4, 2048, 4  # that correct the light path; parts left out in turn
_ALONG = 7  # terms of a polynomial of the position: 1, x, x^2, x^3, y, x y, y^2
_RIDGE, _AT_ONCE = 1e-6, 1024  # at once: frames
_KEPT_ROWS = 3  # of as many motions: a sequence, its first half and its second


def _forget(frames: nn.Module, _: object) -> None:
    """Forget the rows of the last sequences, which were those of other numbers."""
    assert isinstance(frames, PooledFrames)
    frames._last.clear()


class PooledFrames(nn.Module):
    """All frames of a sequence solved for the target, [N, H, W] -> [S, h, h]: one linear-Gaussian estimate.

    In the main components of the light path, in units of their noise, a frame k with the target at p_k is

        c_k = B^T (y_k - ambient) = along(p_k) + A_k (m + V z) + offset + noise

    with A_k the canvas seen from the target plane, m and V mean and patterns of a Gaussian prior over targets,
    `along` the light of what moves with the target (a polynomial of its place), and an offset that is the same
    in all frames of a sequence: unforeseen ambient light, a fixed pattern. With it integrated out, J = A V
    and C what is left, the estimate at a weight w of the prior is

        z_w = (sum_k J_k^T C^-1 J_k + w)^-1 sum_k J_k^T C^-1 (c_k - along - A_k m)

    Light path and prior are those of the setup; the error of a component (noise, and how far the simulated
    setups scatter), the scatter of the offset, and what moves along are taken from simulated samples. These
    numbers are not trained by gradients, and need no setup any more once they are there.

    Args:
        sampling: Size of the maps and their pitch on the target's canvas.
        prior_weights: Weights of the prior, one image each.
        rank: Most components of the light path.
    """

    ambient: Tensor
    basis: Tensor
    light: Tensor
    along: Tensor
    reach: Tensor
    static: Tensor
    mean: Tensor
    patterns: Tensor

    def __init__(self, sampling: Sampling, prior_weights: tuple[float, ...], rank: int) -> None:
        super().__init__()
        self.sampling, self.weights = sampling, prior_weights
        self.target_plane = Plane(_CELLS_ACROSS, _CELLS_ACROSS, target_side_m(sampling.canvas) / _CELLS_ACROSS)
        height, width = sampling.height, sampling.width
        rank = min(rank, height * width)
        self.register_buffer("ambient", torch.zeros(height, width))
        self.register_buffer("basis", torch.zeros(height * width, rank))
        self.register_buffer("light", torch.zeros(rank, height, width))
        self.register_buffer("along", torch.zeros(_ALONG, rank))
        self.register_buffer("reach", torch.tensor([[0.0, 0.0], [1.0, 1.0]]))
        self.register_buffer("static", torch.zeros(rank))
        self.register_buffer("mean", torch.zeros(self.target_plane.shape))
        self.register_buffer("patterns", torch.zeros(_COEFFICIENTS, *self.target_plane.shape))
        self._last = OrderedDict[bytes, tuple[Tensor, Tensor, Tensor]]()
        self.register_load_state_dict_post_hook(_forget)

    @property
    def images(self) -> int:
        """Images that come out for each sequence."""
        return len(self.weights)

    def fit(
        self, setup: Setup, frames: Tensor, truth: Tensor, position_m: Tensor, names: NDArray[np.str_]
    ) -> None:
        """Take light path and prior from a setup, and the errors from samples of it.

        Args:
            setup: A linear setup.
            frames: Simulated frames, white levels, [N, H, W].
            truth: True images on the canvas, [N, H, W].
            position_m: The target's centre at each, (x, y) in metres, [N, 2].
            names: Object of each, [N].

        Raises:
            ConfigError: The setup is not linear.
            DataError: There are fewer than 8 objects.
        """
        objects = np.unique(names, return_inverse=True)[1]
        owner, count = torch.from_numpy(objects), int(objects.max()) + 1
        if count < _FEWEST:
            raise DataError(f"{count} objects to tell light from noise; give {_FEWEST} or more")
        operator = FrameOperator(setup, self.sampling)
        matrix, ambient, rows = operator.matrix, operator.ambient.unflatten(0, operator.size), operator.rows
        left, right = main_factors(matrix, self.basis.shape[1], _RIDGE)
        values, kept = left.norm(dim=0), len(right)
        basis, carry = left / values, right.T * values  # [h w, r], [cells, r]
        parts = [slice(at, at + _AT_ONCE) for at in range(0, len(frames), _AT_ONCE)]
        code = torch.cat([(frames[part].float() - ambient).flatten(1) @ basis for part in parts])
        clean = torch.cat([truth[part][:, rows].float().flatten(1) @ carry for part in parts])

        def mean_of(values: Tensor) -> Tensor:
            total = values.new_zeros((count, *values.shape[1:])).index_add_(0, owner, values)
            return total / torch.bincount(owner).reshape(-1, *[1] * (values.ndim - 1))

        moving, seen = clean - mean_of(clean)[owner], code - mean_of(code)[owner]
        gain = mean_of((moving * seen).sum(dim=1)) / mean_of(moving.square().sum(dim=1)).clamp_min(1e-12)
        left = code - gain[owner, None] * clean
        self.reach.copy_(torch.stack([position_m.amin(dim=0), position_m.amax(dim=0)]))
        terms = self.terms_along(position_m)
        along = _polynomial(terms, left)
        left = left - terms @ along
        offset = mean_of(left)
        noise = (left - offset[owner]).double()
        # Few samples do not tell the noise of all components, which is at least that of the camera.
        variance, turn = torch.linalg.eigh(noise.T @ noise / len(noise))
        white = (turn / (variance.clamp_min(operator.sigma**2) * setup.frame_doubt).sqrt()).T
        shifts = (offset - offset.mean(dim=0)).double()
        for buffer in (self.basis, self.light, self.along, self.static):
            buffer.zero_()
        self.ambient.copy_(ambient)
        light = torch.zeros(kept, *operator.size)
        light[:, rows] = carry.T.unflatten(1, (-1, operator.size[1]))
        # The camera's pattern, where nobody removes it, may be as large as the noise of a frame.
        self.take_components(basis, light, along, shifts.T @ shifts / count + (turn * variance) @ turn.T, white)
        prior = handwritten_prior(self.target_plane, _COEFFICIENTS, ink=setup.ink)
        self.mean.copy_(torch.from_numpy(prior.mean).unflatten(0, self.target_plane.shape))
        self.patterns.copy_(torch.from_numpy(prior.patterns.T.copy()).unflatten(1, self.target_plane.shape))
        self._last.clear()

    def correct(self, frames: Tensor, truth: Tensor, position_m: Tensor, names: NDArray[np.str_]) -> None:
        """Take from captures with known targets what the setup's light path gets wrong.

        What the components hold beside the predicted light is linear in the image on the canvas: ridge
        regression (`ridge_by_groups`), each capture left out in turn, beside an offset of each capture and what
        moves along. What captures left out miss after it is noise to a new target; where its covariance is more
        than that of the samples the components are taken in units of it. Fewer than 4 captures change nothing.

        Args:
            frames: White levels, [N, H, W].
            truth: True images on the canvas, [N, H, W].
            position_m: The target's centre at each, (x, y) in metres, [N, 2].
            names: Capture of each, [N].
        """
        found, owner = np.unique(names, return_inverse=True)
        if len(found) < _FEWEST_CAPTURES:
            return
        some = torch.arange(0, len(owner), math.ceil(len(owner) / _MOST_FRAMES))
        group, terms = torch.from_numpy(owner)[some], self.terms_along(position_m[some])
        shown = truth[some].float().flatten(1)
        code = (frames[some].float() - self.ambient).flatten(1) @ self.basis
        steady = F.normalize(F.one_hot(group).float(), dim=0)  # a column a capture
        common = torch.linalg.qr(torch.cat([steady, terms[:, 1:]], dim=1)).Q
        moving, own = (values - common @ (common.T @ values) for values in (shown, code))
        light = moving @ self.light.flatten(1).T
        gain = (light * own).sum() / light.square().sum().clamp_min(1e-12)
        errors, missed = ridge_by_groups(moving, own - gain * light, group)
        self.light += (errors.T / gain).view_as(self.light)
        self.along.copy_(_polynomial(terms, code - gain * (shown @ self.light.flatten(1).T)))
        variance, turn = torch.linalg.eigh(missed.T @ missed / len(missed))
        white = (turn / variance.clamp_min(1.0).sqrt()) @ turn.T
        self.take_components(self.basis, self.light, self.along, self.static.diag().double(), white)
        self._last.clear()

    def take_components(
        self, basis: Tensor, light: Tensor, along: Tensor, offsets: Tensor, white: Tensor
    ) -> None:
        """Take components W c [k] of components c, turned so that their offsets are independent.

        Args:
            basis: Of c, [h w, k].
            light: Theirs, [k, h, w].
            along: Theirs, [7, k].
            offsets: Covariance of the offsets of c, float64 [k, k].
            white: W, float64 [k, k].
        """
        static, turn = torch.linalg.eigh(white @ offsets @ white.T)
        white, count = (turn.T @ white).float(), len(white)
        self.basis[:, :count] = basis @ white.T
        self.light[:count] = torch.tensordot(white, light, dims=1)
        self.along[:, :count] = along @ white.T
        self.static[:count] = static.clamp_min(0).float()

    def forward(self, frames: Tensor, position_m: Tensor, kept: Tensor) -> Tensor:
        """Return the solutions of subsets of the time steps, targets [K, S, h, h].

        Args:
            frames: White levels, [N, H, W].
            position_m: The target's centre at each, (x, y) in metres, [N, 2].
            kept: 1 where a subset has a time step, else 0, [K, N].
        """
        return self.solved(*self.told(frames, position_m, kept))

    def told(self, frames: Tensor, position_m: Tensor, kept: Tensor) -> tuple[Tensor, Tensor]:
        """Return what frames say, as `statistic` does; arguments of `forward`."""
        away = (frames.float() - self.ambient).flatten(1) @ self.basis - self._rows(position_m)[1]
        return self.statistic(away, position_m, kept)

    def statistic(self, away: Tensor, position_m: Tensor, kept: Tensor) -> tuple[Tensor, Tensor]:
        """Return information [K, k, k] and score [K, k] of subsets of the time steps, float64.

        Args:
            away: Components of the frames, less those of the mean target, [N, r].
            position_m: The target's centre at each, [N, 2].
            kept: 1 where a subset has a time step, else 0, [K, N].
        """
        rows, _, single = self._rows(position_m)  # J [N, k, r], J J^T [N, k, k]
        away, kept = away.double(), kept.double()
        summed, hidden = self._hidden(rows, kept)
        information = torch.tensordot(kept, single, dims=1) - hidden @ summed.mT
        score = kept @ (rows @ away[:, :, None])[..., 0] - (hidden @ (kept @ away)[:, :, None])[..., 0]
        return information, score

    def _hidden(self, rows: Tensor, kept: Tensor) -> tuple[Tensor, Tensor]:
        """Return the sum of the rows of each subset, and its share that an offset hides, [K, k, r] each."""
        static, summed = self.static.to(kept), torch.tensordot(kept, rows, dims=1)
        return summed, summed * (static / (1.0 + kept.sum(dim=1, keepdim=True) * static))[:, None]

    def solved(self, information: Tensor, score: Tensor) -> Tensor:
        """Return the targets of each weight of the prior, [K, S, h, h]; arguments of `statistic`."""
        own = torch.eye(len(self.patterns), dtype=torch.float64, device=score.device)
        found = []
        for weight in self.weights:
            root = torch.linalg.cholesky(information + weight * own)
            z = torch.cholesky_solve(score[..., None], root)[..., 0].float()
            found.append(self.mean + torch.tensordot(z, self.patterns, dims=1))
        return torch.stack(found, dim=1)

    def maps(self, information: Tensor, score: Tensor, grid: TargetGrid) -> Tensor:
        """Return what a network sees of the statistic, the solved targets on the square drawn, [K, S, P, P]."""
        return grid.of_target(self.solved(information, score), self.target_plane.extent_m[0])

    def errors(self, frames: Tensor, truth: Tensor, position_m: Tensor, kept: Tensor) -> Tensor:
        """Return by how much scores miss, [K, k], where the truth on the canvas is known: [N, H, W]."""
        light = truth.float().flatten(1) @ self.light.flatten(1).T + self.terms_along(position_m) @ self.along
        away = (frames.float() - self.ambient).flatten(1) @ self.basis - light
        return self.statistic(away, position_m, kept)[1]

    def foreseen(self, plane: Plane, position_m: Tensor, kept: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return M [K, k, cells], b [K, k] and the information [K, k, k]: the score of a target x is M x + b.

        Args:
            plane: Cells of the target.
            position_m: As of `forward`.
            kept: As of `forward`.
        """
        rows, known, _ = self._rows(position_m)
        away = self.terms_along(position_m) @ self.along - known
        information, base = self.statistic(away, position_m, kept)
        carrier = MatrixTransport(self.light.flatten(1), self.sampling.canvas, (1, len(self.light)))
        seen = torch.zeros(len(kept), len(self.light), plane.height * plane.width)
        told = torch.zeros(len(kept), len(self.patterns), plane.height * plane.width)
        for step, place in enumerate(position_m.cpu().double().numpy()):  # one at a time: all would not fit
            light = SequenceOperator(carrier, plane, place[None]).matrix()[0]
            mine = kept[:, step].nonzero()[:, 0]
            seen[mine] += light
            told[mine] += rows[step].float() @ light
        _, hidden = self._hidden(rows, kept.double())
        return told - hidden.float() @ seen, base, information

    def keep(self, rank: int) -> None:
        """Forget all but the `rank` components that carry most light; see `LinearEmbeddings.keep`."""
        if not 1 <= rank <= len(self.light):
            raise ConfigError(f"the rank is to be {rank}; the frames have {len(self.light)}: give 1 or more")
        most = self.light.square().sum(dim=(1, 2)).topk(rank).indices.sort().values
        self.basis, self.along = self.basis[:, most].clone(), self.along[:, most].clone()
        self.light, self.static = self.light[most].clone(), self.static[most].clone()
        self._last.clear()

    def _rows(self, position_m: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return rows, known light and their products; sequences of the same places share them."""
        key = str(self.light.device).encode() + position_m.cpu().numpy().tobytes()
        if key not in self._last:
            carrier = MatrixTransport(self.light.flatten(1), self.sampling.canvas, (1, len(self.light)))
            seen = SequenceOperator(carrier, self.target_plane, position_m.cpu().double().numpy()).matrix()
            rows = (seen @ self.patterns.flatten(1).T).mT.double()  # [N, k, r]; sums lose digits in float32
            known = self.terms_along(position_m) @ self.along + seen @ self.mean.flatten()
            self._last[key] = rows, known, rows @ rows.mT
            while len(self._last) > _KEPT_ROWS:
                self._last.popitem(last=False)
        self._last.move_to_end(key)
        return self._last[key]

    def terms_along(self, position_m: Tensor) -> Tensor:
        """Return the terms of the polynomial, [N, 7]; a place beyond all that were seen is the nearest one.

        Args:
            position_m: The target's centres, (x, y) in metres, [N, 2].
        """
        low, high = self.reach
        at = position_m.to(self.reach).clamp(low, high)
        x, y = ((at - (low + high) / 2) / ((high - low) / 2).clamp_min(1e-6)).unbind(dim=1)
        return torch.stack([torch.ones_like(x), x, x**2, x**3, y, x * y, y**2], dim=1)


def _polynomial(terms: Tensor, values: Tensor) -> Tensor:
    """Return the factors [7, r] of terms [N, 7] that come nearest to values [N, r]."""
    gram = (terms.T @ terms).double() + _RIDGE * len(terms) * torch.eye(_ALONG, dtype=torch.float64)
    return torch.linalg.solve(gram, (terms.T @ values).double()).float()


class SequenceReconstructor(Reconstructor):
    """All time steps -> the target plane: embed each, look at it from the plane, take the mean, then a U-Net.

    The linear embedding of each time step is read at the plane's own pixels, wherever the plane was then. The
    mean over the time steps has less noise the more there are, so weaker ridges, sharper and noisier, become
    useful. Frames may be solved for the target all at once instead (`PooledFrames`). What is trained by
    gradients is the U-Net behind it. Pooling over a set after Zaheer et al., Deep Sets, NeurIPS 2017; the
    alignment is the known motion.

    Args:
        modality: What it sees.
        settings: U-Net and embedding.
        sampling: Size of the maps and their pitch on the target's canvas.

    Raises:
        ConfigError: The pitch is too fine for the square that is drawn.
    """

    sees_sequence = True
    parts = PARTS
    solver_of_frames: ClassVar[type[PooledFrames]] = PooledFrames
    """Solves frames, and makes of it what the network sees."""

    def __init__(self, modality: Modality, settings: SequenceConfig, sampling: Sampling) -> None:
        super().__init__(modality, settings, sampling)
        self.settings: SequenceConfig = settings
        size = (sampling.height, sampling.width)
        self.normalization = InputNormalization(modality, settings.scaling)
        solved = "surface" if sampling.is_solved else ""
        left_out = "frame" if settings.frames == "likelihood" else ""
        own = [modality.slices[group.name] for group in modality.groups if group.maps == (left_out,)]
        self._frame = own[0].start if own else None
        self.embedding = LinearEmbeddings(
            modality, size, settings.rank, settings.ridge_multipliers, solved, left_out
        )
        how = sampling, settings.prior_weights, settings.rank
        self.frames = None if self._frame is None else self.solver_of_frames(*how)
        images = self.embedding.images + (0 if self.frames is None else self.frames.images)
        self.scale = PooledScale(images)
        self.unet = self.image_network(images)
        self.draws_sequences = not self.embedding.groups
        self._corrects = False
        self._own: dict[str, PooledFrames] = {}  # of captures that correct the light path: by others
        self.grid = TargetGrid(sampling)

    def image_network(self, images: int) -> nn.Module:
        """Return what is trained by gradients, with random weights: from so many images to the target."""
        return ResidualUNet(images, self.settings)

    def images_of(self, pooled: Tensor) -> Tensor:
        """Return those of pooled maps [B, S, P, P] that are images, and brought to one scale: here all."""
        return pooled

    def forward(self, x: Tensor) -> Tensor:
        """Map pooled maps [B, S, P, P] to images of the target plane [B, 1, P, P], 0..1."""
        return self.unet(self.scale(x))

    def fit(self, subset: Callable[[int], Drawn], seed: int, *, is_new: bool, keep_normalization: bool) -> None:
        """Fit the normalization and, where the weights are random, the linear embedding."""
        self._corrects = not is_new  # a training that goes on has the corrected light path in its checkpoint
        fit_input(
            self.normalization,
            self.embedding,
            subset,
            seed,
            is_new=is_new,
            keep_normalization=keep_normalization,
        )

    def training_samples(
        self, samples: NlosDataset, augmentations: int, seed: int, *, is_new: bool
    ) -> InMemoryDataset:
        """Return pooled sequences: of each object all time steps, every other one, then random subsets.

        Subsets have other noise and fewer angles on the same target, so that short sequences are met too.

        Args:
            samples: The samples of single time steps.
            augmentations: Pooled maps of each object.
            seed: Seed of the subsets.
            is_new: Whether the scale of the pooled maps is taken from these samples.

        Returns:
            Inputs float16 [M, S, P, P], true images of the target plane float16 [M, P, P].

        Raises:
            DataError: The motion of an object is unknown.
            ConfigError: Frames are to be solved through the light path of a setup, and none is named.
        """
        inputs, truth, names = [], [], []
        self.check_samples(samples, is_new=is_new)
        begins = self.frames is not None and (is_new or self._corrects)
        self._own = own = self._fit_frames(samples, is_new=is_new) if begins else {}
        draw = np.random.default_rng(derive_seed(seed, "views"))
        device = next(self.parameters()).device
        for name in dict.fromkeys(samples.names.tolist()):
            mine = np.flatnonzero(samples.names == name)
            places = torch.from_numpy(samples.position_m[mine])
            plane = self.grid.mean(samples.truth[torch.from_numpy(mine)], places).half().cpu()
            kept = subsets(len(mine), augmentations, draw)
            seen = samples.inputs[torch.from_numpy(mine)].to(device)
            inputs.append(self.pooled_subsets(seen, places, kept, own.get(name)).half().cpu())
            truth += augmentations * [plane]
            names += augmentations * [name]
        found = InMemoryDataset(torch.cat(inputs), torch.stack(truth), np.array(names))
        if is_new:
            self.scale.fit(self.images_of(found.inputs))
        return found

    def drawn_sequences(
        self, samples: NlosDataset, known: NlosDataset | None, seed: int, *, is_new: bool
    ) -> DrawnSequences:
        """Return sequences of newly drawn targets as `forward` sees them; see `models.drawn`.

        Args:
            samples: The samples of single time steps; a new network takes light path and scale from them.
            known: Captures with known targets, which show what the setup gets wrong; None: the samples do.
            seed: Seed of the sequences that the scale is taken from.
            is_new: Whether light path and scale are taken; else `training_samples` was asked before.
        """
        if is_new and self.frames is not None:
            self._fit_frames(samples, is_new=True)
        shown, parts = samples if known is None else known, list[Callable[[Tensor, torch.Generator], Tensor]]()
        places = torch.from_numpy(shown.position_m)
        if self.frames is not None:
            solver, frames = deepcopy(self.frames).cpu(), shown.inputs[:, self._frame].cpu()
            sequences = known_sequences(frames, shown.truth.cpu(), places, shown.names, solver, self._own)
            parts.append(DrawnFrames(solver, sequences, self.grid))
        if self.embedding.images:
            of_one = places[shown.names == shown.names[0]]
            scale = deepcopy(self.normalization).cpu().of_surface
            parts.append(DrawnEvents(self.sampling, self.grid, scale, of_one))
        found = DrawnSequences(drawn_targets(self.sampling.setup), self.grid, parts)
        if is_new:
            few = [found.batch(64, derive_seed(seed, "scale", number))[0] for number in range(4)]
            self.scale.fit(self.images_of(torch.cat(few).half()))
        return found

    def check_samples(self, samples: NlosDataset, *, is_new: bool) -> None:
        """Refuse samples of unknown motion, and those without a setup where frames are solved through one."""
        unknown = samples.names[np.isnan(samples.position_m).any(axis=1)]
        if len(unknown):
            raise DataError(
                f"the motion of {unknown[0]} is unknown, and a sequence network pools positions; "
                "give it in capture.yaml, or train on single time steps (--network.kind unet)"
            )
        if not is_new or self.frames is None:
            return
        if not self.sampling.setup:
            raise ConfigError(
                "Sampling.setup is empty, and network.frames is 'likelihood', which undoes the light path of a "
                "setup: make the samples with --sampling.setup FOLDER of `evnlos calibrate`"
            )
        load_setup(self.sampling.setup)  # which refuses one that is not there

    def _fit_frames(self, samples: NlosDataset, *, is_new: bool) -> dict[str, PooledFrames]:
        """Take the setup's light path, or correct it: each capture by others, as new targets are."""
        assert self.frames is not None
        device, places = self.frames.basis.device, torch.from_numpy(samples.position_m)
        frames, truth = samples.inputs[:, self._frame].cpu(), samples.truth.cpu()
        own, names = dict[str, PooledFrames](), np.unique(samples.names)
        for part in () if is_new else (names[k::_PARTS] for k in range(_PARTS)):
            one, others = deepcopy(self.frames).cpu(), np.flatnonzero(~np.isin(samples.names, part))
            rows = torch.from_numpy(others)
            one.correct(frames[rows], truth[rows], places[rows], samples.names[others])
            own |= dict.fromkeys(part.tolist(), one.to(device))
        self.frames.cpu()
        if is_new:
            self.frames.fit(load_setup(self.sampling.setup), frames, truth, places, samples.names)
        else:
            self.frames.correct(frames, truth, places, samples.names)
        self.frames.to(device)
        return own

    def draw(self, inputs: Tensor, position_m: Tensor, at_m: Tensor) -> Tensor:
        """Return images of one object at positions `at_m`, [M, H, W], from its sequence."""
        plane = self(self.pooled(inputs, position_m)[None])[0, 0]
        return self.grid.on_canvas(plane, at_m)

    def reduced(self, rank: int) -> Reconstructor:
        """Return a copy whose linear embedding has fewer components, the strongest."""
        copy = deepcopy(self)
        if copy.frames is not None:
            copy.frames.keep(rank)
        if copy.embedding.groups:
            copy.embedding.keep(rank)
        copy.settings = replace(copy.settings, rank=rank)
        return copy

    def pooled(self, inputs: Tensor, position_m: Tensor) -> Tensor:
        """Return the mean of the embedded time steps as the target plane sees them, [S, P, P].

        Arguments as in `pooled_subsets`.
        """
        return self.pooled_subsets(inputs, position_m, torch.ones(1, len(inputs)))[0]

    @torch.no_grad()
    def pooled_subsets(
        self, inputs: Tensor, position_m: Tensor, kept: Tensor, frames: PooledFrames | None = None
    ) -> Tensor:
        """Return `pooled` of subsets of the time steps, [K, S, P, P]; each step is embedded once for all.

        Args:
            inputs: What was recorded at N time steps, [N, C, H, W].
            position_m: The plane's centre on the canvas, (x, y) in metres, [N, 2].
            kept: 1 where a subset has a time step, else 0, float32 [K, N]; its last `so-far` surface counts.
            frames: What frames are solved through; by default the network's own.

        Raises:
            DataError: The plane is off the canvas at all time steps of a subset.
        """
        last = F.one_hot(kept.cumsum(dim=1).argmax(dim=1), len(inputs)).to(kept)
        shown = last if self.sampling.surface == "so-far" else kept
        embeds = self.embedding.images > 0

        def embedded(part: Tensor) -> Tensor:
            return self.embedding(self.normalization(part.float()))

        means = self.grid.means(inputs, position_m, shown, embedded if embeds else None)
        maps = [] if means is None else [means]
        if (solver := frames or self.frames) is not None:
            with torch.autocast(inputs.device.type, enabled=False):
                told = solver.told(inputs[:, self._frame], position_m, kept.to(inputs.device))
                maps.insert(0, solver.maps(*told, self.grid))
        return torch.cat(maps, dim=1)

    @classmethod
    def today(cls, name: str, modality: Modality) -> str:
        """Return today's name of a tensor; before, the scale of the pooled maps was the U-Net's own."""
        if name.startswith("unet.standardise."):
            return f"scale.{name.rpartition('.')[2]}"
        return InputNormalization.today(name, modality)
