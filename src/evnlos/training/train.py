"""Training, flat and readable: pre-training, end-to-end training and fine-tuning are one loop."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from evnlos.claim import claim, is_empty
from evnlos.config import config_hash, differing_keys, read_yaml, save_yaml, to_dict, write_atomically
from evnlos.dataset import CHANNELS, Dataset, LiveDataset, NlosDataset, Sampling
from evnlos.errors import ConfigError, DataError
from evnlos.model import (
    JointNetwork,
    ResidualUNet,
    Weights,
    load_weights,
    new_network,
    save_weights,
)
from evnlos.seeds import derive_seed
from evnlos.training.checkpoint import load_checkpoint, save_checkpoint
from evnlos.training.held_out import confidence_of, held_out_samples, validate
from evnlos.training.loss import LOSSES, light_of
from evnlos.training.pooled import PooledSamples
from evnlos.training.prepare import prepare
from evnlos.training.settings import Training, step_size
from evnlos.training.source import Live, Source, Stored
from evnlos.training.team import Team, team
from evnlos.version import __version__

_PARTS = {"encoder": ("stem", "encoder", "down"), "latent": ("latent",), "decoder": ("up", "decoder", "head")}


def train(
    dataset: Dataset, settings: Training, out: str | Path, weights: str | Path | None = None
) -> Iterator[dict[str, Any]]:
    """Train a network on a dataset's split `train`, yielding one record an epoch.

    From random weights this is pre-training (on simulation) or the end-to-end baseline (on captures);
    from `weights` it is fine-tuning. The run's folder holds `run.yaml` (settings, data, versions),
    `metrics.jsonl`, a checkpoint after each epoch, and in the end `weights.safetensors`. A run that was
    killed goes on when it is started again, and ends with the same bytes. Processes that `torchrun` started
    share each batch: the gradient is that of one process, up to the order of its sums.

    Args:
        dataset: Where the samples are, or a simulation that makes them meanwhile; the split `validation` is
            scored each epoch where there is one.
        settings: What decides the training.
        out: The run's folder; new, or begun with the same settings.
        weights: Weights (or a run) to start from.

    Yields:
        Records with epoch, loss, learning_rate, seconds, and psnr_db, zero_db and collapsed of the validation,
        which the first process does.

    Raises:
        DataError: The folder holds another run, another process is at work in it, a sample is damaged, or
            weights and data do not fit.
    """
    out = Path(out)
    start = load_weights(weights) if weights else None
    network, settings = _network(settings, start, dataset.sampling)
    with team() as processes, claim(out) if processes.rank == 0 else nullcontext():
        about = _about(dataset, settings, start, processes.device)
        if processes.rank == 0:
            _take_up(out, about)
        processes.wait()
        history = [*(start.history if start else []), about]
        yield from _epochs(network, dataset, settings, out, history, processes, start)


def _epochs(
    network: ResidualUNet | JointNetwork,
    dataset: Dataset,
    settings: Training,
    out: Path,
    history: list[dict[str, Any]],
    processes: Team,
    start: Weights | None,
) -> Iterator[dict[str, Any]]:
    """Run the epochs that are left, and write the weights after the last."""
    checkpoint, metrics = out / "checkpoint.safetensors", out / "metrics.jsonl"
    if (out / "weights.safetensors").is_file():
        for line in metrics.read_text().splitlines():
            yield json.loads(line)
        return

    device, leads = processes.device, processes.rank == 0
    network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    for part in settings.freeze:
        for name in _PARTS[part]:
            getattr(_unet(network), name).requires_grad_(False)
    trained = [p for p in network.parameters() if p.requires_grad]
    if not trained:
        raise DataError(f"freeze is {settings.freeze}; leave at least one part of the network to train")
    optimiser = torch.optim.Adam(trained, lr=settings.learning_rate)
    loss_of, half = LOSSES[settings.loss], _half(settings, device)
    positions = source = _source(dataset, settings, processes)
    held_out = held_out_samples(dataset, settings.paradigm, device) if leads else None

    done, log = 0, []
    key = config_hash(settings)
    if checkpoint.is_file():
        done, log = load_checkpoint(checkpoint, network, optimiser, key)
        if leads:
            _write_log(metrics, log)
        yield from log
    else:
        prepare(network, positions, settings.seed, is_new=start is None, restandardise=settings.restandardise)
    if isinstance(network, JointNetwork):
        assert isinstance(positions, Stored) and isinstance(positions.samples, NlosDataset)  # see _source
        passes = PooledSamples(positions.samples, network, settings.views, settings.seed)
        if start is None and not done:
            network.fit_scale(passes.inputs)
        source = Stored(passes, settings.batch_size, settings.seed, processes)
    processes.wait()  # nobody writes before all have read
    joined = processes.joined(network)
    run = torch.compile(joined) if settings.compile else joined
    for epoch in range(done, settings.epochs):
        began, rate, total = time.perf_counter(), 0.0, torch.zeros((), device=device)
        network.train()
        for step, batch in enumerate(source.batches(epoch)):
            rate = step_size(settings, epoch + step / source.steps)
            for group in optimiser.param_groups:
                group["lr"] = rate
            seen, truth = (part.to(device, non_blocking=True) for part in (batch.seen, batch.truth))
            light = processes.total(light_of(truth) * batch.share)
            with torch.autocast(device.type, torch.bfloat16, enabled=half):
                image = run(seen.contiguous(memory_format=torch.channels_last))
            loss = loss_of(image, truth, light) * batch.share
            optimiser.zero_grad(set_to_none=True)
            (loss * processes.size).backward()  # the mean over the processes is then the whole batch's gradient
            torch.nn.utils.clip_grad_norm_(trained, 1.0)
            optimiser.step()
            total += loss.detach() * batch.weight
        record: dict[str, Any] = {
            "epoch": epoch + 1,
            "loss": round(float(processes.total(total)), 6),
            "learning_rate": rate,
        }
        if held_out is not None:
            record |= validate(network, held_out, dataset, device, half)
        record["seconds"] = round(time.perf_counter() - began, 2)
        log.append(record)
        if leads:
            save_checkpoint(checkpoint, network, optimiser, epoch + 1, log, key)
            _write_log(metrics, log)
        yield record
    if leads:
        network = network.cpu().eval()
        done_weights = Weights(
            network,
            settings.paradigm,
            to_dict(dataset.sampling),
            history,
            positions.mean_image(),
            confidence_of(network, held_out, dataset, start),
        )
        save_weights(out / "weights.safetensors", done_weights)
        checkpoint.unlink(missing_ok=True)
    processes.wait()


def _network(
    settings: Training, start: Weights | None, sampling: Sampling
) -> tuple[ResidualUNet | JointNetwork, Training]:
    """Return the network to train; fine-tuning takes kind, paradigm and size from its weights."""
    if start is None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derive_seed(settings.seed, "weights"))
            channels, size = CHANNELS[settings.paradigm], (sampling.height, sampling.width)
            made = new_network(channels, settings.network, size, sampling.pitch_m, joint=settings.joint)
            return made, settings
    known = {"paradigm": start.paradigm, "joint": isinstance(start.network, JointNetwork)}
    return start.network, replace(settings, network=start.network.config, **known)  # type: ignore[arg-type]


def _unet(network: ResidualUNet | JointNetwork) -> ResidualUNet:
    return network.unet if isinstance(network, JointNetwork) else network


def _source(dataset: Dataset, settings: Training, processes: Team) -> Source:
    """Return where the training's batches come from."""
    if isinstance(dataset, LiveDataset):
        if settings.joint:
            raise ConfigError("joint training pools passes on disk; write them with `evnlos simulate` first")
        return Live(dataset, settings.paradigm, settings.batch_size, settings.seed, processes)
    samples = NlosDataset(dataset, "train", settings.paradigm)
    return Stored(samples, settings.batch_size, settings.seed, processes)


