"""The public rendering functions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ._packing import is_list
from ._scene import (
    Meshes,
    Scene,
    average,
    background_rows,
    draw_silhouette,
    make_scene,
    shade,
)
from ._validate import GRADIENTS, as_positive, check_choice, check_flag, check_number, check_size
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
    outputs: str | Sequence[str] = ("rgb", "alpha", "depth"),
    colors: Colors | None = None,
    lights: Lights | None = None,
    background: float | Sequence[float] | Tensor = 0.0,
    image_size: int | tuple[int, int] = 256,
    anti_aliasing: bool = True,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    clip: bool = True,
    eps: float = 1e-4,
    gradient: str = "nmr",
    smooth: bool = False,
    space: str = "world",
    interpolation_gradient: bool = False,
) -> Images:
    """Several images of meshes in one pass: the meshes are transformed and rasterized once.

    Parameters
    ----------
    vertices : float32 or float64 Tensor [B, V, 3] or [V, 3], or a list of [V_b, 3]
        World space; without a camera renderer space: x, y in [-1, 1], z = depth.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
        Vertex indices.
    camera : Camera, optional
        Such as :class:`nmr.LookAt`. B poses of one mesh give B images.
    outputs : "rgb", "alpha", "depth", "normals", "fragments", or a sequence of these
        Also the names of the result's attributes.
    colors : Colors, optional
        VertexColors, FaceColors, TextureCubes, UVTexture, Materials or any object with
        ``sample(fragments)``. Without them the meshes are white.
    lights : Lights, optional
        They multiply colours; without, these are drawn unchanged.
    background : number, [C], or Tensor [B, C]
        Colour of pixels without a face.
    image_size : int or (height, width)
        Pixels h, w; an int is a square.
    anti_aliasing : bool
        Average 2x2 of 2h x 2w pixels.
    fill_back : bool
        Also draw faces from behind (clockwise on the screen).
    near, far : float
        Limits of the depth, exclusive.
    clip : bool
        Cut faces at the plane ``near`` (see :func:`render_silhouette`).
    eps : float
        As in :func:`render_silhouette`.
    gradient : "nmr", "local" or "none"
        At edges; the images are the same.
    smooth : bool
        For normals: interpolated ones of the vertices, not those of the faces.
    space : "world" or "camera"
        For normals; "camera": x to the right of the image, y up, z away from the viewer.
    interpolation_gradient : bool
        Adds the true derivative of interpolated colours, so that vertices also move to shift
        colours under the pixels. As published, colours move vertices through edges only.

    Returns
    -------
    Images
        ``images.rgb[b, y, x]`` is the colour [C] in row y from the top, with the background mixed
        in at edges if anti-aliased; alpha ``[B, h, w]`` the covered part of the pixel; depth ``[B,
        h, w]`` z of the nearest face, ``far`` on background; normals ``[B, h, w, 3]`` those of the
        side that is seen; fragments those of the raster (2h x 2w with anti-aliasing).

    Notes
    -----
    In vertices and camera, rgb and alpha have NMR's edge gradient (of the loss over all their
    channels, if both are drawn); depth and normals have true derivatives at fixed coverage.
    Colours, background and lights have true derivatives. There are no second derivatives.

    NMR's gradient follows whole lines of the image at every edge. ``gradient="local"`` reaches one
    pixel and is many times as fast for large meshes and images: the definition in
    :func:`render_silhouette` with products of I and g summed over channels, also for depth and
    normals, beside their true derivatives (on a background of ``far`` and 0). A surface ends before
    the background, and before a face without a corner in common (by place) whose plane is farther
    away at the centres of both pixels, by more than 1e-4 of the depth. Edges on one surface have no
    gradient; for textures add ``interpolation_gradient=True``. ``"none"`` leaves edges out.
    ``docs/examples/draw_gradients.py`` draws the three. The images are the same (depth and normals
    up to rounding).

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, missing vertices of faces, unknown outputs, and colours,
        lights and backgrounds that do not fit.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt.from_angles(2.732, 30.0, [0.0, 90.0])
    >>> rgb, depth = nmr.render(vertices, faces, camera, outputs=("rgb", "depth"), lights=nmr.Lights(), image_size=64)
    """
    outputs = _check_outputs(outputs)
    check_choice(gradient, "gradient", GRADIENTS)

    how = image_size, anti_aliasing, fill_back, near, far, clip, eps
    if outputs == ("alpha",):
        return Images({"alpha": draw_silhouette(vertices, faces, camera, *how, gradient=gradient)})
    interpolation_gradient = check_flag(interpolation_gradient, "interpolation_gradient")
    scene = make_scene(vertices, faces, camera, *how)
    how = interpolation_gradient, gradient, smooth, space
    return Images(_draw(scene, outputs, background, colors, lights, *how))


def _check_outputs(outputs: object) -> tuple[str, ...]:
    names = (outputs,) if isinstance(outputs, str) else outputs
    listed = is_list(names) and all(name in OUTPUTS for name in names)
    if not listed or not names or len(set(names)) != len(names):
        hint = '; the silhouette is "alpha"' if is_list(names) and "silhouette" in names else ""
        raise ValueError(
            f"outputs must be one or more different names out of {OUTPUTS}, got {outputs!r}{hint}"
        )
    return tuple(names)


def _draw(
    scene: Scene,
    outputs: Sequence[str],
    background: float | Sequence[float] | Tensor,
    colors: Colors | None,
    lights: Lights | None,
    interpolation_gradient: bool,
    gradient: str,
    smooth: bool,
    space: str,
) -> dict[str, Tensor | Fragments]:
    """The outputs of :func:`render`."""
    images: dict[str, Tensor | Fragments] = dict.fromkeys(outputs)  # in the requested order
    anti_aliasing = scene.settings.anti_aliasing
    white = "rgb" in images and colors is None and lights is None
    if white:
        behind = background_rows(background, 3, scene.mesh.batch, scene.mesh.vertices)
        white = not behind.requires_grad and _finite(behind)  # rgb then follows from alpha
    if white or ("alpha" in images and "rgb" not in images):
        alpha, face_index = scene.silhouette(gradient)
        if "alpha" in images:
            images["alpha"] = alpha
        if white:
            covered = alpha.unsqueeze(-1)
            images["rgb"] = covered + (1 - covered) * behind[:, None, None]
    else:
        face_index = scene.rasterize()
    local = gradient == "local" and ("depth" in images or "normals" in images)
    if "depth" in images and not local:
        images["depth"] = scene.depth(face_index)
    shaded = "rgb" in images and not white
    if shaded or local or "normals" in images or "fragments" in images:
        fragments = scene.fragments(face_index)
        if shaded:
            image, behind = shade(fragments, colors, lights, background, interpolation_gradient)
            if "alpha" in images:
                image = torch.cat([image, image.new_ones(1).expand(*image.shape[:3], 1)], dim=-1)
                behind = torch.cat([behind, behind.new_zeros(len(behind), 1)], dim=-1)
            image = fragments._resolve(image, behind, gradient)
            if "alpha" in images:
                image, images["alpha"] = image[..., :-1], image[..., -1]
            images["rgb"] = image
        if "depth" in images and local:
            images["depth"] = fragments._resolve(
                fragments.depth.unsqueeze(-1), None, gradient
            ).squeeze(-1)
        if "normals" in images:
            normals = fragments.normals(smooth, space)
            images["normals"] = (
                fragments._resolve(normals, None, gradient)
                if local
                else average(normals, anti_aliasing)
            )
        if "fragments" in images:
            images["fragments"] = fragments
    return images


def _finite(values: Tensor) -> bool:
    """True also where values cannot be read yet, in torch.compile and torch.func.vmap."""
    if torch.compiler.is_compiling():
        return True
    try:
        return bool(values.isfinite().all())
    except RuntimeError:
        return True


def render_rgb(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    colors: Colors | None = None,
    lights: Lights | None = None,
    background: float | Sequence[float] | Tensor = 0.0,
    image_size: int | tuple[int, int] = 256,
    anti_aliasing: bool = True,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    clip: bool = True,
    eps: float = 1e-4,
    gradient: str = "nmr",
    interpolation_gradient: bool = False,
) -> Tensor:
    """Colour images of meshes: the output rgb of :func:`render`, with its gradients.

    Parameters
    ----------
    vertices : float32 or float64 Tensor [B, V, 3] or [V, 3], or a list of [V_b, 3]
        World space; without a camera renderer space.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
    camera : Camera, optional
        Such as :class:`nmr.LookAt`.
    colors : Colors, optional
        As in :func:`render`.
    lights : Lights, optional
        They multiply colours; without, these are drawn unchanged.
    background : number, [C], or Tensor [B, C]
        Colour of pixels without a face.
    image_size : int or (height, width)
        Pixels h, w; an int is a square.
    anti_aliasing : bool
        Average 2x2 of 2h x 2w pixels.
    fill_back : bool
        Also draw faces from behind.
    near, far : float
        Limits of the depth, exclusive.
    clip : bool
        As in :func:`render_silhouette`.
    eps : float
        As in :func:`render_silhouette`.
    gradient : "nmr", "local" or "none"
        At edges; the images are the same.
    interpolation_gradient : bool
        As in :func:`render`.

    Returns
    -------
    Tensor [B, h, w, C]
        ``rgb[b, y, x]`` is the colour in row y from the top, with the channels of ``colors``.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, missing vertices of faces, and colours, lights and
        backgrounds that do not fit.

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
        clip=clip,
        eps=eps,
        gradient=gradient,
        interpolation_gradient=interpolation_gradient,
    ).rgb


