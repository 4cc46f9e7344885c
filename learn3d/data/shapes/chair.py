"""Procedural chairs, in metres: a seat, what carries it, a back and arms, each in many kinds; plus whole-body families."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from learn3d.data.shapes import supports
from learn3d.data.shapes.parts import (
    Solid,
    assemble,
    bar,
    between,
    both_sides,
    box,
    ellipse,
    ellipsoid,
    post,
    rectangle,
    rounded_path,
    sheet,
    slab,
    tube,
)
from learn3d.data.shapes.sampling import maybe, pick


@dataclass(frozen=True)
class Seat:
    """The measures of a seat that legs, back and arms are fitted to (metres)."""

    width: float
    depth: float
    height: float  # of the top of the seat over the floor
    thickness: float
    exponent: float  # outline: 2 = ellipse ... 8 = rectangle

    def rear(self, x: float) -> float:
        """z of the rear edge at the distance x from the middle."""
        return -self.depth / 2 * (1 - min(abs(2 * x / self.width), 0.99) ** self.exponent) ** (1 / self.exponent)


def make_chair(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random chair."""
    family = pick(rng, {"dining": 5, "office": 1.5, "shell": 2, "club": 1.5, "lounge": 1.5, "bar": 1, "barrel": 1})
    maker = {"shell": _shell_chair, "club": _club_chair, "barrel": _barrel_chair}.get(family)
    return assemble(maker(rng) if maker else _jointed_chair(rng, family))


# --- seat + support + back + arms ------------------------------------------------------------------------------------


def _jointed_chair(rng: np.random.Generator, family: str) -> list[Solid]:
    """A chair put together from a seat, a support, a back and arms."""
    width, depth = rng.uniform(0.40, 0.54), rng.uniform(0.40, 0.50)
    height, recline, back_height = rng.uniform(0.42, 0.5), rng.uniform(2, 14), rng.uniform(0.32, 0.62)
    cushioned = maybe(rng, 0.3)
    if family == "lounge":
        width, depth = rng.uniform(0.52, 0.7), rng.uniform(0.52, 0.66)
        height, recline, back_height = rng.uniform(0.28, 0.40), rng.uniform(15, 30), rng.uniform(0.4, 0.75)
        cushioned = maybe(rng, 0.6)
    elif family == "office":
        width, depth, cushioned = rng.uniform(0.46, 0.56), rng.uniform(0.44, 0.52), True
        back_height = rng.uniform(0.4, 0.75)
    elif family == "bar":
        width, depth = rng.uniform(0.36, 0.44), rng.uniform(0.34, 0.42)
        height, back_height = rng.uniform(0.62, 0.78), rng.uniform(0.14, 0.4)
    elif maybe(rng, 0.15):
        back_height = rng.uniform(0.65, 0.85)  # a throne
    exponent = pick(rng, {8.0: 4, 5.0: 2, 3.0: 1.5, 2.0: 1})
    thickness = rng.uniform(0.07, 0.13) if cushioned else rng.uniform(0.025, 0.05)
    seat = Seat(width, depth, height, thickness, exponent)

    taper = rng.uniform(0.8, 1.0) if maybe(rng, 0.4) else 1.0  # narrower at the rear
    outline = ellipse(width, depth, 24, exponent)
    outline = outline * np.stack([1 + (taper - 1) * (0.5 - outline[:, 1] / depth), np.ones(len(outline))], 1)
    top = slab(outline, thickness, bevel=(0.35 if cushioned else 0.2) * thickness)
    solids = [top.moved(y=height - thickness)]

    if family == "office":
        kind = "star"
    elif family == "bar":
        kind = pick(rng, {"legs": 3, "disc": 1.5, "loops": 1, "panels": 0.3})
    elif family == "lounge":
        kind = pick(rng, {"legs": 2.5, "loops": 2, "cantilever": 1, "rocker": 1, "star": 0.6, "panels": 0.7, "cross": 0.7})
    else:
        kind = pick(
            rng,
            {"legs": 6, "loops": 1, "cantilever": 1, "cross": 0.8, "panels": 0.6, "disc": 0.7, "star": 0.4, "rocker": 0.5},
        )
    under = height - thickness
    spread = 0.5 * (2 if exponent > 4 else 1.75 if exponent > 2.5 else 1.5) / 2
    half_x, half_z = spread * width * (0.5 + 0.5 * taper) - 0.03, spread * depth - 0.03
    solids += supports.base(rng, kind, half_x, half_z, under)

    stile_x = 0.5 * width * taper - 0.03 if exponent > 4 else 0.36 * width
    if maybe(rng, 0.95):
        curve = seat.rear(stile_x) - seat.rear(0.0) if exponent <= 4 else 0.0
        curve = max(curve, rng.uniform(0.0, 0.08) if maybe(rng, 0.6) else 0.0)
        back, rise = _back(rng, family, stile_x, back_height, curve)
        solids += [_leaned(part, seat, recline) for part in back]
        arm_chance = {"office": 0.6, "lounge": 0.6, "bar": 0.1}.get(family, 0.3)
        if maybe(rng, arm_chance) and back_height > 0.3:
            edge = max(stile_x, half_x) if exponent <= 4 else 0.5 * width - 0.02
            solids += _arms(rng, seat, edge, stile_x, recline, curve + rise)
    return solids


