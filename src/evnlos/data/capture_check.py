"""Is a capture worth a day of recordings? What was recorded, in plain words, and how to mend it.

- Of several captures by one camera: whose clocks differ from the others'?
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from evnlos.data.capture import Capture
from evnlos.data.capture_info import CaptureInfo
from evnlos.data.clocks import FEWEST_LAGS, LEAST_AGREEMENT, beside_others, find_lag
from evnlos.data.fixed_pattern import light_path
from evnlos.data.frames import clipped_at
from evnlos.data.sampling import reduce_by_area
from evnlos.errors import DataError
from evnlos.events import find_hot_pixels
from evnlos.events.cleaning import find_flicker, share_of_lamps
from evnlos.types import Events

Level = Literal["good", "doubtful", "bad"]

_DARK_DN, _BORDER = 3, 0.08
_BLOCK = 6  # pixels: single ones tell nothing of the light
_FEWEST_EVENTS = 2_000
_SURELY = 1.5  # times what is usual
_ALONE_US = 70_000  # beyond what cannot be told: dim slow pixels, simulated with equal clocks, reach 65 ms
_CLEARLY = 1.2  # times the agreement of frames and events
_FAR_M = 0.5  # behind that little light of a target reaches what a camera sees of the wall
_WEAK_FLICKER = 0.15  # of the rate: what little lamps sway
_FEW_OF_LAMPS = 0.03  # of the events: a ripple below the thresholds makes less than a hundredth
_USUAL_EVENTS, _FEW_HOLES = 100, 0.05  # events between two frames of which none is no chance; share of them
_MOSAIC = 0.03  # by which the diagonals of 2 x 2 pixels differ: smooth light and a pattern make far less


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Args:
        what: Name of the check.
        level: "good", "doubtful" (look at it) or "bad" (a reconstruction will suffer).
        found: What was measured, with its unit and the limit.
        cure: What to do; empty where nothing is to do.
        lag_us: What to add to the frames' times, microseconds, where the clocks could be compared.
    """

    what: str
    level: Level
    found: str
    cure: str = ""
    lag_us: int | None = None


def check_capture(capture: Capture) -> list[Finding]:
    """Return what a capture is worth, check by check: light, contrast, movement, motion, place, events, clock.

    Args:
        capture: A capture that could be read.
    """
    if not capture.has_frames:
        cure = "a network of events needs none; for calibration and fusion record a frame camera beside it"
        alone = Finding("frames", "doubtful", "none: an event camera alone", cure)
        return [alone, *_events(capture), *_flicker(capture)]
    if not capture.has_events:
        cure = "a network of frames needs none; for fusion and a finer track record an event camera beside it"
        alone = Finding("events", "doubtful", "none: a frame camera alone", cure)
        return [*_light(capture), *_movement(capture), *_motion(capture), alone, *_frame_times(capture)]
    looks = (_light, _movement, _motion, _events, _flicker, _clock, _frame_times, clock_offset)
    return [finding for look in looks for finding in look(capture)]


def _finding(what: str, good: bool, bearable: bool, found: str, cure: str) -> Finding:
    """Return a finding with its level; the cure stands only where something is to do."""
    if good:
        return Finding(what, "good", found)
    return Finding(what, "doubtful" if bearable else "bad", found, cure)


def _light(capture: Capture) -> Iterator[Finding]:
    frames, peak = capture.frames, capture.peak
    if (bits := _unscaled_bits(capture)) is not None:
        found = f"the largest of 16 bits is {int(frames.max())}: these look like {bits} bits, not scaled"
        cure = f"state camera: {{white_dn: {(1 << bits) - 1}}} in capture.yaml, beside its other keys"
        yield Finding("white level", "doubtful", found, cure)
    white, log = clipped_at(frames, peak), capture.info.camera.log
    clipped = float((frames >= white).mean())
    if log is None and Path(capture.info.frames or "").suffix == ".bin":
        cure = "state camera: {log: {codes_per_efold: 600, white_code: 2916}}, or what your sensor has"
        yield Finding("response", "bad", "frames of a CeleX-V are logarithmic, and are read as linear", cure)
    found = f"{100 * clipped:.2f} % of the frames' pixels are clipped{'' if white == peak else f' at {white}'}"
    cure = "shorten the exposure, close the aperture" if log is None else "raise white_code of camera.log"
    cure += ", or dim the ambient light"
    yield _finding("saturation", clipped < 1e-3, clipped < 0.02, found, cure)
    share = float(np.median(frames) / peak)
    least = _DARK_DN * (257 if capture.info.camera.mosaic and peak > 255 else 1)  # 8 bits became 16
    dark, at = float((frames <= least).mean()), f"the middle pixel is at {100 * share:.0f} % of the range"
    found = f"{at}; {100 * dark:.0f} % are darker than {least + 1} digital numbers"
    cure = "lengthen the exposure, open the aperture, or bring the wall nearer"
    yield _finding("brightness", dark < 0.05, dark < 0.5, found, cure)
    if capture.info.camera.mosaic is None and (unlike := _unlike_neighbours(frames)) > _MOSAIC:
        found = (
            f"pixels of a 2 x 2 square differ by {100 * unlike:.0f} %, as raw values behind colour filters do"
        )
        cure = "state camera.mosaic in capture.yaml, e.g. rggb; it is left out"
        yield Finding("colour filters", "bad", found, cure)


