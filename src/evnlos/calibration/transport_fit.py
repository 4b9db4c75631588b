"""Fitting a transport's numbers to frames: coarse to fine, the light itself solved for at every step."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.calibration.captures import Shots
from evnlos.calibration.frame_model import AnyTransport, FrameModel, fitting_strip, working_shape
from evnlos.calibration.least_squares import levenberg_marquardt
from evnlos.dataset.variation import varied
from evnlos.errors import ConfigError, DataError
from evnlos.transport import PaperTransport, RadiometricTransport

_FINE_STEPS = 3  # the coarse stage has done the way; every step of the fine one costs seconds
_EXPLAINED = 0.05
_REACH = 5.0


@dataclass(frozen=True)
class Parameter:
    """A number of a transport that the frames decide.

    Args:
        name: Dotted name in the transport's settings.
        unit: Its unit; empty where it has none.
        step: Step of the finite difference, in the unit, or relative to the value where `log`.
        low: Smallest value.
        high: Largest value.
        log: Whether the search runs over its logarithm.
    """

    name: str
    unit: str
    step: float
    low: float
    high: float
    log: bool = False

    def read(self, transport: AnyTransport) -> float:
        """Return the parameter's value in a transport."""
        name, _, entry = self.name.partition(".")
        value = getattr(transport, name)
        return float(value[int(entry)] if entry else value)

    def encode(self, value: float) -> float:
        """Return the value as the search sees it."""
        return math.log(value) if self.log else value

    def decode(self, value: float) -> float:
        """Return the search's value in the parameter's own unit."""
        return math.exp(value) if self.log else value


RADIOMETRIC = (
    Parameter("roughness", "", 0.02, 0.004, 1.0, log=True),
    Parameter("distance_m", "m", 0.005, 0.02, 20.0, log=True),
    Parameter("target_offset_m.0", "m", 5e-4, -10.0, 10.0),
    Parameter("target_offset_m.1", "m", 5e-4, -10.0, 10.0),
    Parameter("camera_distance_m", "m", 0.005, 0.05, 20.0, log=True),
    Parameter("camera_angle_deg", "deg", 0.2, -75.0, 75.0),
    Parameter("field_of_view_deg", "deg", 0.005, 2.0, 120.0, log=True),
)
"""What the frames decide about a wall of rough metal and a pin-hole camera."""

PAPER = (
    Parameter("tpsf_length_m", "m", 0.02, 1e-4, 1.0, log=True),
    Parameter("mean_free_path", "", 0.02, 0.05, 1.9),
    Parameter("field_of_view_m", "m", 0.005, 0.01, 20.0, log=True),
    Parameter("stretch", "", 0.005, 0.2, 5.0, log=True),
    Parameter("rotation_deg", "deg", 0.2, -45.0, 45.0),
    Parameter("shear", "", 0.005, -1.0, 1.0),
    Parameter("offset_m.0", "m", 5e-4, -10.0, 10.0),
    Parameter("offset_m.1", "m", 5e-4, -10.0, 10.0),
)
"""What the frames decide about the paper's transport."""


@dataclass(frozen=True)
class TransportFit:
    """A fitted transport.

    Args:
        before: The start, with the gain and ambient light that suit it best.
        transport: The fit, gain and ambient light included.
        parameters: The parameters that were searched for.
        error: Standard error of each, in its own unit, from the residual of the last stage; the model's own
            errors are not in it.
    """

    before: AnyTransport
    transport: AnyTransport
    parameters: tuple[Parameter, ...]
    error: NDArray[np.float64]

    @property
    def on_bound(self) -> dict[str, float]:
        """Parameters that ended on a bound of the search, within half a step, and that bound in its unit."""
        found: dict[str, float] = {}
        for p in self.parameters:
            value = p.encode(p.read(self.transport))
            for bound in (p.low, p.high):
                if abs(value - p.encode(bound)) <= 0.5 * p.step:
                    found[p.name] = bound
        return found


def parameters_of(transport: AnyTransport, fixed: tuple[str, ...] = ()) -> tuple[Parameter, ...]:
    """Return the parameters that the frames of a transport decide, without those that are known.

    Args:
        transport: The transport.
        fixed: Names of settings that keep their values, e.g. `distance_m`.
    """
    every = RADIOMETRIC if isinstance(transport, RadiometricTransport) else PAPER
    free = (p for p in every if p.name not in fixed and p.name.partition(".")[0] not in fixed)
    return tuple(_near(p, p.read(transport)) for p in free)


def _near(parameter: Parameter, value: float) -> Parameter:
    """Return a parameter that stays near its start: far off, impossible cameras fit by chance."""
    if not parameter.log:
        return parameter
    low, high = max(parameter.low, value / _REACH), min(parameter.high, value * _REACH)
    return replace(parameter, low=low, high=high)


