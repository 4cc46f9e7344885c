"""From an image with a mask to a mesh file and pictures of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import skimage.transform
import torch
import trimesh
from PIL import Image
from torch import nn

import nmr
from learn3d.config import TrainConfig
from learn3d.data.conventions import DISTANCE, HALF_FOV_DEG, mesh_to_object
from learn3d.data.crops import Crops
from learn3d.data.dataset import MASK_SIZE
from learn3d.data.framing import OBJECT_SHARE, check_mask, mask_box, read_photo, read_picture, threshold_mask
from learn3d.data.layouts import LAYOUTS, Layout
from learn3d.data.poses import LookAtPoses, Poses
from learn3d.files import limits, writing
from learn3d.methods import MeshMethod, Method
from learn3d.methods.refinement import refine
from learn3d.networks.encoders import centre
from learn3d.pictures.sheets import natural_colors, save_gif, save_png, tile
from learn3d.pictures.surfaces import Surface, azimuths_deg, draw_around, turntable
from learn3d.runs import checkpoint
from learn3d.runs.export import small_model

STRIP_SIZE = 192
_LARGE = 1024  # pixels a side in which an object is searched for
_FINE = 4  # at least as many pixels, per side, are kept for one of a prepared image
LARGEST_PICTURE = 2048  # pixels: shapes are drawn four times as fine, and the renderer goes up to 8192


def prepare_image(
    colors: np.ndarray,
    mask: np.ndarray,
    *,
    crop: bool = True,
    object_share: float = OBJECT_SHARE,
    size: int = 64,
    layout: Layout = "kato",
    nearest: bool = False,
) -> np.ndarray:
    """Bring an image of any size into the form that a data set of the layout has, uint8 [4,size,size]: colours, mask.

    The object is laid over white and, with `crop`, centred in a square so that its larger side takes `object_share` of
    it, as in the data set; without, the image must be framed like that already and is only made square and scaled.
    Colours are inverted where the layout inverts them. Where images are stretched (Pascal3D+), the background stays,
    and `crop` takes the mask's box, padded and stretched as the reader does it (`learn3d.data.crops`). nearest: small
    images keep their pixels when enlarged, for people to look at.
    """
    if colors.ndim != 3 or colors.shape[2] != 3 or mask.shape != colors.shape[:2]:
        raise ValueError(f"colors must be [H, W, 3] and mask [H, W], got {list(colors.shape)} and {list(mask.shape)}")
    if LAYOUTS[layout].stretched:
        return _stretched(colors, mask, crop, size)
    if crop:
        rows, columns = (np.flatnonzero(mask.max(axis=axis) > 127) for axis in (1, 0))
        if len(rows) == 0:
            raise ValueError("the mask has no pixel above half strength; is it the right mask?")
        extent = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
        centre_y, centre_x = (rows[0] + rows[-1] + 1) / 2, (columns[0] + columns[-1] + 1) / 2
        side = extent / object_share
        if side > limits.SQUARE_SIDE:
            raise ValueError(
                f"the object is {extent} pixels large and would take {object_share:.3g} of a square of {side:.3g}; at "
                f"most {limits.SQUARE_SIDE} are made: make the image smaller, or frame it yourself (--no-crop)"
            )
    else:
        centre_y, centre_x = mask.shape[0] / 2, mask.shape[1] / 2
        side = float(max(mask.shape))
    reduction = max(1, int(side / (_FINE * size)))  # photographs are averaged in blocks first, which is much faster
    left, top, side = (x / reduction for x in (centre_x - side / 2, centre_y - side / 2, side))
    resized = _resample(_over_white(colors, mask, reduction), left, top, side, size, nearest)
    if not LAYOUTS[layout].inverted:
        resized[..., :3] = 255 - resized[..., :3]
    return np.rint(resized.transpose(2, 0, 1)).clip(0, 255).astype(np.uint8)


def _read(path: Path, mask_path: Path | None, plain_background: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Colours uint8 [H,W,3] and a mask uint8 [H,W] that shows something; see `read_photo` and `threshold_mask`."""
    if plain_background and mask_path is None:
        colors, mask = read_picture(path, _LARGE)
        mask = threshold_mask(colors) if mask is None else mask
        try:
            check_mask(mask)
        except ValueError as error:
            raise ValueError(
                f"{path}: taken by the colour of the border, {error} Cut the object out (transparency), or give --masks"
            ) from None
        return colors, mask
    colors, mask = read_photo(path, mask_path)
    if not mask.any():
        raise ValueError(f"the mask of {path} is empty: no pixel belongs to the object")
    if not (mask > 127).all():
        try:
            check_mask(mask, cropped=True)
        except ValueError as error:
            raise ValueError(f"{mask_path or path}: {error}") from None
    return colors, mask


