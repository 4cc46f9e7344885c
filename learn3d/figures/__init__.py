"""Pictures for people: what a run shows during training, and the paper's figures from saved checkpoints.

`drawing` draws shapes and writes files, `grids` and `interpolation` put them together; `codes`, `curves` and `polar`
are plots (extra `figures`, loaded when used); `runs` opens checkpoints with their data, `paper` draws each figure.
"""

from learn3d.figures import drawing
from learn3d.figures.drawing import (
    CLAY,
    Surface,
    as_meshes,
    azimuths_deg,
    common_zoom,
    draw_around,
    draw_surface,
    natural_colors,
    orbit,
    save_gif,
    save_png,
    to_uint8,
    turntable,
)
from learn3d.figures.grids import GRID_COLUMNS, comparison_grid, picture_grid
from learn3d.figures.interpolation import interpolation_strip, morph
from learn3d.make_data.sheets import HEADER, MARGIN, TILE, tile
