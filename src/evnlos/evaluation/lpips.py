"""LPIPS with the VGG16 trunk: Zhang et al., CVPR 2018, version 0.1, from files that the user has."""

from __future__ import annotations

import hashlib
import importlib.util
import os
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from evnlos.errors import DataError

# Layers of VGG16 (Simonyan and Zisserman, ICLR 2015): number of 3 x 3 convolutions in each block.
_BLOCKS = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
_TRUNK_HASH = "397923af"  # the trunk's file name carries the head of its SHA-256
_MEAN, _STD = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


def load_lpips(
    trunk: str | Path | None = None, heads: str | Path | None = None
) -> Callable[[Tensor, Tensor], Tensor]:
    """Return the metric: pairs of pictures [N, 1, H, W] in 0..1 -> LPIPS [N], 0 = the same.

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
    names = sorted((k for k in state if k.startswith("features.") and k.endswith(".weight")), key=_index)
    return [(state[name], state[name.replace(".weight", ".bias")]) for name in names]


def _index(name: str) -> int:
    return int(name.split(".")[1])


def _installed_heads() -> Path:
    found = importlib.util.find_spec("lpips")
    folder = Path(found.origin).parent if found and found.origin else Path("lpips")
    return folder / "weights" / "v0.1" / "vgg.pth"
