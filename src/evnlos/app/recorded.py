"""One pass as the cameras saw it, whether it was simulated a moment ago or uploaded."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from evnlos.app.controls import Controls
from evnlos.dataset import Samples, Sampling, Simulation, make_samples
from evnlos.dataset.sampling import edges_from
from evnlos.scene import Motion, Scene, Target
from evnlos.seeds import derive_seed
from evnlos.sensor import EventCamera, FrameCamera
from evnlos.types import Events

_TOLERANCE = 0.03  # thresholds: the eye sees no difference to the default, which takes longer


@dataclass(frozen=True, eq=False)
class Recorded:
    """One pass: events, the instants of its positions, and what else is known.

    Args:
        name: What to call it.
        events: Its events.
        edges_us: N + 1 ascending instants, int64, microseconds; position k has the events in
            (edge k, edge k + 1].
        frames: One frame a position, digital numbers, [N, H, W]; None where there were no frames.
        peak: Largest digital number of a frame.
        motion: The hidden object's motion on the events' clock; None where it is unknown.
        target: The hidden object; None where it is unknown.
        simulation: The rig, where it is known.
        distance_m: From hidden object to wall, metres, where it is noted.
        notes: What reading did, a line each.
    """

    name: str
    events: Events
    edges_us: NDArray[np.int64]
    frames: NDArray | None = None
    peak: int = 255
    motion: Motion | None = None
    target: Target | None = None
    simulation: Simulation | None = None
    distance_m: float | None = None
    notes: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.edges_us) - 1

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Instant of each position, [N], seconds."""
        return self.edges_us[1:].astype(np.float64) * 1e-6

    def samples(self, sampling: Sampling) -> Samples:
        """Return what a network sees at each position; frames are black where there are none."""
        blank = np.zeros((len(self), *self.events.shape), np.uint8) if self.frames is None else self.frames
        return make_samples(
            blank, self.peak, self.events, self.edges_us, sampling, motion=self.motion, target=self.target
        )

    def truth(self, sampling: Sampling) -> NDArray[np.float32] | None:
        """Return the hidden object on a canvas's scored rows, float32 [N, h, w], 0..1; None where unknown."""
        if self.motion is None or self.target is None:
            return None
        places = self.motion.position_m(self.times_s)
        return self.target.rasterise(sampling.canvas, places)[:, sampling.scored]


def simulate_pass(controls: Controls, target: Target) -> Recorded:
    """Simulate one pass of a hidden object.

    Args:
        controls: Rig and camera.
        target: What is hidden.

    Raises:
        ConfigError: The rig can't be, or the camera gets no light.
    """
    simulation = controls.simulation()
    scene = Scene(target, simulation.motion, simulation.duration_s)
    wall = simulation.setup.observe(scene)
    times_s = scene.position_times_s(simulation.positions)
    camera: FrameCamera = simulation.frame_camera
    events = EventCamera(simulation.pixel, _TOLERANCE, simulation.setup.time_step_s).record(
        wall, 0.0, simulation.duration_s, seed=derive_seed(controls.seed, "events")
    )
    frames = camera.capture(wall, times_s, seed=derive_seed(controls.seed, "frames"))
    edges_us = edges_from(times_s)
    return Recorded(target.name, events, edges_us, frames, camera.white, scene.motion, target, simulation)
