"""Measure speed and memory: python scripts/benchmark.py [--out benchmark.json]

Every measurement runs in a process of its own, so that its peak memory is its own. Seconds are wall time and count importing bbfit and
writing the file.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

TREES = {"quaking_aspen": 0, "weeping_willow": 0}
"""Species that are grown whole, and their seeds."""


def measure(script: str, *arguments: str) -> dict[str, Any]:
    """Seconds and peak resident memory in bytes of a Python script that prints JSON as its last line, with what it prints."""
    begun = time.perf_counter()
    reading, writing = os.pipe()
    process = os.posix_spawn(
        sys.executable, [sys.executable, "-c", script, *arguments], os.environ, file_actions=[(os.POSIX_SPAWN_DUP2, writing, 1)]
    )
    os.close(writing)
    with os.fdopen(reading) as pipe:
        printed = pipe.read()
    _, status, usage = os.wait4(process, 0)
    seconds = time.perf_counter() - begun
    if status:
        raise SystemExit(f"a measurement failed with status {status}")
    return json.loads(printed.splitlines()[-1]) | {"seconds": round(seconds, 2), "peak_bytes": usage.ru_maxrss * 1024}


GROW = """
import json, sys, bbfit
name, seed, path = sys.argv[1], int(sys.argv[2]), sys.argv[3]
scene = bbfit.grow(name, seed=seed)
bbfit.write_tree(scene, path)
print(json.dumps({"vertices": sum(len(mesh.vertices) for mesh in scene.geometry.values())}))
"""


def main() -> None:
    """Measure, print, and write the result where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="file for the result as JSON")
    out = parser.parse_args().out
    result: dict[str, Any] = {"machine": platform.platform(), "processors": os.cpu_count(), "grow": {}}
    with tempfile.TemporaryDirectory() as folder:
        for name, seed in TREES.items():
            path = Path(folder) / f"{name}.glb"
            result["grow"][name] = measure(GROW, name, str(seed), str(path)) | {"file_bytes": path.stat().st_size}
            print(name, result["grow"][name])
    if out:
        out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
