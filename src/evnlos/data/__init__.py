"""Samples on disk: simulate them, import them from captures, split them, load them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
