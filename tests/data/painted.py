"""Pictures of painted meshes, as they are fitted to."""

from __future__ import annotations

import numpy as np
import torch

import nmr
from learn3d.pictures import photograph
from learn3d.studio.picture_to_mesh.fit import Target, View


def seen(
    vertices: torch.Tensor, faces: torch.Tensor, paint: object, view: View, **look: object
) -> Target:
    """The picture of a mesh [V, 3] from a view. `paint`: colours of its faces. `look`: options of `photograph`."""
    look = {"image_size": 256, "lights": nmr.Lights(1.0, 0.0)} | look
    (rgb,), alpha = photograph(vertices, faces, paint, view.cameras(), **look)
    return Target(torch.from_numpy(np.concatenate([np.moveaxis(rgb, -1, 0), alpha])) / 255)
