"""Teaches the package's model which kind a drawing shows, from styled renderings and icons of packages.

python -m pip install resvg_py
python tools/learn_kinds.py

It learns from other icon sets than those of draw_strangers.py, and changes `small.safetensors`: the
same command gives the same file on the same machine. It needs npm, and a core for half an hour.
"""

import json
import re
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
import tyro
from draw_strangers import draw_svg, icon_svg, load_package
from scipy import ndimage
from torch import Tensor

import nmr
from learn3d.data.conventions import mesh_to_object
from learn3d.data.masks import keep_object
from learn3d.pictures import photograph, studio_lights
from learn3d.runs import checkpoint
from learn3d.studio.make_data.looks import natural_look
from learn3d.studio.make_data.meshes import fit_to_box
from learn3d.studio.picture_to_mesh.familiarity import learn_kinds
from learn3d.studio.picture_to_mesh.fit import frame_view
from learn3d.studio.picture_to_mesh.make import SMALL_MODEL, load_model
from learn3d.studio.picture_to_mesh.read import fill_drawing, prepare_image
from learn3d.studio.shapes import make_shape

SEED = 78
SIDE = 96  # side in pixels of the pictures before they are varied
PACKAGE = "@iconify/json", "2.2.535"  # of npm, with all icon sets
EMOJI = (
    "noto twemoji openmoji fluent-emoji-flat fluent-emoji fxemoji fluent-emoji-high-contrast streamline-emojis"
).split()
SIGNS = (
    "fa6-solid mingcute ion tabler fluent ri bxs streamline streamline-flex streamline-plump "
    "streamline-freehand-color hugeicons lucide healthicons bi carbon temaki maki fluent-mdl2 uil clarity guidance "
    "vaadin f7 material-symbols at-icons bitcoin-icons boxicons cil flat-ui glyphs glyphs-poly griddy-icons "
    "ic iconmind iconoir keyline-icons la lucide-lab mage majesticons marketeq mynaui picon pinhead "
    "pixelarticons reicon si-glyph streamline-color streamline-cyber streamline-cyber-color streamline-flex-color "
    "streamline-plump-color streamline-sharp streamline-sharp-color vs whh wpf"
).split()
STYLES = (
    "(-(fill|filled|solid|line|outline|sharp|remix|flat|duotone|duo|two-tone|bold|regular|thin|light|rounded|alt|"
    "[0-9]+))*"
)
NAMES = {
    "airplane": "((small|ios|md|airport|jet|transportation|(northeast|up)-pointing(-small|-military)?)-)?(air)?plane"
    "(-(private|sea|tilt|fly|up|engines|side|right|arrival|departure|landing|takeoff))?|"
    "aeroplane|aircraft|(md-)?jet|jet-fighter(-up)?|fighter-jet",
    "car": "((oncoming|police|racing|race|ios|md|vehicle|oncoming-police|electric|hybrid|toy|"
    "baseline-(directions|local))-)?(car|automobile|taxi|cab)"
    "(-(side|rear|sport|front|taxi|taxi-front|sideview|suv|profile|profile-ltr|electric))?|sport-utility-vehicle|jeep",
    "chair": "((baseline|office|rocking|dining|garden|camping|director|sleeper|club)-)?(arm)?chair"
    "(-(counter|director))?|seat|((bar|health)-)?stool",
    "lamp": "((table|desk|study|wall|floor|ceiling|small|street|pole)-)?lamp"
    "(-(ceiling|desk|floor|wall-up|wall-down|round|arm))?",
    "sofa": "(two-seater-)?(sofa|couch)(-(single|and-lamp))?|loveseat",
    "table": "((baseline|workspace|computer|study|office|home|school)-)?desk|"
    "(dining|picnic|coffee)-table|(baseline-)?table-(restaurant|round|bar)",
}
# names of people, signs, and of things that are nearly of a known kind
SKIPPED = (
    "flag|face|person|people|man|woman|men|women|boy|girl|hand|finger|family|couple|kiss|keycap|letter|button|"
    "arrow|car|cars|automobile|plane|airplane|aircraft|jet|seat|chair|couch|sofa|lamp|lantern|table|desk|truck|van|minibus|"
    "ambulance|taxi|police|bench|stool|bed|skin|symbol|clock-face|sign|input|latin|square|text|align|letter|number|"
    "circle|user|users|chart|brand|o-clock|oclock|thirty|medium|dark|light|vehicle|armchair|line|layout|border"
)

