"""Procedural chairs, in metres: a seat on a support with a back and arms, moulded shells, armchairs, barrel chairs."""

from functools import partial

import numpy as np

from .draw import Draw, Point, ellipse, points, rectangle, rounded_path
from .parts import Part, bar, between, crossbar, join, post, sheet, slab, tube
from .sofa import upholstered
from .supports import cantilever, cross, disc, legs, loops, panels, rocker, star

# Weights of the supports of dining, lounge and bar chairs.
_DINING = {legs: 6, loops: 1, cantilever: 1, cross: 0.8, panels: 0.6, disc: 0.7, star: 0.4, rocker: 0.5}
_LOUNGE = {legs: 2.5, loops: 2, cantilever: 1, rocker: 1, star: 0.6, panels: 0.7, cross: 0.7}
_BAR = {legs: 3, disc: 1.5, loops: 1, panels: 0.3}
# Weights of the backs of chairs without padding.
_BACKS = {"ladder": 2, "slats": 2, "spindles": 1, "splat": 1.2, "cross": 0.8, "open": 1.0, "lattice": 0.7, "band": 1.0}
_BACKS |= {"panel": 1.2, "hoop": 1.2, "solid": 2.0}


def jointed_chair(draw: Draw, family: str) -> Part:
    """A dining, office, lounge or bar chair, put together from a seat, a support, a back and arms."""
    width, depth, height = draw(0.40, 0.54), draw(0.40, 0.50), draw(0.42, 0.5)
    recline, back_height, cushioned = draw(2, 14), draw(0.32, 0.62), draw.maybe(0.3)
    if family == "lounge":
        width, depth, height = draw(0.52, 0.7), draw(0.52, 0.66), draw(0.28, 0.40)
        recline, back_height, cushioned = draw(15, 30), draw(0.4, 0.75), draw.maybe(0.6)
    elif family == "office":
        width, depth, back_height, cushioned = draw(0.46, 0.56), draw(0.44, 0.52), draw(0.4, 0.75), True
    elif family == "bar":
        width, depth, height, back_height = draw(0.36, 0.44), draw(0.34, 0.42), draw(0.62, 0.78), draw(0.14, 0.4)
    elif draw.maybe(0.15):
        back_height = draw(0.65, 0.85)  # a throne
    exponent = draw.pick({8.0: 4, 5.0: 2, 3.0: 1.5, 2.0: 1})  # outline of the seat: 2 = ellipse ... 8 = rectangle
    thickness = draw(0.07, 0.13) if cushioned else draw(0.025, 0.05)

    taper = draw(0.8, 1.0) if draw.maybe(0.4) else 1.0  # narrower at the rear
    outline = ellipse(width, depth, 24, exponent)
    outline[:, 0] *= 1 + (taper - 1) * (0.5 - outline[:, 1] / depth)
    under = height - thickness
    part = slab(outline, thickness, bevel=(0.35 if cushioned else 0.2) * thickness).moved(y=under)

    support = star if family == "office" else draw.pick({"bar": _BAR, "lounge": _LOUNGE, "dining": _DINING}[family])
    spread = 0.5 * 0.35 ** (1 / exponent)  # well inside the outline
    half_x, half_z = spread * width * (0.5 + 0.5 * taper) - 0.03, spread * depth - 0.03
    part += support(draw, half_x, half_z, under)
    if family == "bar" and not draw.maybe(0.8):  # a stool
        return part

    angular = exponent > 4
    stile_x = 0.5 * width * taper - 0.03 if angular else 0.36 * width
    rear_edge = depth / 2 * (1 - (2 * stile_x / width) ** exponent) ** (1 / exponent)  # -z of the seat at x = stile_x
    curve = max(0.0 if angular else depth / 2 - rear_edge, draw(0.0, 0.08) if draw.maybe(0.6) else 0.0)
    back, bulge = _back(draw, family, stile_x, back_height, curve)
    part += back.rotated("x", -recline).moved(y=height - 0.5 * thickness, z=-depth / 2 + 0.03)
    if draw.maybe({"office": 0.6, "lounge": 0.6, "bar": 0.1, "dining": 0.3}[family]) and back_height > 0.3:
        rise = draw(0.17, 0.26)
        rear = -depth / 2 + 0.03 + (curve + bulge) - np.tan(np.radians(recline)) * rise
        edge = 0.5 * width - 0.02 if angular else max(stile_x, half_x)
        part += _arm(draw, (stile_x, height + rise, rear), rise, edge, height - 0.6 * thickness, depth).both_sides()
    return part