def _unscaled_bits(capture: Capture) -> int | None:
    """Return 10, 12 or 14 where images of 16 bits, as they lie in their files, hold no more than that."""
    info, frames = capture.info, capture.frames
    changes = info.dark, info.flat, info.registration, info.camera.mosaic, info.camera.white_dn, info.camera.log
    size = (info.camera.height, info.camera.width) if info.roi is None else (info.roi.height, info.roi.width)
    is_raw = Path(info.frames or "").suffix in ("", ".csv", ".npy") and frames.shape[1:] == size
    if frames.dtype != np.uint16 or not is_raw or any(one is not None for one in changes):
        return None
    if np.gcd.reduce(np.unique(frames[0])) > 1:  # of fewer bits, but scaled
        return None
    return next((bits for bits in (10, 12, 14) if 255 < int(frames.max()) < 1 << bits), None)


def _unlike_neighbours(frames: NDArray) -> float:
    """Return by how much the diagonals of squares of 2 x 2 pixels differ over the sensor, share of the mean.

    Behind Bayer filters one is green and the other red and blue; light that grows evenly has the same on both.
    """
    rows, columns = (side // 2 * 2 for side in frames.shape[1:])
    if not rows or not columns:
        return 0.0
    mean = frames[:, :rows, :columns].mean(axis=0, dtype=np.float64)
    (a, b), (c, d) = mean.reshape(rows // 2, 2, columns // 2, 2).mean(axis=(0, 2))
    return float(abs(a + d - b - c) / max(a + b + c + d, 2.0)) * 2


def _movement(capture: Capture) -> Iterator[Finding]:
    """Look at what changes in the frames beyond their noise, and where."""
    frames = capture.frames.astype(np.float32)
    if len(frames) < 5:
        yield Finding("movement", "doubtful", f"{len(frames)} frames tell nothing of a movement", "record more")
        return
    noise = float(np.sqrt(np.mean((frames[2:] - 2 * frames[1:-1] + frames[:-2]) ** 2) / 6))
    height, width = (max(1, round(side / _BLOCK)) for side in frames.shape[1:])
    variance = reduce_by_area(frames.var(axis=0, ddof=1), (height, width))
    # Of noise alone the block's variance is this sure, as a fraction; three times that is no movement.
    sure = np.sqrt(2 / ((len(frames) - 1) * frames[0].size / (height * width)))
    moved = np.sqrt(np.maximum(variance - noise**2 * (1 + 3 * sure), 0.0))
    largest = float(np.quantile(moved, 0.95))
    ratio = largest / max(noise, 1e-6)
    found = f"the wall's light changes by {ratio:.2f} times the frames' noise (1 is safe)"
    cure = "check that the target moved and is lit, dim the ambient light, roughen less"
    yield _finding("movement", ratio > 1.0, ratio > 0.25, found, cure)
    contrast = largest / max(float(np.median(frames)), 1.0)
    found = f"the light that moves is {contrast:.2f} times the wall's own (0.05 is safe)"
    cure = "dim the ambient light, light the target more, take a shinier wall"
    yield _finding("wall contrast", contrast > 0.05, contrast > 0.01, found, cure)
    if ratio <= 0.25:
        return
    v, u = max(1, round(_BORDER * height)), max(1, round(_BORDER * width))
    if height < 3 * v or width < 3 * u:
        return
    inner = moved[v:-v, u:-u]
    edge = np.concatenate([moved[:v].ravel(), moved[-v:].ravel(), moved[:, :u].ravel(), moved[:, -u:].ravel()])
    outside = float(edge.mean() / max(inner.mean(), 1e-6))
    found = f"the border changes {outside:.2f} times as much as the inside (below 0.7 is safe)"
    cure = "turn the camera to where the light moves, or take a wider lens or region"
    yield _finding("region", outside < 0.7, outside < 1.2, found, cure)


def _motion(capture: Capture) -> Iterator[Finding]:
    """Compare the stated path p with the light's z, complex numbers: z = a + k p, and k should have angle 0."""
    try:
        motion = capture.motion
    except DataError as error:
        yield Finding("motion", "bad", str(error), "turn direction round if the target goes back")
        return
    if motion is None or len(capture.frames) < 5:
        return
    stated = motion.position_m(capture.frame_times_us * 1e-6)
    away_m = float(np.hypot(*stated.mean(axis=0)))
    if away_m > _FAR_M:
        found = f"the stated path's middle is {away_m:.2f} m from that of the travel ({_FAR_M:g} m is safe)"
        assert capture.info.motion is not None
        late_us = capture.frame_times_us[0] - capture.info.motion.start_us
        cure = f"mend start_m or start_us of motion: the first frame is {late_us} us after start_us"
        yield Finding("motion", "bad", found, cure)
        return
    z, p = ((one - one.mean(axis=0)) @ [1, 1j] for one in (light_path(capture.frames), stated))
    k = np.vdot(p, z) / max(np.vdot(p, p).real, 1e-12)
    explained = 1 - np.vdot(z - k * p, z - k * p).real / max(np.vdot(z, z).real, 1e-12)
    angle = abs(float(np.degrees(np.angle(k))))
    yield _finding(
        "motion",
        angle < 15 and explained > 0.7,
        angle < 45 and explained > 0.4,
        f"the light's path is {angle:.0f} degrees off the stated direction (15 is safe), which explains "
        f"{100 * max(explained, 0):.0f} % of it (70 % is safe); "
        "speed and start are not checked from one capture",
        "mend direction, start_m and start_us of motion, or leave motion out and let `evnlos track` find it",
    )


def _events(capture: Capture) -> Iterator[Finding]:
    events = capture.events
    span_s = max(float(events.t_us[-1] - events.t_us[0]) * 1e-6, 1e-6)
    pixels = events.width * events.height
    rate = len(events) / span_s / pixels
    found = f"{rate:.2f} events per pixel per second (0.05 to 50 is safe)"
    cure = "raise the thresholds, or look for flicker and a camera that shakes"
    if rate < 0.05:
        cure = "lower the thresholds, dim the ambient light, light the target more, or move it faster"
    yield _finding("event rate", 0.05 <= rate <= 50, 0.01 <= rate <= 200, found, cure)
    on = float(events.p.mean())
    found = f"{100 * on:.0f} % of the events are ON (25 to 75 % is safe)"
    cure = "set both thresholds alike, or calibrate, which fits each; a leak makes ON events alone"
    yield _finding("polarity balance", 0.25 < on < 0.75, 0.01 < on < 0.99, found, cure)
    counts = np.bincount(events.y.astype(np.int64) * events.width + events.x, minlength=pixels)
    silent = float((counts == 0).mean())
    found = f"{100 * silent:.0f} % of the pixels sent nothing (below 50 % is safe)"
    cure = "lower the thresholds; a linear map of so few events shows little"
    yield _finding("silent pixels", silent < 0.5, silent < 0.9, found, cure)
    hot = find_hot_pixels(events)
    share = float(counts.reshape(events.shape)[hot].sum() / len(events))
    found = f"{int(hot.sum())} pixels send {100 * share:.1f} % of the events (2 % is safe)"
    cure = "set filters: {hot_pixel_factor: 10} in capture.yaml"
    yield _finding("hot pixels", share < 0.02, share < 0.2, found, cure)


def _flicker(capture: Capture) -> Iterator[Finding]:
    """Look for a line near twice the mains' frequency in the rate of events, and for events of the lamps."""
    events = capture.events
    line = find_flicker(events) if len(events) >= _FEWEST_EVENTS else None
    if line is None:
        text = f"{len(events)} events are too few or too short to tell"
        yield Finding("flicker", "doubtful", text, "record longer")
        return
    hertz, phase = line.frequency_hz, 2 * np.pi * line.frequency_hz * 1e-6 * (events.t_us - events.t_us[0])
    both = [phase[events.p == kind] for kind in (False, True)]
    depth = max(2 * abs(np.exp(1j * one).mean()) for one in both if len(one))
    found = (
        f"the rate's line at {hertz:.1f} Hz is {line.strength:.0f} times its surroundings "
        f"({line.limit:.0f} is safe) and sways it by {100 * depth:.0f} % ({100 * _WEAK_FLICKER:.0f} % is safe)"
    )
    direct = "light with direct current or daylight: mains lamps flicker"
    if not line.is_there or depth < _WEAK_FLICKER:
        yield Finding("flicker", "good", found)
        return
    own, taken = share_of_lamps(events, hertz)
    own = own if all(map(len, both)) else 1.0  # one polarity does not tell whose events they are
    least = f"{100 * _FEW_OF_LAMPS:.0f} % is safe"
    if own < _FEW_OF_LAMPS:
        step_us = float(np.median(np.diff(capture.frame_times_us)))
        is_short = 4e6 / hertz < step_us
        found = (
            f"lamps at {hertz:.1f} Hz time events and make {100 * own:.1f} % of them ({least}): their ripple "
            f"is below the thresholds. It moves an event by up to {1e3 / hertz:.0f} ms, which no filter mends "
            f"and {'does no harm to' if is_short else 'matters in'} time steps of {1e-3 * step_us:.0f} ms"
        )
        yield _finding("flicker", is_short, True, found, direct)
        return
    stated = capture.info.filters.flicker_hz
    way = (
        f"filters: {{flicker_hz: {hertz:.2f}}} in capture.yaml{'' if stated is None else f', not {stated:g},'}"
    )
    if taken < 0.5 * own:
        way = "the filter flicker_hz, which looks for pixels that turn in each period,"
    is_weak = own < 5 * _FEW_OF_LAMPS or line.strength < 10 * line.limit or depth < 2 * _WEAK_FLICKER
    found += f"; the lamps make {100 * own:.0f} % of the events ({least})"
    yield _finding("flicker", False, is_weak, found, f"{direct}; {way} takes {100 * taken:.0f} % of them away")


def _clock(capture: Capture) -> Iterator[Finding]:
    frames, events = capture.frame_times_us, capture.events.t_us
    both = min(frames[-1], events[-1]) - max(frames[0], events[0])
    share = float(max(both, 0) / max(frames[-1] - frames[0], 1))
    found = f"events cover {100 * share:.0f} % of the frames' time (95 % is safe)"
    cure = "check alignment in capture.yaml: offset_us, auto, or a trigger_channel"
    yield _finding("clock", share > 0.95, share > 0.5, found, cure)
    counts = np.diff(np.searchsorted(events, frames))[(frames[:-1] >= events[0]) & (frames[1:] <= events[-1])]
    usual, holes = float(np.median(counts)) if len(counts) else 0.0, int((counts == 0).sum())
    if holes and usual >= _USUAL_EVENTS:
        found = f"no event between {holes} pairs of frames, where {usual:.0f} are usual"
        cure = "packets were lost: record again, with a quicker disk or port, or fewer events"
        yield _finding("holes", False, holes < _FEW_HOLES * len(counts), found, cure)


def _frame_times(capture: Capture) -> Iterator[Finding]:
    steps = np.diff(capture.frame_times_us)
    uneven = float(np.abs(steps - np.median(steps)).max() / max(float(np.median(steps)), 1.0))
    found = f"the most uneven step is off by {100 * uneven:.0f} % (20 % is safe)"
    cure = "frames were dropped or the rate changed; a position is as long as its step"
    yield _finding("frame times", uneven < 0.2, True, found, cure)
    if again := sum(bool((one == before).all()) for before, one in itertools.pairwise(capture.frames)):
        found = f"{again} of {len(capture.frames)} frames are the one before again"
        cure = "leave repeated frames out, or record at the rate that the camera really has"
        yield Finding("repeated frames", "bad", found, cure)


def clock_offset(capture: Capture) -> Iterator[Finding]:
    """Compare the course of the light in the frames with the events: offset, and order of the frames.

    Args:
        capture: A capture with frames and events; where they tell nothing of each other there is no finding.
    """
    lag = find_lag(capture.events, capture.frames, capture.frame_times_us)
    if lag is None:
        return
    if not lag.told or abs(lag.lag_us) > lag.unsure_us:
        least = max(_CLEARLY * lag.agreement, lag.backwards, LEAST_AGREEMENT)
        for other, cure in _other_pixels(capture.events):
            seen = find_lag(other, capture.frames, capture.frame_times_us)
            if seen is not None and seen.agreement > least:
                found = f"events would fit better so: correlation {seen.agreement:.2f}, not {lag.agreement:.2f}"
                yield Finding("pixels", "bad", found, cure)
                return
    if lag.reversed:
        found = f"the events fit the frames in reversed order: correlation {lag.backwards:.2f}, forwards "
        cure = "put the frames' files into the order in which they were taken"
        yield Finding("clock offset", "bad", f"{found}{lag.agreement:.2f}", cure)
        return
    blink = "record a blink of the light, or a trigger_channel"
    if not lag.told:
        found = (
            f"frames and events share too little to tell: correlation {lag.agreement:.2f} "
            f"({LEAST_AGREEMENT:g} is needed), frames reversed {lag.backwards:.2f}"
        )
        yield Finding("clock offset", "doubtful", found, blink)
        return
    if capture.info.dark is None:
        blink = f"a black level of the frames makes some of it: give a dark frame (dark); {blink}"
    way, told = "late" if lag.lag_us < 0 else "early", abs(lag.lag_us) > lag.unsure_us + _ALONE_US
    usual, most = (1e-6 * one for one in (lag.limit_us, lag.unsure_us + _ALONE_US))
    finding = _finding(
        "clock offset",
        abs(lag.lag_us) <= lag.limit_us,
        not told,
        f"the frames' times are {abs(lag.lag_us) * 1e-6:.2f} s too {way} for the events (up to "
        f"{usual:.2f} s is usual, up to {most:.2f} s cannot be told from what pixels do by themselves)",
        _offset_cure(capture.info, lag.lag_us) if told else f"to be sure, {blink}",
    )
    yield replace(finding, lag_us=lag.lag_us)


def _other_pixels(events: Events) -> Iterator[tuple[Events, str]]:
    """Yield the events as they were with other polarities or pixels, and how to mend that."""
    flip, (x, y) = "of events or frames: both see one wall", (events.x, events.y)
    yield replace(events, p=~events.p), "exchange ON and OFF of the events' file"
    yield replace(events, x=(events.width - 1 - x).astype(x.dtype)), f"exchange left and right {flip}"
    yield replace(events, y=(events.height - 1 - y).astype(y.dtype)), f"exchange top and bottom {flip}"


def compare_clocks(
    found: Mapping[str, list[Finding]], infos: Mapping[str, CaptureInfo]
) -> dict[str, list[Finding]]:
    """Return the findings with the clock offset that a capture has alone among those of its camera.

    A capture by itself cannot tell a tenth of a second from what its pixels do. Beside others, whose pixels do
    the same, it can.

    Args:
        found: Findings of each capture, by name.
        infos: What is known about each capture.
    """
    alike, out = defaultdict[Any, list[str]](list), dict(found)
    lags = {name: one.lag_us for name, several in found.items() for one in several if one.lag_us is not None}
    for name in lags:
        motion = infos[name].motion
        alike[infos[name].camera, motion and motion.speed_m_s].append(name)
    for names in alike.values():
        if len(names) < FEWEST_LAGS:
            continue
        away, usual = beside_others([lags[name] for name in names])
        for name, one in zip(names, away.tolist(), strict=True):
            if abs(one) > usual:
                way, sure = "late" if one < 0 else "early", abs(one) > _SURELY * usual
                alone = Finding(
                    "clock offset",
                    "bad" if sure else "doubtful",
                    f"the frames' times are {abs(one) * 1e-6:.2f} s too {way} beside those of "
                    f"{len(names) - 1} other captures by this camera ({usual * 1e-6:.2f} s is usual)",
                    _offset_cure(infos[name], round(one)),
                    lags[name],
                )
                out[name] = [alone if other.lag_us is not None else other for other in found[name]]
    return out


def _offset_cure(info: CaptureInfo, lag_us: int) -> str:
    stated = info.alignment.offset_us
    if stated == "auto":
        return f"auto went astray: state offset_us in capture.yaml, what auto found {lag_us:+d}"
    return f"state alignment: {{offset_us: {stated + lag_us}}} in capture.yaml, or wire a trigger_channel"
