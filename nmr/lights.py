"""Light: ambient and directional, as in the Neural Mesh Renderer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ._validate import as_floats, describe

if TYPE_CHECKING:
    from .fragments import Fragments

__all__ = ["Lights"]

Numbers = float | Sequence | Tensor


@dataclass(frozen=True, eq=False)
class Lights:
    """Ambient light and L directional lights. Colours are multiplied by the light.

    ``light = ambient * ambient_color + sum over l of directional_l * directional_color_l * relu(n . direction_l)``,
    where n is the unit normal in world space of the side that is seen (:meth:`Fragments.normals`). n is the normal of
    the face, as in the published renderer, or, if ``smooth``, the interpolated normal of the vertices. The defaults are
    the published ones.

    Parameters
    ----------
    ambient : number, or Tensor [] or [B]
        Intensity of the light without direction.
    directional : number, or Tensor [], [L] or [B, L]
        Intensity of each light with a direction.
    direction : [3], [L, 3] or [B, L, 3]
        World-space direction towards the light. It is not normalised: a longer vector gives more light.
    ambient_color : [3] or [B, 3]
    directional_color : [3], [L, 3] or [B, L, 3]
    smooth : bool

    Tensors are differentiable, and so are the vertices through their normals. B is the number of images.

    Raises
    ------
    TypeError, ValueError
        For values that are not floats, for wrong shapes, and if the numbers of lights differ; when drawn, also if
        values per image do not match the number of images.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> lights = nmr.Lights(0.3, [0.7, 0.2], [[0.0, 0.8, -0.6], [1.0, 0.0, 0.0]], smooth=True)
    >>> nmr.render_rgb(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), lights=lights, image_size=64).shape
    torch.Size([1, 64, 64, 3])
    """

    ambient: Numbers = 0.5
    directional: Numbers = 0.5
    direction: Numbers = (0.0, 1.0, 0.0)
    ambient_color: Numbers = (1.0, 1.0, 1.0)
    directional_color: Numbers = (1.0, 1.0, 1.0)
    smooth: bool = False

    def __post_init__(self) -> None:
        shapes = {
            "ambient": ("[] or [B]", (0, 1)),
            "directional": ("[], [L] or [B, L]", (0, 1, 2)),
            "direction": ("[3], [L, 3] or [B, L, 3]", (1, 2, 3)),
            "ambient_color": ("[3] or [B, 3]", (1, 2)),
            "directional_color": ("[3], [L, 3] or [B, L, 3]", (1, 2, 3)),
        }
        for name, (shape, dimensions) in shapes.items():
            value = as_floats(getattr(self, name), name, shape)
            if value.ndim not in dimensions or 0 in value.shape or ("3" in shape and value.shape[-1] != 3):
                raise ValueError(f"{name} must have shape {shape}, got {describe(value)}")
            object.__setattr__(self, name, value)
        counts = {_per_light(self.direction, 1).shape[1], _per_light(self.directional_color, 1).shape[1]}
        counts.add(_per_light(self.directional, 0).shape[1])
        if len(counts - {1}) > 1:
            raise ValueError(
                "directional, direction and directional_color must have the same number of lights (or one light), got "
                f"{describe(self.directional)}, {describe(self.direction)} and {describe(self.directional_color)}"
            )

    def shade(self, fragments: Fragments) -> Tensor:
        """The light on each pixel, ``[B, H, W, 3]``; undefined on background."""
        rows = {
            "ambient": self.ambient.reshape(-1, 1),
            "ambient_color": self.ambient_color.reshape(-1, 3),
            "directional": _per_light(self.directional, 0).unsqueeze(-1),
            "directional_color": _per_light(self.directional_color, 1),
            "direction": _per_light(self.direction, 1),
        }
        batch = fragments.mesh.batch
        for name, value in rows.items():
            if value.shape[0] not in (1, batch):
                raise ValueError(
                    f"{name} is given for {value.shape[0]} images, but {batch} are drawn; give one or {batch}"
                )
            rows[name] = value.to(fragments.weights)
        ambient = rows["ambient"] * rows["ambient_color"]
        colors, directions = torch.broadcast_tensors(rows["directional"] * rows["directional_color"], rows["direction"])
        directional = list(zip(colors.unbind(1), directions.unbind(1), strict=True))
        if self.smooth:
            return _light(fragments.normals(smooth=True), ambient, directional, lambda row: row.view(-1, 1, 1, 3))
        normals, spread = fragments._face_normals(), fragments.mesh.spread
        front, back = (_light(side, ambient, directional, spread) for side in (normals, -normals))
        return fragments._per_side(front, back)


def _light(
    normals: Tensor, ambient: Tensor, directional: list[tuple[Tensor, Tensor]], spread: Callable[[Tensor], Tensor]
) -> Tensor:
    """The formula of :class:`Lights`; ``spread`` expands rows ``[B or 1, 3]`` to the shape of the normals."""
    light = spread(ambient)
    for color, direction in directional:
        light = light + (normals * spread(direction)).sum(-1, keepdim=True).relu() * spread(color)
    return light


def _per_light(value: Tensor, vector: int) -> Tensor:
    """``[B or 1, L or 1, ...]`` of a value whose last ``vector`` axes belong to each light."""
    return value[(None,) * (2 + vector - value.ndim)]