def render_silhouette(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    image_size: int | tuple[int, int] = 256,
    anti_aliasing: bool = True,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    clip: bool = True,
    eps: float = 1e-4,
    gradient: str = "nmr",
) -> Tensor:
    """Silhouettes of meshes, with the gradient of the Neural Mesh Renderer, or a local one.

    Parameters
    ----------
    vertices : float32 or float64 Tensor [B, V, 3] or [V, 3], or a list of [V_b, 3]
        World space; without a camera renderer space (x right, y up, both in [-1, 1] across the
        image, z = depth). B poses of one mesh give B images. The meshes of a list may have
        different sizes; each is drawn as if it were alone.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
        Vertex indices, counter-clockwise on the screen if a face is seen from its front.
    camera : Camera, optional
        Such as :class:`nmr.LookAt`.
    image_size : int or (height, width)
        Pixels h, w; an int is a square. x and y in renderer space go from -1 to 1 across
        the whole image. LookAt, Look and Orthographic have square pixels: their field of view
        belongs to the shorter side.
    anti_aliasing : bool
        Average 2x2 of 2h x 2w pixels.
    fill_back : bool
        Also draw faces from behind (clockwise on the screen: with LookAt, Look and Orthographic the
        outsides of mesh files, unless ``right_handed``).
    near, far : float
        Limits of the depth, exclusive.
    clip : bool
        Cut faces that reach behind the plane at depth ``near``; the part in front is drawn, with
        gradients to the corners. Without this, as published, corners behind the eye land mirrored
        on the image. The plane lies at far / 1e5 if near is 0, at far / 1e8 if near is smaller.
        Without a camera, x and y count as divided by z (perspective). In float32, a near of less
        than a thousandth of the scene can leave pixels open where cut faces meet: take float64 or a
        larger near (a warning says so).
    eps : float
        In NMR's gradient, added to the distance between an edge and a pixel (in units of [-1, 1]).
        The local one is 0 if the two directions lower the loss at rates that differ by less than
        eps. Both as published. (In texture cubes: see :class:`nmr.TextureCubes`.)
    gradient : "nmr", "local" or "none"
        The images are the same.

    Returns
    -------
    Tensor [B, h, w], dtype and device of ``vertices``
        ``alpha[b, y, x]`` is the covered part (0 or 1; with anti-aliasing 0, 1/4, ... 1) of the
        pixel in row y from the top.

    Notes
    -----
    Differentiable in x and y of ``vertices`` and in the camera; z gets 0. NMR's gradient is a
    definition, not the derivative of the image (Kato et al. 2018, section 3): on each raster line
    that crosses an edge of a visible face, every pixel m whose change would lower the loss by D
    pulls the edge's two vertices with D / d, d being how far the vertex must move until the edge
    reaches m (``docs/gradients.md``). The values equal those of the published kernels in float32,
    for any number of threads and batch size. There are no second derivatives.

    The local gradient is that of Kato and Harada 2019. I is the coverage (0 or 1) of pixels of the
    raster, R its width (for y its height), g the gradient of the loss with respect to I (with
    anti-aliasing a quarter of that of the image pixel). i and j are neighbours, j to the right of
    i::

        right(i, j) = -(I_i - I_j) g_j R / 2    rate at which the loss falls if the content of i moves to j
        left(i, j)  = -(I_j - I_i) g_i R / 2    rate at which the loss falls if the content of j moves to i

    For each covered pixel, ``right`` and ``left`` are summed over its pairs with its two
    neighbours; pairs of covered pixels, and across the border of the image, contribute 0. The
    derivative of the loss with respect to x of the point in the pixel is -right if right > left,
    else +left; 0 if neither sum is positive, or if they differ by less than ``eps``. It goes to the
    corners of the face by their screen-space weights at the pixel's centre (clamped to [0, 1],
    normalised, constants). y is treated likewise, upwards. A target farther than one pixel from the
    rim has no effect.

    Faces with a corner that is not finite draw nothing and get no gradient; a gradient of the loss
    that is not finite is passed on.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, missing vertices of faces, and an unknown gradient.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt.from_angles(2.732, 30.0, [0.0, 90.0], half_fov_deg=15.0)
    >>> nmr.render_silhouette(0.4 * vertices, faces, camera, image_size=64).shape
    torch.Size([2, 64, 64])
    """
    check_choice(gradient, "gradient", GRADIENTS)
    how = image_size, anti_aliasing, fill_back, near, far, clip, eps
    return draw_silhouette(vertices, faces, camera, *how, gradient=gradient)


