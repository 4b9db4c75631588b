"""The errors that bad input raises: one sentence with the value, the limit and the cure."""


class EvnlosError(Exception):
    """Base of every error that bad input raises; its text is one line a user can act on."""


class ConfigError(EvnlosError):
    """A setting is unknown, of the wrong type, or outside its range."""


class DataError(EvnlosError):
    """An array, image or dataset does not hold what it should."""


class CalibrationError(DataError):
    """The simulator cannot be fitted to captures, or the fit does not stand on those held out."""


class EventFileError(EvnlosError):
    """An event file is damaged, of an unknown format, or contradicts its own header."""


class MissingDependencyError(EvnlosError):
    """An optional package is needed; the text says how to install it."""
