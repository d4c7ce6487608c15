"""The viewer's web server. It answers GET requests for the page, its state and its models, and nothing else."""

from __future__ import annotations

import atexit
import json
import math
import re
import socket
import sys
import threading
from dataclasses import asdict, dataclass, replace
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from types import TracebackType
from typing import Any

from bbfit.checks import InputError
from bbfit.geometry.extent import corners
from bbfit.reporting.charts import billboard_color
from bbfit.reporting.threejs import drawing_script, library_page, page_light
from bbfit.viewing.address import is_own_request, listen
from bbfit.viewing.field import plant
from bbfit.viewing.levels import ViewerLevel, field_levels, largest_scale
from bbfit.viewing.models import ModelCache, ModelOptions
from bbfit.viewing.originals import MAX_BYTES
from bbfit.viewing.viewed import ViewedTree, open_results
from bbfit.views.dataset import ViewDataset

# Connections that are open at a time, and seconds for which one may wait for the other side.
_MAX_CONNECTIONS, _TIMEOUT = 64, 10
# Shares of the sun, of the sky without reflections, and of the sky with them, that an original gets whose views are not known. The page
# casts the sun's shadows, not the sky's.
_SHARES = (0.9, 0.3, 0.2)
_FILES = {"/": ("viewer.html", "text/html"), "/viewer.css": ("viewer.css", "text/css")}
_FILES |= {f"/{name}": (name, "text/javascript") for name in ("viewer.js", "original.js")}
_MODEL = re.compile(r"/([0-9]{1,9})/model/([0-9]{1,4})/([0-4])/(mask|blend|hash|coverage)(-split)?\.glb")
_FIELD = re.compile(r"/([0-9]{1,9})/field/([0-9]{1,5})/([0-9]{1,9})")
_ORIGINAL = re.compile(r"/([0-9]{1,9})/original\.glb")
# The page may use nothing but its own files, and no other site may show it in a frame. trimesh's page has its scripts inside.
_POLICY = "default-src 'none'; img-src 'self' data: blob:; connect-src 'self' data: blob:; frame-src 'self'; frame-ancestors 'self'; "
_OWN_POLICY, _LIBRARY_POLICY = (
    f"{_POLICY}script-src {source}; style-src {source}; base-uri 'none'; form-action 'none'" for source in ("'self'", "'unsafe-inline'")
)


@dataclass(frozen=True)
class _Shown:
    tree: ViewedTree
    models: ModelCache
    generation: int
    """Counts the trees that were shown; it is part of the addresses of their models."""
    origin: int
    """The generation that first had this original; it is part of the original's address, so that pages keep it."""


