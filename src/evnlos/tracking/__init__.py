"""The motion of the hidden object from the recording alone."""

from evnlos.tracking.background import static_light, temporal_noise
from evnlos.tracking.event_velocity import EventVelocity, event_velocity
from evnlos.tracking.follow import Tracking, track_capture, track_doubts, track_frames
from evnlos.tracking.geometry import PlaneMap, plane_map
from evnlos.tracking.registration import Registration, register
from evnlos.tracking.rig_shift import RigShift, rig_shift
from evnlos.tracking.smoother import Measurements, Smoothed, most_likely_acceleration, smooth
from evnlos.tracking.track import Distance, Track

__all__ = [
    "Distance",
    "EventVelocity",
    "Measurements",
    "PlaneMap",
    "Registration",
    "RigShift",
    "Smoothed",
    "Track",
    "Tracking",
    "event_velocity",
    "most_likely_acceleration",
    "plane_map",
    "register",
    "rig_shift",
    "smooth",
    "static_light",
    "temporal_noise",
    "track_capture",
    "track_doubts",
    "track_frames",
]
