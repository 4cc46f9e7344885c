"""The page itself: what is on it, what its buttons do, and the server. Pictures of visitors are read in workers."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from learn3d.data.framing import TOLERANCE, read_picture, threshold_mask
from learn3d.demo import fit_tab, picture_tab
from learn3d.demo.fit_tab import SIDES
from learn3d.demo.picture_tab import Picture
from learn3d.files.findings import DamagedFile
from learn3d.make_data.shapes import CATEGORIES
from learn3d.pictures.sheets import save_png
from learn3d.pictures.surfaces import Surface
from learn3d.reconstruction import Model, load_model
from learn3d.terminal import stop_on_signal

os.environ |= {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_OFFLINE": "1"}  # before gradio is imported
import gradio as gr

if TYPE_CHECKING:
    from gradio.data_classes import FileData

WAITING = 16  # visitors; the next one is asked to come back
_MASK = (0, 200, 235)  # few objects have this colour
_CANVAS = 320  # pixels of a silhouette
_STRENGTH = 0.55  # opacity of the mask over the picture
_PICTURES = [".png", ".jpg", ".jpeg", ".webp", ".bmp"]
_ALONE = {"concurrency_limit": 1, "concurrency_id": "networks", "show_progress": "minimal"}  # one visitor at a time
_EDITOR = {"sources": [], "transforms": [], "layers": False, "buttons": [], "format": "png", "fixed_canvas": True}
_EDITOR |= {"brush": gr.Brush(20, [(f"rgb{_MASK}", _STRENGTH)], color_mode="fixed"), "eraser": gr.Eraser(20)}
_LAUNCH = {"share": False, "ssr_mode": False, "mcp_server": False, "enable_monitoring": False, "run_history": False}
_LAUNCH |= {"prevent_thread_lock": True, "quiet": True, "footer_links": []}
_LAUNCH |= {"max_file_size": 32 * 2**20, "state_session_capacity": WAITING}
_LAUNCH["theme"] = gr.themes.Default(font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"])


def _layer(file: bytes | FileData | None, flatten_on_white: bool = False) -> np.ndarray | None:
    """Opacity uint8 [H,W] of a layer that a browser sends; None for the background and the composite."""
    if file is None or flatten_on_white:
        return None
    with _told(), tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "drawing") if isinstance(file, bytes) else Path(file.path)
        if isinstance(file, bytes):
            path.write_bytes(file)
        colors, alpha = read_picture(path, picture_tab.SIDE)
    return np.full(colors.shape[:2], 255, np.uint8) if alpha is None else alpha


def _drawing(**options: Any) -> gr.ImageEditor:
    """A picture to paint a mask on, which is read as any stranger's picture."""
    editor = gr.ImageEditor(**_EDITOR, **options)
    editor.convert_and_format_image = _layer  # gradio's own opens what the browser sends in this process
    return editor


def drawn(value: dict | None) -> np.ndarray | None:
    """What is painted in any layer of a drawing, uint8 [H,W], 0 or 255; None: there is nothing to paint on."""
    layers = value["layers"] if value else []
    return 255 * (np.max(layers, axis=0) > 64).astype(np.uint8) if layers else None


def _painted(mask: np.ndarray) -> np.ndarray:
    """A mask uint8 [H,W] as a layer to correct with brush and eraser."""
    layer = np.zeros((*mask.shape, 4), np.uint8)
    layer[mask > 127] = (*_MASK, round(255 * _STRENGTH))
    return layer


def _editor(background: np.ndarray | str, mask: np.ndarray) -> dict:
    return {"background": background, "layers": [_painted(mask)], "composite": None}


@contextlib.contextmanager
def _told() -> Iterator[None]:
    """Show errors about a visitor's picture on the page, as one sentence."""
    try:
        yield
    except (ValueError, OSError) as error:
        text = f"{error.path.name}: {error.message}" if isinstance(error, DamagedFile) else str(error)
        raise gr.Error(text, print_exception=False) from None


def _shown(surface: Surface, name: str, azimuth_deg: float, root: Path) -> tuple:
    """What a `_viewer` is to show: a mesh from this azimuth, and its files, in a new folder of `root`."""
    if not len(surface.faces):
        raise ValueError("the model makes an empty shape of this picture; try another picture, or another model")
    glb, obj = map(str, picture_tab.write_mesh(surface, Path(tempfile.mkdtemp(dir=root)), name))
    radius = 3.3 * float(surface.vertices.norm(dim=1).max())  # all of it is seen in a narrow window, too
    mesh = gr.Model3D(glb, camera_position=(-azimuth_deg, 70, radius))
    return mesh, *(gr.DownloadButton(value=file, interactive=True) for file in (glb, obj))


