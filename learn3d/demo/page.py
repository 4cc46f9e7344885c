"""The page itself: its parts, the work of its buttons, and the server. Pictures of visitors are read in workers."""

from __future__ import annotations

import contextlib
import gc
import io
import logging
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from starlette.middleware import Middleware

from learn3d.data.framing import TOLERANCE, read_picture, threshold_mask
from learn3d.demo.gate import Gate
from learn3d.demo.picture import SIDE, Picture, example, make_mesh, open_picture, outline, write_cutout, write_mesh
from learn3d.files.findings import DamagedFile
from learn3d.make_data.shapes import CATEGORIES
from learn3d.pictures.sheets import save_gif, save_png
from learn3d.pictures.surfaces import draw_around
from learn3d.reconstruction import Model, load_model
from learn3d.terminal import plain, say, stop_on_signal

os.environ |= {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_OFFLINE": "1"}  # before gradio is imported
import gradio as gr

if TYPE_CHECKING:
    from gradio.data_classes import FileData

WAITING = 64  # requests in the queue; the next visitor is asked to come back
VISITORS = 256  # whose pictures are kept, 1 MB each
KEPT = 3600  # seconds for which the files of a visitor are kept
_MASK = (0, 200, 235)  # few objects have this colour
_FRAMES, _FRAME_SIDE = 24, 300  # of the picture that turns
_STRENGTH = 0.55  # opacity of the mask over the picture
_PROGRESS = gr.Progress()
#: On a phone the mesh lies below the picture.
_SHOW = "() => { if (innerWidth < 700) document.querySelector('.mesh').scrollIntoView({behavior: 'smooth'}) }"
_PICTURES = [".png", ".jpg", ".jpeg", ".webp", ".bmp"]
_ALONE = {"concurrency_limit": 1, "concurrency_id": "networks", "show_progress": "minimal"}  # one visitor at a time
_EDITOR = {"sources": [], "transforms": [], "layers": False, "buttons": [], "format": "png", "fixed_canvas": True}
_EDITOR |= {"brush": gr.Brush(20, [(f"rgb{_MASK}", _STRENGTH)], color_mode="fixed"), "eraser": gr.Eraser(20)}
_LAUNCH = {"share": False, "ssr_mode": False, "mcp_server": False, "enable_monitoring": False, "run_history": False}
_LAUNCH |= {"prevent_thread_lock": True, "quiet": True, "footer_links": [], "state_session_capacity": VISITORS}
_LAUNCH |= {"max_file_size": 32 * 2**20, "theme": gr.themes.Default(font=["system-ui"], font_mono=["monospace"])}


@contextlib.contextmanager
def _sentences() -> Iterator[None]:
    """Show errors about a visitor's picture on the page, as one sentence."""
    try:
        yield
    except (ValueError, OSError) as error:
        text = f"{error.path.name}: {error.message}" if isinstance(error, DamagedFile) else str(error)
        raise gr.Error(text, print_exception=False) from None


def _layer(file: bytes | FileData | None, flatten_on_white: bool = False) -> np.ndarray | None:
    """Opacity uint8 [H,W] of a layer that a browser sends; None for the background and the composite."""
    if file is None or flatten_on_white:
        return None
    with _sentences(), tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "drawing") if isinstance(file, bytes) else Path(file.path)
        if isinstance(file, bytes):
            path.write_bytes(file)
        colors, alpha = read_picture(path, SIDE)
    return np.full(colors.shape[:2], 255, np.uint8) if alpha is None else alpha


def _show(picture: Picture, mask: np.ndarray) -> dict:
    """The content of the editor: a mask uint8 [H,W] over the picture, as a layer to correct with brush and eraser."""
    layer = np.zeros((*mask.shape, 4), np.uint8)
    layer[mask > 127] = (*_MASK, round(255 * _STRENGTH))
    return {"background": picture.colors, "layers": [layer], "composite": None}


