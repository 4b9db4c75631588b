"""Scores of images against the truth: metrics, a reader of characters, LPIPS (Zhang et al., CVPR 2018)."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from evnlos.data import Capture, Sampling, character_of
from evnlos.errors import DataError
from evnlos.metrics import HAAR_LEAST_SIDE, gmsd, haarpsi, ms_ssim, psnr, ssim
from evnlos.models.drawn import TargetGrid
from evnlos.scene import Scene, Target
from evnlos.tensor_file import read_sealed
from evnlos.types import target_side_m

Perceptual = Callable[[Tensor, Tensor], Tensor]
_MOST_NAMED = 8  # of what is taken for something else
_MARGIN = 2  # pixels around the target's bounding box: the blur of its edge belongs to it


@dataclass(frozen=True)
class Scores:
    """Scores of single images, in the order of the images; every array is float64 [N].

    Args:
        psnr_db: On the scored canvas, peak 1.
        ssim: On the scored canvas.
        psnr_box_db: On the smallest box that holds the target, grown by 2 pixels.
        ms_ssim: On the scored canvas, as many scales as it holds.
        haarpsi: On the scored canvas; None where a side has fewer than 16 pixels.
        gmsd: On the scored canvas; smaller is better.
        lpips: With the VGG trunk; None where it is not at hand.
    """

    psnr_db: np.ndarray
    ssim: np.ndarray
    psnr_box_db: np.ndarray
    ms_ssim: np.ndarray
    haarpsi: np.ndarray | None
    gmsd: np.ndarray
    lpips: np.ndarray | None = None

    def mean(self, chosen: np.ndarray | slice = slice(None)) -> dict[str, float | None]:
        """Return the mean over the chosen images, by name of the metric."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: None if v is None else round(float(v[chosen].mean()), 4) for name, v in values.items()}


def score(images: Tensor, truth: Tensor, perceptual: Perceptual | None = None) -> Scores:
    """Score images [N, H, W] in 0..1 against true ones, both already cut to the scored rows.

    Args:
        images: Reconstructions.
        truth: True images.
        perceptual: LPIPS of [N, 1, H, W] pairs, where its weights are at hand.
    """
    large = min(images.shape[-2:]) >= HAAR_LEAST_SIDE
    boxes = [_box(picture) for picture in truth]
    in_box = [psnr(image[box], picture[box]) for image, picture, box in zip(images, truth, boxes, strict=True)]
    return Scores(
        psnr_db=psnr(images, truth).double().numpy(),
        ssim=ssim(images, truth).double().numpy(),
        psnr_box_db=torch.stack(in_box).double().numpy(),
        ms_ssim=ms_ssim(images, truth).double().numpy(),
        haarpsi=haarpsi(images, truth).double().numpy() if large else None,
        gmsd=gmsd(images, truth).double().numpy(),
        lpips=perceptual(images[:, None], truth[:, None]).double().numpy() if perceptual else None,
    )


_ONCE: dict[bytes, Scores] = {}
_MOST_ONCE = 64


def score_once(images: Tensor, truth: Tensor, perceptual: Perceptual | None = None) -> Scores:
    """Return `score` of images that come again: baselines, which are the same beside every network."""
    found = hashlib.sha256(b"lpips" if perceptual else b"")
    for one in (images, truth):
        found.update(one.contiguous().numpy().tobytes())
    if (key := found.digest()) not in _ONCE:
        if len(_ONCE) >= _MOST_ONCE:
            _ONCE.clear()
        _ONCE[key] = score(images, truth, perceptual)
    return _ONCE[key]


def _box(truth: Tensor) -> tuple[slice, slice]:
    """Return the rows and columns of the target; the whole image where there is none."""
    rows, columns = (torch.nonzero(truth.amax(dim=axis) > 0).flatten() for axis in (1, 0))
    if not len(rows):
        return slice(None), slice(None)
    first = (max(int(rows[0]) - _MARGIN, 0), max(int(columns[0]) - _MARGIN, 0))
    return slice(first[0], int(rows[-1]) + 1 + _MARGIN), slice(first[1], int(columns[-1]) + 1 + _MARGIN)


@dataclass(frozen=True)
class Interval:
    """A mean with its 95 % interval.

    Args:
        mean: The mean over all images.
        low: 2.5 % point of the bootstrap.
        high: 97.5 % point of the bootstrap.
    """

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:+.2f} [{self.low:+.2f}, {self.high:+.2f}]"