def _write_log(path: Path, log: list[dict[str, Any]]) -> None:
    write_atomically(path, "".join(json.dumps(line) + "\n" for line in log).encode())


def _half(settings: Training, device: torch.device) -> bool:
    if settings.precision != "auto":
        return settings.precision == "bf16"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    # Asked of the processor, not of oneDNN, which also says yes where it only emulates bf16, at half the speed.
    return torch.cpu._is_avx512_bf16_supported()


def _about(dataset: Dataset, settings: Training, start: Weights | None, device: torch.device) -> dict[str, Any]:
    return {
        "settings": to_dict(settings),
        "data": {
            "origin": dataset.origin,
            "name": dataset.folder.resolve().name,
            "config_hash": dataset.config_hash,
            "optics": dataset.optics,
            "train": dataset.objects("train"),
            "validation": dataset.split.get("validation", []),
            **(dataset.way(device) if isinstance(dataset, LiveDataset) else {}),
        },
        "from": start.history[-1]["data"]["name"] if start and start.history else None,
        "versions": {
            "evnlos": __version__,
            "torch": str(torch.__version__),
            "python": platform.python_version(),
        },
    }


def _take_up(out: Path, about: dict[str, Any]) -> None:
    """Make the run's folder, or take it up where settings and data are the same."""
    path = out / "run.yaml"
    if path.is_file():
        theirs = read_yaml(path)
        differing = differing_keys(
            {key: about[key] for key in ("settings", "data")},
            {key: theirs.get(key) for key in ("settings", "data")},
        )
        if differing:
            raise DataError(
                f"{out} holds a run with other settings ({'; '.join(differing[:6])}); give another --out"
            )
        return
    if not is_empty(out):
        raise DataError(f"{out} is not empty and holds no run; give a new folder")
    save_yaml(about, path)