def _leaned(part: Solid, seat: Seat, recline_deg: float) -> Solid:
    """A part of the back, drawn in the plane z = 0 above y = 0, put on the rear of the seat and leaned backwards."""
    return part.rotated("x", -recline_deg).moved(y=seat.height - 0.5 * seat.thickness, z=-seat.depth / 2 + 0.03)


def _bow(x: np.ndarray, half: float, curve: float) -> np.ndarray:
    """z of a back that is bent towards the sitter: `curve` at the stiles (x = half), zero in the middle."""
    return curve * (np.abs(x) / half) ** 2


def _rail(half: float, y: float, height: float, thickness: float, curve: float, arch: float = 0.0) -> Solid:
    """A horizontal board between the stiles, following the bow of the back, its middle lifted by `arch`."""
    x = np.linspace(-half, half, 9)
    path = np.stack([x, y + arch * (1 - (x / half) ** 2), _bow(x, half, curve)], 1)
    return tube(path, 1.0, rectangle(thickness, height, segments=1))


def _back(
    rng: np.random.Generator, family: str, half: float, height: float, curve: float
) -> tuple[list[Solid], float]:
    """A back of the given height between stiles at x = -half and half; also how far its front lies before z = 0."""
    top = height + 0.02
    upholstered = {"office": 0.8, "lounge": 0.5}.get(family, 0.12)
    if maybe(rng, upholstered):
        return _padded_back(rng, half, top, curve, detached=family == "office")
    kind = pick(
        rng,
        {"ladder": 2, "slats": 2, "spindles": 1, "splat": 1.2, "cross": 0.8, "open": 1.0, "lattice": 0.7, "band": 1.0}
        | {"panel": 1.2, "hoop": 1.2, "solid": 2.0},
    )
    if kind == "solid":
        return [_plate(rng, half, top, curve, rng.uniform(0.02, 0.045))], 0.0
    if kind == "hoop":
        return _hoop_back(rng, half, top, curve), 0.0

    stile = rng.uniform(0.022, 0.045)
    board = rng.uniform(0.015, 0.028)
    round_stiles = maybe(rng, 0.4)
    outline = ellipse(stile, stile, 8) if round_stiles else rectangle(stile, stile, segments=1)
    head = (half, top, curve)
    parts = both_sides(post((half, -0.02, curve), head, outline, [(0, 1), (1, rng.uniform(0.7, 1))]))
    rail = rng.uniform(0.04, 0.12) if height > 0.3 else rng.uniform(0.03, 0.06)
    arch = rng.uniform(0.01, 0.07) if maybe(rng, 0.4) else 0.0
    parts.append(_rail(half, top - 0.45 * rail, rail, board, curve, arch))
    if kind == "open":
        return parts, 0.0
    low = rng.uniform(0.06, 0.3) * height
    if kind == "ladder":
        count = int(rng.integers(1, 5)) if height > 0.3 else 1
        each = rng.uniform(0.25, 0.6) * (top - rail - low) / (count + 0.5)
        for k in range(count):
            y = low + (k + 0.5) * (top - rail - low) / (count + 0.5)
            parts.append(_rail(half, y, min(each, 0.08), board, curve, 0.6 * arch))
        return parts, 0.0
    if kind in ("panel", "band"):
        bottom = low if kind == "panel" else 0.55 * height
        x, y = np.meshgrid(np.linspace(-half, half, 9), [bottom, top - 0.5 * rail])
        parts.append(sheet(np.stack([x, y, _bow(x, half, curve)], 2), board))
        return parts, 0.0
    bottom = -0.01
    if maybe(rng, 0.5) or kind == "lattice":
        bottom = low
        parts.append(_rail(half, low, rng.uniform(0.025, 0.05), board, curve))
    upper = top - 0.6 * rail
    if kind == "cross":
        for s in (-1, 1):
            x = s * np.linspace(-half, half, 7)
            path = np.stack([x, np.linspace(bottom + 0.01, upper, 7), _bow(x, half, curve)], 1)
            parts.append(tube(path, 1.0, rectangle(board, rng.uniform(0.02, 0.04), segments=1)))
        return parts, 0.0
    if kind == "splat":
        parts.append(_splat(rng, bottom, upper + arch * 0.8, board, half * rng.uniform(0.25, 0.5)))
        return parts, 0.0
    count = {"slats": rng.integers(2, 8), "spindles": rng.integers(4, 9), "lattice": rng.integers(2, 5)}[kind]
    wide = rng.uniform(0.25, 0.6) * 2 * half / (count + 1)
    for x in np.linspace(-half, half, int(count) + 2)[1:-1]:
        z = float(_bow(x, half, curve))
        size = (0.018, None) if kind == "spindles" else (0.8 * board, min(wide, 0.07))
        parts.append(bar((x, bottom, z), (x, upper + arch * (1 - (x / half) ** 2), z), *size))
    if kind == "lattice":
        for y in np.linspace(bottom, upper, int(rng.integers(1, 4)) + 2)[1:-1]:
            parts.append(_rail(half, y, rng.uniform(0.015, 0.03), 0.7 * board, curve))
    return parts, 0.0


