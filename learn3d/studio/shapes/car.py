"""Procedural cars, in metres: closed and open bodies on wheels, and racing cars with free wheels."""

from functools import partial
from types import SimpleNamespace

import numpy as np

from .draw import Draw, Perhaps, points, recipe, rectangle, rounded_path
from .parts import (
    Part,
    bar,
    between,
    board,
    box,
    crossbar,
    ellipsoid,
    join,
    loft,
    revolve,
    sheet,
    slab,
    tube,
    wing,
)

TYRE = 0.22  # width of the wheels

# The weight of each kind, the smallest and largest measures. length, width, height, wheel
# (radius) and clearance (of the floor over the ground) are in metres. bonnet and screen
# (lengths), roof (where it ends) and window (where the rear window ends, and the boot or bed
# starts) are shares of the length. belt: height of the shoulder line under the windows, share of
# the height. lean: inward lean of the side windows per height. A roadster has no roof, so
# that measure does not count; its open cabin ends at window.
_FIELDS = "length width height wheel clearance bonnet screen roof window belt lean".split()
_KINDS = {
    "sedan":     (2.5, ( 4.2,  1.70,  1.38,  0.30,  0.14,  0.25,  0.14, 0.66,  0.80, 0.56, 0.20),
                       ( 5.2,  1.92,  1.52,  0.35,  0.20,  0.31,  0.19, 0.74,  0.90, 0.64, 0.40)),
    "hatchback": (  2, ( 3.3,  1.58,  1.40,  0.28,  0.15,  0.16,  0.14, 0.84,  0.96, 0.56, 0.20),
                       ( 4.3,  1.80,  1.60,  0.34,  0.20,  0.28,  0.20, 0.92,  1.00, 0.64, 0.40)),
    "wagon":     (1.2, ( 4.3,  1.70,  1.42,  0.30,  0.15,  0.24,  0.13, 0.91,  0.97, 0.56, 0.20),
                       ( 5.0,  1.90,  1.58,  0.35,  0.22,  0.30,  0.18, 0.95,  1.00, 0.64, 0.40)),
    "coupe":     (1.8, ( 4.0,  1.78,  1.10,  0.31,  0.10,  0.26,  0.13, 0.56,  0.76, 0.58, 0.30),
                       ( 4.7,  2.00,  1.34,  0.36,  0.15,  0.37,  0.17, 0.66,  0.96, 0.64, 0.50)),
    "suv":       (1.8, ( 4.1,  1.78,  1.62,  0.36,  0.22,  0.23,  0.12, 0.88,  0.96, 0.56, 0.12),
                       ( 5.1,  2.02,  1.95,  0.43,  0.30,  0.30,  0.17, 0.94,  1.00, 0.64, 0.28)),
    "van":       (1.6, ( 4.4,  1.80,  1.90,  0.32,  0.18,  0.06,  0.06, 0.95,  0.98, 0.44, 0.04),
                       ( 6.0,  2.05,  2.60,  0.37,  0.25,  0.20,  0.14, 0.97,  1.00, 0.52, 0.13)),
    "pickup":    (1.6, ( 4.8,  1.75,  1.60,  0.36,  0.24,  0.23,  0.09, 0.46,  0.57, 0.54, 0.20),
                       ( 5.9,  2.05,  1.95,  0.44,  0.34,  0.29,  0.13, 0.55,  0.64, 0.62, 0.40)),
    "roadster":  (1.2, ( 3.5,  1.60,  1.12,  0.28,  0.12,  0.27,  0.05, 0.60,  0.66, 0.58, 0.20),
                       ( 4.7,  1.90,  1.36,  0.34,  0.20,  0.36,  0.09, 0.60,  0.78, 0.66, 0.40)),
}  # fmt: skip


def car(draw: Draw, kind: str) -> Part:
    """A car of one of the kinds of `_KINDS`."""
    _, least, greatest = _KINDS[kind]
    limits = dict(zip(_FIELDS, zip(least, greatest, strict=True), strict=True))
    body = SimpleNamespace(**draw.measures(**limits), kind=kind)
    # height of the shoulder line, above the wheels
    body.shoulder = max(body.belt * body.height, 2 * body.wheel + 0.15)
    # Distances of the axles from the front bumper.
    body.axles = body.wheel + 0.48, body.length - body.wheel - 0.44
    part = _hull(body)

    pair = _wheels(body.wheel, TYRE, (body.width - TYRE) / 2 - 0.02, draw(0.1, 0.6))
    part += join(pair.moved(z=body.length / 2 - s) for s in body.axles)

    half = body.width / 2
    y = body.shoulder + 0.07
    z = (0.5 - body.bonnet) * body.length - 0.2
    mirror = box((draw(0.14, 0.22), draw(0.09, 0.16), 0.08), (half + 0.07, y, z), 0.03)
    part += (
        mirror + bar((0.85 * half, y - 0.09, z), (half + 0.04, y - 0.01, z), 0.05)
    ).both_sides()
    if kind in ("hatchback", "wagon", "suv", "van") and draw.maybe(0.4) and draw.loads:
        part += _roof_box(draw, body)
    if kind == "coupe" and draw.maybe(0.5):
        part += _spoiler(draw, body)
    if kind == "roadster":
        part += _seats(draw, body)
    return part


