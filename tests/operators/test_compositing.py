"""The over operator and the order of layers, against arithmetic done by hand."""

from __future__ import annotations

import itertools

import torch

from bbfit.operators.drawing.compositing import composite


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
