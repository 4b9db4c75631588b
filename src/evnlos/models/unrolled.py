"""The unrolled reconstructor of whole sequences: steps from what the measurement says against the image so far.

A sequence says of the coefficients z of the prior's patterns b = A z + noise (`inverse/sequence_statistic.py`,
`models/sequence.py`). With C = (A + 1)^-1 the covariance of z after it and z_1 = C b its mean, the gradient of
the log-likelihood at an image x, in the metric of C, is

    C (b - A z(x)) = z_1 - z(x) + C z(x)

and needs no number above a few, whatever the information. Each step shows a small network x, this gradient as
an image, how sure the measurement is of each pixel, and the solved images, and adds its answer to the log odds
of x. After Adler and Oektem, Learned primal-dual reconstruction, IEEE TMI 2018.

- What frames say: C and z_1 stand beside the solved images, as further numbers of a sample.
- What events say: recorded maps hold the solved images alone; information is that of the calibrated setup's
  known captures, as strong as it was for targets as bright.
- The steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from evnlos.data import Modality, Sampling, as_modality
from evnlos.errors import ConfigError
from evnlos.inverse.event_images import CELLS, event_errors, event_prior
from evnlos.inverse.sequence_light import EVENT_PRIORS
from evnlos.models.drawn import TargetGrid, folder_of
from evnlos.models.reconstructor import RECONSTRUCTORS, Drawn, Reconstructor
from evnlos.models.sequence import PooledFrames, SequenceConfig, SequenceReconstructor
from evnlos.models.unet import PARTS, ResidualUNet
from evnlos.setups import load_setup
from evnlos.types import target_side_m


@RECONSTRUCTORS.register
@dataclass(frozen=True)
class UnrolledConfig(SequenceConfig):
    """A network of whole sequences in steps, each from the likelihood of what was recorded: kind `unrolled`."""

    kind: str = "unrolled"
    """Kind of the reconstructor."""
    frames: Literal["embedding", "likelihood"] = "likelihood"
    """How frames become images of the target: by the `likelihood` alone, from which the steps go."""
    width: int = 32
    """Channels at the finest level of each step's U-Net; they double at each level down, up to 8 times."""
    steps: int = 2
    """Steps, each with a network of its own; chosen with the width on validation characters."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps < 1:
            raise ConfigError(f"UnrolledConfig.steps is {self.steps}; give at least 1")
        if self.frames != "likelihood" or self.scaling != "dataset":
            raise ConfigError(
                f"UnrolledConfig.frames is {self.frames!r} and scaling {self.scaling!r}; steps from a "
                "likelihood need 'likelihood' and 'dataset': leave both out, or take --network.kind sequence"
            )

    def build(self, modality: str | Modality, sampling: Sampling) -> Reconstructor:
        """Return an unrolled reconstructor of whole sequences with random weights."""
        return UnrolledReconstructor(as_modality(modality), self, sampling)


_LEAST = 0.02  # of an image and of 1 less it, where the steps begin
_MODES = 80  # directions that events say most of, of 240; of others they say next to nothing
_DIMMEST = 1e-3  # mean light of a target, 0..1
_SEEN_PART = 1e-9  # of a direction, below and above which its strength tells nothing
_ROUNDS = 20  # of strengths and powers in turn
_LEAST_POWER, _MOST_POWER = 0.01, 1e4  # of a direction: of less nothing is known, and of more all


class Told(NamedTuple):
    """What a sequence says of the target, for the steps of a network.

    Args:
        start: The most likely target under the prior, [B, 1, P, P].
        score: Maps an image [B, 1, P, P] to the gradient of the log-likelihood there, in the metric of C.
        shown: What a step is shown beside it, [B, S, P, P].
    """

    start: Tensor
    score: Callable[[Tensor], Tensor]
    shown: Tensor


class UnrolledFrames(PooledFrames):
    """Frames solved for the target, with C and z_1 beside the images: float16 does not hurt numbers like these.

    The maps are an image for each weight of the prior, one of the standard deviation after the measurement in
    units of that before it, and packed numbers: z_1, then the upper triangle of C, row after row.
    """

    @property
    def images(self) -> int:
        """Images that come out for each sequence; packed numbers are none."""
        return super().images + 1

    def packed(self, grid: TargetGrid) -> int:
        """Return how many maps the packed numbers fill."""
        count = len(self.patterns)
        return -(-(count + count * (count + 1) // 2) // grid.side**2)

    @property
    def unit(self) -> Tensor:
        """Root of the variance of the prior, mean over the target's cells: []."""
        return self.patterns.square().sum(dim=0).mean().sqrt()

    def maps(self, information: Tensor, score: Tensor, grid: TargetGrid) -> Tensor:
        """Return images, deviation and packed numbers, [K, S + 1 + packed, P, P]."""
        count, size_m = len(self.patterns), self.target_plane.extent_m[0]
        own = torch.eye(count, dtype=information.dtype, device=information.device)
        covariance = torch.cholesky_inverse(torch.linalg.cholesky(information + own))  # [K or 1, k, k]
        z = (covariance @ score[..., None])[..., 0].float()
        covariance = covariance.float().reshape(-1, count, count)
        patterns = self.patterns.flatten(1)
        variance = torch.einsum("bkl,kn,ln->bn", covariance, patterns, patterns).clamp_min(0)
        deviation = (variance.sqrt() / self.unit).unflatten(1, (1, *self.target_plane.shape))
        rows, columns = torch.triu_indices(count, count, device=z.device)
        triangle = covariance[:, rows, columns].expand(len(z), -1)
        numbers = torch.cat([z, triangle], dim=1)
        filled = self.packed(grid) * grid.side**2 - numbers.shape[1]
        numbers = nn.functional.pad(numbers, (0, filled)).unflatten(1, (-1, grid.side, grid.side))
        images = torch.cat([self.solved(information, score), deviation.expand(len(z), -1, -1, -1)], dim=1)
        return torch.cat([grid.of_target(images, size_m), numbers], dim=1)

    def read(self, packed: Tensor, shown: Tensor, grid: TargetGrid) -> Told:
        """Return what packed maps say.

        Args:
            packed: The packed numbers, [B, packed, P, P].
            shown: Images at one scale, [B, S + 1, P, P].
            grid: The square that is drawn.
        """
        count, size_m = len(self.patterns), self.target_plane.extent_m[0]
        numbers = packed.flatten(1)
        rows, columns = torch.triu_indices(count, count, device=numbers.device)
        place = torch.zeros(count, count, dtype=torch.long, device=numbers.device)
        place[rows, columns] = place[columns, rows] = torch.arange(len(rows), device=numbers.device)
        z = numbers[:, :count]
        covariance = numbers[:, count : count + len(rows)][:, place]  # [B, k, k]
        patterns, mean = self.patterns.flatten(1), self.mean.flatten()
        readers = patterns / patterns.square().sum(dim=1, keepdim=True).clamp_min(1e-12)

        def image(coefficients: Tensor, base: Tensor | float = 0.0) -> Tensor:
            cells = (base + coefficients @ patterns).unflatten(1, (1, *self.target_plane.shape))
            return grid.of_target(cells, size_m)

        def score(x: Tensor) -> Tensor:
            cells = grid.target_of(x[:, 0], size_m, self.target_plane.height).flatten(1)
            here = (cells - mean) @ readers.T
            return image(z - here + (covariance @ here[:, :, None])[..., 0]) / self.unit

        return Told(image(z, mean), score, shown)


