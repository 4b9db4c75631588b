"""A whole sequence as one measurement: aligned by the motion, pooled, and better than its best position."""

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evnlos import EvnlosError, evaluate, train
from evnlos.analysis import curve_over_positions, curve_so_far
from evnlos.analysis.model import choices
from evnlos.analysis.scores import aligned_mean
from evnlos.cli import main
from evnlos.config import save_yaml, to_dict
from evnlos.data import NlosDataset, Sampling, SensorSize, Simulation, as_modality, simulate
from evnlos.data.simulations import fitting
from evnlos.errors import ConfigError, DataError
from evnlos.inverse import (
    EVENT_ERRORS,
    EVENT_ERRORS_FILE,
    AboutErrors,
    ScoreErrors,
    SequenceOperator,
    event_prior,
    ridge_by_groups,
    root_of,
)
from evnlos.live import StreamingReconstructor
from evnlos.machine import Step
from evnlos.metrics import psnr
from evnlos.models import (
    FrameOperator,
    SequenceConfig,
    SequenceReconstructor,
    UNetConfig,
    Weights,
    load_weights,
    on_target_plane,
)
from evnlos.models.drawn import DRAWN, DrawnEvents, DrawnFrames, KnownSequence, TargetGrid, subsets
from evnlos.models.sequence import PooledFrames
from evnlos.optics import MatrixTransport
from evnlos.scene import FontGlyphs, HandwritingGlyphs, Target
from evnlos.setups import RadiometricSetup, load_setup
from evnlos.training import Training
from evnlos.types import Plane
from watching import stopped

NET = SequenceConfig(width=8, depth=1, shuffle=2, rank=24, ridge_multipliers=(0.01, 1.0))
PLAN = Training(epochs=6, network=NET, precision="float32", batch_size=4, sequence_augmentations=2)
PITCH_M = 0.0025


def network() -> SequenceReconstructor:
    return SequenceReconstructor(as_modality("frame"), NET, Sampling(height=64, width=96, pitch_m=PITCH_M))


def test_images_of_a_moving_target_meet_on_the_target_and_come_back() -> None:
    target = FontGlyphs(characters="F").target("comic_neue_bold_F")
    places = np.array([[-0.05, -0.01], [0.0, 0.0], [0.0313, 0.0117], [0.06, 0.02]])
    truth = torch.from_numpy(target.rasterise(Plane(64, 96, PITCH_M), places)).float()
    at = torch.from_numpy(places).float()
    net = network()
    target = net.grid.mean(truth, at)
    assert target.shape == (80, 80)
    error = (net.grid.on_canvas(target, at) - truth).square().mean()
    assert 10 * torch.log10(1 / error) > 27
    shuffled = net.grid.mean(truth, at.flip(0))
    assert (net.grid.on_canvas(shuffled, at) - truth).square().mean() > 4 * error


def test_a_canvas_for_larger_targets_shows_them_as_the_usual_one_does() -> None:
    usual, travel = Sampling(), (0.16, 0.0)
    assert all(fitting(usual, size, travel) == usual for size in (0.03, 0.064, 0.08, 0.085))
    assert fitting(usual, 0.12, travel).pitch_m == pytest.approx(0.00375)
    assert fitting(usual, 0.08, (0.3, 0.0)).pitch_m == pytest.approx(0.38 / 96, abs=1e-6)
    assert fitting(usual, 0.08, (0.1, 0.1)).pitch_m == pytest.approx(0.18 / 48, abs=1e-6)
    one, other = network(), SequenceReconstructor(as_modality("frame"), NET, fitting(usual, 0.12, travel))
    images, at = torch.rand(3, 64, 96), torch.tensor([[-0.05, 0.0], [0.0, 0.01], [0.04, 0.0]])
    plane = one.grid.mean(images, at)
    torch.testing.assert_close(other.grid.mean(images, 1.5 * at), plane, rtol=1e-4, atol=1e-5)
    again = (net.grid.on_canvas(plane, scale * at) for net, scale in ((one, 1.0), (other, 1.5)))
    torch.testing.assert_close(*again, rtol=1e-4, atol=1e-5)
    taken = (
        on_target_plane(images, net.sampling.canvas, scale * at) for net, scale in ((one, 1.0), (other, 1.5))
    )
    torch.testing.assert_close(*taken, rtol=1e-4, atol=1e-5)
    solver = PooledFrames(fitting(usual, 0.12, travel), (1.0,), 8)
    assert solver.target_plane.extent_m == pytest.approx((0.12, 0.12))


def test_single_positions_with_noise_of_their_own_gain_by_their_aligned_mean() -> None:
    targets = [FontGlyphs(characters=c).target(f"comic_neue_bold_{c}") for c in "FL"]
    places = np.stack([np.linspace(-0.06, 0.06, 12), np.zeros(12)], axis=1)
    sampling = Sampling(height=64, width=96, pitch_m=PITCH_M)
    truth = torch.from_numpy(np.concatenate([t.rasterise(sampling.canvas, places) for t in targets])).float()
    noisy = truth + 0.3 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))
    names = np.repeat(["F", "L"], 12)
    mean = aligned_mean(noisy, np.concatenate([places, places]), names, sampling)
    seen = mean > 0  # beside the target plane nothing is drawn
    before, after = ((images - truth)[seen].square().mean() for images in (noisy, mean))
    assert before / after > 8  # of 12, less what resampling blurs
    together = aligned_mean(noisy, np.concatenate([places, places]), np.repeat("both", 24), sampling)
    assert (together - truth)[seen].square().mean() > 2 * after