def page(models: dict[str, Model], root: Path) -> gr.Blocks:
    """The page: a picture and its outline on the left, the meshes of all models on the right; files go below `root`."""

    def open_upload(path: str, tolerance: float) -> tuple:
        with _sentences():
            new = open_picture(Path(path), tolerance)
        return new, outline(new), gr.Accordion(open=False)

    def draw_example(category: str) -> tuple:
        new = example(category, time.time_ns() % 2**32)
        return new, outline(new), gr.Accordion(open=False)

    def edit(given: Picture | None) -> dict | None:
        return given and _show(given, given.mask)

    def threshold(given: Picture | None, tolerance: float) -> dict | None:
        return given and _show(given, threshold_mask(given.colors, tolerance))

    def empty(given: Picture | None) -> dict | None:
        return given and _show(given, np.zeros_like(given.mask))

    def make(given: Picture | None, drawing: dict | None = None, progress: gr.Progress = _PROGRESS) -> list:
        with _sentences():
            if given is None:
                raise ValueError("Give a picture first, or take an example")
            if drawing and drawing["layers"]:
                given = given._replace(mask=255 * (np.max(drawing["layers"], axis=0) > 64).astype(np.uint8))
            files, meshes, words = [write_cutout(given, Path(tempfile.mkdtemp(dir=root)))], [], []
            for label, model in models.items():
                made = make_mesh(model, given, lambda text, part: progress(part, f"fitting: {text}"))
                surface = made.surface
                if not len(surface.faces):
                    raise ValueError("the model makes an empty shape of this picture; try another picture or model")
                name = given.name if len(models) == 1 else f"{given.name} {label}"
                files += write_mesh(surface, Path(tempfile.mkdtemp(dir=root)), name)
                radius = 3.3 * float(surface.vertices.norm(dim=1).max())  # a narrow window shows all of it, too
                turns = np.arange(_FRAMES) * (360 / _FRAMES)
                moving = files[-1].with_suffix(".gif")
                save_gif(moving, draw_around(surface, made.azimuth_deg - turns, image_size=_FRAME_SIDE))
                meshes += [str(moving), gr.Model3D(str(files[-2]), camera_position=(-made.azimuth_deg, 70, radius))]
                words.append(made.warning or "")
        said = " ".join(f"**Careful:** {text}." for text in dict.fromkeys(words) if text)
        return [
            said,
            outline(given),
            *meshes,
            *(gr.DownloadButton(value=str(file), interactive=True) for file in files),
        ]

    def clear(path: str) -> list:
        blank, unready = [None] * (3 + 2 * len(models)), [gr.DownloadButton(interactive=False)] * len(files)
        return [path, "Reading the picture ...", *blank, *unready]

    with gr.Blocks(title="learn3d demo", analytics_enabled=False, delete_cache=(KEPT // 10, KEPT)) as blocks:
        gr.Markdown("# Picture to mesh")
        kinds = dict.fromkeys(kind.strip() for m in models.values() for kind in m.config.category.split(","))
        gr.Markdown(
            f"Drop a picture of one object of a kind that the model knows: {', '.join(kinds)}. "
            "Sides that the picture does not show are guessed."
        )
        arrived, picture, meshes = gr.State(), gr.State(), []
        with gr.Row():
            with gr.Column(scale=2, min_width=320):
                upload = gr.File(label="Picture", height=120, file_types=_PICTURES)
                gr.Markdown("Or take a generated one:")
                with gr.Row():
                    examples = {
                        category: gr.Button(category, size="sm", min_width=90, icon=_thumbnail(category, root))
                        for category in CATEGORIES
                    }
                seen = gr.Image(label="The object, as it was found", height=320, interactive=False, buttons=[])
                with gr.Accordion("Correct the outline", open=False) as correction:
                    editor = gr.ImageEditor(label="Object (blue)", canvas_size=(SIDE, SIDE), **_EDITOR)
                    editor.convert_and_format_image = _layer  # gradio's own opens uploads in this process
                    tolerance = gr.Slider(0, 1, TOLERANCE, label="Threshold", info="Difference to a plain background")
                    with gr.Row():
                        emptied = gr.Button("Empty mask", size="sm")
                        start = gr.Button("Make the mesh again", size="sm", variant="primary")
                    files = [gr.DownloadButton("Save the cut-out (PNG)", size="sm", interactive=False)]
            with gr.Column(scale=3, min_width=320):
                status = gr.Markdown("The mesh appears here.")
                with gr.Row():
                    for label in models:
                        with gr.Column(min_width=240):
                            still = {"height": 300, "interactive": False, "buttons": []}
                            meshes.append(gr.Image(label=label, elem_classes="mesh", **still))
                            meshes.append(gr.Model3D(label="To turn by hand", height=380, interactive=False))
                            with gr.Row():
                                small = {"size": "sm", "min_width": 60, "interactive": False}
                                files += [gr.DownloadButton(kind, **small) for kind in ("GLB", "OBJ")]
        shown, made = [picture, seen, correction], [status, seen, *meshes, *files]
        tolerance.release(threshold, [picture, tolerance], editor, **_ALONE)
        emptied.click(empty, [picture], editor, **_ALONE)
        arrivals = [
            button.click(partial(draw_example, name), None, shown, **_ALONE) for name, button in examples.items()
        ]
        uploaded = upload.upload(clear, upload, [arrived, status, upload, picture, seen, *meshes, *files])
        arrivals.append(uploaded.then(open_upload, [arrived, tolerance], shown, **_ALONE))
        for arrival in arrivals:
            arrival.success(lambda: "Making the mesh ...", None, status).success(
                make, [picture], made, show_progress_on=meshes, **_ALONE
            ).success(None, js=_SHOW)
        correction.expand(edit, picture, editor, **_ALONE)
        start.click(make, [picture, editor], made, show_progress_on=meshes, **_ALONE)
    for block in blocks.blocks.values():
        if isinstance(block, gr.components.Component):
            block.async_move_resource_to_block_cache = partial(_keep, block.async_move_resource_to_block_cache)
    return blocks.queue(max_size=WAITING)


def _thumbnail(category: str, root: Path) -> str:
    """A small picture of a generated object, for the button of its category."""
    path = root / f"{category}.png"
    save_png(path, example(category, 4).colors[::4, ::4])
    return str(path)


async def _keep(keep: Any, path: str | Path | None) -> str | None:
    """Take a file into the cache, by gradio's own `keep`, which would fetch it if a request names an address."""
    if "://" in str(path):
        raise gr.Error("a picture must be uploaded: nothing is fetched from elsewhere", print_exception=False)
    return await keep(path)


class _PlainStderr(io.TextIOBase):
    """Stderr by way of `plain`: tracebacks of gradio and logs of uvicorn quote a visitor's words."""

    def __init__(self) -> None:
        self._stream = sys.stderr

    def write(self, text: str) -> int:
        self._stream.write(plain(text))
        self._stream.flush()
        return len(text)


def labels(runs: Sequence[Path]) -> list[str]:
    """A name for each run: that of its folder or file; numbered if several have the same."""
    names = [Path(run).resolve().name for run in runs]
    return [f"{name} {i + 1}" if names.count(name) > 1 else name for i, name in enumerate(names)]


def serve(runs: Sequence[Path], *, host: str, port: int, browser: bool) -> None:
    """Load the models of `runs` (none: the package's small one) and serve the page until a signal asks for the end.

    Raises ValueError and OSError for models that cannot be loaded and an address that is taken.
    """
    models = dict(zip(labels(runs), map(load_model, runs), strict=True)) if runs else {"small model": load_model(None)}
    with tempfile.TemporaryDirectory(prefix="learn3d-demo-") as folder, stop_on_signal() as stop:
        os.environ["GRADIO_TEMP_DIR"] = f"{folder}/uploads"
        root = Path(folder, "results")
        root.mkdir()
        blocks = page(models, root)
        gate = {"app_kwargs": {"middleware": [Middleware(Gate, host=host)]}}
        with contextlib.redirect_stderr(_PlainStderr()):
            try:
                _, url, _ = blocks.launch(server_name=host, server_port=port, inbrowser=browser, **gate, **_LAUNCH)
            except OSError as error:
                raise OSError(f"cannot open a page at {host}:{port}; give another --port or --host") from error
            say(f"the page is at {url} (Ctrl-C ends it)")
            while not stop.name:
                time.sleep(0.1)
            logging.getLogger("uvicorn.error").disabled = True  # it reports its own end as an error
            blocks.server.force_exit = True  # it would wait for pages that are open
            blocks.close(verbose=False)
    gc.freeze()  # taking all of it apart when Python ends would take seconds