def _arm(draw: Draw, back: Point, rise: float, edge: float, base: float, depth: float) -> Part:
    """The arm at x > 0, from a point of the back to the front, `rise` above a seat with its edge at x = edge."""
    x, y, rear = back
    front = depth * draw(0.15, 0.45)
    foot_z = min(front, depth * 0.3)
    kind, size = draw.pick({"post": 3, "panel": 0.8, "loop": 1.5, "swoop": 1.5, "cantilever": 0.7}), draw(0.025, 0.05)
    rest, start = rectangle(size * draw(1.0, 2.0), 0.7 * size, segments=1), (x, y, rear - 0.01)
    if kind == "panel":
        return between((edge - 0.02, base - 0.02, rear), (edge + 0.03, y, front + 0.02), 0.012)
    if kind == "loop":
        path = [start, (edge + 0.02, y, front), (edge + 0.02, base, foot_z), (edge - 0.06, base, foot_z)]
        return tube(rounded_path(path, 0.09), 0.011 + 0.2 * size)
    if kind == "swoop":
        path = [start, (edge, y + 0.02, 0.2 * front), (edge, y - 0.4 * rise, front), (edge - 0.01, base, foot_z)]
        return tube(rounded_path(path, 0.12, 5), 1.0, rest, side=(1, 0, 0))
    arm = tube(rounded_path([start, (edge, y, 0.0), (edge, y, front)], 0.1), 1.0, rest, side=(1, 0, 0))
    if kind == "cantilever":
        return arm + bar((edge - 0.01, base, rear / 2), (edge, y, rear / 2), 0.03, 0.05)
    outline = ellipse(0.8 * size, 0.8 * size, 8) if draw.maybe(0.5) else rectangle(0.8 * size, 0.8 * size)
    profile = [(0, 1), (0.5, draw(0.8, 1.5)), (1, 0.9)]
    return arm + post((edge - 0.012, base, foot_z), (edge, y, foot_z), outline, profile)


def _back(draw: Draw, family: str, half: float, height: float, curve: float) -> tuple[Part, float]:
    """A back in the plane z = 0, from y = 0 to `height`, between stiles at x = +-half; and the z of its front."""
    top = height + 0.02
    if not draw.maybe({"office": 0.8, "lounge": 0.5}.get(family, 0.12)):
        kind = draw.pick(_BACKS)
        if kind == "solid":
            return _plate(draw, half, top, curve, draw(0.02, 0.045)), 0.0
        return _hoop(draw, half, top, curve) if kind == "hoop" else _frame(draw, half, height, curve, kind), 0.0
    thickness = draw(0.05, 0.11)
    if family == "office" and not draw.maybe(0.3):  # mostly held above the seat by a spine
        gap = draw(0.12, 0.35) * top
        back = _plate(draw, draw(0.8, 1.1) * half, top - gap, max(curve, 0.03), thickness).moved(y=gap)
        path = [(0, -0.06, 0.12), (0, -0.06, -0.07), (0, gap + 0.3 * (top - gap), -0.4 * thickness)]
        back += tube(rounded_path(path, 0.06), 1.0, rectangle(0.06, 0.02, segments=1), side=(1, 0, 0))
    elif draw.maybe(0.5):
        back = _plate(draw, 1.05 * half, top, curve, thickness)
    else:
        back = between((-half - 0.03, -0.02, -thickness / 2), (half + 0.03, top, thickness / 2), 0.03)
    return back, thickness / 2


