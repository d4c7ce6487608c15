"""Resolved configurations: types in which every choice is made."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import get_args

import pytest

from bbfit.checks import InputError
from bbfit.exporting.config import ExportConfig, Profile, ResolvedExport
from bbfit.fitting.config import FitConfig, Preset, ResolvedFit
from bbfit.geometry.alpha import AlphaKind


@pytest.mark.parametrize("alpha", [None, *get_args(AlphaKind)])
@pytest.mark.parametrize("preset", get_args(Preset))
def test_a_resolved_fit_has_every_value(preset: Preset, alpha: AlphaKind | None) -> None:
    given = FitConfig(preset=preset, alpha=alpha, beta1=0.5, seed=3)
    resolved = given.resolve()
    assert type(resolved) is ResolvedFit and resolved.resolve() is resolved
    missing = {name for name, value in asdict(resolved).items() if value is None}
    chosen_by_the_fit = (
        {"billboards", "restarts", "candidates", "refinement_rounds", "trunk_billboards", "locality"} if preset == "default" else set()
    )
    assert missing == {"max_texels"} | chosen_by_the_fit
    assert {name: value for name, value in asdict(given).items() if value is not None}.items() <= asdict(resolved).items()


@pytest.mark.parametrize("name", ["alpha", "colors", "texel_density", "loss", "steps", "beta2"])
def test_a_resolved_fit_misses_no_value(name: str) -> None:
    with pytest.raises(InputError, match=f"^{name}: expected .*None"):
        replace(FitConfig().resolve(), **{name: None})


def test_values_of_a_resolved_fit_go_together() -> None:
    resolved = FitConfig(billboards=3, max_texels=3).resolve()
    with pytest.raises(InputError, match="max_texels: 3 are too few for 6 textures"):
        replace(resolved, sides="two")
    with pytest.raises(InputError, match="sides: pairs need an even placement"):
        replace(resolved, sides="pair", max_texels=None)


@pytest.mark.parametrize("profile", [None, *get_args(Profile)])
def test_a_resolved_export_has_every_choice_but_the_clouds(profile: Profile | None) -> None:
    resolved = ExportConfig(profile=profile, textures="auto").resolve()
    assert type(resolved) is ResolvedExport and resolved.resolve() is resolved
    assert resolved.textures in ("png", "ktx2") and resolved.split == (profile not in (None, "vtk", "blender"))
    assert {name for name, value in asdict(resolved).items() if value is None} - {"profile"} == {"alpha", "alpha_cutoff", "mipmaps"}
    assert not ExportConfig(profile="three", split=False).resolve().split