def _plate(rng: np.random.Generator, half: float, top: float, curve: float, thickness: float) -> Solid:
    """A one-piece back: straight or flared, its upper corners rounded, bowed and with a lumbar bulge."""
    flare, power = rng.uniform(-0.25, 0.2), pick(rng, (2.0, 3.0, 6.0, 12.0))
    wave = rng.uniform(-0.02, 0.03)
    t = np.concatenate([np.linspace(0, 0.7, 4), 1 - 0.3 * np.linspace(0.75, 0, 5) ** 1.8])[:, None]
    v = np.linspace(-1, 1, 11)[None]
    rounding = (1 - np.clip((t - 0.4) / 0.605, 0, 1) ** power) ** (1 / power)
    x = v * half * (1 + flare * t) * np.maximum(rounding, 0.12)
    y = -0.01 + t * (top + 0.01) + 0 * v
    return sheet(np.stack([x, y, _bow(x, half, curve) + wave * np.sin(np.pi * t)], 2), thickness)


def _padded_back(
    rng: np.random.Generator, half: float, top: float, curve: float, detached: bool
) -> tuple[list[Solid], float]:
    """An upholstered back; `detached` ones float above the seat on a spine."""
    thickness = rng.uniform(0.05, 0.11)
    if not detached or maybe(rng, 0.3):
        if maybe(rng, 0.5):
            return [_plate(rng, 1.05 * half, top, curve, thickness)], thickness / 2
        return [between((-half - 0.03, -0.02, -thickness / 2), (half + 0.03, top, thickness / 2), 0.03)], thickness / 2
    gap = rng.uniform(0.12, 0.35) * top
    pad = _plate(rng, rng.uniform(0.8, 1.1) * half, top - gap, max(curve, 0.03), thickness).moved(y=gap)
    spine = tube(
        rounded_path([(0, -0.06, 0.12), (0, -0.06, -0.07), (0, gap + 0.3 * (top - gap), -0.4 * thickness)], 0.06),
        1.0,
        rectangle(0.06, 0.02, segments=1),
        side=(1, 0, 0),
    )
    return [pad, spine], thickness / 2


