"""The textures of many models in one atlas: the same pictures, and no color of a neighbor."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from billboard_scene import column
from gltf_arrays import array
from khronos import WARNING, messages
from PIL import Image
from two_models import cards_of, clouds, page_of, plain, write_models

from bbfit.checks import InputError
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.encoders import encode_webp
from bbfit.exporting.gltf import texture_files, texture_names
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Cards
from bbfit.geometry.light import Light
from bbfit.geometry.orbit import Orbit
from bbfit.glb import split_glb
from bbfit.library.shared_atlas import cell_texels, safe_level, shared_pages
from bbfit.library.stored_cards import read_cards, write_cards
from bbfit.operators.cards.reference import hits
from bbfit.operators.cards.sheets import sheets_of
from bbfit.rendering.cards import CardRenderer

SUN = Light(*(torch.tensor(values).double() for values in ([[0.0, 0.6, 0.8]], [5.0], [[1.0, 1.0, 1.0]], [0.4])))
CONFIGS = {
    "mask": ExportConfig(alpha="mask", alpha_cutoff=0.5),
    "mask with mip levels": ExportConfig(alpha="mask", alpha_cutoff=0.5, textures="ktx2"),
    "mask with the program's mip levels": ExportConfig(alpha="mask", alpha_cutoff=0.2),
    "blend in nodes": ExportConfig(alpha="blend", profile="three"),
    "hash": ExportConfig(alpha="hash"),
    "wide padding": ExportConfig(alpha="blend", padding=20),
}


def around(pixels: int) -> Camera:
    """Four cameras around the models, for pictures of a height."""
    corners = torch.tensor([[x, y, z] for x in (-1.0, 1.0) for y in (0.0, 3.0) for z in (-1.0, 1.0)])
    return Orbit(4, (15.0,)).frame(corners.double().numpy(), target=torch.tensor([0.0, 1.5, 0.0]).double(), width=pixels, height=pixels)


def compare(alone: Cards, shared: Cards, pixels: int, safe: int) -> int:
    """Require equal pictures wherever only safe mip levels show; return the number of pixels that show a card there.

    A pixel has one sample. With more, edges show what lies beyond a card, however far that is at a slant.
    """
    cameras, compared = around(pixels), 0
    for index in range(len(cameras)):
        met = hits(alone, sheets_of(alone), cameras[index])
        coarse, seen = torch.zeros(pixels, pixels, dtype=torch.bool), torch.zeros(pixels, pixels, dtype=torch.bool)
        far = met.detail > safe if alone.chain is not None else torch.zeros_like(met.detail, dtype=torch.bool)
        coarse[met.y[far], met.x[far]], seen[met.y, met.x] = True, True
        one, other = (CardRenderer(cards, multisampled=False).draw(cameras[index])[~coarse] for cards in (alone, shared))
        np.testing.assert_allclose(other, one, atol=1e-5)
        compared += int((seen & ~coarse).sum())
    return compared


@pytest.mark.parametrize("halvings", [0, 1])
@pytest.mark.parametrize("name", CONFIGS)
def test_a_model_looks_as_it_does_by_itself(name: str, halvings: int) -> None:
    """Near, and from afar, where the third mip level shows."""
    config = CONFIGS[name]
    own = cards_of(clouds(), config, halvings)
    page = page_of(own, config)
    for alone, shared in zip(own, page.cards, strict=True):
        for pixels in (48, 12, 5, 3):
            assert compare(alone, shared, pixels, safe_level(config.padding)) > 4
        assert alone.atlas.sizes.tolist() == shared.atlas.sizes.tolist()
    assert 0 < page.used <= 1


@pytest.mark.parametrize("name", CONFIGS)
def test_mip_levels_of_neighbors_do_not_mix(name: str) -> None:
    """A red model, a green one and a blue one: each cell has one color alone at all levels that are said to be safe."""
    config = CONFIGS[name]
    own = cards_of([plain((1.0, 0, 0)), plain((0, 1.0, 0)), plain((0, 0, 1.0))], config)
    page = page_of(own, config)
    safe = safe_level(config.padding)
    for channel, (alone, cards) in enumerate(zip(own, page.cards, strict=True)):
        chain = cards.chain or (cards.atlas.image,)
        cells = -(-(alone.atlas.sizes + 2 * config.padding) // (1 << safe)) << safe
        for (x, y), (width, height) in zip((cards.atlas.corners - config.padding).tolist(), cells.tolist(), strict=True):
            assert x % (1 << safe) == y % (1 << safe) == 0
            for level in range(min(safe + 1, len(chain))):
                cell = chain[level][y >> level : (y + height) >> level, x >> level : (x + width) >> level]
                assert (cell[..., channel] >= 254).all() and (np.delete(cell[..., :3], channel, -1) <= 1).all(), (name, level)
                assert cell[..., 3].any()
        # One pixel for eight texels or so: what shows has no other color.
        picture = CardRenderer(cards).draw(around(3)).reshape(-1, 4)
        assert picture[:, 3].max() > 0.2 and np.delete(picture[:, :3].numpy(), channel, -1).max() < 0.01


def test_pictures_for_programs_that_average_keep_their_filled_gaps(tmp_path: Path) -> None:
    """Of those models that have them; they survive the disk too."""
    config = CONFIGS["mask with mip levels"]
    first, second = (replace(cards, averaged=None) for cards in cards_of(clouds(), config)[:2])
    filled = second.atlas.image.copy()
    filled[filled[..., 3] == 0, 3] = 70
    write_cards(tmp_path / "second.safetensors", replace(second, averaged=filled), 3)
    page = page_of([first, read_cards(tmp_path / "second.safetensors")], config)
    for before, own, after in zip((first.atlas.image, filled), (first, second), page.cards, strict=True):
        assert after.averaged is not None
        for old, new, (width, height) in zip(own.atlas.corners, after.atlas.corners, own.atlas.sizes, strict=True):
            expected, found = (
                picture[y - 8 : y + height + 8, x - 8 : x + width + 8] for picture, (x, y) in ((before, old), (after.averaged, new))
            )
            np.testing.assert_array_equal(found, expected)
    picture = np.array(Image.open(io.BytesIO(texture_files(page.cards[0], config.resolve())["atlas.png"])).convert("RGBA"))
    np.testing.assert_array_equal(picture, page.cards[0].averaged)


def test_cells_are_apart_and_inside() -> None:
    config = ExportConfig()
    page = page_of(cards_of(clouds() * 4, config), config)
    height, width = page.image.shape[:2]
    taken = np.zeros((height, width), int)
    for cards in page.cards:
        for (x, y), (wide, high) in zip(cards.atlas.corners, cards.atlas.sizes, strict=True):
            taken[y - 8 : y + high + 8, x - 8 : x + wide + 8] += 1
            assert min(x, y) >= 8 and x + wide + 8 <= width and y + high + 8 <= height
    assert taken.max() == 1 and width % 8 == height % 8 == 0
    assert sum(cell_texels(cards, 8) for cards in page.cards) <= width * height


def test_what_does_not_fit_into_one_picture_goes_to_several() -> None:
    config = ExportConfig()
    own = cards_of(clouds() * 4, config)
    whole = max(page_of(own, config).image.shape)
    pages = shared_pages(own, config.padding, whole - 8, own_levels=False)
    assert len(pages) > 1 and [number for page in pages for number in page.models] == list(range(8))
    for page in pages:
        assert max(page.image.shape[:2]) <= whole - 8
        for number, shared in zip(page.models, page.cards, strict=True):
            assert compare(own[number], shared, 24, safe_level(config.padding)) > 100
    with pytest.raises(InputError, match=r"^page_size: the textures of one level need .* at most 32 are allowed; raise --page-size"):
        shared_pages(own, config.padding, 32, own_levels=False)
    with pytest.raises(InputError, match="padding: expected at least 4"):
        shared_pages(own, 2, 4096, own_levels=False)


def test_maps_share_the_atlas_too(tmp_path: Path) -> None:
    config = ExportConfig()
    models = [column(SUN, color) for color in ((0.6, 0.5, 0.3), (0.2, 0.5, 0.9))]
    own = cards_of(models, config)
    page = page_of(own, config)
    for alone, shared in zip(own, page.cards, strict=True):
        for pixels in (40, 10):
            assert compare(alone, shared, pixels, 3) > 4
    paths = write_models(tmp_path, page, config)
    assert texture_names(config.resolve(), maps=True) == ["atlas.png", "normals.png", "occlusion.png"]
    assert not [message for message in messages(*paths) if message["severity"] <= WARNING]
    images = split_glb(paths[0].read_bytes())[0]["images"]
    assert [image["uri"] for image in images] == texture_names(config.resolve(), maps=True)


@pytest.mark.parametrize("textures", ["png", "ktx2", "webp"])
@pytest.mark.parametrize("fallback", [True, False])
def test_files_refer_to_the_atlas(textures: str, fallback: bool, tmp_path: Path) -> None:
    """The validator accepts them with the pictures beside them; they contain no picture, and the geometry of the models by themselves."""
    if textures == "ktx2":
        pytest.importorskip("alktx2")
    config = ExportConfig(textures=textures, fallback=fallback)  # type: ignore[arg-type]
    own = cards_of(clouds(), config)
    page = page_of(own, config)
    paths = write_models(tmp_path, page, config)
    codes = {message["code"] for message in messages(*paths) if message["severity"] <= WARNING}
    # The validator does not know KTX2.
    known = {"VALUE_NOT_IN_LIST", "IMAGE_UNRECOGNIZED_FORMAT"}
    assert codes <= (known if textures == "ktx2" else set())
    for path, cards in zip(paths, page.cards, strict=True):
        tree, contents = split_glb(path.read_bytes())
        assert [image["uri"] for image in tree["images"]] == texture_names(config.resolve(), maps=False)
        assert len(contents) == len(tree["accessors"]) and not any("bufferView" in image for image in tree["images"])
        uvs = [array(tree, contents, primitive["attributes"]["TEXCOORD_0"]) for mesh in tree["meshes"] for primitive in mesh["primitives"]]
        np.testing.assert_allclose(np.concatenate(uvs), np.concatenate([card.uvs for card in cards.cards]), atol=0.5 / 65535)
    if "png" in texture_names(config.resolve(), maps=False)[0]:
        np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "atlas.png").convert("RGBA")), page.image)
    if textures == "webp":
        assert (tmp_path / "atlas.webp").read_bytes() == encode_webp(page.image)
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(encode_webp(page.image)))), page.image)


@pytest.mark.parametrize("name", CONFIGS)
def test_stored_cards_are_the_same_cards(name: str, tmp_path: Path) -> None:
    config = CONFIGS[name]
    for cards in cards_of(clouds(), config):
        write_cards(tmp_path / "cards.safetensors", cards, 3)
        again = read_cards(tmp_path / "cards.safetensors")
        assert (again.alpha, again.traced, len(again.cards)) == (cards.alpha, cards.traced, len(cards.cards))
        np.testing.assert_array_equal(again.atlas.image, cards.atlas.image)
        assert len(again.chain or ()) == min(4, len(cards.chain or ()))
        for first, second in zip(cards.cards, again.cards, strict=True):
            assert (first.culled, first.rectangle, tuple(first.ranks)) == (second.culled, second.rectangle, second.ranks)
            for field in ("corners", "uvs", "normal", "tangent", "origin"):
                np.testing.assert_array_equal(getattr(first, field), getattr(second, field))
    data = bytearray((tmp_path / "cards.safetensors").read_bytes())
    (tmp_path / "cut.safetensors").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"cut\.safetensors cannot be read"):
        read_cards(tmp_path / "cut.safetensors")
