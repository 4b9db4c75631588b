"""Learning to reconstruct: pre-training on simulation, fine-tuning on captures, end-to-end training."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
