"""Learning: a tiny run must see, a killed run must go on bit for bit, a collapse must be noticed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from evnlos import EvnlosError, evaluate, train
from evnlos.config import to_dict
from evnlos.data import NlosDataset
from evnlos.errors import ConfigError, DataError
from evnlos.models import ResidualUNet, SequenceConfig, UNetConfig, load_weights, save_weights
from evnlos.training import LOSSES, Training, check_run, learning_rate_at, normalized_bce_mse_ssim, paper_loss
from evnlos.training.source import half_mirrored, with_mirrored
from evnlos.training.train import validate

SMALL = UNetConfig(width=8, depth=2, shuffle=1, rank=0)
QUICK = Training(
    epochs=2, network=replace(SMALL, rank=8), precision="float32", batch_size=16, learning_rate=1e-3
)


def run(dataset, settings, out, weights=None) -> list[dict]:
    return train(dataset, settings, out, weights).records


@pytest.fixture(scope="module")
def trained(tiny_dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "frame"
    log = run(tiny_dataset, replace(QUICK, epochs=14, learning_rate=3e-3), out)
    return out, log


@pytest.mark.parametrize(("height", "width"), [(64, 96), (37, 51), (16, 16), (1, 3)])
def test_the_network_takes_any_size(height: int, width: int) -> None:
    net = ResidualUNet(3, UNetConfig(width=8, depth=3, rank=0))
    out = net(torch.zeros(2, 3, height, width))
    assert out.shape == (2, 1, height, width)
    assert out.min() >= 0 and out.max() <= 1


def test_the_network_refuses_the_wrong_number_of_channels() -> None:
    with pytest.raises(EvnlosError, match=r"\[B, 3, H, W\]"):
        ResidualUNet(3, SMALL)(torch.zeros(1, 1, 16, 16))


def test_every_parameter_is_trained() -> None:
    net = ResidualUNet(1, SMALL)
    for _ in range(2):  # the second convolution of each block starts at zero and hides the first one's gradient
        net.zero_grad()
        net(torch.randn(2, 1, 16, 16)).square().mean().backward()
        with torch.no_grad():
            for p in net.parameters():
                p.add_(p.grad if p.grad is not None else 0)
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in net.parameters())


@pytest.mark.parametrize("name", LOSSES)
def test_losses_are_least_at_the_truth_and_finite(name: str) -> None:
    truth = torch.zeros(3, 1, 32, 32)
    truth[:, :, 8:20, 10:14] = 1
    at_truth = LOSSES[name](truth, truth)
    for other in (torch.zeros_like(truth), torch.rand(truth.shape), 1 - truth):
        image = other.clone().requires_grad_()
        loss = LOSSES[name](image, truth)
        loss.backward()
        assert loss > at_truth + 0.1
        assert torch.isfinite(image.grad).all()


def test_black_costs_almost_nothing_under_the_papers_loss_only() -> None:
    truth = torch.zeros(4, 1, 48, 96)
    truth[:, :, 20:30, 40:42] = 1
    black = torch.zeros_like(truth)
    worst = {
        "paper": paper_loss(1 - truth, truth),
        "normalized_bce_mse_ssim": normalized_bce_mse_ssim(1 - truth, truth),
    }
    assert (paper_loss(black, truth) - 2) / (worst["paper"] - 2) < 0.02
    assert normalized_bce_mse_ssim(black, truth) > 5 * normalized_bce_mse_ssim(
        torch.full_like(truth, float(truth.mean())), truth
    )


def test_a_tiny_run_beats_the_mean_image(trained, tiny_dataset) -> None:
    out, log = trained
    found = evaluate(load_weights(out), tiny_dataset, "validation").summary()
    assert found["overall"]["psnr_db"] > found["baselines"]["mean"]["overall"]["psnr_db"] + 1.0
    assert found["overall"]["psnr_db"] > found["baselines"]["zero"]["overall"]["psnr_db"] + 1.0
    assert log[-1]["psnr_db"] == pytest.approx(found["overall"]["psnr_db"], abs=0.1)
    assert log[-1]["loss"] < 0.7 * log[0]["loss"]
    assert not log[-1]["collapsed"]
    assert set(found["characters"]) == set(tiny_dataset.objects("validation"))


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(tiny_dataset, tmp_path) -> None:
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        run(tiny_dataset, replace(QUICK, seed=seed), tmp_path / name)
    a, b, c = ((tmp_path / n / "weights.safetensors").read_bytes() for n in "abc")
    assert a == b
    assert a != c


def test_a_run_that_has_ended_is_not_trained_again(trained, tiny_dataset) -> None:
    out, log = trained
    before = (out / "weights.safetensors").stat().st_mtime_ns
    assert run(tiny_dataset, replace(QUICK, epochs=14, learning_rate=3e-3), out) == log
    assert (out / "weights.safetensors").stat().st_mtime_ns == before
    with pytest.raises(DataError, match=r"settings\.epochs: 14 -> 2"):
        run(tiny_dataset, replace(QUICK, learning_rate=3e-3), out)


def test_fine_tuning_starts_from_the_weights_and_keeps_frozen_parts(trained, tiny_dataset, tmp_path) -> None:
    out, _ = trained
    settings = replace(QUICK, freeze=("encoder", "latent"), learning_rate=1e-3, modality="event")
    run(tiny_dataset, settings, tmp_path / "fine", out)
    old, new = load_weights(out), load_weights(tmp_path / "fine")
    assert new.modality.name == "frame"  # that of the weights
    assert [step["data"]["origin"] for step in new.history] == ["simulation", "simulation"]
    for name, value in old.network.state_dict().items():
        frozen = not name.startswith(("unet.up.", "unet.decoder.", "unet.head."))
        assert torch.equal(value, new.network.state_dict()[name]) == frozen, name


def test_step_sizes() -> None:
    step = Training(epochs=200, learning_rate=1e-4, schedule="step", step_epoch=100)
    assert [learning_rate_at(step, e) for e in (0, 99.9, 100, 199)] == [1e-4, 1e-4, 5e-5, 5e-5]
    cosine = Training(epochs=10, learning_rate=1.0)
    np.testing.assert_allclose([learning_rate_at(cosine, e) for e in (0, 5, 10)], [1, 0.5, 0], atol=1e-12)


def test_a_collapsed_network_is_recognised(trained, tiny_dataset, tmp_path) -> None:
    assert not trained[1][-1]["collapsed"]
    log = run(tiny_dataset, replace(QUICK, epochs=1, loss="paper", learning_rate=1e-9), tmp_path / "stuck")
    assert log[-1]["collapsed"] and log[-1]["psnr_db"] < log[-1]["zero_db"] + 0.1
    net = SMALL.build("frame", tiny_dataset.sampling)
    for p in net.parameters():
        torch.nn.init.zeros_(p)
    held_out = NlosDataset(tiny_dataset, "validation", "frame")
    assert validate(net, held_out, tiny_dataset, torch.device("cpu"), False)["collapsed"]


@pytest.mark.parametrize("damage", ["cut", "text", "other", "missing", "huge"])
def test_strange_weights_are_refused(damage: str, trained, tmp_path) -> None:
    path = tmp_path / "w.safetensors"
    good = (trained[0] / "weights.safetensors").read_bytes()
    if damage == "cut":
        path.write_bytes(good[: len(good) // 2])
    elif damage == "text":
        path.write_text("no weights")
    elif damage == "other":
        from safetensors.torch import save_file

        save_file({"a": torch.zeros(2)}, path)
    elif damage == "huge":
        path.write_bytes(good.replace(b'\\"width\\": 8', b'\\"width\\": 80000', 1))
    with pytest.raises(EvnlosError) as caught:
        load_weights(path)
    assert "\n" not in str(caught.value)


def test_weights_round_trip(trained, tmp_path) -> None:
    weights = load_weights(trained[0])
    save_weights(tmp_path / "w.safetensors", weights)
    assert (tmp_path / "w.safetensors").read_bytes() == (trained[0] / "weights.safetensors").read_bytes()


@pytest.mark.parametrize("part", ["encoder", "latent", "decoder"])
def test_any_part_can_be_frozen(part: str, tiny_dataset, trained, tmp_path) -> None:
    log = run(tiny_dataset, replace(QUICK, epochs=1, freeze=(part,)), tmp_path / part, trained[0])
    assert np.isfinite(log[-1]["loss"])


def test_half_of_a_mirrored_batch_is_upside_down_with_its_images() -> None:
    draw = torch.Generator().manual_seed(0)
    seen, truth = torch.rand(400, 2, 6, 5, generator=draw), torch.rand(400, 1, 6, 5, generator=draw)
    inputs, pictures = half_mirrored(seen, truth, seed=3)
    turned = (inputs == seen.flip(-2)).flatten(1).all(dim=1)
    assert ((inputs == seen).flatten(1).all(dim=1) ^ turned).all()
    assert torch.equal(turned, (pictures == truth.flip(-2)).flatten(1).all(dim=1))
    assert 150 < int(turned.sum()) < 250
    assert torch.equal(half_mirrored(seen, truth, seed=3)[0], inputs)
    assert not torch.equal(half_mirrored(seen, truth, seed=4)[0], inputs)


def test_mirrored_samples_come_in_pairs_and_no_more_than_asked_for() -> None:
    def subset(count: int):
        draw = torch.Generator().manual_seed(count)
        return torch.rand(count, 2, 4, 3, generator=draw), torch.rand(count, 4, 3), np.full(count, "a")

    inputs, pictures, names = with_mirrored(subset)(10)
    assert len(inputs) == len(pictures) == len(names) == 10
    assert torch.equal(inputs[:5].flip(-2), inputs[5:]) and torch.equal(pictures[:5].flip(-2), pictures[5:])


def test_mirrored_training_is_another_one_that_repeats(tiny_dataset, tmp_path) -> None:
    mirrored = replace(QUICK, mirror=True)
    for name, settings in (("a", mirrored), ("b", mirrored), ("plain", QUICK)):
        run(tiny_dataset, settings, tmp_path / name)
    same, again, plain = ((tmp_path / n / "weights.safetensors").read_bytes() for n in ("a", "b", "plain"))
    assert same == again != plain


def test_sequences_are_not_mirrored(tiny_dataset, tmp_path) -> None:
    with pytest.raises(ConfigError, match="whole sequences, which are not mirrored"):
        run(tiny_dataset, replace(QUICK, mirror=True, network=SequenceConfig()), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_run_that_an_older_version_began_is_taken_up(tmp_path) -> None:
    settings = Training(modality="frame", network=SequenceConfig(ridge_multipliers=(0.5, 2.0)), epochs=3)
    (tmp_path / "run.yaml").write_text(
        "settings:\n  paradigm: frame\n  network: {kind: sequence, strengths: [0.5, 2.0]}\n  epochs: 3\n"
        "data: {name: near}\n"
    )
    check_run(tmp_path, {"settings": to_dict(settings), "data": {"name": "near"}})
    with pytest.raises(DataError, match=r"settings.epochs: 3 -> 4"):
        check_run(tmp_path, {"settings": to_dict(replace(settings, epochs=4)), "data": {"name": "near"}})


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("kind", [UNetConfig, SequenceConfig])
def test_a_training_on_cuda_ends_where_that_of_the_cpu_does(kind, tiny_dataset, tmp_path, monkeypatch) -> None:
    settings = replace(QUICK, network=kind(width=8, depth=2, shuffle=1, rank=8), batch_size=4)
    there = run(tiny_dataset, settings, tmp_path / "there")
    with monkeypatch.context() as patched:
        patched.setattr(torch.cuda, "is_available", lambda: False)
        here = run(tiny_dataset, settings, tmp_path / "here")
    assert there[-1]["loss"] == pytest.approx(here[-1]["loss"], rel=1e-2)
    assert next(load_weights(tmp_path / "there").network.parameters()).device.type == "cpu"