def render_soft_silhouette(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    sigma: float | Tensor = 1e-5,
    dist_eps: float = 1e-4,
    image_size: int | tuple[int, int] = 256,
    anti_aliasing: bool = False,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    clip: bool = True,
) -> Tensor:
    """The soft silhouettes of SoftRas (Liu et al. 2019).

    Parameters
    ----------
    vertices : float32 or float64 Tensor [B, V, 3] or [V, 3], or a list of [V_b, 3]
        World space; without a camera renderer space.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
    camera : Camera, optional
        Such as :class:`nmr.LookAt`.
    sigma : float or Tensor []
        A face covers a pixel at the distance d from its border with the probability D, which is
        ``sigmoid(d^2 / sigma)`` inside and ``sigmoid(-d^2 / sigma)`` outside. d is in units of
        half the shorter side of the image.
    dist_eps : float
        In (0, 0.5): faces with a smaller D at a pixel outside are left out there.
    image_size : int or (height, width)
        Pixels h, w; an int is a square.
    anti_aliasing : bool
        Average 2x2 of 2h x 2w pixels.
    fill_back : bool
        Also draw faces from behind.
    near, far : float
        Limits of the depth, exclusive.
    clip : bool
        As in :func:`render_silhouette`.

    Returns
    -------
    Tensor [B, h, w]
        ``alpha = 1 - product over all faces of (1 - D)``, hidden ones too.

    Notes
    -----
    The true derivatives in x and y of the vertices, the camera and sigma, up to the jump of
    dist_eps; z gets 0. As published, but faces wholly nearer than ``near`` or farther than ``far``
    are left out, and with ``fill_back=False`` those seen from behind. There is no second
    derivative.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, missing vertices of faces, a sigma that is not positive,
        and a dist_eps outside (0, 0.5).

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt([0.0, 0.0, -5.0])
    >>> soft = nmr.render_soft_silhouette(vertices, faces, camera, sigma=1e-3, image_size=64)
    """
    scene = make_scene(
        vertices, faces, camera, image_size, anti_aliasing, fill_back, near, far, clip
    )
    sigma = as_positive(sigma, "sigma", scene.mesh.vertices.dtype)
    return scene.soft_silhouette(sigma, check_dist_eps(dist_eps))