class UnrolledEvents(nn.Module):
    """What solved images of events say, with the information of the calibrated setup's known captures.

    How much events say depends on the target, and hardly on its shape: with U the main directions of the mean
    of C over the captures, C = 1 - U s U^T, s = g p / (1 + g p), fits each capture at its own strength g, and
    g falls with the mean light l of the target as a power of it: ln g = a + b ln l. Light is taken from the
    image by the stronger prior, within what was known.
    """

    mean: Tensor
    variance: Tensor
    modes: Tensor
    readers: Tensor
    powers: Tensor
    law: Tensor

    def __init__(self, sampling: Sampling) -> None:
        super().__init__()
        self._size_m = target_side_m(sampling.canvas)
        self.register_buffer("mean", torch.zeros(CELLS, CELLS))
        self.register_buffer("variance", torch.ones(CELLS, CELLS))
        self.register_buffer("modes", torch.zeros(_MODES, CELLS, CELLS))
        self.register_buffer("readers", torch.zeros(_MODES, CELLS, CELLS))
        self.register_buffer("powers", torch.zeros(_MODES))
        self.register_buffer("law", torch.tensor([0.0, 0.0, 0.5, 0.5]))  # a, b, least and most light

    @property
    def unit(self) -> Tensor:
        """Root of the variance of the prior, mean over the target's cells: []."""
        return self.variance.mean().sqrt()

    def fit(self, sampling: Sampling) -> None:
        """Take prior and information from the folder of a calibrated setup.

        Args:
            sampling: Names it, and says whether errors are taken from events (`corrected`).

        Raises:
            DataError: The folder says nothing of the setup's errors.
        """
        known = event_errors(folder_of(sampling.setup), "take --network.kind sequence")
        prior = event_prior(load_setup(sampling.setup), self._size_m)
        told = known.told(corrected=sampling.surface == "corrected")
        information = torch.from_numpy(np.stack([one.information for one in told]))
        own = torch.eye(prior.count, dtype=torch.float64)
        covariance = torch.linalg.inv(information + own)
        axes = torch.linalg.eigh(covariance.mean(dim=0)).eigenvectors[:, :_MODES]  # those of least variance
        seen = 1 - torch.einsum("km,ckl,lm->cm", axes, covariance, axes).clamp(_SEEN_PART, 1 - _SEEN_PART)
        odds, weight = seen.logit(), seen * (1 - seen)  # ln (g p) of each, and what it tells of g and p
        strength, powers = torch.zeros(len(seen), dtype=torch.float64), odds[0]
        for _ in range(_ROUNDS):
            powers = (weight * (odds - strength[:, None])).sum(dim=0) / weight.sum(dim=0)
            strength = (weight * (odds - powers)).sum(dim=1) / weight.sum(dim=1)
        light = known.light.double().clamp_min(_DIMMEST).log()
        away = light - light.mean()
        slope = float((away * strength).sum() / away.square().sum().clamp_min(1e-9))
        start = float(strength.mean()) - slope * float(light.mean())
        patterns = torch.from_numpy(prior.patterns)  # [n, k]
        shape = self.mean.shape
        self.mean.copy_(torch.from_numpy(prior.mean).view(shape))
        self.variance.copy_(patterns.square().sum(dim=1).view(shape))
        powers = powers.exp().clamp_max(_MOST_POWER)
        axes = axes * (powers > _LEAST_POWER)  # what an image holds of others is not of the events
        self.modes.copy_((patterns @ axes).T.reshape(-1, *shape))
        self.readers.copy_((patterns / patterns.square().sum(dim=0) @ axes).T.reshape(-1, *shape))
        self.powers.copy_(powers)
        self.law.copy_(torch.tensor([start, slope, *light.aminmax()]))

    def read(self, images: Tensor, shown: Tensor, grid: TargetGrid) -> Told:
        """Return what solved images say.

        Args:
            images: One for each of `EVENT_PRIORS`, in their own units, [B, 2, P, P].
            shown: The same at one scale, [B, 2, P, P].
            grid: The square that is drawn.
        """
        modes, readers = self.modes.flatten(1), self.readers.flatten(1)

        def coefficients(x: Tensor) -> Tensor:
            cells = grid.target_of(x, self._size_m, CELLS).flatten(1)
            return (cells - self.mean.flatten()) @ readers.T

        def image(cells: Tensor) -> Tensor:
            return grid.of_target(cells.unflatten(1, (1, CELLS, CELLS)), self._size_m)

        start, slope, least, most = self.law
        smooth = grid.target_of(images[:, -1], self._size_m, CELLS).flatten(1)
        light = smooth.mean(dim=1).clamp_min(_DIMMEST).log().clamp(least, most)
        power = (start + slope * light).exp()[:, None] * self.powers  # [B, m]
        part = power / (1 + power)
        # (A + w) z_w = b = (A + 1) z_1, of each image
        found = [
            coefficients(images[:, n]) * (power + weight) / (power + 1) for n, weight in enumerate(EVENT_PRIORS)
        ]
        z = torch.stack(found).mean(dim=0)

        def score(x: Tensor) -> Tensor:
            return image((z - part * coefficients(x[:, 0])) @ modes) / self.unit

        variance = (self.variance.flatten() - part @ modes.square()).clamp_min(0)
        deviation = image(variance.sqrt() / self.unit)
        return Told(image(self.mean.flatten() + z @ modes), score, torch.cat([deviation, shown], dim=1))