def _hoop_back(rng: np.random.Generator, half: float, top: float, curve: float) -> list[Solid]:
    """A bent hoop, empty or filled with spindles (Windsor)."""
    angle = np.linspace(0, np.pi, 17)
    straight = rng.uniform(0.2, 0.6) * top
    x, y = half * np.cos(angle), straight + (top - straight) * np.sin(angle) ** 0.9
    x, y = np.concatenate([[half], x, [-half]]), np.concatenate([[-0.02], y, [-0.02]])
    thickness = rng.uniform(0.018, 0.035)
    parts = [tube(np.stack([x, y, _bow(x, half, curve)], 1), thickness / 2)]
    count = int(rng.integers(3, 9)) if maybe(rng, 0.85) else 0
    for x in np.linspace(-half, half, count + 2)[1:-1]:
        end = straight + (top - straight) * (1 - (x / half) ** 2) ** 0.45
        parts.append(bar((0.75 * x, -0.01, _bow(0.75 * x, half, curve)), (x, end, _bow(x, half, curve)), 0.016))
    return parts


def _splat(rng: np.random.Generator, bottom: float, top: float, thickness: float, half: float) -> Solid:
    """A vase-shaped centre board."""
    t = np.linspace(0, 1, 9)[:, None]
    width = half * (1 + rng.uniform(0.1, 0.5) * np.sin(2 * np.pi * (rng.uniform(0.6, 1.4) * t + rng.uniform(0, 1))))
    x = np.array([[-1.0, -0.5, 0.0, 0.5, 1.0]]) * np.minimum(width, 1.8 * half)
    return sheet(np.stack([x, bottom + t * (top - bottom) + 0 * x, 0 * x], 2), thickness)


def _arms(
    rng: np.random.Generator, seat: Seat, edge: float, stile_x: float, recline_deg: float, bow: float
) -> list[Solid]:
    """A pair of arms from the back's stile to the front of the seat."""
    rise = rng.uniform(0.17, 0.26)
    y = seat.height + rise
    rear = -seat.depth / 2 + 0.03 + bow - np.tan(np.radians(recline_deg)) * rise
    front = seat.depth * rng.uniform(0.15, 0.45)
    foot_z = min(front, seat.depth * 0.3)
    kind = pick(rng, {"post": 3, "panel": 0.8, "loop": 1.5, "swoop": 1.5, "cantilever": 0.7})
    size = rng.uniform(0.025, 0.05)
    base = seat.height - 0.6 * seat.thickness
    rest = rectangle(size * rng.uniform(1.0, 2.0), 0.7 * size, segments=1)
    start = (stile_x, y, rear - 0.01)
    if kind == "panel":
        return both_sides(between((edge - 0.02, base - 0.02, rear), (edge + 0.03, y, front + 0.02), 0.012))
    if kind == "loop":
        path = [start, (edge + 0.02, y, front), (edge + 0.02, base, foot_z), (edge - 0.06, base, foot_z)]
        return both_sides(tube(rounded_path(path, 0.09), 0.011 + 0.2 * size))
    if kind == "swoop":
        path = [start, (edge, y + 0.02, 0.2 * front), (edge, y - 0.4 * rise, front), (edge - 0.01, base, foot_z)]
        return both_sides(tube(rounded_path(path, 0.12, 5), 1.0, rest, side=(1, 0, 0)))
    arm = tube(rounded_path([start, (edge, y, 0.0), (edge, y, front)], 0.1), 1.0, rest, side=(1, 0, 0))
    if kind == "cantilever":
        return both_sides(arm) + both_sides(bar((edge - 0.01, base, rear / 2), (edge, y, rear / 2), 0.03, 0.05))
    outline = ellipse(0.8 * size, 0.8 * size, 8) if maybe(rng, 0.5) else rectangle(0.8 * size, 0.8 * size)
    bulge = rng.uniform(0.8, 1.5)
    front_post = post((edge - 0.012, base, foot_z), (edge, y, foot_z), outline, [(0, 1), (0.5, bulge), (1, 0.9)])
    return both_sides(arm) + both_sides(front_post)


# --- whole-body families ----------------------------------------------------------------------------------------------