def _wheels(radius: float, width: float, x: float, dish: float) -> Part:
    """Wheels with dished hubs at (+-x, radius, 0), on an axle."""
    rim = np.array([(0.5, dish - 1), (0.62, -0.95), (0.92, -1), (1, -0.7)])
    profile = np.concatenate([rim, rim[::-1] * [1, -1]]) * [radius, width / 2]
    wheel = revolve(profile).rotated("z", 90).moved(x, radius)
    return wheel.both_sides() + crossbar((-x, radius, 0), 0.1)


@recipe(thick=(0.1, 0.18), lean_deg=(8, 25), head=(0.1, 0.3))
def _seats(draw: Draw, body: SimpleNamespace, *, thick, lean_deg, head) -> Part:
    """The windscreen of an open car, and two seats behind it."""
    cowl = (0.5 - body.bonnet) * body.length
    low, tall = body.shoulder, body.height - body.shoulder
    up, across = np.array([[0.0], [1.0]]), np.linspace(-0.43, 0.43, 5) * body.width
    screen = sheet(
        points(
            across * (1 - 0.12 * up),
            low + 0.04 + (tall - 0.04) * up,
            cowl - 0.06 - body.screen * body.length * up - 0.3 * across**2,
        ),
        0.035,
    )
    half, bottom = 0.15 * body.width, low - 0.4
    back = max((0.5 - body.window) * body.length + 0.3, cowl - 1.1)
    seat = box((2 * half, thick + 0.1, 0.5), (0, bottom + 0.1, back + 0.25))
    rest = board(half, (bottom + 0.05, low + 0.25 * tall), (back - thick, back))
    rest += board(0.6 * half, (low, low + head * tall + 0.25 * tall), (back - 0.8 * thick, back))
    seat += rest.rotated("x", -lean_deg, (0, bottom, back))
    return screen + seat.moved(x=0.21 * body.width).both_sides()


@recipe(
    length=(3.6, 5.2),
    width=(1.6, 2.0),
    wheel=(0.28, 0.36),
    tyre=(0.2, 0.42),
    girth=(0.5, 0.8),
    nose=(0.2, 0.5),
    pods=Perhaps(0.7, (0.3, 0.5)),
    front_wing=0.75,
    rear_wing=0.75,
    airbox=0.7,
)
def racing_car(
    draw: Draw, *, length, width, wheel, tyre, girth, nose, pods, front_wing, rear_wing, airbox
) -> Part:
    """A single seat in a narrow body between four free wheels, perhaps with wings."""
    front, rear = length / 2 - draw(0.6, 1.0), 0.45 - length / 2
    x = (width - tyre) / 2
    y = wheel + 0.02
    # Sections of the body from front to rear: z, width, and upper and lower edge over the axles.
    z = np.array([0.5, 0.42, 0.3, 0.12, 0.06, -0.06, -0.1, -0.25, -0.44]) * length
    wide = girth * np.array([0.2, 0.3, 0.5, 0.9, 1, 1, 1, 0.9, 0.35])
    top = girth * np.array([nose - 0.1, nose, 0.3, 0.45, 0.15, 0.15, 0.6, 0.5, 0.2])
    low = 0.14 - y + np.array([nose, 0.7 * nose, 0.3 * nose, 0, 0, 0, 0, 0.02, 0.1]) * 0.5
    top = np.maximum(top, low + 0.12)
    section = rectangle(1.0, 1.0, 0.25, 3)[None]
    height = ((top + low) / 2)[:, None] + section[..., 1] * (top - low)[:, None]
    part = loft(points(section[..., 0] * wide[:, None], y + height, z[:, None]))
    part += ellipsoid((0.27, 0.3, 0.27), (0, y + 0.15 * girth + 0.22, -0.01 * length))
    part += bar((0, y, -0.02 * length), (0, y + 0.15 * girth + 0.15, -0.02 * length), 0.2)
    if airbox:
        path = [(0, y + 0.5 * girth, -0.12 * length), (0, y + 0.85 * girth, -0.13 * length)]
        path += [(0, y + 0.35 * girth, -0.36 * length)]
        part += tube(path, [0.15, 0.12, 0.06])
    if pods:
        part += between(
            (0.3 * girth, 0.13, -0.3 * length),
            (0.42 * girth + 0.3 * pods, 0.13 + pods, 0.08 * length),
            0.12,
        ).both_sides()
    pair = _wheels(wheel, tyre, x, draw(0.1, 0.6))
    for axle in (front, rear):
        part += pair.moved(z=axle)
        for ahead in (-0.35, 0.35):
            arm = bar((0.1, y, axle + ahead), (x, y, axle), 0.05)
            part += arm.both_sides()
    if front_wing:
        half, z = 0.47 * width, 0.5 * length - draw(0.0, 0.1)
        part += _plank(half, 0.16, z, 0.35)
        part += between((half - 0.03, 0.06, z - 0.4), (half, 0.34, z + 0.02)).both_sides()
        part += bar((0, 0.16, z - 0.2), (0, y + top[1] - 0.05, z - 0.3), 0.12)
    if rear_wing:
        half, high = 0.4 * width, y + draw(0.35, 0.75)
        part += _plank(half, high, rear - 0.1, 0.4)
        part += between((half - 0.03, y, rear - 0.55), (half, high + 0.1, rear - 0.05)).both_sides()
        part += bar((0, y, rear), (0, high, rear - 0.3), 0.1)
    return part


