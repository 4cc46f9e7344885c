"""Rendering functions: validate, document, call the operators."""

from __future__ import annotations

import torch
from torch import Tensor

from . import ops
from ._validate import check_depth_range, check_faces, check_size, check_vertices, describe
from .cameras import Camera

_LARGEST_IMAGE = 8192


def _to_renderer_space(vertices: Tensor, faces: Tensor, camera: Camera | None) -> tuple[Tensor, Tensor]:
    vertices = check_vertices(vertices)
    if camera is not None:
        if not isinstance(camera, Camera):
            raise TypeError(
                f"camera must have a method transform(vertices), as nmr.LookAt does, got {describe(camera)}"
            )
        vertices = check_vertices(camera.transform(vertices))
    return vertices, check_faces(faces, vertices.shape[0], vertices.device)


def render_silhouette(
    vertices: Tensor,
    faces: Tensor,
    camera: Camera | None = None,
    *,
    image_size: int = 256,
    anti_aliasing: bool = True,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    eps: float = 1e-4,
) -> Tensor:
    """Silhouettes of meshes, with the gradient of the Neural Mesh Renderer.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
        Without a camera in renderer space: x right, y up, both in [-1, 1] across the image, z = depth. With one, in
        the space that the camera transforms from. One mesh and a camera with B poses give B images.
    faces : integer Tensor [F, 3], or [B, F, 3]
        Vertex indices; counter-clockwise on the screen is the front.
    camera : Camera, optional
        For example :class:`nmr.LookAt`.
    image_size : int
        S, pixels per side.
    anti_aliasing : bool
        Raster at 2S x 2S and average 2x2 pixels.
    fill_back : bool
        Draw faces from behind, too. Without it only faces that are counter-clockwise on the screen are drawn.
    near, far : float
        A pixel is covered only where near < depth < far. Faces are not clipped.
    eps : float
        In the gradient, added to the distance between an edge and a pixel (in units of [-1, 1]).

    Returns
    -------
    Tensor [B, S, S], dtype and device of ``vertices``
        ``alpha[b, y, x]`` is the covered share (0, 1/4, ... 1 with anti-aliasing) of the pixel in row y from the top.

    Notes
    -----
    Differentiable in x and y of ``vertices`` (and through the camera); z in renderer space gets 0. The gradient is
    defined, not derived (Kato et al. 2018, section 3): every raster line that crosses an edge of a visible face lets
    each pixel m whose change would lower the loss by D pull the edge's two vertices with D / (travel that brings the
    edge to m). The values equal those of the published kernels in float32; ``docs/conventions.md`` lists the
    departures. Results do not depend on the number of threads or on the batch size. There are no second derivatives.

    No mesh gives a NaN: faces with a non-finite corner draw nothing and get no gradient. (A loss whose own gradient is
    not finite passes that on.)

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, and for faces that refer to missing vertices.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt.from_angles(2.732, 30.0, [0.0, 90.0], half_fov_deg=15.0)
    >>> nmr.render_silhouette(0.4 * vertices, faces, camera, image_size=64).shape
    torch.Size([2, 64, 64])
    """
    check_size(image_size, "image_size", _LARGEST_IMAGE)
    check_depth_range(near, far)
    vertices, faces = _to_renderer_space(vertices, faces, camera)
    if not torch.finfo(vertices.dtype).tiny <= eps < float("inf"):
        raise ValueError(f"eps must be positive in {vertices.dtype} and finite, got {eps}")
    alpha, _ = ops.silhouette(
        vertices, faces, None, image_size, bool(anti_aliasing), bool(fill_back), float(near), float(far), float(eps)
    )
    return alpha


@torch.no_grad()
def render_face_index(
    vertices: Tensor,
    faces: Tensor,
    camera: Camera | None = None,
    *,
    image_size: int = 256,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
) -> Tensor:
    """Which face is nearest at each pixel centre; the arguments are those of :func:`render_silhouette`.

    Returns
    -------
    int32 Tensor [B, S, S]
        ``face_index[b, y, x] = f`` means face f is nearest there (seen from either side); -1 is background. Row 0 =
        top. Of equally near faces the first wins. Not differentiable.

    Raises
    ------
    TypeError, ValueError
        As :func:`render_silhouette`.
    """
    check_size(image_size, "image_size", _LARGEST_IMAGE)
    check_depth_range(near, far)
    vertices, faces = _to_renderer_space(vertices, faces, camera)
    owner = ops.rasterize(vertices, faces, None, image_size, bool(fill_back), float(near), float(far))
    num_faces = faces.shape[-2]
    return torch.where(owner >= num_faces, owner - num_faces, owner)
