"""How good a reconstruction is, with its baselines, and how good it could be at all."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