def check_dist_eps(dist_eps: float) -> float:
    dist_eps = check_number(dist_eps, "dist_eps")
    if not 0 < dist_eps < 0.5:
        raise ValueError(f"dist_eps must lie between 0 and 0.5, got {dist_eps}")
    return dist_eps


def render_depth(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    image_size: int | tuple[int, int] = 256,
    anti_aliasing: bool = True,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    clip: bool = True,
) -> Tensor:
    """Depth images of meshes.

    Parameters
    ----------
    vertices : float32 or float64 Tensor [B, V, 3] or [V, 3], or a list of [V_b, 3]
        World space; without a camera renderer space.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
    camera : Camera, optional
        Such as :class:`nmr.LookAt`.
    image_size : int or (height, width)
        Pixels h, w; an int is a square.
    anti_aliasing : bool
        Average 2x2 of 2h x 2w pixels.
    fill_back : bool
        Also draw faces from behind.
    near, far : float
        Limits of the depth, exclusive.
    clip : bool
        As in :func:`render_silhouette`.

    Returns
    -------
    Tensor [B, h, w]
        ``depth[b, y, x]`` is z of the nearest face in row y from the top, ``far`` on background.
        With anti-aliasing it is the mean of 2x2 pixels, so that edges mix in ``far``, as published.

    Notes
    -----
    The true derivative of z at each pixel, in vertices and camera, at fixed coverage: depth does
    not move edges. There is no second derivative.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, and missing vertices of faces.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt([0.0, 0.0, -3.0])
    >>> depth = nmr.render_depth(vertices, faces, camera, anti_aliasing=False)  # 2 in the middle
    """
    scene = make_scene(
        vertices, faces, camera, image_size, anti_aliasing, fill_back, near, far, clip
    )
    return scene.depth(scene.rasterize())


