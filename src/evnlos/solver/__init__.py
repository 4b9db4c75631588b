"""Inversion without learning, on the operator protocol."""

from evnlos.solver.cross_validation import block_folds
from evnlos.solver.denoiser import DenoiserTraining, ResidualDenoiser, train_denoiser
from evnlos.solver.event_channel import LogChange, log_change
from evnlos.solver.inversion import Inversion, prepare_inversion
from evnlos.solver.joint import JointProblem
from evnlos.solver.operators import Gradient, LinearOperator, dense_matrix, operator_norm
from evnlos.solver.photograph import Photograph, read_photograph
from evnlos.solver.plate_pass import PlatePass
from evnlos.solver.plug_and_play import plug_and_play
from evnlos.solver.problem import Background, Problem
from evnlos.solver.solution import Solution
from evnlos.solver.tikhonov import tikhonov, tikhonov_cv_error
from evnlos.solver.total_variation import total_variation

__all__ = [
    "Background",
    "DenoiserTraining",
    "Gradient",
    "Inversion",
    "JointProblem",
    "LinearOperator",
    "LogChange",
    "Photograph",
    "PlatePass",
    "Problem",
    "ResidualDenoiser",
    "Solution",
    "block_folds",
    "dense_matrix",
    "log_change",
    "operator_norm",
    "plug_and_play",
    "prepare_inversion",
    "read_photograph",
    "tikhonov",
    "tikhonov_cv_error",
    "total_variation",
    "train_denoiser",
]
