"""The files that a USD refers to: layers, and the pictures that they name."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

from bbfit.checks import fail
from bbfit.inputs import InputLimits, reading
from bbfit.tree_files.references import existing

_LAYERS = (".usd", ".usda", ".usdc", ".usdz")
_SCRIPT = Path(__file__).with_name("usd_layers.py")
_HINT = "export the tree again"
# Seconds to wait for the asset paths of a layer.
_PATIENCE = 120.0


def usd_files(path: Path, limits: InputLimits) -> list[Path]:
    """The existing files to which a USD refers: sublayers, references, payloads and textures, and those to which these refer.

    Each layer is opened alone, and only after its place was checked, by the library of USD that is part of Blender, in a process of its
    own. Without Blender, which alone can read a USD, the result is empty. Raises ``InputError`` if a layer is damaged, or if a file lies
    outside the folder of the USD and ``limits`` do not allow it.
    """
    library = _library()
    if library is None:
        return []
    files, waiting = list[Path](), [path]
    with subprocess.Popen(
        [sys.executable, "-P", str(_SCRIPT), str(library)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        try:
            while waiting:
                source = waiting.pop(0)
                for layer in [str(source.resolve()), *_packed(source)]:
                    for other in existing(source, _asset_paths(process, layer, source), path.parent, limits):
                        if other not in files and not other.samefile(path):
                            files.append(other)
                            waiting += [other] if other.suffix.lower() in _LAYERS else []
        finally:
            process.kill()
    return files


def _library() -> Path | None:
    """The folder of the module pxr in Blender."""
    blender = importlib.util.find_spec("bpy")
    if blender is None or blender.origin is None:
        return None
    return next((module.parent for module in Path(blender.origin).parent.glob("*/python/lib/python*/site-packages/pxr")), None)


def _packed(path: Path) -> list[str]:
    """The layers in a .usdz, a ZIP archive, in the notation of USD."""
    if path.suffix.lower() != ".usdz":
        return []
    with reading("tree", path, _HINT), zipfile.ZipFile(path) as archive:
        return [f"{path.resolve()}[{name}]" for name in archive.namelist() if name.lower().endswith(_LAYERS)]


def _asset_paths(process: subprocess.Popen[bytes], layer: str, source: Path) -> list[str]:
    """The asset paths in a layer of ``source``. A layer in a package can refer to other files by absolute paths alone."""
    assert process.stdin and process.stdout
    watchdog = threading.Timer(_PATIENCE, process.kill)
    watchdog.start()
    try:
        process.stdin.write(json.dumps(layer).encode() + b"\n")
        process.stdin.flush()
        answer = process.stdout.readline()
    except BrokenPipeError:
        answer = b""
    finally:
        watchdog.cancel()
    names = json.loads(answer) if answer else None
    if names is None:
        fail("tree", f"{source} cannot be read as USD", _HINT)
    files = [str(name).partition("[")[0] for name in names]  # what follows is a file in a package
    return (
        files if layer == str(source.resolve()) and source.suffix.lower() != ".usdz" else [name for name in files if name.startswith("/")]
    )
