"""bbfit: a 3D tree as textured planes that look like it from every side."""

from typing import Any

import lazy_loader

# Importing bbfit must stay fast: `bbfit --help` does not wait for torch. __init__.pyi lists the names.
_public_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("bbfit")
    return _public_name(name)