def test_the_mean_is_over_the_positions_that_see_a_pixel() -> None:
    net = network()
    net.embedding.groups["frame"].mean_out.fill_(0.5)  # every position answers one half everywhere
    inputs, places = torch.zeros(3, 1, 64, 96), torch.tensor([[0.0, 0.0], [0.1, 0.0], [-0.03, 0.0]])
    pooled = net.pooled(inputs, places)
    inner = pooled[:, 4:-4, 4:-4]
    torch.testing.assert_close(inner, torch.full_like(inner, 0.5))
    with pytest.raises(DataError, match="off the canvas"):
        net.pooled(inputs, places + 1.0)


def test_subsets_are_pooled_as_one_by_one() -> None:
    net = network()
    torch.manual_seed(1)
    for buffer in net.embedding.buffers():
        buffer.copy_(torch.randn_like(buffer))
    inputs, places = torch.randn(70, 1, 64, 96), 0.05 * torch.randn(70, 2)
    kept = (torch.rand(5, 70) < 0.4).float()
    together = net.pooled_subsets(inputs, places, kept)
    for some, found in zip(kept.bool(), together, strict=True):
        torch.testing.assert_close(found, net.pooled(inputs[some], places[some]), rtol=1e-4, atol=1e-3)
    with pytest.raises(DataError, match="off the canvas"):
        net.pooled_subsets(inputs, places, kept * torch.tensor([[1.0], [1], [0], [1], [1]]))


