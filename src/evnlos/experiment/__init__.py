"""Experiments: what is compared, run so that it can go on after any interruption, and put into tables."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
