"""Chunks of recordings, packed by one of four methods, unpacked into no more memory than they may take.

What a file says of a size decides nothing: bytes are counted while they come out.
"""

from __future__ import annotations

import bz2
from typing import Any

from evnlos.errors import MissingDependencyError

MOST_CHUNK_BYTES = 1 << 27
"""Size of a chunk, packed or not, at most; recorders write about a megabyte."""


def unpack(method: str, data: bytes | memoryview, size: int) -> bytes | memoryview:
    """Return the unpacked bytes of a chunk.

    Args:
        method: "" or "none" (as they are), "bz2", "lz4" (frames) or "zstd".
        data: The packed bytes.
        size: How many bytes they are unpacked, as the file says.

    Raises:
        ValueError: Another method, damage, another size than stated, or a chunk that is too large.
        MissingDependencyError: lz4 or zstd without its package.
    """
    if size > MOST_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes, at most {MOST_CHUNK_BYTES} are read")
    if method in ("", "none"):
        unpacked: Any = data
    elif method == "bz2":
        unpacked = _bz2(data, size)
    elif method == "lz4":
        unpacked = _lz4(data, size)
    elif method == "zstd":
        unpacked = _zstd(data, size)
    else:
        raise ValueError(f"a chunk packed by {method[:20]!r}; none, bz2, lz4 and zstd are read")
    if len(unpacked) != size:
        raise ValueError(f"a chunk of {len(unpacked)} bytes or more where {size} are announced")
    return unpacked


def _bz2(data: bytes | memoryview, size: int) -> bytes:
    try:
        return bz2.BZ2Decompressor().decompress(data, max_length=size + 1)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"a chunk that bz2 cannot unpack ({error})") from None


def _lz4(data: bytes | memoryview, size: int) -> bytes:
    try:
        import lz4.frame  # type: ignore[import-not-found]
    except ImportError:
        raise MissingDependencyError(_missing("lz4")) from None
    try:
        return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    except (RuntimeError, EOFError, ValueError, MemoryError) as error:
        raise ValueError(f"a chunk that lz4 cannot unpack ({error})") from None


def _zstd(data: bytes | memoryview, size: int) -> bytes:
    try:
        import zstandard  # type: ignore[import-not-found]
    except ImportError:
        raise MissingDependencyError(_missing("zstd")) from None
    try:
        decoder = zstandard.ZstdDecompressor(max_window_size=MOST_CHUNK_BYTES)
        return decoder.stream_reader(data, read_across_frames=True).read(size + 1)
    except (zstandard.ZstdError, MemoryError, ValueError) as error:
        raise ValueError(f"a chunk that zstd cannot unpack ({error})") from None


def _missing(method: str) -> str:
    return (
        f"this recording is packed by {method}, which needs a package: pip install evnlos[ros], "
        "or write the recording again without compression"
    )
