"""What all tests of operators share."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def poisoned(poison: None) -> None:
    """An operator overwrites all memory that it allocates without a value."""
