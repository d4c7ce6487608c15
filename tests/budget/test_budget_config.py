"""Limits on what a result may cost: what is understood, and what is refused by name."""

from __future__ import annotations

import dataclasses

import pytest

from bbfit.budget.config import BudgetConfig, amount
from bbfit.checks import InputError, InputTypeError


@pytest.mark.parametrize(
    ("written", "number"),
    [
        (7, 7),
        ("7", 7),
        ("60000", 60_000),
        ("60k", 60_000),
        ("60K", 60_000),
        ("0.5k", 500),
        ("1.5M", 1_500_000),
        ("2m", 2_000_000),
        ("0.000001M", 1),
        ("3.0", 3),
        ("1e3", 1000),
        ("2.01k", 2010),
        ("1.005M", 1_005_000),
    ],
)
def test_amounts(written: int | str, number: int) -> None:
    found = amount("texels", written)
    assert found == number and type(found) is int


@pytest.mark.parametrize("name", ["texels", "bytes"])
@pytest.mark.parametrize(
    ("written", "says"),
    [
        ("many", "'many' is no number; write for example 200000, 200k or 1.5M"),
        ("k", "'k' is no number"),
        ("1e9999999", "'1e9999999' is no number"),
        ("1e9999999M", "'1e9999999M' is no number"),
        ("", "'' is no number"),
        ("60kb", "'60kb' is no number"),
        ("60 000", "'60 000' is no number"),
        ("2.5", "'2.5' is not a whole number; write for example"),
        ("1.0005k", "'1.0005k' is not a whole number"),
        ("0", "expected at least 1, got 0"),
        ("0.0k", "expected at least 1, got 0"),
        ("-5k", "expected at least 1, got -5000"),
        (0, "expected at least 1, got 0"),
        ("inf", "inf"),
        ("1e999k", "1e999k"),
        ("nan", "nan"),
    ],
)
def test_amounts_that_cannot_be(name: str, written: int | str, says: str) -> None:
    with pytest.raises(InputError) as caught:
        BudgetConfig(**{name: written})  # type: ignore[arg-type]
    assert str(caught.value).startswith(f"{name}: ") and says in str(caught.value)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"vertices": 3}, "vertices: expected at least 4, got 3"),
        ({"vertices": 0}, "vertices: expected at least 4, got 0"),
        ({"target_psnr": 0}, r"target_psnr: expected a value in \(0, 100\], got 0"),
        ({"target_psnr": -1.5}, "target_psnr: .*got -1.5"),
        ({"target_psnr": 100.5}, "target_psnr: .*got 100.5"),
        ({"target_psnr": float("nan")}, "target_psnr: .*got nan"),
        ({"target_psnr": float("inf")}, "target_psnr: .*got inf"),
        ({"target_psnr": 30.0, "auto": True}, "auto: .*target PSNR both decide when to stop; leave one of them out"),
    ],
)
def test_limits_that_cannot_be(fields: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=f"^{says}"):
        BudgetConfig(**fields)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "fields",
    [{"vertices": 8.0}, {"vertices": "8"}, {"vertices": True}, {"texels": 2.5}, {"bytes": True}, {"bytes": [1]}, {"target_psnr": "30"}],
)
def test_wrong_types(fields: dict[str, object]) -> None:
    with pytest.raises(InputTypeError, match=f"^{next(iter(fields))}: expected a "):
        BudgetConfig(**fields)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "fields", [{"vertices": 4}, {"texels": 1}, {"bytes": "2k"}, {"target_psnr": 0.1}, {"target_psnr": 100}, {"auto": True}]
)
def test_one_limit_is_a_budget(fields: dict[str, object]) -> None:
    budget = BudgetConfig(**fields)  # type: ignore[arg-type]
    assert budget.given
    assert {name: value for name, value in dataclasses.asdict(budget).items() if value} == fields


def test_all_limits_go_together_but_for_two_that_say_when_to_stop() -> None:
    for last in ({"target_psnr": 30.0}, {"auto": True}):
        assert BudgetConfig(vertices=32, texels="20k", bytes="60k", **last).given  # type: ignore[arg-type]


def test_nothing_is_no_budget() -> None:
    assert not BudgetConfig().given and not BudgetConfig(auto=False).given
    assert BudgetConfig().most_texels is None and BudgetConfig().most_bytes is None


def test_limits_as_numbers() -> None:
    budget = BudgetConfig(texels="1.5M", bytes="60k")
    assert (budget.most_texels, budget.most_bytes) == (1_500_000, 60_000)
    assert (budget.texels, budget.bytes) == ("1.5M", "60k")  # as they were written
    assert (BudgetConfig(texels=5).most_texels, BudgetConfig(bytes=6).most_bytes) == (5, 6)
    assert BudgetConfig(texels=5).most_bytes is None and BudgetConfig(bytes=6).most_texels is None
