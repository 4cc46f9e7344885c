"""Teaches the package's model which kind a drawing shows, from styled renderings and icons of packages.

python -m pip install resvg_py
python tools/learn_kinds.py

It learns from other icon sets than those of draw_strangers.py, and changes `small.safetensors`. It needs npm.
"""

import io
import re
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import resvg_py
import torch
import torch.nn.functional as F
import tyro
from draw_strangers import read_set
from PIL import Image
from scipy import ndimage

import nmr
from learn3d.data.conventions import mesh_to_object
from learn3d.data.masks import keep_object
from learn3d.pictures import photograph, studio_lights
from learn3d.runs import checkpoint
from learn3d.studio.make_data.looks import natural_look
from learn3d.studio.make_data.meshes import fit_to_box
from learn3d.studio.picture_to_mesh.familiarity import KNOWN_CODES, learn_kinds
from learn3d.studio.picture_to_mesh.fit import frame_view
from learn3d.studio.picture_to_mesh.make import SMALL_MODEL, Model, load_model
from learn3d.studio.picture_to_mesh.read import fill_drawing
from learn3d.studio.shapes import make_shape

SEED = 78
SETS = {
    "@iconify-json/noto": "1.2.9",
    "@iconify-json/twemoji": "1.2.5",
    "@iconify-json/openmoji": "1.2.29",
    "@iconify-json/fluent-emoji-flat": "1.2.6",
    "@iconify-json/fxemoji": "1.2.2",
    "@iconify-json/fluent-emoji-high-contrast": "1.2.6",
    "@iconify-json/fa6-solid": "1.2.4",
    "@iconify-json/mingcute": "1.2.8",
    "@iconify-json/ion": "1.2.7",
    "@iconify-json/tabler": "1.2.41",
}
FILLED = {"mingcute": "-fill", "tabler": "-filled"}  # endings of the names of drawings with areas
NAMES = {
    "airplane": "airplane|small-airplane|plane|plane-up|jet|airplane-(sharp|fill)|plane-filled|plane-tilt-filled|"
    "(northeast-|up-)pointing-(small-|military-)?airplane|jet-fighter(-up)?|airplane-(arrival|departure)",
    "car": "automobile|oncoming-automobile|taxi|oncoming-taxi|police-car|oncoming-police-car|racing-car|"
    "sport-utility-vehicle|car|car-(side|rear|sport|sharp|sport-sharp)|car-(2-|3-)?fill|jeep-fill|car-filled|car-suv-filled",
    "chair": "chair|seat|armchair|seat-fill",
    "lamp": "desk-lamp|desk-lamp-(2-)?fill|ceiling-lamp-fill",
    "sofa": "couch|couch-and-lamp|sofa-fill",
    "table": "desk-fill|table-[23]-fill|bedside-table-(2-)?fill",
}
# names of people, signs, and of things that are nearly of a known kind
SKIPPED = (
    "flag|face|person|people|man|woman|men|women|boy|girl|hand|finger|family|couple|kiss|keycap|letter|button|"
    "arrow|car|cars|automobile|plane|airplane|aircraft|jet|seat|chair|couch|sofa|lamp|lantern|table|desk|truck|van|minibus|"
    "ambulance|taxi|police|bench|stool|bed|skin|symbol|clock-face|sign|input|latin|square|text|align|letter|number|"
    "circle|user|users|chart|brand|o-clock|oclock|thirty|medium|dark|light|vehicle|armchair|line|layout|border"
)

Picture = tuple[np.ndarray, np.ndarray]  # colours uint8 [H, W, 3] and mask uint8 [H, W]


def draw_styled(category: str, rng: np.random.Generator) -> Picture:
    """A generated object in the style of a rendering, a flat drawing, one with ink lines, or a silhouette."""
    mesh = make_shape(category, rng)
    vertices = torch.tensor(fit_to_box(mesh.vertices) @ mesh_to_object("y", "z").T).float()
    faces = torch.tensor(np.asarray(mesh.faces))
    level = rng.random() < 0.5
    azimuth = rng.choice([-90, 0, 90, 180]) if level else rng.uniform(-180, 180)
    elevation = 0.0 if level else rng.choice([rng.uniform(-5, 50), 80.0], p=[0.9, 0.1])
    roll = rng.uniform(-60, 60) * (category == "airplane" or rng.random() < 0.1)
    angles = (torch.tensor([float(value)]) for value in (azimuth, elevation))
    view = frame_view(vertices, *angles, float(roll))
    placed, camera = view.place(vertices[None])[0], view.cameras()
    style = rng.choice(
        ["rendering", "flat", "ink", "silhouette", "lines"], p=[0.2, 0.25, 0.25, 0.2, 0.1]
    )
    colors, lights = natural_look(vertices.numpy(), mesh.faces, rng)
    if style != "rendering":
        lights = studio_lights((0.3, 1.0, 0.2), rng.uniform(0.75, 1.0))
    (rgb,), (alpha,) = photograph(placed, faces, colors, camera, image_size=256, lights=lights)
    if style in ("flat", "ink"):
        levels = rng.integers(3, 9)
        rgb = (np.round(rgb / 255 * levels) / levels * 255).astype(np.uint8)
    normals = nmr.render_normals(placed[None], faces, camera, image_size=256)[0].numpy()
    bend = sum(np.abs(np.diff(normals, axis=axis, append=0)).sum(2) for axis in (0, 1))
    lines = bend > 0.6
    wide = int(rng.integers(1, 7))
    near = ndimage.binary_dilation(lines, iterations=wide)
    if style == "ink":
        rgb = np.where(near[..., None], rng.integers(0, 60, 3).astype(np.uint8), rgb)
        alpha = np.maximum(
            alpha, 255 * ndimage.binary_dilation(alpha > 127, iterations=wide).astype(np.uint8)
        )
    elif style == "lines":
        inside = rng.choice([255, 230])
        rgb = np.where(near[..., None], np.uint8(rng.integers(0, 80)), np.uint8(inside)) + np.zeros(
            (1, 1, 3), np.uint8
        )
        alpha = np.maximum(alpha, 255 * near.astype(np.uint8))
    elif style == "silhouette":
        ink = rng.integers(0, 70, 3) if rng.random() < 0.7 else rng.integers(0, 256, 3)
        rgb = np.broadcast_to(ink.astype(np.uint8), rgb.shape).copy()
        if rng.random() < 0.6:  # gaps between the parts
            cut = lines & ndimage.binary_erosion(alpha > 127, iterations=4)
            cut = ndimage.binary_dilation(cut, iterations=int(rng.integers(1, 4)))
            alpha = np.where(cut, np.uint8(0), alpha)
    if rng.random() < 0.3:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(20, 90))]
        rgb = cv2.imdecode(cv2.imencode(".jpg", rgb, quality)[1], cv2.IMREAD_COLOR)
    return np.ascontiguousarray(rgb), keep_object(alpha)[0]


