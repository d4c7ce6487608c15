"""Tables and numbers as text."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any


def percent(ratio: float, digits: int = 3) -> str:
    """A ratio of at least 0 in percent, with so many significant digits, or more in front of the point."""
    value = 100 * ratio
    if 0 < value < 1e-4:  # where the format below turns to powers of ten
        return "< 0.0001 %"
    return f"{value:,.0f} %" if value >= 10 ** (digits - 1) else f"{value:.{digits}g} %"


def markdown(head: Sequence[str], table: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *table]
    return "".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |\n" for line in lines)


def csv_bytes(rows: Iterable[Sequence[Any]]) -> bytes:
    """A table as CSV in UTF-8; None is an empty cell."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode(errors="backslashreplace")
