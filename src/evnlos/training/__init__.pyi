"""Names of `evnlos.training`; `__init__.py` reads this list."""

from .choice import MOST_ASYMMETRY as MOST_ASYMMETRY
from .choice import Choice as Choice
from .choice import alternatives as alternatives
from .choice import asymmetry as asymmetry
from .choice import augmented as augmented
from .choice import best_shown as best_shown
from .choice import between as between
from .choice import choose_and_finetune as choose_and_finetune
from .choice import read_choice as read_choice
from .settings import LOSSES as LOSSES
from .settings import Training as Training
from .settings import check_run as check_run
from .settings import finetuning as finetuning
from .settings import learning_rate_at as learning_rate_at
from .settings import normalized_bce_mse_ssim as normalized_bce_mse_ssim
from .settings import paper_finetuning as paper_finetuning
from .settings import paper_loss as paper_loss
from .settings import paper_pretraining as paper_pretraining
from .train import TrainingResult as TrainingResult
from .train import train as train