def vary(picture: Picture, rng: np.random.Generator) -> Picture:
    """A picture stretched, turned a little, mirrored or not, with other colours and thicker or thinner lines."""
    colors, mask = picture
    mixed = colors[..., rng.permutation(3)] / 255
    if rng.random() < 0.5:
        mixed = mixed ** rng.uniform(0.5, 2) * rng.uniform(0.5, 1, 3) + rng.uniform(0, 0.3, 3)
    mask = cv2.erode(mask, None, iterations=int(rng.integers(3)))
    image = np.dstack([(255 * mixed.clip(0, 1)).astype(np.uint8), mask])
    size = (image.shape[1::-1] * rng.uniform(0.8, 1.25, 2)).astype(int)
    turned = Image.fromarray(image).resize(size).rotate(rng.uniform(-8, 8), expand=True)
    image = np.asarray(turned)[:, :: rng.choice([-1, 1])]
    return np.ascontiguousarray(image[..., :3]), keep_object(image[..., 3])[0]


def icons() -> Iterator[tuple[str, Picture]]:
    """Kinds, "other" among them, and icons of all sets."""
    rng = np.random.default_rng(SEED)
    for package, version in SETS.items():
        short = package.split("/")[-1]
        with tempfile.TemporaryDirectory() as place:
            drawings = read_set(package, version, Path(place))
        kinds = {}
        for name in sorted(drawings):
            for kind, wanted in NAMES.items():
                if re.fullmatch(wanted, name):
                    kinds[name] = kind
        signs = re.compile(rf"(^|-)({SKIPPED})(s?)(-|$)")
        filled = [name for name in sorted(drawings) if name.endswith(FILLED.get(short, ""))]
        others = [name for name in filled if not signs.search(name) and name not in kinds]
        for name in rng.permutation(others)[:180]:
            kinds[str(name)] = "other"
        for name, kind in kinds.items():
            content = bytes(resvg_py.svg_to_bytes(svg_string=drawings[name].decode(), width=256))
            image = np.asarray(Image.open(io.BytesIO(content)).convert("RGBA"))
            mask = keep_object(image[..., 3])[0]
            if (mask > 127).mean() > 0.02:
                yield kind, (np.ascontiguousarray(image[..., :3]), mask)


@torch.no_grad()
def encode(model: Model, pictures: Sequence[Picture]) -> torch.Tensor:
    """Normalised codes [N, C] of pictures."""
    stored = [model.prepare(*fill_drawing(*picture)) for picture in pictures]
    parts = torch.from_numpy(np.stack(stored)).split(128)
    return F.normalize(torch.cat([model.method.encode(part) for part in parts]), dim=1)


def main(path: Path = SMALL_MODEL, objects: int = 450, varied: int = 8) -> None:
    """Learn the network of `KnownCodes` for an exported model, and write the model again.

    path: the model's file. objects: generated ones of each kind, each in one style. varied: forms of each
    icon of a known kind; those of other things are seen as they are and mirrored.
    """
    torch.set_num_threads(1)
    model = load_model(path)
    names, rng = (*model.categories, "other"), np.random.default_rng(SEED)
    of_kinds = {name: [] for name in names}
    for kind, picture in icons():
        mirrored = tuple(np.ascontiguousarray(part[:, ::-1]) for part in picture)
        of_kinds[kind] += [picture, mirrored]
        of_kinds[kind] += [vary(picture, rng) for _ in range(varied if kind != "other" else 0)]
    codes, known = [], []
    for kind, name in enumerate(names):
        found = [encode(model, of_kinds[name])]
        if name != "other":
            seeds = ([SEED, kind, number] for number in range(objects))
            drawn = [draw_styled(name, np.random.default_rng(seed)) for seed in seeds]
            centres = F.normalize(model.known_codes.kinds[kind].float(), dim=1)
            found += [encode(model, drawn), centres]
        codes += found
        known.append(torch.full((sum(map(len, found)),), kind))
        print(f"{name}: {len(of_kinds[name])} icons")
    learnt = learn_kinds(torch.cat(codes), torch.cat(known))
    tensors, metadata = checkpoint.load(path)
    tensors |= {name: part.half() for name, part in zip(KNOWN_CODES[1:], learnt, strict=True)}
    checkpoint.save(path, tensors, metadata)


if __name__ == "__main__":
    tyro.cli(main)
