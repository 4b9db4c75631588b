"""A track: where the hidden object was at any time of a recording, how fast it went, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError


@dataclass(frozen=True, eq=False)
class Distance:
    """How far the object was from the wall, smoothed.

    Its mean is that of the rig, which no pass tells: a plate that is nearer and one that is larger look alike.

    Args:
        time_s: Instants of the frames, [N], seconds.
        distance_m: Distance, [N], metres.
        distance_sigma: Its standard deviation, [N], metres.
        retreat_m_s: Speed away from the wall, [N], metres a second; below 0 the object approaches.
        retreat_sigma: Its standard deviation, [N].
    """

    time_s: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    distance_sigma: NDArray[np.float64]
    retreat_m_s: NDArray[np.float64]
    retreat_sigma: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Track:
    """Position and velocity over time, from a smoother, with their standard deviations.

    The position is that of the middle of the object's light; which point of the plate that is, only the
    object's shape could tell. In pixels the origin is its mean over the frames, as a picture has no other.

    Args:
        time_s: Instants, float64 [T], seconds, ascending.
        position: (x, y), float64 [T, 2], in `unit`.
        velocity: (x, y), float64 [T, 2], `unit` a second.
        position_sigma: Standard deviation of each coordinate, [T, 2].
        velocity_sigma: Standard deviation of each component, [T, 2].
        unit: "m" on the target's plane where the rig is known, else "px" on the sensor.
        frame_time_s: Instants of the frames, [N], seconds.
        frame_position: What the frames alone say, [N, 2], in `unit`.
        frame_sigma: Its standard deviation, [N, 2].
        size: Size of the object's picture in each frame over its mean size, [N]; it falls as the object moves
            away from the wall.
        size_sigma: Standard deviation of the size, [N].
        event_windows: Number of velocities that came from events.
        distance: Distance from the wall, where it was looked for.
        misfit: With a rig: what it leaves of the frames' changes, over their noise, root mean square. The
            stated deviations hold it as if it were noise.
    """

    time_s: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    position_sigma: NDArray[np.float64]
    velocity_sigma: NDArray[np.float64]
    unit: Literal["m", "px"]
    frame_time_s: NDArray[np.float64]
    frame_position: NDArray[np.float64]
    frame_sigma: NDArray[np.float64]
    size: NDArray[np.float64]
    size_sigma: NDArray[np.float64]
    event_windows: int
    distance: Distance | None = None
    misfit: float | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def speed(self) -> NDArray[np.float64]:
        """Speed, [T], `unit` a second."""
        return np.hypot(self.velocity[:, 0], self.velocity[:, 1])

    @property
    def speed_sigma(self) -> NDArray[np.float64]:
        """Standard deviation of the velocity's component along itself, [T]."""
        along = self.velocity / np.maximum(self.speed, 1e-300)[:, None]
        return np.sqrt(np.square(along * self.velocity_sigma).sum(axis=1)) + (self.speed == 0) * np.hypot(
            self.velocity_sigma[:, 0], self.velocity_sigma[:, 1]
        )

    @property
    def direction_deg(self) -> NDArray[np.float64]:
        """Direction of the velocity, [T], degrees from x (right) towards y (down); meaningless at rest."""
        return np.degrees(np.arctan2(self.velocity[:, 1], self.velocity[:, 0]))

    def at(self, t_s: ArrayLike) -> NDArray[np.float64]:
        """Return the position at times within the track, [..., 2], by cubic Hermite curves through it.

        Raises:
            DataError: A time lies outside the track.

        Args:
            t_s: Times, seconds, any shape [...].
        """
        times = np.asarray(t_s, dtype=np.float64)
        low, high = float(self.time_s[0]), float(self.time_s[-1])
        if not bool(((times >= low - 1e-9) & (times <= high + 1e-9)).all()):
            raise DataError(f"the track runs from {low:g} to {high:g} s; ask within it")
        k = np.clip(np.searchsorted(self.time_s, times, side="right") - 1, 0, len(self) - 2)
        step = (self.time_s[k + 1] - self.time_s[k])[..., None]
        u = (times - self.time_s[k])[..., None] / step
        rise = self.position[k + 1] - self.position[k]
        bend = step * (self.velocity[k] * u * (1 - u) ** 2 - self.velocity[k + 1] * u**2 * (1 - u))
        return self.position[k] + rise * u**2 * (3 - 2 * u) + bend

    def summary(self) -> dict[str, Any]:
        """Return everything as plain lists and numbers, for JSON."""
        arrays = {
            name: np.round(getattr(self, name), 7).tolist()
            for name in (
                "time_s",
                "position",
                "velocity",
                "position_sigma",
                "velocity_sigma",
                "speed",
                "speed_sigma",
                "direction_deg",
                "frame_time_s",
                "frame_position",
                "frame_sigma",
                "size",
                "size_sigma",
            )
        }
        found = {"unit": self.unit, "event_windows": self.event_windows, **arrays}
        if self.misfit is not None:
            found["misfit"] = round(self.misfit, 3)
        if self.distance is not None:
            depth = {name: np.round(values, 7).tolist() for name, values in vars(self.distance).items()}
            found["distance"] = depth
        return found