@pytest.fixture(scope="module")
def trained(tiny_dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("sequence") / "run"
    return out, train(tiny_dataset, PLAN, out).records


def test_a_joint_run_learns_scores_and_is_read_back(trained, tiny_dataset) -> None:
    out, log = trained
    assert log[-1]["loss"] < log[0]["loss"]
    weights = load_weights(out)
    assert weights.network.kind == "sequence" and weights.network.sees_sequence
    found = evaluate(weights, tiny_dataset, "train")
    assert found.images.shape == found.truth.shape
    assert found.scores.mean()["psnr_db"] > found.baselines["zero"].mean()["psnr_db"]
    samples = NlosDataset(tiny_dataset, "train", "frame")
    both = weights.network.infer(samples.inputs, samples.position_m, samples.names)
    name = samples.names[0]
    mine = samples.names == name
    alone = weights.network.infer(samples.inputs[torch.from_numpy(mine)], samples.position_m[mine])
    torch.testing.assert_close(both[torch.from_numpy(mine)], alone)


def test_the_curve_over_positions_ends_at_the_whole_sequence(trained, tiny_dataset) -> None:
    weights = load_weights(trained[0])
    whole = len(NlosDataset(tiny_dataset, "train", "frame")) // len(tiny_dataset.objects("train"))
    points = curve_over_positions(weights, tiny_dataset, "train", (1, whole))
    assert [point.positions for point in points] == [1, whole]
    assert [point.subsets for point in points] == [min(whole, 8), 1]
    every = evaluate(weights, tiny_dataset, "train").scores.mean()["psnr_db"]
    assert points[-1].psnr_db == pytest.approx(every, abs=1e-4)
    assert points[0].psnr_db != pytest.approx(every, abs=1e-2)
    with pytest.raises(DataError, match=f"{whole + 1} positions"):
        curve_over_positions(weights, tiny_dataset, "train", (1, whole + 1))


def test_the_curve_so_far_ends_at_the_whole_sequence(trained, tiny_dataset, capsys) -> None:
    """Each image is made of the time steps up to its own; later ones may hold anything."""
    weights = load_weights(trained[0])
    points = curve_so_far(weights, tiny_dataset, "train")
    samples = NlosDataset(tiny_dataset, "train", "frame")
    mine = np.flatnonzero(samples.names == samples.names[0])
    assert [point.positions for point in points] == list(range(1, len(mine) + 1))
    rows, network = tiny_dataset.sampling.scored, weights.network.eval()
    inputs, places = samples.inputs[mine].float(), torch.from_numpy(samples.position_m[mine]).float()
    truth = samples.truth[mine].float()
    for step in (0, 1, len(mine) - 1):
        part = slice(0, step + 1)
        with torch.no_grad():
            image = network.draw(inputs[part], places[part], places[step : step + 1])
        own = psnr(image[:, rows].contiguous(), truth[step : step + 1, rows].contiguous())
        assert points[step].objects[str(samples.names[0])] == pytest.approx(float(own), abs=1e-3)
    arguments = ["--weights", str(trained[0]), "--data", str(tiny_dataset.folder), "--split", "train"]
    main(["evaluate", *arguments, "--so-far", "--json"])
    shown = json.loads(capsys.readouterr().out)["so_far"]
    assert [point["psnr_db"] for point in shown] == [point.psnr_db for point in points]
    main(["evaluate", *arguments, "--so-far", "--positions", "2"])
    table = capsys.readouterr().out
    assert f"| 2 | {points[1].psnr_db:.2f} |" in table and "| 1 |" not in table
    mean = np.mean([point.psnr_db for point in points])
    assert f"| mean of all | {mean:.2f} |" in table


def test_of_surfaces_so_far_the_last_one_counts() -> None:
    sampling = Sampling(surface="so-far")
    see = replace(NET, rank=8).build("event", sampling).eval()
    other = replace(NET, rank=8).build("event", replace(sampling, surface="likelihood")).eval()
    other.load_state_dict(see.state_dict())
    maps, places = torch.rand(5, 2, 64, 96), torch.zeros(5, 2)
    kept = torch.tensor([[1.0, 1, 1, 1, 1], [1, 0, 1, 0, 0], [0, 1, 0, 0, 0]])
    alone = torch.cat([other.pooled(maps[k : k + 1], places[:1])[None] for k in (4, 2, 1)])
    torch.testing.assert_close(see.pooled_subsets(maps, places, kept), alone)
    assert not torch.allclose(other.pooled_subsets(maps, places, kept)[0], alone[0])


def test_surfaces_that_know_later_events_are_refused(tiny_dataset) -> None:
    later = replace(tiny_dataset, sampling=replace(tiny_dataset.sampling, surface="trace"))
    weights = Weights(NET.build("event", later.sampling))
    with pytest.raises(DataError, match=r"--sampling\.surface so-far"):
        curve_so_far(weights, later, "train")


def test_evaluate_prints_the_curve(trained, tiny_dataset, capsys) -> None:
    arguments = ["--weights", str(trained[0]), "--data", str(tiny_dataset.folder), "--split", "train"]
    main(["evaluate", *arguments, "--positions", "1", "2", "--json"])
    points = json.loads(capsys.readouterr().out)["positions"]
    assert [point["positions"] for point in points] == [1, 2]
    main(["evaluate", *arguments, "--positions", "2"])
    assert f"| 2 | {points[1]['subsets']} | {points[1]['psnr_db']:.2f} |" in capsys.readouterr().out


@pytest.mark.parametrize("count", [1, 3, 7, 20, 39, 40])
def test_choices_are_equally_spaced_and_within_the_sequence(count: int) -> None:
    parts = choices(40, count)
    assert 1 <= len(parts) <= 8
    for part in parts:
        assert len(part) == count and part.min() >= 0 and part.max() < 40
        assert len(set(np.diff(part).tolist())) <= 1


def test_a_killed_joint_run_goes_on_to_the_same_bytes(trained, tiny_dataset, tmp_path) -> None:
    out, _ = trained
    stopped(train, tiny_dataset, PLAN, tmp_path / "again", after=2)
    train(tiny_dataset, PLAN, tmp_path / "again")
    one, other = (load_weights(run).network.state_dict() for run in (out, tmp_path / "again"))
    assert [name for name in one if not torch.equal(one[name], other[name])] == []


def test_fine_tuning_keeps_the_kind_and_frozen_parts(trained, tiny_dataset, tmp_path) -> None:
    out, _ = trained
    plan = replace(PLAN, network=UNetConfig(), epochs=1, freeze=("encoder",))
    train(tiny_dataset, plan, tmp_path / "fine", out)
    old, new = load_weights(out).network, load_weights(tmp_path / "fine").network
    assert new.kind == "sequence"
    assert torch.equal(old.unet.stem.weight, new.unet.stem.weight)
    assert not torch.equal(old.unet.head.weight, new.unet.head.weight)


def test_layers_of_another_setup_start_a_training_behind_a_new_embedding(trained, tiny_dataset, tmp_path):
    out, log = trained
    fewer = replace(NET, rank=12)
    plan = replace(PLAN, network=fewer, epochs=1, learning_rate=1e-9, schedule="constant", refit_embedding=True)
    begun = train(tiny_dataset, plan, tmp_path / "begun", out)
    old, new = load_weights(out).network, begun.load().network
    for name, value in new.named_parameters():
        torch.testing.assert_close(value, dict(old.named_parameters())[name], atol=1e-6, rtol=0)
    assert new.embedding.groups["frame"].rank == 12 != old.embedding.groups["frame"].rank
    # On the setup that the layers come from they are at home at once.
    assert begun.records[0]["loss"] < log[0]["loss"]
    for other in (replace(fewer, width=16), UNetConfig(width=8, depth=1, shuffle=2, rank=12)):
        with pytest.raises(ConfigError, match="weights to start from"):
            train(tiny_dataset, replace(plan, network=other), tmp_path / "other", out)


def test_layers_of_frames_begin_a_network_of_frames_and_events(trained) -> None:
    """What it sees besides begins with weights of 0: at first it is the network of frames."""
    old = load_weights(trained[0]).network
    new = SequenceReconstructor(as_modality("fusion"), NET, old.sampling)
    new.take_layers(old)
    torch.manual_seed(0)
    pooled = torch.randn(2, new.unet.channels, 16, 16)
    torch.testing.assert_close(new.unet(pooled), old.unet(pooled[:, : old.unet.channels]))
    with pytest.raises(ConfigError, match="sees frame"):
        old.take_layers(new)
    events = SequenceReconstructor(as_modality("event"), NET, old.sampling)
    with pytest.raises(ConfigError, match="give weights like it"):
        events.take_layers(old)


def test_what_a_joint_network_cannot_do_is_said(trained, tiny_dataset) -> None:
    weights = load_weights(trained[0])
    samples = NlosDataset(tiny_dataset, "train", "frame")
    with pytest.raises(DataError, match="where the target was"):
        weights.network.infer(samples.inputs)
    unknown = np.full_like(samples.position_m, np.nan)
    with pytest.raises(EvnlosError, match=r"capture\.yaml"):
        weights.network.infer(samples.inputs, unknown)
    with pytest.raises(DataError, match="whole sequences"):
        StreamingReconstructor(weights)
    with pytest.raises(ConfigError, match="rank"):
        replace(NET, rank=0)


SOLVING = replace(NET, rank=200, frames="likelihood", prior_weights=(0.3, 3.0))


def random_solver(rank: int) -> PooledFrames:
    """A solver of frames with random numbers for everything that it would take from samples."""
    torch.manual_seed(0)
    solver = PooledFrames(Sampling(height=24, width=36, pitch_m=0.005, scored_rows=20), (0.5, 4.0), rank)
    for name, buffer in solver.named_buffers():
        buffer.copy_(torch.randn_like(buffer) * {"basis": 0.3, "patterns": 0.3}.get(name, 0.1))
    solver.static.copy_(2.0 * torch.rand(len(solver.static)))
    solver.reach.copy_(torch.tensor([[-0.06, -0.01], [0.06, 0.01]]))
    return solver


def test_frames_are_solved_as_one_gaussian_posterior() -> None:
    """Against all rows of all frames at once, with offset and noise in a dense covariance."""
    solver = random_solver(200)
    places = torch.stack([torch.linspace(-0.05, 0.05, 5), 0.1 * torch.linspace(-0.05, 0.05, 5)], dim=1)
    frames, kept = torch.rand(5, 24, 36), torch.tensor([[1.0, 1, 1, 1, 1], [1, 0, 1, 0, 0]])
    white = torch.eye(200, dtype=torch.float64) + 0.03 * torch.randn(200, 200, dtype=torch.float64)
    other = deepcopy(solver)
    other.take_components(
        other.basis, other.light, other.along, other.static.diag().double(), white
    )  # the noise of one component is then no longer that of another

    light = solver.light.double()
    away = (frames - solver.ambient).flatten(1).double() @ solver.basis.double()
    carrier = MatrixTransport(light.flatten(1), solver.sampling.canvas, (1, len(light)))
    drawn = SequenceOperator(carrier, solver.target_plane, places.double().numpy()).drawn
    seen = torch.stack([torch.einsum("thw,rhw->tr", drawn(p), light) for p in solver.patterns.double()], dim=2)
    x, y = places[:, :1].double() / 0.06, places[:, 1:].double() / 0.01
    along = torch.cat([x**0, x, x**2, x**3, y, x * y, y**2], dim=1) @ solver.along.double()
    away = away - along - torch.einsum("thw,rhw->tr", drawn(solver.mean.double()), light)
    for one, noise in (
        (solver, torch.eye(200, dtype=torch.float64)),
        (other, torch.inverse(white.T @ white).contiguous()),
    ):
        for some, images in zip(kept.bool(), one(frames, places, kept), strict=True):
            rows, data = seen[some].flatten(0, 1), away[some].flatten()
            count = int(some.sum())
            offset = torch.ones(count, count, dtype=torch.float64)
            covariance = torch.kron(torch.eye(count, dtype=torch.float64), noise)
            covariance += torch.kron(offset, torch.diag(solver.static.double()))
            pushed = torch.linalg.solve(covariance, torch.cat([rows, data[:, None]], dim=1))
            for weight, image in zip(solver.weights, images, strict=True):
                normal = rows.T @ pushed[:, :-1] + weight * torch.eye(rows.shape[1], dtype=torch.float64)
                z = torch.linalg.solve(normal, rows.T @ pushed[:, -1])
                expected = solver.mean + torch.tensordot(z, solver.patterns.double(), dims=1)
                near = {"rtol": 1e-3, "atol": 1e-3 * float(expected.std())}
                torch.testing.assert_close(image.double(), expected, **near)


def test_scores_of_drawn_targets_are_those_of_their_frames() -> None:
    """M x + b and what is missed beside it is the score of the frames, whatever these are."""
    solver = random_solver(40)
    places = torch.stack([torch.linspace(-0.05, 0.05, 5), 0.1 * torch.linspace(-0.05, 0.05, 5)], dim=1)
    cells, frames, kept = Plane(9, 9, 0.01), torch.rand(5, 24, 36), subsets(5, 4, np.random.default_rng(0))
    target = torch.rand(9, 9)
    carrier = MatrixTransport(solver.light.flatten(1), solver.sampling.canvas, (1, 40))
    truth = SequenceOperator(carrier, cells, places.double().numpy()).drawn(target.double()).float()
    seen, base, information = solver.foreseen(cells, places, kept)
    found = (seen @ target.flatten()).double() + base + solver.errors(frames, truth, places, kept)
    images = torch.cat([solver.solved(information[k : k + 1], found[k : k + 1]) for k in range(4)])
    torch.testing.assert_close(images, solver(frames, places, kept), rtol=1e-3, atol=1e-3)


def test_known_sequences_of_other_lengths_and_ways_tell_errors_too() -> None:
    """The way of new targets is that of a sequence, not a mean of ways there and back."""
    solver, asked = random_solver(40), list[torch.Tensor]()
    grid = TargetGrid(solver.sampling)
    foreseen = solver.foreseen
    solver.foreseen = lambda *args: (asked.append(args[1]), foreseen(*args))[1]
    known = list[KnownSequence]()
    for steps, sign in ((9, 1.0), (8, -1.0), (8, 1.0), (9, -1.0), (8, 1.0), *6 * ((8, 1.0),), (3, 1.0)):
        way = sign * torch.linspace(-0.05, 0.05, steps)[:, None] * torch.tensor([1.0, 0.1])
        known.append(KnownSequence(torch.rand(steps, 24, 36), torch.rand(steps, 24, 36), way, solver))
    frames = DrawnFrames(solver, known, grid)
    assert frames.kept.shape == (8, 8) and torch.equal(asked[0], known[2].position_m)
    images = frames(torch.rand(2, grid.side, grid.side), torch.Generator().manual_seed(0))
    assert images.shape == (2, 2, grid.side, grid.side) and torch.isfinite(images).all()


def test_errors_of_scores_are_told_from_noise_and_drawn_again() -> None:
    """Mean, scatter and noise of many known targets come back; noise alone shows neither mean nor scatter."""
    draw = np.random.default_rng(0)
    mean, spread, noise = draw.normal(size=30), draw.normal(size=(30, 2)), draw.normal(size=(400, 30))
    known = mean + draw.normal(size=(400, 2)) @ spread.T + 0.5 * noise
    for given in (0.25, None):
        errors = ScoreErrors.of(known, given)
        again = errors.draw(4000, torch.Generator().manual_seed(1)).numpy()
        expected = spread @ spread.T + 0.25 * np.eye(30)
        assert np.abs(again.mean(axis=0) - mean).max() < 0.2 * np.abs(mean).max()
        assert np.abs(np.cov(again.T) - expected).max() < 0.15 * np.abs(expected).max()
    alone = ScoreErrors.of(noise[:12], 1.0)
    assert np.abs(alone.mean).max() < 0.1 * np.abs(mean).max()
    assert np.square(alone.spread).sum() < 0.2 * np.square(spread).sum()
    few = ScoreErrors.of(noise[:1], 0.25)
    assert few.spread.shape == (30, 0) and not few.mean.any() and few.noise == 0.25


def test_what_says_nothing_of_the_target_has_no_noise() -> None:
    """The root of information is its own square root, symmetric, and nothing where it is nothing."""
    draw = np.random.default_rng(0)
    half = draw.normal(size=(2, 12, 7))
    information = half @ half.swapaxes(1, 2)  # five of twelve directions unseen
    roots = root_of(information)
    np.testing.assert_allclose(roots @ roots, information, atol=1e-6)
    np.testing.assert_allclose(roots, roots.swapaxes(1, 2), atol=1e-12)
    assert (np.linalg.eigvalsh(roots)[:, :5] < 1e-3).all()


def test_motions_in_turn_are_solved_as_each_alone() -> None:
    """What a solver keeps of the last motions belongs to them, and to its own numbers."""
    torch.manual_seed(0)
    solver = PooledFrames(Sampling(height=24, width=36, pitch_m=0.005, scored_rows=20), (0.5,), 50)
    for buffer in solver.buffers():
        buffer.copy_(torch.rand_like(buffer))
    places, frames = torch.linspace(-0.05, 0.05, 6)[:, None] * torch.tensor([1.0, 0.2]), torch.rand(6, 24, 36)
    parts = [slice(0, 6), slice(0, 3), slice(3, 6), slice(1, 5), slice(0, 6), slice(3, 6)]
    for change in (1.0, 1.5):
        solver.load_state_dict(solver.state_dict() | {"patterns": change * solver.patterns})
        for part in parts:
            kept = torch.ones(1, len(places[part]))
            alone = deepcopy(solver)
            alone.load_state_dict(solver.state_dict())  # which knows no motion then
            torch.testing.assert_close(*(one(frames[part], places[part], kept) for one in (solver, alone)))


def test_ridge_regression_leaves_out_group_after_group() -> None:
    """Against the penalty of each column, and what it misses, that solving anew without each group gives."""
    torch.manual_seed(1)
    known, group = torch.randn(60, 12), torch.arange(60) % 5
    wanted = known @ torch.randn(12, 4) + torch.tensor([0.5, 9.0, 9.0, 0.0]) * torch.randn(60, 4)
    wanted[:, 3] *= torch.tensor([1.0, -1.0, 0.0, 0.0, 0.0])[group]  # what others predict has the wrong sign
    penalties = (1e-3, 1e-2, 1e-1, 10.0)
    x, y = known.double(), wanted.double()

    def solved(kept: torch.Tensor, penalty: float) -> torch.Tensor:
        own = penalty * float(x.square().sum()) * torch.eye(12)
        return torch.linalg.solve(x[kept].T @ x[kept] + own, x[kept].T @ y[kept])

    left = torch.empty(len(penalties) + 1, 60, 4, dtype=torch.float64)
    left[-1] = y
    for row, penalty in enumerate(penalties):
        for g in range(5):
            left[row, group == g] = y[group == g] - x[group == g] @ solved(group != g, penalty)
    best = left.square().sum(dim=1).argmin(dim=0)
    assert len(best.unique()) > 2 and best[-1] == len(penalties)
    found, missed = ridge_by_groups(known, wanted, group, penalties)
    for column, row in enumerate(best.tolist()):
        torch.testing.assert_close(missed[:, column], left[row, :, column], rtol=1e-4, atol=1e-4)
        own = solved(group >= 0, penalties[row])[:, column] if row < len(penalties) else torch.zeros(12)
        torch.testing.assert_close(found[:, column].double(), own.double(), rtol=1e-4, atol=1e-5)


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """A simulation whose samples name the file of its setup."""
    folder = tmp_path_factory.mktemp("solved")
    setup = RadiometricSetup(cell_m=0.01, gain=0.7, ambient=0.06, sensor=SensorSize(48, 72))
    save_yaml(to_dict(setup), folder / "setup.yaml")
    sampling = Sampling(height=32, width=48, pitch_m=0.005, scored_rows=24, setup=str(folder / "setup.yaml"))
    config = Simulation(
        glyphs=HandwritingGlyphs(characters="ABCEFHLT", writers=2),
        setup=setup,
        sampling=sampling,
        positions=8,
        validation=0.2,
        vary={"setup.gain": (0.66, 0.74), "setup.ambient": (0.05, 0.07)},
    )
    return simulate(config, folder / "simulation"), folder / "run"


def test_frames_solved_through_the_light_path_show_the_target(solved) -> None:
    dataset, out = solved
    plan = replace(PLAN, network=SOLVING)
    weights = load_weights(train(dataset, plan, out).folder)
    samples = NlosDataset(dataset, "validation", "frame")
    network = weights.network
    assert isinstance(network, SequenceReconstructor) and network.frames is not None
    name = samples.names[0]
    mine = torch.from_numpy(np.flatnonzero(samples.names == name))
    places = torch.from_numpy(samples.position_m[mine])
    plane = network.grid.mean(samples.truth[mine], places)
    inputs = samples.inputs[mine].float()
    pooled = network.pooled(inputs, places)
    mean = network.grid.of_target(network.frames.mean, 0.08)
    error, blind = ((image - plane).square().mean() for image in (pooled[0], mean))
    assert error < 0.5 * blind
    assert evaluate(weights, dataset, "train").scores.mean()["psnr_db"] > 12

    pattern = 0.005 * torch.randn(inputs.shape[-2:], generator=torch.Generator().manual_seed(0))

    def change(more: float | torch.Tensor) -> float:
        """Return what ambient light that was not foreseen, or a fixed pattern, changes."""
        light, brighter = (network.pooled(inputs + part, places)[0] for part in (0.0, more))
        return float((brighter - light).square().mean())

    known, of_pattern = change(0.01), change(pattern)
    slim = network.reduced(100).pooled(inputs, places)[1]  # by the strong prior, which needs few components
    assert (slim - pooled[1]).square().mean() < 0.02 * blind
    network.load_state_dict(network.state_dict() | {"frames.static": torch.zeros(len(network.frames.static))})
    assert known < 0.2 * change(0.01)
    assert of_pattern < 0.8 * change(pattern)  # in eight frames


def test_a_network_learns_from_drawn_sequences(solved, tmp_path, monkeypatch) -> None:
    """Behind a setup that says what to draw; what was interrupted goes on, and a fine-tuning mixes them in."""
    dataset, _ = solved
    plan = replace(PLAN, network=SOLVING, epochs=2, drawn=48)
    with pytest.raises(ConfigError, match=r"has no training\.yaml"):
        train(dataset, plan, tmp_path / "none")
    monkeypatch.setattr("evnlos.models.drawn.TRAIN_WRITERS", 3)
    monkeypatch.setattr("evnlos.models.drawn._POPULATIONS", 2)
    training = Simulation(glyphs=HandwritingGlyphs(characters="BCEFHLT", writers=2), setup=RadiometricSetup())
    folder = Path(dataset.sampling.setup).parent
    save_yaml(to_dict(training), folder / "training.yaml")
    try:
        steps = list[Step]()
        whole = train(dataset, plan, tmp_path / "whole", progress=steps.append, captures=dataset)
        targets = DRAWN.load(folder / "drawn.safetensors", "")
        assert targets.masks.shape == (42, 64, 64) and targets.about.size_m == 0.08  # 2 x 3 writers, 7 letters
        assert len(torch.unique(targets.masks.flatten(1), dim=0)) == 42
        assert [step.done for step in steps if step.unit == "targets"] == list(range(43))
        assert evaluate(whole.load(), dataset, "train").scores.mean()["psnr_db"] > 12

        def stop(step: Step) -> None:
            if step.done == 1 and step.unit == "epochs":
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            train(dataset, plan, tmp_path / "parts", progress=stop, captures=dataset)
        parts = train(dataset, plan, tmp_path / "parts", captures=dataset)
        assert parts.file.read_bytes() == whole.file.read_bytes()
        tuned = train(dataset, replace(plan, drawn=20, keep_normalization=True), tmp_path / "t", whole.folder)
        assert len(tuned.records) == 2 and tuned.file.read_bytes() != whole.file.read_bytes()
    finally:
        (folder / "training.yaml").unlink()
    with pytest.raises(ConfigError, match="drawn is 0"):
        train(dataset, replace(plan, drawn=0), tmp_path / "none", captures=dataset)
    other = replace(dataset, sampling=replace(dataset.sampling, pitch_m=0.004))
    with pytest.raises(ConfigError, match="another canvas"):
        train(dataset, plan, tmp_path / "none", captures=other)
    with pytest.raises(ConfigError, match="leave --drawn at 0"):
        train(dataset, replace(PLAN, network=UNetConfig(width=4, depth=1), drawn=8), tmp_path / "unet")
    with pytest.raises(ConfigError, match=r"Training\.drawn is -1"):
        replace(PLAN, drawn=-1)


def test_events_of_drawn_targets_show_them(solved, tmp_path) -> None:
    """With much information and no error: the targets by the prior's patterns, on the canvas's pixels."""
    dataset, _ = solved
    setup = load_setup(dataset.sampling.setup)
    save_yaml(to_dict(setup), tmp_path / "setup.yaml")
    prior, grid = event_prior(setup, 0.08), network().grid
    file, about = tmp_path / EVENT_ERRORS_FILE, AboutErrors(tuple("ABCDE"))
    for count in (120, prior.count):
        roots = 1e5 * torch.eye(count).repeat(5, 1, 1)
        known = {"errors": torch.zeros(5, count), "roots": roots, "light": torch.full((5,), 0.1)}
        EVENT_ERRORS.write(file, known, about)
        if count < prior.count:  # of an older calibration
            sampling = Sampling(surface="likelihood", setup=str(tmp_path))
            with pytest.raises(DataError, match=r"120 patterns .* 240; calibrate again, or leave --drawn at 0"):
                DrawnEvents(sampling, grid, torch.abs, torch.zeros(1, 2))
    target = FontGlyphs(characters="F").target("comic_neue_bold_F").rasterise(prior.target_plane)
    at = torch.stack([torch.linspace(-0.05, 0.05, 40), torch.linspace(0.0, 0.01, 40)], dim=1)
    by_patterns = np.clip(prior.image(prior.coefficients(target)), 0, 1)
    shown = Target("F", by_patterns.astype(np.float32), 0.08).rasterise(Plane(64, 96, PITCH_M), at)
    expected = grid.mean(torch.from_numpy(shown), at)
    plane = grid.of_target(torch.from_numpy(target)[None].float(), 0.08)
    for surface in ("likelihood", "corrected"):
        sampling = Sampling(surface=surface, setup=str(tmp_path))
        events = DrawnEvents(sampling, grid, lambda images: 2 * images, at)
        images = events(plane, torch.Generator().manual_seed(0))
        assert images.shape == (1, 2, 80, 80)
        for image in images[0] / 2:
            assert (image - expected).square().mean() < 0.02 * expected.var()
    with pytest.raises(DataError, match=r"has no events\.safetensors"):
        DrawnEvents(Sampling(setup=str(tmp_path / "none")), grid, torch.abs, at)


def test_a_bright_target_is_drawn_with_what_events_say_of_bright_ones(solved, tmp_path) -> None:
    """Here the events of four dim captures say all, those of four bright ones nothing."""
    dataset, _ = solved
    setup = load_setup(dataset.sampling.setup)
    save_yaml(to_dict(setup), tmp_path / "setup.yaml")
    prior, grid, at = event_prior(setup, 0.08), network().grid, torch.zeros(1, 2)
    roots = torch.tensor([1e5, 1e-4]).repeat_interleave(4)[:, None, None] * torch.eye(prior.count)
    light = torch.tensor([0.1, 0.9]).repeat_interleave(4)
    known = {"errors": torch.zeros(8, prior.count), "roots": roots, "light": light}
    EVENT_ERRORS.write(tmp_path / EVENT_ERRORS_FILE, known, AboutErrors(tuple("ABCDEFGH")))
    events = DrawnEvents(Sampling(surface="likelihood", setup=str(tmp_path)), grid, torch.clone, at)
    target = torch.from_numpy(
        FontGlyphs(characters="F").target("comic_neue_bold_F").rasterise(prior.target_plane)
    )
    planes = grid.of_target(torch.stack([target.float(), 1 - target.float()]), 0.08)
    dim, bright = events(planes, torch.Generator().manual_seed(0))
    unseen = torch.from_numpy(np.clip(prior.image(np.zeros(prior.count)), 0, 1)).float()
    blank = grid.of_target(unseen[None], 0.08)[0]
    assert (dim - planes[0]).square().mean() < 0.1 * planes[0].var()
    assert (bright - blank).square().mean() < 0.02 * blank.var() < (dim - blank).square().mean()


def test_frames_are_not_solved_without_a_setup(tiny_dataset, tmp_path) -> None:
    with pytest.raises(ConfigError, match="setup is empty"):
        train(tiny_dataset, replace(PLAN, network=SOLVING), tmp_path / "run")
    gone = replace(tiny_dataset, sampling=replace(tiny_dataset.sampling, setup="gone.yaml"))
    with pytest.raises(ConfigError, match="does not exist"):
        train(gone, replace(PLAN, network=SOLVING), tmp_path / "run")
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match="prior_weights is"):
        replace(SOLVING, prior_weights=(0.0,))