def paired_difference(
    a: ArrayLike, b: ArrayLike, objects: ArrayLike, *, draws: int = 10_000, seed: int = 0
) -> Interval:
    """Return the mean of a - b with a 95 % percentile interval, objects and seeds drawn with replacement.

    The positions of one object are not independent, so whole objects are drawn, and both methods are always
    compared on the same images. Of several seeds each draw takes as many, those of `a` and of `b` apart, so
    that the interval holds what another training would change. With few objects (4 characters) such an
    interval is coarse and, as a rule, too narrow; it speaks of other objects like these, not of other setups.

    Args:
        a: Scores of one method, [N], or [S, N] for S seeds, which are averaged.
        b: Scores of the other, the same images in the same order.
        objects: Object of each image, [N].
        draws: Number of bootstrap samples.
        seed: Seed of the draws.

    Raises:
        DataError: The lengths disagree, or there is no image.

    Example:
        >>> str(paired_difference([3.0, 4.0, 6.0], [1.0, 2.0, 3.0], ["A", "A", "B"]))
        '+2.33 [+2.00, +3.00]'
    """
    both, labels = [np.atleast_2d(np.asarray(scores, np.float64)) for scores in (a, b)], np.asarray(objects)
    difference = both[0].mean(axis=0) - (both[1].mean(axis=0) if both[1].size else 0.0)
    if any(one.shape[1:] != labels.shape for one in both) or not len(labels):
        shapes = " and ".join(str(one.shape) for one in both)
        raise DataError(f"scores {shapes} and {labels.shape} objects; give one object an image")
    _, group = np.unique(labels, return_inverse=True)
    counts, draw = np.bincount(group), np.random.default_rng(seed)
    chosen = draw.integers(0, len(counts), (draws, len(counts)))  # [D, G]
    drawn = []
    for one in both:
        sums = np.stack([np.bincount(group, scores) for scores in one])  # [S, G]
        weights = draw.multinomial(len(one), np.full(len(one), 1 / len(one)), draws) / len(one)  # [D, S]
        drawn.append(np.take_along_axis(weights @ sums, chosen, axis=1).sum(axis=1))
    means = (drawn[0] - drawn[1]) / counts[chosen].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return Interval(float(difference.mean()), float(low), float(high))


CHARACTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"
"""What the reader knows; it always answers with one of these."""
_FILE = Path(__file__).parent / "classifier.safetensors"


class CharacterReader(nn.Module):
    """Three strided convolutions and a mean: images of a target [N, 1, 32, 32] in 0..1 -> scores [N, 36]."""

    def __init__(self) -> None:
        super().__init__()
        widths = (1, 24, 48, 96)
        self.layers = nn.ModuleList(nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairwise(widths))
        self.norms = nn.ModuleList(nn.GroupNorm(4, b) for b in widths[1:])
        self.head = nn.Linear(widths[-1] * 16, len(CHARACTERS))

    def forward(self, x: Tensor) -> Tensor:
        """Return unnormalised scores; each image is first brought to mean 0 and deviation 1."""
        x = x - x.mean(dim=(1, 2, 3), keepdim=True)
        x = x / x.square().mean(dim=(1, 2, 3), keepdim=True).sqrt().clamp_min(1e-3)
        for layer, norm in zip(self.layers, self.norms, strict=True):
            x = F.silu(norm(layer(x)))
        return self.head(x.flatten(1))  # [N, 96 * 4 * 4] -> [N, 36]


@lru_cache(maxsize=1)
def load_reader(path: str | Path = _FILE) -> CharacterReader:
    """Return the trained reader; `python tools/train_classifier.py` made the one in the package.

    Raises:
        DataError: The file is missing, damaged, without a digest, or of another network.
    """
    path = Path(path)
    reader = CharacterReader()
    try:
        text, state, is_sealed = read_sealed(path)
        if not is_sealed:
            raise ValueError("nothing vouches for its numbers; make it anew with tools/train_classifier.py")
        about = json.loads(text)
        reader.load_state_dict({name: value.float() for name, value in state.items()})
    except (OSError, RuntimeError, ValueError) as error:
        raise DataError(f"{path} is no character reader: {' '.join(str(error).split())[:160]}") from None
    if about.get("characters") != CHARACTERS:
        raise DataError(f"{path} knows {about.get('characters')!r}; this version reads {CHARACTERS!r}")
    return reader.eval()