class Viewer:
    """A viewer that listens until it is closed; a context manager.

    It takes the first free port of the host from ``port`` on; 0 is any free one. Raises InputError if it cannot listen there.
    """

    def __init__(self, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        self._lock, self._closed = threading.RLock(), threading.Event()
        self._shown: _Shown | None = None
        self._previous: _Shown | None = None  # a page may still load its models
        self._status, self._serial = "", 0
        self._measuring: threading.Thread | None = None
        self._host = host
        self._server = listen(host, port, partial(_Server, self))
        self.port: int = self._server.server_address[1]
        """The port that it listens on."""
        self.url = f"http://{'127.0.0.1' if host in ('', '0.0.0.0', '::') else f'[{host}]' if ':' in host else host}:{self.port}"
        """Its address for a browser on this machine."""
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
        atexit.register(self.close)

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def tree(self) -> ViewedTree | None:
        """The tree that is shown."""
        return None if self._shown is None else self._shown.tree

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the tree, such as why its original is not shown."""
        return () if self.tree is None else tuple(filter(None, (*self.tree.notes, self.tree.original.note)))

    def show(self, tree: ViewedTree, models: ModelCache | None = None) -> None:
        """Show a tree. ``models`` are the models of its clouds, if some are made already."""
        with self._lock:
            self._serial += 1
            before = self._shown
            origin = self._serial if before is None or before.tree.original != tree.original else before.origin
            self._shown = _Shown(tree, models or ModelCache(tree.clouds, tree.export), self._serial, origin)
            self._previous = before
        if not (tree.is_measured or tree.live or tree.views is None):
            self._measuring = threading.Thread(target=self._measure, args=(tree,), daemon=True)
            self._measuring.start()

    def show_status(self, status: str) -> None:
        """Show a line on work in progress, such as a fit."""
        with self._lock:
            self._serial += 1
            self._status = status

    def close(self) -> None:
        """Stop listening."""
        if self._closed.is_set():
            return
        self._closed.set()
        atexit.unregister(self.close)
        self._server.shutdown()
        self._server.server_close()
        if self._measuring is not None:
            self._measuring.join()
        if self._shown is not None:
            self._shown.models.close()

    def accepts(self, host: str | None, origin: str | None) -> bool:
        """Whether a request with these headers may come from the viewer's own page."""
        return is_own_request(self._host, self.port, host, origin)

    def content(self, path: str) -> tuple[str, bytes] | None:
        """The media type and the bytes at a path, ``None`` if there is nothing."""
        if path in _FILES:
            name, kind = _FILES[path]
            return kind, (files("bbfit.viewing") / "page" / name).read_bytes()
        if path == "/library":
            return "text/html", library_page().encode()
        if path == "/drawing.js":
            return "text/javascript", drawing_script().encode()
        with self._lock:
            serial, status, recent = self._serial, self._status, (self._shown, self._previous)
        if path == "/state":
            return "application/json", json.dumps({"serial": serial, "status": status, "tree": _state(recent[0])}).encode()
        match = _MODEL.fullmatch(path) or _FIELD.fullmatch(path) or _ORIGINAL.fullmatch(path)
        if match is None:
            return None
        number = int(match[1])
        shown = next((each for each in recent if each and number == (each.origin if match.re is _ORIGINAL else each.generation)), None)
        if shown is None:
            return None
        if match.re is _FIELD:
            try:
                return "application/octet-stream", plant(int(match[2]), shown.tree.bounds, seed=int(match[3])).tobytes()
            except InputError:
                return None
        if match.re is _ORIGINAL:
            return None if shown.tree.original.glb is None else ("model/gltf-binary", shown.tree.original.glb)
        if int(match[2]) >= len(shown.tree.clouds):
            return None
        options = ModelOptions(alpha=match[4], split=match[5] is not None, halvings=int(match[3]))  # type: ignore[arg-type]
        return "model/gltf-binary", shown.models.glb(int(match[2]), options)

    def _measure(self, tree: ViewedTree) -> None:
        """Measure the scale below which the billboards may be shown."""
        assert tree.views is not None
        try:
            measured = tree.with_scale(largest_scale(tree.clouds[0], ViewDataset.load(tree.views).train, self._closed.is_set))
        except InputError as error:
            measured = tree.without_views(f"the distance from which the billboards may be shown is not known: {error}")
        with self._lock:
            if self._shown is not None and self._shown.tree is tree:
                self._serial += 1
                self._shown = replace(self._shown, tree=measured)


def view(run: str | Path, *, host: str = "127.0.0.1", port: int = 8080, original_bytes: int = MAX_BYTES) -> Viewer:
    """Show a run or levels of detail in the browser, and return at once.

    The page has the original and the billboards side by side under one camera, the alpha modes, the planes' outlines, the levels of detail,
    a sun to move around models with maps, and fields of up to 10,000 trees with the time of a frame.

    Parameters
    ----------
    run
        The folder of ``bbfit run``, ``bbfit fit`` or ``bbfit lod``.
    host
        The address to listen on. Whoever can reach it can see the page. ``0.0.0.0`` is all addresses of this machine.
    port
        The first port to try; 0 is any free one.
    original_bytes
        The largest size of the original's file that is sent to browsers.

    Returns
    -------
    Viewer
        It listens until its ``close`` is called or the process ends; its ``url`` is the page's address.

    Raises
    ------
    MissingFileError, InputError
        If the folder is none of these or damaged, or if the viewer cannot listen there.
    """
    tree = open_results(run, original_bytes=original_bytes)
    viewer = Viewer(host=host, port=port)
    viewer.show(tree)
    return viewer


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = _MAX_CONNECTIONS

    def __init__(self, viewer: Viewer, address: tuple[str, int], family: socket.AddressFamily) -> None:
        self.address_family, self.slots = family, threading.BoundedSemaphore(_MAX_CONNECTIONS)
        super().__init__(address, partial(_Handler, viewer))

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Close connections beyond the limit at once."""
        return self.slots.acquire(blocking=False)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away is no error."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    timeout = _TIMEOUT

    def __init__(self, viewer: Viewer, request: Any, client_address: Any, server: _Server) -> None:
        self._viewer = viewer
        try:
            super().__init__(request, client_address, server)
        finally:
            server.slots.release()

    def do_GET(self) -> None:
        host = self.headers.get_all("Host", [])
        if len(host) != 1 or not self._viewer.accepts(host[0], self.headers.get("Origin")):
            self.send_error(HTTPStatus.FORBIDDEN, "Not a request of this page")
            return
        answer = self._viewer.content(self.path)
        if answer is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        kind, content = answer
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind if "/octet" in kind or kind.startswith("model") else f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Content-Security-Policy", _LIBRARY_POLICY if self.path == "/library" else _OWN_POLICY)
        self.end_headers()
        self.wfile.write(content)

    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-store")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("X-Content-Type-Options", "nosniff")
        super().end_headers()

    def version_string(self) -> str:
        return "bbfit"

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log nothing: the terminal belongs to the command."""


def _state(shown: _Shown | None) -> dict[str, Any] | None:
    """What the page knows of a tree. A scale is null if it is not known, and for the first level, which has none."""
    if shown is None:
        return None
    tree, clouds, light = shown.tree, shown.tree.clouds, page_light(shown.tree.clouds[0].light or shown.tree.light)

    def described(level: ViewerLevel) -> dict[str, Any]:
        scale = None if level.scale is None or math.isinf(level.scale) else level.scale
        cloud = next((index for index, cloud in enumerate(clouds) if cloud is level.cloud), None)
        return {"name": level.name, "scale": scale, "cloud": cloud, "halvings": level.halvings}

    return {
        "name": tree.name,
        "generation": shown.generation,
        "origin": shown.origin,
        "live": tree.live,
        "measuring": not tree.is_measured and tree.views is not None,
        "notes": [note for note in (*tree.notes, tree.original.note) if note],
        "original": tree.original.glb is not None,
        "levels": [described(level) for level in tree.levels],
        "field": [described(level) for level in field_levels(tree.levels)],
        "outlines": [corners(cloud).tolist() for cloud in clouds],
        "colors": [billboard_color(index) for index in range(max(map(len, clouds)))],
        "alpha": tree.export.alpha or clouds[0].alpha.kind,
        "split": bool(tree.export.resolve().split),
        "bounds": tree.bounds.tolist(),
        "maps": tree.has_maps,
        "light": light,
        "seen": [asdict(seen) for seen in tree.seen],
        "shares": _SHARES,
    }
