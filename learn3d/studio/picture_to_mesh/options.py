"""Options of the way from a picture to a mesh, which `tools/measure_*` can vary.

Lengths are in units of the object frame unless they name pixels. `docs/log` has the measurements
behind the defaults.
"""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class CutOptions:
    """How an object is found in a picture without transparency."""

    side: int = 384
    """Longer side in pixels of the picture for GrabCut."""
    searched_side: int = 512
    """Longer side in pixels to which a picture is reduced before its object is searched."""
    cut_out_side: int = 1024
    """Longer side in pixels to which an object with a mask is reduced."""
    frame: float = 0.15
    """Widest frame around a picture that is peeled off, as a share of its shorter side."""
    frames: int = 4
    """Frames, one in the other, that are peeled off at most."""
    plain: float = 0.9
    """Least share of the border with one colour in pictures with a plain background."""
    even: float = 0.06
    """Largest difference from this colour, in 0 .. 1; walls and floors differ by more."""
    tolerance: float = 0.12
    """Largest difference of the background from its colour, in 0 .. 1."""
    jpeg_noise: int = 6
    """Levels by which compression changes the background near an object."""
    plain_hole: float = 0.5
    """A hole of the mask shows the background if more than this share of it has its colour."""
    holes: tuple[float, float] = (0.001, 0.4)
    """Least and largest size of such a hole, as a share of the object. Larger holes are often white
    table tops."""
    rounds: int = 3
    """Rounds of GrabCut."""
    around: int = 16
    """Width in pixels of the region around strokes that GrabCut sees."""
    certain: float = 0.995
    """Probability from which GrabCut does not decide."""
    boxed: float = 0.2
    """Share of a box's view with which GrabCut starts if the network finds nothing there."""
    small_hole: float = 0.002
    """Smaller holes are filled, as a share of the object."""
    rectangle: float = 0.9
    """Share of its box that an upright rectangle fills: probably a picture on the wall."""
    framed: float = 0.6
    """Share of the picture from which the box of an upright rectangle is a doubt: it may be a frame."""
    parts: int = 3
    """Parts that may be the object."""
    part: float = 0.1
    """Their least area, over that of the largest."""
    touched: float = 0.03
    """Share of a side of the picture, from which the object touches it: a doubt in a photograph, or if
    it touches two."""
    ragged: float = 600.0
    """Squared length of an outline over its area from which it is doubtful; a thin-legged chair has
    200."""
    sure: float = 0.82
    """Least sureness of a mask, see `cut_out`; less is a doubt."""
    possible: float = 0.15
    """Least probability of pixels that may belong to the same thing."""
    fills: float = 0.25
    """Least share of its box that the box of an outline fills; less is a doubt."""
    agreed: float = 0.6
    """Least IoU of rembg's mask and the package's network; less is a doubt."""
    kept: float = 0.8
    """Least share of a mask that is kept as the object; less is a doubt."""
    ink: int = 16
    """Brightness up to which a pixel of a drawing is black."""
    black: float = 0.7
    """Share of black pixels from which a picture is a black drawing, see `fill_drawing`."""
    grey: float = 0.95
    """Share of grey pixels from which a black drawing has no colours."""
    apart: float = 0.12
    """Largest gap between parts of a black drawing, over the length of its largest region."""
    gap: float = 0.04
    """Half of the widest gap in a line that is closed, as a share of the drawing."""
    drawn: float = 0.75
    """Share of a drawing up to which it consists of lines."""


@dataclass(frozen=True)
class FitOptions:
    """How a camera is found, and how a predicted shape is fitted to an outline."""

    elevations_deg: tuple[float, ...] = (0.0, 12.0, 25.0, 40.0, 55.0, 75.0)
    """Elevations that are tried with each azimuth."""
    starts: int = 6
    """Best of these views, from which the camera is optimised."""
    steps: int = 25
    """Steps of the camera."""
    belief: float = 0.05
    """Weight of the log-probability of a view; that of the IoU is 1."""
    code_steps: int = 45
    """Steps of the code, without templates."""
    vertex_steps: int = 45
    """Steps of the vertices, without templates."""
    code_rate: float = 0.07
    """Learning rate of the code, in units of the root mean square of its entries."""
    vertex_rate: float = 0.004
    """Learning rate of the vertices."""
    pull: float = 0.1
    """Weight of the squared relative distance between the code and the predicted one."""
    smoothness: float = 3e-4
    """Weight of the smoothness loss."""
    stiffness: float = 10.0
    """Weight of the Laplacian loss of the vertices' displacements."""


KNOWN_CAMERAS = FitOptions(
    code_steps=40, vertex_steps=40, code_rate=0.1, vertex_rate=0.002, smoothness=1e-3
)