@torch.inference_mode()
def read_characters(pictures: Tensor) -> list[str]:
    """Name the character on each target [N, 1, 32, 32].

    Example:
        >>> import numpy as np
        >>> from evnlos.scene import FontGlyphs
        >>> from evnlos.types import Plane
        >>> mask = FontGlyphs(characters="R").target("comic_neue_bold_R").rasterise(Plane(32, 32, 0.0025))
        >>> read_characters(torch.from_numpy(mask)[None, None])
        ['R']
    """
    return [CHARACTERS[i] for i in load_reader()(pictures.float()).argmax(dim=1).tolist()]


# Layers of VGG16 (Simonyan and Zisserman, ICLR 2015): number of 3 x 3 convolutions in each block.
_BLOCKS = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
_TRUNK_HASH = "397923af"  # the trunk's file name carries the head of its SHA-256
_MEAN, _STD = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


def load_lpips(
    trunk: str | Path | None = None, heads: str | Path | None = None
) -> Callable[[Tensor, Tensor], Tensor]:
    """Return the metric: pairs of images [N, 1, H, W] in 0..1 -> LPIPS [N], 0 = the same.

    Args:
        trunk: torchvision's `vgg16-397923af.pth`; by default the torch hub cache is looked in.
        heads: The five linear heads, `vgg.pth` of LPIPS v0.1; by default those of an installed `lpips`.

    Raises:
        DataError: A file is missing, or the trunk's SHA-256 is not that of the published weights (an
            untrained trunk gives plausible but meaningless numbers).
    """
    trunk = Path(trunk) if trunk else Path(torch.hub.get_dir()) / "checkpoints" / f"vgg16-{_TRUNK_HASH}.pth"
    heads = Path(heads) if heads else _installed_heads()
    for path, what in ((trunk, "the VGG16 trunk"), (heads, "the LPIPS heads")):
        if not path.is_file():
            raise DataError(
                f"LPIPS: not available: {what} is not at {path}; give its path with --vgg / --lpips-heads"
            )
    found = hashlib.sha256(trunk.read_bytes()).hexdigest()
    if not found.startswith(_TRUNK_HASH):
        raise DataError(
            f"LPIPS: {trunk} has SHA-256 {found[:8]}..., not {_TRUNK_HASH}...; give the published trunk"
        )
    layers = _convolutions(torch.load(trunk, map_location="cpu", weights_only=True))
    state = torch.load(heads, map_location="cpu", weights_only=True)
    linear = [state[f"lin{i}.model.1.weight"] for i in range(5)]
    return lambda image, truth: lpips(image, truth, layers, linear)


def available_lpips() -> Callable[[Tensor, Tensor], Tensor] | None:
    """Return the metric where its weights are in their default places, else None."""
    try:
        return load_lpips(os.environ.get("EVNLOS_VGG16"))
    except DataError:
        return None


@torch.inference_mode()
def lpips(image: Tensor, truth: Tensor, layers: list[tuple[Tensor, Tensor]], linear: list[Tensor]) -> Tensor:
    """Return the LPIPS of pairs [N, 1 or 3, H, W] in 0..1 from the trunk's layers and the heads."""
    distances = []
    for a, b, head in zip(_features(image, layers), _features(truth, layers), linear, strict=True):
        difference = (F.normalize(a, dim=1, eps=1e-10) - F.normalize(b, dim=1, eps=1e-10)).square()
        distances.append(F.conv2d(difference, head).mean(dim=(1, 2, 3)))
    return torch.stack(distances).sum(dim=0)


def _features(image: Tensor, layers: list[tuple[Tensor, Tensor]]) -> list[Tensor]:
    """Return the activations behind the last convolution of each block."""
    mean, std = (torch.tensor(v, dtype=image.dtype).reshape(1, 3, 1, 1) for v in (_MEAN, _STD))
    x = (image.expand(-1, 3, -1, -1) * 2 - 1 - mean) / std
    found, remaining = [], iter(layers)
    for block, (_, count) in enumerate(_BLOCKS):
        if block:
            x = F.max_pool2d(x, 2)
        for _ in range(count):
            weight, bias = next(remaining)
            x = F.relu(F.conv2d(x, weight, bias, padding=1))
        found.append(x)
    return found


def _convolutions(state: dict[str, Tensor]) -> list[tuple[Tensor, Tensor]]:
    """Return weight and bias of the thirteen convolutions, in order."""
    names = [k[:-7] for k in state if k.startswith("features.") and k.endswith(".weight")]
    names.sort(key=lambda name: int(name.split(".")[1]))
    return [(state[f"{name}.weight"], state[f"{name}.bias"]) for name in names]


