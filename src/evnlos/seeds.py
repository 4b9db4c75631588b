"""Every random draw comes from a seed that is derived, by name, from the one the user gave."""

from __future__ import annotations

import hashlib


def derive_seed(seed: int, *names: str | int) -> int:
    """Return a seed in 0..2^63 - 1 for the named purpose; other names give independent seeds.

    Example:
        >>> derive_seed(0, "writer03_A", "events") == derive_seed(0, "writer03_A", "frames")
        False
    """
    text = "\x1f".join(str(part) for part in (seed, *names))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little") >> 1
