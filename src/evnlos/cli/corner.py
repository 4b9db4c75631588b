"""`evnlos corner`: a video of the floor in, who moves behind the corner out; or one is filmed."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from evnlos.cameras.video import Tone, Video, open_video
from evnlos.cli.parsing import check_files, drawn, refuse_existing, say
from evnlos.cli.recordings import Flat, Force, result
from evnlos.errors import ConfigError, DataError
from evnlos.files import write_atomically
from evnlos.inverse import CornerImage, FloorSector, Penumbra
from evnlos.machine import ProgressBars, counted
from evnlos.tracking import UNSURE_NOISE, BearingTracking, BearingTracks
from evnlos.types import OutFolder
from evnlos.untrusted import open_regular

_DISTURBED, _SHAKE_PX, _NOISE, _GAIN = 0.02, 0.3, 3.0, 0.01  # beyond these a warning is due


@dataclass(frozen=True)
class FilmOptions:
    """The corner that --simulate films."""

    contrast: float = 0.01
    """Largest change of the floor's light by the people, fraction of the steady light."""
    people: Literal[0, 1, 2] = 1
    """How many people walk behind the corner."""
    seconds: float = 20.0
    """Length of the video, 2 to 600 seconds; people walk during the first 19."""
    fps: float = 15.0
    """Frames per second, 1 to 240."""
    size: tuple[int, int] = (320, 240)
    """Width and height, pixels."""
    texture: float = 0.15
    """Standard deviation of the floor's reflectance, fraction."""
    drift: float = 0.0
    """Swing of the exposure's gain, fraction."""
    shake_px: float = 0.0
    """Standard deviation of the camera's shake, pixels."""
    full_well_e: float = 15_000.0
    """Electrons of a pixel at white: less is more noise."""
    quality: int | None = None
    """CRF of H.264, 1 to 51, as phones compress; by default without loss."""
    seed: int = 0
    """Seed of texture, shake and noise."""

    def write(self, out: Path, tone: Tone, quiet: bool) -> dict[str, Any]:
        """Film the corner; return what `evnlos corner` asks for, and the truth."""
        from evnlos.cameras import FrameCamera
        from evnlos.cameras.video import film
        from evnlos.cameras.video_files import write_video
        from evnlos.optics import ONE_WALKER, TWO_WALKERS, CornerFloor, CornerScene

        if not (2 <= self.seconds <= 600 and 1 <= self.fps <= 240):
            raise ConfigError(f"{self.seconds:g} s at {self.fps:g} fps; give 2 to 600 s at 1 to 240 fps")
        scene = CornerScene(
            walkers=((), ONE_WALKER, TWO_WALKERS)[self.people], contrast=self.contrast, size=self.size,
            texture=self.texture, drift=self.drift, shake_px=self.shake_px, seed=self.seed,
        )  # fmt: skip
        floor = CornerFloor(scene)
        camera = FrameCamera(0.0, self.full_well_e, bit_depth=8 if tone == "as-is" else 12)
        times = np.arange(round(self.seconds * self.fps)) / self.fps
        shots = film(floor, camera, times.tolist(), tone, self.seed)
        with ProgressBars(quiet) as progress:
            write_video(out, counted(shots, progress, f"film {out.name}", len(times)), self.fps, self.quality)
        bearings = [[None if np.isnan(v) else round(v, 3) for v in row] for row in scene.bearings_deg(times)]
        about = {"hidden_from_deg": round(scene.hidden_from_deg(), 2), "contrast": self.contrast}
        return floor.marks() | about | {"times_s": times.round(6).tolist(), "bearings_deg": bearings}


