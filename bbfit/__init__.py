"""bbfit: a 3D tree as a handful of textured planes that look like it from every side."""

import os
from typing import Any

import lazy_loader

# Torch reads these variables when it is loaded. After each operation its threads wait for the next one on all cores, by default for
# milliseconds, and hold up Warp's kernels. Now they wait for a tenth of that. Large tensors get large pages.
for _name, _value in (("GOMP_SPINCOUNT", "20000"), ("THP_MEM_ALLOC_ENABLE", "1")):
    os.environ.setdefault(_name, _value)

# Importing bbfit must stay fast: `bbfit --help` does not wait for torch. __init__.pyi lists the names.
_public_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("bbfit")
    return _public_name(name)
