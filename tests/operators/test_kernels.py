"""All kernels are compiled for CUDA, which needs no GPU."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import warp as wp

import bbfit

PACKAGE = Path(bbfit.__file__).parent
SOURCES = sorted(path for path in PACKAGE.rglob("*.py") if "import warp" in path.read_text(encoding="utf-8"))
FILES = [path for path in SOURCES if path.name.endswith("kernels.py")]
ARCHITECTURES = (75, 90, 120)
"""Turing, Hopper and Blackwell."""


def decorated(path: Path) -> list[str]:
    """Names of the functions in a file that are Warp kernels."""
    functions = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.FunctionDef)]
    return sorted(f.name for f in functions if any(ast.unparse(decorator).startswith("wp.kernel") for decorator in f.decorator_list))


def kernels_of(path: Path) -> list[wp.Kernel]:
    """A file's kernels: those of the module, and those that its function ``kernels`` makes for CUDA."""
    module = import_module(".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts))
    made = vars(module.kernels()) if hasattr(module, "kernels") else {}
    kernels = [value for value in [*vars(module).values(), *made.values()] if isinstance(value, wp.Kernel)]
    return [kernel for kernel in kernels if kernel.func.__module__ == module.__name__]


def test_kernels_are_apart_from_host_code_and_memory_is_torchs() -> None:
    """Memory that Warp allocated would escape the poison of the other tests."""
    assert len(FILES) >= 5
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        assert path in FILES or not ("@wp.kernel" in text or "@wp.func" in text), path
        assert not any(f"wp.{function}(" in text for function in ("empty", "zeros", "ones", "full", "empty_like", "zeros_like")), path


@pytest.mark.parametrize("path", [path for path in FILES if decorated(path)], ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_every_kernel_compiles_for_cuda(path: Path, tmp_path: Path) -> None:
    kernels = kernels_of(path)
    assert sorted(kernel.func.__name__ for kernel in kernels) == decorated(path)
    for module in {kernel.module for kernel in kernels}:
        compiled = [file.read_text() for file in wp.compile_aot_module(module, arch=ARCHITECTURES, use_ptx=True, module_dir=tmp_path)]
        assert sorted(int(re.search(r"\.target sm_(\d+)", ptx)[1]) for ptx in compiled) == sorted(ARCHITECTURES)  # type: ignore[index]
        assert all(kernel.key in ptx for ptx in compiled for kernel in kernels if kernel.module is module)


def test_kernels_leave_room_for_others_on_a_multiprocessor(tmp_path: Path) -> None:
    """What the compiler says of registers and local memory, by the script that the documentation names. Measured: 44 to 128 registers."""
    script, file = PACKAGE.parent / "scripts" / "cuda_report.py", tmp_path / "rows.json"
    subprocess.run([sys.executable, script, "--architectures", "90", "--layers", "4", "--json", file], check=True, capture_output=True)
    rows = {row["kernel"]: row for row in json.loads(file.read_text())}
    assert len(rows) == 6 and all(16 <= row["registers"] <= 128 and row["occupancy"] >= 0.25 for row in rows.values())
    # Arrays with an entry for each of four layers, 15 numbers in all, and six pixels.
    assert all(240 + 96 <= row["local"] <= 400 for kernel, row in rows.items() if kernel.startswith("drawing"))
    assert all(row["local"] <= 64 for kernel, row in rows.items() if not kernel.startswith("drawing"))
