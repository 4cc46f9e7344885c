"""Procedural chairs, in metres: a seat, a support, a back and arms, each of many kinds; and one-piece chairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from learn3d.make_data.shapes import supports
from learn3d.make_data.shapes.chair_backs import back_parts
from learn3d.make_data.shapes.chair_bodies import barrel_chair, club_chair, shell_chair
from learn3d.make_data.shapes.parts import (
    Solid,
    assemble,
    bar,
    between,
    both_sides,
    ellipse,
    post,
    rectangle,
    rounded_path,
    slab,
    tube,
)
from learn3d.make_data.shapes.sampling import maybe, pick


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
    maker = {"shell": shell_chair, "club": club_chair, "barrel": barrel_chair}.get(family)
    return assemble(maker(rng) if maker else _jointed_chair(rng, family))


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
        kinds = {"legs": 2.5, "loops": 2, "cantilever": 1, "rocker": 1, "star": 0.6, "panels": 0.7, "cross": 0.7}
        kind = pick(rng, kinds)
    else:
        kinds = {"legs": 6, "loops": 1, "cantilever": 1, "cross": 0.8, "panels": 0.6, "disc": 0.7, "star": 0.4}
        kind = pick(rng, kinds | {"rocker": 0.5})
    under = height - thickness
    spread = 0.5 * 0.35 ** (1 / exponent)  # well inside the outline
    half_x, half_z = spread * width * (0.5 + 0.5 * taper) - 0.03, spread * depth - 0.03
    solids += supports.base(rng, kind, half_x, half_z, under)

    stile_x = 0.5 * width * taper - 0.03 if exponent > 4 else 0.36 * width
    if family != "bar" or maybe(rng, 0.8):  # the others are stools
        curve = seat.rear(stile_x) - seat.rear(0.0) if exponent <= 4 else 0.0
        curve = max(curve, rng.uniform(0.0, 0.08) if maybe(rng, 0.6) else 0.0)
        back, rise = back_parts(rng, family, stile_x, back_height, curve)
        solids += [_leaned(part, seat, recline) for part in back]
        arm_chance = {"office": 0.6, "lounge": 0.6, "bar": 0.1}.get(family, 0.3)
        if maybe(rng, arm_chance) and back_height > 0.3:
            edge = max(stile_x, half_x) if exponent <= 4 else 0.5 * width - 0.02
            solids += _arms(rng, seat, edge, stile_x, recline, curve + rise)
    return solids


def _leaned(part: Solid, seat: Seat, recline_deg: float) -> Solid:
    """A part of the back, drawn in the plane z = 0 above y = 0, put on the rear of the seat and leaned backwards."""
    return part.rotated("x", -recline_deg).moved(y=seat.height - 0.5 * seat.thickness, z=-seat.depth / 2 + 0.03)


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