Picture = tuple[np.ndarray, np.ndarray]  # colours uint8 [H, W, 3] and mask uint8 [H, W]


def draw_styled(category: str, rng: np.random.Generator, plain: bool) -> Picture:
    """A generated object as a rendering, a flat drawing, one with ink lines, or a silhouette with gaps.

    plain: as a rendering.
    """
    shares = (1, 0, 0, 0) if plain else (0.25, 0.25, 0.3, 0.2)
    mesh = make_shape(category, rng)
    vertices = torch.tensor(fit_to_box(mesh.vertices) @ mesh_to_object("y", "z").T).float()
    faces = torch.tensor(np.asarray(mesh.faces))
    level = rng.random() < 0.5
    azimuth = rng.choice([-90, 0, 90, 180]) if level else rng.uniform(-180, 180)
    elevation = 0.0 if level else rng.choice([rng.uniform(-5, 50), 80.0], p=[0.9, 0.1])
    angles = (torch.tensor([float(value)]) for value in (azimuth, elevation))
    view = frame_view(vertices, *angles)
    camera = view.cameras()
    style = rng.choice(["rendering", "flat", "ink", "gaps"], p=shares)
    colors, lights = natural_look(vertices.numpy(), mesh.faces, rng)
    if style != "rendering":
        lights = studio_lights((0.3, 1.0, 0.2), rng.uniform(0.75, 1.0))
    (rgb,), (alpha,) = photograph(vertices, faces, colors, camera, image_size=192, lights=lights)
    normals = nmr.render_normals(vertices, faces, camera, image_size=192)[0].numpy()
    bend = sum(np.abs(np.diff(normals, axis=axis, append=0)).sum(2) for axis in (0, 1))
    near = ndimage.binary_dilation(bend > 0.6, iterations=int(rng.integers(1, 6)))
    if style in ("flat", "ink"):
        levels = rng.integers(3, 9)
        rgb = (np.round(rgb / 255 * levels) / levels * 255).astype(np.uint8)
    if style == "ink":
        rgb = np.where(near[..., None], rng.integers(0, 60, 3).astype(np.uint8), rgb)
        alpha = np.where(near, np.uint8(255), alpha)
    elif style == "gaps":
        rgb = np.broadcast_to(rng.integers(0, 70, 3).astype(np.uint8), rgb.shape).copy()
        inside = ndimage.binary_erosion(alpha > 127, iterations=5)
        alpha = np.where(near & inside, np.uint8(0), alpha)
    return np.ascontiguousarray(rgb), keep_object(alpha)[0]


def read_sets() -> Iterator[tuple[str, dict[str, bytes]]]:
    """Each icon set of `EMOJI` and `SIGNS`: its name, and its icons by name, as SVG files."""
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(load_package(*PACKAGE, Path(folder))) as packed:
            for name in (*EMOJI, *SIGNS):
                icons = json.load(packed.extractfile(f"package/json/{name}.json"))
                yield name, {key: icon_svg(icons | icon) for key, icon in icons["icons"].items()}


def choose_icons(drawings: dict[str, bytes], others: int) -> Iterator[tuple[str, Picture]]:
    """Kinds, "other" among them, and the icons of a set that are of a known kind, and `others` at random."""
    kinds = {}
    for name in sorted(drawings):
        for kind, wanted in NAMES.items():
            if re.fullmatch(f"({wanted}){STYLES}", name):
                kinds[name] = kind
    signs = re.compile(rf"(^|-)({SKIPPED})(s?)(-|$)")
    free = [name for name in sorted(drawings) if not signs.search(name) and name not in kinds]
    for name in np.random.default_rng(SEED).permutation(free)[:others]:
        kinds[str(name)] = "other"
    for name, kind in kinds.items():
        image = np.asarray(draw_svg(drawings[name], 128))
        mask = keep_object(image[..., 3])[0]
        if (mask > 127).mean() > 0.02:
            yield kind, (np.ascontiguousarray(image[..., :3]), mask)


