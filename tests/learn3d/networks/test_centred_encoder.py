"""The encoder for which every object is scaled to one size (conv-centred)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from learn3d.networks import create_encoder
from learn3d.networks.encoders import CENTRED_SHARE, centre


def box(image: Tensor) -> tuple[int, int, int, int]:
    """Top, bottom, left, right (excluded) of the mask of an image [4,S,S]."""
    rows, columns = ((image[3] > 0.5).any(axis).nonzero()[:, 0] for axis in (1, 0))
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


def wedge(size: int) -> Tensor:
    """A right-angled triangle with a gradient of colours, [1,4,size,size], that fills the image."""
    y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    inside = (x <= y).float()
    return torch.stack([inside * x / size, inside * y / size, inside, inside])[None]


def placed(size: int, top: int, left: int) -> Tensor:
    """The wedge with this side and corner in an empty image [1,4,64,64]."""
    return F.pad(wedge(size), (left, 64 - size - left, top, 64 - size - top))


def test_the_object_takes_the_same_part_wherever_and_however_large_it_is() -> None:
    images = torch.cat([placed(20, 3, 40), placed(40, 23, 1), placed(60, 2, 2)])
    centred = centre(images)
    extent = round(64 * CENTRED_SHARE)
    first = (64 - extent) // 2
    for image in centred:
        for found, wanted in zip(box(image), (first, first + extent) * 2, strict=True):
            assert abs(found - wanted) <= 1
    assert (centred[1:] - centred[:1]).abs().mean() < 0.02


def test_the_background_goes_on_beyond_the_border_and_the_mask_does_not() -> None:
    image = torch.ones(1, 4, 64, 64)
    image[:, 3, :, 40:] = 0  # the object fills the height: it must become smaller
    image[:, :3, :, :40] = 0.25
    centred = centre(image)[0]
    top, bottom, left, right = box(centred)
    assert abs(bottom - top - 64 * CENTRED_SHARE) <= 1
    assert abs((left + right) / 2 - 32) <= 1
    assert torch.equal(centred[:3, 30, -1], torch.ones(3))
    assert not centred[3, 0].any()


def test_an_image_without_a_mask_stays_as_it_is() -> None:
    images = torch.rand(2, 4, 64, 64)
    images[:, 3] = 0.4
    assert torch.equal(centre(images), images)


def test_codes_do_not_depend_on_place_and_size() -> None:
    torch.manual_seed(0)
    encoder = create_encoder("conv-centred", inverted=False)
    with torch.no_grad():
        small, large, other = encoder(torch.cat([placed(30, 3, 30), placed(60, 2, 2), placed(60, 2, 2).flip(2)]))
    assert (small - large).norm() < 0.2 * (large - other).norm()
