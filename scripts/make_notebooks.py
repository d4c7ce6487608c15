"""Runs the notebooks from top to bottom and saves them with small pictures, which code hosts show. About five minutes on two cores."""

from __future__ import annotations

import base64
import hashlib
import io
import sys
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from PIL import Image

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
# The largest width of a picture in pixels, and its quality as JPEG.
_WIDTH, _QUALITY = 560, 60


def small(output: Any) -> Any | None:
    """A picture as a small JPEG; None for other outputs, which tell how far a cell is or change from run to run."""
    if "image/png" not in output.get("data", {}):
        return None
    image = Image.open(io.BytesIO(base64.b64decode(output["data"]["image/png"]))).convert("RGB")
    image.thumbnail((_WIDTH, 10 * _WIDTH))
    image.save(buffer := io.BytesIO(), "jpeg", quality=_QUALITY, optimize=True)
    return nbformat.v4.new_output("display_data", data={"image/jpeg": base64.b64encode(buffer.getvalue()).decode()})


def main() -> None:
    """Run the notebooks whose names are given, or all."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        if len(sys.argv) > 1 and path.stem not in sys.argv[1:]:
            continue
        notebook = nbformat.read(path, as_version=4)
        NotebookClient(notebook, timeout=None, kernel_name="python3", resources={"metadata": {"path": NOTEBOOKS}}).execute()
        for cell in notebook.cells:
            if cell.cell_type == "code":
                cell.outputs = [kept for output in cell.outputs if (kept := small(output)) is not None]
                cell.execution_count = None
            cell.metadata.pop("execution", None)
        notebook.metadata.pop("widgets", None)
        code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
        notebook.metadata["pictures_of"] = hashlib.sha256(code.encode()).hexdigest()
        nbformat.write(notebook, path)
        print(f"{path.name}: {path.stat().st_size / 1024:.0f} KiB", flush=True)


if __name__ == "__main__":
    main()
