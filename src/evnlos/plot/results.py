"""Figures of results, one for each command.

- The check image of a calibration: held-out captures beside the fit.
- Reconstructions of a hidden screen side by side; needs matplotlib.
- The check image of an imported scan; needs matplotlib.
- The path of a hidden object and its speed; needs matplotlib.
- Can the confidence be trusted? What is left when the least supported sequences go, and support against skill.
- A fitted event pixel: what was recorded beside what its model makes.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.calibration import SetupFit
from evnlos.files import write_atomically
from evnlos.plot.figures import new_figure, save_figure, signed_map
from evnlos.plot.setup import scale_bar
from evnlos.scene import Scene
from evnlos.setups.files import Measurement
from evnlos.tracking import Track
from evnlos.untrusted import open_image

if TYPE_CHECKING:
    from evnlos.analysis.confidence import ConfidenceCheck
    from evnlos.calibration.pixel_report import KnownLightFit


def draw_calibration(fit: SetupFit, path: str | Path) -> None:
    """Draw frame, model and residual of held-out captures, and the time surfaces where events were fitted.

    Args:
        fit: The calibration.
        path: PNG file to write.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    with_events = any(example.surface is not None for example in fit.example)
    signed = signed_map()
    columns, rows = (6 if with_events else 3), len(fit.example)
    figure = new_figure((2.6 * columns, 1.85 * rows + 0.4))
    axes = figure.subplots(rows, columns, squeeze=False)
    for line, example in zip(axes, fit.example, strict=True):
        top = max(float(example.frame.max()), float(example.model.max()))
        miss = example.frame - example.model
        pictures = [(example.frame, "frame", "gray", 0.0, top), (example.model, "model", "gray", 0.0, top)]
        pictures.append((miss, "frame - model, times 5", signed, -top / 5, top / 5))
        if example.surface is not None and example.model_surface is not None:
            seen, made = (s[0] - s[1] for s in (example.surface, example.model_surface))
            peak = float(np.abs(seen).max())
            pictures += [
                (seen, "events: ON - OFF", signed, -peak, peak),
                (made, "model", signed, -peak, peak),
                (seen - made, "difference", signed, -peak, peak),
            ]
        for axis in line:
            axis.set_axis_off()
        for axis, (picture, title, colours, low, high) in zip(line, pictures, strict=False):
            axis.imshow(picture, cmap=colours, vmin=low, vmax=high)
            axis.set_title(f"{example.name}: {title}" if title == "frame" else title, fontsize=8)
    figure.supxlabel("differences and events: light orange above 0, grey at 0, dark blue below", fontsize=8)
    # Noise hardly compresses: fewer colours keep the image small.
    drawn = BytesIO()
    figure.savefig(drawn, dpi=60, format="png")
    with open_image(drawn) as picture:
        packed = BytesIO()
        picture.convert("RGB").quantize(200).save(packed, "PNG", optimize=True)
    write_atomically(path, packed.getvalue())