def _shell_chair(rng: np.random.Generator) -> list[Solid]:
    """A moulded bucket: one curved sheet for seat and back, on any support."""
    width, depth = rng.uniform(0.42, 0.62), rng.uniform(0.40, 0.52)
    height, back, lean = rng.uniform(0.36, 0.47), rng.uniform(0.25, 0.5), rng.uniform(0.05, 0.2)
    curl, wings = rng.uniform(0.0, 0.07), rng.uniform(0.0, 0.22)
    path = rounded_path(
        [(0, -0.03, depth / 2), (0, 0, depth / 2 - 0.08), (0, -0.02, -depth / 2 + 0.05), (0, back, -depth / 2 - lean)],
        rng.uniform(0.1, 0.2),
        5,
    )
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    t = (length / length[-1])[:, None]
    v = np.linspace(-1, 1, 13)[None]
    ease = np.clip((t - 0.35) / 0.3, 0, 1)
    narrow = rng.uniform(-0.1, 0.35)
    span = 0.5 * width * (1 - narrow * ease) * (1 - np.clip((t - 0.75) / 0.25, 0, 1) ** 3 * rng.uniform(0.1, 0.6))
    span = span * (1 - 0.25 * np.clip(1 - t / 0.15, 0, 1) ** 2)
    # the rims are lifted off the seat and pulled forward off the back; `wings` makes arms of them about the hip
    hip = np.exp(-(((t - 0.5) / 0.2) ** 2))
    lift = (curl * np.abs(v) ** 2.5 + wings * hip * np.abs(v) ** 4) * (1 - 0.7 * ease)
    pull = (curl + wings * hip) * np.abs(v) ** 2.5 * ease
    surface = np.stack([span * v, path[:, 1:2] + lift, path[:, 2:3] + pull], 2)
    shell = sheet(surface, rng.uniform(0.018, 0.035)).moved(y=height)
    kind = pick(rng, {"legs": 2, "star": 1, "disc": 1, "loops": 1, "rocker": 0.5})
    plate = slab(ellipse(0.7 * width, 0.65 * depth, 20, 4), 0.03).moved(y=height - 0.045)
    return [shell, plate] + supports.base(rng, kind, 0.32 * width, 0.3 * depth, height - 0.035)


def _club_chair(rng: np.random.Generator) -> list[Solid]:
    """An upholstered armchair: a block seat, thick arms and back, perhaps wings, on short feet."""
    width, depth = rng.uniform(0.68, 0.95), rng.uniform(0.68, 0.9)
    arm, arm_height = rng.uniform(0.09, 0.2), rng.uniform(0.5, 0.66)
    back, back_height = rng.uniform(0.12, 0.24), rng.uniform(0.66, 1.1)
    foot = rng.uniform(0.03, 0.2)
    seat_height = rng.uniform(0.36, 0.46)
    soft = rng.uniform(0.02, 0.06)
    half, inner, lean = width / 2, width / 2 - arm, rng.uniform(0, 14)
    split = seat_height - rng.uniform(0.1, 0.16)
    solids = [
        between((-half + 0.02, foot, -depth / 2 + 0.02), (half - 0.02, split + 0.01, depth / 2 - 0.03), 0.02),
        between((-inner - 0.02, split, -depth / 2 + 0.05), (inner + 0.02, seat_height, depth / 2), soft),
    ]
    solids.append(
        between((-inner - 0.05, split - 0.1, -depth / 2), (inner + 0.05, back_height, -depth / 2 + back), soft).rotated(
            "x", -lean, (0, split, -depth / 2 + back)
        )
    )
    kind = pick(rng, ("box", "rolled", "sloped"))
    if kind == "sloped":
        z = np.array([depth / 2 - 0.01, -depth / 2 + 0.02])
        rise = np.array([arm_height - rng.uniform(0.03, 0.12), arm_height + 0.05])
        outline = rectangle(arm, 1.0, 0.03, 3)
        rings = [
            np.stack([half - arm / 2 + outline[:, 0], foot + (outline[:, 1] + 0.5) * (h - foot), np.full(16, zz)], 1)
            for zz, h in zip(z, rise, strict=True)
        ]
        solids += both_sides(Solid(np.stack(rings)))
    else:
        solids += both_sides(between((inner, foot, -depth / 2 + 0.02), (half, arm_height, depth / 2 - 0.01), soft))
        if kind == "rolled":
            start, end = (half - arm / 2, arm_height, -depth / 2 + 0.03), (half - arm / 2, arm_height, depth / 2)
            solids += both_sides(bar(start, end, 1.35 * arm))
    if maybe(rng, 0.35) and back_height > 0.8:  # wings
        t = np.linspace(0, 1, 6)[:, None]
        reach = rng.uniform(0.18, 0.3) * np.sin(np.pi * (0.12 + 0.8 * t)) ** 0.7
        z = -depth / 2 + back - 0.06 + np.linspace(0, 1, 4)[None] * (reach + 0.06)
        y = arm_height - 0.05 + t * (back_height - arm_height) + 0 * z
        sweep = np.tan(np.radians(lean)) * (y - split)
        side = sheet(np.stack([np.full_like(z, inner + 0.02), y, z - sweep], 2), rng.uniform(0.04, 0.08))
        solids += both_sides(side)
    if foot > 0.05:
        solids += supports.feet(rng, half - 0.07, depth / 2 - 0.08, foot + 0.02)
    if maybe(rng, 0.25):
        solids.append(ellipsoid((0.4, 0.34, 0.16), (0, seat_height + 0.15, -depth / 2 + back + 0.07)).rotated("x", 0))
    return solids