@dataclass(frozen=True)
class MatchOptions:
    """How templates are chosen, stretched, bent and ranked."""

    candidates: int = 80
    """Templates with the nearest codes, which are made and compared with the picture."""
    kept: int = 32
    """Best of them, which are stretched."""
    bent: int = 8
    """Best of these, which are bent and then ranked."""
    poor: float = 0.86
    """IoU of the best stretched template below which other cameras are tried."""
    flying: tuple[str, ...] = ("airplane",)
    """Categories that may be turned in a picture."""
    flies: float = 0.3
    """Probability of these categories from which a turned picture is tried."""
    rolls_deg: tuple[float, ...] = (-60.0, -45.0, -30.0, 30.0, 45.0, 60.0)
    """Angles of the picture in its plane that are tried then."""
    retries: int = 2
    """How many of the most familiar angles are tried. Each takes a third of the candidates."""
    doubted: float = 0.5
    """Factor of the voxels' and the codes' weights then."""
    rolled: float = 0.25
    """Cost of a camera that is turned about its axis."""
    voxels: float = 0.5
    """Weight of the IoU with the predicted shape; that of the outline is 1."""
    nearness: float = 0.5
    """Weight of the codes' cosine and of the bonus below."""
    other: float = 0.8
    """Probability of other things from which a picture is doubted."""
    kind: float = 0.4
    """Weight of the logarithm of their category's probability, beside the cosine."""
    least: float = 0.01
    """Least probability that counts."""
    edges: float = 0.15
    """Weight of the distance of two outlines in pixels of 64."""
    farthest: float = 6.0
    """Largest distance of outlines and lines that counts, in pixels of 64."""
    lines: float = 0.15
    """Weight of the distance of two pictures' lines in pixels of 64."""
    line_contrast: float = 0.03
    """Change of a colour from pixel to pixel that makes a line."""
    line_bend: float = 0.5
    """Sum of the normal's changes from pixel to pixel that makes a line."""
    colors: float = 0.5
    """Weight of the difference of colours between parts that are mirror images."""
    ranked_size: int = 128
    """Side in pixels of the pictures in which bent templates are ranked."""
    alike: float = 0.3
    """Cost of a guess with the same voxels as a better one; with others it is in proportion."""
    stretching: float = 1.0
    """Weight of unequal factors along the axes."""
    stretch_steps: int = 30
    """Steps of stretching."""
    lattice: int = 6
    """Points of the lattice for bending along each axis."""
    bending: float = 0.25
    """Weight of their moves."""
    bent_cost: float = 0.5
    """Share of the cost of these moves that counts in the ranking."""
    bending_steps: int = 60
    """Steps of bending."""


@dataclass(frozen=True)
class ColorOptions:
    """How a mesh gets the colours of a picture."""

    behind: float = 0.02
    """Distance behind the depth map from which a vertex is hidden."""
    grazing: float = 0.25
    """Cosine between normal and line of sight below which a colour is not used."""
    border: int = 2
    """Width in pixels of the border inside the outline that may have the background's colours. Its
    inner pixels count half, as thin legs have no others."""
    contour: float = 24.0
    """Width of the widest line that a drawing may have along its outline, in pixels of a picture of 256."""
    even: float = 0.15
    """A pixel belongs to this line if no channel differs more from the line's colour, in 0 .. 1."""
    others: float = 0.3
    """A drawing has such a line if at most this share of the pixels along its outline have another
    colour, and at most this share of the pixels deeper inside have the line's colour."""
    drawn: float = 0.2
    """Weight of pixels of this line, beside 1 of others, when hidden parts get colours."""
    coarse: float = 0.05
    """Longest edge of the mesh on which the colours of hidden parts are found."""
    fine: float = 0.025
    """Longest edge of the coloured mesh."""
    equal: float = 0.06
    """Two parts are equal if the sizes of their boxes and their heights differ by less."""
    neighbours: int = 60
    """Clearly seen vertices at a similar height whose median colour a hidden part has."""
    spreading: float = 5e-2
    """Weight of these colours; that of alike neighbours is 0.01."""
    sure: float = 0.02
    """Squared reliability of a colour that counts as much as those of the neighbours."""


@dataclass(frozen=True)
class SmoothOptions:
    """How an outline is inflated."""

    grid: int = 72
    """Cells along each side of the cube in which the surface lies."""
    depth: float = 0.8
    """Thickness of the shape of a disc, over the disc's diameter."""
    edge: int = 2
    """Pixels inside the outline that may have the background's colours."""
    rounds: int = 4
    """Rounds of smoothing."""
    thin: int = 3
    """Pixels from the middle of a part to its sides, up to which it is thin."""


@dataclass(frozen=True)
class Options:
    """All options from a picture to a mesh."""

    cut: CutOptions = field(default_factory=CutOptions)
    fit: FitOptions = field(default_factory=FitOptions)
    match: MatchOptions = field(default_factory=MatchOptions)
    color: ColorOptions = field(default_factory=ColorOptions)
    smooth: SmoothOptions = field(default_factory=SmoothOptions)


DEFAULTS = Options()