class Model(NamedTuple):
    """A trained model, ready to turn pictures into meshes."""

    method: Method
    config: TrainConfig
    object_share: float  # of the side of its training images that objects take

    def prepare(self, colors: np.ndarray, mask: np.ndarray, **options: Any) -> np.ndarray:
        """`prepare_image` for these networks; the options may have another size."""
        form = {"object_share": self.object_share, "size": self.method.image_size, "layout": self.config.layout}
        return prepare_image(colors, mask, **form | options)

    def shown(self, stored: np.ndarray) -> np.ndarray:
        """Images uint8 [..., 4, S, S] as stored -> uint8 [..., S, S, 3] for people."""
        return natural_colors(stored, inverted=LAYOUTS[self.config.layout].inverted)


def load_model(run: Path | None, which: str = "last") -> Model:
    """The model of a run folder or checkpoint file; None: the small one that comes with the package."""
    method, config, metadata = checkpoint.load_method(checkpoint.find(run or small_model(), which))
    return Model(method, config, metadata.progress.object_share or OBJECT_SHARE)


@torch.no_grad()
def reconstruct(
    method: Method, images: np.ndarray, masks: torch.Tensor | None = None, poses: Poses | None = None
) -> list[Surface]:
    """Meshes, in the object frame, of images uint8 [B,4,S,S] as stored.

    With masks float32 [B,64,64] and poses, shapes are fitted to them (`methods.refinement`). Raises ValueError for
    methods whose shapes are not meshes.
    """
    pixels = torch.from_numpy(images)
    if poses is None:
        return method.decode(method.encode(pixels)).surfaces()
    if not isinstance(method, MeshMethod):
        raise ValueError("only meshes can be fitted to masks, and this run predicts voxels; leave out --refine")
    return refine(method, pixels, masks, poses).surfaces()


@torch.no_grad()
def input_azimuth_deg(surface: Surface, mask: np.ndarray) -> float:
    """From where the shape's silhouette agrees best with the mask uint8 [S,S] of its image; a multiple of 15 degrees.

    The camera of an image is not known: this is a guess for pictures. Azimuths are compared at four elevations, and
    outlines at one size, as the distance is not known either.
    """
    small = nn.functional.interpolate(torch.from_numpy(mask)[None, None].float() / 255, (64, 64), mode="area")
    target = _centred(small[:, 0])
    azimuths = [15.0 * k for k in range(24)]
    loss = [
        nmr.losses.soft_iou_loss(silhouette[None], target)
        for elevation in (0.0, 10.0, 20.0, 30.0)
        for silhouette in _centred(
            nmr.render_silhouette(
                surface.vertices,
                surface.faces,
                nmr.LookAt.from_angles(DISTANCE, elevation, azimuths, half_fov_deg=HALF_FOV_DEG),
                image_size=64,
            )
        )
    ]
    return azimuths[int(torch.stack(loss).argmin()) % len(azimuths)]


def _centred(masks: torch.Tensor) -> torch.Tensor:
    """Masks float [B,64,64], moved and scaled so that their boxes lie in the middle and have one size."""
    return centre(masks[:, None])[:, 0]


def export_mesh(path: Path, surface: Surface) -> None:
    """Write a mesh of the object frame as OBJ, GLB or PLY (by the file's ending), y up, right-handed.

    The object frame is left-handed; the reflection back turns the faces, whose normals point outwards in the file.
    GLB and PLY keep the colours of the vertices. A GLB's node has the file's name, and its material shows faces from
    both sides: learnt surfaces cross themselves, and by glTF's rule a viewer leaves out what is seen from behind.
    """
    kind = path.suffix.lower().lstrip(".")
    if kind not in ("obj", "glb", "ply"):
        raise ValueError(f"mesh files are written as .obj, .glb or .ply, not '{path.name}'")
    points = surface.vertices.detach().cpu().double().numpy() @ mesh_to_object()
    mesh = trimesh.Trimesh(points, surface.faces.cpu().numpy()[:, ::-1], process=False)
    if surface.colors is not None and kind != "obj":
        colors = surface.colors.detach().cpu().clamp(0, 1)
        colors = colors**2.2 if kind == "glb" else colors  # those of a GLB are linear
        mesh.visual.vertex_colors = (colors * 255).round().to(torch.uint8).numpy()
    if kind == "glb":
        content = trimesh.Scene({path.stem: mesh}).export(file_type=kind, tree_postprocessor=_seen_from_both_sides)
    else:
        content = mesh.export(file_type=kind)
    writing.write_bytes(path, content.encode() if isinstance(content, str) else content)


def _seen_from_both_sides(tree: dict) -> None:
    """Give all meshes of a glTF tree a dull material whose faces are seen from both sides."""
    tree["materials"] = [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}]
    for mesh in tree.get("meshes", ()):  # none in an empty shape
        for primitive in mesh["primitives"]:
            primitive["material"] = 0