@dataclass(frozen=True)
class CornerCommand:
    """See who moves behind a corner in an ordinary video of the floor: bearings over time, as a figure.

    The video shows the foot of a wall's edge, such as a door frame's, and the floor around it, from a tripod
    with the exposure locked. EDGE, WALL and END span the sector of the floor that looks past the edge.
    """

    video: Annotated[Path, tyro.conf.Positional]
    """Video file, GIF, folder of images or .npy; with --simulate the file to write (.mp4, .mkv, .gif or a
    folder)."""
    edge: tuple[float, float] | None = None
    """Foot of the wall's edge: column and row, pixels."""
    wall: tuple[float, float] | None = None
    """Another point of the line in which that wall meets the floor: column and row, pixels. Bearings count from
    this line."""
    end: tuple[float, float] | None = None
    """A point of the floor on the last bearing that is used: column and row, pixels. The farther of wall and
    end says how far from the edge the floor is used."""
    floor: tuple[float, float, float, float, float, float, float, float] | None = None
    """Corners of a rectangle that lies on the floor (a tile), one after the other: column and row of each,
    pixels. Without it bearings are those of the image, right at the wall's line and off elsewhere."""
    floor_size: tuple[float, float] = (1.0, 1.0)
    """Sides of that rectangle, first to second corner and second to third, any unit: their ratio counts."""
    out: OutFolder = Path("corner")
    """Folder for result.png, summary.json and corner.npz."""
    start: float = 0.0
    """Begin, seconds."""
    stop: float | None = None
    """End, seconds; by default the video's."""
    fps: float | None = None
    """Frames per second; needed for images and arrays, otherwise in place of the times in the file."""
    tone: Tone = "srgb"
    """Curve of the video's numbers that is undone: srgb, rec709, or as-is where they are light already."""
    step: float = 0.1
    """Time over which frames are averaged, 0.01 to 10 seconds."""
    bin_deg: float = 1.0
    """Width of a cell of bearing, 0.25 to 10 degrees."""
    tracking: Flat[BearingTracking] = field(default_factory=BearingTracking)
    truth: Path | None = None
    """File with the true bearings, as --simulate writes it: they are drawn, and errors printed."""
    simulate: bool = False
    """Film a simulated corner instead, with its truth beside it, and print the command that looks at it."""
    scene: FilmOptions = field(default_factory=FilmOptions)
    """simulate: what is filmed."""
    force: Force = False
    json: bool = False
    """Print one JSON object."""

    def check_names(self) -> None:
        """Refuse a video that is not there."""
        if not self.simulate:
            check_files(self.video)

    def run(self) -> None:
        """Look past the corner, or film one."""
        if self.simulate:
            self._film()
            return
        from evnlos.inverse import estimate_corner, read_penumbra
        from evnlos.plot.setup import draw_corner
        from evnlos.tracking import track_bearings

        sector = self._sector()
        refuse_existing(self.force, *(self.out / name for name in ("result.png", "summary.json", "corner.npz")))
        video = self._video()
        box, index, bearings = sector.pixels((video.height, video.width))
        truth = None if self.truth is None else _true_bearings(self.truth)
        with ProgressBars() as progress:
            frames = self._part(
                counted(video.part(box), progress, f"read {video.path.name}", video.frames or 0)
            )
            penumbra = read_penumbra(frames, index, bearings, step_s=self.step, bin_deg=self.bin_deg)
        steps = f"{len(penumbra.times_s)} steps of {penumbra.step_s:.3g} s"
        say(f"note: {penumbra.frames} frames read; people are searched for in {steps}")
        tracks = track_bearings(penumbra, self.tracking)
        picture = estimate_corner(replace(penumbra, variance=tracks.variance))
        words = in_words(tracks, picture, penumbra, sector)
        errors: list[dict[str, float]] = []
        found = _values(self, penumbra, picture, tracks) | {"in_words": words}
        true = None
        if truth is not None:
            true = np.array([np.interp(penumbra.times_s, truth[0], row) for row in truth[1]])
            errors = found["errors_deg"] = _errors(tracks, true)
        found["warnings"] = warnings_of(penumbra, tracks)
        still = next(light for time_s, light in video if time_s >= self.start)
        shown = self.out / "result.png"
        found["picture"] = drawn(
            shown, lambda: draw_corner(shown, picture, tracks, still, sector, words[0], true)
        )
        write_atomically(self.out / "corner.npz", _arrays(penumbra, picture, tracks))
        write_atomically(self.out / "summary.json", json.dumps(found, indent=1).encode())
        for warning in found["warnings"]:
            say(f"warning: {warning}")
        misses = [
            f"person {k + 1}: {one['rms']:.2f} degrees rms off the truth, "
            f"{100 * one['within_90']:.0f} % of it within the 90 % intervals"
            for k, one in enumerate(errors)
        ]
        where = f"{self.out}: summary.json, corner.npz" + (", result.png" if found["picture"] else "")
        result(self.json, found, "\n".join([where, *misses, *words[1:], words[0]]))

    def _film(self) -> None:
        about = self.video.with_suffix(".json") if self.video.suffix else Path(f"{self.video}.json")
        refuse_existing(self.force, self.video, about)
        made = self.scene.write(self.video, self.tone, self.json)
        write_atomically(about, json.dumps(made).encode())
        words = [f"evnlos corner {self.video}"]
        words += [
            f"--{name} " + " ".join(f"{v:g}" for v in made[name]) for name in ("edge", "wall", "end", "floor")
        ]
        words.append(f"--truth {about}")
        if not self.video.suffix:
            words.append(f"--fps {self.scene.fps:g}")
        if self.tone != "srgb":
            words.append(f"--tone {self.tone}")
        values = {"video": str(self.video), "truth": str(about), "command": " ".join(words)}
        result(self.json, values, f"{self.video}, its truth in {about}; look at it with\n{' '.join(words)}")

    def _video(self) -> Video:
        if not 0.01 <= self.step <= 10:
            raise ConfigError(f"--step is {self.step:g}; give 0.01 to 10 seconds")
        if not 0.25 <= self.bin_deg <= 10:
            raise ConfigError(f"--bin-deg is {self.bin_deg:g}; give 0.25 to 10 degrees")
        if self.stop is not None and not self.start < self.stop:
            raise ConfigError(f"--stop is {self.stop:g} s, --start {self.start:g} s; give a later stop")
        return open_video(self.video, fps=self.fps, tone=self.tone)

    def _part(self, frames: Iterable[tuple[float, NDArray]]) -> Iterator[tuple[float, NDArray]]:
        """Yield the frames between start and stop."""
        for time_s, light in frames:
            if self.stop is not None and time_s > self.stop:
                return
            if time_s >= self.start:
                yield time_s, light

    def _sector(self) -> FloorSector:
        if self.edge is None or self.wall is None or self.end is None:
            lacks = ", ".join(
                f"--{name} X Y" for name in ("edge", "wall", "end") if getattr(self, name) is None
            )
            raise ConfigError(
                f"no {lacks}; give the pixels of the foot of the edge, of another point of the wall's foot, "
                "and of the floor's far side, as a viewer of images shows them"
            )
        ground = None
        if self.floor is not None:
            from evnlos.data.frames import homography_from_points

            across, along = self.floor_size
            if not (across > 0 and along > 0):
                raise ConfigError(f"--floor-size is {across:g} {along:g}; give two sides above 0")
            corners = np.array(self.floor).reshape(4, 2)
            matrix = homography_from_points(corners, [(0, 0), (across, 0), (across, along), (0, along)])
            ground = tuple(tuple(float(v) for v in row) for row in matrix)
        return FloorSector(self.edge, self.wall, self.end, ground)


