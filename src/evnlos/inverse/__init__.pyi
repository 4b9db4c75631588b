"""Names of `evnlos.inverse`; `__init__.py` reads this list."""

from .inversion import Inversion as Inversion
from .inversion import Photograph as Photograph
from .inversion import prepare_inversion as prepare_inversion
from .inversion import read_photograph as read_photograph
from .measurements import LogChange as LogChange
from .measurements import log_change as log_change
from .operators import Gradient as Gradient
from .operators import LinearOperator as LinearOperator
from .operators import Solution as Solution
from .operators import operator_norm as operator_norm
from .plug_and_play import DenoiserTraining as DenoiserTraining
from .plug_and_play import ResidualDenoiser as ResidualDenoiser
from .plug_and_play import plug_and_play as plug_and_play
from .plug_and_play import train_denoiser as train_denoiser
from .problem import Background as Background
from .problem import Problem as Problem
from .problem import block_folds as block_folds
from .sequence_problem import SequenceOperator as SequenceOperator
from .sequence_problem import SequenceProblem as SequenceProblem
from .tikhonov import tikhonov as tikhonov
from .tikhonov import tikhonov_cv_error as tikhonov_cv_error
from .total_variation import total_variation as total_variation
