"""The page itself: what is on it, what its buttons do, and the server. Pictures of visitors are read in workers."""

from __future__ import annotations

import contextlib
import os
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from learn3d.data.framing import read_picture
from learn3d.demo import fit_tab, picture_tab
from learn3d.demo.fit_tab import SIDES
from learn3d.demo.picture_tab import Picture
from learn3d.files.findings import DamagedFile
from learn3d.make_data.shapes import CATEGORIES
from learn3d.reconstruction import Model, load_model
from learn3d.terminal import stop_on_signal

os.environ |= {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_OFFLINE": "1"}  # before gradio is imported
import gradio as gr  # noqa: E402

if TYPE_CHECKING:
    from gradio.data_classes import FileData

UPLOAD_BYTES = 32 * 2**20
WAITING = 16  # visitors; the next one is asked to come back
_MASK = (230, 50, 60)
_CANVAS = 320  # pixels of a silhouette
_STRENGTH = 0.55  # opacity of the mask over the picture
_PICTURES = [".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff"]
_ALONE = {"concurrency_limit": 1, "concurrency_id": "networks", "show_progress": "minimal"}  # one visitor at a time
_EDITOR = {"sources": [], "transforms": [], "layers": False, "buttons": [], "format": "png", "fixed_canvas": True}
_EDITOR |= {"brush": gr.Brush(20, [(f"rgb{_MASK}", _STRENGTH)], color_mode="fixed"), "eraser": gr.Eraser(20)}
_THEME = gr.themes.Default(font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"])


def _layer(file: bytes | FileData | None, flatten_on_white: bool = False) -> np.ndarray | None:
    """Opacity uint8 [H,W] of a layer that a browser sends; None for the background and the composite."""
    if file is None or flatten_on_white:
        return None
    with tempfile.TemporaryDirectory() as folder:
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


def _editor(background: np.ndarray, mask: np.ndarray) -> dict:
    return {"background": background, "layers": [_painted(mask)], "composite": None}


@contextlib.contextmanager
def _told() -> Iterator[None]:
    """What is wrong with a visitor's picture is said on the page, in a sentence."""
    try:
        yield
    except (ValueError, OSError) as error:
        text = f"{error.path.name}: {error.message}" if isinstance(error, DamagedFile) else str(error)
        raise gr.Error(text, title="Not like this", print_exception=False) from None


def _new_folder(root: Path) -> Path:
    return Path(tempfile.mkdtemp(dir=root))


def picture_page(models: dict[str, Model], root: Path) -> None:
    """Tab 1."""
    picture = gr.State()

    def show(new: Picture) -> tuple:
        return new, _editor(*new), *[None] * (3 * len(models))

    def upload(path: str | None, tolerance: float) -> tuple:
        if path is None:
            return None, None, *[None] * (3 * len(models))
        with _told():
            return show(picture_tab.open_picture(Path(path), tolerance))

    def threshold(old: Picture | None, tolerance: float) -> tuple:
        if old is None:
            return None, None
        new = Picture(old.colors, picture_tab.threshold_mask(old.colors, tolerance))
        return new, _editor(*new)

    def cut_out(old: Picture | None) -> tuple:
        import rembg

        with _told():
            if old is None:
                raise ValueError("Give a picture first")
            new = Picture(old.colors, np.asarray(rembg.remove(Image.fromarray(old.colors), only_mask=True)))
            return new, _editor(*new)

    def make(old: Picture | None, drawing: dict | None, chosen: list[str]) -> Iterator[tuple]:
        with _told():
            if old is None:
                raise ValueError("Give a picture first, or take an example")
            mask = drawn(drawing)
            new = old if mask is None else Picture(old.colors, mask)
            outputs = []
            for label, model in models.items():
                if label not in chosen:
                    outputs += [gr.Model3D(visible=False), *[gr.DownloadButton(visible=False)] * 2]
                    continue
                found = picture_tab.make_mesh(model, new, _new_folder(root), label)
                camera = (180 + found.azimuth_deg, 70, None)
                outputs.append(gr.Model3D(str(found.glb), camera_position=camera, visible=True))
                outputs += [gr.DownloadButton(value=str(path), visible=True) for path in (found.glb, found.obj)]
            return tuple(outputs)

    with gr.Row():
        with gr.Column(scale=2, min_width=320):
            given = gr.File(label="Picture", height=140, file_types=_PICTURES)
            with gr.Row():
                examples = [gr.Button(category, size="sm", min_width=60) for category in CATEGORIES]
            editor = _drawing(label="Mask: paint the object red", canvas_size=(picture_tab.SIDE, picture_tab.SIDE))
            tolerance = gr.Slider(0, 1, picture_tab.TOLERANCE, label="Threshold: how far from the background's colour")
            removed = gr.Button("Find the object (rembg)", visible=find_spec("rembg") is not None)
        with gr.Column(scale=3, min_width=320):
            several = len(models) > 1
            chosen = gr.CheckboxGroup(list(models), value=list(models), label="Models", visible=several)
            button = gr.Button("Make the mesh", variant="primary")
            meshes = []
            with gr.Row():
                for label in models:
                    with gr.Column(min_width=240):
                        meshes.append(gr.Model3D(label=label, height=480, interactive=False))
                        with gr.Row():
                            meshes += [gr.DownloadButton(kind, size="sm", min_width=60) for kind in ("GLB", "OBJ")]
    making = {"fn": make, "inputs": [picture, editor, chosen], "outputs": meshes, **_ALONE}
    given.upload(upload, [given, tolerance], [picture, editor, *meshes], **_ALONE)
    for number, category in enumerate(CATEGORIES):
        draw = lambda category=category: show(picture_tab.example(category, time.time_ns() % 2**32))  # noqa: E731
        examples[number].click(draw, None, [picture, editor, *meshes], **_ALONE)
    tolerance.release(threshold, [picture, tolerance], [picture, editor], **_ALONE)
    removed.click(cut_out, [picture], [picture, editor], **_ALONE)
    button.click(**making)


def fit_page(root: Path) -> None:
    """Tab 2."""
    white = np.full((_CANVAS, _CANVAS, 3), 255, np.uint8)

    def choose(category: str) -> list[dict]:
        masks = fit_tab.example_silhouettes(category, time.time_ns() % 2**32).values()
        large = (np.asarray(Image.fromarray(mask).resize((_CANVAS, _CANVAS))) for mask in masks)
        return [_editor(white, mask) for mask in large]

    def fit(*drawings: dict | None) -> Iterator[tuple]:
        with _told():
            masks = dict(zip(SIDES, map(drawn, drawings), strict=True))
            nothing = [gr.skip()] * 3
            for moment in fit_tab.fit(masks):
                yield moment.picture, f"step {moment.step}, IoU {moment.iou:.2f}", *nothing
            glb, obj = picture_tab.write_mesh(moment.surface, _new_folder(root), "fitted")
            yield moment.picture, gr.skip(), str(glb), str(glb), str(obj)

    gr.Markdown("Paint the same object from two or three sides, or take an example. A sphere is then fitted to it.")
    with gr.Row():
        examples = [gr.Button(category, size="sm", min_width=60) for category in CATEGORIES]
    with gr.Row():
        value, size = {"background": white, "layers": [], "composite": None}, (_CANVAS, _CANVAS)
        drawings = [_drawing(value=value, label=side, canvas_size=size, min_width=240) for side in SIDES]
    with gr.Row():
        start = gr.Button("Fit", variant="primary")
        stop = gr.Button("Stop")
    live = gr.Image(label="Yours orange, the mesh blue, both grey", buttons=[], format="png", interactive=False)
    said = gr.Markdown()
    mesh = gr.Model3D(label="Fitted mesh", height=360, interactive=False)
    with gr.Row():
        files = [gr.DownloadButton(kind, size="sm", min_width=60) for kind in ("GLB", "OBJ")]
    for number, category in enumerate(CATEGORIES):
        examples[number].click(lambda category=category: choose(category), None, drawings, **_ALONE)
    fitting = start.click(fit, drawings, [live, said, mesh, *files], **_ALONE)
    stop.click(None, cancels=[fitting])


def page(models: dict[str, Model], root: Path) -> gr.Blocks:
    """The page; files of meshes are written below `root`."""
    with gr.Blocks(title="learn3d demo", analytics_enabled=False, delete_cache=(600, 3600)) as blocks:
        gr.Markdown("# learn3d demo")
        with gr.Tab("Picture to mesh"):
            picture_page(models, root)
        with gr.Tab("Fit a mesh"):
            fit_page(root)
    return blocks.queue(max_size=WAITING)


def labels(runs: Sequence[Path]) -> list[str]:
    """A name for each run: that of its folder or file; numbered where they would be the same."""
    names = [Path(run).resolve().stem for run in runs]
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
        _, url, _ = blocks.launch(
            server_name=host,
            server_port=port,
            inbrowser=browser,
            prevent_thread_lock=True,
            share=False,
            quiet=True,
            allowed_paths=[folder],
            max_file_size=UPLOAD_BYTES,
            footer_links=[],
            run_history=False,
            enable_monitoring=False,
            ssr_mode=False,
            mcp_server=False,
            state_session_capacity=WAITING,
            theme=_THEME,
        )
        report(f"the page is at {url} (Ctrl-C ends it)")
        while not stop.name:
            time.sleep(0.1)
        blocks.close(verbose=False)
