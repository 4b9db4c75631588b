"""Scores: boxes, baselines, LPIPS from files, tables and curves."""

import dataclasses
import hashlib
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from evnlos import EvnlosError
from evnlos.analysis import Evaluation, load_lpips, reconstruct, score
from evnlos.data import STANDARD_MODALITIES, Sampling
from evnlos.errors import DataError
from evnlos.live import StreamingReconstructor
from evnlos.models import UNetConfig, Weights
from evnlos.report import RunResult
from evnlos.report.pictures import curves_svg
from evnlos.report.sections import gains_of, losses_of, summary_section
from evnlos.report.tables import best_two, method_of

CONVOLUTIONS = [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]  # places in torchvision's vgg16.features
SIDES = [(3, 64), (64, 64), (64, 128), (128, 128), (128, 256), (256, 256), (256, 256)]
SIDES += [(256, 512), (512, 512), (512, 512), (512, 512), (512, 512), (512, 512)]


def test_the_box_holds_the_target_and_two_pixels_more() -> None:
    truth = torch.zeros(1, 20, 30)
    truth[0, 8:10, 12:15] = 1
    image = truth.clone()
    image[0, 6, 10] = 0.5  # inside the box by its margin
    image[0, 5, 10] = 0.5  # outside
    found = score(image, truth)
    assert found.psnr_box_db[0] == pytest.approx(10 * np.log10(6 * 7 / 0.25), abs=1e-4)
    assert found.psnr_db[0] == pytest.approx(10 * np.log10(600 / 0.5), abs=1e-4)
    empty = score(torch.full((1, 20, 30), 0.1), torch.zeros(1, 20, 30))
    assert empty.psnr_box_db[0] == pytest.approx(20.0, abs=1e-4)


def test_means_are_over_images_not_over_errors() -> None:
    truth = torch.zeros(2, 16, 16)
    image = torch.stack([torch.full((16, 16), 0.1), torch.full((16, 16), 0.01)])
    found = score(image, truth)
    assert found.mean()["psnr_db"] == pytest.approx(30.0, abs=1e-3)
    assert found.mean(np.array([True, False]))["psnr_db"] == pytest.approx(20.0, abs=1e-3)
    assert found.mean()["lpips"] is None


@pytest.fixture
def files(tmp_path):
    """A seeded random trunk and heads, in the layout of the published files."""
    generator = torch.Generator().manual_seed(0)
    trunk = {}
    for place, (inside, outside) in zip(CONVOLUTIONS, SIDES, strict=True):
        weight = torch.randn(outside, inside, 3, 3, generator=generator) * (2 / (9 * inside)) ** 0.5
        trunk[f"features.{place}.weight"] = weight
        trunk[f"features.{place}.bias"] = torch.randn(outside, generator=generator) * 0.01
    trunk["classifier.0.weight"] = torch.zeros(2, 2)
    widths = (64, 128, 256, 512, 512)
    heads = {
        f"lin{i}.model.1.weight": torch.rand(1, c, 1, 1, generator=generator) for i, c in enumerate(widths)
    }
    torch.save(trunk, tmp_path / "vgg16.pth")
    torch.save(heads, tmp_path / "vgg.pth")
    return tmp_path / "vgg16.pth", tmp_path / "vgg.pth", trunk, heads


def slow_lpips(a: torch.Tensor, b: torch.Tensor, trunk: dict, heads: dict) -> float:
    """LPIPS of one grey pair, spelled out layer by layer as in torchvision's list of features."""
    total = 0.0
    xs = []
    for image in (a, b):
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        xs.append(((2 * image - 1).expand(3, -1, -1) - shift[:, None, None]) / scale[:, None, None])
    layer = 0
    for place in range(30):
        if place in (4, 9, 16, 23):
            xs = [F.max_pool2d(x[None], 2)[0] for x in xs]
        elif place in CONVOLUTIONS:
            weight, bias = trunk[f"features.{place}.weight"], trunk[f"features.{place}.bias"]
            xs = [F.conv2d(x[None], weight, bias, padding=1)[0].clamp_min(0) for x in xs]
            if place in (2, 7, 14, 21, 28):
                u, v = (x / (x.square().sum(0, keepdim=True).sqrt() + 1e-10) for x in xs)
                total += float(((u - v).square() * heads[f"lin{layer}.model.1.weight"][0]).sum(0).mean())
                layer += 1
    return total


