"""Pictures of meshes for data sets and figures: nmr's lights, set up as in a studio, on white paper."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F

import nmr

KEY_LIGHT = (0.45, 0.8, -0.4)  # towards the light, object frame (x right, y up, -z towards the camera of view 0)
BACK_LIGHT = 0.35  # share of the diffuse light that comes from the opposite side: shadow sides keep their relief


def studio_lights(light: tuple[float, float, float] = KEY_LIGHT, ambient: float = 0.5) -> nmr.Lights:
    """A key light from `light` (any length but 0), a weaker one from behind, and a share `ambient` from everywhere.

    A surface that faces the key light has the light 1. Raises ValueError for ambient outside [0, 1], or no direction.
    """
    direction = torch.tensor(light, dtype=torch.float64)
    if direction.shape != (3,) or not direction.isfinite().all() or not direction.any():
        raise ValueError(f"light must be three finite numbers, not all zero, got {light}")
    if not 0.0 <= ambient <= 1.0:
        raise ValueError(f"ambient must lie in [0, 1], got {ambient}")
    key, direction = 1.0 - ambient, direction / direction.norm()
    return nmr.Lights(ambient, [key, BACK_LIGHT * key], torch.stack([direction, -direction]))


def photograph(
    vertices: torch.Tensor,
    faces: torch.Tensor,
    face_colors: np.ndarray,
    cameras: nmr.cameras.Camera,
    *,
    image_size: int,
    lights: nmr.Lights | None = None,
    supersample: int = 2,
) -> tuple[np.ndarray, np.ndarray]:
    """One mesh in B views on white, both sides of its faces lit alike; not differentiable.

    Parameters
    ----------
    vertices : float [V, 3], object frame. Tensor or array.
    faces : integer [F, 3].
    face_colors : float [F, 3] or [3], RGB in [0, 1].
    cameras : a camera of nmr with B poses.
    image_size : side S of the pictures, in pixels.
    lights : by default `studio_lights()`.
    supersample : subpixels per pixel and axis, an even number; 2 covers exactly what `nmr.render_silhouette` covers.

    Returns
    -------
    rgb : uint8 [B, S, S, 3], row 0 = top, white background.
    alpha : uint8 [B, S, S], 255 * the covered share of the pixel.

    Raises
    ------
    ValueError : shapes that do not fit, sizes that are not possible.
    """
    vertices = torch.as_tensor(vertices, dtype=torch.float32).detach().cpu()
    faces = torch.as_tensor(faces).detach().cpu()
    if vertices.ndim != 2 or vertices.shape[-1] != 3 or faces.ndim != 2 or faces.shape[-1] != 3:
        raise ValueError(
            "photograph takes one mesh: vertices must be [V, 3] and faces [F, 3], "
            f"got {list(vertices.shape)} and {list(faces.shape)}"
        )
    colors = torch.as_tensor(np.asarray(face_colors, dtype=np.float32)).clamp(0.0, 1.0)
    if tuple(colors.shape) not in ((3,), (len(faces), 3)):
        raise ValueError(f"face_colors must be [3] or [{len(faces)}, 3] (one per face), got {list(colors.shape)}")
    if image_size < 1 or supersample < 2 or supersample % 2:
        raise ValueError(
            "image_size must be at least 1 and supersample an even number from 2 on, "
            f"got {image_size} and {supersample}"
        )
    finer = supersample // 2  # the renderer halves once more
    with torch.no_grad():
        images = nmr.render(
            vertices,
            faces,
            cameras,
            outputs=("rgb", "alpha"),
            colors=nmr.FaceColors(colors.expand(len(faces), 3)),
            lights=studio_lights() if lights is None else lights,
            background=1.0,
            image_size=image_size * finer,
        )
    channels = torch.cat([images.rgb, images.alpha.unsqueeze(-1)], dim=-1)
    if finer > 1:
        channels = F.avg_pool2d(channels.movedim(-1, 1), finer).movedim(1, -1)
    pixels = np.rint(255.0 * channels.numpy()).astype(np.uint8)
    return np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])
