"""Training, flat and readable: pre-training, end-to-end training and fine-tuning are one loop."""

from __future__ import annotations

import json
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch.utils.data import TensorDataset

from evnlos.config import LONG_YAML, config_hash, read_yaml, save_yaml
from evnlos.data import Dataset, LiveDataset, Modality, NlosDataset, Sampling, as_modality
from evnlos.errors import ConfigError, DataError
from evnlos.files import directory_lock, write_atomically
from evnlos.machine import Progress, Step, silent
from evnlos.metrics import psnr
from evnlos.models import (
    Confidence,
    Reconstructor,
    SequenceReconstructor,
    Weights,
    drawn_targets,
    load_weights,
    save_weights,
)
from evnlos.models.confidence import FEWEST, fit_confidence
from evnlos.training.settings import (
    LOSSES,
    Training,
    about_run,
    check_run,
    learning_rate_at,
    light_of,
    load_checkpoint,
    save_checkpoint,
    tell_of_threads,
)
from evnlos.training.source import (
    BatchSource,
    DiskSource,
    DrawnSource,
    ProcessGroup,
    SimulatedSource,
    half_mirrored,
    process_group,
    with_mirrored,
)
from evnlos.types import derive_seed

_CHECKPOINT_S = 5.0  # a checkpoint after the first epoch, then no more often: it may take longer than an epoch


@dataclass(frozen=True, eq=False)
class TrainingResult:
    """A finished training.

    Args:
        folder: The run's folder.
        records: One record per epoch: epoch, loss, learning_rate, seconds, and psnr_db, zero_db and collapsed
            of the validation, which the first process does.
    """

    folder: Path
    records: list[dict[str, Any]]

    @property
    def file(self) -> Path:
        """The weights file."""
        return self.folder / "weights.safetensors"

    def load(self) -> Weights:
        """Read the trained network and what belongs to it."""
        return load_weights(self.file)


def train(
    dataset: Dataset,
    settings: Training,
    out: str | Path,
    weights: str | Path | None = None,
    progress: Progress = silent,
    captures: Dataset | None = None,
) -> TrainingResult:
    """Train a network on a dataset's split `train`.

    From random weights this is pre-training (on simulation) or the end-to-end baseline (on captures);
    from `weights` it is fine-tuning. The run's folder holds `run.yaml` (settings, data, versions),
    `metrics.jsonl`, a checkpoint after the first epoch and then every five seconds, and in the end
    `weights.safetensors`. A run that was killed goes on when it is started again, and ends with the same bytes
    if it has as many threads. Processes that `torchrun` started share each batch: the gradient is that of one
    process, up to the order of its sums.

    Args:
        dataset: Where the samples are, or a simulation that makes them meanwhile; the split `validation` is
            scored each epoch where there is one.
        settings: What decides the training.
        out: The run's folder; new, or begun with the same settings.
        weights: Weights (or a run) to start from.
        progress: Called when the training begins and after each epoch, with its record.
        captures: Captures with known targets, whose split `train` shows what the setup gets wrong: drawn
            sequences (`Training.drawn`) err as they do. None: as those of the dataset do.

    Returns:
        The run's folder and the record of each epoch.

    Raises:
        ConfigError: Settings that the dataset or the processes cannot follow.
        DataError: The folder holds another run, another process is at work in it, a sample is damaged, or
            weights and data do not fit.
    """
    out = Path(out)
    start = load_weights(weights) if weights else None
    network, settings = _network(settings, start, dataset.sampling)
    network.freeze(settings.freeze)
    _check_data(dataset, network)
    if settings.mirror and network.sees_sequence:
        raise ConfigError(
            f"mirror is on, and a reconstructor of kind {network.kind!r} sees whole sequences, which are not "
            "mirrored; leave it off"
        )
    _check_drawn(network, settings, captures, progress)
    samples = None
    if not (isinstance(dataset, LiveDataset) or (out / "weights.safetensors").is_file()):
        samples = NlosDataset(dataset, "train", network.modality)
        network.check_samples(samples, is_new=start is None or settings.refit_embedding)
    with process_group() as processes, ExitStack() as stack:
        about = about_run(dataset, settings, start, processes.device)
        if processes.rank == 0:
            stack.enter_context(directory_lock(out, check=lambda: check_run(out, about)))
            if (out / "run.yaml").is_file():
                tell_of_threads(out)
            else:
                save_yaml(about, out / "run.yaml")
        processes.wait()
        history = [*(start.history if start else []), about]
        known = None if captures is None else NlosDataset(captures, "train", network.modality)
        records = _epochs(network, dataset, samples, known, settings, out, history, processes, start, progress)
    return TrainingResult(out, records)


