"""Where the viewer listens, and whose requests it accepts."""

from __future__ import annotations

import socket

import pytest

from bbfit.checks import InputError
from bbfit.viewing.address import is_own_request
from bbfit.viewing.server import Viewer


def test_a_taken_port_is_passed_over() -> None:
    with Viewer(port=0) as first, Viewer(port=first.port) as second:
        assert first.port < second.port < first.port + 100
        assert second.url == f"http://127.0.0.1:{second.port}"


def test_it_listens_on_one_address_only() -> None:
    with Viewer(port=0) as viewer:
        with socket.create_connection(("127.0.0.1", viewer.port), 5):
            pass
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.2", viewer.port), 5)


@pytest.mark.parametrize(
    ("host", "port", "message"),
    [
        ("127.0.0.1", 65536, "port: expected 0 to 65535, got 65536"),
        ("127.0.0.1", -1, "port: expected at least 0"),
        ("no such host", 8080, "host: 'no such host' is not known"),
        ("192.0.2.1", 8080, "host: cannot listen on 192.0.2.1"),  # of a network that is for documentation only
    ],
)
def test_an_address_that_cannot_be_listened_on_is_an_error(host: str, port: int, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Viewer(host=host, port=port)


@pytest.mark.parametrize(
    ("host", "origin", "accepted"),
    [
        ("127.0.0.1:8080", None, True),
        ("localhost:8080", "http://localhost:8080", True),
        ("[::1]:8080", None, True),
        ("10.1.2.3:8080", "http://10.1.2.3:8080", True),  # one of the addresses that 0.0.0.0 stands for
        ("tree.lan:8080", "http://tree.lan:8080", True),  # the host that the server was started with
        ("evil.example:8080", None, False),
        ("evil.example:8080", "http://evil.example:8080", False),
        ("127.0.0.1:8081", None, False),
        ("127.0.0.1:8080", "http://evil.example", False),
        ("127.0.0.1:8080", "https://127.0.0.1:8080", False),
        ("127.0.0.1:8080", "http://localhost:8080", False),
        ("127.0.0.1:8080", "null", False),
        ("user@127.0.0.1:8080", "http://user@127.0.0.1:8080", False),
        ("127.0.0.1:8080/x", None, False),
        ("127.0.0.1:port", None, False),
        ("[::1:8080", None, False),
        ("", None, False),
        (None, None, False),
    ],
)
def test_only_the_page_itself_may_make_requests(host: str | None, origin: str | None, accepted: bool) -> None:
    assert is_own_request("tree.lan", 8080, host, origin) == accepted
