"""Names of `evnlos.tracking`; `__init__.py` reads this list."""

from .bearings import UNSURE_NOISE as UNSURE_NOISE
from .bearings import BearingTrack as BearingTrack
from .bearings import BearingTracking as BearingTracking
from .bearings import BearingTracks as BearingTracks
from .bearings import track_bearings as track_bearings
from .follow import Tracking as Tracking
from .follow import static_light as static_light
from .follow import temporal_noise as temporal_noise
from .follow import track_capture as track_capture
from .follow import track_frames as track_frames
from .follow import track_warnings as track_warnings
from .motion_fit import MotionFit as MotionFit
from .motion_fit import fit_motion as fit_motion
from .registration import EventVelocity as EventVelocity
from .registration import Registration as Registration
from .registration import event_velocity as event_velocity
from .registration import register as register
from .track import Distance as Distance
from .track import Measurements as Measurements
from .track import PlaneMap as PlaneMap
from .track import Smoothed as Smoothed
from .track import Track as Track
from .track import most_likely_acceleration as most_likely_acceleration
from .track import plane_map as plane_map
from .track import smooth as smooth
