"""Names of `evnlos.live`; `__init__.py` reads this list."""

from .device import DEVICES as DEVICES
from .device import CameraFacts as CameraFacts
from .device import CameraLostError as CameraLostError
from .device import CameraPacket as CameraPacket
from .device import DeviceSource as DeviceSource
from .device import NeuromorphicDriver as NeuromorphicDriver
from .engine import StreamingReconstructor as StreamingReconstructor
from .record import RecordingCheck as RecordingCheck
from .record import check_line as check_line
from .record import record_capture as record_capture
from .streams import DvSource as DvSource
from .streams import WordInput as WordInput
from .udp import AestreamSource as AestreamSource