def check_pictures(frames: int = 36, image_size: int = 256) -> None:
    """Raise a ValueError where no turntable of so many frames, with a side of so many pixels, can be drawn."""
    if frames < 1:
        raise ValueError(f"frames must be at least 1, the pictures of a turntable, got {frames}")
    if not 1 <= image_size <= LARGEST_PICTURE:
        raise ValueError(
            f"image_size must be in 1 .. {LARGEST_PICTURE}, the side of a picture in pixels, got {image_size}"
        )


def save_reconstruction(
    folder: Path,
    name: str,
    picture: np.ndarray,
    mask: np.ndarray,
    surface: Surface,
    *,
    azimuth_deg: float | None = None,
    mesh_format: Literal["obj", "glb", "ply"] = "glb",
    frames: int = 36,
    image_size: int = 256,
) -> list[Path]:
    """Write <name>.<format>, <name>.gif (turntable) and <name>.png (input, mask, six views); returns the three paths.

    picture: the input, uint8 [S,S,3]; mask: uint8 [S,S]. azimuth_deg: where its camera stood; None: it is guessed.
    """
    check_pictures(frames, image_size)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.{suffix}" for suffix in _suffixes(mesh_format)]
    export_mesh(paths[0], surface)
    save_gif(paths[1], turntable(surface, frames=frames, image_size=image_size))
    start = input_azimuth_deg(surface, mask) if azimuth_deg is None else azimuth_deg
    views = draw_around(surface, [start - 60 * k for k in range(6)], image_size=STRIP_SIZE)
    titles = ["input", "mask", "from the input's side", *(f"turned by {60 * k}°" for k in range(1, 6))]
    shown = [_pixels(picture), _pixels(np.repeat(mask[..., None], 3, axis=2))]
    save_png(paths[2], tile([[*shown, *views]], titles, tile_size=STRIP_SIZE))
    return paths


def _suffixes(mesh_format: str) -> tuple[str, str, str]:
    """Endings of the files of one image: mesh, turntable, views."""
    return mesh_format, "gif", "png"


def _pixels(picture: np.ndarray) -> np.ndarray:
    """A picture smaller than a tile of the strip, enlarged so that its pixels are seen."""
    if picture.shape[0] >= STRIP_SIZE:
        return picture
    return np.asarray(Image.fromarray(picture).resize((STRIP_SIZE, STRIP_SIZE), Image.Resampling.NEAREST))


def reconstruct_files(
    run: Path | None,
    folder: Path,
    images: Sequence[Path],
    masks: Sequence[Path] = (),
    *,
    crop: bool = True,
    poses: LookAtPoses | None = None,
    plain_background: bool = False,
    which: str = "last",
    **options: Any,
) -> list[Path]:
    """Reconstruct image files with the networks of a run (see `load_model`) and save the results in `folder`.

    `masks` is empty (the images have transparency, or with `plain_background` what differs from the border's colour is
    the object) or as long as `images`. Where `poses` are given, one of each image,
    shapes are fitted to the masks. `options` go to `save_reconstruction`. Returns the files, named after the images.
    """
    _check(options)
    if masks and len(masks) != len(images):
        raise ValueError(f"there are {len(images)} images but {len(masks)} masks; give one mask per image, or none")
    if poses is not None and len(poses) != len(images):
        raise ValueError(f"there are {len(images)} images but {len(poses)} poses; give one azimuth per image")
    names = [Path(image).stem for image in images]
    if len(set(names)) < len(names):
        names = [f"{number:03}_{name}" for number, name in enumerate(names)]
    _check_inputs_stay([*images, *masks], folder, names, options)
    model, prepared = load_model(run, which), []
    if poses is not None and LAYOUTS[model.config.layout].stretched:
        raise ValueError(
            f"this run learnt from photographs stretched to a square (layout {model.config.layout!r}): no camera shows "
            "image files so, and shapes cannot be fitted to their masks; leave out --refine"
        )
    for image, mask in zip(images, masks or [None] * len(images), strict=True):
        photo = _read(image, mask, plain_background)  # one at a time: they may be large
        strip = model.prepare(*photo, crop=crop, size=STRIP_SIZE, nearest=True)
        prepared.append((model.prepare(*photo, crop=crop), strip))
    stored, fine = map(np.stack, zip(*prepared, strict=True))
    small = nn.functional.interpolate(torch.from_numpy(stored[:, 3:]).float() / 255, MASK_SIZE, mode="area")[:, 0]
    surfaces = reconstruct(model.method, stored, small, poses)
    return _save_all(surfaces, folder, names, model.shown(fine), fine[:, 3], poses, options)


