"""Light: ambient and directional, as in the Neural Mesh Renderer; point lights; highlights;
spherical harmonics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from ._packing import is_list
from ._validate import as_floats, check_flag, check_values, describe, holds_for_all

if TYPE_CHECKING:
    from .fragments import Fragments
    from .textures import Colors

__all__ = ["Lights"]

Numbers = float | Sequence | Tensor

# Real spherical harmonics of bands 0 to 2: the factors of 1; y, z, x; xy, yz, 3 z^2 - 1, xz,
# x^2 - y^2.
_HARMONICS = (
    0.28209479,
    0.48860251,
    0.48860251,
    0.48860251,
    1.09254843,
    1.09254843,
    0.31539157,
    1.09254843,
    0.54627422,
)


class _Parameter(NamedTuple):
    """What a parameter may be: one for all lights or each its own, a number or three."""

    shape: str
    per_light: bool
    vector: bool


_NUMBER = _Parameter("[] or [B]", False, False)
_NUMBERS = _Parameter("[], [L] or [B, L]", True, False)
_VECTOR = _Parameter("[3] or [B, 3]", False, True)
_VECTORS = _Parameter("[3], [L, 3] or [B, L, 3]", True, True)
# In the order of the kernel's enum LightParameter.
_PARAMETERS = {
    "ambient": _NUMBER,
    "ambient_color": _VECTOR,
    "directional": _NUMBERS,
    "directional_color": _VECTORS,
    "direction": _VECTORS,
    "point": _NUMBERS,
    "point_color": _VECTORS,
    "position": _VECTORS,
    "falloff": _NUMBERS,
    "specular": _NUMBER,
    "shininess": _NUMBER,
}
_DIRECTIONAL = ("directional", "directional_color", "direction")
_POINT = ("point", "point_color", "position", "falloff")


@dataclass(frozen=True, eq=False)
class Lights:
    """Ambient light, directional lights, point lights, the highlights of the last two, and
    spherical harmonics.

    ``rgb = color * light + highlight``, with n the unit normal in world space of the side that is
    seen (:meth:`Fragments.normals`) and x the point that is seen::

        light = ambient ambient_color + sum over lights of c relu(n . l) + sum over i of harmonics_i Y_i(n)
        highlight = specular * sum over lights with n . l > 0 of c relu(r . v)^shininess        (Phong)
        c = directional directional_color, or point point_color / (1 + falloff |position - x|^2)

    A directional light has ``l = direction``; a point light l of length 1 towards its position.
    r is l, reflected by the surface, v points towards the eye; highlights use the unit
    vector along direction, and multiply c by its length. n is the face's normal or, if ``smooth``,
    interpolated. The defaults are the published ones.

    Parameters
    ----------
    ambient : number, or Tensor [] or [B]
        Intensity without direction.
    directional : number, or Tensor [], [L] or [B, L]
        Intensity of each directional light.
    direction : [3], [L, 3] or [B, L, 3]
        World-space direction towards the light, not normalised: a longer vector gives more light.
    ambient_color : [3] or [B, 3]
    directional_color : [3], [L, 3] or [B, L, 3]
    smooth : bool
    position : [3], [L, 3] or [B, L, 3], optional; keyword only, as all that follow
        World-space positions of point lights (default: none); their number may differ from that of
        the directional ones.
    point : number, or Tensor [], [L] or [B, L]
        Intensity of each point light.
    point_color : [3], [L, 3] or [B, L, 3]
    falloff : number, or Tensor [], [L] or [B, L]
        The light falls to one half at the distance ``falloff^(-1/2)``; 0: never.
    specular : number, or Tensor [] or [B]
        Strength of highlights, which have the colour of the light. 0: none.
    shininess : number, or Tensor [] or [B]
        The larger, the smaller the highlight.
    harmonics : [9, 3] or [B, 9, 3], optional
        Light from all around as a function of n: coefficients of the real, orthonormal spherical
        harmonics 1; y, z, x; xy, yz, 3 z^2 - 1, xz, x^2 - y^2, for each colour. From those of an
        environment map L, ``harmonics = L * [1, 2/3, 1/4]`` by band (Ramamoorthi and Hanrahan 2001,
        divided by pi). It may be negative.
    normals : Tensor [V, 3], [B, V, 3], a list of [V_b, 3], :class:`NormalMap` or any object with ``sample``, optional
        World-space normals in place of the mesh's: of the vertices, outward as
        :func:`vertex_normals`, interpolated and normalised; or of pixels: ``sample(fragments) ->
        [B, H, W, 3]``. They are turned with the side of the face that is seen.

    Tensors are differentiable, and so are the vertices, through normals and lit points. Highlights
    need the eye, a constant: a camera of your own has an attribute ``eye``, [3] or [B, 3]; without
    a camera the viewer looks along z. B is the number of images.

    Raises
    ------
    TypeError, ValueError
        For values that are not floats or not finite, a negative shininess, wrong shapes, different
        numbers of lights; when drawn, also of images.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> lights = nmr.Lights(0.3, [0.7, 0.2], [[0.0, 0.8, -0.6], [1.0, 0.0, 0.0]], smooth=True)
    >>> nmr.render_rgb(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), lights=lights, image_size=64).shape
    torch.Size([1, 64, 64, 3])
    >>> lamp = nmr.Lights(0.2, 0.0, position=[2.0, 2.0, -3.0], specular=0.5, shininess=20.0, smooth=True)
    """

    ambient: Numbers = 0.5
    directional: Numbers = 0.5
    direction: Numbers = (0.0, 1.0, 0.0)
    ambient_color: Numbers = (1.0, 1.0, 1.0)
    directional_color: Numbers = (1.0, 1.0, 1.0)
    smooth: bool = False
    _: KW_ONLY
    position: Numbers | None = None
    point: Numbers = 0.5
    point_color: Numbers = (1.0, 1.0, 1.0)
    falloff: Numbers = 0.0
    specular: Numbers = 0.0
    shininess: Numbers = 20.0
    harmonics: Numbers | None = None
    normals: Tensor | list[Tensor] | Colors | None = None

    def __post_init__(self) -> None:
        unused = _POINT if self.position is None else ()
        if isinstance(self.specular, (int, float)) and self.specular == 0:
            unused = (*unused, "specular", "shininess")
        object.__setattr__(self, "_unused", unused)
        object.__setattr__(self, "smooth", check_flag(self.smooth, "smooth"))
        for name, (shape, per_light, vector) in _PARAMETERS.items():
            if name in unused:
                continue
            value = as_floats(getattr(self, name), name, shape)
            missing = 1 + per_light + vector - value.ndim  # axes that may be left out
            wrong = not 0 <= missing <= 1 + per_light or (vector and value.shape[-1] != 3)
            if wrong or 0 in value.shape:
                raise ValueError(f"{name} must have shape {shape}, got {describe(value)}")
            if not holds_for_all(value.isfinite()):
                raise ValueError(f"{name} must be finite, got {value}")
            if name == "shininess" and not holds_for_all(value >= 0):
                raise ValueError(f"shininess must be 0 or more, got {value}")
            object.__setattr__(self, name, value)
        if self.harmonics is not None:
            wanted = "[9, 3] or [B, 9, 3]"
            value = as_floats(self.harmonics, "harmonics", wanted)
            if value.ndim not in (2, 3) or value.shape[-2:] != (9, 3):
                raise ValueError(f"harmonics must have shape {wanted}, got {describe(value)}")
            if not holds_for_all(value.isfinite()):
                raise ValueError(f"harmonics must be finite, got {value}")
            object.__setattr__(self, "harmonics", value)
        if self.normals is not None and not callable(getattr(self.normals, "sample", None)):
            value = check_values(self.normals, "normals", "V, 3")
            if value[0].shape[-1] != 3:
                raise ValueError(f"normals must have 3 coordinates, got {describe(value[0])}")
        for group in (_DIRECTIONAL, _POINT):
            if group[0] in unused:
                continue
            counts = {_rows(getattr(self, name), name).shape[1] for name in group} - {1}
            if len(counts) > 1:
                names = ", ".join(group)
                shapes = ", ".join(describe(getattr(self, name)) for name in group)
                raise ValueError(
                    f"{names} must have the same number of lights (or one light), got {shapes}"
                )

    def shade(self, fragments: Fragments, colors: Tensor | None = None) -> Tensor:
        """``colors`` ``[B, H, W, 3 or 1]``, lit: ``[B, H, W, 3]``; 0 on background. Without
        colours a white surface.

        Of fragments with layers, ``[B, H, W, K, 3]``.
        """
        own = self._own_normals(fragments)
        if fragments.layers:
            colors = None if colors is None else colors.flatten(2, 3)
            own = own.flatten(2, 3) if own is not None and own.ndim == 5 else own
            return fragments._each_layer(self._shade(fragments._wide(), colors, own))
        return self._shade(fragments, colors, own)

    def _shade(self, fragments: Fragments, colors: Tensor | None, own: Tensor | None) -> Tensor:
        batch, values, layout, first = fragments.mesh.batch, [], [], 0
        for name in _PARAMETERS:
            if name in self._unused:
                layout.append((first, 1, 0))
                continue
            value = _rows(getattr(self, name), name)
            _check_images(value, name, batch)
            values.append(value.reshape(-1).to(fragments.weights))
            layout.append((first, *value.shape[:2]))
            first += value.numel()
        highlights = "specular" not in self._unused
        positions = highlights or "position" not in self._unused
        colors = None if colors is None else colors.to(fragments.weights)
        parameters, layout = torch.cat(values), torch.tensor(layout, device="cpu")
        lit = fragments._lit(colors, parameters, layout, self.smooth, positions, highlights, own)
        if self.harmonics is None:
            return lit
        x, y, z = fragments._lit(None, None, layout[:0], self.smooth, own=own).unbind(-1)
        basis = torch.stack(
            [torch.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], dim=-1
        )
        harmonics = self.harmonics.to(x).reshape(-1, 9, 3)
        _check_images(harmonics, "harmonics", batch)
        with torch.autocast(x.device.type, enabled=False):
            light = (basis * basis.new_tensor(_HARMONICS)) @ harmonics.unsqueeze(1)
        light = torch.where(fragments.covered.unsqueeze(-1), light, torch.zeros_like(light))
        return lit + (light if colors is None else colors * light)

    def _own_normals(self, fragments: Fragments) -> Tensor | None:
        """Of the vertices in the layout of the meshes, or of the pixels ``[B, H, W, 3]``."""
        if self.normals is None:
            return None
        if isinstance(self.normals, Tensor) or is_list(self.normals):
            return fragments.mesh.values(
                check_values(self.normals, "normals", "V, 3"), "normals", "vertex"
            )
        normals, shape = self.normals.sample(fragments), (*fragments.sided_face_index.shape, 3)
        if not isinstance(normals, Tensor) or normals.shape != shape:
            raise ValueError(
                f"normals.sample must return a tensor {list(shape)}, got {describe(normals)}"
            )
        return normals.to(fragments.weights)


def _check_images(value: Tensor, name: str, batch: int) -> None:
    if value.shape[0] not in (1, batch):
        raise ValueError(
            f"{name} is given for {value.shape[0]} images, but {batch} are drawn; give it once or for each"
        )


def _rows(value: Tensor, name: str) -> Tensor:
    """A parameter as ``[B or 1, L or 1, width]``."""
    _, per_light, vector = _PARAMETERS[name]
    value = value if vector else value.unsqueeze(-1)
    if not per_light:
        value = value.unsqueeze(-2)
    return value[(None,) * (3 - value.ndim)]
