"""The unrolled reconstructor: its steps go by the exact likelihood, begin at the solved image, and learn."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from evnlos import evaluate, train
from evnlos.cli import main
from evnlos.config import save_yaml, to_dict
from evnlos.data import NlosDataset, Sampling, SensorSize, Simulation, simulate
from evnlos.errors import ConfigError, DataError
from evnlos.inverse import EVENT_ERRORS, EVENT_ERRORS_FILE, AboutErrors, event_prior
from evnlos.inverse.sequence_light import EVENT_PRIORS
from evnlos.models import UnrolledConfig, UnrolledReconstructor, Weights, load_weights, save_weights
from evnlos.models.drawn import TargetGrid
from evnlos.scene import HandwritingGlyphs
from evnlos.setups import RadiometricSetup, load_setup
from evnlos.training import Training

NET = UnrolledConfig(width=8, depth=1, shuffle=2, rank=100, prior_weights=(0.3, 3.0), steps=2)
PLAN = Training(epochs=4, network=NET, precision="float32", batch_size=8, drawn=48)
SAMPLING = Sampling(height=32, width=48, pitch_m=0.005, scored_rows=24, surface="likelihood")
MODALITIES = ("frame", "event", "fusion")


def random_information(count: int, seen: int, seed: int = 0) -> torch.Tensor:
    """Return an information of which `seen` directions are told, each with another strength."""
    draw = torch.Generator().manual_seed(seed)
    axes = torch.linalg.qr(torch.randn(count, count, generator=draw, dtype=torch.float64)).Q[:, :seen]
    return (axes * torch.logspace(2, -1, seen, dtype=torch.float64)) @ axes.T


def gradient(information: torch.Tensor, score: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    """Return the gradient of log p(b | z) = b z - z A z / 2 by automatic differentiation, times (A + 1)^-1."""
    z = z.double().requires_grad_()
    (score * z - 0.5 * z * (z @ information)).sum().backward()
    own = torch.eye(len(information), dtype=torch.float64)
    return torch.linalg.solve(information + own, z.grad.T).T


def test_scores_of_frames_are_gradients_of_their_likelihood() -> None:
    torch.manual_seed(0)
    network = NET.build("frame", SAMPLING)
    grid, frames = network.grid, network.frames
    axes = torch.linalg.qr(torch.randn(1024, 150)).Q.T
    frames.patterns.copy_((axes * torch.logspace(0.5, -0.5, 150)[:, None]).view(150, 32, 32))
    frames.mean.copy_(torch.rand(32, 32))
    information = random_information(150, 90)
    b, x = 5 * torch.randn(3, 150, dtype=torch.float64), torch.rand(3, 1, grid.side, grid.side)
    pooled = frames.maps(information, b, grid).half().float()  # as training samples are kept
    assert pooled.shape == (3, 3 + frames.packed(grid), grid.side, grid.side)
    told = frames.read(pooled[:, 3:], pooled[:, :3], grid)
    cells = grid.target_of(x[:, 0], 0.08, 32).flatten(1).double()
    patterns, mean = frames.patterns.flatten(1).double(), frames.mean.flatten().double()
    z = torch.linalg.lstsq(patterns.T, (cells - mean).T).solution.T
    expected = gradient(information, b, z) @ patterns / patterns.square().sum(dim=0).mean().sqrt()
    expected = grid.of_target(expected.view(3, 1, 32, 32), 0.08)
    found = told.score(x).double()
    assert (found - expected).abs().max() < 3e-3 * expected.abs().max()
    posterior = torch.linalg.inv(information + torch.eye(150, dtype=torch.float64))
    deviation = (patterns.T @ posterior @ patterns).diagonal().sqrt()
    deviation = deviation / patterns.square().sum(dim=0).mean().sqrt()
    shown = grid.of_target(deviation.view(1, 32, 32), 0.08)
    torch.testing.assert_close(pooled[0, 2].double(), shown[0], atol=2e-3, rtol=2e-3)
    # Of several subsets each has its own information.
    several = torch.stack([information, 2 * information, random_information(150, 30, seed=1)])
    together = frames.maps(several, b, grid)
    alone = [frames.maps(a[None], s[None], grid) for a, s in zip(several, b, strict=True)]
    torch.testing.assert_close(together, torch.cat(alone), atol=1e-4, rtol=1e-4)


@pytest.fixture(scope="module")
def behind(tmp_path_factory) -> Path:
    """A folder of a setup that says what to draw and what events of five captures, dim and bright, tell."""
    folder = tmp_path_factory.mktemp("behind")
    setup = RadiometricSetup(cell_m=0.01, gain=0.7, ambient=0.06, sensor=SensorSize(48, 72))
    save_yaml(to_dict(setup), folder / "setup.yaml")
    glyphs = HandwritingGlyphs(characters="BCEFHLT", writers=2)
    save_yaml(to_dict(Simulation(glyphs=glyphs, setup=setup)), folder / "training.yaml")
    values, axes = torch.linalg.eigh(random_information(240, 60))
    light = torch.tensor([0.1, 0.15, 0.2, 0.3, 0.4])
    strengths = (light / 0.2) ** -1.5
    roots = torch.stack([(axes * (g * values.clamp_min(0)).sqrt()) @ axes.T for g in strengths.double()])
    known = {"errors": torch.randn(5, 240), "roots": roots.float(), "light": light}
    EVENT_ERRORS.write(folder / EVENT_ERRORS_FILE, known, AboutErrors(tuple("ABCDE")))
    return folder


@pytest.fixture(scope="module")
def dataset(behind, tmp_path_factory):
    """Few simulated sequences, frames and events, both solved through that setup."""
    config = Simulation(
        glyphs=HandwritingGlyphs(characters="ABCEFHLT", writers=1),
        setup=load_setup(str(behind)),
        sampling=replace(SAMPLING, setup=str(behind)),
        positions=6,
    )
    return simulate(config, tmp_path_factory.mktemp("simulated") / "data")


def test_scores_of_events_are_gradients_with_the_information_of_targets_as_bright(behind) -> None:
    sampling = replace(SAMPLING, setup=str(behind))
    grid, prior = TargetGrid(sampling), event_prior(load_setup(str(behind)), 0.08)
    events = NET.build("event", sampling).events
    events.fit(sampling)
    torch.testing.assert_close(events.law[1], torch.tensor(-1.5), atol=0.02, rtol=0)
    targets = torch.rand(2, 32, 32) * torch.tensor([0.3, 0.7])[:, None, None]
    solved = torch.stack([targets, targets + 0.05 * torch.rand(2, 32, 32)], dim=1)
    images, x = grid.of_target(solved, 0.08), torch.rand(2, 1, grid.side, grid.side)
    told = events.read(images, images, grid)
    assert told.shown.shape == (2, 3, grid.side, grid.side)

    def z_of(one: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(prior.coefficients(grid.target_of(one, 0.08, 32).double().numpy()))

    patterns, own = torch.from_numpy(prior.patterns), torch.eye(240, dtype=torch.float64)
    for k in range(2):
        light = float(grid.target_of(images[k : k + 1, 1], 0.08, 32).mean())
        a = random_information(240, 60) * (light / 0.2) ** -1.5
        told_of = torch.linalg.pinv(a, rcond=1e-6) @ a  # nothing is told of other directions
        z = [z_of(images[k : k + 1, n])[0] for n in range(2)]
        scores = [told_of @ (a + w * own) @ one for one, w in zip(z, EVENT_PRIORS, strict=True)]
        b = torch.stack(scores).mean(dim=0)
        expected = gradient(a, b[None], z_of(x[k : k + 1, 0])) @ patterns.T
        expected = grid.of_target(expected.view(1, 1, 32, 32), 0.08) / events.unit
        error = (told.score(x)[k] - expected[0]).square().mean() / expected.square().mean()
        assert error < 2e-3


def test_an_untrained_network_returns_the_solved_image(behind) -> None:
    sampling = replace(SAMPLING, setup=str(behind))
    for modality in MODALITIES:
        net = NET.build(modality, sampling)
        assert isinstance(net, UnrolledReconstructor)
        torch.manual_seed(0)
        if net.frames is not None:
            net.frames.patterns.copy_(0.1 * torch.randn(150, 32, 32))
            net.frames.mean.fill_(0.3)
        if net.events is not None:
            net.events.fit(sampling)
        x = torch.rand(2, net.scale.mean.numel() + (modality != "event") * 8, net.grid.side, net.grid.side)
        image = net(x)
        if net.frames is None:
            told = net.events.read(x, x, net.grid)
        else:
            told = net.frames.read(x[:, 3:11], x[:, :3], net.grid)
        torch.testing.assert_close(image, told.start.clamp(0.02, 0.98))


@pytest.fixture(scope="module", params=MODALITIES)
def trained(request, dataset, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("evnlos.models.drawn.TRAIN_WRITERS", 1)
        out = tmp_path_factory.mktemp("run") / request.param
        return train(dataset, replace(PLAN, modality=request.param), out)


def test_it_learns_from_drawn_sequences_is_read_back_and_tuned(trained, dataset, tmp_path) -> None:
    assert trained.records[-1]["loss"] < 0.97 * trained.records[0]["loss"]
    weights = trained.load()
    network = weights.network
    assert network.kind == "unrolled" and network.sees_sequence
    samples = NlosDataset(dataset, "train", network.modality)
    images = network.infer(samples.inputs, samples.position_m, samples.names)
    save_weights(tmp_path / "again.safetensors", weights)
    again = load_weights(tmp_path / "again.safetensors").network
    torch.testing.assert_close(again.infer(samples.inputs, samples.position_m, samples.names), images)
    save_weights(tmp_path / "half.safetensors", weights, torch.float16)
    half = load_weights(tmp_path / "half.safetensors").network
    assert (half.infer(samples.inputs, samples.position_m, samples.names) - images).abs().mean() < 0.01
    found = evaluate(weights, dataset, "train")
    assert found.scores.mean()["psnr_db"] > found.baselines["zero"].mean()["psnr_db"]
    plan = replace(PLAN, epochs=1, drawn=0, keep_normalization=True, freeze=("encoder",))
    tuned = train(dataset, plan, tmp_path / "tuned", trained.folder).load().network
    old, new = dict(network.named_parameters()), dict(tuned.named_parameters())
    assert torch.equal(old["unet.steps.1.stem.weight"], new["unet.steps.1.stem.weight"])
    assert not torch.equal(old["unet.steps.1.head.weight"], new["unet.steps.1.head.weight"])
    if network.frames is not None:
        assert isinstance(network.reduced(60), UnrolledReconstructor)


def test_layers_of_frames_begin_a_network_of_frames_and_events(behind) -> None:
    sampling = replace(SAMPLING, setup=str(behind))
    old, new = NET.build("frame", sampling), NET.build("fusion", sampling)
    new.take_layers(old)
    first = old.unet.steps[0].stem.weight
    torch.testing.assert_close(new.unet.steps[0].stem.weight, F.pad(first, (0, 0, 0, 0, 0, 16)))


def test_the_command_line_trains_and_says_what_it_cannot(dataset, behind, tmp_path, capsys) -> None:
    words = [
        "train",
        "--data",
        str(dataset.folder),
        "--modality",
        "event",
        "--epochs",
        "1",
        "--batch-size",
        "8",
    ]
    small = ["--network.kind", "unrolled", "--network.width", "8", "--network.steps", "1"]
    main([*words, *small, "--out", str(tmp_path / "run")])
    assert load_weights(tmp_path / "run").network.settings.steps == 1
    capsys.readouterr()
    main(["weights", str(tmp_path / "run")])
    assert "event, unrolled" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="steps is 0"):
        replace(NET, steps=0)
    with pytest.raises(ConfigError, match=r"take --network\.kind sequence"):
        replace(NET, frames="embedding")
    with pytest.raises(ConfigError, match="events is embedded"):
        NET.build("fusion", Sampling())
    known = (behind / EVENT_ERRORS_FILE).rename(behind / "away")
    try:
        with pytest.raises(DataError, match=r"has no events\.safetensors"):
            train(dataset, replace(PLAN, drawn=0, modality="event"), tmp_path / "none")
    finally:
        known.rename(behind / EVENT_ERRORS_FILE)


def test_weights_without_a_training_are_written_and_read(behind, tmp_path) -> None:
    network = NET.build("fusion", replace(SAMPLING, setup=str(behind))).eval()
    network.events.fit(network.sampling)
    save_weights(tmp_path / "w.safetensors", Weights(network))
    same = load_weights(tmp_path / "w.safetensors").network
    assert same.settings == network.settings
    for name, value in network.state_dict().items():
        assert np.array_equal(value, same.state_dict()[name]), name
