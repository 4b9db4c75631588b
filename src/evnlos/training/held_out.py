"""What a training is watched by: samples that it does not learn from."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch.utils.data import TensorDataset

from evnlos.dataset import Dataset, LiveDataset, Modality, NlosDataset
from evnlos.metrics import psnr
from evnlos.model import Confidence, Reconstructor, Weights
from evnlos.training.confidence import FEWEST, fit_confidence

HeldOut = NlosDataset | TensorDataset


def held_out_samples(dataset: Dataset, modality: Modality, device: torch.device) -> HeldOut | None:
    """Return the samples to validate on, or None where the dataset holds none out."""
    if not dataset.split.get("validation"):
        return None
    if isinstance(dataset, LiveDataset):
        made = dataset.stream(dataset.objects("validation"), 0, modality, device)
        return TensorDataset(*(torch.cat(parts) for parts in zip(*made, strict=True)))
    return NlosDataset(dataset, "validation", modality)


@torch.inference_mode()
def validate(
    network: Reconstructor,
    held_out: HeldOut,
    dataset: Dataset,
    device: torch.device,
    half: bool,
) -> dict[str, Any]:
    """Return psnr_db, zero_db (an all-black picture's) and collapsed of the samples that are held out."""
    if isinstance(held_out, NlosDataset):
        inputs, truth = held_out.inputs, held_out.truth.float().cpu()
        places, names = held_out.position_m, held_out.names
    else:
        inputs, truth = held_out.tensors[0], held_out.tensors[1][:, 0].cpu()
        places = names = None
    with torch.autocast(device.type, torch.bfloat16, enabled=half):
        images = network.infer(inputs.to(device), places, names).float().cpu()
    images, truth = (part[:, dataset.sampling.scored] for part in (images, truth))
    score, blank = psnr(images, truth).mean().item(), psnr(torch.zeros_like(truth), truth).mean().item()
    # A network that has collapsed answers the same to every input.
    collapsed = bool(images.flatten(1).std(dim=0).mean() < 1e-3) if len(images) > 1 else False
    return {"psnr_db": round(score, 3), "zero_db": round(blank, 3), "collapsed": collapsed}


def confidence_of(
    network: Reconstructor, held_out: HeldOut | None, dataset: Dataset, start: Weights | None
) -> Confidence | None:
    """Return what the pictures are worth: from the validation, or as the weights that this began from say."""
    if isinstance(held_out, NlosDataset):
        is_known = not np.isnan(held_out.position_m).any()
        if is_known and len(dataset.objects("validation")) >= FEWEST:
            return fit_confidence(network, held_out, dataset.sampling.canvas)
    return start.confidence if start else None
