"""A library of two trees, which is built once."""

from __future__ import annotations

import pytest
from library_of_two import LEVELS, SMALL, TREE

from bbfit.library.building import build_library
from bbfit.library.manifest import Library


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Library:
    """An acer with seed 1, and a tree from a file. Do not change it."""
    return build_library([TREE], tmp_path_factory.mktemp("library") / "out", LEVELS, SMALL, species=["acer"], seeds=[1])
