"""Cameras: from world space to renderer space (x right, y up, both in [-1, 1] across the image;
z = depth).

``docs/conventions.md`` has the table of conventions and which of them mirror the world.
"""

from .conversions import (
    from_opencv,
    from_opengl,
    from_pytorch3d,
    from_pytorch3d_fov,
    to_opencv,
    to_opengl,
    to_pytorch3d,
)
from .look_at import Look, LookAt, Orthographic, points_from_angles
from .pinhole import Pinhole
from .poses import cat
from .projection import Camera, ProjectingCamera, Projection

__all__ = [
    "Camera",
    "Look",
    "LookAt",
    "Orthographic",
    "Pinhole",
    "ProjectingCamera",
    "Projection",
    "cat",
    "from_opencv",
    "from_opengl",
    "from_pytorch3d",
    "from_pytorch3d_fov",
    "points_from_angles",
    "to_opencv",
    "to_opengl",
    "to_pytorch3d",
]
