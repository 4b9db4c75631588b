"""`evnlos track`: a capture in, the path and the speed of the hidden object out."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from evnlos.cli.console import Flat
from evnlos.cli.notes import say
from evnlos.files import write_atomically
from evnlos.tracking import Tracking

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from evnlos.dataset import Capture
    from evnlos.tracking import Track


@dataclass(frozen=True)
class TrackCommand:
    """Follow the hidden object of a capture: position, speed and direction over time, with errors."""

    capture: Annotated[Path, tyro.conf.Positional]
    """Capture folder; what it says of the motion serves for comparison only."""
    setup: Path | None = None
    """Setup of the capture (a file, or the folder that `evnlos calibrate` wrote): positions in metres; without
    it they are in image pixels."""
    pattern: Path | None = None
    """The camera's fixed pattern, to be removed; a file, or the folder of its calibrated rig."""
    out: Path = Path("track.png")
    """The picture; the numbers go to the same name with .json."""
    json: bool = False
    """Print one JSON object."""
    settings: Flat[Tracking] = field(default_factory=Tracking)

    def run(self) -> None:
        """Follow, print, write the picture."""
        from evnlos.cli.invert_pass import linear_setup
        from evnlos.dataset import load_pattern, read_capture
        from evnlos.plot.track import draw_track
        from evnlos.tracking import track_capture, track_doubts

        capture = read_capture(self.capture)
        setup = None if self.setup is None else linear_setup(self.setup)
        pattern = None if self.pattern is None else load_pattern(self.pattern)
        track = track_capture(capture, setup, self.settings, pattern)
        truth = true_path(capture, track.time_s) if track.unit == "m" else None
        found = figures(capture, track, truth)
        found["warnings"] = track_doubts(capture, setup, track)
        found["picture"] = str(draw_track(track, self.out, truth, capture.name))
        text = json.dumps({**found, "track": track.summary()})
        write_atomically(self.out.with_suffix(".json"), text.encode())
        print(json.dumps(found) if self.json else to_text(found))
        for doubt in found["warnings"]:
            say(f"warning: {doubt}")


def true_path(capture: Capture, t_s: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the middle of the target's light, [T, 2], metres; None where target or motion is unknown."""
    scene = capture.scene
    if scene is None:
        return None
    mask = scene.target.mask.astype(np.float64)
    along = ((np.arange(len(mask)) + 0.5) / len(mask) - 0.5) * scene.target.size_m
    middle = np.array([mask.sum(axis=0) @ along, mask.sum(axis=1) @ along]) / mask.sum()
    return scene.motion.position_m(t_s) + middle


def figures(capture: Capture, track: Track, truth: NDArray[np.float64] | None) -> dict[str, Any]:
    """Return what the command prints: means, and errors where the truth is known."""
    step = track.position[-1] - track.position[0]
    found: dict[str, Any] = {
        "capture": capture.name,
        "unit": track.unit,
        "frames": len(track.frame_time_s),
        "event_windows": track.event_windows,
        "travel": float(np.hypot(*step)),
        "direction_deg": float(np.degrees(np.arctan2(step[1], step[0]))),
        "mean_speed": float(track.speed.mean()),
        "position_sigma": float(track.position_sigma.mean()),
        "speed_sigma": float(track.speed_sigma.mean()),
        "size_change": float(track.size[-1] / track.size[0]),
    }
    if track.misfit is not None:
        found["misfit"] = track.misfit
    if track.distance is not None:
        away = track.distance
        found["distance"] = [float(away.distance_m[0]), float(away.distance_m[-1])]
        found["distance_sigma"] = float(away.distance_sigma.mean())
        found["retreat"] = float((away.distance_m[-1] - away.distance_m[0]) / np.ptp(away.time_s))
        found["distance_spread"] = float(away.distance_m.std())
    if truth is not None:
        error = track.position - truth
        rate = np.gradient(truth, track.time_s, axis=0)
        speed = np.hypot(rate[:, 0], rate[:, 1])
        found["position_offset"] = error.mean(axis=0).tolist()
        found["position_error"] = float(np.sqrt(np.square(error - error.mean(axis=0)).sum(axis=1).mean()))
        found["speed_error_percent"] = float(
            100 * np.sqrt(np.mean(np.square(track.speed - speed))) / np.sqrt(np.mean(np.square(speed)))
        )
    return found


def to_text(found: dict[str, Any]) -> str:
    """Return the figures as lines for people."""
    scale, unit = (1000.0, "mm") if found["unit"] == "m" else (1.0, "px")
    lines = [
        f"{found['capture']}: {found['frames']} frames, {found['event_windows']} windows of events",
        f"travel      {scale * found['travel']:8.2f} {unit}, direction {found['direction_deg']:.1f} deg"
        + ("" if unit == "mm" else "; image pixels: give --setup for metres"),
        f"mean speed  {scale * found['mean_speed']:8.3f} {unit}/s, "
        f"+- {scale * found['speed_sigma']:.3f} at an instant",
        f"position    {scale * found['position_sigma']:8.3f} {unit} standard deviation"
        + (" by the noise; the rig's own errors come on top" if unit == "mm" else ""),
        f"size        {found['size_change']:8.3f} at the end over the start",
    ]
    if "misfit" in found:
        lines.append(
            f"misfit      {found['misfit']:8.2f} times the noise is left in the frames by plate and rig"
        )
    if "distance" in found:
        first, last = (scale * v for v in found["distance"])
        lines.append(
            f"distance    {first:8.2f} {unit} at the start, {last:.2f} {unit} at the end, "
            f"+- {scale * found['distance_sigma']:.2f} {unit}; "
            f"{scale * found['distance_spread']:.2f} {unit} rms about its mean, which is the rig's"
        )
    if "position_error" in found:
        x, y = (scale * v for v in found["position_offset"])
        lines.append(
            f"error       {scale * found['position_error']:8.3f} {unit} rms about an offset of "
            f"({x:.2f}, {y:.2f}) {unit}; speed {found['speed_error_percent']:.2f} % rms"
        )
    return "\n".join([*lines, found["picture"]])