def test_lpips_has_the_published_arithmetic(files, monkeypatch) -> None:
    trunk_path, heads_path, trunk, heads = files
    with monkeypatch.context() as patch:  # as where the trunk is the published one
        patch.setattr(hashlib, "sha256", lambda _: SimpleNamespace(hexdigest=lambda: "397923af"))
        metric = load_lpips(trunk_path, heads_path)
    a, b = torch.rand(2, 3, 1, 48, 96, generator=torch.Generator().manual_seed(1))
    expected = [slow_lpips(a[i], b[i], trunk, heads) for i in range(3)]
    np.testing.assert_allclose(metric(a, b).numpy(), expected, rtol=1e-4)
    np.testing.assert_allclose(metric(a, a).numpy(), 0.0, atol=1e-7)
    assert score(a[:, 0], b[:, 0], metric).mean()["lpips"] == pytest.approx(np.mean(expected), rel=1e-3)


def test_an_untrained_trunk_is_refused(files) -> None:
    with pytest.raises(EvnlosError, match="SHA-256"):
        load_lpips(*files[:2])
    with pytest.raises(EvnlosError, match="not available"):
        load_lpips(files[0].with_name("missing.pth"), files[1])


def test_methods_follow_from_the_history() -> None:
    sim, recorded = {"data": {"origin": "simulation"}}, {"data": {"origin": "captures"}}
    assert [method_of(h) for h in ([sim], [recorded], [sim, recorded])] == ["simulation only", "E2E", "EPNP"]


def test_best_two_skips_the_baselines() -> None:
    assert best_two([30.0, 1.0, 3.0, None, 2.0], 1) == (2, 4)
    assert best_two([1.0], 1) == (None, None)


def test_curves_hold_every_point_and_name() -> None:
    svg = curves_svg({"a<b": [(1, 2.0), (2, 1.0)], "none": []}, "epoch", "loss")
    assert svg.count("<polyline") == 1
    assert "a&lt;b" in svg
    assert curves_svg({}, "x", "y") == ""


def test_a_reconstructor_gives_the_same_images_one_at_a_time() -> None:
    draw = np.random.default_rng(0)
    sampling = Sampling(height=22, width=34, scored_rows=16)
    frame, surface = draw.random((3, 22, 34), np.float32), draw.random((3, 2, 22, 34), np.float32)
    for modality in STANDARD_MODALITIES:
        network = UNetConfig(width=8, depth=2, rank=0).build(modality, sampling).eval()
        for parameter in network.parameters():
            torch.nn.init.normal_(parameter, std=0.1)
        weights = Weights(network)
        expected = reconstruct(weights, frame, surface)
        see = StreamingReconstructor(weights)
        for k in range(3):
            torch.testing.assert_close(see(frame[k], surface[k]), expected[k], atol=1e-5, rtol=1e-4)
    with pytest.raises(DataError, match="do not fit"):
        see(frame[0, :20], surface[0])


def test_a_report_leads_with_what_is_gained() -> None:
    draw = torch.Generator().manual_seed(0)
    truth = (torch.rand(6, 24, 24, generator=draw) > 0.8).float()
    names = np.array(["near_G"] * 3 + ["near_K"] * 3)
    results, errors = [], {}
    for method, noise in (("E2E", 0.4), ("EPNP", 0.2)):
        for seed in range(2):
            image = (truth + noise * torch.randn(truth.shape, generator=draw)).clamp(0, 1)
            found = score(image, truth)
            errors.setdefault(method, []).append(found.psnr_db)
            blank = {"zero": score(torch.zeros_like(truth), truth)}
            one = Evaluation(image, truth, names, found, blank)
            results.append(RunResult(f"{method}-{seed}", "frame", False, method, one, [], []))
    gain = gains_of(results)["frame"]
    assert gain.mean == pytest.approx(np.mean(errors["EPNP"]) - np.mean(errors["E2E"]))
    assert list(gains_of(results)) == ["frame"] and gains_of(results[:2]) == {}
    page = summary_section(results)
    assert f"frame {gain} dB" in page and f">{np.mean(errors['EPNP']):.2f}</text>" in page
    assert "Fine-tuning harmed" not in page
    # What fine-tuning lost against simulation alone is said beside the gain.
    better = dataclasses.replace(results[-1], name="sim", method="simulation only")
    worse = [dataclasses.replace(one, method="EPNP") for one in results[:2]]
    before, after = float(errors["EPNP"][1].mean()), float(np.mean(errors["E2E"]))
    assert losses_of([better, *worse]) == [
        f"Fine-tuning harmed frame: {before:.2f} dB with simulation only, {after:.2f} dB after it. "
        "Use the weights from before, or fewer epochs."
    ]
    assert "Fine-tuning harmed frame" in summary_section([better, *worse, *results[:2]])
    assert "all-black" in page and page.count("<rect") == 2
