"""Where a page may listen."""

from __future__ import annotations

import socket

import pytest

from bbfit.checks import InputError
from bbfit.viewing.address import free_port


def test_a_taken_port_is_passed_over() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert port < free_port("127.0.0.1", port) < port + 100


def test_any_free_port() -> None:
    assert free_port("127.0.0.1", 0) > 0


@pytest.mark.parametrize(
    ("host", "port", "told"),
    [
        ("127.0.0.1", 65536, "port: expected 0 to 65535, got 65536"),
        ("127.0.0.1", -1, "port: expected at least 0"),
        ("no such host", 8080, "host: 'no such host' is not known"),
        ("192.0.2.1", 8080, "host: 192.0.2.1 cannot be listened on"),  # of a network that is for documentation only
    ],
)
def test_what_cannot_be_listened_on_is_an_error(host: str, port: int, told: str) -> None:
    with pytest.raises(InputError, match=told):
        free_port(host, port)