def _epochs(
    network: Reconstructor,
    dataset: Dataset,
    samples: NlosDataset | None,
    known: NlosDataset | None,
    settings: Training,
    out: Path,
    history: list[dict[str, Any]],
    processes: ProcessGroup,
    start: Weights | None,
    progress: Progress,
) -> list[dict[str, Any]]:
    """Run the epochs that are left, write the weights after the last, and return the records of all."""
    seed = settings.seed
    checkpoint, metrics = out / "checkpoint.safetensors", out / "metrics.jsonl"
    what = f"train {out.name}"
    if (out / "weights.safetensors").is_file():
        log = [json.loads(line) for line in metrics.read_text().splitlines()]
        progress(Step(what, len(log), settings.epochs, "epochs"))
        return log

    device, leads = processes.device, processes.rank == 0
    network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    trained = [p for p in network.parameters() if p.requires_grad]
    optimiser = torch.optim.Adam(trained, lr=settings.learning_rate)
    loss_of, half = LOSSES[settings.loss], _half(settings, device)
    progress(Step(f"{what}: gather its samples", 0, 1, "sets"))  # a minute, where a network pools sequences
    how = settings.batch_size, settings.seed, processes
    if isinstance(dataset, LiveDataset):
        steps: BatchSource = SimulatedSource(dataset, network.modality, *how)
    else:
        assert samples is not None  # of a training that has not ended
        steps = DiskSource(samples, *how)
    held_out = held_out_samples(dataset, network.modality, device) if leads else None

    done, log = 0, list[dict[str, Any]]()
    is_new = start is None or settings.refit_embedding  # of this light path nothing is known yet
    # The hash is that of the settings as they were written, maybe by an older version.
    key = config_hash(read_yaml(out / "run.yaml", LONG_YAML)["settings"])
    goes_on = checkpoint.is_file()
    if not (goes_on and is_new):  # else what is fitted stands in the checkpoint
        keep = settings.keep_normalization
        subset = with_mirrored(steps.subset) if settings.mirror else steps.subset
        network.fit(subset, seed, is_new=is_new, keep_normalization=keep)
    if goes_on and is_new:
        done, log = load_checkpoint(checkpoint, network, optimiser, key)
    begins = is_new and not done
    source: BatchSource | DrawnSource = steps
    alone = is_new and settings.drawn > 0
    if not alone:
        source = steps.for_network(network, settings.sequence_augmentations, is_new=begins)
    if settings.drawn:
        assert samples is not None
        shown = source.samples if isinstance(source, DiskSource) and not alone else None
        drawn = cast(SequenceReconstructor, network).drawn_sequences(samples, known, seed, is_new=begins)
        source = DrawnSource(drawn, settings.drawn, shown, *how)
    if goes_on and not is_new:  # its samples were those of the weights that it began with
        done, log = load_checkpoint(checkpoint, network, optimiser, key)
    if goes_on and leads:
        _write_log(metrics, log)
    progress(Step(what, done, settings.epochs, "epochs"))
    processes.wait()  # nobody writes before all have read
    processes.share(network)
    run = torch.compile(network) if settings.compile else network
    saved = time.monotonic()
    for epoch in range(done, settings.epochs):
        began, rate, total = time.perf_counter(), 0.0, torch.zeros((), device=device)
        network.train()
        for step, batch in enumerate(source.batches(epoch)):
            rate = learning_rate_at(settings, epoch + step / source.steps)
            for group in optimiser.param_groups:
                group["lr"] = rate
            seen, truth = (part.to(device, non_blocking=True) for part in (batch.seen, batch.truth))
            if settings.mirror:
                draw = derive_seed(settings.seed, "mirror", epoch, step, processes.rank)
                seen, truth = half_mirrored(seen, truth, draw)
            light = processes.total(light_of(truth) * batch.share)
            with torch.autocast(device.type, torch.bfloat16, enabled=half):
                image = run(seen.contiguous(memory_format=torch.channels_last))
            loss = loss_of(image.float(), truth, light) * batch.share  # losses are in float32
            optimiser.zero_grad(set_to_none=True)
            (loss * processes.size).backward()  # the mean over the processes is then the whole batch's gradient
            processes.average_gradients(trained)
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
            if epoch == done or time.monotonic() - saved >= _CHECKPOINT_S:
                save_checkpoint(checkpoint, network, optimiser, epoch + 1, log, key)
                saved = time.monotonic()
            _write_log(metrics, log)
        progress(Step(what, epoch + 1, settings.epochs, "epochs", record))
    if leads:
        network = network.cpu().eval()
        done_weights = Weights(
            network,
            history,
            steps.mean_image(),
            confidence_of(network, held_out, dataset, start),
        )
        save_weights(out / "weights.safetensors", done_weights)
        checkpoint.unlink(missing_ok=True)
    processes.wait()
    return log