def _viewer(label: str) -> list:
    """A place for a mesh, and for its files."""
    mesh = gr.Model3D(label=label, height=440, interactive=False)
    with gr.Row():
        return [mesh, *(gr.DownloadButton(k, size="sm", min_width=60, interactive=False) for k in ("GLB", "OBJ"))]


def _example_buttons() -> dict[str, gr.Button]:
    with gr.Row():
        return {category: gr.Button(category, size="sm", min_width=60) for category in CATEGORIES}


def picture_page(models: dict[str, Model], root: Path) -> None:
    """Tab 1: a picture and its mask on the left, the meshes of all models on the right."""

    def show(new: Picture) -> tuple:
        return new, _editor(new.colors, new.mask)

    def upload(path: str, tolerance: float) -> tuple:
        with _told():
            return show(picture_tab.open_picture(Path(path), tolerance))

    def paint(given: Picture | None, mask: Callable[[Picture], np.ndarray]) -> dict | None:
        return given and _editor(given.colors, mask(given))

    def threshold(given: Picture | None, tolerance: float) -> dict | None:
        return paint(given, lambda picture: threshold_mask(picture.colors, tolerance))

    def cut_out(given: Picture | None) -> dict | None:
        return paint(given, lambda picture: picture_tab.object_mask(picture.colors))

    def empty(given: Picture | None) -> dict | None:
        return paint(given, lambda picture: np.zeros_like(picture.mask))

    def restore(given: Picture | None) -> dict | None:
        return paint(given, lambda picture: picture.mask)

    def draw_example(category: str) -> tuple:
        return show(picture_tab.example(category, time.time_ns() % 2**32))

    def make(given: Picture | None, chosen: list[str], drawing: dict | None = None) -> list:
        outputs = []
        with _told():
            if given is None:
                raise ValueError("Give a picture first, or take an example")
            mask = drawn(drawing)
            new = given if mask is None else given._replace(mask=mask)
            cutout = picture_tab.write_cutout(new, Path(tempfile.mkdtemp(dir=root)))
            outputs.append(gr.DownloadButton(value=str(cutout), interactive=True))
            for label, model in models.items():
                if label not in chosen:
                    outputs += [gr.skip()] * 3
                    continue
                name = new.name if len(models) == 1 else f"{new.name} {label}"
                surface, azimuth = picture_tab.make_mesh(model, new)
                outputs += _shown(surface, name, azimuth, root)
        return outputs

    def clear() -> list:
        off = gr.DownloadButton(interactive=False)
        return [None, None, off, *[None, off, off] * len(models)]

    picture = gr.State()
    gr.Markdown(
        "1. Give a picture of an object, or press a category. 2. See that the mask covers the object. 3. Turn the mesh."
    )
    with gr.Row():
        with gr.Column(scale=2, min_width=320):
            upload_box = gr.File(label="Picture", height=140, file_types=_PICTURES)
            examples = _example_buttons()
            editor = _drawing(label="Mask (bright blue)", canvas_size=(picture_tab.SIDE, picture_tab.SIDE))
            tolerance = gr.Slider(0, 1, TOLERANCE, label="Threshold", info="Difference to the background")
            with gr.Row():
                emptied, again = gr.Button("Empty mask", size="sm"), gr.Button("Mask as at first", size="sm")
            removed = gr.Button("Find the object (rembg)", visible=find_spec("rembg") is not None)
            cutout = gr.DownloadButton("Save the cut-out (PNG)", size="sm", interactive=False)
        with gr.Column(scale=3, min_width=320):
            chosen = gr.CheckboxGroup(list(models), value=list(models), label="Models", visible=len(models) > 1)
            start = gr.Button("Make the mesh", variant="primary")
            columns, meshes = [], []
            with gr.Row():
                for label in models:
                    with gr.Column(min_width=240) as column:
                        meshes += _viewer(label)
                    columns.append(column)
    chosen.change(lambda names: [gr.Column(visible=label in names) for label in models], [chosen], columns)
    shown, made = [picture, editor], [cutout, *meshes]
    tolerance.release(threshold, [picture, tolerance], editor, **_ALONE)
    for button, mask in ((again, restore), (emptied, empty), (removed, cut_out)):
        button.click(mask, [picture], editor, **_ALONE)
    arrivals = [example.click(partial(draw_example, name), None, shown, **_ALONE) for name, example in examples.items()]
    uploaded = upload_box.upload(clear, None, [*shown, *made]).then(upload, [upload_box, tolerance], shown, **_ALONE)
    for arrival in (uploaded, *arrivals):
        arrival.success(make, [picture, chosen], made, **_ALONE)
    start.click(make, [picture, chosen, editor], made, **_ALONE)


