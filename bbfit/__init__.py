"""bbfit: a 3D tree as a handful of textured planes that look like it from every side."""

from importlib.metadata import version

import lazy_loader

# Importing bbfit must stay fast: `bbfit --help` does not wait for torch. __init__.pyi lists the names.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = version("bbfit")
