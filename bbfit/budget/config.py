"""What a result may cost, and how good it has to be."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, InvalidOperation

from bbfit.checks import check_count, check_range, fail

_FACTORS, _MOST = {"k": 1_000, "m": 1_000_000}, 10**15


@dataclass(frozen=True)
class BudgetConfig:
    """Limits, all of which hold at once. With any of them the number of billboards, their sides, their placement and their texel density
    are chosen on validation views, which are taken out of the training views."""

    vertices: int | None = None
    """Vertices of the model at most: 4 for a billboard, 8 for a two-sided one."""
    texels: int | str | None = None
    """Texels at most; 500k and 2M are understood."""
    bytes: int | str | None = None
    """Bytes of model.glb at most; 500k and 2M are understood."""
    target_psnr: float | None = None
    """PSNR over white in dB to reach on validation views, with as few billboards as will do."""
    auto: bool = False
    """Take as many billboards as pay: until twice as many gain less than 0.75 dB."""

    def __post_init__(self) -> None:
        if self.vertices is not None:
            check_count("vertices", self.vertices, 4)
        for name in ("texels", "bytes"):
            if getattr(self, name) is not None:
                check_count(name, amount(name, getattr(self, name)))
        if self.target_psnr is not None:
            check_range("target_psnr", self.target_psnr, 0, 100, open_low=True)
            if self.auto:
                fail("auto", "it and a target PSNR both say when to stop", "leave one of them out")

    @property
    def given(self) -> bool:
        """Whether there is anything to choose for."""
        return self != BudgetConfig()

    @property
    def most_texels(self) -> int | None:
        """``texels`` as a number."""
        return None if self.texels is None else amount("texels", self.texels)

    @property
    def most_bytes(self) -> int | None:
        """``bytes`` as a number."""
        return None if self.bytes is None else amount("bytes", self.bytes)


def amount(name: str, value: int | str) -> int:
    """A whole number, or one with k (thousands) or M (millions) after it, as in ``200k`` and ``1.5M``."""
    if not isinstance(value, str):
        return value
    factor = _FACTORS.get(value[-1:].lower(), 1)
    try:
        number = Decimal(value if factor == 1 else value[:-1]) * factor
    except InvalidOperation:
        fail(name, f"{value!r} is no number", "write for example 200000, 200k or 1.5M")
    if not number.is_finite() or abs(number) > _MOST or number != int(number):
        fail(name, f"{value!r} is not a whole number", "write for example 200000, 200k or 1.5M")
    return int(number)