def _installed_heads() -> Path:
    found = importlib.util.find_spec("lpips")
    folder = Path(found.origin).parent if found and found.origin else Path("lpips")
    return folder / "weights" / "v0.1" / "vgg.pth"


def aligned_mean(images: Tensor, position_m: NDArray, names: NDArray, sampling: Sampling) -> Tensor:
    """Return images [N, H, W] of which each object's are replaced by their mean along the motion.

    Args:
        images: Images of single time steps on the canvas, [N, H, W].
        position_m: The target's centre at each, (x, y) in metres, [N, 2].
        names: Object of each, [N].
        sampling: Size of the maps and their pitch on the target's canvas.
    """
    grid, found, places = TargetGrid(sampling), torch.zeros_like(images), torch.from_numpy(position_m)
    for name in np.unique(names):
        mine = torch.from_numpy(np.flatnonzero(names == name))
        found[mine] = grid.on_canvas(grid.mean(images[mine], places[mine]), places[mine])
    return found


def scored_sampling(size_m: float, position_m: NDArray[np.float64] | None = None) -> Sampling:
    """Return the standard sample as large, against a target, as it is for the usual one of 8 cm.

    Args:
        size_m: Side of the target, metres.
        position_m: Its centre (x, y), [N, 2], metres: on a longer way the canvas is larger; None: about 0.
    """
    usual = Sampling()
    scale = size_m / target_side_m(usual.canvas)
    if position_m is not None:
        sides = usual.canvas.extent_m[1], usual.scored_rows * usual.pitch_m
        needed = float(((2 * np.abs(position_m).max(axis=0) + size_m) / sides).max())
        scale = needed if needed > 1.04 * scale else scale
    return replace(usual, pitch_m=usual.pitch_m * scale)


def target_psnr(capture: Capture, image: Tensor, size_m: float, motion: NDArray) -> float | None:
    """Return the PSNR of an image [cells, cells], dB; None where the truth is unknown or out of view.

    Args:
        capture: The capture.
        image: The target plane.
        size_m: Its side, metres.
        motion: Its centre at the frames 1, 2, ..., [N, 2], metres.
    """
    if (scene := capture.scene) is None:
        return None
    times_s = capture.frame_times_us[1:] * 1e-6
    sampling = scored_sampling(scene.target.size_m, scene.motion.position_m(times_s))
    target = Target("found", image.clamp(0, 1).float().numpy(), size_m)
    images = target.rasterise(sampling.canvas, motion), scene.truth(sampling.canvas, times_s)
    found, true = (torch.from_numpy(one[:, sampling.scored]) for one in images)
    values = (told := psnr(found, true))[told.isfinite()]  # elsewhere the canvas shows nothing
    return round(float(values.mean()), 3) if len(values) else None


def track_psnr(scene: Scene, image: NDArray, size_m: float, times_s: NDArray) -> float:
    """Return the PSNR of an image whose light's middle is in its middle, at the mean turn, as of a track, dB.

    Args:
        scene: The truth.
        image: The target plane, [cells, cells].
        size_m: Its side, metres.
        times_s: Instants of the frames, [N], seconds.
    """
    true = scene.target.turned(float(np.mean(scene.pose(times_s).rotation_rad)))
    found, sampling = Target("found", image.clip(0, 1), size_m), scored_sampling(scene.target.size_m)
    shown = found.rasterise(sampling.canvas), true.rasterise(sampling.canvas, -true.light_m)
    image_on, true_on = (torch.from_numpy(one[sampling.scored]) for one in shown)
    return round(float(psnr(image_on, true_on)), 3)


def confusion(seen: Sequence[dict[str, dict[str, int]]]) -> str:
    """Return what the reader takes for something else, the most first, as "G as C 12 %"; shares of each object.

    Args:
        seen: As `Record.read_as`, of one or several records.
    """
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for one in seen:
        for name, read in one.items():
            counts[character_of(name)].update(read)
    wrong = [
        (count / read.total(), f"{true} as {character}")
        for true, read in counts.items()
        for character, count in read.items()
        if character != true
    ]
    wrong.sort(key=lambda pair: -pair[0])
    more = [f"{len(wrong) - _MOST_NAMED} more"] if len(wrong) > _MOST_NAMED else []
    return ", ".join([f"{words} {share:.0%}" for share, words in wrong[:_MOST_NAMED]] + more)
