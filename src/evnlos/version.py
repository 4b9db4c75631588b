"""The package's version, read from its metadata."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("evnlos")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
