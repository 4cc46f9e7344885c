"""What the plots with axes have in common: one style, colours that everyone can tell apart, files."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import numpy as np
import skimage.color

from learn3d.files import writing
from learn3d.pictures.sheets import with_suffix

if TYPE_CHECKING:
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

P = ParamSpec("P")
R = TypeVar("R")

#: Okabe and Ito's colours, told apart with any kind of colour vision, darker ones first: yellow is too faint for lines.
COLORS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
LINE_STYLES = ("-", "--", "-.", ":")
_STYLE = {
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "text.parse_math": False,  # names are names, whatever dollars are in them
    "svg.hashsalt": "learn3d",  # the same drawing gives the same file
    "svg.fonttype": "none",
}


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Decorator: run a function that uses matplotlib in this module's style, leaving the caller's settings alone.

    Figures are made without pyplot, so no window opens.
    """

    @functools.wraps(draw)
    def wrapper(*args: P.args, **options: P.kwargs) -> R:
        import matplotlib

        with matplotlib.rc_context(_STYLE):
            return draw(*args, **options)

    return wrapper


def line_style(index: int) -> dict[str, str]:
    """Colour and dashes of the index-th line of a plot; no two of the first 28 look alike."""
    return {"color": COLORS[index % len(COLORS)], "linestyle": LINE_STYLES[index // len(COLORS) % len(LINE_STYLES)]}


def cyclic_colors(count: int = 256) -> np.ndarray:
    """Colours of a full turn, float [count, 3] in [0, 1]: no jump at its end, opposite directions clearly different.

    A circle in CIE Lab through lightness and the blue-yellow axis, which every kind of colour vision sees, with some
    red-green in between: dark violet, blue, light green, brown. None is too light for a white page.
    """
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    lab = np.stack([54 - 28 * np.cos(angle), 24 * np.cos(angle) - 16 * np.sin(angle), -50 * np.sin(angle)], axis=1)
    return skimage.color.lab2rgb(lab[None])[0].clip(0, 1)


def cyclic_map() -> ListedColormap:
    """`cyclic_colors` as a colour map."""
    from matplotlib.colors import ListedColormap

    return ListedColormap(cyclic_colors(), name="turn")


@styled
def save_figure(figure: Figure, path: Path, *, dpi: int = 160) -> list[Path]:
    """Write a figure as .png and as .svg, whichever ending `path` has; returns both paths."""
    written = []
    for suffix, options in ((".png", {"dpi": dpi}), (".svg", {"metadata": {"Date": None}})):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix[1:], bbox_inches="tight", **options)
        written.append(with_suffix(path, suffix))
        writing.write_bytes(written[-1], buffer.getvalue())
    return written
