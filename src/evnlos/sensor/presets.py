"""Event pixels of known settings and sensors, with the source of every number that has one.

A data sheet quotes a contrast c as a fraction of the light. An ON threshold is ln(1 + c). An OFF threshold is
-ln(1 - c) where c is a fraction of the light before, and ln(1 + c) where it is one of the darker light, as the
maker of the Prophesee sensors defines it: 100 % (L_max - L_min) / L_min ("Event-based vision sensor
characteristics", Prophesee support pages). Where no source is named, the number is an assumption for indoor
light: bandwidth and noise of real sensors depend on their biases and on the light, so fit them to a recording
when they matter.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable

from evnlos.errors import ConfigError
from evnlos.sensor.brownian import BrownianPixel
from evnlos.sensor.pixel import EventPixel


def paper() -> EventPixel:
    """Return the settings of Wang et al., arXiv 2404.05977, Table 1; leak 0.01 Hz and refractory 0 are ours.

    Example:
        >>> paper() == EventPixel()
        True
    """
    return EventPixel(0.15, 0.15, 0.03, 15.0, 0.01, 0.0015, 0.0)


def v2e_clean() -> EventPixel:
    """Return v2e's parameter set "clean": no noise, no filter, slight mismatch (v2e, `set_dvs_params`)."""
    return EventPixel(0.2, 0.2, 0.02, 0.0, 0.0, 0.0, 0.0)


def v2e_noisy() -> EventPixel:
    """Return v2e's parameter set "noisy": a dim scene (v2e, `set_dvs_params`)."""
    return EventPixel(0.2, 0.2, 0.05, 30.0, 0.1, 5.0, 0.0)


def davis346() -> EventPixel:
    """Return a DAVIS346: contrast 14.3 to 22.5 % (Gallego et al., TPAMI 2020, Table 1), taken as ON and OFF.

    Mismatch 3.5 % of contrast (Brandli et al., JSSC 2014, for the DAVIS240); bandwidth, noise and refractory
    period are assumed, and so is that the OFF contrast is a fraction of the light before.
    """
    return EventPixel(_brighter(0.143), _darker(0.225), 0.035, 200.0, 0.1, 1.0, 5e-4)


def prophesee_gen3() -> EventPixel:
    """Return a Prophesee Gen3 VGA CD: contrast 12 % of the darker light (Gallego et al., TPAMI 2020, Table 1).

    The bandwidth is that of the slowest quoted latency, 200 us; the rest is assumed.
    """
    return EventPixel(_brighter(0.12), _brighter(0.12), 0.03, _cutoff(200e-6), 0.1, 0.5, 3e-4)


def prophesee_gen4() -> EventPixel:
    """Return a Prophesee Gen4 HD CD: contrast 11 % of the darker light (Gallego et al., TPAMI 2020, Table 1).

    The bandwidth is that of the slowest quoted latency, 150 us; the rest is assumed.
    """
    return EventPixel(_brighter(0.11), _brighter(0.11), 0.03, _cutoff(150e-6), 0.1, 0.5, 2e-4)


def celex_v() -> EventPixel:
    """Return a CeleX-V: contrast 10 % (Gallego et al., TPAMI 2020, Table 1); all else is assumed."""
    return EventPixel(_brighter(0.10), _darker(0.10), 0.03, 200.0, 0.2, 1.0, 5e-4)


def voltmeter_dvs346() -> BrownianPixel:
    """Return DVS-Voltmeter's DAVIS346 (Lin et al., ECCV 2022, published code): a Brownian pixel."""
    return BrownianPixel.voltmeter(5.265, 20.0, 1e-4, 1e-7, 5e-9, 1e-5)


def voltmeter_dvs240() -> BrownianPixel:
    """Return DVS-Voltmeter's DAVIS240 (Lin et al., ECCV 2022, published code): a Brownian pixel."""
    return BrownianPixel.voltmeter(4.4241, 23.0, 2e-4, 1e-7, 5e-8, 1e-5)


PRESETS: dict[str, Callable[[], EventPixel | BrownianPixel]] = {
    preset.__name__: preset
    for preset in (
        paper,
        v2e_clean,
        v2e_noisy,
        davis346,
        prophesee_gen3,
        prophesee_gen4,
        celex_v,
        voltmeter_dvs346,
        voltmeter_dvs240,
    )
}
"""All presets by name."""


def pixel_preset(name: str) -> EventPixel | BrownianPixel:
    """Return the preset of this name.

    Raises:
        ConfigError: There is no such preset; the nearest is named.

    Example:
        >>> pixel_preset("davis346").threshold_on
        0.1337
    """
    if name not in PRESETS:
        near = difflib.get_close_matches(name, PRESETS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"give one of {', '.join(PRESETS)}"
        raise ConfigError(f"there is no pixel preset {name!r}; {hint}")
    return PRESETS[name]()


def _brighter(contrast: float) -> float:
    """Return the threshold, log units, of a contrast in fractions of the darker light."""
    return round(math.log1p(contrast), 4)


def _darker(contrast: float) -> float:
    """Return the threshold, log units, of a fall by a fraction of the light before."""
    return round(-math.log1p(-contrast), 4)


def _cutoff(latency_s: float) -> float:
    """Return the corner frequency of a first-order low-pass filter with this time constant, hertz."""
    return round(1.0 / (2.0 * math.pi * latency_s), 1)
