"""Khronos' glTF validator, by Node.js."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

_NODE = Path(__file__).with_name("node")
WARNING = 1
"""Severity of warnings; errors are 0, information 2, hints 3."""


def reports(*files: Path) -> list[dict[str, Any]]:
    """What the validator says of each file."""
    if shutil.which("node") is None or not (_NODE / "node_modules" / "gltf-validator").is_dir():
        pytest.fail(f"the glTF validator is not installed: install Node.js and run `npm ci` in {_NODE}")
    done = subprocess.run(["node", str(_NODE / "validate.mjs"), *map(str, files)], check=True, capture_output=True)
    found = json.loads(done.stdout)
    assert len(found) == len(files)
    return list(found)


def messages(*files: Path) -> list[dict[str, Any]]:
    """All that it finds, but that sides of textures are no powers of two: an atlas is no larger than it must be."""
    found = [message for report in reports(*files) for message in report["issues"]["messages"]]
    return [message for message in found if message["code"] != "IMAGE_NPOT_DIMENSIONS"]
