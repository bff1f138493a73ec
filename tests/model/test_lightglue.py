import math

import pytest
import torch
from torch import Tensor

from corrsfm.model.lightglue import deform_conv2d


def _pixel(image: Tensor, y: float, x: float) -> Tensor:
    """Bilinear value (c,) of an image (c, h, w) that is zero outside."""
    value = torch.zeros(image.shape[0])
    for row in (math.floor(y), math.floor(y) + 1):
        for column in (math.floor(x), math.floor(x) + 1):
            if 0 <= row < image.shape[1] and 0 <= column < image.shape[2]:
                value += (1 - abs(y - row)) * (1 - abs(x - column)) * image[:, row, column]
    return value


def _plain(image: Tensor, offset: Tensor, weight: Tensor, padding: tuple[int, int], mask: Tensor) -> Tensor:
    """One photo (c, h, w) by the definition, pixel by pixel."""
    outputs, _, kernel_height, kernel_width = weight.shape
    result = torch.zeros(outputs, *offset.shape[1:])
    for y in range(offset.shape[1]):
        for x in range(offset.shape[2]):
            for tap in range(kernel_height * kernel_width):
                row, column = divmod(tap, kernel_width)
                dy, dx = offset[2 * tap : 2 * tap + 2, y, x].tolist()
                value = _pixel(image, y - padding[0] + row + dy, x - padding[1] + column + dx)
                result[:, y, x] += mask[tap, y, x] * (weight[:, :, row, column] @ value)
    return result


@pytest.mark.parametrize(("kernel", "padding"), [((3, 3), (1, 1)), ((3, 2), (1, 0))])
def test_deformable_convolution_equals_its_definition(
    kernel: tuple[int, int], padding: tuple[int, int]
) -> None:
    generator = torch.Generator().manual_seed(0)
    height, width = 5, 7
    size = height + 2 * padding[0] - kernel[0] + 1, width + 2 * padding[1] - kernel[1] + 1
    taps = kernel[0] * kernel[1]
    images = torch.randn(2, 3, height, width, generator=generator)
    # Some taps end up outside of the photo.
    offsets = 3 * torch.randn(2, 2 * taps, *size, generator=generator)
    weight = torch.randn(4, 3, *kernel, generator=generator)
    bias = torch.randn(4, generator=generator)
    mask = torch.rand(2, taps, *size, generator=generator)
    expected = [
        _plain(image, offset, weight, padding, factors) + bias[:, None, None]
        for image, offset, factors in zip(images, offsets, mask, strict=True)
    ]
    found = deform_conv2d(images, offsets, weight, bias, padding, mask)
    torch.testing.assert_close(found, torch.stack(expected), atol=1e-4, rtol=1e-4)


def test_without_offsets_it_is_a_convolution() -> None:
    generator = torch.Generator().manual_seed(1)
    images = torch.randn(1, 2, 6, 5, generator=generator)
    weight = torch.randn(3, 2, 3, 3, generator=generator)
    found = deform_conv2d(images, torch.zeros(1, 18, 6, 5), weight, padding=(1, 1))
    expected = torch.nn.functional.conv2d(images, weight, padding=1)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)