def _frame(draw: Draw, half: float, height: float, curve: float, kind: str) -> Part:
    """Two stiles and a rail on top, filled with boards, slats, spindles, a splat, a cross, a lattice, or open."""
    top, high = height + 0.02, height > 0.3
    stile, board = draw(0.022, 0.045), draw(0.015, 0.028)
    outline = ellipse(stile, stile, 8) if draw.maybe(0.4) else rectangle(stile, stile, segments=1)
    part = post((half, -0.02, curve), (half, top, curve), outline, [(0, 1), (1, draw(0.7, 1))]).both_sides()
    rail = draw(0.04, 0.12) if high else draw(0.03, 0.06)
    arch = draw(0.01, 0.07) if draw.maybe(0.4) else 0.0
    part += _rail(half, top - 0.45 * rail, rail, board, curve, arch)
    if kind == "open":
        return part
    low = draw(0.06, 0.3) * height
    if kind == "ladder":
        count = draw.count(1, 4) if high else 1
        pitch = (top - rail - low) / (count + 0.5)
        each = min(draw(0.25, 0.6) * pitch, 0.08)
        return part + join(_rail(half, low + (k + 0.5) * pitch, each, board, curve, 0.6 * arch) for k in range(count))
    if kind in ("panel", "band"):
        x, y = np.linspace(-half, half, 9), np.array([[low if kind == "panel" else 0.55 * height], [top - 0.5 * rail]])
        return part + sheet(points(x, y, _bow(x, half, curve)), board)
    bottom, upper = -0.01, top - 0.6 * rail
    if draw.maybe(0.5) or kind == "lattice":
        bottom = low
        part += _rail(half, low, draw(0.025, 0.05), board, curve)
    if kind == "splat":  # a vase-shaped board in the middle
        tall, wide, t = upper + arch * 0.8 - bottom, half * draw(0.25, 0.5), np.linspace(0, 1, 9)[:, None]
        width = wide * (1 + draw(0.1, 0.5) * np.sin(2 * np.pi * (draw(0.6, 1.4) * t + draw(0, 1))))
        x = np.linspace(-1, 1, 5) * np.minimum(width, 1.8 * wide)
        return part + sheet(points(x, bottom + t * tall, 0.0), board)
    if kind == "cross":
        x = np.linspace(-half, half, 7)
        path = points(x, np.linspace(bottom + 0.01, upper, 7), _bow(x, half, curve))
        for mirror in (-1, 1):
            part += tube(path * [mirror, 1, 1], 1.0, rectangle(board, draw(0.02, 0.04), segments=1))
        return part
    count = {"slats": draw.count(2, 7), "spindles": draw.count(4, 8), "lattice": draw.count(2, 4)}[kind]
    wide = draw(0.25, 0.6) * 2 * half / (count + 1)
    size = (0.018, None) if kind == "spindles" else (0.8 * board, min(wide, 0.07))
    for x in np.linspace(-half, half, count + 2)[1:-1]:
        z = _bow(x, half, curve)
        part += bar((x, bottom, z), (x, upper + arch * (1 - (x / half) ** 2), z), *size)
    if kind == "lattice":
        for y in np.linspace(bottom, upper, draw.count(1, 3) + 2)[1:-1]:
            part += _rail(half, y, draw(0.015, 0.03), 0.7 * board, curve)
    return part


def _bow(x: np.ndarray, half: float, curve: float) -> np.ndarray:
    """z of a back that is bent forward: `curve` at the stiles (|x| = half), 0 in the middle."""
    return curve * (np.abs(x) / half) ** 2


def _rail(half: float, y: float, height: float, thickness: float, curve: float, arch: float = 0.0) -> Part:
    """A horizontal board between the stiles, following the bow of the back, its middle lifted by `arch`."""
    x = np.linspace(-half, half, 9)
    path = points(x, y + arch * (1 - (x / half) ** 2), _bow(x, half, curve))
    return tube(path, 1.0, rectangle(thickness, height, segments=1))


