"""Print the asset paths in a layer of USD, in a process of its own: ``usd_layers.py FOLDER_OF_PXR``.

Each line of standard input is the path of a layer as JSON, and the answer is a line with a list of paths, or null if the layer cannot be
read. A layer is opened alone: what it refers to is not opened. ``usd.py`` starts this file by path; it does not import bbfit.
"""

import json
import os
import sys


def main() -> None:
    """Answer until standard input ends."""
    sys.path.insert(0, sys.argv[1])
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the library prints goes to standard error
    from pxr import Sdf, Tf, UsdUtils

    for line in sys.stdin:
        names: list[str] | None = []

        def collect(name: str, names: list[str] = names) -> str:  # type: ignore[assignment]
            names.append(name)
            return name

        try:
            layer = Sdf.Layer.OpenAsAnonymous(json.loads(line))
            UsdUtils.ModifyAssetPaths(layer, collect)
        except (Tf.ErrorException, RuntimeError, TypeError):
            names = None
        answers.write(json.dumps(names) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