def _barrel_chair(rng: np.random.Generator) -> list[Solid]:
    """A round seat with a back that wraps around it and falls towards the arms."""
    radius, height = rng.uniform(0.26, 0.38), rng.uniform(0.36, 0.47)
    rise, fall = rng.uniform(0.22, 0.5), rng.uniform(0.0, 0.8)
    reach = np.radians(rng.uniform(80, 150))
    angle = np.linspace(-reach, reach, 25)
    thickness = pick(rng, (0.025, 0.04, 0.09)) * rng.uniform(0.9, 1.2)
    drop = (1 - np.cos(angle)) / (1 - np.cos(reach))
    top = rise * (1 - fall * drop)
    open_gap = rng.uniform(0.1, 0.22) if maybe(rng, 0.4) else None
    bottom = -0.06 if open_gap is None else np.minimum(open_gap, 0.5 * top)
    t = np.linspace(0, 1, 4)[:, None]
    flare = rng.uniform(0.0, 0.12)
    y = bottom + t * (top - bottom)
    r = radius - 0.3 * thickness + flare * np.maximum(y, 0.0)
    wrap = sheet(np.stack([r * np.sin(angle), y, -r * np.cos(angle)], 2), thickness).moved(y=height)
    solids = [wrap]
    cushion = rng.uniform(0.06, 0.14)
    solids.append(slab(ellipse(2 * radius, 2 * radius, 28, pick(rng, (2.0, 2.0, 3.0))), cushion).moved(y=height - cushion))
    if open_gap is not None:
        for a in np.linspace(-0.92 * reach, 0.92 * reach, int(rng.integers(4, 12))):
            lift = 0.6 * min(open_gap, 0.5 * float(np.interp(a, angle, top))) + 0.05
            foot = np.array([radius * np.sin(a), height - 0.5 * cushion, -radius * np.cos(a)]) * [0.93, 1, 0.93]
            head = np.array([radius * np.sin(a), height + lift, -radius * np.cos(a)]) * [0.99, 1, 0.99]
            head[1] = height + min(open_gap, 0.5 * float(np.interp(a, angle, top))) + 0.02
            solids.append(bar(foot, head, 0.022))
    if maybe(rng, 0.2):  # a solid drum down to the floor
        base = ellipse(1.9 * radius, 1.9 * radius, 28)
        return [*solids, slab(base, height - cushion + 0.02, 0.02)]
    kind = pick(rng, {"legs": 3, "disc": 1, "star": 0.7, "loops": 0.7})
    solids += supports.base(rng, kind, 0.66 * radius, 0.66 * radius, height - cushion)
    if kind in ("legs", "loops") and maybe(rng, 0.3):
        solids.append(box((1.2 * radius, 0.02, 1.2 * radius), (0, height - cushion - 0.01, 0)))
    return solids
