"""The renderer: camera, light and raster settings in one object."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from nmr.cameras import Look, LookAt, Orthographic
from nmr.neural_renderer._convert import check_batch, height_and_width, integer_faces
from nmr.neural_renderer.lighting import face_light
from nmr.neural_renderer.look import orthographic_look
from nmr.neural_renderer.projection import projection
from nmr.neural_renderer.rasterize import DEFAULT_EPS, DEFAULT_FAR, DEFAULT_NEAR, draw
from nmr.neural_renderer.vertices_to_faces import vertices_to_faces

_MODES = ("projection", "look_at", "look", "none")


class Renderer(torch.nn.Module):
    """Draws meshes. All settings are attributes and may be changed at any time.

    Parameters
    ----------
    image_size : int or (height, width)
        Pixels, h and w; one number means a square. "look_at" and "look" have square pixels: their
        field of view belongs to the shorter side. "projection" stretches an image of
        ``orig_size`` over the whole one.
    anti_aliasing : bool
        Average 2x2 pixels of a raster of 2h x 2w.
    background_color : [3] or [B, 3]
        Background of RGB images. Colours and vectors, here and below, are lists, tuples, arrays
        or tensors; gradients reach tensors.
    fill_back : bool
        Also draw faces that are seen from behind.
    camera_mode : {"projection", "look_at", "look", "none"}
        The function of that name takes vertices to renderer space. "none" (also "None", None):
        vertices are already in renderer space. "projection" without K, R and t means "look_at",
        as in the Chainer version.
    K, R, t, dist_coeffs, orig_size
        Camera of "projection": see :func:`projection`. The methods take others for one call. As
        published, arrays become float32 tensors, and dist_coeffs are zeros ``[1, 5]`` if not
        given.
    perspective : bool
        With "look_at" and "look": divide by the depth.
    viewing_angle : float
        Half of the field of view, in degrees.
    camera_direction : [3] or [B, 3]
        With "look".
    near, far : float
        A pixel of an RGB image is covered only if near < depth < far. As published,
        :meth:`render_silhouettes` and :meth:`render_depth` always take 0.1, 100 and eps 1e-4;
        :meth:`render` and :meth:`render_rgb` take near, far and ``rasterizer_eps`` of the
        renderer.
    light_intensity_ambient, light_intensity_directional
        See :func:`lighting`.
    light_color_ambient, light_color_directional, light_direction
        See :func:`lighting`.

    Attributes
    ----------
    eye : [3] or [B, 3]
        Position of the camera of "look_at" and "look"; (0, 0, -(1 / tan(viewing_angle) + 1)) by
        default.
    camera_up : [3] or [B, 3]
        Up in the image of "look_at" and "look"; (0, 1, 0) by default, as published. (The
        published class has no such attribute; some of its forks do.)
    rasterizer_eps : float
        1e-3 by default.

    Examples
    --------
    >>> renderer = nr.Renderer(camera_mode="look_at", image_size=128)
    >>> renderer.eye = nr.get_points_from_angles(2.732, 30, 45)
    >>> rgb, depth, alpha = renderer(vertices, faces, textures)
    """

    # an attribute of the class: renderers saved whole by the published code lack it
    camera_up = (
        0,
        1,
        0,
    )

    def __init__(
        self,
        image_size=256,
        anti_aliasing=True,
        background_color=(0, 0, 0),
        fill_back=True,
        camera_mode="projection",
        K=None,
        R=None,
        t=None,
        dist_coeffs=None,
        orig_size=1024,
        perspective=True,
        viewing_angle=30,
        camera_direction=(0, 0, 1),
        near=0.1,
        far=100,
        light_intensity_ambient=0.5,
        light_intensity_directional=0.5,
        light_color_ambient=(1, 1, 1),
        light_color_directional=(1, 1, 1),
        light_direction=(0, 1, 0),
    ) -> None:
        super().__init__()
        self.image_size = image_size
        self.anti_aliasing = anti_aliasing
        self.background_color = background_color
        self.fill_back = fill_back
        self.camera_mode = camera_mode
        self._mode()
        self.K, self.R, self.t, self.dist_coeffs = (
            torch.tensor(x, dtype=torch.float32) if isinstance(x, np.ndarray) else x
            for x in (K, R, t, dist_coeffs)
        )
        if dist_coeffs is None:
            self.dist_coeffs = torch.zeros(1, 5)
        self.orig_size = orig_size
        self.perspective = perspective
        self.viewing_angle = viewing_angle
        # 0 is possible for cameras that do not use the angle
        tangent = math.tan(math.radians(viewing_angle))
        self.eye = [0, 0, -(1 / tangent + 1)] if tangent else None
        self.camera_direction = camera_direction
        self.near = near
        self.far = far
        self.light_intensity_ambient = light_intensity_ambient
        self.light_intensity_directional = light_intensity_directional
        self.light_color_ambient = light_color_ambient
        self.light_color_directional = light_color_directional
        self.light_direction = light_direction
        self.rasterizer_eps = 1e-3

    def __setattr__(self, name: str, value: object) -> None:
        # An attribute that was a Parameter may be set to a list; torch itself would require a
        # Parameter.
        self.__dict__.get("_parameters", {}).pop(name, None)
        super().__setattr__(name, value)

    def forward(
        self,
        vertices,
        faces,
        textures=None,
        mode=None,
        K=None,
        R=None,
        t=None,
        dist_coeffs=None,
        orig_size=None,
    ):
        """:meth:`render` for ``mode=None``, else the method that ``mode`` names: "rgb",
        "silhouettes" or "depth".
        """
        camera = (K, R, t, dist_coeffs, orig_size)
        if mode is None:
            return self.render(vertices, faces, textures, *camera)
        if mode == "rgb":
            return self.render_rgb(vertices, faces, textures, *camera)
        if mode == "silhouettes":
            return self.render_silhouettes(vertices, faces, *camera)
        if mode == "depth":
            return self.render_depth(vertices, faces, *camera)
        raise ValueError(f"mode must be None, 'rgb', 'silhouettes' or 'depth', got {mode!r}")

    def render_silhouettes(
        self, vertices, faces, K=None, R=None, t=None, dist_coeffs=None, orig_size=None
    ) -> Tensor:
        """Coverage ``[B, h, w]``, row 0 = top.

        ``vertices [B, V, 3]`` float32 or float64; ``faces [B, F, 3]`` (``[1, F, 3]`` or
        ``[F, 3]`` for all meshes). One mesh and a camera with B poses give B images. Raises
        TypeError or ValueError for wrong types, shapes and ranges.
        """
        return self._draw(vertices, faces, None, (K, R, t, dist_coeffs, orig_size), ("alpha",))[
            "alpha"
        ]

    def render_depth(
        self, vertices, faces, K=None, R=None, t=None, dist_coeffs=None, orig_size=None
    ) -> Tensor:
        """Depth ``[B, h, w]``, row 0 = top, 100 on background; arguments as
        :meth:`render_silhouettes`.
        """
        return self._draw(vertices, faces, None, (K, R, t, dist_coeffs, orig_size), ("depth",))[
            "depth"
        ]

    def render_rgb(
        self, vertices, faces, textures, K=None, R=None, t=None, dist_coeffs=None, orig_size=None
    ) -> Tensor:
        """Lit colours ``[B, 3, h, w]``, row 0 = top; ``textures [B or 1, F, ts, ts, ts, 3]`` in
        [0, 1].
        """
        return self._draw(vertices, faces, textures, (K, R, t, dist_coeffs, orig_size), ("rgb",))[
            "rgb"
        ]

    def render(
        self, vertices, faces, textures, K=None, R=None, t=None, dist_coeffs=None, orig_size=None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """``(rgb [B, 3, h, w], depth [B, h, w], alpha [B, h, w])``, in one pass; arguments as
        :meth:`render_rgb`.
        """
        images = self._draw(
            vertices, faces, textures, (K, R, t, dist_coeffs, orig_size), ("rgb", "alpha", "depth")
        )
        return images["rgb"], images["depth"], images["alpha"]

    def _draw(self, vertices, faces, textures, camera, outputs) -> dict[str, Tensor | None]:
        vertices = check_batch(vertices)
        faces = integer_faces(faces, vertices)
        if faces.ndim == 3:
            vertices = vertices.expand(len(faces), -1, -1)
        on_screen = self._transform(vertices, *camera)
        settings = (DEFAULT_NEAR, DEFAULT_FAR, DEFAULT_EPS)
        light = None
        if "rgb" in outputs:
            settings = (self.near, self.far, self.rasterizer_eps)
            light = self._light(vertices, faces)
        size = (self.image_size, self.anti_aliasing)
        return draw(
            *(on_screen, faces, textures, *size, *settings, self.background_color, outputs),
            fill_back=bool(self.fill_back),
            light=light,
        )

    def _light(self, vertices: Tensor, faces: Tensor) -> Tensor:
        """``[B, F, 3]``, or with fill_back ``[B, 2F, 3]``: of the faces seen from the front, then
        from behind.
        """
        corners = vertices_to_faces(vertices, faces)
        if self.fill_back:
            corners = torch.cat([corners, corners.flip(2)], dim=1)
        return face_light(
            corners,
            self.light_intensity_ambient,
            self.light_intensity_directional,
            self.light_color_ambient,
            self.light_color_directional,
            self.light_direction,
        )

    def _mode(self) -> str:
        mode = "none" if self.camera_mode is None else str(self.camera_mode).lower()
        if mode not in _MODES:
            raise ValueError(
                f"camera_mode must be 'projection', 'look_at', 'look' or 'none' (vertices are in renderer space), got "
                f"{self.camera_mode!r}"
            )
        return mode

    def _transform(self, vertices: Tensor, K, R, t, dist_coeffs, orig_size) -> Tensor:
        """World space to renderer space."""
        mode = self._mode()
        if mode == "none":
            return vertices
        if mode == "projection":
            K, R, t, dist_coeffs, orig_size = (
                own if given is None else given
                for given, own in (
                    (K, self.K),
                    (R, self.R),
                    (t, self.t),
                    (dist_coeffs, self.dist_coeffs),
                    (orig_size, self.orig_size),
                )
            )
            missing = [name for name, value in (("K", K), ("R", R), ("t", t)) if value is None]
            if not missing:
                return projection(vertices, K, R, t, dist_coeffs, orig_size)
            if len(missing) < 3:
                raise ValueError(
                    f"camera_mode='projection' needs K, R and t; missing: {', '.join(missing)}; give them to the "
                    "renderer or to this call"
                )
        if self.eye is None:
            raise ValueError(f"camera_mode={self.camera_mode!r} needs an eye; set renderer.eye")
        if mode == "look" and self.perspective:
            camera = Look(
                self.eye, self.camera_direction, self.camera_up, half_fov_deg=self.viewing_angle
            )
        elif mode == "look":
            camera = orthographic_look(self.eye, self.camera_direction, self.camera_up)
        elif self.perspective:
            camera = LookAt(self.eye, up=self.camera_up, half_fov_deg=self.viewing_angle)
        else:
            camera = Orthographic(self.eye, up=self.camera_up)
        return camera.for_image(*height_and_width(self.image_size)).transform(vertices)
