"""Names of this machine: which requests come from its own browsers, and which addresses can be listened on."""

from __future__ import annotations

import errno
import ipaddress
import os
import queue
import re
import socket
import threading

from evnlos.errors import ConfigError

_PATIENCE_S = 2.0  # for the name of a machine; a resolver that nobody answers takes half a minute to say so
_HEADER = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^\s:\[\]@/]+)(?::\d+)?")


def is_local(host: str) -> bool:
    """Return whether a host is this machine itself, which nobody else can reach.

    Example:
        >>> is_local("127.0.0.1"), is_local("[::1]"), is_local("localhost"), is_local("0.0.0.0")
        (True, True, True, False)
    """
    try:
        return host.lower() == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def names_this_machine(header: str, own: str = "127.0.0.1") -> bool:
    """Return whether a request's Host header names this machine.

    A page from elsewhere may have made its own name lead here; its requests carry that name. The port says
    nothing more, and another one is what a forwarded port has.

    Args:
        header: The header, with or without a port.
        own: Further name that the server listens under.

    Example:
        >>> names_this_machine("localhost:8765"), names_this_machine("evil.example:8765")
        (True, False)
    """
    found = _HEADER.fullmatch(header)
    return found is not None and (is_local(found[1]) or found[1].lower() == own.lower())


def listening_address(host: str, port: int) -> str:
    """Return the address of a host of this machine, after a try to listen there.

    Args:
        host: Name or address.
        port: Port; 0 is any.

    Raises:
        ConfigError: The host is not known, is another machine, or the port is taken.
    """
    family, address = _resolved(host)
    try:
        with socket.socket(family) as probe:
            if os.name == "posix":  # as servers do; elsewhere it would let two listen on one port
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((address, port))
    except OSError as error:
        if error.errno == errno.EADDRNOTAVAIL:
            raise ConfigError(
                f"{host} is no address of this machine; give 127.0.0.1, or 0.0.0.0 to let the network in"
            ) from None
        wrong = "is in use" if error.errno == errno.EADDRINUSE else f"can't be had ({error.strerror})"
        raise ConfigError(f"port {port} {wrong}; give another --port, or 0 for a free one") from None
    return address


def _resolved(host: str) -> tuple[socket.AddressFamily, str]:
    """Return family and address of a host, asked for in a thread that may be left behind."""
    found: queue.SimpleQueue[tuple[socket.AddressFamily, str] | None] = queue.SimpleQueue()

    def ask() -> None:
        try:
            family, _, _, _, place = socket.getaddrinfo(host.strip("[]"), None, type=socket.SOCK_STREAM)[0]
            found.put((family, str(place[0])))
        except (OSError, UnicodeError):  # a label that is empty or too long
            found.put(None)

    threading.Thread(target=ask, name="resolver", daemon=True).start()
    try:
        answer = found.get(timeout=_PATIENCE_S)
    except queue.Empty:
        answer = None
    if answer is None:
        raise ConfigError(f"host {host!r} is not known; give 127.0.0.1, or 0.0.0.0 to let the network in")
    return answer