def test_captures_correct_the_light_path_that_frames_are_solved_through(solved, tmp_path) -> None:
    """A wall that is 5 % brighter here and moves its light there; what it explains of other captures grows."""
    dataset, _ = solved
    sampling, samples = dataset.sampling, NlosDataset(dataset, "train", "frame")
    setup, names = load_setup(sampling.setup), list(dict.fromkeys(samples.names.tolist()))
    truth, places = samples.truth.float(), torch.from_numpy(samples.position_m)
    operator = FrameOperator(setup, sampling)
    plain = operator(truth)
    wave = torch.sin(torch.arange(sampling.width) / 3.0)
    draw = torch.Generator().manual_seed(3)
    wrong = plain * (1 + 0.05 * wave) + 0.15 * wave * (plain.roll(-1, 2) - plain.roll(1, 2))
    seen = wrong + operator.sigma * torch.randn(wrong.shape, generator=draw)
    fitted = PooledFrames(sampling, (1.0,), 200)
    fitted.fit(setup, samples.inputs[:, 0].float(), truth, places, samples.names)
    known = torch.from_numpy(np.isin(samples.names, names[:8]))
    own = ~known

    def left() -> float:
        light = truth[own].flatten(1) @ fitted.light.flatten(1).T
        away = (
            (wrong[own] - fitted.ambient).flatten(1) @ fitted.basis
            - fitted.terms_along(places[own]) @ fitted.along
            - light
        )
        return float((away - away.mean(dim=0)).square().mean())

    before = left()
    fitted.correct(seen[known][:24], truth[known][:24], places[known][:24], samples.names[known.numpy()][:24])
    assert left() == before  # of three captures nothing is learned
    fitted.correct(seen[known], truth[known], places[known], samples.names[known.numpy()])
    assert left() < 0.5 * before