def in_words(tracks: BearingTracks, picture: CornerImage, penumbra: Penumbra, sector: FloorSector) -> list[str]:
    """Return what is seen, first in one sentence, then what it rests on."""
    rate = f"{100 * tracks.false_alarms:g} %"
    if tracks.tracks:
        count = len(tracks.tracks)
        who = "One moving person is" if count == 1 else f"{count} moving people are"
        parts = []
        for k, track in enumerate(tracks.tracks):
            seen = track.bearing_deg[track.there]
            times = penumbra.times_s[track.there]
            if not len(seen):
                continue
            span = f"{seen[0]:.0f} to {seen[-1]:.0f}, between {seen.min():.0f} and {seen.max():.0f} degrees"
            name = "the bearing" if count == 1 else f"that of person {k + 1}"
            parts.append(f"{name} goes from {span}, {times[0]:.1f} to {times[-1]:.1f} s")
        first = f"{who} seen behind the corner (false alarms: at most {rate}); {'; '.join(parts)}."
        best = tracks.tracks[0]
        finite = picture.resolution_deg[np.isfinite(picture.resolution_deg)]
        width = f"{np.median(finite):.0f} degrees" if len(finite) else "unknown"
        rest = [
            f"In a step of {penumbra.step_s:.2g} s the clearest one stands {best.step_sigma:.1f} standard "
            f"deviations over the noise, {100 * best.typical:.2g} % of the floor's light; a thin bright strip "
            f"would look {width} wide."
        ]
    else:
        first = f"No moving thing is seen behind the corner (false alarms: at most {rate})."
        rest = [
            "A person who walks across the sector and changes the floor's light by "
            f"{100 * tracks.limit:.2g} % would have been seen in nine of ten such videos; who stands still is "
            "not seen."
        ]
    if tracks.noise_factor > UNSURE_NOISE:
        first = f"Doubtful, as the video's noise is that of compression or unsteady light: {first}"
    if sector.to_ground is None:
        rest.append("Bearings are those of the image, not of the floor: --floor makes them true.")
    return [first, *rest]


