"""evnlos sees moving things around a corner with an event camera."""
