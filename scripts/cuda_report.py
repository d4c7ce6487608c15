"""Report what CUDA kernels need of a GPU, without one: python scripts/cuda_report.py [--architectures N ...] [--layers N ...]

NVRTC compiles all kernels that a fit launches. The report reads from its machine code, for each kernel and architecture:

registers   of a thread
local       bytes of local memory of a thread: arrays that are indexed, and spilled registers. The kernels of drawing have arrays with room
            for the most layers in a pixel, rounded up to a power of two
occupancy   resident warps that the registers allow, over those that a multiprocessor can hold, for blocks of 256 threads
"""

from __future__ import annotations

import argparse
import json
import struct
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import warp as wp

from bbfit.operators.adam.kernels import update_blocks
from bbfit.operators.drawing.kernels import kernels as drawing
from bbfit.operators.sharpness import kernels as sharpness
from bbfit.operators.ssim.kernels import kernels as ssim

MOST_WARPS = {75: 32, 80: 64, 86: 48, 89: 48, 90: 64, 100: 64, 120: 48}
"""Warps that a multiprocessor can hold, by architecture (CUDA C++ Programming Guide, table of compute capabilities)."""
REGISTERS, WARPS_OF_A_BLOCK = 65_536, 8
# Attributes of a kernel in the section .nv.info of a cubin: the size of its frame and its number of registers.
FRAME, COUNT = 0x11, 0x2F
PAIR = 4  # the format of an attribute that has a size and, here, a symbol and a value
Row = dict[str, Any]


def attributes(cubin: bytes) -> Iterator[tuple[str, int, int]]:
    """Names of functions, attributes and values in a cubin, which is an ELF file of 64 bits."""
    (start,), (size, number, names) = struct.unpack_from("<Q", cubin, 0x28), struct.unpack_from("<HHH", cubin, 0x3A)
    headers = [struct.unpack_from("<IIQQQQ", cubin, start + index * size) for index in range(number)]

    def text(table: int, offset: int) -> str:
        begin = headers[table][4] + offset
        return cubin[begin : cubin.index(b"\0", begin)].decode()

    sections = {text(names, header[0]): index for index, header in enumerate(headers)}
    symbols, strings, info = (sections[name] for name in (".symtab", ".strtab", ".nv.info"))
    place, end = headers[info][4], headers[info][4] + headers[info][5]
    while place < end:
        form, attribute, length = struct.unpack_from("<BBH", cubin, place)
        place += 4
        if form == PAIR:
            if length == 8:
                symbol, value = struct.unpack_from("<II", cubin, place)
                yield text(strings, struct.unpack_from("<I", cubin, headers[symbols][4] + 24 * symbol)[0]), attribute, value
            place += length


def of_kernel(kernel: Any, architecture: int) -> Row:
    """Registers, local memory and occupancy of a kernel."""
    with tempfile.TemporaryDirectory() as folder:
        (file,) = wp.compile_aot_module(kernel.module, arch=architecture, use_ptx=False, module_dir=folder)
        found = {attribute: value for name, attribute, value in attributes(Path(file).read_bytes()) if name.startswith(kernel.key)}
    rounded = -(-found[COUNT] // 8) * 8  # registers are allocated eight at a time
    warps = REGISTERS // (32 * rounded) // WARPS_OF_A_BLOCK * WARPS_OF_A_BLOCK
    occupancy = min(1.0, warps / MOST_WARPS[architecture])
    return {"architecture": architecture, "registers": found[COUNT], "local": found[FRAME], "occupancy": round(occupancy, 2)}


def report(architectures: Sequence[int], layers: Sequence[int]) -> Iterator[Row]:
    """The rows, one for each kernel, number of layers and architecture."""
    kernels = [(f"drawing.{name}, {count}", getattr(drawing(count, 1), name)) for count in layers for name in ("draw", "differentiate")]
    kernels += [("ssim.sweep", ssim(1).sweep), ("sharpness.measure", sharpness.measure)]
    kernels += [("sharpness.differentiate", sharpness.differentiate), ("adam.update_blocks", update_blocks)]
    for name, kernel in kernels:
        for architecture in architectures:
            yield {"kernel": name} | of_kernel(kernel, architecture)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--architectures", type=int, nargs="+", choices=MOST_WARPS, default=[75, 90, 120], help="compute capabilities, times ten"
    )
    parser.add_argument("--layers", type=int, nargs="+", default=[4, 16, 64], help="most layers in a pixel, powers of two from 4 on")
    parser.add_argument("--json", type=Path, help="write the rows to this file as a JSON list")
    arguments = parser.parse_args()
    rows = []
    for row in report(arguments.architectures, arguments.layers):
        rows.append(row)
        print("  ".join(f"{value}" if key == "kernel" else f"{key} {value}" for key, value in row.items()), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
