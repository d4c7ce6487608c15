"""Options of operators."""

from typing import Literal

Backend = Literal["auto", "reference", "fused"]
Loss = Literal["l1", "l2", "backgrounds"]
