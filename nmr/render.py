"""Rendering functions: validate, document, call the operators."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ._packing import is_list
from ._scene import Meshes, average, make_scene, shade
from ._validate import check_choice
from .cameras import Camera
from .fragments import Fragments
from .images import OUTPUTS, Images
from .lights import Lights
from .textures import Colors


def render(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    outputs: Sequence[str] = ("rgb", "alpha", "depth"),
    colors: Colors | None = None,
    lights: Lights | None = None,
    background: float | Sequence[float] | Tensor = 0.0,
    image_size: int = 256,
    anti_aliasing: bool = True,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    eps: float = 1e-4,
    smooth_normals: bool = False,
    interpolation_gradient: bool = False,
) -> Images:
    """Several images of meshes in one pass: the meshes are transformed and rasterized once.

    Parameters
    ----------
    vertices, faces, camera, image_size, anti_aliasing, fill_back, near, far, eps
        As :func:`render_silhouette`.
    outputs : sequence of "rgb", "alpha", "depth", "normals", "fragments"
        What to draw; the names of the attributes of the result.
    colors : VertexColors, FaceColors, TextureCubes, UVTexture or any object with ``sample(fragments)``, optional
        For rgb. Without them the meshes are white.
    lights : Lights, optional
        What colours are multiplied with. Without them colours appear as they are.
    background : number, [C], or Tensor [B, C]
        Colour where there is no face.
    smooth_normals : bool
        For normals: those of the vertices, interpolated, instead of those of the faces.
    interpolation_gradient : bool
        Adds, for rgb, the true derivative of interpolated colours by where on the face a pixel lies: a texture that
        slides under the pixels moves vertices. The published definition does not have it: there colour moves vertices
        by edges only.

    Returns
    -------
    Images
        ``images.rgb[b, y, x]`` is the colour [C] of the pixel in row y from the top, mean of 2x2 with anti-aliasing
        (background mixed in at edges); alpha, depth, normals as of :func:`render_silhouette`, :func:`render_depth` and
        :func:`render_normals`; fragments at the resolution of the raster (2 S with anti-aliasing).

    Notes
    -----
    Differentiable in vertices and camera: rgb and alpha by NMR's edges (if both are asked for, all their channels
    decide together which pixels pull, as in the published renderer), depth and normals by their true derivatives at
    fixed coverage. Differentiable in colours, background and the parameters of lights exactly. No second derivatives.

    Raises
    ------
    TypeError, ValueError
        As :func:`render_silhouette`; for unknown outputs; for colours, lights and backgrounds that do not fit.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt.from_angles(2.732, 30.0, [0.0, 90.0])
    >>> rgb, depth = nmr.render(vertices, faces, camera, outputs=("rgb", "depth"), lights=nmr.Lights(), image_size=64)
    """
    listed = is_list(outputs) and all(name in OUTPUTS for name in outputs)
    if not listed or not outputs or len(set(outputs)) != len(outputs):
        raise ValueError(f"outputs must be different names out of {OUTPUTS}, at least one, in a tuple; got {outputs!r}")
    scene = make_scene(vertices, faces, camera, image_size, anti_aliasing, near, far, eps)
    images: dict[str, Tensor | Fragments] = dict.fromkeys(outputs)  # in the order asked
    if "alpha" in images and "rgb" not in images:
        images["alpha"], owner = scene.silhouette(anti_aliasing, fill_back, near, far, eps)
    else:
        owner = scene.rasterize(fill_back, near, far)
    if "depth" in images:
        images["depth"] = scene.depth(owner, anti_aliasing, far)
    if not {"rgb", "normals", "fragments"}.isdisjoint(images):
        fragments = scene.fragments(owner, anti_aliasing, far, eps)
        if "rgb" in images:
            image = shade(fragments, colors, lights, background, interpolation_gradient)
            if "alpha" in images:
                image = torch.cat([image, fragments.covered.unsqueeze(-1).to(image)], dim=-1)
            image = fragments.resolve(image)
            if "alpha" in images:
                image, images["alpha"] = image[..., :-1], image[..., -1]
            images["rgb"] = image
        if "normals" in images:
            images["normals"] = average(fragments.normals(smooth_normals), anti_aliasing)
        if "fragments" in images:
            images["fragments"] = fragments
    return Images(images)


def render_rgb(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    colors: Colors | None = None,
    lights: Lights | None = None,
    background: float | Sequence[float] | Tensor = 0.0,
    image_size: int = 256,
    anti_aliasing: bool = True,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    eps: float = 1e-4,
    interpolation_gradient: bool = False,
) -> Tensor:
    """Colour images of meshes; the arguments, gradients and errors are those of :func:`render`.

    Returns
    -------
    Tensor [B, S, S, C]
        ``rgb[b, y, x]`` is the colour of the pixel in row y from the top, with as many channels as ``colors`` have.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> colors, lights = nmr.VertexColors((vertices + 1) / 2), nmr.Lights(smooth=True)
    >>> rgb = nmr.render_rgb(0.8 * vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), colors=colors, lights=lights)
    """
    return render(
        vertices,
        faces,
        camera,
        outputs=("rgb",),
        colors=colors,
        lights=lights,
        background=background,
        image_size=image_size,
        anti_aliasing=anti_aliasing,
        fill_back=fill_back,
        near=near,
        far=far,
        eps=eps,
        interpolation_gradient=interpolation_gradient,
    ).rgb


def render_silhouette(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    image_size: int = 256,
    anti_aliasing: bool = True,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    eps: float = 1e-4,
    gradient: str = "nmr",
) -> Tensor:
    """Silhouettes of meshes, with the gradient of the Neural Mesh Renderer, or a local one.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], or a list of Tensors [V_b, 3]; float32 or float64
        Without a camera in renderer space: x right, y up, both in [-1, 1] across the image, z = depth. With one, in
        the space that the camera transforms from. One mesh and a camera with B poses give B images. The meshes of
        a list may have different sizes; they are laid end to end, without padding, and drawn as one by one.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
        Vertex indices; counter-clockwise on the screen is the front.
    camera : Camera, optional
        For example :class:`nmr.LookAt`.
    image_size : int
        S, pixels per side.
    anti_aliasing : bool
        Raster at 2S x 2S and average 2x2 pixels.
    fill_back : bool
        Draw faces from behind, too. Without it only faces that are counter-clockwise on the screen are drawn; a camera
        that mirrors the world (LookAt, Look, Orthographic) turns the outside of mesh files clockwise.
    near, far : float
        A pixel is covered only where near < depth < far. Faces are not clipped.
    eps : float
        In NMR's gradient, added to the distance between an edge and a pixel (in units of [-1, 1]). In the local one,
        directions that lower the loss at rates less than this apart tie. Both are absolute, and as published.
    gradient : "nmr" or "local"
        Which gradient; the images are the same.

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

    The local gradient is that of Kato and Harada 2019 (view prior learning), described anew here. With I the coverage
    of raster pixels (0 or 1), g the gradient of the loss by it (with anti-aliasing a quarter of that by the image
    pixel: raster and R = 2S, else R = S), and i, j neighbours, j to the right::

        right(i, j) = -(I_i - I_j) g_j R / 2    the rate at which the loss falls if what i shows moves onto j
        left(i, j)  = -(I_j - I_i) g_i R / 2    ... if what j shows moves onto i

    A covered pixel sums each over its pairs with the left and the right neighbour; a pair within an object (or beyond
    the border of the image) gives nothing. With ``right`` and ``left`` these sums, d loss / d x of the point seen in
    the pixel is 0 if neither is positive or they differ by less than ``eps``, -right if right > left, else +left. The
    corners of the pixel's face receive it in the shares of their weights on the screen at the pixel's centre (clamped
    to [0, 1], normalised, taken as constant). The same upwards for y. So only pixels at the rim of an object pull, and
    only by what is wrong at the rim: a target out of a pixel's reach moves nothing.

    No mesh gives a NaN: faces with a non-finite corner draw nothing and get no gradient. (A loss whose own gradient is
    not finite passes that on.)

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, for faces that refer to missing vertices, and for an unknown gradient.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt.from_angles(2.732, 30.0, [0.0, 90.0], half_fov_deg=15.0)
    >>> nmr.render_silhouette(0.4 * vertices, faces, camera, image_size=64).shape
    torch.Size([2, 64, 64])
    """
    check_choice(gradient, "gradient", ("nmr", "local"))
    scene = make_scene(vertices, faces, camera, image_size, anti_aliasing, near, far, eps)
    alpha, _ = scene.silhouette(anti_aliasing, fill_back, near, far, eps, gradient == "local")
    return alpha


def render_depth(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    image_size: int = 256,
    anti_aliasing: bool = True,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
) -> Tensor:
    """Depth images of meshes; the arguments are those of :func:`render_silhouette`.

    Returns
    -------
    Tensor [B, S, S]
        ``depth[b, y, x]`` is z of the nearest face at the pixel in row y from the top, ``far`` where there is none.
        With anti-aliasing the mean of 2x2, far mixed in at edges, as published; without it z is exact.

    Notes
    -----
    Differentiable in x, y and z of the vertices (and through the camera): the true derivative of z at each pixel.
    Coverage is fixed: edges are not moved by depth. No second derivative.

    Raises
    ------
    TypeError, ValueError
        As :func:`render_silhouette`.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt([0.0, 0.0, -3.0])
    >>> depth = nmr.render_depth(vertices, faces, camera, anti_aliasing=False)  # 2 in the middle
    """
    scene = make_scene(vertices, faces, camera, image_size, anti_aliasing, near, far)
    return scene.depth(scene.rasterize(fill_back, near, far), anti_aliasing, far)


def render_normals(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    smooth: bool = False,
    image_size: int = 256,
    anti_aliasing: bool = True,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
) -> Tensor:
    """Normals of meshes in world space; the arguments are those of :func:`render_silhouette`.

    Returns
    -------
    Tensor [B, S, S, 3]
        ``normals[b, y, x]`` is the unit normal, on the side that is seen (:meth:`Fragments.normals`), at the pixel in
        row y from the top; of the face, or with ``smooth`` interpolated between those of its vertices. 0 where there is
        no face. With anti-aliasing the mean of 2x2: shorter than 1 at edges.

    Notes
    -----
    Differentiable in the vertices: the true derivative at fixed coverage. (For edges moved by normals, shade by
    yourself: ``fragments.resolve(fragments.normals())``.)

    Raises
    ------
    TypeError, ValueError
        As :func:`render_silhouette`.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt([0.0, 0.0, -3.0])
    >>> picture = (1 + nmr.render_normals(vertices, faces, camera, smooth=True)) / 2
    """
    scene = make_scene(vertices, faces, camera, image_size, anti_aliasing, near, far)
    fragments = scene.fragments(scene.rasterize(fill_back, near, far), anti_aliasing, far, 1e-4)
    return average(fragments.normals(smooth), anti_aliasing)


def render_fragments(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    image_size: int = 256,
    anti_aliasing: bool = False,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    eps: float = 1e-4,
) -> Fragments:
    """Face, weights and depth at each pixel, to shade by yourself; arguments as of :func:`render_silhouette`.

    Returns
    -------
    Fragments
        At S x S pixels; with ``anti_aliasing`` at the 2S x 2S of the raster, which :meth:`Fragments.resolve` averages.

    Notes
    -----
    weights and depth have true derivatives by the vertices, :meth:`Fragments.resolve` has NMR's.

    Raises
    ------
    TypeError, ValueError
        As :func:`render_silhouette`.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> fragments = nmr.render_fragments(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), anti_aliasing=True)
    >>> image = fragments.resolve(fragments.interpolate(vertices).sin())
    """
    scene = make_scene(vertices, faces, camera, image_size, anti_aliasing, near, far, eps)
    return scene.fragments(scene.rasterize(fill_back, near, far), anti_aliasing, far, eps)


@torch.no_grad()
def render_face_index(
    vertices: Meshes,
    faces: Meshes,
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

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> face_index = nmr.render_face_index(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), image_size=64)
    >>> seen = torch.unique(face_index[face_index >= 0])
    """
    scene = make_scene(vertices, faces, camera, image_size, False, near, far)
    owner = scene.rasterize(fill_back, near, far)
    num_faces = scene.mesh.num_faces
    return torch.where(owner >= num_faces, owner - num_faces, owner)