def _plank(half: float, y: float, z: float, chord: float) -> Part:
    """A straight wing from x = -half to half, its front at z."""
    return wing([(x, y, z, chord, 0.12) for x in (-half, half)])


@recipe(width=(1.0, 1.8), tall=(0.18, 0.35))
def _roof_box(draw: Draw, body: SimpleNamespace, *, width, tall) -> Part:
    """A box on two bars across the roof."""
    start = body.bonnet + body.screen
    half = 0.35 * body.width - 0.5 * body.lean * (body.height - body.shoulder)
    z = (0.5 - (start + body.roof) / 2) * body.length
    long = 0.8 * (body.roof - start) * body.length
    bars = (
        box((2 * half, 0.12, 0.06), (0, body.height + 0.01, z + s * 0.3 * long)) for s in (-1, 1)
    )
    top = slab(rectangle(width * half, long, 0.2, 3), tall, 0.1).moved(y=body.height + 0.05, z=z)
    return join(bars) + top


@recipe(inset=(0.15, 0.4), high=(0.1, 0.3))
def _spoiler(draw: Draw, body: SimpleNamespace, *, inset, high) -> Part:
    """A small wing on two stays over the boot."""
    half = 0.42 * body.width
    z = inset - body.length / 2
    y = body.shoulder + high
    stay = box((0.05, high + 0.3, 0.14), (0.7 * half, y - high / 2 - 0.13, z - 0.13))
    return _plank(half, y, z, 0.3) + stay.both_sides()


def _hull(body: SimpleNamespace) -> Part:
    """The body: cross-sections from front to rear, the wheel arches cut into lower corners."""
    length = body.length
    boot = min(body.window * length, length - 0.12)
    cowl = body.bonnet * length
    # start and end of the open box behind the cabin, or of the open cabin
    beds = {"pickup": (boot + 0.06, length - 0.08), "roadster": (cowl + 0.1, boot)}
    bed = beds.get(body.kind, (length, length))
    line = _side_view(body, cowl, boot)
    arch = body.wheel + 0.055  # radius of the wheel arches
    s = _stations(body, line[:, 0], bed, arch)
    top = np.interp(s, *line.T)
    sides, cabin, well = _cross_sections(body, s, top, arch)
    upper = np.where((bed[0] < s) & (s < bed[1]), well, cabin)
    right = np.concatenate([sides, upper])  # [12, 2, S]
    left = right[-2:0:-1] * [[-1], [1]]  # without the points in the plane of symmetry
    x, y = np.concatenate([right, left]).transpose(1, 2, 0)
    return loft(points(x, y, (length / 2 - s)[:, None]))