def _plate(draw: Draw, half: float, top: float, curve: float, thickness: float) -> Part:
    """A one-piece back: straight or flared, its upper corners rounded, bowed and with a lumbar bulge."""
    flare, power, wave = draw(-0.25, 0.2), draw.pick((2.0, 3.0, 6.0, 12.0)), draw(-0.02, 0.03)
    t = np.concatenate([np.linspace(0, 0.7, 4), 1 - 0.3 * np.linspace(0.75, 0, 5) ** 1.8])[:, None]
    v = np.linspace(-1, 1, 11)[None]
    rounding = (1 - np.clip((t - 0.4) / 0.605, 0, 1) ** power) ** (1 / power)
    x = v * half * (1 + flare * t) * np.maximum(rounding, 0.12)
    z = _bow(x, half, curve) + wave * np.sin(np.pi * t)
    return sheet(points(x, -0.01 + t * (top + 0.01), z), thickness)


def _hoop(draw: Draw, half: float, top: float, curve: float) -> Part:
    """A bent hoop, empty or filled with spindles (Windsor)."""
    angle, straight = np.linspace(0, np.pi, 17), draw(0.2, 0.6) * top
    x = np.r_[half, half * np.cos(angle), -half]
    y = np.r_[-0.02, straight + (top - straight) * np.sin(angle) ** 0.9, -0.02]
    part = tube(points(x, y, _bow(x, half, curve)), draw(0.018, 0.035) / 2)
    count = draw.count(3, 8) if draw.maybe(0.85) else 0
    for x in np.linspace(-half, half, count + 2)[1:-1]:
        end = straight + (top - straight) * (1 - (x / half) ** 2) ** 0.45
        part += bar((0.75 * x, -0.01, _bow(0.75 * x, half, curve)), (x, end, _bow(x, half, curve)), 0.016)
    return part


def shell_chair(draw: Draw) -> Part:
    """A moulded bucket: one curved sheet for seat and back, on any support."""
    width, depth, height = draw(0.42, 0.62), draw(0.40, 0.52), draw(0.36, 0.47)
    back, lean, curl, wings = draw(0.25, 0.5), draw(0.05, 0.2), draw(0.0, 0.07), draw(0.0, 0.22)
    front, rear = depth / 2, -depth / 2
    path = [(0, -0.03, front), (0, 0, front - 0.08), (0, -0.02, rear + 0.05), (0, back, rear - lean)]
    path = rounded_path(path, draw(0.1, 0.2), 5)
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    t, v = np.linspace(0, 1, 18)[:, None], np.linspace(-1, 1, 15)  # from the front edge to the top of the back; across
    y, z = (np.interp(t * length[-1], length, path[:, k]) for k in (1, 2))
    ease = np.clip((t - 0.3) / 0.4, 0, 1)
    ease = ease**2 * (3 - 2 * ease)
    span = 0.5 * width * (1 - draw(-0.1, 0.35) * ease) * (1 - np.clip((t - 0.75) / 0.25, 0, 1) ** 3 * draw(0.1, 0.6))
    span = span * (1 - 0.25 * np.clip(1 - t / 0.15, 0, 1) ** 2)
    # The rims of the seat are lifted and those of the back pulled forward; at the hip `wings` turns them into arms.
    hip = np.exp(-(((t - 0.5) / 0.25) ** 2))
    lift = (curl * np.abs(v) ** 2.5 + wings * hip * np.abs(v) ** 3) * (1 - 0.7 * ease)
    pull = (curl + wings * hip) * np.abs(v) ** 2.5 * ease
    part = sheet(points(span * v, y + lift, z + pull), draw(0.018, 0.035)).moved(y=height)
    part += slab(ellipse(0.8 * width, 0.8 * depth, 20, 5), 0.03).moved(y=height - 0.045)
    support = draw.pick({legs: 2, star: 1, disc: 1, loops: 1, rocker: 0.5})
    if support is legs:
        return part + legs(draw, 0.34 * width, 0.34 * depth, height - 0.035, plain=True)
    return part + support(draw, 0.37 * width, 0.38 * depth, height - 0.035)


