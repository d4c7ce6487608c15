"""The page: a web server on this machine, which viser's own client is served by, and its visitors."""

from __future__ import annotations

import atexit
import contextlib
import json
import math
import threading
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import rich
import viser
from viser import _messages  # it has no public way to run a script

from bbfit.checks import InputError
from bbfit.viewing.address import free_port
from bbfit.viewing.background import Background
from bbfit.viewing.levels import takes_over
from bbfit.viewing.models import Models
from bbfit.viewing.subject import Subject
from bbfit.viewing.visitor import ROOTS, Visitor
from bbfit.views import ViewDataset

HOST, PORT = "127.0.0.1", 8080
"""Where a page listens if nothing else is said."""
_SCRIPT = Path(__file__).with_name("page.js")
# Shares of the sky's and of the sun's light that reach a leaf among others, in place of shadows: by the mean color of two trees' views.
_SKY, _SUN = 0.5, 0.85


class Page:
    """A page that listens until it is closed; usable in a ``with`` statement.

    Raises
    ------
    InputError
        if it cannot listen there.
    """

    def __init__(self, *, host: str = HOST, port: int = PORT) -> None:
        port = free_port(host, port)
        self._lock = threading.RLock()
        self._subject: Subject | None = None
        self._models: Models | None = None
        self._status, self._closed = "", False
        self._original: bytes | None = None
        self._visitors = dict[int, Visitor]()
        self._background = Background()
        with _quiet():
            self._server = viser.ViserServer(host=host, port=port, label="bbfit", verbose=False)
        atexit.register(self.close)  # before viser's own, which prints
        self.url = f"http://{'127.0.0.1' if host in ('', '0.0.0.0', '::') else host}:{self._server.get_port()}"
        """Where it is to be seen from this machine."""
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._server.gui.main_panel.dock_right()
        scene = self._server.scene
        scene.set_up_direction("+y")
        scene.world_axes.visible = False
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        for root in ROOTS.values():
            scene.add_frame(root, show_axes=False)
        self._server.on_client_connect(self._greet)
        self._server.on_client_disconnect(self._part)

    def __enter__(self) -> Page:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def visitors(self) -> list[Visitor]:
        """Browsers that look at it."""
        with self._lock:
            return list(self._visitors.values())

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be said of what it shows."""
        subject = self._subject
        return tuple(filter(None, (*subject.notes, subject.original.note))) if subject is not None else ()

    def show(self, subject: Subject, models: Models | None = None) -> None:
        """Show a subject in place of what is shown; ``models`` are those of it that are made already."""
        with self._lock:
            self._subject, self._models = subject, models or Models(subject.export)
            self._stage(subject)
            for visitor in self._visitors.values():
                visitor.show(subject, self._models)
        if any(level.scale is None for level in subject.levels) and not subject.live and subject.views is not None:
            self._background.start(lambda: self._measure(subject))

    def say(self, status: str) -> None:
        """Say something about work in progress, as of a fit."""
        with self._lock:
            self._status = status
            for visitor in self._visitors.values():
                visitor.say(status)

    def close(self) -> None:
        """Stop listening."""
        if not self._closed:
            self._closed = True
            atexit.unregister(self.close)
            for visitor in self.visitors:
                visitor.leave()
            self._background.close()
            with _quiet():
                self._server.stop()

    def _greet(self, client: viser.ClientHandle) -> None:
        send_script(client, _SCRIPT.read_text(encoding="utf-8"))
        visitor = Visitor(client, send_state, self._background)
        with self._lock:
            self._visitors[client.client_id] = visitor
            visitor.say(self._status)
            if self._subject is not None and self._models is not None:
                visitor.show(self._subject, self._models)

    def _part(self, client: viser.ClientHandle) -> None:
        with self._lock:
            visitor = self._visitors.pop(client.client_id, None)
        if visitor is not None:
            visitor.leave()

    def _stage(self, subject: Subject) -> None:
        """What all visitors share: the original, its light, the ground."""
        scene, light = self._server.scene, subject.light
        if subject.original.glb is not None and subject.original.glb is not self._original:
            self._original = subject.original.glb
            scene.add_glb(f"{ROOTS['original']}/mesh", self._original, cast_shadow=False, receive_shadow=False)
        azimuth, elevation = math.radians(light.sun_azimuth), math.radians(light.sun_elevation)
        sun = (math.cos(elevation) * math.sin(azimuth), math.sin(elevation), math.cos(elevation) * math.cos(azimuth))
        # A white matt surface returns its irradiance over pi, in Blender's sun and sky as in three.js's lights.
        scene.add_light_ambient("/sky", intensity=_SKY * math.pi * light.ambient_strength)
        scene.add_light_directional("/sun", intensity=_SUN * light.sun_strength, position=sun)
        ground, height = float(subject.bounds[0, 1]), subject.size[1]
        cell = 10.0 ** math.floor(math.log10(height / 2))
        scene.add_grid(
            "/ground",
            plane="xz",
            infinite_grid=True,
            cell_size=cell,
            section_size=10 * cell,
            cell_color=(214, 220, 226),
            section_color=(178, 188, 198),
            fade_distance=20 * height,
            shadow_opacity=0.0,
            position=(0.0, ground, 0.0),
        )

    def _measure(self, subject: Subject) -> None:
        """From where on the billboards stand for the tree, worked out from the views while the page is up."""
        assert subject.views is not None
        (cloud,) = [level.cloud for level in subject.levels if level.scale is None]
        assert cloud is not None
        try:
            scale = takes_over(cloud, ViewDataset.load(subject.views).train, stop=lambda: self._background.closed)
            measured = subject.measured(scale)
        except InputError as error:
            measured = subject.unmeasured(f"from where on the billboards may be shown is not known: {error}")
        with self._lock:
            if self._subject is subject and not self._closed:
                self.show(measured, self._models)


def send_script(client: viser.ClientHandle, source: str) -> None:
    """Run a script in a visitor's browser."""
    client.gui._websock_interface.queue_message(_messages.RunJavascriptMessage(source))


def send_state(client: viser.ClientHandle, state: dict[str, Any], seconds: float) -> None:
    """Tell the page's script what to show, and for how many seconds to measure frames."""
    send_script(client, f"window.bbfit.set({json.dumps(state)}, {json.dumps(seconds)})")


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Nothing is printed on rich's console meanwhile, where viser prints of its own accord."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
