"""Pseudo-real captures: shots that the paper's simulator did not make, for people without a camera."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from evnlos.config import save_yaml
from evnlos.dataset.simulate import SensorSize
from evnlos.errors import DataError
from evnlos.events import write_events
from evnlos.scene import FontGlyphs, LineMotion, Scene
from evnlos.seeds import derive_seed
from evnlos.sensor import EventCamera, EventPixel, FrameCamera
from evnlos.transport import RadiometricTransport


@dataclass(frozen=True)
class Lab:
    """A rendered laboratory: rough aluminium instead of a tPSF, and another camera than the simulator's."""

    glyphs: FontGlyphs = field(default_factory=FontGlyphs)
    """What is hidden."""
    motion: LineMotion = field(default_factory=LineMotion)
    """How it moves."""
    duration_s: float = 8.0
    """Length of a pass, seconds."""
    frame_rate_hz: float = 5.0
    """Frames a second, hertz; a pass of 8 s has the 40 positions of the paper."""
    transport: RadiometricTransport = field(
        default_factory=lambda: RadiometricTransport(gain=0.7, ambient=0.06, ambient_gradient=(0.3, -0.2))
    )
    """The rig."""
    sensor: SensorSize = field(default_factory=SensorSize)
    """Size of the sensor."""
    frame_camera: FrameCamera = field(
        default_factory=lambda: FrameCamera(exposure_s=0.016, full_well_e=9000.0, read_noise_e=12.0)
    )
    """The frame camera; 8-bit, as captures are."""
    pixel: EventPixel = field(
        default_factory=lambda: EventPixel(
            threshold_on=0.21,
            threshold_off=0.24,
            threshold_sigma=0.04,
            cutoff_hz=40.0,
            leak_rate_hz=0.05,
            shot_noise_rate_hz=0.08,
            refractory_s=0.0005,
        )
    )
    """The event pixel: on purpose not that of the training simulator."""
    seed: int = 0
    """Seed of every draw."""


def render_captures(lab: Lab, out: str | Path, names: list[str] | None = None) -> Iterator[Path]:
    """Render one capture folder an object, yielding each as it is done.

    A folder that exists is done and is kept, so that a run can be taken up again.

    Args:
        lab: Rig, cameras and objects.
        out: The folder for the captures.
        names: Objects of `lab.glyphs`; all by default.

    Raises:
        DataError: `out` is a file.
    """
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise DataError(f"{out} is a file; give a folder for the captures")
    out.mkdir(parents=True, exist_ok=True)
    for name in names if names is not None else lab.glyphs.objects():
        folder = out / f"lab_{name.rsplit('_', 1)[-1]}"
        if not folder.is_dir():
            _render(lab, name, folder)
        yield folder


def _render(lab: Lab, name: str, folder: Path) -> None:
    """Render into a temporary folder, then rename: a capture is there whole or not at all."""
    target = lab.glyphs.target(name, lab.seed)
    scene = Scene(target, lab.motion, lab.duration_s)
    shape = (lab.sensor.height, lab.sensor.width)
    wall = lab.transport.wall(scene, shape)
    times_s = np.arange(round(lab.duration_s * lab.frame_rate_hz) + 1) / lab.frame_rate_hz
    seed = derive_seed(lab.seed, name)
    events = EventCamera(lab.pixel).record(wall, 0.0, lab.duration_s, seed=derive_seed(seed, "events"))
    frames = lab.frame_camera.capture(wall, times_s, seed=derive_seed(seed, "frames"))

    draft = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(draft, ignore_errors=True)
    (draft / "frames").mkdir(parents=True)
    write_events(draft / "events.raw", events)
    rows = ["t_us,file"]
    for k, (time_s, frame) in enumerate(zip(times_s, frames, strict=True)):
        Image.fromarray(frame).save(draft / f"frames/{k:04d}.png")
        rows.append(f"{round(time_s * 1e6)},frames/{k:04d}.png")
    (draft / "frames.csv").write_text("\n".join(rows) + "\n")
    Image.fromarray(np.round(target.mask * 255).astype(np.uint8)).save(draft / "target.png")
    save_yaml(_description(lab, folder.name, target.size_m), draft / "capture.yaml")
    draft.rename(folder)


def _description(lab: Lab, name: str, plate_m: float) -> dict:
    rig = lab.transport
    return {
        "camera": {
            "name": "rendered laboratory",
            "width": lab.sensor.width,
            "height": lab.sensor.height,
            "frame_rate_hz": lab.frame_rate_hz,
            "exposure_s": lab.frame_camera.exposure_s,
        },
        "events": "events.raw",
        "frames": "frames.csv",
        "target": {"name": name.rsplit("_", 1)[-1], "mask": "target.png", "plate_m": plate_m},
        "motion": {
            "start_m": list(lab.motion.start_m),
            "speed_m_s": lab.motion.speed_m_s,
            "direction": list(lab.motion.direction),
            "start_us": round(lab.motion.start_s * 1e6),
        },
        "rig": {
            "distance_m": rig.distance_m,
            "wall": f"rendered, {rig.wall_material}, roughness {rig.roughness}",
            "ambient": f"{rig.ambient} of the white level",
        },
    }
