"""The options of a budget: what a result may cost, and how good it has to be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from bbfit.checks import Range, amount, check_count, check_fields, fail


@dataclass(frozen=True)
class BudgetConfig:
    """Limits of a result; all of them hold at once.

    With any limit, bbfit chooses the number of billboards, their sides, placement and texel density. It compares the choices on validation
    views, which it takes from the training views.
    """

    vertices: Annotated[int, Range(4)] | None = None
    """Most vertices of the model: a billboard has 4, a two-sided one 8. Billboards are then hulls of at most 4 corners."""
    texels: int | str | None = None
    """Most texels, such as 500k or 2M."""
    bytes: int | str | None = None
    """Most bytes of model.glb, such as 500k or 2M. Billboards then have the finest outline that fits."""
    target_psnr: Annotated[float, Range(0, 100, open_low=True)] | None = None
    """PSNR in dB, the mean over four backgrounds, to reach on validation views with as few billboards as possible."""
    auto: bool = False
    """Choose as many billboards as are worth their bytes: twice the bytes have to gain 0.35 dB in short fits."""

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("texels", "bytes"):
            if getattr(self, name) is not None:
                check_count(name, amount(name, getattr(self, name)))
        if self.auto and self.target_psnr is not None:
            fail("auto", "auto and a target PSNR both decide when to stop", "leave one of them out")

    @property
    def given(self) -> bool:
        """Whether there is any limit."""
        return self != BudgetConfig()

    @property
    def most_texels(self) -> int | None:
        """``texels`` as a number."""
        return None if self.texels is None else amount("texels", self.texels)

    @property
    def most_bytes(self) -> int | None:
        """``bytes`` as a number."""
        return None if self.bytes is None else amount("bytes", self.bytes)

    @property
    def half(self) -> BudgetConfig:
        """The same with half of the texels and bytes."""
        limits = {"texels": self.most_texels, "bytes": self.most_bytes}
        halves = {name: max(1, limit // 2) for name, limit in limits.items() if limit is not None}
        return replace(self, **halves)  # type: ignore[arg-type]