def _network(settings: Training, start: Weights | None, sampling: Sampling) -> tuple[Reconstructor, Training]:
    """Return the network to train; fine-tuning takes kind, modality and size from its weights."""
    if start is None or settings.refit_embedding:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derive_seed(settings.seed, "weights"))
            network = settings.network.build(as_modality(settings.modality), sampling)
        if start is not None:
            network.take_layers(start.network)
        return network, settings
    network = start.network.seeing(sampling)
    return network, replace(settings, network=network.settings, modality=start.modality.name)


def _check_drawn(
    network: Reconstructor, settings: Training, captures: Dataset | None, progress: Progress
) -> None:
    """Refuse drawn sequences where nobody knows how to draw them; draw the targets where they are missing."""
    if captures is not None and not settings.drawn:
        raise ConfigError(
            f"captures ({captures.folder.name}) show what drawn sequences err by, and drawn is 0; give --drawn "
            "2000 or so, or leave them out"
        )
    if captures is not None and captures.sampling.canvas != network.sampling.canvas:
        raise ConfigError(
            f"{captures.folder.name} shows another canvas than the samples; import it with the same --sampling"
        )
    if settings.drawn and not network.draws_sequences:
        raise ConfigError(
            f"drawn is {settings.drawn}; a network learns from drawn sequences only where frames "
            "(--network.kind sequence --network.frames likelihood) and events (--sampling.surface likelihood) "
            "are solved; leave --drawn at 0"
        )
    if settings.drawn:
        drawn_targets(network.sampling.setup, progress=progress)


def _check_data(dataset: Dataset, network: Reconstructor) -> None:
    """Refuse, before anything is written, what a training could not end with."""
    learned = dataset.objects("train")
    if isinstance(dataset, LiveDataset):
        if network.sees_sequence:
            raise ConfigError(
                f"a reconstructor of kind {network.kind!r} learns from sequences on disk; write them with "
                "`evnlos simulate` first"
            )
        return
    lost = [n for n in (*learned, *dataset.split.get("validation", [])) if not dataset.shard(n).is_file()]
    if lost:
        raise DataError(
            f"{dataset.folder} lacks {len(lost)} of its shards ({lost[0]} is the first); run the command that "
            "made the dataset again"
        )


def _write_log(path: Path, log: list[dict[str, Any]]) -> None:
    write_atomically(path, "".join(json.dumps(line) + "\n" for line in log).encode())


def _half(settings: Training, device: torch.device) -> bool:
    if settings.precision != "auto":
        return settings.precision == "bf16"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    # Asked of the processor, not of oneDNN, which also says yes where it only emulates bf16, at half the speed.
    return torch.cpu._is_avx512_bf16_supported()


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
    """Return psnr_db, zero_db (an all-black image's) and collapsed of the samples that are held out."""
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
    """Return the confidence in the images: of the validation, or of the weights that this began with."""
    if isinstance(held_out, NlosDataset):
        is_known = not np.isnan(held_out.position_m).any()
        if is_known and len(dataset.objects("validation")) >= FEWEST:
            return fit_confidence(network, held_out, dataset.sampling.canvas)
    return start.confidence if start else None
