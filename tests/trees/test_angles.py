"""Directions of stems against the figures: down angles, spirals and whorls, curves, splits, attraction and the pruning envelope."""

from __future__ import annotations

import math

import numpy as np
import pytest
from plain_tree import ROUNDING, angles, at_parents, by_level, directions, grown, plain

from bbfit.trees.formulas import in_envelope
from bbfit.trees.skeleton import Array, Stems
from bbfit.trees.species import known_species, load_species

# Angles of children -----------------------------------------------------------------------------------------------------------------------


def test_down_angle_varies_within_its_spread() -> None:
    species = plain(levels=3, down_angle=(0, 50, 60, 0), down_angle_v=(0, 10, 20, 0), curve_v=(40, 60, 0, 0), branches=(1, 60, 40, 0))
    trunk, branches, twigs = grown(species).levels
    for parents, stems, middle, spread in ((trunk, branches, 50, 10), (branches, twigs, 60, 20)):
        points, along = at_parents(parents, stems)
        down = angles(directions(stems)[:, 0], along)
        assert np.abs(points - stems.nodes[:, 0]).max() < ROUNDING
        assert (np.abs(down - middle) <= spread + 1e-6).all() and np.ptp(down) > 1.8 * spread


def test_negative_down_angle_v_changes_the_angle_evenly_along_the_parent() -> None:
    trunk, branches, _ = grown(load_species("quaking_aspen"), leaves=0).levels
    down = angles(directions(branches)[:, 0], at_parents(trunk, branches)[1])
    height = (1 - branches.offset) / 0.7
    assert np.abs(down - (60 - 50 * (1 - 2 * (0.2 + 0.8 * height)))).max() < 1e-6  # from 110 degrees at the crown's foot to 30 at its top


@pytest.mark.parametrize("turn", [140.0, 77.0])
def test_children_go_round_their_parent_in_a_spiral(turn: float) -> None:
    _, branches = grown(plain(rotate=by_level(1, turn))).levels
    x, y, z = directions(branches)[:, 0].T
    assert np.abs(z).max() < ROUNDING
    steps = np.diff(np.degrees(np.arctan2(y, x)))
    assert np.abs((steps - turn + 180) % 360 - 180).max() < 1e-6
    assert np.allclose(np.diff(branches.offset), 0.8 / 12)


def test_negative_rotate_puts_children_left_and_right_in_turn() -> None:
    species = plain(levels=3, rotate=(0, 140, -120, 0), down_angle=(0, 90, 50, 0), branches=(1, 5, 20, 0))
    _, branches, twigs = grown(species).levels
    out = directions(branches)[twigs.parent, 0]
    up = np.array([0.0, 0.0, 1.0])
    left = np.cross(up, out)
    heading = directions(twigs)[:, 0]
    # From below the branch, the side that nCurve above 0 bends it to, round by 120 degrees either way: above it, to the left or right.
    side = np.degrees(np.arctan2((heading * left).sum(-1), -(heading @ up)))
    assert np.abs(np.abs(side) - 120).max() < 1e-6
    for branch in range(len(branches)):
        signs = np.sign(side[twigs.parent == branch])
        assert (signs[1:] == -signs[:-1]).all()