class UnrolledNetwork(nn.Module):
    """The steps: each shows its U-Net the image, scores and what is shown, and adds the answer to the log odds.

    The last layer of each begins with weights of 0, so that the first image is the solved one.

    Args:
        channels: Of what each U-Net sees.
        config: Steps, and the rest of each U-Net.
    """

    def __init__(self, channels: int, config: UnrolledConfig) -> None:
        super().__init__()
        self.channels = channels
        self.steps = nn.ModuleList(ResidualUNet(channels, config) for _ in range(config.steps))
        for step in self.steps:
            head = cast(ResidualUNet, step).head
            nn.init.zeros_(head.weight)
            nn.init.zeros_(cast(Tensor, head.bias))

    def forward(self, told: list[Told], unit: Tensor) -> Tensor:
        """Return images [B, 1, P, P], 0..1.

        Args:
            told: What was recorded says; the steps begin at the first.
            unit: What images are divided by for a network, [].
        """
        odds = told[0].start.clamp(_LEAST, 1 - _LEAST).logit()
        for step in self.steps:
            x = odds.sigmoid()
            with torch.autocast(x.device.type, enabled=False):
                parts = [x / unit, *(part for one in told for part in (one.score(x), one.shown))]
            odds = odds + cast(ResidualUNet, step).log_odds(torch.cat(parts, dim=1))
        return odds.sigmoid()