def vary(images: Tensor, kinds: Tensor, rng: np.random.Generator) -> Tensor:
    """Float images [B, 4, 64, 64] of stored ones: turned, stretched, mirrored, and in other colours.

    An eighth each are silhouettes, line drawings, negatives, and noisy; a quarter is grey; an
    eighth each has thicker and thinner parts. Half of the airplanes, kind 0, are turned far.
    """
    count, size = len(images), 64
    eighths = torch.arange(count).chunk(8)

    def draw(low: float, high: float, *shape: int) -> Tensor:
        return torch.from_numpy(rng.uniform(low, high, (count, *shape))).float()

    far = (kinds == 0) & (draw(0, 1) < 0.5)
    turn = torch.deg2rad(torch.where(far, draw(-60, 60), draw(-9, 9)))
    rotation = torch.stack([turn.cos(), -turn.sin(), turn.sin(), turn.cos()], 1).view(-1, 2, 2)
    moves = torch.diag_embed(1.25 * draw(-0.25, 0.25, 2).exp())
    moves[:, 0, 0] *= draw(-1, 1).sign()
    moves[:, 0, 1] = draw(-0.15, 0.15)
    shape = count, 4, size, size
    grid = F.affine_grid(F.pad(rotation @ moves, (0, 1)), shape, align_corners=False)
    images = F.grid_sample(images.float() / 255, grid, align_corners=False)
    colors, masks = 1 - images[:, :3], images[:, 3:]
    order = draw(0, 1, 3).argsort(1)[..., None, None]
    colors = colors.gather(1, order.expand_as(colors)).clamp(1e-3, 1)
    for rows in eighths[4:6]:
        colors[rows] = colors[rows].mean(1, keepdim=True)
    darkest, lightest = draw(-0.35, 0.35, 3, 1, 1).clamp(min=0), draw(0.5, 1, 3, 1, 1)
    colors = darkest + (lightest - darkest) * colors ** draw(-0.8, 0.8, 1, 1, 1).exp()
    ink, lines, negative, noisy = eighths[:4]
    colors[ink] = draw(0, 0.6, 3, 1, 1)[ink] ** 2
    on_white = colors[lines].mean(1, keepdim=True) * masks[lines] + 1 - masks[lines]
    change = F.max_pool2d(on_white, 3, 1, 1) + F.max_pool2d(-on_white, 3, 1, 1)
    colors[lines] = draw(0.7, 1, 1, 1, 1)[lines] * (1 - 2.5 * change).clamp(min=0)
    colors[negative] = 1 - colors[negative]
    colors[noisy] += 0.08 * torch.from_numpy(rng.standard_normal(colors[noisy].shape)).float()
    masks[::8] = F.max_pool2d(masks[::8], 3, 1, 1)
    masks[4::8] = -F.max_pool2d(-masks[4::8], 3, 1, 1)
    return torch.cat([(1 - colors.clamp(0, 1)) * masks, masks], 1)


def main(path: Path = SMALL_MODEL, objects: int = 400, icons: int = 400, others: int = 240) -> None:
    """Learn the network of `KnownCodes` for an exported model of renderings, and write the model again.

    path: the model's file. objects: generated ones of each kind in all styles, and as many plain
    renderings. icons: fewest of each kind, some of them several times. others: icons of other
    things of each set of emoji; other sets give a quarter.
    """
    torch.set_num_threads(1)
    model = load_model(path)
    names = (*model.categories, "other")

    def store(picture: Picture) -> np.ndarray:
        return prepare_image(*fill_drawing(*picture), size=SIDE, object_size=0.8)

    drawn = {name: [] for name in names}
    for package, drawings in read_sets():
        for kind, picture in choose_icons(drawings, others if package in EMOJI else others // 4):
            drawn[kind].append(store(picture))
    images, kinds = [], []
    for kind, name in enumerate(names):
        found = drawn[name]
        print(f"{name}: {len(found)} icons", flush=True)
        if name != "other":
            found = [found[k % len(found)] for k in range(max(icons, len(found)))]
            for plain in (False, True):
                seeds = ([SEED, kind, number, *[1] * plain] for number in range(objects))
                rngs = map(np.random.default_rng, seeds)
                found += [store(draw_styled(name, rng, plain)) for rng in rngs]
        images += found
        kinds += [kind] * len(found)
    judge = learn_kinds(torch.from_numpy(np.stack(images)), torch.tensor(kinds), True, vary)
    tensors, metadata = checkpoint.load(path)
    learnt = model.known_codes._replace(judge=judge.half()).tensors()
    checkpoint.save(path, tensors | learnt, metadata)


if __name__ == "__main__":
    tyro.cli(main)
