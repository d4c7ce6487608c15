"""Changing a GLB without the program that wrote it."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

JSON, BINARY = 0x4E4F534A, 0x004E4942


def edit_glb(glb: Path, target: Path, change: Callable[[dict[str, Any], list[bytes]], None]) -> Path:
    """Write a changed copy; ``change`` is given the JSON and the contents of the buffer views, to change both in place."""
    data = glb.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    tree, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    views = [binary[view.get("byteOffset", 0) :][: view["byteLength"]] for view in tree["bufferViews"]]
    change(tree, views)
    binary = b""
    for view, content in zip(tree["bufferViews"], views, strict=True):
        view |= {"byteOffset": len(binary), "byteLength": len(content)}
        binary += content + bytes(-len(content) % 4)
    tree["buffers"] = [{"byteLength": len(binary)}]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), JSON) + text + struct.pack("<II", len(binary), BINARY) + binary
    target.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return target


def with_min_filter(glb: Path, min_filter: int) -> Path:
    """A copy beside the GLB whose samplers have another minification filter: 9729 is bilinear, 9987 trilinear."""

    def change(tree: dict[str, Any], _: list[bytes]) -> None:
        for sampler in tree["samplers"]:
            sampler["minFilter"] = min_filter

    return edit_glb(glb, glb.with_name(f"{glb.stem}_{min_filter}.glb"), change)
