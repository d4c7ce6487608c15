"""What frames take time for, and which models no other one beats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bbfit.checks import InputError, MissingFileError
from bbfit.exporting.config import LodConfig, Profile
from bbfit.files import write_json
from bbfit.frames.costs import frame_costs
from bbfit.lod import with_measured_speed
from bbfit.reporting.frame_tables import FrameCosts, FrameRow, Machine, fastest, frames_json, frames_markdown

MACHINE = Machine("a processor, 2 cores", "a renderer", "a browser", "1280 x 720 pixels", 0.0)


def row(model: str = "planes", **figures: object) -> FrameRow:
    usual: dict[str, object] = {"tree_pixels": 100, "count": 100, "ms": 1.0, "update_ms": 0.0, "frames": 7, "calls": 1, "triangles": 1000}
    more = {"fragments": 1e5, "card_bytes": 1000, "file_bytes": 1000, "flip": 0.1, "psnr": 20.0, "error_pixels": 100.0}
    return FrameRow("three r187", model, f"the {model}", "mesh", **(usual | more | figures))  # type: ignore[arg-type]


def field(random: np.random.Generator, noise: float) -> FrameRow:
    """A frame of 200 ns a tree, 30 ns a triangle and 1.5 ns a fragment."""
    count, triangles, fragments = (int(np.exp(random.uniform(*np.log(limits)))) for limits in ((10, 1e4), (1e3, 1e7), (1e5, 1e8)))
    ms = (200 * count + 30 * triangles + 1.5 * fragments) / 1e6
    return row(count=count, triangles=triangles, fragments=float(fragments), ms=ms * float(np.exp(random.normal(0, noise))))


@pytest.mark.parametrize(("noise", "allowed"), [(0.0, 1e-6), (0.05, 0.15)])
def test_costs_are_those_of_which_the_frames_consist(noise: float, allowed: float) -> None:
    random = np.random.default_rng(0)
    (cost,) = frame_costs([field(random, noise) for _ in range(60)])
    assert (cost.triangle_ns, cost.fragment_ns) == pytest.approx((30.0, 1.5), rel=allowed)
    assert cost.fragments_per_triangle == pytest.approx(20.0, rel=2 * allowed)
    assert cost.error <= 1.5 * noise + 1e-9 and cost.fields == 60


def test_without_fragments_or_with_few_fields_nothing_is_claimed() -> None:
    random = np.random.default_rng(0)
    fields = [field(random, 0.0) for _ in range(6)]
    assert frame_costs(fields) and not frame_costs(fields[:5]) and not frame_costs([])
    assert not frame_costs([row(fragments=None)] * 9)


@pytest.mark.parametrize(("profile", "expected"), [("three", 20.0), ("babylon", 5.0), ("unity", 20.0), (None, 20.0)])
def test_levels_of_detail_take_the_number_of_the_profiles_program(profile: Profile | None, expected: float, tmp_path: Path) -> None:
    costs = [FrameCosts(name, 0.0, number, 1.0, 0.1, 9) for name, number in (("three.js 1", 20.0), ("Babylon.js 9", 5.0))]
    write_json(tmp_path / "frames.json", frames_json([], [FrameCosts("another 1", 0.0, 9.0, 0.0, 0.1, 9), *costs], MACHINE))
    assert with_measured_speed(LodConfig(frames=tmp_path), profile) == LodConfig(fragments_per_triangle=expected)
    assert with_measured_speed(LodConfig(), profile) == LodConfig()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "frames: .*is not valid JSON"),
        ("{}", "frames: .*'costs' is missing.*start bbfit frames again"),
        ('{"costs": []}', "no program's time of a triangle"),
        ('{"costs": [{"program": "three.js", "tree_ns": "x"}]}', "start bbfit frames again"),
    ],
)
def test_a_measurement_that_says_nothing_is_one_line(content: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "frames.json").write_text(content)
    with pytest.raises(InputError, match=rf"^(?=[^\n]+$).*{said}"):
        with_measured_speed(LodConfig(frames=tmp_path), "three")


def test_a_number_and_a_measurement_are_refused_together(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="frames: fragments_per_triangle is given too"):
        LodConfig(frames=tmp_path, fragments_per_triangle=4.0)
    with pytest.raises(MissingFileError, match="frames"):
        with_measured_speed(LodConfig(frames=tmp_path / "none"), None)


def test_a_model_that_no_other_one_beats_has_a_star() -> None:
    """At the largest number of trees of all: at that of a single one, the slow model would win."""
    rows = [
        row("good", count=100, ms=5.0, flip=0.1),
        row("good", count=1000, ms=50.0, flip=0.1),
        row("fast", count=100, ms=1.0, flip=0.2),
        row("worse", count=100, ms=6.0, flip=0.1),
        row("unknown", count=100, ms=0.5, flip=None),
    ]
    assert fastest(rows) == {"good", "fast"}
    random = np.random.default_rng(0)
    text = frames_markdown(rows, frame_costs([field(random, 0.0) for _ in range(9)]), MACHINE)
    lines = {line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| the ")}
    assert lines == {"the good *", "the fast *", "the worse", "the unknown"}
    assert "| three r187 | 200.0 | 30.0 | 1.5 | 20 | 9 | 0 % |" in text
    assert fastest([]) == set() and fastest([row(flip=None)]) == set()
