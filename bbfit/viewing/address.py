"""The viewer's address: the port that it listens on, and the requests that it accepts there."""

from __future__ import annotations

import errno
import ipaddress
import socket
from collections.abc import Callable
from typing import TypeVar
from urllib.parse import urlsplit

from bbfit.checks import check_count, fail

# Ports to try, one after the other, until one is free.
_TRIES = 100
Server = TypeVar("Server")


def listen(host: str, port: int, start: Callable[[tuple[str, int], socket.AddressFamily], Server]) -> Server:
    """Start a server with ``start`` on the first free port of up to 100 from ``port`` on, 0 to 65535; 0 is any free port.

    ``host`` is a name or an address of this machine. ``start`` binds a server to an address and a port, or raises ``OSError``. Raises
    InputError if the host does not belong to this machine, the port is out of range or needs other rights, or all ports are taken.
    """
    check_count("port", port, 0)
    if port > 65535:
        fail("port", f"expected 0 to 65535, got {port}")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except (socket.gaierror, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not a name"
        fail("host", f"{host!r} is not known ({reason})", "127.0.0.1 is this machine alone, 0.0.0.0 all of its addresses")
    for candidate in range(port, min(port + _TRIES, 65536)):
        try:
            return start((str(address[0]), candidate), family)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                continue
            if error.errno in (errno.EACCES, errno.EPERM):
                fail("port", f"this process may not listen on {candidate} ({error.strerror})", "choose a port of 1024 or more")
            fail("host", f"cannot listen on {host} ({error.strerror})", "give an address of this machine, such as 127.0.0.1")
    fail("port", f"{port} and the next {_TRIES - 1} ports are taken", "choose another port")


def is_own_request(server_host: str, port: int, host: str | None, origin: str | None) -> bool:
    """Whether a request's ``Host`` and ``Origin`` headers show that it comes from the viewer's own page, and not from another site's.

    A page of another site can reach a server on this machine in two ways. It can send requests across origins, which carry its own
    ``Origin``. Or its domain can change its address to this machine's (DNS rebinding), and then ``Host`` names that domain. So ``Host`` has
    to be an IP address, ``localhost`` or ``server_host``, the host that the server was started with, with the port that it listens on; and
    ``Origin``, if there is one, has to be the same server.
    """
    try:
        parts = urlsplit(f"//{host}")
        name, its_port = parts.hostname, parts.port or 80
    except ValueError:
        return False
    if name is None or parts.username is not None or parts.netloc != host or its_port != port:
        return False
    return (name in ("localhost", server_host.lower()) or _is_address(name)) and origin in (None, f"http://{host}")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
