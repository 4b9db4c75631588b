"""Streaming reconstruction: events arrive, pictures leave, and every picture knows how long it took."""

__all__: list[str] = []
