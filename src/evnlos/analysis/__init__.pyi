"""Names of `evnlos.analysis`; `__init__.py` reads this list."""

from .evaluate import BASELINES as BASELINES
from .evaluate import CHECKS as CHECKS
from .evaluate import Evaluation as Evaluation
from .evaluate import assess as assess
from .evaluate import check_sampling as check_sampling
from .evaluate import evaluate as evaluate
from .evaluate import reconstruct as reconstruct
from .identify import Identification as Identification
from .identify import identify as identify
from .linearized import Bench as Bench
from .model import Model as Model
from .model import PositionsPoint as PositionsPoint
from .model import Reconstruction as Reconstruction
from .model import StreamingReconstructor as StreamingReconstructor
from .model import curve_over_positions as curve_over_positions
from .model import load_model as load_model
from .scores import Scores as Scores
from .scores import available_lpips as available_lpips
from .scores import load_lpips as load_lpips
from .scores import score as score