def barrel_chair(draw: Draw) -> Part:
    """A round seat with a back that wraps around it and falls towards the arms."""
    radius, height, rise, fall = draw(0.26, 0.38), draw(0.36, 0.47), draw(0.22, 0.5), draw(0.0, 0.8)
    reach = np.radians(draw(80, 150))
    angle, thickness = np.linspace(-reach, reach, 25), draw.pick((0.025, 0.04, 0.09)) * draw(0.9, 1.2)
    top = rise * (1 - fall * (1 - np.cos(angle)) / (1 - np.cos(reach)))
    gap = np.minimum(draw(0.1, 0.22), 0.5 * top) if draw.maybe(0.4) else None  # between seat and back, at each angle
    bottom = -0.06 if gap is None else gap
    y = bottom + np.linspace(0, 1, 4)[:, None] * (top - bottom)
    r = radius - 0.3 * thickness + draw(0.0, 0.12) * np.maximum(y, 0.0)
    part = sheet(points(r * np.sin(angle), y, -r * np.cos(angle)), thickness).moved(y=height)
    cushion = draw(0.06, 0.14)
    under = height - cushion
    part += slab(ellipse(2 * radius, 2 * radius, 28, draw.pick((2.0, 2.0, 3.0))), cushion).moved(y=under)
    if gap is not None:
        for a in np.linspace(-0.92 * reach, 0.92 * reach, draw.count(4, 11)):
            x, z, top_y = radius * np.sin(a), -radius * np.cos(a), height + np.interp(a, angle, gap) + 0.02
            part += bar((0.93 * x, height - 0.5 * cushion, 0.93 * z), (0.99 * x, top_y, 0.99 * z), 0.022)
    if draw.maybe(0.2):  # a solid drum down to the floor
        return part + slab(ellipse(1.9 * radius, 1.9 * radius, 28), under + 0.02, 0.02)
    support = draw.pick({legs: 3, disc: 1, star: 0.7, loops: 0.7})
    return part + support(draw, 0.66 * radius, 0.66 * radius, under)


def stool(draw: Draw) -> Part:
    """A seat without a back, round or square, low or high."""
    width, height, thickness = draw(0.3, 0.45), draw(0.35, 0.78), draw(0.02, 0.12)
    depth = width * draw(0.7, 1.0) if draw.maybe(0.4) else width
    seat = slab(ellipse(width, depth, 24, draw.pick((2.0, 2.0, 4.0, 8.0))), thickness).moved(y=height - thickness)
    return seat + draw.pick(_BAR)(draw, 0.38 * width, 0.38 * depth, height - thickness + 0.005)


def bench(draw: Draw) -> Part:
    """A long seat of boards, half of them with a back of boards."""
    width, depth, height = draw(1.0, 1.7), draw(0.35, 0.5), draw(0.4, 0.47)
    count, thick, gap = draw.count(1, 6), draw(0.02, 0.06), draw(0.005, 0.03)
    step = depth / count
    part = draw.pick({legs: 3, panels: 2, loops: 1})(draw, 0.44 * width, 0.38 * depth, height - 0.02)
    part += between((-0.46 * width, height - 0.04, -depth / 2), (0.46 * width, height, depth / 2))
    for z in np.arange(count) * step - depth / 2:
        part += between((-width / 2, height - 0.01, z + gap), (width / 2, height + thick, z + step - gap))
    if draw.maybe(0.5):
        lean, top, rear = draw(0.05, 0.2), draw(0.3, 0.45), 0.02 - depth / 2
        for x in (-0.4 * width, 0.4 * width):
            part += bar((x, height - 0.02, rear), (x, height + top, rear - lean), 0.05)
        for t in np.linspace(0.35, 0.95, draw.count(1, 3)):
            y, z = height + t * top, rear - t * lean
            part += crossbar((-width / 2, y, z), 0.03, draw(0.06, 0.12))
    return part


KINDS = {partial(jointed_chair, family="dining"): 5, partial(jointed_chair, family="office"): 1.5, shell_chair: 2}
KINDS |= {partial(upholstered, seats=1): 1.5, partial(jointed_chair, family="lounge"): 1.5}
KINDS |= {partial(jointed_chair, family="bar"): 1, barrel_chair: 1, stool: 1.2, bench: 0.7}