def fit_transport(
    shots: Shots,
    start: AnyTransport,
    *,
    fixed: tuple[str, ...] = (),
    columns: int = 64,
    iterations: int = 20,
) -> TransportFit:
    """Fit a transport to the frames of captures with known targets.

    The residual at given parameters is that after the best gain and ambient light (variable projection, Golub
    and Pereyra 1973), so only the optics are searched: first a scan over blur and magnification, then
    Levenberg-Marquardt on small pictures and coarse cells, then on larger ones.

    Args:
        shots: The captures to fit.
        start: Where the search starts; its kind (radiometric or paper) is the kind that is fitted.
        fixed: Names of settings that keep their values.
        columns: Columns of the working pictures, pixels; half as many in the coarse stage.
        iterations: Most steps a stage.

    Raises:
        DataError: The frames do not follow the targets.
    """
    start = _explicit(fitting_strip(start, shots))
    parameters = parameters_of(start, fixed)
    coarse = FrameModel(shots, working_shape(shots.shape, columns // 2), _every(shots, 400))
    fine = FrameModel(shots, working_shape(shots.shape, columns), _every(shots, 200))
    quick, _ = _search(coarse, _scanned(coarse, sampled(start, 2.0)), parameters, iterations)
    found, error = _search(fine, sampled(quick), parameters, min(iterations, _FINE_STEPS))
    found = sampled(found)
    full = FrameModel(shots, shots.shape, _every(shots, 200))
    before = sampled(start)
    before = full.fit(full.light(before))[0].into(before)
    light, _ = full.fit(full.light(found))
    return TransportFit(before, light.into(found), parameters, error)


def _search(
    model: FrameModel, start: AnyTransport, parameters: tuple[Parameter, ...], iterations: int
) -> tuple[AnyTransport, NDArray[np.float64]]:
    def residual(values: NDArray[np.float64]) -> torch.Tensor:
        try:
            light = model.light(moved(start, parameters, values))
        except ConfigError:  # a camera that can't be, e.g. one that sees past the wall: the search turns back
            return model.frames * model.weight
        return model.fit(light)[1]

    found = levenberg_marquardt(
        residual,
        [p.encode(p.read(start)) for p in parameters],
        [p.step for p in parameters],
        [(p.encode(p.low), p.encode(p.high)) for p in parameters],
        iterations=iterations,
    )
    result = moved(start, parameters, found.values)
    scale = [p.read(result) if p.log else 1.0 for p in parameters]
    return result, found.error * np.array(scale)


def _scanned(model: FrameModel, start: AnyTransport) -> AnyTransport:
    """Return the best of a few blurs and magnifications around the start: a search from afar loses its way.

    Raises:
        DataError: The targets explain the frames hardly better than darkness, or better when mirrored.
    """
    blur, view = ("roughness", "field_of_view_deg")
    if isinstance(start, PaperTransport):
        blur, view = ("tpsf_length_m", "field_of_view_m")
    best, least, mirrored = start, math.inf, math.inf
    for wider in (1.0, 0.7, 1.4):
        for rougher in (0.25, 0.5, 1.0, 2.0):
            values = {blur: getattr(start, blur) * rougher, view: getattr(start, view) * wider}
            trial = replace(start, **values)
            picture = model.light(trial)
            light, residual = model.fit(picture)
            rms = _rms(residual)
            if light.gain > 0 and rms < least:
                best, least = trial, rms
            mirrored = min(mirrored, _rms(model.fit(picture.flip(-1))[1]))
    if mirrored < 0.8 * least:
        raise DataError(
            "the frames follow the targets the other way round; mirror the frames, or turn the motion's "
            "direction"
        )
    explained = 1 - least / _rms(model.fit(torch.zeros_like(model.frames))[1])
    if explained < _EXPLAINED:
        raise DataError(
            f"the targets explain {100 * max(explained, 0):.0f} % of what moves in the frames, below "
            f"{100 * _EXPLAINED:.0f} %; check the motion's start, speed and direction, or start "
            "nearer to the rig"
        )
    return best


def _rms(residual: torch.Tensor) -> float:
    return float(residual.square().mean().sqrt())


def moved(
    transport: AnyTransport, parameters: tuple[Parameter, ...], values: NDArray[np.float64]
) -> AnyTransport:
    """Return the transport with the search's values, [len(parameters)], each as `Parameter.encode` gives it."""
    chosen = {p.name: p.decode(float(v)) for p, v in zip(parameters, values, strict=True)}
    return varied(transport, {name: (v, v) for name, v in chosen.items()}, 0, "")  # a range without width


def _explicit(transport: AnyTransport) -> AnyTransport:
    """Return the transport with the place of the target written out: the search moves it by itself."""
    if isinstance(transport, RadiometricTransport):
        return replace(transport, target_offset_m=transport.offset_m())
    return transport


def sampled(transport: AnyTransport, coarser: float = 1.0) -> AnyTransport:
    """Return the transport with the coarsest cells that its blur allows: finer ones cost time and show nothing.

    A microfacet slope of alpha blurs the target by about 2 alpha r, with r the distance; a cell gets a sixth of
    that, as exact means over cells are what the matrix multiplies. The paper's kernel gets ten samples a unit
    of rho.

    Args:
        transport: The transport.
        coarser: Factor on the size of the cells.

    Example:
        >>> sampled(RadiometricTransport(roughness=0.05, distance_m=0.3)).cell_m
        0.005
    """
    if isinstance(transport, RadiometricTransport):
        blur = transport.roughness * transport.distance_m / 3 * coarser
        width, height = transport.strip_m
        # Whole cells across the plate's height, so that nothing of it is cut off.
        rows = max(8, min(64, math.ceil(height / blur)))
        cell = height / rows
        return replace(
            transport, cell_m=cell, strip_m=(round(math.ceil(width / cell - 1e-9) * cell, 9), height)
        )
    pitch = min(2e-3, max(2.5e-4, transport.tpsf_length_m / 10 * coarser))
    return replace(transport, pitch_m=pitch)


def _every(shots: Shots, frames: int) -> int:
    """Return the stride that leaves about this many frames."""
    return max(1, sum(len(capture.frames) for capture in shots.captures) // frames)