class UnrolledReconstructor(SequenceReconstructor):
    """All time steps -> the target plane, in steps from what they say against the image so far.

    Args:
        modality: What it sees.
        settings: Steps and their networks.
        sampling: Size of the maps and their pitch on the target's canvas.

    Raises:
        ConfigError: Something that it sees is not solved, or the pitch is too fine for the square drawn.
    """

    solver_of_frames = UnrolledFrames

    def __init__(self, modality: Modality, settings: UnrolledConfig, sampling: Sampling) -> None:
        super().__init__(modality, settings, sampling)
        if not self.draws_sequences:
            raise ConfigError(
                f"an unrolled network of {modality.name} goes by the likelihood of all that it sees, and "
                f"{', '.join(self.embedding.groups)} is embedded; make the samples with --sampling.surface "
                "likelihood, or take --network.kind sequence"
            )
        self.events = UnrolledEvents(self.sampling) if self.embedding.images else None
        steps = [f"unet.steps.{number}." for number in range(settings.steps)]
        self.parts = {  # type: ignore[misc]
            part: tuple(step + name.removeprefix("unet.") for step in steps for name in names)
            for part, names in PARTS.items()
        }

    def image_network(self, images: int) -> nn.Module:
        """Return the steps: beside the images each sees its own, and of each that tells a score."""
        more = 1 + (self.frames is not None) + 2 * (self.embedding.images > 0)
        return UnrolledNetwork(images + more, cast(UnrolledConfig, self.settings))

    def images_of(self, pooled: Tensor) -> Tensor:
        """Return pooled maps without packed numbers, [B, S, P, P]."""
        if self.frames is None:
            return pooled
        count = self.frames.images
        packed = cast(UnrolledFrames, self.frames).packed(self.grid)
        return torch.cat([pooled[:, :count], pooled[:, count + packed :]], dim=1)

    def forward(self, x: Tensor) -> Tensor:
        """Map pooled maps [B, S, P, P] to images of the target plane [B, 1, P, P], 0..1."""
        told, frames, count = list[Told](), cast(UnrolledFrames | None, self.frames), 0
        with torch.autocast(x.device.type, enabled=False):
            shown = self.scale(self.images_of(x.float()))
            if frames is not None:
                count = frames.images
                packed = x[:, count : count + frames.packed(self.grid)].float()
                told.append(frames.read(packed, shown[:, :count], self.grid))
            if self.events is not None:
                own = self.normalization.in_units(x[:, -self.embedding.images :].float())
                told.append(self.events.read(own, shown[:, count:], self.grid))
            unit = (self.events if frames is None else frames).unit  # type: ignore[union-attr]
        return self.unet(told, unit)

    def fit(self, subset: Callable[[int], Drawn], seed: int, *, is_new: bool, keep_normalization: bool) -> None:
        """Fit the scale of the maps, and take what events say of targets from the setup."""
        super().fit(subset, seed, is_new=is_new, keep_normalization=keep_normalization)
        if self.events is not None:
            self.events.fit(self.sampling)