def warnings_of(penumbra: Penumbra, tracks: BearingTracks) -> list[str]:
    """Return what may spoil the result, each with its cure."""
    found = []
    if penumbra.disturbed > _DISTURBED:
        found.append(
            f"in {100 * penumbra.disturbed:.0f} % of the frames something moves on the floor itself, or casts "
            "a shadow on it; these are left out: keep this side of the corner empty"
        )
    shake = np.sqrt(np.nanmean(np.nanvar(penumbra.shift_px, axis=0))) if penumbra.shift_known else 0.0
    if shake > _SHAKE_PX:
        found.append(
            f"the image shakes by {shake:.2f} px rms; it is corrected roughly: put the camera on a tripod"
        )
    if tracks.noise_factor > _NOISE:
        found.append(
            f"the noise has {tracks.noise_factor:.1f} times the variance of independent pixels (compression, "
            "lamps that flicker, shake); record with a higher bit rate"
        )
    if (gain := float(np.nanstd(penumbra.gain))) > _GAIN:
        found.append(f"the exposure varies by {100 * gain:.1f} %; it is taken off, but lock it in the camera")
    return found


def _values(
    command: CornerCommand, penumbra: Penumbra, picture: CornerImage, tracks: BearingTracks
) -> dict[str, Any]:
    return {
        "video": str(command.video),
        "frames": penumbra.frames,
        "steps": len(penumbra.times_s),
        "step_s": penumbra.step_s,
        "bearings_deg": [float(penumbra.edges_deg[0]), float(penumbra.edges_deg[-1])],
        "floor_level": round(penumbra.level, 4),
        "noise_factor": round(tracks.noise_factor, 3),
        "doubtful": tracks.noise_factor > UNSURE_NOISE,
        "gain_deviation": float(np.nanstd(penumbra.gain)),
        "disturbed": penumbra.disturbed,
        "prior": picture.prior._asdict(),
        "evidence": picture.evidence,
        "false_alarms": tracks.false_alarms,
        "limit": None if np.isnan(tracks.limit) else tracks.limit,
        "tracks": [track.summary() for track in tracks.tracks],
        "times_s": penumbra.times_s.round(6).tolist(),
    }


def _arrays(penumbra: Penumbra, picture: CornerImage, tracks: BearingTracks) -> bytes:
    """Return the numbers behind the figure as an NPZ file."""
    buffer = io.BytesIO()
    columns = {"bearing_deg": [], "deviation_deg": [], "presence": [], "brightness": []}
    for track in tracks.tracks:
        for name, rows in columns.items():
            rows.append(getattr(track, name))
    shape = (len(tracks.tracks), len(penumbra.times_s))
    arrays: dict[str, Any] = dict(
        times_s=penumbra.times_s,
        edges_deg=penumbra.edges_deg,
        change=penumbra.change,
        variance=penumbra.variance,
        gain=penumbra.gain,
        shift_px=penumbra.shift_px,
        picture=picture.mean,
        image_deviation=picture.deviation,
        resolution_deg=picture.resolution_deg,
        **{f"track_{name}": np.array(rows).reshape(shape) for name, rows in columns.items()},
    )
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def _true_bearings(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times [F] and bearings [walkers, F] of a file that --simulate wrote."""
    try:
        with open_regular(path) as file:
            told = json.load(file)
        times = np.array(told["times_s"], np.float64)
        rows = [[np.nan if v is None else float(v) for v in row] for row in told["bearings_deg"]]
        return times, np.array(rows, np.float64).reshape(len(rows), len(times))
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(
            f"{path}: no file of true bearings ({error}); give the one that --simulate wrote"
        ) from None


def _errors(tracks: BearingTracks, truth: NDArray[np.float64]) -> list[dict[str, float]]:
    """Return the errors of each track against the nearest true one, degrees."""
    found = []
    for track in tracks.tracks:
        off = track.bearing_deg - truth  # [walkers, T]
        if not np.isfinite(off).any():
            continue
        usual = [np.nanmedian(np.abs(row)) if np.isfinite(row).any() else np.inf for row in off]
        row = off[int(np.argmin(usual))]
        known = np.isfinite(row)
        within = np.abs(row[known]) <= 1.645 * track.deviation_deg[known]
        found.append({"rms": float(np.sqrt(np.mean(row[known] ** 2))), "within_90": float(within.mean())})
    return found
