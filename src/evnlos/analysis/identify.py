"""Identifiability and resolution of a setup: what any method can reconstruct from it, in numbers and in words.

- What a setup can show: singular values, patterns above the noise, finest stroke, best linear image, in words.
- Setups side by side, as a table in Markdown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import torch

from evnlos.analysis.linearized import (
    AnalysisSettings,
    AskedSize,
    LinearEstimator,
    LinearizedSetup,
    artifact_note,
    finest_bars,
    linearized,
    scan_notes,
    verdict,
)
from evnlos.errors import MissingDependencyError
from evnlos.machine import note
from evnlos.setups import Setup
from evnlos.types import aligned, derive_seed

if TYPE_CHECKING:
    from evnlos.inverse.prior import TargetPrior
    from evnlos.models import ConfidenceReport

MODE_LEVEL = 1e-2
"""Singular values above this share of the largest count as usable modes."""
KINK_LEVEL = 1e-4
"""Level at which the kink of a cut tPSF is distinguished from what the wall shows."""


@dataclass(frozen=True, eq=False)
class NoiseLevelResult:
    """What is left of a setup at one noise; figures are expectations over the noise of one image of the wall.

    Args:
        noise: Root mean square noise of a pixel, white levels.
        patterns: Patterns in which handwritten targets differ by more than the noise.
        psnr_db: Mean over unseen targets of the PSNR of the best linear image, on the target plane.
        stroke_m: Width of the finest bars that are resolved, upright and lying, metres; None where none are.
        spectrum: Singular values of the matrix in units of the noise, float64 [n], descending.
        picard: Coefficient of the typical target's image on each mode, in units of the noise, float64 [n].
        modes: The first modes as targets, float64 [8, h, w], unit norm.
        picture: The best linear image of the typical target with one draw of the noise, float64 [h, w].
    """

    noise: float
    patterns: int
    psnr_db: float
    stroke_m: tuple[float | None, float | None]
    spectrum: torch.Tensor
    picard: torch.Tensor
    modes: torch.Tensor
    picture: torch.Tensor

    @property
    def finest_m(self) -> float | None:
        """Width of the finest bars that are resolved in both directions, metres."""
        upright, lying = self.stroke_m
        return None if upright is None or lying is None else max(upright, lying)


@dataclass(frozen=True, eq=False)
class Identification:
    """The result of an identifiability analysis.

    Args:
        name: Name of the setup.
        setup: Its settings.
        settings: How the question was put.
        singular: Singular values over the largest, float64 [n], descending.
        modes: How many of them lie above 1e-2.
        zero_db: Mean PSNR of the all-black image, on the target plane.
        mean_db: Mean PSNR of the mean training target, on the target plane.
        stroke_m: Typical stroke of the targets, metres.
        truth: The typical target, float64 [h, w].
        at_camera: At the frame camera's own noise.
        at_noise_std: At the fixed noise of the settings.
        verdict: The same in words.
        warnings: What makes the figures look better than they are.
        source: Who says how large the target is, in words.
    """

    name: str
    setup: Setup
    settings: AnalysisSettings
    singular: torch.Tensor
    modes: int
    zero_db: float
    mean_db: float
    stroke_m: float
    truth: torch.Tensor
    at_camera: NoiseLevelResult
    at_noise_std: NoiseLevelResult
    verdict: str
    warnings: tuple[str, ...] = ()
    source: str = "as asked"

    @property
    def size(self) -> AskedSize:
        """How large the target is, and who says so."""
        return AskedSize(self.settings.target_plane.extent_m[0], self.source)

    @property
    def wall(self) -> str:
        """What the wall allows, in one sentence that does not hang on the grid of the analysis."""
        return self.allowed("this wall")

    def allowed(self, which: str) -> str:
        """Return what the wall allows, as `wall`, with a name for it: `which`."""
        told = self.verdict.partition(": ")[2].removesuffix(".")
        return f"from {_frames(self.settings.frames)} of {which} and a target of {self.size.words}, {told}"

    def summary(self, arrays: bool = False) -> dict[str, Any]:
        """Return plain numbers and words; with `arrays` also singular values and Picard coefficients."""
        found: dict[str, Any] = {
            "setup": self.name,
            "verdict": self.verdict,
            "warnings": list(self.warnings),
            "modes_above_1e-2": self.modes,
            "psnr_zero_db": round(self.zero_db, 2),
            "psnr_mean_db": round(self.mean_db, 2),
            "typical_stroke_m": round(self.stroke_m, 5),
            "target_size_from": self.source,
            "analysis": asdict(self.settings),
            "settings": asdict(self.setup),
        }
        for name, one in (("camera_noise", self.at_camera), ("noise_std", self.at_noise_std)):
            upright, lying = (None if width is None else round(width, 5) for width in one.stroke_m)
            found[name] = {
                "rms_noise": round(one.noise, 6),
                "patterns_above_noise": one.patterns,
                "psnr_linear_db": round(one.psnr_db, 2),
                "finest_upright_stroke_m": upright,
                "finest_lying_stroke_m": lying,
            }
            if arrays:
                found[name]["singular_values_over_noise"] = one.spectrum.tolist()
                found[name]["picard_coefficients_over_noise"] = one.picard.tolist()
        if arrays:
            found["singular_values"] = self.singular.tolist()
        return found


def identify(
    setup: Setup,
    settings: AnalysisSettings | None = None,
    name: str = "setup",
    seed: int = 0,
    stated_m: float | None = None,
) -> Identification:
    """Say what one image of the wall can show of a target at a known place, whatever the method.

    The linear map from the target plane's cells to the camera's pixels is taken apart by its singular values;
    the noise is the frame camera's at the light of the mean target, and a fixed share of the brightest pixel.
    The best linear image uses mean and covariance of handwriting and is tested on characters and writers that
    it never saw.

    Args:
        setup: The setup; its frame camera's noise is what counts.
        settings: Cells, pixels and noise; None is the default, that of the table in docs/identifiability.md.
        name: What to call the setup.
        seed: Seed of the one image that is drawn with noise.
        stated_m: Side of the targets that the setup's file states (`stated_target_m`), metres; it counts where
            the settings name none.

    Raises:
        ConfigError: The setup is geometrically impossible, or the camera gets no light from the target.

    Example:
        >>> from evnlos.setups import load_setup
        >>> few = AnalysisSettings(cells=8, height=12, width=20, writers=1)
        >>> found = identify(load_setup("matte-near"), settings=few)
        >>> found.modes
        3
    """
    settings = settings or AnalysisSettings()
    size = AskedSize.of(setup, settings.target_size_m, stated_m)
    settings = replace(settings, target_size_m=size.size_m)
    seen = linearized(setup, settings)
    from evnlos.inverse.prior import handwritten_targets

    targets = handwritten_targets(settings.target_plane, settings.writers)
    singular = singular_values(seen.matrix)
    light = seen.ambient + seen.matrix @ targets.mean
    own = setup.frame_camera.noise_variance(light, settings.frames, settings.fpn_corrected)
    fixed = torch.full_like(own, (settings.noise_std * seen.white) ** 2 / settings.frames)
    at_camera, at_noise_std = (result_at_noise(seen, variance, targets, seed) for variance in (own, fixed))
    warnings = []
    plain = setup.without_artifacts()
    if plain is not None:
        wide = singular_values(linearized(plain, settings).matrix)
        note = artifact_note(
            setup, plain, modes_above(singular, KINK_LEVEL), modes_above(wide, KINK_LEVEL), KINK_LEVEL
        )
        warnings += [note] if note else []
    noise = setup.resized(seen.shape).operator_noise(seen.target_plane)
    if noise is not None:
        warnings += scan_notes(noise, seen, singular, MODE_LEVEL)
    zero_db, mean_db = (
        _psnr((targets.test - blank).square().mean(dim=-1))
        for blank in (torch.zeros_like(targets.mean), targets.mean)
    )
    return Identification(
        name,
        setup,
        settings,
        singular,
        modes_above(singular, MODE_LEVEL),
        zero_db,
        mean_db,
        targets.stroke_m,
        targets.test[targets.typical].reshape(settings.target_plane.shape),
        at_camera,
        at_noise_std,
        verdict(at_camera.patterns, at_camera.stroke_m, targets.stroke_m, size.size_m).replace(
            "one frame", _frames(settings.frames)
        ),
        tuple(warnings),
        size.source,
    )


QUICK = AnalysisSettings(cells=16, writers=2)
"""A coarse question, answered while one waits; `evnlos identify` asks the fine one."""


GUESSED = {
    True: "what the intervals leave open is the network's guess, from its training",
    False: "the whole image is the network's guess",
    None: "how much of the image is guessed cannot be told",
}
"""What of an image is guessed, by whether its sequence was measured; None: unknown."""


@dataclass(frozen=True)
class Verdict:
    """What to believe of a reconstruction: the same words in each command, on the page and in the files.

    Args:
        wall: What the wall allows (`Identification.wall`), or what is needed to know it; empty: unknown.
        recording: What this recording supports (`ConfidenceReport.verdict`), or why that can't be told.
        guessed: What the network draws without a measurement.
    """

    wall: str
    recording: str
    guessed: str

    @property
    def lines(self) -> list[str]:
        """The sentences that there are."""
        return [one for one in (self.wall, self.recording, self.guessed) if one]


def verdict_on(
    setup: Setup | None,
    report: ConfidenceReport | None,
    no_confidence: str | None = None,
    frames: int = 1,
    is_stated: bool = True,
    stated_m: float | None = None,
) -> Verdict:
    """Return the verdict on a reconstruction.

    Args:
        setup: The setup that the recording is taken to be of, where it is known and linear.
        report: How far to believe the images, where that can be told.
        no_confidence: Why it can't be told.
        frames: Frames that an image is made of: all of a network of whole sequences, else 1.
        is_stated: Whether the setup is that of the recording by somebody's word; else it is that of the
            weights, and where nothing was measured it says nothing of this wall.
        stated_m: Side of the targets that the setup's file states, metres; None where it states none.
    """
    wall, which = "", "this wall" if is_stated else "the wall that these weights know"
    try:
        if setup is not None and setup.is_linear and (is_stated or report is None or report.measured):
            wall = identify(setup, replace(QUICK, frames=frames), stated_m=stated_m).allowed(which)
    except MissingDependencyError as error:  # of handwriting; the images stand without the answer
        wall = f"what the wall allows is not known: {error}"
    if report is None:
        return Verdict(wall, no_confidence or "", GUESSED[None])
    untold = report.measured and report.explained is None  # halves that agree may agree on a habit
    return Verdict(wall, report.verdict, GUESSED[None if untold else report.measured])


def result_at_noise(
    seen: LinearizedSetup, variance: torch.Tensor, targets: TargetPrior, seed: int = 0
) -> NoiseLevelResult:
    """Return what is left of a setup at independent noise of a given variance.

    Args:
        seen: The linear map.
        variance: Variance of each pixel's noise, white levels squared, [H W], above 0.
        targets: Prior and test.
        seed: Seed of the one image that is drawn with noise.
    """
    cells, shape = seen.target_plane.width, seen.target_plane.shape
    note(f"modes at a noise of {float(variance.mean().sqrt()):.2g}")
    whitened = seen.matrix / variance.sqrt()[:, None]
    gram = whitened.mT @ whitened
    power, axes = torch.linalg.eigh(gram)
    power, axes = power.flip(0).clamp(min=0), axes.flip(1)
    # The sign of a mode is free: the larger half is shown bright.
    axes = axes * torch.where(axes.sum(dim=0) < 0, -1.0, 1.0)
    typical = targets.test[targets.typical]
    estimator = LinearEstimator.known(gram, targets.mean, targets.root)
    shapeless = LinearEstimator.white(gram, power, axes)
    generator = torch.Generator().manual_seed(derive_seed(seed, "identify"))
    noise = torch.randn(len(variance), generator=generator, dtype=torch.float64)
    backprojected = gram @ (typical - targets.mean) + whitened.mT @ noise
    strokes = [finest_bars(shapeless, cells, upright) for upright in (True, False)]
    upright, lying = (None if one is None else one * seen.target_plane.pitch_m for one in strokes)
    return NoiseLevelResult(
        float(variance.mean().sqrt()),
        estimator.patterns_seen,
        _psnr(estimator.expected_error(targets.test)),
        (upright, lying),
        power.sqrt(),
        power.sqrt() * (axes.mT @ typical).abs(),
        axes[:, :8].mT.reshape(8, *shape),
        estimator.estimate(backprojected).reshape(shape),
    )


def singular_values(matrix: torch.Tensor) -> torch.Tensor:
    """Return the singular values of a tall matrix over the largest one, float64 [n], descending."""
    note("singular values")
    # The triangle of a QR decomposition has the same ones; a product A^T A would lose those below 1e-8.
    values = torch.linalg.svdvals(torch.linalg.qr(matrix.double(), mode="r").R)
    return values / values[0]


def modes_above(singular: torch.Tensor, level: float) -> int:
    """Return how many singular values lie above a share of the largest."""
    return int((singular > level * singular[0]).sum())


def _psnr(error: torch.Tensor) -> float:
    """Return the mean PSNR of images with these mean squared errors, dB, peak 1."""
    return float((-10 * torch.log10(error)).mean())


def setup_table(found: Sequence[Identification]) -> str:
    """Return an aligned table of setups with the same settings, between lines that hold for all of them.

    Below it stands a line for each size of target that was asked about: where that is from, and of which.
    """
    settings = found[0].settings
    rows = [["setup", "modes > 1e-2", "patterns", "bars, upright x lying, mm", "best linear image, dB"]]
    for one in found:
        camera, fixed = one.at_camera, one.at_noise_std
        rows.append([one.name, str(one.modes), f"{camera.patterns} / {fixed.patterns}"])
        rows[-1] += [f"{_bars(camera)} / {_bars(fixed)}", f"{camera.psnr_db:.2f} / {fixed.psnr_db:.2f}"]
    sizes = dict[AskedSize, list[Identification]]()
    for one in found:
        sizes.setdefault(one.size, []).append(one)
    lines = [
        f"On the target plane of {size.words} ({size.source}"
        + (f": {', '.join(one.name for one in same)}" if len(sizes) > 1 else "")
        + f"): all-black {same[0].zero_db:.2f} dB, "
        f"mean training target {same[0].mean_db:.2f} dB; typical stroke {1e3 * same[0].stroke_m:.1f} mm; "
        f"{settings.cells} x {settings.cells} cells, {settings.height} x {settings.width} pixels."
        for size, same in sizes.items()
    ]
    return (
        f"From {_frames(settings.frames)}; two figures: at the camera's noise / at "
        f"{100 * settings.noise_std:g} % of white.\n{aligned(rows)}\n" + "\n".join(lines)
    )


def _frames(count: int) -> str:
    return "one frame" if count == 1 else f"the mean of {count} frames"


def _bars(one: NoiseLevelResult) -> str:
    return " x ".join("none" if width is None else f"{1e3 * width:.1f}" for width in one.stroke_m)