def fit_page(root: Path) -> None:
    """Tab 2: silhouettes above, the fit and its mesh below."""

    def draw_example(category: str) -> list[dict]:
        masks = fit_tab.example_silhouettes(category, time.time_ns() % 2**32).values()
        large = (np.asarray(Image.fromarray(mask).resize((_CANVAS, _CANVAS))) for mask in masks)
        return [_editor(paper, mask) for mask in large]

    def fit(*drawings: dict | None) -> Iterator[tuple]:
        with _told():
            for moment in fit_tab.fit(dict(zip(SIDES, map(drawn, drawings), strict=True))):
                yield moment.picture, f"step {moment.step}, IoU {moment.iou:.2f}", moment.surface

    def show(surface: Surface) -> tuple:
        return _shown(surface, "fitted", -30, root)

    paper = str(root / "paper.png")  # a file: each picture that is given as an array is written anew while it is sent
    save_png(Path(paper), np.full((_CANVAS, _CANVAS, 3), 255, np.uint8))
    gr.Markdown("Paint one object from two or three sides, or take an example: a sphere is then fitted to it.")
    examples = _example_buttons()
    with gr.Row():
        how = {"value": {"background": paper, "layers": [], "composite": None}, "canvas_size": (_CANVAS, _CANVAS)}
        drawings = [_drawing(label=f"From the {side}", min_width=240, **how) for side in SIDES]
    with gr.Row():
        start = gr.Button("Fit", variant="primary")
        stop = gr.Button("Stop")
    with gr.Row():
        with gr.Column(min_width=320):
            live = gr.Image(label="Orange: yours; blue: the mesh; grey: both", buttons=[], height=440, format="png")
            said = gr.Markdown()
        with gr.Column(min_width=320):
            fitted = _viewer("Fitted mesh")
    for category, example in examples.items():
        example.click(partial(draw_example, category), None, drawings, **_ALONE)
    surface = gr.State()
    fitting = start.click(fit, drawings, [live, said, surface], **_ALONE)
    fitting.success(show, [surface], fitted, **_ALONE)
    stop.click(None, cancels=[fitting])


def page(models: dict[str, Model], root: Path) -> gr.Blocks:
    """The page; files of meshes are written below `root`."""
    with gr.Blocks(title="learn3d demo", analytics_enabled=False) as blocks:
        gr.Markdown("# learn3d demo")
        with gr.Tab("Picture to mesh"):
            picture_page(models, root)
        with gr.Tab("Fit a mesh"):
            fit_page(root)
    return blocks.queue(max_size=WAITING)


def labels(runs: Sequence[Path]) -> list[str]:
    """A name for each run: that of its folder or file; numbered where they would be the same."""
    paths = [Path(run).resolve() for run in runs]
    names = [path.stem if path.is_file() else path.name for path in paths]
    return [f"{name} {i + 1}" if names.count(name) > 1 else name for i, name in enumerate(names)]


def check_address(host: str, port: int) -> None:
    """OSError, in a sentence, where nobody can listen there."""
    try:
        with socket.create_server((host, port)):
            pass
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OSError(f"cannot open a page at {host}:{port} ({reason}); give another --port or --host") from None


def serve(runs: Sequence[Path], *, host: str, port: int, browser: bool, report: Callable[[str], None]) -> None:
    """Load the models of `runs` (none: the package's small one) and serve the page until a signal asks for the end.

    Raises ValueError and OSError for models that cannot be loaded and an address that is taken.
    """
    check_address(host, port)
    models = dict(zip(labels(runs), map(load_model, runs), strict=True)) if runs else {"small model": load_model(None)}
    with tempfile.TemporaryDirectory(prefix="learn3d-demo-") as folder, stop_on_signal() as stop:
        os.environ["GRADIO_TEMP_DIR"] = folder  # uploads go there, too
        blocks = page(models, Path(folder))
        where = {"server_name": host, "server_port": port, "inbrowser": browser, "allowed_paths": [folder]}
        _, url, _ = blocks.launch(**where, **_LAUNCH)
        logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)  # tracebacks where a visitor leaves early
        report(f"the page is at {url} (Ctrl-C ends it)")
        while not stop.name:
            time.sleep(0.1)
        blocks.server.force_exit = True  # it would wait for pages that are open
        blocks.close(verbose=False)
    gc.freeze()  # taking all of it apart when Python ends would take seconds
