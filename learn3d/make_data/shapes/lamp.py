"""Procedural lamps, in metres: table, floor, arc and desk lamps, pendants, chandeliers."""

from __future__ import annotations

import numpy as np
import trimesh

from learn3d.make_data.shapes.parts import (
    Solid,
    all_moved,
    assemble,
    bar,
    ellipse,
    ellipsoid,
    rectangle,
    revolve,
    rounded_path,
    slab,
    tube,
)
from learn3d.make_data.shapes.sampling import maybe, pick


def make_lamp(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random lamp."""
    weights = {_table_lamp: 3.5, _floor_lamp: 2.5, _arc_lamp: 1, _desk_lamp: 1.5, _pendant: 1.8, _chandelier: 1.2}
    maker = pick(rng, weights)
    return assemble(maker(rng))


def _shell(radius: np.ndarray, y: np.ndarray, sides: int = 20) -> Solid:
    """A thin wall around the y axis, open below and above: its outer radius [N] at the heights y [N]."""
    outer = np.stack([radius, y], 1)
    inner = np.stack([radius - 0.03 * radius.max(), y], 1)
    return revolve(np.concatenate([outer, inner[::-1]]), sides, hollow=True)


def _shade(rng: np.random.Generator, radius: float, height: float) -> list[Solid]:
    """A lamp shade from y = 0 to `height`, with a bulb, and two wires across that hold it."""
    t = np.linspace(0, 1, 7)
    top = rng.uniform(0.3, 0.75)
    outline = {
        "cone": 1 - (1 - top) * t,
        "drum": 1 - 0.1 * t,
        "bell": top + (1 - top) * (1 - t) ** 2,
        "dome": np.sqrt(1 - (0.98 * t) ** 2),
    }
    scale = outline[pick(rng, {"cone": 4, "drum": 2, "bell": 1.5, "dome": 1.5})]
    level = 0.85 * height
    reach = 0.985 * radius * float(np.interp(0.85, t, scale))  # the wires end inside the wall
    return [
        _shell(radius * scale, height * t, sides=pick(rng, {20: 5, 4: 1})),
        bar((-reach, level, 0), (reach, level, 0), 0.012),
        bar((0, level, -reach), (0, level, reach), 0.012),
        ellipsoid((0.07, 0.11, 0.07), (0, 0.62 * height, 0), 10, 6),
        bar((0, -0.02, 0), (0, 0.88 * height, 0), 0.02),
    ]


def _foot(rng: np.random.Generator, size: float) -> Solid:
    """A round or square plate on the floor."""
    return slab(pick(rng, (ellipse(size, size), rectangle(size, size))), rng.uniform(0.02, 0.05))


def _table_lamp(rng: np.random.Generator) -> list[Solid]:
    """A turned base under a shade."""
    base, width = rng.uniform(0.2, 0.38), rng.uniform(0.06, 0.13)
    t = np.linspace(0, 1, 17)
    profiles = {
        "vase": 0.22 + 0.8 * np.exp(-(((t - rng.uniform(0.3, 0.7)) / 0.22) ** 2)),
        "balls": 0.2 + 0.6 * np.abs(np.sin(rng.integers(2, 5) * np.pi * t)),
        "hourglass": 0.25 + 0.7 * np.abs(2 * t - 1) ** 1.6,
        "cone": 0.9 - 0.75 * t,
        "stick": np.full(17, 0.15),
    }
    profile = profiles[pick(rng, tuple(profiles))]
    points = [(1.0, 0.0), (1.0, 0.04), *zip(profile, 0.06 + 0.94 * t, strict=True)]
    body = revolve([(width * r, base * y) for r, y in points], pick(rng, {20: 3, 8: 1, 4: 1}))
    neck = base + rng.uniform(0.02, 0.06)
    shade = _shade(rng, rng.uniform(1.15, 2.2) * max(width, 0.09), rng.uniform(0.15, 0.3))
    return [body, bar((0, 0.7 * base, 0), (0, neck + 0.03, 0), 0.025), *all_moved(shade, y=neck - 0.02)]


def _floor_lamp(rng: np.random.Generator) -> list[Solid]:
    """A tall pole on a plate or on three legs, with a shade on top."""
    height, thick = rng.uniform(1.0, 1.5), rng.uniform(0.025, 0.04)
    if maybe(rng, 0.5):
        solids = [_foot(rng, rng.uniform(0.26, 0.4)), bar((0, 0.01, 0), (0, height, 0), thick)]
    else:
        reach, knee = rng.uniform(0.22, 0.34), rng.uniform(0.5, 0.95) * height
        solids = [bar((0, knee - 0.03, 0), (0, height, 0), 1.3 * thick)]
        for angle in np.radians([90, 210, 330]):
            solids.append(bar((reach * np.cos(angle), 0, reach * np.sin(angle)), (0, knee, 0), thick))
    shade = _shade(rng, rng.uniform(0.17, 0.3), rng.uniform(0.2, 0.36))
    return solids + all_moved(shade, y=height - 0.02)


def _arc_lamp(rng: np.random.Generator) -> list[Solid]:
    """A floor lamp whose pole bends over to the front and lets a shade hang down."""
    height, reach = rng.uniform(1.4, 1.9), rng.uniform(0.5, 1.2)
    rise = rng.uniform(0.3, 0.7) * height
    angle = np.linspace(0, np.pi * rng.uniform(0.7, 0.95), 14)
    arc = np.stack([0 * angle, height - rise + rise * np.sin(angle), reach / 2 * (1 - np.cos(angle))], 1)
    tall = rng.uniform(0.14, 0.26)
    hang = arc[-1] - [0, rng.uniform(0.0, 0.2) + tall, 0]
    shade = all_moved(_shade(rng, rng.uniform(0.12, 0.24), tall), *hang)
    cord = bar(arc[-1], hang + [0, 0.5 * tall, 0], 0.014)
    return [_foot(rng, 0.36), tube([(0, 0.01, 0), *arc], 0.014), cord, *shade]


def _desk_lamp(rng: np.random.Generator) -> list[Solid]:
    """Two arms with joints, or one bent tube, that hold a head towards +z."""
    lower, upper = np.radians(rng.uniform(-35, 25)), np.radians(rng.uniform(20, 80))
    foot = np.array([0, 0.02, 0])
    elbow = foot + rng.uniform(0.2, 0.42) * np.array([0, np.cos(lower), np.sin(lower)])
    head = elbow + rng.uniform(0.2, 0.42) * np.array([0, np.cos(upper), np.sin(upper)])
    thick = rng.uniform(0.014, 0.022)
    solids = [_foot(rng, rng.uniform(0.16, 0.24))]
    if maybe(rng, 0.35):
        solids.append(tube(rounded_path([foot, elbow, head], 0.2, 7), thick / 2))
    else:
        solids += [bar(foot, elbow, thick), bar(elbow, head, thick)]
        solids += [bar(joint - [0.02, 0, 0], joint + [0.02, 0, 0], 0.04) for joint in (elbow, head)]
    size, tilt_deg = rng.uniform(0.06, 0.11), rng.uniform(-10, 60)
    t = np.linspace(0, 1, 6)
    radius = size * pick(rng, (np.sqrt(1 - 0.93 * t**2), 1 - 0.7 * t))
    shade = [
        _shell(radius, 1.5 * size * t, 16),
        ellipsoid((0.9 * size, size, 0.9 * size), (0, 0.7 * size, 0), 10, 6),
        revolve([(0.5 * size, 1.2 * size), (0.4 * size, 1.7 * size)], 12),
    ]
    tilted = [part.moved(y=-1.5 * size).rotated("x", -tilt_deg) for part in shade]
    return solids + all_moved(tilted, *head)


def _pendant(rng: np.random.Generator) -> list[Solid]:
    """One to three shades of the same kind hanging from a ceiling plate."""
    count = pick(rng, {1: 3, 2: 1, 3: 1.5})
    radius, height = rng.uniform(0.12, 0.32), rng.uniform(0.12, 0.32)
    ceiling, pitch = height + rng.uniform(0.25, 0.9), 2.4 * radius
    shade = [*_shade(rng, radius, height), bar((0, 0.6 * height, 0), (0, ceiling + 0.01, 0), 0.014)]
    plate = slab(rectangle(pitch * (count - 1) + 0.12, 0.12, 0.05, 4), 0.03).moved(y=ceiling)
    places = pitch * (np.arange(count) - (count - 1) / 2)
    return [plate, *(part.moved(x=x) for x in places for part in shade)]


def _chandelier(rng: np.random.Generator) -> list[Solid]:
    """Arms around a hanging column, each with a candle or a globe."""
    count, reach, drop = int(rng.integers(3, 9)), rng.uniform(0.25, 0.45), rng.uniform(0.3, 0.6)
    swing, rise = rng.uniform(0.02, 0.2), rng.uniform(-0.06, 0.16)
    path = rounded_path([(0, 0, 0), (0.5 * reach, -swing, 0), (reach, -0.5 * swing, 0), (reach, rise, 0)], 0.15, 4)
    arm = [tube(path, 0.009)]
    if maybe(rng, 0.5):
        arm.append(ellipsoid((0.12, 0.12, 0.12), (reach, rise + 0.05, 0), 12, 8))
    else:
        arm.append(revolve([(0.012, 0), (0.045, 0.01), (0.045, 0.02), (0.012, 0.022)], 10).moved(reach, rise - 0.01))
        arm.append(bar((reach, rise, 0), (reach, rise + 0.1, 0), 0.026))
    t = np.linspace(0, 1, 9)
    radius = 0.02 + 0.04 * np.abs(np.sin(rng.uniform(1, 3) * np.pi * t))
    column = revolve(np.stack([radius, -0.12 + 0.3 * t], 1), 12)
    rose = slab(ellipse(0.13, 0.13), 0.03).moved(y=drop - 0.01)
    turned = [part.rotated("y", angle) for angle in 90 + 360 / count * np.arange(count) for part in arm]
    return [column, bar((0, 0.1, 0), (0, drop, 0), 0.016), rose, *turned]
