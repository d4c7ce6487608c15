"""The over operator and the order of layers, against arithmetic done by hand."""

from __future__ import annotations

import itertools

import pytest
import torch

from bbfit.operators.drawing.compositing import TIE, composite, composite_fragments


def layer(*values: float) -> torch.Tensor:
    """A picture of one row, [1, 1, 1, W] float64."""
    return torch.tensor(values, dtype=torch.float64).reshape(1, 1, 1, -1)


def test_over_by_hand() -> None:
    red, green = torch.tensor([1.0, 0, 0]).double().reshape(1, 3, 1, 1), torch.tensor([0, 1.0, 0]).double().reshape(1, 3, 1, 1)
    image = composite([red, green], [layer(0.25), layer(0.5)], [layer(1), layer(2)])
    assert image.flatten().tolist() == [0.25, 0.375, 0, 0.625]
    image = composite([red, green], [layer(0.25), layer(0.5)], [layer(2), layer(1)])
    assert image.flatten().tolist() == [0.125, 0.5, 0, 0.625]


def test_order_is_per_pixel_and_ties_go_to_the_lower_index() -> None:
    colors = [torch.full((1, 3, 1, 3), value, dtype=torch.float64) for value in (1.0, 0.0)]
    image = composite(colors, [layer(1, 1, 1), layer(1, 1, 1)], [layer(1, 2, 3), layer(2, 2, 1)])
    assert image[0, 0, 0].tolist() == [1, 1, 0] and (image[0, 3] == 1).all()


def test_the_order_of_the_list_does_not_matter() -> None:
    generator = torch.Generator().manual_seed(0)
    colors = [torch.rand(2, 3, 3, 5, generator=generator, dtype=torch.float64) for _ in range(4)]
    alphas = [torch.rand(2, 1, 3, 5, generator=generator, dtype=torch.float64) for _ in range(4)]
    depths = [torch.rand(2, 1, 3, 5, generator=generator, dtype=torch.float64) for _ in range(4)]
    image = composite(colors, alphas, depths)
    for order in itertools.permutations(range(4)):
        again = composite(*([values[i] for i in order] for values in (colors, alphas, depths)))
        assert torch.allclose(image, again, atol=1e-14)


def test_layers_that_are_nowhere_do_nothing() -> None:
    colors = [torch.full((1, 3, 1, 1), value, dtype=torch.float64) for value in (0.5, 1.0)]
    image = composite(colors, [layer(0.5), layer(0.0)], [layer(3), layer(torch.inf)])
    assert image.flatten().tolist() == [0.25, 0.25, 0.25, 0.5]


@pytest.mark.parametrize("nested", [False, True])
def test_fragments_show_what_layers_show(nested: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    shape = 7, 1, 6, 5
    colors, alphas = torch.rand(7, 3, 6, 5, generator=generator).double(), torch.rand(shape, generator=generator).double()
    # Few depths, so that many layers tie, some exactly and others within the tolerance.
    depths = torch.randint(1, 4, shape, generator=generator) * (1 + TIE / 4 * torch.randint(0, 3, shape, generator=generator)).double()
    present = torch.rand(shape, generator=generator) < 0.7
    layers = ([part[None] for part in stack] for stack in (colors, alphas * present, depths.where(present, torch.inf)))
    expected = composite(*layers, nested=nested)[0].permute(1, 2, 0).reshape(-1, 4)
    layer, _, y, x = present.nonzero().T
    image = composite_fragments(colors[layer, :, y, x], alphas[layer, 0, y, x], depths[layer, 0, y, x], y * 5 + x, count=30, nested=nested)
    assert torch.allclose(image, expected, atol=1e-14)