@pytest.mark.parametrize(("figure", "size"), [(0, 1), (1, 2), (3, 4)])
def test_whorls_are_even_and_at_one_height(figure: int, size: int) -> None:
    _, branches = grown(plain(branch_dist=by_level(1, figure))).levels
    offsets, sizes = np.unique(np.round(branches.offset, 9), return_counts=True)
    assert sizes.tolist() == [size] * (12 // size)
    assert np.allclose(np.diff(offsets), 0.8 * size / 12)
    around = np.degrees(np.arctan2(branches.frames[:, 0, 1, 2], branches.frames[:, 0, 0, 2])).reshape(-1, size)
    assert np.abs((around - around[:, :1]) % 360 - 360 / size * np.arange(size)).max() < 1e-6
    assert np.abs((np.diff(around[:, 0]) - 140 + 180) % 360 - 180).max() < 1e-6


def test_whorls_of_a_broken_size_hold_every_child_once() -> None:
    _, branches = grown(plain(branch_dist=by_level(1, 0.5))).levels
    sizes = np.unique(np.round(branches.offset, 9), return_counts=True)[1]
    assert sizes.tolist() == [2, 1] * 4


# Curves -----------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [1, 2, 5, 10])
@pytest.mark.parametrize("curve", [-40.0, 30.0, 150.0])
def test_a_stem_turns_by_ncurve_in_a_plane_and_keeps_its_length(curve: float, resolution: int) -> None:
    _, branches = grown(plain(curve=by_level(1, curve), curve_res=(6, resolution, 0, 0))).levels
    turned = directions(branches)
    assert np.abs(angles(turned[:, 0], turned[:, -1]) - abs(curve)).max() < 1e-6
    assert np.abs(turned[:, -1, 2] - math.sin(math.radians(-curve))).max() < ROUNDING  # a negative curve turns a branch upwards
    normal = np.cross(turned[:, 0], [0, 0, 1.0])
    offset = branches.nodes - branches.nodes[:, :1]
    assert np.abs((offset * normal[:, None]).sum(-1)).max() < ROUNDING
    # Nodes lie on a circle of the stem's length.
    radius = branches.length / math.radians(abs(curve))
    assert np.allclose(np.linalg.norm(offset[:, -1], axis=-1), 2 * radius * math.sin(math.radians(abs(curve)) / 2), rtol=ROUNDING)


def test_curve_back_undoes_the_curve_of_the_lower_half() -> None:
    _, branches = grown(plain(curve=by_level(1, 60), curve_back=by_level(1, -60))).levels
    turned = directions(branches)
    assert np.abs(angles(turned[:, 0], turned[:, 3]) - 60).max() < 1e-6
    assert angles(turned[:, 0], turned[:, 6]).max() < 1e-5


def test_random_curvature_is_shared_out_among_the_segments() -> None:
    _, branches = grown(plain(curve_v=by_level(1, 90), branches=(1, 200, 0, 0))).levels
    turned = directions(branches)
    steps = angles(turned[:, :-1], turned[:, 1:])
    assert 14 < steps.max() <= 90 / 6 + 1e-6
    _, bent = grown(plain(bend_v=by_level(1, 90), branches=(1, 200, 0, 0))).levels
    steps = angles(directions(bent)[:, :-1], directions(bent)[:, 1:])
    assert 14 < steps.max() <= 90 / 6 + 1e-6
    assert np.abs(directions(bent)[..., 2]).max() < ROUNDING  # to the side: level branches stay level
    assert np.abs(directions(branches)[..., 2]).max() > 0.1


def test_a_helix_keeps_its_declination_and_goes_round_once() -> None:
    species = plain(curve_v=by_level(1, -30), branches=(1, 8, 0, 0), curve_res=(6, 12, 0, 0))
    trunk, branches = grown(species).levels
    chord = branches.nodes[:, -1] - branches.nodes[:, 0]
    axis = chord / np.linalg.norm(chord, axis=-1, keepdims=True)
    assert np.abs(angles(directions(branches), axis[:, None]) - 30).max() < 1e-6
    assert np.abs(angles(axis, at_parents(trunk, branches)[1]) - 90).max() < 1e-6  # the bud's own direction
    assert angles(directions(branches)[:, 0], directions(branches)[:, -1]).max() < 1e-5


# Splits -----------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("clones", [1, 2, 4])
def test_a_trunk_s_clones_spread_evenly_and_point_up_again_at_the_tip(clones: int) -> None:
    stems = grown(plain(levels=1, base_splits=clones, split_angle=by_level(0, 40))).levels[0]
    assert len(stems) == clones + 1 and stems.first.tolist() == [0] + [1] * clones and stems.root.tolist() == [0] * (clones + 1)
    turned = directions(stems)
    assert angles(turned[:, 1], np.array([0, 0, 1.0])).max() < 1e-5  # the trunk up to the split is straight
    assert np.abs(angles(turned[:, 2], np.array([0, 0, 1.0])) - 40).max() < 1e-6
    assert angles(turned[:, -1], np.array([0, 0, 1.0])).max() < 1e-5
    around = np.sort(np.degrees(np.arctan2(turned[:, 2, 1], turned[:, 2, 0])))
    assert np.allclose(np.diff(around), 360 / (clones + 1))


def clone_starts(stems: Stems) -> tuple[Array, Array]:
    """Where clones begin, and the points of the stems they split from there."""
    clones = np.flatnonzero(stems.first)
    begin = stems.nodes[clones, stems.first[clones]]
    return begin, stems.at(stems.parent[clones], stems.offset[clones])[0]


@pytest.mark.parametrize("name", [name for name in known_species() if any(load_species(name).seg_splits)])
def test_clones_start_on_the_stem_they_split_from_and_part_with_it(name: str) -> None:
    for seed in range(3):
        for stems in grown(load_species(name), seed, leaves=0).levels:
            begin, there = clone_starts(stems)
            assert len(begin) == 0 or np.abs(begin - there).max() < 1e-9
            clones = np.flatnonzero(stems.first)
            apart = np.linalg.norm(stems.nodes[clones] - stems.nodes[stems.parent[clones]], axis=-1).max(1, initial=0)
            together = int((apart < 1e-6).sum())
            assert together == 0, f"seed {seed}, level {stems.level}: {together} of {len(clones)} clones lie on the stem they split from"


def test_splits_are_as_many_as_nsegsplits_says() -> None:
    species = plain(seg_splits=by_level(1, 0.7), split_angle=by_level(1, 20), branches=(1, 50, 0, 0))
    for seed in range(5):
        branches = grown(species, seed).levels[1]
        clones = np.bincount(branches.first, minlength=6)[1:]
        assert (np.abs(clones - 0.7 * 50) <= 1).all()  # at each of the five nodes between segments
        assert len(np.unique(branches.parent[branches.first == 0])) == 1


# Attraction, envelope ---------------------------------------------------------------------------------------------------------------------


def test_tropism_pulls_twigs_up_or_down_and_only_sideways_the_rest() -> None:
    still, up, down, aside = (grown(plain(levels=3, tropism=tropism)).levels for tropism in ((0, 0, 0), (0, 0, 1), (0, 0, -1), (0.5, 0, 0)))
    heights = [levels[2].frames[:, -1, 2, 2] for levels in (down, still, up)]
    assert (heights[0] < heights[1] - 0.05).all() and (heights[1] < heights[2] - 0.05).all()
    for level in (0, 1):
        assert np.array_equal(up[level].frames, still[level].frames) and np.array_equal(down[level].frames, still[level].frames)
        east = aside[level].frames[:, :, 0, 2]
        assert (np.diff(east, axis=1) > 0).all()
    assert aside[0].frames[0, -1, 0, 2] > 0.1


def test_a_strong_pull_does_not_overshoot() -> None:
    for tropism, target in (((0, 0, 20), (0, 0, 1)), ((0, 0, -20), (0, 0, -1))):
        twigs = grown(plain(levels=3, tropism=tropism)).levels[2]
        left = angles(directions(twigs), np.array(target))  # a fifth of it after every segment, from the second on
        assert (left[:, 2:] <= 0.2 * left[:, 1:-1] + 1e-4).all() and left[:, -1].max() < 0.06


def test_one_segment_of_attraction_is_the_paper_s_angle() -> None:
    # Twigs that stand level: 90 degrees to the zenith, of which a segment takes AttractionUp / nCurveRes.
    species = plain(levels=3, down_angle=(0, 90, 90, 0), rotate=(0, 140, -90, 0), tropism=(0, 0, 0.5))
    twigs = grown(species).levels[2]
    assert np.abs(directions(twigs)[:, 0, 2]).max() < ROUNDING
    assert np.abs(angles(directions(twigs)[:, 0], directions(twigs)[:, 1]) - 90 * 0.5 / 6).max() < 1e-6


def test_pruning_cuts_to_the_envelope_by_its_ratio() -> None:
    figures = {"length": (0.9, 0.6, 0, 0), "prune_width": 0.3, "prune_width_peak": 0.4, "branches": (1, 40, 0, 0)}
    (trunk, free), (_, half), (_, full) = (grown(plain(**figures, prune_ratio=ratio)).levels for ratio in (0, 0.5, 1))
    assert len(free) == len(half) == 40 > len(full) > 30  # what is cut to nothing is left out
    kept = np.isin(free.offset, full.offset)
    trunk_length = trunk.length[0]
    shares = full.length / free.length[kept]
    assert shares.max() < 0.99 and np.abs(half.length[kept] / free.length[kept] - (1 + shares) / 2).max() < ROUNDING
    at_growth = full.nodes * (9 / trunk_length)  # before the tree was scaled to its height
    assert in_envelope(plain(**figures), 10.0, at_growth).all()


@pytest.mark.parametrize("ratio", [0.5, 1.0])
def test_pruning_a_tree_with_no_bare_trunk_leaves_a_tree(ratio: float) -> None:
    species = plain(base_size=(0,) * 4, prune_ratio=ratio, prune_width=0.4, length=(0.9, 0.3, 0, 0))
    trunk, branches = grown(species).levels
    assert trunk.length[0] == pytest.approx(10) and len(branches) >= 6
