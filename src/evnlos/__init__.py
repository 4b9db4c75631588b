"""evnlos sees moving things around a corner with an event camera: simulate, learn, reconstruct, measure.

The names of `__init__.pyi` are imported when they are requested, so that `--version` and `evnlos doctor` need
no PyTorch; all others are in their rooms: `evnlos.events`, `evnlos.optics`, `evnlos.cameras` and so on.
"""

from importlib.util import find_spec

try:
    import lazy_loader
except ModuleNotFoundError:  # without it, help, version and doctor work, and the doctor names it
    from evnlos.registry import __version__ as __version__
else:
    __getattr__, __dir__, _NAMES = lazy_loader.attach_stub(__name__, __file__)
    # A star brings names, not rooms.
    __all__ = [name for name in _NAMES if find_spec(f"evnlos.{name}") is None]  # pyright: ignore
