"""Files that hold several streams: topics of a ROS bag, cameras of one file; listed, and one chosen by name."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from evnlos.errors import EventFileError

_LOG = logging.getLogger("evnlos")
StreamKind = Literal["events", "frames", "other"]
_MOST_NAMES = 12  # of a message


@dataclass(frozen=True)
class Stream:
    """One stream of a file.

    Args:
        name: How the file calls it, such as "/event_camera/events"; what `topic=` takes.
        kind: "events", "frames", or "other" for what is not read.
        type: What the file says of it: a message type, a camera, a data set.
        count: Messages or packets that the file announces for it; None where it does not say.
    """

    name: str
    kind: StreamKind
    type: str
    count: int | None = None


def choose_stream(
    path: Path, streams: Sequence[Stream], topic: str | None, kind: StreamKind, is_strict: bool
) -> Stream:
    """Return the stream to read: the named one, else the only one of its kind.

    Args:
        path: The file, for messages.
        streams: All that it holds.
        topic: Name of the stream; a unique end of it, such as "left/events", will do. None = the only one.
        kind: What is wanted.
        is_strict: Whether several without a name are an error; else the first is taken, and a warning logged.

    Raises:
        EventFileError: No stream of that kind or name, or several and no name.
    """
    fitting = [stream for stream in streams if stream.kind == kind]
    names = ", ".join(stream.name for stream in fitting[:_MOST_NAMES])
    if not fitting:
        held = ", ".join(f"{stream.name} ({stream.type})" for stream in streams[:_MOST_NAMES]) or "nothing"
        raise EventFileError(
            f"{path}: byte 0: holds no stream of {kind}; it holds {held}; record {kind} as well"
        )
    if topic is not None:
        exact = [stream for stream in fitting if stream.name == topic]
        ends = exact or [stream for stream in fitting if stream.name.endswith("/" + topic.strip("/"))]
        if len(ends) != 1:
            raise EventFileError(
                f"{path}: byte 0: topic {topic!r} is {len(ends)} streams of {kind}; give one of: {names}"
            )
        return ends[0]
    if len(fitting) > 1:
        told = f"{path}: byte 0: holds {len(fitting)} streams of {kind}; give topic= (--topic), one of: {names}"
        if is_strict:
            raise EventFileError(told)
        _LOG.warning("%s; took %s", told, fitting[0].name)
    return fitting[0]


def refuse_topic(path: Path, name: str, topic: str | None) -> None:
    """Raise where a topic is named for a format that holds one stream."""
    if topic is not None:
        raise EventFileError(
            f"{path}: byte 0: {name} holds one stream, topic {topic!r} is none of it; leave topic out"
        )