def render_normals(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    smooth: bool = False,
    space: str = "world",
    image_size: int | tuple[int, int] = 256,
    anti_aliasing: bool = True,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    clip: bool = True,
) -> Tensor:
    """Normals of meshes in world or camera space.

    Parameters
    ----------
    vertices : float32 or float64 Tensor [B, V, 3] or [V, 3], or a list of [V_b, 3]
        World space; without a camera renderer space.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
    camera : Camera, optional
        Such as :class:`nmr.LookAt`.
    smooth : bool
        Interpolated normals of the vertices, not those of the faces.
    space : "world" or "camera"
        "camera": x to the right of the image, y up, z away from the viewer.
    image_size : int or (height, width)
        Pixels h, w; an int is a square.
    anti_aliasing : bool
        Average 2x2 of 2h x 2w pixels.
    fill_back : bool
        Also draw faces from behind.
    near, far : float
        Limits of the depth, exclusive.
    clip : bool
        As in :func:`render_silhouette`.

    Returns
    -------
    Tensor [B, h, w, 3]
        ``normals[b, y, x]`` is the unit normal of the side that is seen (:meth:`Fragments.normals`)
        in row y from the top, 0 on background. With anti-aliasing it is the mean of 2x2 pixels,
        shorter than 1 at edges.

    Notes
    -----
    The true derivative in the vertices, at fixed coverage.
    ``fragments.resolve(fragments.normals())`` is the same image, with NMR's edge gradient in
    addition.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, and missing vertices of faces.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt([0.0, 0.0, -3.0])
    >>> picture = (1 + nmr.render_normals(vertices, faces, camera, smooth=True)) / 2
    """
    scene = make_scene(
        vertices, faces, camera, image_size, anti_aliasing, fill_back, near, far, clip
    )
    fragments = scene.fragments(scene.rasterize())
    return average(fragments.normals(smooth, space), anti_aliasing)


