"""What a setup predicts for the frames of captures, and the light that fits them best.

- The frame camera's noise, from what is left of the frames when the fitted light is taken off.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.calibration.captures import CaptureSet, Own, moved_along, relit
from evnlos.cameras import FrameCamera, FrameCameraSettings, LogCodes, LogFrameCamera
from evnlos.data.capture import Capture
from evnlos.data.fixed_pattern import FixedPattern
from evnlos.data.sampling import reduce_by_area
from evnlos.errors import ConfigError, DataError
from evnlos.setups import Setup
from evnlos.types import Plane

_AHEAD_M, _FASTER = 1e-3, 0.02  # steps of the derivatives by place and speed
_COARSER, EVERY = 4, 2  # pixels and frames of one that the light of captures is told from
_LEAST_CHANGE, _LEAST_CHANGE_DN = 0.02, 0.1  # of light from capture to capture: of itself; DN of 8 bits
_LEAST_WAY_M = 6e-4  # of places from capture to capture: walls of other kinds feign 1e-4 to 4e-4


@dataclass(frozen=True)
class LightLevel:
    """The linear part of a frame: frame = gain light + ambient (1 + gx x + gy y), x and y from -1 to 1.

    Args:
        gain: White levels per unit of light.
        ambient: Ambient light in the middle of the image, white levels.
        gradient: Relative growth of the ambient light to the right and the lower border.
    """

    gain: float
    ambient: float
    gradient: tuple[float, float]

    def into(self, setup: Setup) -> Setup:
        """Return the setup with this gain and ambient light.

        Raises:
            DataError: No camera shows such light: the gain is not positive, or the ambient light is negative.
        """
        if not self.gain > 0:
            raise DataError(
                f"the fitted gain is {self.gain:.3g}; the frames do not follow the targets: check the motion's "
                "direction and start, and whether the frames are mirrored"
            )
        gx, gy = self.gradient
        # A dark corner may come out a hair below zero; a wall that is dark everywhere has no gradient.
        level = max(self.ambient, 0.0)
        steep = abs(gx) + abs(gy)
        shrink = min(1.0, (1.0 - 1e-6) / steep) if steep > 0 else 1.0
        gradient = (gx * shrink, gy * shrink) if level > 0 else (0.0, 0.0)
        return replace(setup, gain=self.gain, ambient=level, ambient_gradient=gradient)


class FrameModel:
    """The frames of captures at a working size, beside what a setup makes of the same targets.

    Pixels that a frame shows at its largest number are saturated and take no part.

    Args:
        capture_set: The captures.
        shape: Working size (h, w), pixels; frames are reduced to it by area averaging.
        every: Only every n-th frame of a capture takes part.

    Attributes:
        frames: The frames, white levels, float32 [N, h, w].
        weight: 1 where a pixel takes part, 0 where it is saturated, float32 [N, h, w].

    Raises:
        ConfigError: `every` is below 1.
    """

    def __init__(self, capture_set: CaptureSet, shape: tuple[int, int], every: int = 1) -> None:
        if every < 1:
            raise ConfigError(f"every is {every}; take every frame (1) or every n-th")
        self.shape = shape
        self._scenes, self._motions = capture_set.scenes, capture_set.motions
        self._times = [capture_set.times_s(k)[::every] for k in range(len(capture_set.captures))]
        raw = np.concatenate([capture.frames[::every] for capture in capture_set.captures])
        reduced = reduce_by_area(raw / np.float32(capture_set.peak), shape)
        self.frames = torch.from_numpy(reduced)
        open_share = reduce_by_area((raw < capture_set.peak).astype(np.float32), shape)
        self.weight = torch.from_numpy((open_share > 0.999).astype(np.float32))
        y, x = torch.linspace(-1, 1, shape[0]), torch.linspace(-1, 1, shape[1])
        self._ramp = torch.stack([torch.ones(shape), x.expand(shape), y[:, None].expand(shape)])  # [3, h, w]
        self._drawn: dict[object, torch.Tensor] = {}

    def light(self, setup: Setup) -> torch.Tensor:
        """Return the light of every frame at gain 1 without ambient light, float32 [N, h, w]."""
        plain = replace(setup, gain=1.0, ambient=0.0, ambient_gradient=(0.0, 0.0)).resized(self.shape)
        cells = plain.target_cells()
        if cells is not None and plain.is_linear:
            # One matrix carries the frames of all captures at once.
            matrix = plain.operator(cells, dtype=torch.float32).dense(torch.float32)
            strips = self._strips(cells)
            return (strips @ matrix.T).reshape(-1, *self.shape) + self._along(plain)
        walls = [plain.observe(scene) for scene in self._scenes]
        return torch.cat([wall.irradiance(times) for wall, times in zip(walls, self._times, strict=True)])

    def fit(self, light: torch.Tensor) -> tuple[LightLevel, torch.Tensor]:
        """Return gain and ambient light that fit best, and the residual frame - model, float32 [N, h, w]."""
        ramp = self._ramp.double()
        lit = light * self.weight
        # Normal equations: the ambient light is the same three images in every frame.
        columns = torch.zeros(4, 4, dtype=torch.float64)
        columns[0, 0] = _inner(lit, light)
        columns[0, 1:] = columns[1:, 0] = (ramp * lit.sum(0)).sum((1, 2))
        columns[1:, 1:] = torch.einsum("ahw,bhw,hw->ab", ramp, ramp, self.weight.sum(0).double())
        seen = (self.frames * self.weight).sum(0)
        right = torch.cat([_inner(lit, self.frames)[None], (ramp * seen).sum((1, 2))])
        if columns[0, 0] == 0:
            columns[0, 0] = 1.0  # no light at all: its gain is 0, and the others stand alone
        gain, level, gx, gy = torch.linalg.solve(columns, right).tolist()
        ambient = (torch.tensor([level, gx, gy]) @ self._ramp.flatten(1)).reshape(self.shape)
        residual = ((self.frames - ambient) - gain * light) * self.weight
        floor = level if abs(level) > 1e-9 else 1e-9
        return LightLevel(gain, level, (gx / floor, gy / floor)), residual

    def predict(self, setup: Setup) -> torch.Tensor:
        """Return the frames that the setup, with its own gain and ambient light, predicts, [N, h, w]."""
        return setup.gain * self.light(setup) + setup.ambient_light(self.shape)

    def own(self, setup: Setup) -> NDArray[np.float64]:
        """Return what each capture has of its own, [captures, 6], in the order of `Own`.

        Least squares, in place and speed to first order: a L(p + d) = a L + a d L'.
        """
        light, around = setup.gain * self.light(setup), setup.ambient_light(self.shape)
        counts, found = [len(one) for one in self._times], []
        late = torch.cat([torch.linspace(-0.5, 0.5, n) if n > 1 else torch.zeros(n) for n in counts])
        columns = [light, around.to(light).expand_as(light)]
        for ahead_m, faster in ((_AHEAD_M, 0.0), (0.0, _FASTER)):
            there = setup.gain * self._moved(ahead_m, 1 + faster).light(setup)
            columns.append((there - light) / (ahead_m + faster))
        columns += [late[:, None, None] * one for one in columns[:2]]
        split = (torch.stack(columns).split(counts, 1), self.frames.split(counts), self.weight.split(counts))
        for parts, seen, weight in zip(*split, strict=True):
            scale = parts.double().square().mean(dim=(1, 2, 3)).sqrt() + 1e-30
            each = parts.double() / scale[:, None, None, None]
            normal = torch.einsum("anhw,bnhw,nhw->ab", each, each, weight.double())
            right = torch.einsum("anhw,nhw,nhw->a", each, seen.double(), weight.double())
            target, ambient, *more = (
                torch.linalg.lstsq(normal, right[:, None]).solution[:, 0] / scale
            ).tolist()
            ahead, faster, fade, drift = more
            grown = fade / target, drift / ambient if ambient else 0.0
            found.append([target, ambient, ahead / target, 1 + faster / target, *grown])
        return np.array(found)

    def _moved(self, ahead_m: float, speed: float) -> FrameModel:
        """Return the model of the same frames with targets ahead of their places, and faster."""
        other, scenes = copy(self), []
        for scene, motion, times in zip(self._scenes, self._motions, self._times, strict=True):
            moved = moved_along(motion, ahead_m, speed, (times[0] + times[-1]) / 2)
            scenes.append(replace(scene, motion=moved))
        other._scenes, other._drawn = tuple(scenes), {}
        return other

    def _along(self, setup: Setup) -> torch.Tensor | float:
        """Return the light of what moves along with the targets, [N, h, w], or nothing."""
        places = [
            scene.motion.position_m(times) for scene, times in zip(self._scenes, self._times, strict=True)
        ]
        where, index = np.unique(np.concatenate(places), axis=0, return_inverse=True)
        light = setup.companion_light(where)
        return 0.0 if light is None else light[torch.from_numpy(index.reshape(-1))]

    def relative(self, residual: torch.Tensor) -> float:
        """Return the root mean square of a residual over the frames' standard deviation, over all pixels."""
        return relative_residual(residual, self.frames, self.weight)

    def left(self, predicted: torch.Tensor, seen: torch.Tensor | None = None) -> float:
        """Return what a prediction leaves, as `relative` does: of the frames, or of others in their place."""
        return self.relative(((self.frames if seen is None else seen) - predicted) * self.weight)

    def _strips(self, plane: Plane) -> torch.Tensor:
        """Return every frame's target on the strip of cells, float32 [N, cells]; drawn once for each strip."""
        if plane not in self._drawn:
            drawn = [
                scene.target.rasterise(plane, scene.motion.position_m(times))
                for scene, times in zip(self._scenes, self._times, strict=True)
            ]
            self._drawn[plane] = torch.from_numpy(np.concatenate(drawn)).flatten(1)
        return self._drawn[plane]


