"""Random colours and lights for generated objects and meshes without colours."""

import colorsys
from collections.abc import Sequence

import numpy as np
from trimesh.graph import connected_component_labels

import nmr
from learn3d.pictures import studio_lights

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
    side = rng.normal(size=2)
    height = rng.uniform(0.3, 1.5)
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
