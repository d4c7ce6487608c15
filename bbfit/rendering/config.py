"""Which renderers there are."""

from typing import Literal

Backend = Literal["auto", "reference", "fused"]