def steadied(fit: CaptureSet, held: CaptureSet, setup: Setup) -> tuple[CaptureSet, CaptureSet] | None:
    """Return captures without what each has of its own beside the setup and its notes.

    Daylight, lamps elsewhere in the room, the lamp of the target and the exposure change from one recording to
    the next and in its course, and a target that starts by hand is never where its notes say; what is fitted
    takes light and motion to be the same in all.

    Args:
        fit: Captures that were fitted.
        held: Captures that were held out.
        setup: What was fitted to them.

    Returns:
        The same captures; None where they do not differ by what frames show.
    """
    factors = _own_factors(fit, held, setup)
    if factors is None:
        return None
    around, found = setup.ambient_light(fit.shape).numpy(), list[CaptureSet]()
    middle = np.median(np.concatenate(factors)[:, 1])  # of the ambient light
    for one, every in zip((fit, held), factors, strict=True):
        captures, told = list[Capture](), list[Own]()
        usual = np.float32(middle * one.peak) * around
        for k, (capture, (target, ambient, *other)) in enumerate(
            zip(one.captures, every.tolist(), strict=True)
        ):
            own = Own(target, ambient / middle, *other)
            late = np.linspace(-0.5, 0.5, len(capture.frames), dtype=np.float32)[:, None, None]
            lit = own.target * (1 + own.target_growth * late)
            level = (capture.frames - own.ambient * (1 + own.ambient_growth * late) * usual) / lit + usual
            motion, times = one.motions[k], one.times_s(k)
            moved = moved_along(motion, own.ahead_m, own.speed, float(times[0] + times[-1]) / 2)
            assert capture.info.motion is not None
            noted = replace(capture.info.motion, start_m=moved.start_m, speed_m_s=moved.speed_m_s)
            info = replace(capture.info, motion=noted)
            captures.append(replace(relit(capture, level, one.peak), info=info))
            told.append(one.own[k].then(own) if one.own else own)
        found.append(replace(one, captures=tuple(captures), own=tuple(told)))
    return found[0], found[1]


