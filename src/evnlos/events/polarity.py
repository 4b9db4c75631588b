"""Events whose camera gave no polarity."""

from __future__ import annotations

from evnlos.types import Events


def keep_known_polarity(events: Events) -> Events:
    """Return the events whose polarity is known.

    A CeleX-V sends intensities: a pixel's polarity is the sign of the change since its last event, so it is
    unknown for a pixel's first event and where nothing changed. Off-pixel recordings have no polarity at all.

    Args:
        events: The stream; it is not changed, and returned as it is without the column `polarity_known`.

    Returns:
        The events with a polarity, without the column `polarity_known`; `adc` stays.

    Example:
        >>> events = Events([1, 2], [0, 0], [0, 0], [False, True], 1, 1, polarity_known=[False, True])
        >>> keep_known_polarity(events)
        Events(1 events, 1 x 1, 2..2 us, 100 % ON)
    """
    if events.polarity_known is None:
        return events
    known = events[events.polarity_known]
    return Events(known.t_us, known.x, known.y, known.p, known.width, known.height, adc=known.adc)
