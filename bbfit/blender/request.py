"""The request for a folder of pictures and the measurements of the tree, as stored in ``views.json`` and ``pictures.json``."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard

from bbfit.blender.config import ViewsConfig
from bbfit.checks import check_file, fail
from bbfit.files import read_json, write_json
from bbfit.images import picture_header
from bbfit.inputs import LARGEST, InputLimits, reading
from bbfit.provenance import VERSIONS, identity, installed_version
from bbfit.tree_files.tree_file import TreeFile

# Most pixels of a panorama, which are more than those of a texture: 23170 x 11585.
_PANORAMA = 1 << 28
_UNLIMITED = InputLimits(max_input_pixels=1 << 62)


@dataclass(frozen=True)
class RenderedTree:
    """The tree in the pictures. ``None`` marks an unknown value."""

    name: str | None = None
    """Name of its main file."""
    sha256: str | None = None
    """Digest of the tree (:class:`~bbfit.tree_files.tree_file.TreeFile`)."""
    bytes: int | None = None
    """Total size of its files."""
    up_axis: str | None = None
    """The axis that points up in its file, ``"y"`` or ``"z"``."""
    vertices: int | None = None
    """Number of vertices in Blender."""
    faces: int | None = None
    """Number of triangles in Blender."""
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    """Lowest and highest corner of its bounding box in meters, Y up."""


@dataclass(frozen=True)
class ViewsRequest:
    """A request to render pictures of a tree, and its outcome as far as it is known."""

    config: Mapping[str, Any]
    """The :func:`~bbfit.provenance.identity` of the :class:`~bbfit.blender.config.ViewsConfig`."""
    tree: RenderedTree
    """The tree."""
    version: int = VERSIONS["views"]
    """Version of the rendering (:data:`~bbfit.provenance.VERSIONS`)."""
    bbfit: str | None = None
    """Version of bbfit."""
    blender: str | None = None
    """Version of Blender."""
    camera: Mapping[str, Any] | None = None
    """For views on rings: ``target``, the point that all cameras look at, and ``distance``, their distance from it, both in meters."""
    cameras: Mapping[str, Any] | None = None
    """For pictures with explicit cameras: the cameras."""
    clips: list[list[float]] | None = None
    """For pictures with explicit cameras: the clip distances in meters, if there are any."""
    seconds: float = 0.0
    """Time spent rendering, over all attempts."""
    complete: bool = False
    """Whether all pictures are rendered."""

    @staticmethod
    def of(tree: TreeFile, config: ViewsConfig) -> ViewsRequest:
        """The request for views of a tree before rendering. Raises ``InputError`` if a panorama does not exist or is too large."""
        if config.hdri is not None:
            panorama = check_file("hdri", config.hdri)
            header = picture_header("hdri", panorama, _UNLIMITED)
            if header is not None and header.width * header.height > _PANORAMA:
                pixels = f"{header.width} x {header.height} pixels"
                fail("hdri", f"{panorama} has {pixels}, more than {_PANORAMA:,}", "reduce it; 8192 x 4096 are enough for any light")
            config = replace(config, hdri=panorama)
        known = RenderedTree(tree.path.name, tree.digest, tree.bytes, tree.up_axis)
        config = replace(config, elevations=config.rings)  # a default is the same as naming it
        return ViewsRequest(identity(config), known, bbfit=installed_version("bbfit") or "unknown")

    @staticmethod
    def load(path: Path) -> ViewsRequest | None:
        """Read a request. The result is ``None`` if bbfit did not write the file. Values of an unexpected type count as unknown.

        Raises ``InputError`` if the file is not valid JSON.
        """
        content = read_json("views", path)
        if not isinstance(content, dict) or not isinstance(content.get("tree"), dict):
            return None
        with reading("views", path, "remove the file or restore it"):
            return _request(content)

    def save(self, path: Path) -> None:
        """Write the request. Unknown values are omitted."""
        content = {name: value for name, value in asdict(self).items() if value is not None}
        content["tree"] = {name: value for name, value in content["tree"].items() if value is not None}
        write_json(path, content)

    def check_same(self, folder: Path, file: str) -> ViewsRequest | None:
        """The earlier request in ``file`` of a folder of pictures. ``None`` if the file does not exist.

        Raises ``InputError`` with the first difference if the earlier request was for other pictures.
        """
        path, hint = folder / file, f"choose another output folder, or remove {folder} to render again"
        if not path.is_file():
            return None
        earlier = ViewsRequest.load(path)
        if earlier is None or not earlier.config:
            fail("out", f"{path} was not written by bbfit", hint)
        for name, value in self.config.items():
            before = earlier.config.get(name)
            if before != value:
                fail("out", f"{folder} contains pictures with {name} {_shown(before)}, not {_shown(value)}", hint)
        if earlier.tree.sha256 != self.tree.sha256:
            other = "another tree," if earlier.tree.name != self.tree.name else "an earlier version of"
            fail("out", f"{folder} contains pictures of {other} {earlier.tree.name}", hint)
        for name in ("version", "cameras", "clips"):
            if getattr(earlier, name) != getattr(self, name):
                fail("out", f"{folder} contains pictures with other {name}", hint)
        return earlier


def _request(content: dict[str, Any]) -> ViewsRequest:
    """The request in the JSON of a file."""
    tree = content["tree"]
    facts: dict[str, Any] = {name: tree[name] for name in ("name", "sha256", "up_axis") if isinstance(tree.get(name), str)}
    facts |= {name: tree[name] for name in ("bytes", "vertices", "faces") if _is_number(tree.get(name), 1 << 62, int)}
    bounds = tree.get("bounds")
    if isinstance(bounds, list) and [len(corner) for corner in bounds if isinstance(corner, list)] == [3, 3]:
        low, high = bounds
        if all(_is_number(value, LARGEST) for value in (*low, *high)) and all(map(operator.le, low, high)):
            facts["bounds"] = bounds
    types = {"version": int, "bbfit": str, "blender": str, "camera": dict, "cameras": dict, "clips": list, "complete": bool}
    known: dict[str, Any] = {"version": 1}  # files from before there was a version
    known |= {name: value for name, kind in types.items() if isinstance(value := content.get(name), kind)}
    config, seconds = content.get("config"), content.get("seconds")
    return ViewsRequest(
        identity(config) if isinstance(config, dict) else {},
        RenderedTree(**facts),
        **known,
        seconds=float(seconds) if _is_number(seconds, 1e12) and seconds >= 0 else 0.0,
    )


def _is_number(value: Any, most: float, kind: Any = int | float) -> TypeGuard[float]:
    return isinstance(value, kind) and not isinstance(value, bool) and -most <= value <= most


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return str(value.get("name"))
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