def _own_factors(fit: CaptureSet, held: CaptureSet, setup: Setup) -> list[NDArray[np.float64]] | None:
    """Return what each has of its own [captures, 6], in the order of `Own`; None where frames show nothing.

    What all have alike is the setup's: a median, the middle of the places. Ambient light stays beside the
    setup's.
    """
    factors = [FrameModel(one, coarse_shape(fit), EVERY).own(setup) for one in (fit, held)]
    every, motions = np.concatenate(factors), (*fit.motions, *held.motions)
    times = [one.times_s(k) for one in (fit, held) for k in range(len(one.captures))]
    along = np.array([np.asarray(one.direction) / np.hypot(*one.direction) for one in motions])
    ways = np.array([one.speed_m_s * (t[-1] - t[0]) for one, t in zip(motions, times, strict=True)])
    every[:, 2] -= along @ np.linalg.lstsq(along, every[:, 2], rcond=None)[0]
    middle = np.median(every, axis=0)
    every[:, [0, 3]] /= middle[[0, 3]]
    every[:, 4:] -= middle[4:]
    levels = np.array([setup.gain, float(setup.ambient_light(fit.shape).mean())] * 2)
    light, spread = [0, 1, 4, 5], every[:, [0, 1, 4, 5]].std(axis=0)
    is_seen = np.ones(6, dtype=bool)
    is_seen[light] = (spread > _LEAST_CHANGE) & (spread * levels * 255 > _LEAST_CHANGE_DN)
    away = np.hypot(every[:, 2], (every[:, 3] - 1) * ways / 2)
    is_seen[2:4] = np.sqrt(np.mean(away**2)) > _LEAST_WAY_M
    if not is_seen.any() or not (middle[:2] > 0).all() or not (every[:, [0, 3]] > 0).all():
        return None
    every = np.where(is_seen, every, [1.0, middle[1], 0.0, 1.0, 0.0, 0.0])
    return np.split(every, [len(factors[0])])


