"""What a network knows before its first step: the scale of the data, and the light path undone linearly."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from evnlos import EvnlosError, train
from evnlos.data import NlosDataset, Sampling, as_modality
from evnlos.errors import ConfigError
from evnlos.live import StreamingReconstructor
from evnlos.models import UNetConfig, Weights, fit_linear, load_weights, save_weights
from evnlos.models.embedding import InputNormalization, LinearEmbedding, LinearEmbeddings
from evnlos.training import Training

NET = UNetConfig(width=8, depth=1, rank=12, ridge_multipliers=(0.1, 1.0, 10.0))


@pytest.fixture(scope="module")
def samples() -> tuple[torch.Tensor, torch.Tensor, np.ndarray]:
    draw = torch.Generator().manual_seed(0)
    truth = torch.rand(60, 6, 8, generator=draw)
    matrix = torch.randn(48, 2 * 48, generator=draw) / 10
    seen = truth.flatten(1) @ matrix + 0.1 * torch.randn(60, 96, generator=draw)
    return seen.unflatten(1, (2, 6, 8)), truth, np.repeat([f"o{k}" for k in range(12)], 5)


def test_each_strength_is_a_ridge_regression_of_its_own(samples) -> None:
    inputs, truth, names = samples
    estimate = fit_linear(inputs, truth, names, rank=96)
    embedding = LinearEmbedding(2, (6, 8), 96, NET.ridge_multipliers)
    embedding.take(estimate)
    x = (inputs.flatten(1) - inputs.flatten(1).mean(0)).double()
    y = (truth.flatten(1) - truth.flatten(1).mean(0)).double()
    inner = x.T @ x
    # sixty samples span at most sixty directions: the mean power is over those that were kept
    unit = estimate.regularization * inner.diagonal().sum() / len(estimate.powers)
    for k, strength in enumerate(NET.ridge_multipliers):
        weights = torch.linalg.solve(inner + strength * unit * torch.eye(96, dtype=torch.float64), x.T @ y)
        expected = truth.double().mean(0) + (x @ weights).unflatten(1, (6, 8))
        torch.testing.assert_close(embedding(inputs)[:, k].double(), expected, atol=2e-4, rtol=0)


def test_frame_and_events_are_undone_each_on_its_own() -> None:
    draw = torch.Generator().manual_seed(2)
    truth = torch.rand(60, 6, 8, generator=draw)
    seen = torch.stack([truth, 0.5 * truth, 0 * truth], dim=1) + 0.1 * torch.randn(60, 3, 6, 8, generator=draw)
    names = np.repeat([f"o{k}" for k in range(12)], 5)
    both = LinearEmbeddings(as_modality("fusion"), (6, 8), 40, NET.ridge_multipliers)
    both.fit(seen, truth, names, seed=4)
    frame, events = both.groups["frame"], both.groups["events"]
    assert (both.rank, both.images, frame.rank, events.rank) == (40, 6, 25, 15)
    alone = LinearEmbedding(1, (6, 8), 25, NET.ridge_multipliers)
    alone.take(fit_linear(seen[:, :1], truth, names, rank=25, seed=4))
    pictures = both(seen)
    assert pictures.shape == (60, 6, 6, 8)
    torch.testing.assert_close(pictures[:, :3], alone(seen[:, :1]))
    # The frame's images know nothing of the events, and the other way round.
    blind = seen.clone()
    blind[:, 1:] = 0
    torch.testing.assert_close(both(blind)[:, :3], pictures[:, :3])
    assert not torch.allclose(both(blind)[:, 3:], pictures[:, 3:])
    both.keep(16)
    assert (frame.rank, events.rank) == (10, 6)
    for rank in (1, 17):
        with pytest.raises(ConfigError, match=f"to be {rank}; this embedding has 16"):
            both.keep(rank)
    with pytest.raises(ConfigError, match="give 2 or more"):
        LinearEmbeddings(as_modality("fusion"), (6, 8), 1, (1.0,))


def test_fewer_samples_than_components_leave_the_rest_empty(samples) -> None:
    inputs, truth, names = samples
    embedding = LinearEmbedding(2, (6, 8), 96, (1.0,))
    embedding.take(fit_linear(inputs, truth, names, rank=96))
    before = embedding(inputs[:2])
    embedding.take(fit_linear(inputs[:10], truth[:10], names[:10], rank=96))
    assert not torch.allclose(embedding(inputs[:2]), before)
    assert (embedding.basis.abs().sum(0) > 0).sum() <= 10


@pytest.mark.parametrize(("modality", "channels"), [("frame", 1), ("event", 2), ("fusion", 3)])
@pytest.mark.parametrize("scaling", ["dataset", "picture"])
def test_frames_lose_their_mean_and_events_keep_their_zero(modality: str, channels: int, scaling: str) -> None:
    draw = torch.Generator().manual_seed(channels)
    x = torch.rand(5, channels, 6, 8, generator=draw) * torch.arange(1, 6)[:, None, None, None]
    layer = InputNormalization(as_modality(modality), scaling)
    layer.fit(x)
    found = layer(x)
    for k in range(5):
        whole = x if scaling == "dataset" else x[k : k + 1]
        frames, events = whole[:, : channels % 2], whole[:, channels % 2 :]
        expected = []
        if channels % 2:
            expected.append((x[k, :1] - frames.mean()) / frames.std(correction=0))
        if channels > 1:
            expected.append(x[k, channels % 2 :] / events.square().mean().sqrt())
        torch.testing.assert_close(found[k], torch.cat(expected))


def test_scaled_by_itself_an_image_tells_neither_gain_nor_ambient_light() -> None:
    layer = InputNormalization(as_modality("frame"), "picture")
    x = torch.rand(2, 1, 6, 8)
    torch.testing.assert_close(layer(0.5 * x + 0.2), layer(x), atol=1e-5, rtol=0)
    assert torch.isfinite(layer(torch.zeros(1, 1, 6, 8))).all()


def test_training_gives_a_new_network_both_and_weights_keep_them(tiny_dataset, tmp_path) -> None:
    plan = Training(epochs=1, network=NET, precision="float32", modality="fusion")
    train(tiny_dataset, plan, tmp_path / "first")
    weights = load_weights(tmp_path / "first")
    known = NlosDataset(tiny_dataset, "train", "fusion")
    normalization, embedding = weights.network.normalization, weights.network.embedding
    assert embedding is not None and embedding.rank == NET.rank
    wanted = InputNormalization(as_modality("fusion"), "dataset")
    wanted.fit(known.inputs.float())
    torch.testing.assert_close(normalization.mean, wanted.mean)
    seen = normalization(known.inputs.float())
    pictures, truth = embedding(seen)[:, 1], known.truth.float()
    assert (pictures - truth).square().mean() < 0.8 * (truth.mean(0) - truth).square().mean()

    train(tiny_dataset, replace(plan, seed=1), tmp_path / "second", tmp_path / "first")
    later = load_weights(tmp_path / "second").network
    assert torch.equal(later.embedding.groups["events"].basis, embedding.groups["events"].basis)

    save_weights(tmp_path / "half.safetensors", weights, torch.float16)
    half = load_weights(tmp_path / "half.safetensors")
    assert (tmp_path / "half.safetensors").stat().st_size < 0.55 * (
        tmp_path / "first" / "weights.safetensors"
    ).stat().st_size
    one, other = (w.network.infer(known.inputs[:4]) for w in (weights, half))
    torch.testing.assert_close(one, other, atol=0.02, rtol=0)


def test_fine_tuning_takes_the_scale_of_the_new_data_only_where_it_shall(tiny_dataset, tmp_path) -> None:
    plan = Training(epochs=1, network=NET, precision="float32")
    train(tiny_dataset, plan, tmp_path / "first")
    weights = load_weights(tmp_path / "first")
    weights.network.normalization.mean.fill_(7.0)
    save_weights(tmp_path / "other.safetensors", weights)
    for keep in (False, True):
        settings = replace(plan, keep_normalization=keep)
        train(tiny_dataset, settings, tmp_path / f"{keep}", tmp_path / "other.safetensors")
        mean = load_weights(tmp_path / f"{keep}").network.normalization.mean
        assert (float(mean) == 7.0) == keep


def test_a_single_position_is_seen_as_in_a_batch(tiny_dataset, tmp_path) -> None:
    sampling = tiny_dataset.sampling
    network = NET.build("frame", sampling).eval()
    known = NlosDataset(tiny_dataset, "train", "frame")
    network.embedding.groups["frame"].take(fit_linear(known.inputs, known.truth, known.names, NET.rank))
    see = StreamingReconstructor(Weights(network))
    surface = np.zeros((2, sampling.height, sampling.width))
    frame = known.inputs[3, 0].float()
    torch.testing.assert_close(
        see(frame.numpy(), surface), network.infer(known.inputs[3:4])[0], atol=1e-4, rtol=0
    )


def test_wrong_sizes_and_settings_are_named() -> None:
    with pytest.raises(EvnlosError, match=r"takes \[B, 1, 6, 8\]"):
        NET.build("frame", Sampling(height=6, width=8, scored_rows=6))(torch.zeros(1, 1, 8, 8))
    with pytest.raises(ConfigError, match=r"rank is -1"):
        UNetConfig(rank=-1)
    with pytest.raises(ConfigError, match="ridge_multipliers"):
        UNetConfig(ridge_multipliers=(1.0, 0.0))
