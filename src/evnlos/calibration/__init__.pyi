"""Names of `evnlos.calibration`; `__init__.py` reads this list."""

from .captures import CaptureSet as CaptureSet
from .captures import read_capture_set as read_capture_set
from .event_fit import PixelFit as PixelFit
from .event_fit import fit_pixel as fit_pixel
from .fit import Example as Example
from .fit import SetupFit as SetupFit
from .fit import fit_setup as fit_setup
from .frame_model import FrameModel as FrameModel
from .frame_model import FrameNoise as FrameNoise
from .frame_model import LightLevel as LightLevel
from .frame_model import fit_frame_noise as fit_frame_noise
from .settings import Calibration as Calibration
from .summary import CALIBRATION_VALUES_FILE as CALIBRATION_VALUES_FILE
from .summary import calibration_values as calibration_values
from .summary import residual_table as residual_table
from .summary import rows_of as rows_of
from .summary import table as table
from .summary import warnings_of as warnings_of
from .summary import write_setup as write_setup
from .transport_fit import Residual as Residual
from .transport_fit import TransportFit as TransportFit
from .transport_fit import fit_transport as fit_transport