def coarse_shape(captures: CaptureSet) -> tuple[int, int]:
    """Return the size (h, w) at which captures are told from each other."""
    height, width = captures.shape
    return max(8, round(height / _COARSER)), max(8, round(width / _COARSER))


def relative_residual(residual: torch.Tensor, frames: torch.Tensor, weight: torch.Tensor) -> float:
    """Return sqrt(mean residual^2) over the standard deviation of the frames, over the pixels that take part.

    Args:
        residual: Frames minus model, [...].
        frames: The frames, [...].
        weight: 1 where a pixel takes part, 0 elsewhere, [...].

    Example:
        >>> frames = torch.tensor([0.0, 2.0])
        >>> relative_residual(frames - 1.0, frames, torch.ones(2))
        1.0
    """
    taken = weight > 0
    spread = frames[taken].double().std(correction=0)
    return float(residual[taken].double().square().mean().sqrt() / spread)


def _inner(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the sum of a b over [N, h, w], gathered in float64."""
    return torch.einsum("nhw,nhw->n", a, b).double().sum()


def fitting_strip(setup: Setup, capture_set: CaptureSet) -> Setup:
    """Return the setup with room for every target of the captures on its way."""
    reach: NDArray[np.float64] = np.zeros(2)
    for k, scene in enumerate(capture_set.scenes):
        places = np.abs(scene.motion.position_m(capture_set.times_s(k))).max(axis=0)
        reach = np.maximum(reach, places + scene.target.size_m / 2)
    return setup.covering((float(2 * reach[0]), float(2 * reach[1])))


_BINS = 24
_LARGEST_WELL_E = 1e6
_OPEN = 0.9  # share of the largest number above which noise may be clipped
FITTED = {
    "linear": {"full_well_e": "electrons", "read_noise_e": "electrons", "prnu": "", "dsnu_e": "electrons"},
    "log": {"noise_codes": "codes of 12 bits", "pattern_codes": "codes of 12 bits"},
}
"""What is fitted to the noise, with its unit, by the kind of the frame camera."""


@dataclass(frozen=True)
class FrameNoise:
    """What the residual says about the frame camera.

    Args:
        camera: The frame camera that makes this noise.
        temporal: Standard deviation of the noise that changes from frame to frame, white levels.
        pattern: Sensitivity and offset of each pixel, the most probable ones.
        remaining: Settings of the camera's fixed pattern that stay after correction by `pattern`, by name.
    """

    camera: FrameCameraSettings
    temporal: float
    pattern: FixedPattern
    remaining: dict[str, float]


def fit_frame_noise(capture_set: CaptureSet, model: NDArray, start: FrameCameraSettings) -> FrameNoise:
    """Fit full well, read noise and fixed pattern to the residual of the frames.

    The variance of the temporal noise is a line over the signal (photon transfer, EMVA 1288): its slope is the
    digital number an electron makes, its intercept read noise and rounding. The noise comes from second
    differences of the residual in time, the pattern from second differences over the sensor, so that a smooth
    misfit of the model takes no part. The black level is taken as 0: frames cannot tell it from ambient light.
    Of logarithmic frames, which are linear by now, noise and pattern are shares of the light.

    Args:
        capture_set: The captures.
        model: Predicted frames, white levels, [N, H, W], in the order of `capture_set.frames()`.
        start: Camera whose other settings are kept, where it is of the captures' kind.
    """
    about, peak = capture_set.captures[0].info.camera, float(capture_set.peak)
    frames = capture_set.frames().astype(np.float64)
    signal = model.astype(np.float64) * peak
    residual = frames - signal
    mean_signal = signal.mean(axis=0)
    swing = signal - mean_signal
    power = np.maximum((swing**2).sum(axis=0), 1e-9)
    tilt = (swing * residual).sum(axis=0) / power  # a of residual = a signal + b, for each pixel
    seen = signal if about.log is None else frames  # with the pattern, which the noise of log frames grows with
    noise, level = _temporal(residual - tilt * swing, seen, capture_set.frame_of())
    open_ = level < _OPEN * peak
    noise, level = noise[open_], level[open_]
    temporal = float(np.sqrt(np.mean(noise**2)))
    prnu, dsnu = _fixed_pattern(residual.mean(axis=0), mean_signal, tilt, power, temporal**2, len(frames))
    pattern, (left, offset_left) = most_probable_pattern(residual, signal, temporal, prnu, dsnu, peak)
    if about.log is not None:
        rms = math.sqrt(float(np.mean(signal**2)))
        spread, rest = (
            about.log.codes_per_efold * math.hypot(a, b / rms) for a, b in ((prnu, dsnu), (left, offset_left))
        )
        share = math.sqrt(float(np.sum(noise**2) / np.sum(level**2)))
        camera = _log_camera(about.log, frames[0], share, spread)
        return FrameNoise(camera, temporal / peak, pattern, {"pattern_codes": rest})
    slope, floor = _photon_transfer(noise, level)
    full_well = min(_LARGEST_WELL_E, peak / slope) if slope > 0 else _LARGEST_WELL_E
    dn_per_e = peak / full_well
    start = start if isinstance(start, FrameCamera) else FrameCamera()
    camera = replace(
        start,
        exposure_s=start.exposure_s if about.exposure_s is None else about.exposure_s,
        full_well_e=full_well,
        read_noise_e=math.sqrt(max(floor - 1 / 12, 0.0)) / dn_per_e,
        prnu=prnu,
        dsnu_e=dsnu / dn_per_e,
        bit_depth=int(peak + 1).bit_length() - 1,
        gain=1.0,
        black_level=0.0,
    )
    return FrameNoise(camera, temporal / peak, pattern, {"prnu": left, "dsnu_e": offset_left / dn_per_e})


def _log_camera(codes: LogCodes, frame: NDArray, share: float, spread: float) -> LogFrameCamera:
    """Return the camera of log frames whose noise is a share of the light, of which the rounding makes some.

    Args:
        codes: Its codes.
        frame: A frame, linear [H, W]: codes of 8 bits leave few numbers.
        share: Noise over light.
        spread: Standard deviation of the fixed pattern, codes.
    """
    bits = 8 if np.isin(frame, codes.levels(np.arange(256, dtype=np.uint8))).all() else 12
    noise = math.sqrt(max((codes.codes_per_efold * share) ** 2 - 4.0 ** (12 - bits) / 12, 0.0))
    return LogFrameCamera(codes.codes_per_efold, codes.white_code, 255.0, 0.0, spread, 0.0, 0.0, noise, bits)


def most_probable_pattern(
    residual: NDArray, signal: NDArray, temporal: float, prnu: float, dsnu: float, peak: float
) -> tuple[FixedPattern, tuple[float, float]]:
    """Return each pixel's sensitivity and offset, given the frames and how far the pixels spread.

    residual_k = g signal_k + h + noise_k over the frames k, with normal g, h and noise: a linear regression
    with priors for each pixel, two equations for (g, h).

    Args:
        residual: Camera minus model, DN [N, H, W].
        signal: The model, DN [N, H, W].
        temporal: Standard deviation of the noise, DN.
        prnu: Standard deviation of g.
        dsnu: Standard deviation of h, DN.
        peak: Largest digital number.

    Returns:
        The pattern, and the root mean squares of what stays unknown: of g, over the light's swing, and of
        g signal + h at a pixel's mean signal, DN.
    """
    s0, s1, s2 = len(signal), signal.sum(axis=0), (signal**2).sum(axis=0)
    r0, r1 = residual.sum(axis=0), (residual * signal).sum(axis=0)
    # In units of 1 / temporal^2; a spread of 0 leaves nothing to find.
    a = s2 + (temporal / max(prnu, 1e-9)) ** 2
    d = s0 + (temporal / max(dsnu, 1e-9)) ** 2
    determinant = a * d - s1**2
    g, h = (d * r1 - s1 * r0) / determinant, (a * r0 - s1 * r1) / determinant
    pattern = FixedPattern((1 + g).astype(np.float32), (h / peak).astype(np.float32))
    # The error at light s is e_mean + e_g (s - mean): what is left of g counts where the light swings.
    mean, swing = s1 / s0, np.maximum(s2 - s1**2 / s0, 1e-12)
    left_g = float(np.average(d / determinant, weights=swing))
    left_mean = float(np.mean((a - 2 * mean * s1 + mean**2 * d) / determinant))
    return pattern, (min(prnu, temporal * math.sqrt(left_g)), min(dsnu, temporal * math.sqrt(left_mean)))


def _temporal(residual: NDArray, signal: NDArray, capture: NDArray) -> tuple[NDArray, NDArray]:
    """Return samples of the temporal noise and the signal there: second differences within each capture."""
    inside = (capture[2:] == capture[:-2])[:, None, None]
    noise = (residual[2:] - 2 * residual[1:-1] + residual[:-2]) / math.sqrt(6)
    level = (signal[2:] + 4 * signal[1:-1] + signal[:-2]) / 6  # weights of the variances
    chosen = np.broadcast_to(inside, noise.shape)
    return noise[chosen], level[chosen]


def _photon_transfer(noise: NDArray, level: NDArray) -> tuple[float, float]:
    """Return slope (DN) and intercept (DN^2) of the noise's variance over the signal."""
    order = np.argsort(level, kind="stable")
    parts = np.array_split(order, _BINS)
    x = np.array([level[part].mean() for part in parts])
    y = np.array([np.mean(noise[part] ** 2) for part in parts])
    # A variance's own error grows with it: equal relative weights.
    slope, floor = np.polyfit(x, y, 1, w=1 / np.maximum(y, 1e-6))
    return float(slope), float(floor)


def _fixed_pattern(
    residual: NDArray, signal: NDArray, tilt: NDArray, power: NDArray, variance: float, frames: int
) -> tuple[float, float]:
    """Return the standard deviations of sensitivity (fraction) and offset (DN) over the pixels.

    Args:
        residual: Mean residual of each pixel, DN.
        signal: Mean signal of each pixel, DN.
        tilt: Slope of the residual over the signal, for each pixel.
        power: Sum of the squares of the signal's swing, DN^2.
        variance: Variance of the temporal noise, DN^2.
        frames: Number of frames behind the means.
    """
    sure = power >= np.quantile(power, 0.8)
    prnu2 = max(0.0, float(np.mean((local_square(tilt) - variance / power)[sure])))
    dim = power <= np.quantile(power, 0.5)
    offset2 = local_square(residual) - variance / frames - prnu2 * signal**2
    return math.sqrt(prnu2), math.sqrt(max(0.0, float(np.mean(offset2[dim]))))


def local_square(image: NDArray) -> NDArray[np.float64]:
    """Return the square of an image's difference from its neighbours, scaled to a white image's variance.

    Args:
        image: Real [H, W], at least 3 x 3.

    Example:
        >>> float(local_square(np.arange(25.0).reshape(5, 5)).max())
        0.0
    """
    padded = np.pad(np.asarray(image, dtype=np.float64), 1, mode="reflect", reflect_type="odd")
    around = padded[1:-1, :-2] + padded[1:-1, 2:] + padded[:-2, 1:-1] + padded[2:, 1:-1]
    return (2 * padded[1:-1, 1:-1] - around / 2) ** 2 / 5