def test_a_killed_fine_tuning_corrects_the_light_path_once(solved, tmp_path) -> None:
    dataset, out = solved
    plan = replace(PLAN, network=SOLVING)
    before = load_weights(train(dataset, plan, out).folder).network
    tuned = replace(plan, epochs=3, keep_normalization=True)
    whole = load_weights(train(dataset, tuned, tmp_path / "fine", out).folder).network
    stopped(train, dataset, tuned, tmp_path / "again", out, after=2)
    again = load_weights(train(dataset, tuned, tmp_path / "again", out).folder).network
    assert not torch.equal(before.frames.light, whole.frames.light)
    one, other = whole.state_dict(), again.state_dict()
    assert [name for name in one if not torch.equal(one[name], other[name])] == []


def test_what_a_fine_tuning_learns_from_is_solved_through_what_other_captures_correct(solved) -> None:
    """Its own errors are undone nowhere but in the light path that new targets are solved through."""
    dataset, out = solved
    net = load_weights(train(dataset, replace(PLAN, network=SOLVING), out).folder).network
    samples, other = NlosDataset(dataset, "train", "frame"), deepcopy(net)
    net.fit(lambda count: pytest.fail("nothing is fitted again"), 0, is_new=False, keep_normalization=True)
    learned = net.training_samples(samples, 1, 0, is_new=False)
    name = np.unique(samples.names)[1]
    mine = torch.from_numpy(samples.names == name)
    rest = ~torch.from_numpy(np.isin(samples.names, np.unique(samples.names)[1::4]))
    places = torch.from_numpy(samples.position_m)
    other.frames.correct(
        samples.inputs[rest, 0], samples.truth[rest], places[rest], samples.names[rest.numpy()]
    )
    seen = samples.inputs[mine].float(), places[mine]
    expected = other.pooled(*seen)
    (row,) = np.flatnonzero(learned.names == name)
    torch.testing.assert_close(learned.inputs[row].float(), expected, rtol=2e-3, atol=2e-3)
    assert float((net.pooled(*seen) - expected).abs().max()) > 0.01
