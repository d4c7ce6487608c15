"""What the server answers, and what it refuses."""

from __future__ import annotations

import errno
import http.client
import json
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import bbfit
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.extent import corners
from bbfit.glb import split_glb
from bbfit.viewing.server import Viewer

DATA = Path(__file__).resolve().parents[2] / "data"


@pytest.fixture(scope="module")
def viewer(small_run: Path) -> Iterator[Viewer]:
    with bbfit.view(small_run, port=0) as viewer:
        yield viewer


def request(viewer: Viewer, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and content of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=60)
    try:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
    finally:
        connection.close()


def png_area(model: bytes) -> int:
    """Texels of the picture in a GLB."""
    at = model.index(b"IHDR") + 4
    return int.from_bytes(model[at : at + 4], "big") * int.from_bytes(model[at + 4 : at + 8], "big")


def state(viewer: Viewer) -> dict:
    return json.loads(request(viewer, "/state")[2])["tree"]


def test_the_state_describes_the_tree(viewer: Viewer, small_run: Path) -> None:
    tree, cloud = state(viewer), BillboardCloud.load(small_run / "cloud.safetensors")
    assert [level["name"] for level in tree["levels"]] == ["original", "4 billboards"]
    assert [level["cloud"] for level in tree["levels"]] == [None, 0]
    assert (tree["alpha"], tree["split"], tree["original"], tree["live"]) == ("mask", False, True, False)
    np.testing.assert_allclose(tree["outlines"][0], corners(cloud).numpy())
    assert len(set(tree["colors"])) == 4


def test_models_and_fields_are_sent(viewer: Viewer, small_run: Path) -> None:
    generation = state(viewer)["generation"]
    assert request(viewer, f"/{generation}/original.glb")[2] == (DATA / "tree.glb").read_bytes()
    masked = request(viewer, f"/{generation}/model/0/0/mask.glb")[2]
    assert split_glb(masked)[1] == split_glb((small_run / "model.glb").read_bytes())[1]  # the run's has names and a score besides
    smaller = request(viewer, f"/{generation}/model/0/1/mask.glb")[2]  # half as wide and high, with the padding that half needs
    assert png_area(smaller) < 0.5 * png_area(masked) and len(smaller) < len(masked)
    field = np.frombuffer(request(viewer, f"/{generation}/field/100/7")[2], np.float32)
    assert field.shape == (500,)


@pytest.mark.parametrize(
    "path",
    [
        "/nothing",
        "/../setup.cfg",
        "/%2e%2e/setup.cfg",
        "//etc/passwd",
        "/state?x=1",
        "/{}/model/1/0/mask.glb",
        "/{}/model/0/5/mask.glb",
        "/{}/model/0/0/opaque.glb",
        "/{}/field/0/0",
        "/{}/field/10001/0",
        "/{}/field/1/9999999999",
        "/999/model/0/0/mask.glb",
        "/999/original.glb",
    ],
)
def test_there_is_nothing_else(viewer: Viewer, path: str) -> None:
    assert request(viewer, path.format(state(viewer)["generation"]))[0] == 404


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "CONNECT", "HEAD", "NONSENSE"])
def test_clients_can_only_read(viewer: Viewer, method: str) -> None:
    assert request(viewer, "/state", method)[0] == 501


@pytest.mark.parametrize("path", ["/", "/state", "/library", "/nothing"])
@pytest.mark.parametrize(
    "headers", [{"Origin": "http://evil.example"}, {"Host": "evil.example"}, {"Host": "evil.example", "Origin": "null"}]
)
def test_foreign_pages_are_refused(viewer: Viewer, path: str, headers: dict[str, str]) -> None:
    status, _, content = request(
        viewer, path, **{name: f"{value}:{viewer.port}" if name == "Host" else value for name, value in headers.items()}
    )
    assert status == 403
    assert b"4 billboards" not in content and b"<canvas" not in content


def test_foreign_pages_may_not_embed_what_is_sent(viewer: Viewer) -> None:
    for path in ("/", "/state", "/library", "/viewer.js", "/drawing.js"):
        status, headers, _ = request(viewer, path)
        assert status == 200
        assert headers["cross-origin-resource-policy"] == "same-origin"
        assert headers["x-content-type-options"] == "nosniff"
        assert "frame-ancestors 'self'" in headers["content-security-policy"]
        assert "access-control-allow-origin" not in headers


@pytest.mark.parametrize(
    "garbage",
    [
        b"\x00\xff\xfe\r\n\r\n",
        b"GET\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET " + b"a" * 100_000 + b" HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 1000 + b"\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET /state HTTP/1.1\r\nHost: \xff\xfe\r\n\r\n",
        b"GET / HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n",
        b"",
    ],
)
def test_garbage_is_refused_in_silence(viewer: Viewer, garbage: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    with socket.create_connection(("127.0.0.1", viewer.port), 10) as connection:
        answer = b""
        try:
            connection.sendall(garbage)
            connection.shutdown(socket.SHUT_WR)
            while part := connection.recv(65536):
                answer += part
        except OSError as error:  # the server may close the connection before it has read everything, but it must not hang
            assert error.errno in (errno.ECONNRESET, errno.EPIPE, errno.ENOTCONN)
    assert b"200 OK" not in answer and b"101" not in answer[:20]
    assert request(viewer, "/state")[0] == 200
    assert capfd.readouterr() == ("", "")


def test_connections_are_bounded(viewer: Viewer) -> None:
    """Those beyond the limit are closed, and once the others are gone there is room again."""
    connections = [socket.create_connection(("127.0.0.1", viewer.port), 60) for _ in range(70)]
    try:
        assert [connection.recv(1) for connection in connections[64:]] == [b""] * 6
    finally:
        for connection in connections:
            connection.close()
    while True:
        try:
            assert request(viewer, "/state")[0] == 200
            break
        except (http.client.RemoteDisconnected, ConnectionError):
            continue
