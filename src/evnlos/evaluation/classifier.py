"""An independent reader: a small network that names a character, trained on clean glyphs alone."""

from __future__ import annotations

import json
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from evnlos.errors import DataError

CHARACTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"
"""What the reader knows; it always answers with one of these."""
_FILE = Path(__file__).parent / "classifier.safetensors"


class CharacterReader(nn.Module):
    """Three strided convolutions and a mean: pictures of a plate [N, 1, 32, 32] in 0..1 -> scores [N, 36]."""

    def __init__(self) -> None:
        super().__init__()
        widths = (1, 24, 48, 96)
        self.layers = nn.ModuleList(nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairwise(widths))
        self.norms = nn.ModuleList(nn.GroupNorm(4, b) for b in widths[1:])
        self.head = nn.Linear(widths[-1] * 16, len(CHARACTERS))

    def forward(self, x: Tensor) -> Tensor:
        """Return unnormalised scores; each picture is first brought to mean 0 and deviation 1."""
        x = x - x.mean(dim=(1, 2, 3), keepdim=True)
        x = x / x.square().mean(dim=(1, 2, 3), keepdim=True).sqrt().clamp_min(1e-3)
        for layer, norm in zip(self.layers, self.norms, strict=True):
            x = F.silu(norm(layer(x)))
        return self.head(x.flatten(1))  # [N, 96 * 4 * 4] -> [N, 36]


@lru_cache(maxsize=1)
def load_reader(path: str | Path = _FILE) -> CharacterReader:
    """Return the trained reader; `python tools/train_classifier.py` made the one in the package.

    Raises:
        DataError: The file is missing or of another network.
    """
    path = Path(path)
    reader = CharacterReader()
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("evnlos", "{}"))
            state = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 - no mapping
        reader.load_state_dict(state)
    except (SafetensorError, OSError, RuntimeError) as error:
        raise DataError(f"{path} is no character reader: {' '.join(str(error).split())[:160]}") from None
    if about.get("characters") != CHARACTERS:
        raise DataError(f"{path} knows {about.get('characters')!r}; this version reads {CHARACTERS!r}")
    return reader.eval()


@torch.inference_mode()
def read_characters(pictures: Tensor) -> list[str]:
    """Name the character on each plate [N, 1, 32, 32].

    Example:
        >>> import numpy as np
        >>> from evnlos.scene import FontGlyphs
        >>> from evnlos.types import Plane
        >>> mask = FontGlyphs(characters="R").target("comic_neue_bold_R").rasterise(Plane(32, 32, 0.0025))
        >>> read_characters(torch.from_numpy(mask)[None, None])
        ['R']
    """
    return [CHARACTERS[i] for i in load_reader()(pictures.float()).argmax(dim=1).tolist()]
