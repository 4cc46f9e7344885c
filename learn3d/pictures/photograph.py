"""Pictures of meshes for data sets and figures: studio lights, white background."""

import colorsys
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from trimesh.graph import connected_component_labels

import nmr

# towards the light, object frame (x right, y up, -z towards the camera of view 0)
KEY_LIGHT = (
    0.45,
    0.8,
    -0.4,
)
BACK_LIGHT = 0.35  # strength of the light from the opposite side, relative to the key light


def studio_lights(
    light: Sequence[float] = KEY_LIGHT, ambient: float = 0.5, smooth: bool = False
) -> nmr.Lights:
    """A key light from the direction `light` (of any length but 0), a weaker one from behind, and ambient light.

    ambient: its share in 0 .. 1; a surface that faces the key light has the brightness 1. smooth:
    interpolate normals.
    """
    key, direction = 1.0 - ambient, torch.as_tensor(light, dtype=torch.float64)
    direction = direction / direction.norm()
    return nmr.Lights(
        ambient, [key, BACK_LIGHT * key], torch.stack([direction, -direction]), smooth=smooth
    )


@torch.no_grad()
def photograph(
    vertices: torch.Tensor | np.ndarray,
    faces: torch.Tensor | np.ndarray,
    colors: np.ndarray | Sequence[float] | nmr.UVTexture,
    cameras: nmr.cameras.Camera,
    *,
    image_size: int,
    lights: nmr.Lights | None = None,
    supersample: int = 2,
) -> tuple[np.ndarray, np.ndarray]:
    """One mesh in B views on white. Both sides of its faces are lit in the same way. Not differentiable.

    vertices float [V, 3] in the object frame, faces integer [F, 3], a camera of nmr with B poses.
    colors: a texture, or colours of the faces, float [F, 3] or [3] in [0, 1]. supersample:
    subpixels per pixel and axis, an even number; 2 covers exactly the pixels that
    `nmr.render_silhouette` covers. Returns rgb uint8 [B, S, S, 3], row 0 = top, and alpha uint8
    [B, S, S], 255 * the covered share of each pixel. Raises TypeError and ValueError as
    `nmr.render` does.
    """
    faces = torch.as_tensor(faces).cpu()
    if not isinstance(colors, nmr.UVTexture):
        colors = nmr.FaceColors(
            torch.as_tensor(np.float32(colors)).clamp(0.0, 1.0).expand(len(faces), 3)
        )
    finer = supersample // 2  # the renderer halves once more
    images = nmr.render(
        torch.as_tensor(vertices, dtype=torch.float32).cpu(),
        faces,
        cameras,
        outputs=("rgb", "alpha"),
        colors=colors,
        lights=lights or studio_lights(),
        background=1.0,
        image_size=image_size * finer,
    )
    channels = torch.cat([images.rgb, images.alpha.unsqueeze(-1)], dim=-1)
    if finer > 1:
        channels = F.avg_pool2d(channels.movedim(-1, 1), finer).movedim(1, -1)
    pixels = np.rint(255.0 * channels.numpy()).astype(np.uint8)
    return np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])


#: Colours that go together, for pictures that people look at.
PALETTES = {
    "airplane": ((0.93, 0.93, 0.9), (0.78, 0.16, 0.13), (0.1, 0.2, 0.4)),
    "car": ((0.75, 0.13, 0.1), (0.13, 0.13, 0.15), (0.2, 0.2, 0.22)),
    "chair": ((0.62, 0.38, 0.2), (0.12, 0.42, 0.42), (0.9, 0.82, 0.66)),
    "lamp": ((0.8, 0.6, 0.26), (0.94, 0.86, 0.68), (0.25, 0.18, 0.14)),
    "sofa": ((0.76, 0.34, 0.2), (0.93, 0.84, 0.68), (0.6, 0.27, 0.17)),
    "table": ((0.58, 0.36, 0.2), (0.82, 0.64, 0.4), (0.22, 0.24, 0.26)),
}


def natural_look(
    vertices: np.ndarray,
    faces: np.ndarray,
    rng: np.random.Generator,
    palette: Sequence[Sequence[float]] | None = None,
) -> tuple[np.ndarray, nmr.Lights]:
    """Random colours [F, 3] and lights for a mesh [V, 3], [F, 3].

    Connected parts with the same number of faces get the same colour out of three. The light
    comes from any side.
    palette: the three colours; None for random ones.
    """
    part = connected_component_labels(np.concatenate([faces[:, :2], faces[:, 1:]]), len(vertices))[
        faces[:, 0]
    ]
    kinds = np.unique(np.bincount(part)[part], return_inverse=True)[1]
    palette = np.array(palette or [_material(rng) for _ in range(3)])
    colors = palette[rng.choice(3, size=kinds.max() + 1, p=(0.6, 0.25, 0.15))][kinds]
    side, height = rng.normal(size=2), rng.uniform(0.3, 1.5)
    return colors, studio_lights((side[0], height, side[1]), rng.uniform(0.35, 0.7))


def _material(rng: np.random.Generator) -> tuple[float, float, float]:
    """A random colour of wood, of paint or cloth, or a grey."""
    kind = rng.choice(3, p=(0.25, 0.4, 0.35))
    if kind == 0:
        return colorsys.hsv_to_rgb(
            rng.uniform(0.05, 0.11), rng.uniform(0.3, 0.75), rng.uniform(0.2, 0.85)
        )
    if kind == 1:
        return colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.2, 0.9), rng.uniform(0.2, 0.95))
    return colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.0, 0.08), rng.uniform(0.05, 0.98))
