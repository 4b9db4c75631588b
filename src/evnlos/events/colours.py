"""The two colours of events, for every picture and page of the project.

Told apart with every common kind of colour blindness, and in grey print: fully opaque, ON is lighter than OFF
by 50 of 255 or more. Each stands out from white and from the dark grounds that are drawn on.
"""

from __future__ import annotations

ON_RGB = (226, 120, 0)
"""Colour of events that are brighter: orange."""
OFF_RGB = (32, 87, 228)
"""Colour of events that are darker: blue."""
ON_HEX, OFF_HEX = ("#{:02x}{:02x}{:02x}".format(*colour) for colour in (ON_RGB, OFF_RGB))
WORDS = "orange brighter, blue darker"
"""What a caption says of them."""
