"""Pictures of meshes with flat shading, for data sets and figures; not differentiable."""

from __future__ import annotations

import numpy as np
import torch

import nmr

KEY_LIGHT = (0.45, 0.8, -0.4)  # towards the light, object frame (x right, y up, -z towards the camera of view 0)
BACK_LIGHT = 0.35  # share of the diffuse light that comes from the opposite side: shadow sides keep their relief


def shade_mesh(
    vertices: torch.Tensor,
    faces: torch.Tensor,
    face_colors: np.ndarray,
    cameras: nmr.LookAt | nmr.cameras.Projection,
    *,
    image_size: int,
    supersample: int = 2,
    ambient: float = 0.5,
    light: tuple[float, float, float] = KEY_LIGHT,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw one mesh from B cameras with flat, two-sided Lambert shading, composited over white.

    Each face reflects `color * (ambient + (1 - ambient) * (relu(n.l) + BACK_LIGHT * relu(-n.l)))`, with n its normal
    turned towards the camera (raw meshes have faces of either winding) and l the unit vector along `light`. A pixel is
    the mean of its supersample^2 subpixels, of which the uncovered ones are white.

    Parameters
    ----------
    vertices : float [V, 3], object frame. Tensor or array.
    faces : integer [F, 3].
    face_colors : float [F, 3] or [3], RGB in [0, 1].
    cameras : nmr.LookAt with a batch of B, or nmr.cameras.Projection with a batch of B and parallel rays.
    image_size : side S of the pictures, in pixels.
    supersample : subpixels per pixel and axis; 2 covers exactly what `nmr.render_silhouette` covers (anti-aliased).
    ambient : share of the light that has no direction, in [0, 1].
    light : direction towards the light in the object frame, any length but 0.

    Returns
    -------
    rgb : uint8 [B, S, S, 3], row 0 = top, white background.
    alpha : uint8 [B, S, S], 255 * the covered share of the pixel.

    Raises
    ------
    ValueError : shapes that do not fit, ambient outside [0, 1], no light direction, a Projection with perspective.
    """
    vertices = torch.as_tensor(vertices, dtype=torch.float32).detach().cpu()
    faces = torch.as_tensor(faces).detach().cpu()
    if vertices.ndim != 2 or vertices.shape[-1] != 3 or faces.ndim != 2 or faces.shape[-1] != 3:
        raise ValueError(
            "shade_mesh draws one mesh: vertices must be [V, 3] and faces [F, 3], "
            f"got {list(vertices.shape)} and {list(faces.shape)}"
        )
    colors = np.asarray(face_colors, dtype=np.float32)
    if colors.shape not in ((3,), (len(faces), 3)):
        raise ValueError(f"face_colors must be [3] or [{len(faces)}, 3] (one per face), got {list(colors.shape)}")
    direction = np.asarray(light, dtype=np.float64)
    if direction.shape != (3,) or not np.isfinite(direction).all() or not direction.any():
        raise ValueError(f"light must be three finite numbers, not all zero, got {light}")
    if not 0.0 <= ambient <= 1.0:
        raise ValueError(f"ambient must lie in [0, 1], got {ambient}")
    if isinstance(cameras, nmr.cameras.Projection) and cameras.perspective:
        raise ValueError("shade_mesh knows perspective cameras as nmr.LookAt only, got an nmr.cameras.Projection")
    if image_size < 1 or supersample < 1:
        raise ValueError(f"image_size and supersample must be at least 1, got {image_size} and {supersample}")

    index = nmr.render_face_index(vertices, faces, cameras, image_size=image_size * supersample).numpy()
    intensity = _intensity(vertices.numpy(), faces.numpy(), cameras, ambient, direction / np.linalg.norm(direction))
    covered = index >= 0
    view, row, column = np.nonzero(covered)
    face = index[view, row, column]
    ink = np.zeros((*index.shape, 3), dtype=np.float32)  # 1 - colour, 0 on the white background
    lit = np.clip(colors, 0.0, 1.0)
    ink[view, row, column] = 1.0 - (lit if lit.ndim == 1 else lit[face]) * intensity[view, face, None]
    rgb = 255.0 * (1.0 - _pool(ink, image_size, supersample))
    alpha = 255.0 * _pool(covered[..., None].astype(np.float32), image_size, supersample)[..., 0]
    return np.rint(rgb).astype(np.uint8), np.rint(alpha).astype(np.uint8)


def _intensity(
    vertices: np.ndarray,
    faces: np.ndarray,
    cameras: nmr.LookAt | nmr.cameras.Projection,
    ambient: float,
    light: np.ndarray,
) -> np.ndarray:
    """Light on each face as each camera sees it: float32 [B, F] in [0, 1]."""
    corners = vertices.astype(np.float64)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    if isinstance(cameras, nmr.cameras.Projection):
        towards_eye = -cameras.matrix[:, 2, :3].numpy().astype(np.float64) @ normals.T
    else:
        eye = np.atleast_2d(torch.as_tensor(cameras.eye).detach().cpu().numpy()).astype(np.float64)
        towards_eye = eye @ normals.T - np.einsum("fi,fi->f", normals, corners[:, 0])
    facing = np.where(towards_eye < 0, -1.0, 1.0) * (normals @ light)
    diffuse = np.where(facing > 0, facing, -BACK_LIGHT * facing)
    return (ambient + (1.0 - ambient) * diffuse).astype(np.float32)


def _pool(images: np.ndarray, size: int, factor: int) -> np.ndarray:
    """Mean over factor x factor blocks: [B, size * factor, size * factor, C] -> [B, size, size, C]."""
    total = np.zeros((len(images), size, size, images.shape[-1]), dtype=np.float32)
    for row in range(factor):
        for column in range(factor):
            total += images[:, row::factor, column::factor]  # several times faster than one mean over two axes
    return total / np.float32(factor**2)
