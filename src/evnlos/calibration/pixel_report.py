"""From recordings under known light to a pixel file: the whole fit, its numbers as a table, and its files."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evnlos.calibration.event_statistics import count_map
from evnlos.calibration.pixel_checks import (
    AtLight,
    Comparison,
    Predicted,
    at_lights,
    compared,
    numbers_of,
    predicted,
    refractory_of,
    tick_of,
)
from evnlos.calibration.pixel_files import Manifest, doubts_of, maps_of, read_lit_events
from evnlos.calibration.pixel_fit import (
    CandidateFit,
    Estimate,
    PixelFitSettings,
    fit_candidate,
    panels_of,
)
from evnlos.calibration.pixel_light import LitEvents, LitRecording, choose_panel, lit_recording
from evnlos.cameras import PIXEL_MAPS_FILE, PixelMaps, PixelSettings, ReadoutPixel
from evnlos.config import save_yaml, to_dict
from evnlos.errors import DataError
from evnlos.files import write_atomically
from evnlos.machine import Progress, Step, silent
from evnlos.registry import __version__

PIXEL_FILE, PIXEL_VALUES_FILE, PIXEL_FIGURE = "pixel.yaml", "pixel_fit.json", "pixel_fit.png"
UNITS = {
    "threshold_on": "log units",
    "threshold_off": "log units",
    "threshold_sigma": "log units",
    "mismatch": "of the threshold",
    "cutoff_hz": "Hz at white",
    "leak_rate_hz": "Hz per pixel",
    "shot_noise_rate_hz": "Hz per pixel",
    "dark_dn": "DN",
    "leak_rate_per_dn_hz": "Hz per DN",
    "photon_noise": "log units sqrt(DN / s)",
    "photocurrent_a_per_dn": "A per DN",
    "noise_factor": "",
    "refractory_s": "s",
}
"""Unit of each number."""
_BAD_FIT = 2.0
_COARSE_US = 20
_LEVELS_OF_FRAMES = (0.1, 0.5, 0.9)


@dataclass(frozen=True, eq=False)
class KnownLightFit:
    """What recordings under known light say of an event pixel.

    Args:
        pixel: The pixel of the best model, behind a readout where hot pixels were seen; None where no light is
            known, so that nothing decides it.
        best: Its fit; None likewise.
        fits: All models that were fitted.
        compared: The models on pixels held out, the best first.
        refractory: The refractory period.
        predicted: Predictive checks of the best model.
        lights: Its noise and bandwidth against light.
        maps: Thresholds of each pixel; None where no light moves.
        observed: Of each recording, by name: counts, intervals, polarity, whatever the light.
        hot: Number of hot pixels.
        hot_rate_hz: Their median rate, hertz.
        white: The level that counts as 255 DN.
        seconds: Length of each recording, by name.
        warnings: What speaks against the fit, a line each.
    """

    pixel: PixelSettings | None
    best: CandidateFit | None
    fits: tuple[CandidateFit, ...]
    compared: tuple[Comparison, ...]
    refractory: Estimate
    predicted: Predicted | None
    lights: tuple[AtLight, ...]
    maps: PixelMaps | None
    observed: dict[str, dict[str, float]]
    hot: int
    hot_rate_hz: float
    white: float
    seconds: dict[str, float]
    warnings: tuple[str, ...]

    @property
    def describes(self) -> bool:
        """Whether the pixel describes the sensor: its misfit is at most twice what chance allows."""
        return self.best is not None and self.best.misfit <= _BAD_FIT


def fit_known_light(
    manifest: Manifest, settings: PixelFitSettings | None = None, progress: Progress = silent
) -> KnownLightFit:
    """Fit event models to recordings under known light, choose one on pixels held out, and check it.

    Args:
        manifest: The recordings and their light.
        settings: How to fit; None is the default.
        progress: Called after each simulation.

    Raises:
        DataError: Too few events or pixels, frames that do not fit, or recordings of different sensors.
        EventFileError: A file can't be read.
    """
    settings = settings or PixelFitSettings()
    sources = []
    for k, one in enumerate(manifest.recordings):
        progress(Step("read", k, len(manifest.recordings), "recordings"))
        sources.append(read_lit_events(one, manifest.white))
    progress(Step("read", len(sources), len(sources), "recordings"))
    warnings = [line for one in sources for line in doubts_of(one)]
    refractory = refractory_of([one.events for one in sources])
    ticks = {one.name: tick_of(one.events) for one in sources}
    warnings += [
        f"{name}: time stamps are multiples of {tick} us; shorter intervals say nothing"
        for name, tick in ticks.items()
        if tick > _COARSE_US
    ]
    panel = choose_panel(sources, settings.pixels, settings.seed)
    hot_rate = _hot_rate(sources, panel.hot)
    seconds = {one.name: one.seconds for one in sources}
    observed = {}
    for one in sources:
        lit = lit_recording(one, panel.fitted, settings.most_s)
        observed[one.name] = {k: v for k, v in numbers_of(lit, lit.events).items() if math.isfinite(v)}
    known = [one for one in sources if one.light.kind != "unknown"]
    if not known:
        warnings.append(
            "the light of no recording is known: thresholds, mismatch, bandwidth, leak and noise against light "
            "are not identified; give --light, a capture folder with frames, or a manifest"
        )
        return KnownLightFit(
            None, None, (), (), refractory, None, (), None, observed, int(panel.hot.sum()), hot_rate,
            manifest.white, seconds, tuple(warnings),
        )  # fmt: skip
    fitted, held = (
        [lit_recording(one, pixels, settings.most_s) for one in known] for pixels in (panel.fitted, panel.held)
    )
    dead_s = refractory.value if refractory.state == "identified" else 0.0
    full = panels_of(fitted)
    fits = [fit_candidate(name, full, settings, dead_s, progress) for name in settings.models]
    judged = panels_of(held, full)
    ranking = compared(fits, judged, settings, progress)
    best = next(fit for fit in fits if fit.name == ranking[0].name)
    names = [one.name for one in known]
    checks = predicted(best, judged, names, settings, progress)
    levels = _levels(fitted)
    lights = at_lights(best, levels, settings.seed)
    maps = maps_of(best, known, full, panel.hot, settings)
    if best.misfit > _BAD_FIT:
        warnings.append(
            f"no model explains the recordings: the best one's misfit is {best.misfit:.1f} times what chance "
            "allows, and its intervals are widened by as much; is the light as stated?"
        )
    failed = [one for one in checks.checks if not one.passed]
    if len(failed) > max(1, 0.05 * len(checks.checks)):
        warnings.append(f"{len(failed)} of {len(checks.checks)} predictive checks fail; see pixel_fit.json")
    pixel: PixelSettings = best.pixel
    if panel.hot.any():
        share = float(panel.hot.mean())
        pixel = ReadoutPixel(pixel, event_s=0.0, hot_pixel_fraction=share, hot_pixel_rate_hz=hot_rate)
    return KnownLightFit(
        pixel, best, tuple(fits), ranking, refractory, checks, lights, maps, observed, int(panel.hot.sum()),
        hot_rate, manifest.white, seconds, tuple(warnings),
    )  # fmt: skip


def _hot_rate(sources: Sequence[LitEvents], hot: Any) -> float:
    """Return the median rate of the hot pixels, hertz."""
    if not hot.any():
        return 0.0
    seconds = sum(one.seconds for one in sources)
    counts = sum(count_map(one.events, sign, -1) for one in sources for sign in (True, False))
    return float(np.median(counts[hot])) / seconds  # type: ignore[index]


def _levels(recordings: Sequence[LitRecording]) -> list[float]:
    """Return the light levels at which noise is told, DN: constant ones, else quantiles of all light."""
    still = sorted({one.known.level for one in recordings if one.known.kind == "static"})
    if still:
        return still
    light = np.concatenate([one.light.ravel()[:: max(1, one.light.size // 10_000)] for one in recordings])
    return sorted({round(float(q), 1) for q in np.quantile(light, _LEVELS_OF_FRAMES)})


def values_of_fit(fit: KnownLightFit) -> dict[str, Any]:
    """Return everything that was found as plain numbers and words, for pixel_fit.json.

    Args:
        fit: The fit.
    """
    best, maps = fit.best, fit.maps
    return {
        "evnlos": __version__,
        "pixel": None if fit.pixel is None else to_dict(fit.pixel),
        "model": None if best is None else best.name,
        "estimates": [_plain(one) for one in _estimates(fit)],
        "models": [asdict(one) for one in fit.compared],
        "describes_the_sensor": fit.describes,
        "misfit": {one.name: one.misfit for one in fit.fits},
        "all_estimates": {one.name: [_plain(each) for each in one.estimates] for one in fit.fits},
        "correlation": None
        if best is None
        else {"names": [f.name for f in best.free], "matrix": best.correlation.tolist()},
        "checks": []
        if fit.predicted is None
        else [asdict(one) | {"passed": one.passed} for one in fit.predicted.checks],
        "at_light": [{key: _finite(value) for key, value in asdict(one).items()} for one in fit.lights],
        "maps": None
        if maps is None
        else {
            "file": PIXEL_MAPS_FILE,
            "explained_on": maps.told[0],
            "explained_off": maps.told[1],
            "state": ["identified" if share > 0 else "not identified" for share in maps.told],
        },
        "hot_pixels": fit.hot,
        "hot_pixel_rate_hz": fit.hot_rate_hz,
        "white": fit.white,
        "recordings": {name: {"seconds": length, **fit.observed[name]} for name, length in fit.seconds.items()},
        "warnings": list(fit.warnings),
    }


def _plain(one: Estimate) -> dict[str, Any]:
    return {key: _finite(value) for key, value in asdict(one).items()} | {"unit": UNITS.get(one.name, "")}


def _finite(value: Any) -> Any:
    """Return a value for JSON, in which infinity is null."""
    if isinstance(value, tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _estimates(fit: KnownLightFit) -> tuple[Estimate, ...]:
    own = () if fit.best is None else fit.best.estimates
    if fit.best is None:
        own = tuple(
            Estimate(name, math.nan, math.nan, math.nan, "not identified")
            for name in (
                "threshold_on",
                "threshold_off",
                "threshold_sigma",
                "cutoff_hz",
                "leak_rate_hz",
                "shot_noise_rate_hz",
            )
        )
    return (*own, fit.refractory)


def lines_of_fit(fit: KnownLightFit) -> list[str]:
    """Return the fit as lines for people.

    Args:
        fit: The fit.
    """
    lines = []
    for one in _estimates(fit):
        unit = f" {UNITS.get(one.name, '')}".rstrip()
        if one.state == "identified":
            text = f"{one.value:.4g}  ({one.low:.4g} to {one.high:.4g}){unit}"
        elif one.state == "at most":
            text = f"not told from none, at most {one.high:.3g}{unit}"
        else:
            text = "not identified"
        lines.append(f"  {one.name:<24} {text}")
    if fit.maps is None:
        lines.append(f"  {'thresholds of each pixel':<24} not identified")
    else:
        shares = [
            f"{100 * s:.0f} % of the {n} mismatch" if s else f"{n} not identified"
            for s, n in zip(fit.maps.told, ("ON", "OFF"), strict=True)
        ]
        lines.append(f"  {'thresholds of each pixel':<24} {', '.join(shares)}; {fit.hot} hot pixels")
    if fit.best is not None:
        lines.insert(0, f"{fit.best.name}: value (95 % interval), misfit {fit.best.misfit:.2f} (1 is chance)")
    for one in fit.lights:
        corner = f"{one.bandwidth_hz[0]:.3g} Hz" if math.isfinite(one.bandwidth_hz[0]) else "none in this model"
        on, off = (f"{mid:.3g} ({low:.3g} to {high:.3g}) Hz" for mid, low, high in (one.on_hz, one.off_hz))
        lines.append(f"  at {one.light_dn:6.3g} DN: noise ON {on}, OFF {off}; bandwidth {corner}")
    if len(fit.compared) > 1:
        lines.append("held-out pixels, log likelihood behind the best model:")
        for one in fit.compared:
            told = (
                "the best"
                if one.behind == 0
                else f"{one.behind:.1f} +- {one.error:.1f} nats ({one.bits_per_event:.3g} bits per event)"
            )
            near = "; not distinguished" if 0 < one.behind < 2 * one.error else ""
            lines.append(f"  {one.name:<28} {told}{near}")
    if fit.predicted is not None:
        checks = fit.predicted.checks
        failed = [one for one in checks if not one.passed]
        lines.append(f"predictive checks: {len(checks) - len(failed)} of {len(checks)} pass")
        lines += [
            f"  fails: {one.name} of {one.recording}: {one.recorded:.4g}, model {one.low:.4g} to {one.high:.4g}"
            for one in failed[:8]
        ]
    for name, numbers in fit.observed.items():
        lines.append(
            f"{name}: {fit.seconds[name]:.3g} s, {numbers['rate, Hz per pixel']:.3g} Hz per pixel, ON / OFF "
            f"{numbers['ON / OFF']:.3g}"
        )
    return lines


def write_known_light_fit(fit: KnownLightFit, out: Path) -> Path | None:
    """Write pixel.yaml, pixel_fit.json and pixel_maps.npz, and return the path of the pixel's file.

    Args:
        fit: The fit.
        out: Folder, made where it is not there.

    Raises:
        DataError: The folder can't be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{out} can't be made a folder ({error.strerror}); give another --out") from None
    write_atomically(out / PIXEL_VALUES_FILE, json.dumps(values_of_fit(fit), indent=1).encode())
    if fit.maps is not None:
        packed, maps = io.BytesIO(), fit.maps
        np.savez_compressed(
            packed,
            threshold_on=maps.on,
            threshold_off=maps.off,
            error_on=maps.error_on,
            error_off=maps.error_off,
            hot=maps.hot,
        )
        write_atomically(out / PIXEL_MAPS_FILE, packed.getvalue())
    if fit.pixel is None:
        return None
    save_yaml(fit.pixel, out / PIXEL_FILE)
    return out / PIXEL_FILE