def render_fragments(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    image_size: int | tuple[int, int] = 256,
    anti_aliasing: bool = False,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    clip: bool = True,
    eps: float = 1e-4,
    faces_per_pixel: int = 1,
    blur_radius: float = 0.0,
) -> Fragments:
    """Face, weights and depth at each pixel, for shading of your own.

    Parameters
    ----------
    vertices : float32 or float64 Tensor [B, V, 3] or [V, 3], or a list of [V_b, 3]
        World space; without a camera renderer space.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
    camera : Camera, optional
        Such as :class:`nmr.LookAt`.
    image_size : int or (height, width)
        Pixels h, w; an int is a square.
    anti_aliasing : bool
        Average 2x2 of 2h x 2w pixels.
    fill_back : bool
        Also draw faces from behind.
    near, far : float
        Limits of the depth, exclusive.
    clip : bool
        As in :func:`render_silhouette`.
    eps : float
        That of NMR's gradient in :meth:`Fragments.resolve`.
    faces_per_pixel : int
        K in 1..1024 surfaces, one behind the other. 1: the nearest, without an axis for K.
    blur_radius : float
        If positive, faces also count for pixels outside whose squared distance from their border
        (in units of half the shorter side of the image) is less than this, and there is an axis for
        K. Weights outside are clamped to [0, 1] and divided by their sum, as in SoftRas; depth
        follows from them. See :attr:`Fragments.distances`.

    Returns
    -------
    Fragments
        h x w pixels; with ``anti_aliasing`` 2h x 2w, which :meth:`Fragments.resolve` averages. With
        K > 1, ``sided_face_index[b, y, x, k]`` is the face of the k-th nearest surface, -1 behind
        the last (weights 0, depth ``far``). Of equally near faces the first comes first.

    Notes
    -----
    Weights and depth have true derivatives; :meth:`Fragments.resolve` has NMR's gradient.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, missing vertices of faces, and a faces_per_pixel that is
        not an integer in 1..1024.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> fragments = nmr.render_fragments(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), anti_aliasing=True)
    >>> image = fragments.resolve(fragments.interpolate(vertices).sin())

    The thickness of a body, from its two surfaces (a pixel whose centre lies on an edge may see
    one of them twice):

    >>> layers = nmr.render_fragments(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), faces_per_pixel=2)
    >>> thickness = layers.depth[..., 1] - layers.depth[..., 0]
    """
    scene = make_scene(
        vertices, faces, camera, image_size, anti_aliasing, fill_back, near, far, clip, eps
    )
    layers = check_size(faces_per_pixel, "faces_per_pixel", 1024)
    blur_radius = check_number(blur_radius, "blur_radius")
    if not 0 <= blur_radius < float("inf"):
        raise ValueError(f"blur_radius must be 0 or more and finite, got {blur_radius}")
    if blur_radius > 0:
        sigma = torch.tensor(blur_radius, dtype=torch.float64, device="cpu")
        return scene.soft_fragments(layers, sigma, 1.0, with_empty=True)
    return scene.fragments(scene.rasterize() if layers == 1 else scene.rasterize_layers(layers))


@torch.no_grad()
def render_face_index(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    image_size: int | tuple[int, int] = 256,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    clip: bool = True,
) -> Tensor:
    """Which face is nearest at each pixel centre.

    Parameters
    ----------
    vertices : float32 or float64 Tensor [B, V, 3] or [V, 3], or a list of [V_b, 3]
        World space; without a camera renderer space.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
    camera : Camera, optional
        Such as :class:`nmr.LookAt`.
    image_size : int or (height, width)
        Pixels h, w; an int is a square.
    fill_back : bool
        Also draw faces from behind.
    near, far : float
        Limits of the depth, exclusive.
    clip : bool
        As in :func:`render_silhouette`.

    Returns
    -------
    int32 Tensor [B, h, w]
        ``face_index[b, y, x] = f``: face f is nearest there, seen from either side; -1: background.
        Row 0 is the top. Of equally near faces the first is taken. Not differentiable.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, and missing vertices of faces.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> face_index = nmr.render_face_index(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), image_size=64)
    >>> seen = torch.unique(face_index[face_index >= 0])
    """
    scene = make_scene(vertices, faces, camera, image_size, False, fill_back, near, far, clip)
    return scene.face_index(scene.rasterize())
