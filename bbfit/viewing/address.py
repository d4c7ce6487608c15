"""Where a page listens."""

from __future__ import annotations

import errno
import socket

from bbfit.checks import check_count, fail

# Ports tried, one after the other, until one is free.
_TRIES = 100


def free_port(host: str, port: int) -> int:
    """The first port from ``port`` on that is free on a host of this machine; 0 is any free one.

    Raises
    ------
    InputError
        if the host is not one of this machine's, the port is none or needs other rights, or a hundred are taken.
    """
    check_count("port", port, 0)
    if port > 65535:
        fail("port", f"expected 0 to 65535, got {port}")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except (socket.gaierror, UnicodeError) as error:
        fail("host", f"{host!r} is not known ({error})", "127.0.0.1 is this machine alone, 0.0.0.0 all of its addresses")
    for tried in range(port, min(port + _TRIES, 65536)):
        with socket.socket(family, kind, protocol) as server:
            server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a page that was closed a moment ago is no hindrance
            try:
                server.bind((address[0], tried, *address[2:]))
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    continue
                if error.errno in (errno.EACCES, errno.EPERM):
                    fail("port", f"{tried} may not be listened on ({error.strerror})", "choose one of 1024 or more")
                fail("host", f"{host} cannot be listened on ({error.strerror})", "give an address of this machine, such as 127.0.0.1")
            taken: int = server.getsockname()[1]
            return taken
    fail("port", f"{port} and the {_TRIES - 1} after it are taken", "choose another one")
