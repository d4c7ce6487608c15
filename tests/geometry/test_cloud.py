"""The billboard cloud: its layout in memory, its file, and the thesis's even arrangement."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from full_disk import FULL, full_disk
from safetensors.torch import save_file

from bbfit.checks import InputError, MissingFileError
from bbfit.geometry.cloud import FORMAT, TENSORS, BillboardCloud, even_upright


def small_cloud(dtype: torch.dtype = torch.float32) -> BillboardCloud:
    """Two billboards, one of them two-sided, with random texels."""
    cloud = even_upright(
        2,
        axis=torch.tensor([0.1, 2.0, -0.3], dtype=dtype),
        half_extents=torch.tensor([[1.0, 2.0], [0.5, 0.25]], dtype=dtype),
        texture_sizes=torch.tensor([[3, 2], [4, 5]]),
    )
    cloud = replace(cloud, two_sided=torch.tensor([False, True]), texels=torch.zeros(6 + 40, 4, dtype=dtype))
    return cloud.with_texels(torch.rand(46, 4, generator=torch.Generator().manual_seed(0), dtype=dtype))


def test_textures_are_views_into_the_texels_in_order() -> None:
    cloud = small_cloud()
    first, second = cloud.textures()
    assert first.shape == (1, 3, 2, 4) and second.shape == (2, 4, 5, 4)
    assert torch.equal(torch.cat([first.reshape(-1, 4), second[0].reshape(-1, 4), second[1].reshape(-1, 4)]), cloud.texels)
    second[1, 3, 4] = 0.5
    assert (cloud.texels[-1] == 0.5).all()


def test_counts() -> None:
    cloud = small_cloud()
    assert len(cloud) == 2 and cloud.vertex_count == 4 * 3


def test_dtype_conversion_leaves_whole_numbers_alone() -> None:
    cloud = small_cloud().to(torch.float64)
    kinds = {name: getattr(cloud, name).dtype for name in TENSORS}
    assert kinds.pop("texture_sizes") == torch.int64 and kinds.pop("two_sided") == torch.bool
    assert set(kinds.values()) == {torch.float64}


def mixed_cloud(count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> BillboardCloud:
    """Billboards that all differ in place and size, every third of them two-sided, with random texels."""
    generator = torch.Generator().manual_seed(seed)
    vectors = [torch.randn(count, n, generator=generator, dtype=dtype) for n in (3, 3, 3, 2)]
    sizes = torch.randint(1, 6, (count, 2), generator=generator)
    two_sided = torch.arange(count) % 3 == 1
    texels = torch.rand(int((sizes.prod(-1) * (1 + two_sided.long())).sum()), 4, generator=generator, dtype=dtype)
    return BillboardCloud(*vectors, sizes, two_sided, texels)


def assert_same(a: BillboardCloud, b: BillboardCloud) -> None:
    for name in TENSORS:
        ours, theirs = getattr(a, name), getattr(b, name)
        assert ours.dtype == theirs.dtype and torch.equal(ours, theirs), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bare_rectangles_have_transparent_texels_that_take_no_memory(dtype: torch.dtype) -> None:
    cloud = small_cloud(dtype)
    tracked = cloud.with_texels(cloud.texels.clone().requires_grad_())
    without_textures = tracked.without_textures()
    assert_same(without_textures, cloud.with_texels(torch.zeros_like(cloud.texels)))
    assert (
        without_textures.texels.untyped_storage().nbytes() == 4 * cloud.texels.element_size() and not without_textures.texels.requires_grad
    )
    with pytest.raises(RuntimeError):
        without_textures.texels.add_(1)
    assert [texture.shape for texture in without_textures.textures()] == [texture.shape for texture in cloud.textures()]
    assert tracked.texels.any()


@pytest.mark.parametrize("kept", [[0], [4], [1, 2], [3, 1], [2, 2, 0], [5, 4, 3, 2, 1, 0], []])
def test_taken_billboards_keep_all_that_is_theirs_in_the_given_order(kept: list[int]) -> None:
    cloud = mixed_cloud(6)
    some = cloud.take(number for number in kept)
    assert len(some) == len(kept) and len(some.textures()) == len(kept)
    for ours, number in zip(range(len(kept)), kept, strict=True):
        for name in TENSORS:
            if name != "texels":
                assert torch.equal(getattr(some, name)[ours], getattr(cloud, name)[number]), name
        assert torch.equal(some.textures()[ours], cloud.textures()[number])
    assert_same(cloud, mixed_cloud(6))


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_parts_are_equal_numbers_of_billboards_in_order(count: int) -> None:
    cloud = mixed_cloud(6)
    parts, each = cloud.parts(count), 6 // count
    assert [len(part) for part in parts] == [each] * count
    for number, part in enumerate(parts):
        assert_same(part, cloud.take(range(each * number, each * number + each)))
    assert_same(BillboardCloud.joined(parts), cloud)


def test_joined_clouds_are_the_clouds_one_after_the_other() -> None:
    """Of any number of billboards each, also none."""
    clouds = [mixed_cloud(3, 1), mixed_cloud(1, 2), mixed_cloud(4, 3).take([]), mixed_cloud(4, 4)]
    whole = BillboardCloud.joined(clouds)
    assert len(whole) == 8
    assert_same(whole.take(range(3)), clouds[0])
    assert_same(whole.take([3]), clouds[1])
    assert_same(whole.take(range(4, 8)), clouds[3])
    assert_same(BillboardCloud.joined(clouds[:1]), clouds[0])
    nothing = BillboardCloud.joined([cloud.take([]) for cloud in clouds])
    assert len(nothing) == 0 and nothing.texels.shape == (0, 4)


def test_gradients_pass_through_parts_and_joins() -> None:
    cloud = mixed_cloud(4)
    leaves = {name: getattr(cloud, name).clone().requires_grad_() for name in ("centers", "texels")}
    second, first = replace(cloud, **leaves).parts(2)[::-1]
    whole = BillboardCloud.joined([second, first, second])
    weights = torch.arange(1.0, len(whole.texels) + 1)
    ((whole.texels.sum(-1) * weights).sum() + (whole.centers.sum(-1) * weights[: len(whole)]).sum()).backward()
    assert leaves["centers"].grad is not None and leaves["texels"].grad is not None
    assert leaves["centers"].grad[:, 0].tolist() == [3, 4, 1 + 5, 2 + 6]
    n, m = len(second.texels), len(first.texels)
    expected = torch.cat([weights[n : n + m], weights[:n] + weights[n + m :]])
    assert torch.equal(leaves["texels"].grad, expected[:, None].expand(-1, 4))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_upright_billboards_stand_evenly_around_the_axis(count: int) -> None:
    axis = torch.tensor([1.0, 2, 3], dtype=torch.float64)
    cloud = even_upright(count, axis=axis, half_extents=torch.ones(2).double(), texture_sizes=torch.tensor([2, 3]))
    azimuth = torch.atan2(cloud.normals[:, 0], cloud.normals[:, 2])  # 0 faces +Z, 90 degrees faces +X
    assert torch.allclose(azimuth * 180 / math.pi, torch.arange(count).double() * 180 / count)
    assert (cloud.ups == torch.tensor([0.0, 1, 0])).all() and (cloud.rights[:, 1] == 0).all()
    assert torch.allclose(cloud.rights.norm(dim=-1), torch.ones(count).double())
    assert (cloud.centers == axis).all() and (cloud.texels == 0).all() and len(cloud.texels) == 6 * count
    assert cloud.vertex_count == 4 * count


def test_two_sided_billboards_own_two_textures() -> None:
    cloud = even_upright(3, axis=torch.zeros(3), half_extents=torch.ones(2), texture_sizes=torch.tensor([2, 3]), sides="two")
    assert cloud.two_sided.all() and len(cloud.texels) == 36 and cloud.vertex_count == 24


def test_a_pair_stands_a_gap_apart_along_the_normal() -> None:
    half_extents = torch.tensor([[1.0, 2], [3, 4]])
    axis = torch.tensor([1.0, 2, 3])
    cloud = even_upright(2, axis=axis, half_extents=half_extents, texture_sizes=torch.tensor([2, 3]), sides="pair", gap=0.5)
    assert len(cloud) == 4 and not cloud.two_sided.any() and cloud.vertex_count == 16
    assert torch.equal(cloud.half_extents, half_extents[[0, 0, 1, 1]])
    expected = torch.tensor([[0, 0, 0.25], [0, 0, -0.25], [0.25, 0, 0], [-0.25, 0, 0]])
    assert torch.allclose(cloud.centers - axis, expected, atol=1e-6)


@pytest.mark.parametrize(("count", "sides"), [(0, "one"), (-1, "one"), (2.0, "one"), (True, "one"), (2, "both")])
def test_bad_arrangements_are_refused(count: int, sides: str) -> None:
    with pytest.raises(InputError, match="expected"):
        even_upright(count, axis=torch.zeros(3), half_extents=torch.ones(2), texture_sizes=torch.tensor([2, 3]), sides=sides)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("centers", torch.zeros(3)),
        ("centers", torch.zeros(3, 3)),
        ("ups", torch.zeros(2, 2)),
        ("texels", torch.zeros(45, 4)),
        ("texels", torch.zeros(46, 3)),
        ("texture_sizes", torch.tensor([[3, 2], [0, 5]])),
        ("texture_sizes", torch.tensor([[3.0, 2], [4, 5]])),
        ("two_sided", torch.tensor([0, 1])),
    ],
)
def test_inconsistent_tensors_are_refused(name: str, value: torch.Tensor) -> None:
    with pytest.raises(InputError, match="expected"):
        replace(small_cloud(), **{name: value})


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_file_gives_back_the_same_bits(tmp_path: Path, dtype: torch.dtype) -> None:
    cloud, path = small_cloud(dtype), tmp_path / "cloud.safetensors"
    replace(cloud, texels=cloud.texels.requires_grad_()).save(path)
    loaded = BillboardCloud.load(path)
    for name in TENSORS:
        before, after = getattr(cloud, name).detach(), getattr(loaded, name)
        assert before.dtype == after.dtype and torch.equal(before, after)
    assert [p.name for p in tmp_path.iterdir()] == ["cloud.safetensors"]


def test_tensors_that_share_memory_or_are_strided_are_saved(tmp_path: Path) -> None:
    cloud, path = small_cloud(), tmp_path / "cloud.safetensors"
    both = torch.stack([cloud.rights, cloud.ups], -1)
    shared = replace(cloud, centers=both[..., 1], rights=both[..., 0], ups=both[..., 1])
    shared.save(path)
    assert torch.equal(BillboardCloud.load(path).ups, both[..., 1])


HALF = math.sqrt(0.5)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("half_extents", lambda extents: extents.to(torch.int32), "dtype: expected one of torch.float32"),
        ("half_extents", lambda extents: -extents, "half_extents: expected more than 0"),
        ("half_extents", lambda extents: extents * 0, "half_extents: expected more than 0"),
        ("half_extents", lambda extents: extents * 1e20, "half_extents: expected more than 0 and at most 1e\\+06"),
        ("centers", lambda centers: centers + 1e20, "centers: expected at most 1e\\+06 meters"),
        ("centers", lambda centers: centers.to(torch.float8_e4m3fn), "centers's dtype: expected one of"),
        ("centers", lambda centers: centers.to(torch.complex64), "centers's dtype: expected one of"),
        ("rights", lambda rights: rights * 0, "rights: expected unit vectors"),
        ("rights", lambda rights: rights * 1000, "rights: expected unit vectors"),
        ("ups", lambda ups: ups.double(), "ups's dtype: expected one of torch.float32"),
        ("ups", lambda ups: ups * 1.01, "ups: expected unit vectors"),
        ("ups", lambda ups: torch.tensor([[1.0, 0, 0], [0, 0, 1.0]]), "ups: expected vectors perpendicular"),
        ("ups", lambda ups: torch.tensor([[HALF, HALF, 0], [HALF, HALF, 0]]), "ups: expected vectors perpendicular"),
        ("texels", lambda texels: texels * 1000, r"texels: expected values in \[0, 1\]"),
        ("texels", lambda texels: texels - 1, r"texels: expected values in \[0, 1\]"),
        ("texels", lambda texels: texels.to(torch.complex64), "texels's dtype: expected one of"),
    ],
)
def test_malformed_clouds_are_refused_and_never_written(tmp_path: Path, name: str, change: Callable, says: str) -> None:
    cloud, path = small_cloud(), tmp_path / "cloud.safetensors"
    malformed = replace(cloud, **{name: change(getattr(cloud, name))})
    with pytest.raises(InputError, match=says):
        malformed.save(path)
    assert not path.exists()
    save_file(tensors_of(malformed), path, {"format": FORMAT})
    with pytest.raises(InputError, match=rf"^cloud: .*cloud\.safetensors is damaged \(.*{says}.*\); expected a file written") as caught:
        BillboardCloud.load(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "alpha", ["[" * 100_000, '{"kind": [}', '{"cutoff": ' + "9" * 5000 + "}", '{"color": 1}', "null", '"blend"', '{"cutoff": NaN}']
)
def test_hostile_metadata_of_a_cloud_is_refused_in_one_line(tmp_path: Path, alpha: str) -> None:
    path = tmp_path / "cloud.safetensors"
    save_file(tensors_of(small_cloud()), path, {"format": f"{FORMAT} {alpha}"})
    with pytest.raises(InputError, match=r"^cloud: .*cloud\.safetensors .*expected a file written by bbfit fit$") as caught:
        BillboardCloud.load(path)
    assert "\n" not in str(caught.value)


def test_an_empty_cloud_is_saved(tmp_path: Path) -> None:
    empty = BillboardCloud(
        *(torch.zeros(0, n) for n in (3, 3, 3, 2)),
        torch.zeros(0, 2, dtype=torch.int64),
        torch.zeros(0, dtype=torch.bool),
        torch.zeros(0, 4),
    )
    empty.save(tmp_path / "cloud.safetensors")
    assert len(BillboardCloud.load(tmp_path / "cloud.safetensors")) == 0


def test_a_failed_save_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "cloud.safetensors"
    small_cloud().save(path)
    before = path.read_bytes()
    with full_disk(), pytest.raises(InputError, match=FULL):
        small_cloud(torch.float64).save(path)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == [path.name]


def tensors_of(cloud: BillboardCloud) -> dict[str, torch.Tensor]:
    return {name: getattr(cloud, name) for name in TENSORS}


def test_unusable_files_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "cloud.safetensors"
    good, known = tensors_of(small_cloud()), {"format": FORMAT}
    with pytest.raises(MissingFileError, match=r"cloud\.safetensors"):
        BillboardCloud.load(path)
    small_cloud().save(path)
    whole = path.read_bytes()

    damaged: list[bytes] = [b"", b"{}", b"\0" * 64, whole[:5], whole[:100], whole[:-1], b"\x89PNG" + whole[4:]]
    for data in damaged:
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"cloud\.safetensors"):
            BillboardCloud.load(path)

    nan = good["texels"].clone()
    nan[3, 1] = torch.nan
    foreign = [
        (good, None),
        (good, {"format": "another"}),
        ({k: v for k, v in good.items() if k != "ups"}, known),
        (good | {"texels": nan}, known),
        (good | {"texels": torch.zeros(3, 4)}, known),
        (good | {"texture_sizes": torch.tensor([[3, 2], [-4, 5]])}, known),
        (good | {"texture_sizes": torch.rand(2, 2)}, known),
        (good | {"centers": torch.tensor(1.0)}, known),
    ]
    for tensors, metadata in foreign:
        save_file(tensors, path, metadata)
        with pytest.raises(InputError, match=r"cloud\.safetensors.*bbfit fit"):
            BillboardCloud.load(path)
    with pytest.raises(InputError, match=r"is a folder; give the file .*cloud\.safetensors"):
        BillboardCloud.load(tmp_path)
    with pytest.raises(InputError, match="not a file"):
        BillboardCloud.load(tmp_path.parent)
    (tmp_path / "model.glb").write_bytes(b"glTF")
    with pytest.raises(InputError, match="is a model; give the cloud"):
        BillboardCloud.load(tmp_path / "model.glb")