def draw_pixel_fit(fit: KnownLightFit, path: str | Path) -> None:
    """Draw a fit's predictive checks (counts, intervals, all of them) and noise against light as a PNG file."""
    assert fit.predicted is not None
    figure = new_figure((11.0, 7.0))
    axes = figure.subplots(2, 2)
    for axis, (edges, seen, made), name in (
        (axes[0, 0], fit.predicted.counts, "events per pixel"),
        (axes[0, 1], fit.predicted.intervals, "log10 of the interval, s"),
    ):
        low, high = np.quantile(made, (0.05, 0.95), axis=0)
        axis.stairs(high, edges, baseline=low, fill=True, color="0.75", label="model, 5 to 95 %")
        axis.stairs(seen, edges, color="C1", label="recorded, held-out pixels")
        axis.set(xlabel=name, ylabel="share")
        axis.legend(frameon=False, fontsize=8)
    checks = fit.predicted.checks
    middles = [(c.recorded - 0.5 * (c.low + c.high)) / max(c.high - c.low, 1e-9) for c in checks]
    colours = ["k" if one.passed else "C3" for one in checks]
    axes[1, 0].scatter(np.clip(middles, -3, 3), range(len(checks)), c=colours, s=12)
    names = [f"{one.name}, {one.recording}"[:60] for one in checks]
    axes[1, 0].set_yticks(range(len(checks)), names, fontsize=max(3, min(7, 180 // max(len(checks), 1))))
    axes[1, 0].set(xlabel="recorded, in 90 % ranges of the model (red: p beyond 0.01)")
    for sign in ("on", "off"):
        middle, low, high = np.array([getattr(one, f"{sign}_hz") for one in fit.lights]).T
        lights = [one.light_dn for one in fit.lights]
        axes[1, 1].errorbar(lights, middle, [middle - low, high - middle], marker="o", ms=3, label=sign.upper())
    axes[1, 1].set(xscale="symlog", xlabel="light, DN", ylabel="events without cause, Hz per pixel")
    axes[1, 1].legend(frameon=False, fontsize=8)
    save_figure(figure, path, dpi=100)


def draw_inversion(
    path: str | Path,
    panels: Sequence[tuple[str, torch.Tensor]],
    side_m: float | None = None,
    verdict: str = "",
) -> Path:
    """Draw images [channels, h, w] in a row under their titles.

    Each is drawn from 0 to its own 99.5th percentile: how bright the screen was is not known.

    Args:
        path: The image, PNG or SVG.
        panels: Titles and images, one or three channels.
        side_m: Width of the images, metres, for a scale bar; None draws none.
        verdict: How far to believe them, below.

    Returns:
        The path.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure((3.1 * len(panels), 3.4 if verdict else 3.0))
    for axes, (title, image) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        axes.imshow(as_image(image), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
        if side_m is not None:
            _draw_scale(axes, image.shape[-2:], side_m)
    if verdict:
        figure.supxlabel(textwrap.fill(verdict, 42 * len(panels)), fontsize=9)
    return save_figure(figure, path, dpi=100)


def sequence_panels(
    rows: Sequence[dict[str, Any]], pictures: Mapping[str, torch.Tensor]
) -> tuple[list[tuple[str, torch.Tensor]], float | None]:
    """Return titles and images of inverted captures at most positions, each after its truth, and their width.

    The width is in metres, None where not all have one.

    Args:
        rows: Figures of each capture, solver and number of positions.
        pictures: Images by CAPTURE_SOLVER_POSITIONS, and of truths by "CAPTURE truth".
    """
    panels, most = list[tuple[str, torch.Tensor]](), max(row["positions"] for row in rows)
    last = {(row["capture"], row["solver"]): row for row in rows if row["positions"] == most}
    for name in dict.fromkeys(name for name, _ in last):
        if (truth := pictures.get(f"{name} truth")) is not None:
            panels.append((f"{name}, truth", truth[None]))
        for row in (row for (capture, _), row in last.items() if capture == name):
            known = "" if row["psnr_db"] is None else f", {row['psnr_db']:.1f} dB"
            image = pictures[f"{name}_{row['solver']}_{most}"]
            panels.append((f"{name}, {row['solver']}{known}", image.view(-1, *image.shape[-2:])))
    return panels, _common_width_m(rows)


def estimate_panels(
    rows: Sequence[dict[str, Any]], pictures: Mapping[str, torch.Tensor]
) -> tuple[list[tuple[str, torch.Tensor]], float | None]:
    """Return titles and images of estimated captures, each after its truth, and their width as above.

    Args:
        rows: Figures of each capture.
        pictures: By "CAPTURE" the image, followed by its deviation, truth, samples, [c, h, w] or [h, w] each.
    """
    panels = list[tuple[str, torch.Tensor]]()
    for row in rows:
        name, known = row["capture"], row["psnr_db"]
        found = "" if known is None else f", {known:.1f} dB of {row['expected_db']:.1f} expected"
        samples = [key for key in pictures if key.startswith(f"{name} sample ")]
        for key in (f"{name} truth", name, f"{name} deviation", *samples):
            if (image := pictures.get(key)) is not None:
                panels.append((f"{key}{found if key == name else ''}", image.view(-1, *image.shape[-2:])))
    return panels, _common_width_m(rows)


def _common_width_m(rows: Sequence[dict[str, Any]]) -> float | None:
    sides = {row["side_m"] for row in rows}
    return sides.pop() if len(sides) == 1 else None


def _draw_scale(axes: Any, shape: Sequence[int], side_m: float) -> None:
    """Draw a bar of at most a third of the width below an image, and its length."""
    length, words = scale_bar(side_m / 3)
    (height, width), foot = shape, 1.04 * shape[0] - 0.5
    stop = length / side_m * width - 0.5
    axes.plot([-0.5, stop], [foot, foot], color="0.2", lw=2, clip_on=False)
    axes.text(stop + 0.5, foot, f" {words}", va="center", fontsize=8)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(1.08 * height - 0.5, -0.5))


def as_image(image: torch.Tensor) -> NDArray[np.float64]:
    """Return an image [channels, h, w] as [h, w] or [h, w, 3] in 0..1, 1 its 99.5th percentile."""
    picture = image.detach().double().clamp(min=0).numpy()
    picture = np.clip(picture / max(float(np.quantile(picture, 0.995)), 1e-12), 0, 1)
    return picture[0] if len(picture) == 1 else np.moveaxis(picture[:3], 0, -1)


def draw_scan(path: str | Path, measurement: Measurement, raw: torch.Tensor | None = None) -> Path:
    """Draw four columns of the matrix, the light of all cells, the noise, and the singular values.

    Args:
        path: The image, PNG or SVG.
        measurement: What was measured.
        raw: The matrix before denoising, [H W, n], for its singular values beside the others.

    Returns:
        The path.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    shape, plane = measurement.shape, measurement.about.plane
    figure = new_figure((13.0, 6.0))
    axes = figure.subplots(2, 4)
    rows, columns = (sorted({n // 4, n // 2}) for n in plane.shape)
    cells = [(r, c) for r in rows for c in columns][:4]
    for place, (row, column) in zip(axes[0], cells, strict=False):
        light = measurement.matrix[:, row * plane.width + column].reshape(shape)
        _picture(figure, place, light, f"cell ({row}, {column}), white levels")
    for place in axes[0][len(cells) :]:
        place.set_axis_off()
    _picture(figure, axes[1][0], measurement.matrix.sum(dim=1).reshape(shape), "all cells lit")
    noise = torch.where(measurement.bad, torch.nan, measurement.noise)
    _picture(figure, axes[1][1], noise, f"noise of an entry; {int(measurement.bad.sum())} pixels unusable")
    _picture(figure, axes[1][2], measurement.dark, "dark frame, white levels")
    last = axes[1][3]
    if raw is not None and raw.shape[1] == measurement.matrix.shape[1]:
        last.semilogy(_spectrum(raw), label="plain mean of the repeats", color="tab:gray")
    last.semilogy(_spectrum(measurement.matrix), label="as written", color="tab:blue")
    sigma = torch.where(measurement.bad, 0.0, measurement.noise).double()
    edge = float(sigma.max()) * (plane.height * plane.width) ** 0.5 + float(sigma.square().sum().sqrt())
    last.axhline(edge, color="tab:red", linestyle=":", label="largest of noise alone, at most")
    last.set_title("singular values", fontsize=9)
    last.set_ylim(bottom=max(last.get_ylim()[0], 1e-6))
    last.legend(fontsize=7)
    return save_figure(figure, path, dpi=90)


def _picture(figure: Any, axes: Any, image: torch.Tensor, title: str) -> None:
    shown = axes.imshow(np.asarray(image), cmap="gray", interpolation="nearest")
    figure.colorbar(shown, ax=axes, shrink=0.7)
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()


def _spectrum(matrix: torch.Tensor) -> np.ndarray:
    work = matrix.double()
    gram = work.mT @ work if work.shape[1] <= work.shape[0] else work @ work.mT
    return torch.linalg.eigvalsh(gram).flip(0).clamp(min=0).sqrt().numpy()


_TRUE: dict[str, Any] = {"linestyle": "--", "color": "k", "linewidth": 1}


def draw_track(track: Track, path: str | Path, scene: Scene | None = None, title: str = "") -> Path:
    """Draw path, coordinates, speed, and distance, turn or size over time, with bands of two deviations.

    Args:
        track: The track.
        path: The image, PNG or SVG.
        scene: The truth, where it is known; of a track in metres.
        title: Heading of the figure.

    Returns:
        The path.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    scale, unit = (100.0, "cm") if track.unit == "m" else (1.0, "px")
    curves: list[tuple[Any, Any, Any, Any, str, str]] = []
    if (away := track.distance) is not None:
        true = None if scene is None else scale * away.true_m(scene)
        seen = scale * away.distance_m, scale * away.distance_sigma
        curves.append((away.time_s, *seen, true, f"distance, {unit}", "distance from the wall"))
    if (turn := track.turn) is not None:
        true = None if scene is None else turn.true_deg(scene)
        seen = turn.rotation_deg, turn.rotation_sigma
        curves.append((turn.time_s, *seen, true, "degrees", "turn about its mean"))
    if not curves and np.isfinite(track.size).any():
        curves.append((track.frame_time_s, track.size, track.size_sigma, None, "over its mean", "image size"))
    figure = new_figure((16.5 if len(curves) > 1 else 11.0, 6.4))
    plane, along, speed, *rest = figure.subplots(2, 2 + len(curves) // 2).flat
    figure.suptitle(title)
    by = "events" if track.events else "frames"
    plane.plot(*(scale * track.frame_position.T), ".", color="0.6", label=by)
    plane.plot(*(scale * track.position.T), color="C0", label="track")
    for axis, (middle, sigma) in enumerate(zip(track.position.T, track.position_sigma.T, strict=True)):
        _band(along, track.time_s, scale * middle, scale * sigma, f"C{axis}", "xy"[axis])
    top = _band(speed, track.time_s, scale * track.speed, scale * track.speed_sigma, "C2")
    if scene is not None:
        truth = scale * scene.light_m(track.time_s)
        fast = np.linalg.norm(np.gradient(truth, track.time_s, axis=0), axis=1)
        top = max(top, float(fast.max()))
        plane.plot(*truth.T, **_TRUE, label="truth")
        along.plot(track.time_s, truth, **_TRUE)
        speed.plot(track.time_s, fast, **_TRUE)
    plane.set(xlabel=f"x, {unit}", ylabel=f"y, {unit} (downwards)", title="path", aspect="equal")
    plane.set(adjustable="datalim")
    plane.invert_yaxis()
    plane.legend()
    along.set(xlabel="time, s", ylabel=f"position, {unit}", title="position")
    along.legend()
    # A tenth more than the largest, so that no line lies on the frame; set last, as what is drawn later is cut.
    speed.set(xlabel="time, s", ylabel=f"speed, {unit}/s", title="speed", ylim=(0, 1.1 * top or None))
    for axes, (time_s, middle, sigma, true, name, heading) in zip(rest, curves, strict=False):
        _band(axes, time_s, middle, sigma, "C3")
        if true is not None:
            axes.plot(time_s, true, **_TRUE)
        axes.set(xlabel="time, s", ylabel=name, title=heading)
    for axes in rest[len(curves) :]:
        axes.set_axis_off()
    return save_figure(figure, path, dpi=80)


def _band(axes: Any, time_s: Any, middle: Any, sigma: Any, color: str, label: str | None = None) -> float:
    """Draw a course with a band of two deviations, and return its upper end."""
    axes.plot(time_s, middle, color=color, label=label)
    axes.fill_between(time_s, middle - 2 * sigma, top := middle + 2 * sigma, color=color, alpha=0.3)
    return float(top.max())


_LEAST_SKILL = -1.2  # worse sequences are drawn on this line


def draw_confidence(found: Mapping[str, Sequence[ConfidenceCheck]], path: str | Path) -> Path:
    """Draw the risk-coverage curves of all sequences, and each sequence's skill over its support.

    Args:
        found: The sequences by the name of their set.
        path: The image, PNG or SVG.

    Returns:
        The path.

    Raises:
        MissingDependencyError: Matplotlib is not installed.
    """
    from evnlos.analysis.confidence import risk_coverage

    figure = new_figure((10.5, 4.4))
    curves, cloud = figure.subplots(1, 2)
    sequences = [one for those in found.values() for one in those]
    skill, support = (np.array([getattr(one, key) for one in sequences]) for key in ("skill", "support"))
    for order, name, line in (
        (support, "the most supported first", "-"),
        (skill, "the best first (not known to a user)", "--"),
    ):
        kept, risk = risk_coverage(order, 1 - skill)
        curves.plot(100 * kept, risk, line, label=name, lw=1.6)
    curves.axhline(float(np.mean(1 - skill)), color="0.5", lw=1.0, ls=":", label="all sequences")
    curves.set(xlabel="sequences kept, %", ylabel="mean risk of what is kept (1 - skill)", ylim=(0, None))
    curves.legend(frameon=False, fontsize=8)
    marks = "osD^v<>PX*ph"
    for number, (name, those) in enumerate(found.items()):
        cloud.plot(
            [one.support for one in those],
            [max(one.skill, _LEAST_SKILL) for one in those],
            marks[number % len(marks)],
            ms=5,
            alpha=0.75,
            label=name,
            color=f"C{number % 10}",
        )
    cloud.axline((0, 0), (1, 1), color="0.5", lw=1.0, ls=":")
    cloud.set(xlabel="support: what was said", ylabel=f"skill: what was true ({_LEAST_SKILL} or less below)")
    cloud.set(xlim=(-0.03, 1.03), ylim=(_LEAST_SKILL - 0.1, 1.05))
    cloud.legend(frameon=False, fontsize=7, loc="lower right")
    return save_figure(figure, path, dpi=100)
