"""Streaming reconstruction: events arrive, images leave, and every image knows how long it took."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