def _side_view(body: SimpleNamespace, cowl: float, boot: float) -> np.ndarray:
    """The upper edge of the body seen from the side [P, 2]: distance from the front bumper, and height.

    cowl: where the bonnet ends. boot: where the boot or bed starts.
    """
    length, belt = body.length, body.shoulder
    roof_rear = body.roof * length
    roof_front = cowl + body.screen * length
    corners = [(0, 0.75 * belt), (0.06, 0.9 * belt), (0.22, belt), (cowl, belt + 0.08)]
    if body.kind != "roadster":
        corners += [
            (roof_front, body.height),
            ((roof_front + roof_rear) / 2, body.height + 0.015),
            (roof_rear, body.height - 0.02),
        ]
    corners += [(boot, belt + 0.07), (length - 0.08, belt + 0.04), (length, 0.85 * belt)]
    line = rounded_path(corners, 0.12, 2)
    line[:, 0] = np.maximum.accumulate(line[:, 0] + 1e-4 * np.arange(len(line)))
    return line


def _stations(
    body: SimpleNamespace, corners: np.ndarray, bed: tuple[float, float], arch: float
) -> np.ndarray:
    """Distances of the cross-sections from the front bumper [S]: at every corner, arch and end of the bed."""
    around_axle = arch * np.append([-1.02, 1.02], 0.999 * np.cos(np.linspace(0, np.pi, 8)))
    ends = [end + side for end in bed for side in (-0.015, 0.015)]
    s = np.concatenate(
        [corners, np.linspace(0, body.length, 7), *(a + around_axle for a in body.axles), ends]
    )
    s = np.unique(s[(s >= 0) & (s <= body.length)].round(3))
    return s[np.append(True, np.diff(s) > 0.004)]


def _cross_sections(
    body: SimpleNamespace, s: np.ndarray, top: np.ndarray, arch: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The right halves of the cross-sections at `s` [S], each as points (x, y), [6, 2, S].

    The first has the floor and the side, from the middle outwards and up to the shoulder line.
    The others go on to the middle: over the cabin, and down into the bed. top: the height of the
    upper edge.
    """

    def near_front(reach: float) -> np.ndarray:
        return np.clip(1 - s / body.length / reach, 0, 1)

    def near_rear(reach: float) -> np.ndarray:
        return np.clip(1 - (1 - s / body.length) / reach, 0, 1)

    zero = np.zeros_like(s)
    width = body.width / 2 * (1 - 0.15 * near_front(0.18) ** 2) * (1 - 0.06 * near_rear(0.15) ** 2)
    floor = body.clearance + 0.12 * near_front(0.08) + 0.15 * near_rear(0.1)
    inner = zero + (body.width / 2 - TYRE - 0.06)  # the floor between the wheels
    cut = floor + 0.002  # lower edge of the sides
    for axle in body.axles:
        over_wheel = body.wheel + np.sqrt(np.maximum(arch**2 - (s - axle) ** 2, 0.0))
        cut = np.where(np.abs(s - axle) < arch, np.maximum(cut, over_wheel), cut)
    shoulder = np.minimum(body.shoulder, top - 0.03)
    middle = np.maximum(0.55 * floor + 0.45 * shoulder, 0.5 * (cut + shoulder))
    sides = [(zero, floor), (inner, floor), (inner, cut), (0.95 * width, cut)]
    sides += [(width, middle), (0.97 * width, shoulder)]

    # rim of the roof
    edge = np.maximum(top - 0.045 - 0.1 * np.clip(top - shoulder - 0.1, 0, 0.3), shoulder + 0.01)
    roof = np.maximum(0.96 * width - 0.03 - body.lean * (edge - shoulder), 0.45 * width)
    cabin = [
        (0.97 * width - 0.03, shoulder + 0.006),
        (roof, edge),
        (0.88 * roof, 0.5 * (edge + top)),
    ]
    cabin += [(0.6 * roof, top - 0.008), (0.3 * roof, top - 0.002), (zero, top)]

    rim, bottom = shoulder + 0.02, zero + (body.shoulder - 0.38)
    # the wheel arch seen from the bed
    hump = np.maximum(bottom + 0.004, np.minimum(cut + 0.03, rim - 0.03))
    well = [
        (0.95 * width - 0.02, rim),
        (0.92 * width - 0.05, rim - 0.01),
        (0.9 * width - 0.06, hump),
    ]
    well += [(inner - 0.03, hump - 0.001), (inner - 0.032, bottom), (zero, bottom)]
    return np.array(sides), np.array(cabin), np.array(well)


KINDS = {partial(car, kind=kind): weight for kind, (weight, *_) in _KINDS.items()}
KINDS[racing_car] = 0.9