def _check_inputs_stay(inputs: Sequence[Path], folder: Path, names: Sequence[str], options: dict[str, Any]) -> None:
    """Raise ValueError where a result would replace one of the inputs."""
    there = {Path(path).resolve() for path in inputs}
    for name in names:
        for suffix in _suffixes(options.get("mesh_format", "glb")):
            if (path := Path(folder, f"{name}.{suffix}")).resolve() in there:
                raise ValueError(f"the result {path} would replace an image that was given; give another --output")


def reconstruct_dataset(
    run: Path | None,
    folder: Path,
    data: Path,
    indices: Sequence[int],
    *,
    category: str | None = None,
    split: str = "test",
    which: str = "last",
    refined: bool = False,
    **options: Any,
) -> list[Path]:
    """Reconstruct images of a data set (indices object * views + view) and save the results in `folder`.

    refined: fit the shapes to the masks, with the data set's poses. Files are named after the object and its view
    class; where several of the images agree in both, after their index.
    """
    _check(options)
    if not Path(data).is_dir():
        raise FileNotFoundError(f"there is no folder {data}; say where the data set is with --data")
    model = load_model(run, which)
    name = category or model.config.category
    dataset = checkpoint.load_data(model.config, split, data=data, category=name)
    batch = dataset.batch(torch.tensor(indices, dtype=torch.int64))
    numbers = zip(batch.object_ids.tolist(), batch.view_ids.tolist(), strict=True)
    names = [f"{dataset.category}_{split}_object{number:04}_view{view:02}" for number, view in numbers]
    if len(set(names)) < len(names):
        names = [f"{dataset.category}_{split}_image{index:06}" for index in indices]
    if refined and batch.poses is None:
        raise ValueError(f"{dataset.category} has no poses, and shapes are fitted to masks of known pose")
    images = batch.images.numpy()
    surfaces = reconstruct(model.method, images, *(batch.masks, batch.poses) if refined else ())
    return _save_all(surfaces, folder, names, model.shown(images), images[:, 3], batch.poses, options)


def _check(options: dict[str, Any]) -> None:
    """Refuse what `save_reconstruction` would refuse, before a model is loaded."""
    check_pictures(**{name: options[name] for name in ("frames", "image_size") if name in options})


def _save_all(
    surfaces: list[Surface],
    folder: Path,
    names: list[str],
    pictures: np.ndarray,
    masks: np.ndarray,
    poses: Poses | None,
    options: dict[str, Any],
) -> list[Path]:
    written = []
    azimuths = [None] * len(names) if poses is None else azimuths_deg(poses).tolist()
    for name, picture, mask, surface, azimuth in zip(names, pictures, masks, surfaces, azimuths, strict=True):
        written += save_reconstruction(folder, name, picture, mask, surface, azimuth_deg=azimuth, **options)
    return written


def _stretched(colors: np.ndarray, mask: np.ndarray, crop: bool, size: int) -> np.ndarray:
    """The padded box of the mask (or all of the image), as Pascal3D+'s reader gives it to the networks."""
    if not (mask > 127).any():
        raise ValueError("the mask has no pixel above half strength; is it the right mask?")
    height, width = mask.shape
    left, top, right, bottom = mask_box(mask) if crop else (0, 0, width, height)
    box = np.array([[left, top, right - left, bottom - top]])
    planes = (colors, np.repeat(mask[..., None], 3, axis=2))
    cut, cut_mask = (Crops.from_images([np.ascontiguousarray(p)], box, size).cut()[0] for p in planes)
    return np.concatenate([cut, cut_mask[:1]])


def _over_white(colors: np.ndarray, mask: np.ndarray, reduction: int) -> np.ndarray:
    """255 - colour over white, then the mask, float32 [H/r, W/r, 4], averaged over blocks of r x r pixels.

    It is zero outside the object, so padding is plain.
    """
    alpha = mask.astype(np.float32) / 255
    planes = [(255 - colors[..., channel]) * alpha for channel in range(3)] + [255 * alpha]
    return np.stack([np.asarray(Image.fromarray(plane).reduce(reduction)) for plane in planes], axis=2)


def _resample(stored: np.ndarray, left: float, top: float, side: float, size: int, nearest: bool) -> np.ndarray:
    """The square with that corner and side (whole pixels), scaled to [size,size,C], anti-aliased; zero outside."""
    left, top, side = round(left), round(top), max(1, round(side))
    pad = max(0, -left, -top, left + side - stored.shape[1], top + side - stored.shape[0])
    square = np.pad(stored, ((pad, pad), (pad, pad), (0, 0)))[top + pad :, left + pad :][:side, :side]
    order = 0 if nearest and side <= size else 1
    return skimage.transform.resize(square, (size, size), order=order, anti_aliasing=side > size)
