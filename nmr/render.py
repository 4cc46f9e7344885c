"""The public rendering functions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ._packing import is_list
from ._scene import Meshes, Scene, average, background_rows, make_scene, shade
from ._validate import GRADIENTS, as_positive, check_choice, check_number, check_size
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
    vertices : Tensor [B, V, 3] or [V, 3], or a list of Tensors [V_b, 3]; float32 or float64
        World coordinates; without a camera renderer space: x right, y up, both in [-1, 1],
        z = depth.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
        Vertex indices.
    camera : Camera, optional
        For example :class:`nmr.LookAt`. One mesh and a camera with B poses give B images.
    outputs : "rgb", "alpha", "depth", "normals", "fragments", or a sequence of these
        What to draw. These are also the names of the attributes of the result.
    colors : VertexColors, FaceColors, TextureCubes, UVTexture or any object with ``sample(fragments)``, optional
        Without them the meshes are white.
    lights : Lights, optional
        Colours are multiplied by the light. Without lights they are drawn unchanged.
    background : number, [C], or Tensor [B, C]
        Colour of pixels without a face.
    image_size : int or (height, width)
        Pixels: h and w; an int means a square.
    anti_aliasing : bool
        Render 2h x 2w pixels and average 2x2 of them.
    fill_back : bool
        Also draw faces that are seen from behind (clockwise on the screen).
    near, far : float
        A pixel is covered only if near < depth < far.
    clip : bool
        Cut the faces that reach behind the plane at depth ``near`` (details:
        :func:`render_silhouette`).
    eps : float
        In NMR's gradient, added to the distance between an edge and a pixel; in the local one the
        least difference of two rates.
    gradient : "nmr", "local" or "none"
        The definition of the gradient at edges. The images are the same.
    smooth : bool
        For the output "normals": interpolated normals of the vertices instead of normals of the
        faces.
    space : "world" or "camera"
        For the output "normals": "camera" means x to the right of the image, y up, z away from
        the viewer.
    interpolation_gradient : bool
        Adds the true derivative of interpolated colours with respect to the position of a pixel
        on its face, so that vertices also move to shift colours under the pixels. The published
        renderer does not have this: there colours move vertices only through edges.

    Returns
    -------
    Images
        ``images.rgb[b, y, x]`` is the colour [C] of the pixel in row y from the top, mean of 2x2
        with anti-aliasing (background mixed in at edges). alpha ``[B, h, w]`` is the covered part
        of the pixel; depth ``[B, h, w]`` is z of the nearest face, ``far`` on background; normals
        ``[B, h, w, 3]`` are those of the side that is seen; fragments have the resolution of the
        raster (2h x 2w with anti-aliasing).

    Notes
    -----
    In vertices and camera, rgb and alpha have NMR's edge gradient (if both are outputs, it sums
    the change of the loss over all their channels, as the published renderer does); depth and
    normals have their true derivatives at fixed coverage. Colours, background and the parameters
    of lights have true derivatives. There are no second derivatives.

    NMR's gradient follows whole lines of the image at every edge of every face.
    ``gradient="local"`` reaches one pixel and is many times as fast for large meshes and images.
    It is the definition in :func:`render_silhouette` with products of I and g summed over
    channels, and it applies to depth and normals, too, beside their true derivatives (their
    background is ``far`` and 0). A surface ends before the background, and before another surface
    behind it: a face that has no corner in common with it (by place, so that seams are no ends),
    and whose plane is farther away at the centres of both pixels, by more than 1e-4 of the depth.
    Edges on one surface have no gradient then; for textures add ``interpolation_gradient=True``.
    ``gradient="none"`` leaves all of this out, for example to fit depth or colours alone. The
    images are the same (depth and normals up to rounding). ``docs/examples/draw_gradients.py``
    draws the three.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, for faces that refer to missing vertices, for unknown
        outputs, and for colours, lights and backgrounds that do not fit.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt.from_angles(2.732, 30.0, [0.0, 90.0])
    >>> rgb, depth = nmr.render(vertices, faces, camera, outputs=("rgb", "depth"), lights=nmr.Lights(), image_size=64)
    """
    outputs = _check_outputs(outputs)
    check_choice(gradient, "gradient", GRADIENTS)

    scene = make_scene(
        vertices, faces, camera, image_size, anti_aliasing, fill_back, near, far, clip, eps
    )
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
    vertices : Tensor [B, V, 3] or [V, 3], or a list of Tensors [V_b, 3]; float32 or float64
        World coordinates; without a camera renderer space: x right, y up, both in [-1, 1],
        z = depth.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
        Vertex indices.
    camera : Camera, optional
        For example :class:`nmr.LookAt`. One mesh and a camera with B poses give B images.
    colors : VertexColors, FaceColors, TextureCubes, UVTexture or any object with ``sample(fragments)``, optional
        Without them the meshes are white.
    lights : Lights, optional
        Colours are multiplied by the light. Without lights they are drawn unchanged.
    background : number, [C], or Tensor [B, C]
        Colour of pixels without a face.
    image_size : int or (height, width)
        Pixels: h and w; an int means a square.
    anti_aliasing : bool
        Render 2h x 2w pixels and average 2x2 of them.
    fill_back : bool
        Also draw faces that are seen from behind (clockwise on the screen).
    near, far : float
        A pixel is covered only if near < depth < far.
    clip : bool
        Cut the faces that reach behind the plane at depth ``near`` (details:
        :func:`render_silhouette`).
    eps : float
        In NMR's gradient, added to the distance between an edge and a pixel; in the local one the
        least difference of two rates.
    gradient : "nmr", "local" or "none"
        The definition of the gradient at edges. The images are the same.
    interpolation_gradient : bool
        Adds the true derivative of interpolated colours with respect to the position of a pixel
        on its face, so that vertices also move to shift colours under the pixels. The published
        renderer does not have this: there colours move vertices only through edges.

    Returns
    -------
    Tensor [B, h, w, C]
        ``rgb[b, y, x]`` is the colour of the pixel in row y from the top, with as many channels
        as ``colors`` have.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, for faces that refer to missing vertices, and for
        colours, lights and backgrounds that do not fit.

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
    vertices : Tensor [B, V, 3] or [V, 3], or a list of Tensors [V_b, 3]; float32 or float64
        With a camera: world coordinates. Without: coordinates in renderer space (x right, y up,
        both in [-1, 1] across the image, z = depth). One mesh and a camera with B poses give B
        images. The meshes of a list may have different sizes; they are not padded, and each is
        drawn as if it were alone.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
        Vertex indices. A face is seen from its front if its vertices run counter-clockwise on the
        screen.
    camera : Camera, optional
        For example :class:`nmr.LookAt`.
    image_size : int or (height, width)
        Pixels: h and w; an int means a square. x and y in renderer space go from -1 to 1 across
        the whole image. LookAt, Look and Orthographic have square pixels: their field of view
        belongs to the shorter side.
    anti_aliasing : bool
        Render 2h x 2w pixels and average 2x2 of them.
    fill_back : bool
        Also draw faces that are seen from behind (clockwise on the screen). LookAt, Look and
        Orthographic show mesh files mirrored, so that their outsides are clockwise, unless they
        are ``right_handed``.
    near, far : float
        A pixel is covered only if near < depth < far.
    clip : bool
        Cut the faces that reach behind the plane at depth ``near``, so that their part in front
        is drawn where it is seen, with gradients to their corners. Without this, as in the
        published renderer, corners behind the eye land mirrored on the image, and the whole face
        is drawn wrongly. Scenes in front of the plane are the same. The plane lies at far / 1e5
        if near is 0, at far / 1e8 if near is smaller than that: nothing nearer is drawn. Without
        a camera, x and y are taken as divided by z (perspective). In float32, a near of less than
        a thousandth of a scene around the eye can leave single pixels open where cut faces meet;
        take float64 or a larger near (a warning says so).
    eps : float
        In NMR's gradient, added to the distance between an edge and a pixel (in units of [-1,
        1]). In the local one, the gradient is 0 if the two directions lower the loss at rates
        that differ by less than eps. Both as published. (It also limits coordinates in texture
        cubes to ts - 1 - eps: see :class:`nmr.TextureCubes`.)
    gradient : "nmr", "local" or "none"
        The definition of the gradient. The images are the same.

    Returns
    -------
    Tensor [B, h, w], dtype and device of ``vertices``
        ``alpha[b, y, x]`` is the covered part (0 or 1; with anti-aliasing 0, 1/4, ... 1) of the
        pixel in row y from the top.

    Notes
    -----
    Differentiable in x and y of ``vertices`` (and through the camera); z in renderer space gets
    0. NMR's gradient is a definition, not the derivative of the image (Kato et al. 2018, section
    3). On each raster line that crosses an edge of a visible face, every pixel m whose change
    would lower the loss by D pulls the two vertices of the edge with D / d, where d is how far
    the vertex must move until the edge reaches m. The values equal those of the published kernels
    in float32; ``docs/conventions.md`` lists the differences. Results do not depend on the number
    of threads or on the batch size. There are no second derivatives.

    The local gradient is that of Kato and Harada 2019 (view prior learning). I is the coverage (0
    or 1) of pixels of the raster, R is its width (for y its height). g is the gradient of the
    loss with respect to I (with anti-aliasing a quarter of the gradient of the image pixel). i
    and j are neighbours, j to the right of i::

        right(i, j) = -(I_i - I_j) g_j R / 2    rate at which the loss falls if the content of i moves to j
        left(i, j)  = -(I_j - I_i) g_i R / 2    rate at which the loss falls if the content of j moves to i

    For each covered pixel, ``right`` and ``left`` are summed over its pairs with the left and the
    right neighbour. Pairs of two covered pixels, and pairs across the border of the image,
    contribute 0. The derivative of the loss with respect to x of the point seen in the pixel is
    then -right if right > left, and +left otherwise; it is 0 if neither sum is positive, or if
    they differ by less than ``eps``. It is distributed to the corners of the pixel's face by
    their screen-space weights at the pixel's centre (clamped to [0, 1], normalised, treated as
    constants). y is treated in the same way, upwards. So only pixels at the rim of an object have
    a gradient, and a target that is farther than one pixel from the rim has no effect.

    No mesh gives a NaN: faces with a corner that is not finite draw nothing and get no gradient.
    (A gradient of the loss that is not finite is passed on.)

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, for faces that refer to missing vertices, and for an
        unknown gradient.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt.from_angles(2.732, 30.0, [0.0, 90.0], half_fov_deg=15.0)
    >>> nmr.render_silhouette(0.4 * vertices, faces, camera, image_size=64).shape
    torch.Size([2, 64, 64])
    """
    check_choice(gradient, "gradient", GRADIENTS)
    scene = make_scene(
        vertices, faces, camera, image_size, anti_aliasing, fill_back, near, far, clip, eps
    )
    alpha, _ = scene.silhouette(gradient)
    return alpha


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
    vertices : Tensor [B, V, 3] or [V, 3], or a list of Tensors [V_b, 3]; float32 or float64
        World coordinates; without a camera renderer space: x right, y up, both in [-1, 1],
        z = depth.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
        Vertex indices.
    camera : Camera, optional
        For example :class:`nmr.LookAt`. One mesh and a camera with B poses give B images.
    sigma : float or Tensor []
        How soft the image is. A pixel at the distance d from the border of a face is covered by
        it with probability ``D = sigmoid(d^2 / sigma)`` if it is inside, else
        ``sigmoid(-d^2 / sigma)``. d is in units of half the shorter side of the image: at
        sqrt(sigma) from the border D is 0.27 or 0.73.
    dist_eps : float
        Faces for which D would be less than this at a pixel outside are left out there. In (0,
        0.5).
    image_size : int or (height, width)
        Pixels: h and w; an int means a square.
    anti_aliasing : bool
        Render 2h x 2w pixels and average 2x2 of them.
    fill_back : bool
        Also draw faces that are seen from behind (clockwise on the screen).
    near, far : float
        A pixel is covered only if near < depth < far.
    clip : bool
        Cut the faces that reach behind the plane at depth ``near`` (details:
        :func:`render_silhouette`).

    Returns
    -------
    Tensor [B, h, w]
        ``alpha = 1 - product over all faces of (1 - D)``. Faces count whether they are seen or
        hidden.

    Notes
    -----
    Differentiable in x and y of the vertices (and through the camera): this is the true
    derivative of the image (up to the jump of dist_eps), and in sigma. z gets 0. Formulas and
    constants are the published ones. Unlike there, faces wholly nearer than ``near`` or farther
    than ``far`` are left out, and ``fill_back=False`` leaves out those seen from behind. There is
    no second derivative.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, for faces that refer to missing vertices, for a sigma
        that is not positive, and a dist_eps outside (0, 0.5).

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
    vertices : Tensor [B, V, 3] or [V, 3], or a list of Tensors [V_b, 3]; float32 or float64
        World coordinates; without a camera renderer space: x right, y up, both in [-1, 1],
        z = depth.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
        Vertex indices.
    camera : Camera, optional
        For example :class:`nmr.LookAt`. One mesh and a camera with B poses give B images.
    image_size : int or (height, width)
        Pixels: h and w; an int means a square.
    anti_aliasing : bool
        Render 2h x 2w pixels and average 2x2 of them.
    fill_back : bool
        Also draw faces that are seen from behind (clockwise on the screen).
    near, far : float
        A pixel is covered only if near < depth < far.
    clip : bool
        Cut the faces that reach behind the plane at depth ``near`` (details:
        :func:`render_silhouette`).

    Returns
    -------
    Tensor [B, h, w]
        ``depth[b, y, x]`` is z of the nearest face at the pixel in row y from the top, ``far`` on
        background. With anti-aliasing it is the mean of 2x2 pixels, so that edges mix in ``far``,
        as published; else z is exact.

    Notes
    -----
    Differentiable in x, y and z of the vertices (and through the camera): the true derivative of
    z at each pixel. Coverage is treated as fixed: depth does not move edges. There is no second
    derivative.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, and for faces that refer to missing vertices.

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
    vertices : Tensor [B, V, 3] or [V, 3], or a list of Tensors [V_b, 3]; float32 or float64
        World coordinates; without a camera renderer space: x right, y up, both in [-1, 1],
        z = depth.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
        Vertex indices.
    camera : Camera, optional
        For example :class:`nmr.LookAt`. One mesh and a camera with B poses give B images.
    smooth : bool
        Interpolated normals of the vertices instead of normals of the faces.
    space : "world" or "camera"
        "camera": x to the right of the image, y up, z away from the viewer.
    image_size : int or (height, width)
        Pixels: h and w; an int means a square.
    anti_aliasing : bool
        Render 2h x 2w pixels and average 2x2 of them.
    fill_back : bool
        Also draw faces that are seen from behind (clockwise on the screen).
    near, far : float
        A pixel is covered only if near < depth < far.
    clip : bool
        Cut the faces that reach behind the plane at depth ``near`` (details:
        :func:`render_silhouette`).

    Returns
    -------
    Tensor [B, h, w, 3]
        ``normals[b, y, x]`` is the unit normal of the side that is seen
        (:meth:`Fragments.normals`) at the pixel in row y from the top: the normal of the face or,
        with ``smooth``, the interpolated normal of its vertices. 0 on background. With
        anti-aliasing it is the mean of 2x2 pixels, and shorter than 1 at edges.

    Notes
    -----
    Differentiable in the vertices: the true derivative at fixed coverage.
    ``fragments.resolve(fragments.normals())`` is the same image, with NMR's edge gradient in
    addition.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, and for faces that refer to missing vertices.

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
    vertices : Tensor [B, V, 3] or [V, 3], or a list of Tensors [V_b, 3]; float32 or float64
        World coordinates; without a camera renderer space: x right, y up, both in [-1, 1],
        z = depth.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
        Vertex indices.
    camera : Camera, optional
        For example :class:`nmr.LookAt`. One mesh and a camera with B poses give B images.
    image_size : int or (height, width)
        Pixels: h and w; an int means a square.
    anti_aliasing : bool
        Render 2h x 2w pixels and average 2x2 of them.
    fill_back : bool
        Also draw faces that are seen from behind (clockwise on the screen).
    near, far : float
        A pixel is covered only if near < depth < far.
    clip : bool
        Cut the faces that reach behind the plane at depth ``near`` (details:
        :func:`render_silhouette`).
    eps : float
        That of NMR's gradient in :meth:`Fragments.resolve`.
    faces_per_pixel : int
        K in 1..1024: how many surfaces to return, one behind the other. 1 means the nearest,
        without an axis for K.
    blur_radius : float
        If positive, faces count also for pixels outside whose squared distance from their border
        (in units of half the shorter side of the image) is less than this, and there is an axis
        for K. Weights outside are clamped to [0, 1] and divided by their sum, as in SoftRas, and
        depth follows from them. See :attr:`Fragments.distances`.

    Returns
    -------
    Fragments
        h x w pixels; with ``anti_aliasing`` 2h x 2w pixels, which :meth:`Fragments.resolve`
        averages. With K > 1, ``sided_face_index[b, y, x, k]`` is the face of the k-th nearest
        surface, -1 behind the last one (there weights are 0 and depth is ``far``). Of equally
        near faces the first one comes first.

    Notes
    -----
    In the vertices, weights and depth have true derivatives; :meth:`Fragments.resolve` has NMR's
    gradient.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, for faces that refer to missing vertices, and for a
        faces_per_pixel that is not an integer in 1..1024.

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
        return scene.soft_fragments(
            layers, torch.tensor(blur_radius, dtype=torch.float64, device="cpu"), 1.0
        )
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
    vertices : Tensor [B, V, 3] or [V, 3], or a list of Tensors [V_b, 3]; float32 or float64
        World coordinates; without a camera renderer space: x right, y up, both in [-1, 1],
        z = depth.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
        Vertex indices.
    camera : Camera, optional
        For example :class:`nmr.LookAt`. One mesh and a camera with B poses give B images.
    image_size : int or (height, width)
        Pixels: h and w; an int means a square.
    fill_back : bool
        Also draw faces that are seen from behind (clockwise on the screen).
    near, far : float
        A pixel is covered only if near < depth < far.
    clip : bool
        Cut the faces that reach behind the plane at depth ``near`` (details:
        :func:`render_silhouette`).

    Returns
    -------
    int32 Tensor [B, h, w]
        ``face_index[b, y, x] = f`` means face f is nearest there (seen from either side); -1 is
        background. Row 0 is the top. Of equally near faces the first one is taken. Not
        differentiable.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges, and for faces that refer to missing vertices.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> face_index = nmr.render_face_index(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), image_size=64)
    >>> seen = torch.unique(face_index[face_index >= 0])
    """
    scene = make_scene(vertices, faces, camera, image_size, False, fill_back, near, far, clip)
    return scene.face_index(scene.rasterize())
