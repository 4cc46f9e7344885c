"""Procedural lamps, in metres: table, floor, tripod, arc and desk lamps, pendants, chandeliers, lanterns."""

from __future__ import annotations

import numpy as np
import trimesh

from learn3d.make_data.shapes.parts import (
    Solid,
    all_moved,
    assemble,
    bar,
    box,
    ellipse,
    ellipsoid,
    post,
    rectangle,
    revolve,
    rounded_path,
    slab,
    tube,
)
from learn3d.make_data.shapes.sampling import maybe, pick


def make_lamp(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random lamp."""
    maker = pick(
        rng,
        {
            _table_lamp: 3.5,
            _floor_lamp: 2.0,
            _arc_lamp: 1.0,
            _desk_lamp: 1.5,
            _pendant: 1.8,
            _chandelier: 1.2,
            _lantern: 0.8,
        },
    )
    return assemble(maker(rng))


def _shade(rng: np.random.Generator, radius: float, height: float) -> list[Solid]:
    """A lamp shade, open below (and mostly above) with a spider that reaches its axis, from y = 0 to `height`."""
    kind = pick(rng, {"cone": 3, "drum": 2, "bell": 1.5, "dome": 1.2, "square": 1.0, "globe": 1.0, "pleated": 0.7})
    if kind == "globe":
        return [ellipsoid((2 * radius, min(height, 2 * radius), 2 * radius), (0, height / 2, 0), 18, 12)]
    t = np.linspace(0, 1, 7 if kind in ("bell", "dome") else 3)
    top = rng.uniform(0.3, 0.75)
    scale = {
        "drum": 1 - (1 - rng.uniform(0.85, 1)) * t,
        "bell": top + (1 - top) * (1 - t) ** rng.uniform(1.6, 2.6),
        "dome": np.maximum(np.sqrt(np.maximum(1 - (0.985 * t) ** 2, 0)), 0.12),
    }.get(kind, 1 - (1 - top) * t)
    sides = {"square": 4, "pleated": 24}.get(kind, 20)
    wall = 0.03 * radius
    outer = np.stack([radius * scale, t * height], 1)
    inner = np.stack([np.maximum(radius * scale - wall, 0.02 * radius), t * height], 1)[::-1]
    shade = revolve(np.concatenate([outer, inner]), sides, hollow=True)
    if kind == "pleated":
        factor = np.where(np.arange(sides) % 2, 0.93, 1.03)[None, :, None]
        shade = Solid(shade.rings * np.where([True, False, True], factor, 1.0), shade.ends)
    if sides == 4:
        shade = shade.rotated("y", 45)
    wide = {"square": 0.5**0.5, "pleated": 1.03}.get(kind, 1.0)  # the spider ends inside the wall
    reach = 0.985 * float(np.interp(0.85, t, scale)) * radius * wide
    spider = [bar((-reach, 0.85 * height, 0), (reach, 0.85 * height, 0), 0.012)]
    spider.append(bar((0, 0.85 * height, -reach), (0, 0.85 * height, reach), 0.012))
    spider.append(ellipsoid((0.07, 0.11, 0.07), (0, 0.62 * height, 0), 10, 6))
    spider.append(bar((0, -0.02, 0), (0, 0.88 * height, 0), 0.02))
    return [shade, *spider]


def _table_lamp(rng: np.random.Generator) -> list[Solid]:
    """A turned, ball, block, jug or stick base under a shade."""
    base, height = rng.uniform(0.2, 0.38), rng.uniform(0.15, 0.3)
    width = rng.uniform(0.06, 0.13)
    sides = pick(rng, (4, 6, 8, 20, 20, 20))
    kind = pick(rng, ("vase", "turned", "balls", "stick", "block", "cone", "hourglass", "loop"))
    t = np.linspace(0, 1, 13)
    foot = [(1.0, 0.0), (1.0, 0.04)]
    if kind == "vase":
        swell = rng.uniform(0.3, 0.75)
        profile = 0.22 + 0.9 * np.exp(-(((t - swell) / rng.uniform(0.16, 0.3)) ** 2)) * (1 - 0.4 * t)
        points = [(0.7, 0.0), (0.7, 0.03), *zip(profile, 0.05 + 0.95 * t, strict=True)]
    elif kind == "turned":
        r = 0.25 + 0.22 * np.abs(np.sin(rng.uniform(1.5, 4.5) * np.pi * t + rng.uniform(0, 3))) * (1.3 - t)
        points = [*foot, *zip(r, 0.06 + 0.94 * t, strict=True)]
    elif kind == "cone":
        points = [*foot, (0.9, 0.06), (0.18, 1.0)]
    elif kind == "hourglass":
        points = [*zip(0.25 + 0.7 * np.abs(2 * t - 1) ** 1.6, t, strict=True)]
    else:
        points = [*foot, (0.2, 0.06), (0.12, 0.1), (0.12, 1.0)]
    solids = [revolve([(width * r, base * y) for r, y in points], sides)]
    if kind == "balls":
        count = int(rng.integers(2, 5))
        for k in range(count):
            size = base / count * rng.uniform(0.85, 1.05)
            solids.append(ellipsoid((size, size, size), (0, base * (k + 0.5) / count, 0)))
    elif kind == "block":
        w = rng.uniform(0.5, 1.5) * width
        solids.append(box((w, 0.8 * base, w * rng.uniform(0.5, 1)), (0, 0.46 * base, 0), 0.01))
    elif kind == "loop":
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        r = 0.42 * base
        ring = np.stack([r * np.cos(angle), 0.5 * base + r * np.sin(angle), 0 * angle], 1)
        solids.append(tube(ring, rng.uniform(0.012, 0.025), closed=True))
    neck = base + rng.uniform(0.02, 0.06)
    solids.append(bar((0, 0.7 * base, 0), (0, neck + 0.03, 0), 0.025))
    shade = _shade(rng, rng.uniform(1.15, 2.2) * max(width, 0.09), height)
    return solids + all_moved(shade, y=neck - 0.02)


def _stand(rng: np.random.Generator, height: float) -> list[Solid]:
    """A foot and a pole of the given height: disc, slab, tripod, bent legs or a stack of shelves."""
    kind = pick(rng, {"disc": 2, "tripod": 2, "square": 1, "star": 1, "shelf": 0.7, "turned": 1})
    thick = rng.uniform(0.02, 0.035)
    reach = rng.uniform(0.13, 0.2)
    solids: list[Solid] = []
    if kind == "tripod":
        wide, top = rng.uniform(0.22, 0.34), height * rng.uniform(0.75, 1.0)
        for a in np.radians([90, 210, 330]):
            foot = (wide * np.cos(a), 0.0, wide * np.sin(a))
            solids.append(bar(foot, (0.02 * np.cos(a), top, 0.02 * np.sin(a)), 0.03, 0.03 if maybe(rng, 0.5) else None))
        solids.append(slab(ellipse(0.1, 0.1, 12), 0.05).moved(y=top - 0.04))
        return [*solids, bar((0, top - 0.02, 0), (0, height, 0), thick)]
    solids.append(bar((0, 0.01, 0), (0, height, 0), thick))
    if kind == "disc":
        solids.append(revolve([(reach, 0), (reach, 0.02), (0.3 * reach, rng.uniform(0.025, 0.06))], 20))
    elif kind == "square":
        solids.append(slab(rectangle(1.7 * reach, 1.7 * reach), 0.03))
    elif kind == "star":
        for a in np.radians(np.arange(4) * 90 + 45):
            path = [(0, 0.12, 0), (0.4 * reach * np.cos(a), 0.1, 0.4 * reach * np.sin(a))]
            path = rounded_path([*path, (1.2 * reach * np.cos(a), 0.012, 1.2 * reach * np.sin(a))], 0.05)
            solids.append(tube(path, 0.013))
    elif kind == "turned":
        t = np.linspace(0, 1, 25)
        r = 0.022 + 0.018 * np.abs(np.sin(rng.uniform(3, 8) * np.pi * t))
        solids.append(revolve([(reach, 0), (reach, 0.03), *zip(r, 0.05 + t * (height - 0.06), strict=True)], 12))
    else:
        half = rng.uniform(0.11, 0.16)
        for x in (-half, half):
            for z in (-half, half):
                solids.append(bar((x, 0, z), (x, height - 0.02, z), 0.022, 0.022))
        for y in np.linspace(0.1, height - 0.03, int(rng.integers(3, 5))):
            solids.append(box((2 * half + 0.02, 0.02, 2 * half + 0.02), (0, y, 0)))
    return solids


def _floor_lamp(rng: np.random.Generator) -> list[Solid]:
    """A tall stand with one shade on top, or an uplighter bowl, or a column of light."""
    height = rng.uniform(1.1, 1.5)
    kind = pick(rng, {"shade": 3, "bowl": 1, "column": 0.7})
    if kind == "column":
        wide, deep = rng.uniform(0.16, 0.4), rng.uniform(0.16, 0.3)
        outline = pick(rng, (ellipse(wide, wide, 20), rectangle(wide, deep, 0.02), ellipse(wide, wide, 6)))
        t, bulge, twist = np.linspace(0, 1, 9), rng.uniform(-0.4, 0.4), rng.uniform(-90, 90) * maybe(rng, 0.4)
        body = post((0, 0.05, 0), (0, height, 0), outline, [(s, 1 + bulge * np.sin(np.pi * s)) for s in t])
        turned = [Solid(ring[None]).rotated("y", twist * s).rings[0] for s, ring in zip(t, body.rings, strict=True)]
        return [slab(1.15 * outline, 0.06), Solid(np.stack(turned))]
    solids = _stand(rng, height)
    if kind == "bowl":
        r, h = rng.uniform(0.16, 0.26), rng.uniform(0.08, 0.2)
        t = np.linspace(0.06, 1, 7)
        outer, inner = np.stack([r * t, h * t**2], 1), np.stack([0.94 * r * t, h * t**2 + 0.016], 1)[::-1]
        bowl = revolve(np.concatenate([outer, inner]), 20, hollow=True)
        return [*solids, bowl.moved(y=height - 0.015), ellipsoid((0.06, 0.1, 0.06), (0, height + 0.02, 0), 10, 6)]
    return solids + all_moved(_shade(rng, rng.uniform(0.17, 0.3), rng.uniform(0.2, 0.36)), y=height - 0.02)


def _arc_lamp(rng: np.random.Generator) -> list[Solid]:
    """A floor lamp whose pole bends over to the front and lets a shade hang down."""
    height, reach = rng.uniform(1.4, 1.9), rng.uniform(0.5, 1.2)
    angle = np.linspace(0, np.pi * rng.uniform(0.7, 0.95), 14)
    flat = rng.uniform(0.3, 0.7)
    rise = flat * height
    path = np.stack([0 * angle, height - rise + rise * np.sin(angle), reach / 2 * (1 - np.cos(angle))], 1)
    path = np.concatenate([[[0, 0.02, 0]], path])
    end = path[-1]
    drop = rng.uniform(0.0, 0.2)
    height_of_shade = rng.uniform(0.14, 0.26)
    hang = end - [0, drop + height_of_shade, 0]
    shade = all_moved(_shade(rng, rng.uniform(0.12, 0.24), height_of_shade), *hang)
    base = slab(pick(rng, (ellipse(0.36, 0.36, 20), rectangle(0.34, 0.34))), rng.uniform(0.03, 0.1))
    return [base, tube(path, 0.014), bar(end, hang + [0, 0.5 * height_of_shade, 0], 0.014), *shade]


def _desk_lamp(rng: np.random.Generator) -> list[Solid]:
    """An articulated or gooseneck desk lamp, its head towards +z."""
    base = slab(
        pick(rng, (ellipse(0.2, 0.2, 20), rectangle(0.18, 0.18), rectangle(0.26, 0.12))), rng.uniform(0.02, 0.05)
    )
    a, b = rng.uniform(0.2, 0.42), rng.uniform(0.2, 0.42)
    back, forward = np.radians(rng.uniform(-35, 25)), np.radians(rng.uniform(20, 80))
    foot = np.array([0, 0.02, 0])
    elbow = foot + a * np.array([0, np.cos(back), np.sin(back)])
    head = elbow + b * np.array([0, np.cos(forward), np.sin(forward)])
    thick = rng.uniform(0.012, 0.02)
    if maybe(rng, 0.35):
        solids = [base, tube(rounded_path([foot, elbow, head], 0.2, 7), thick / 2)]
    else:
        gap = rng.uniform(0.015, 0.03) if maybe(rng, 0.5) else 0.0
        solids = [base]
        for x in (-gap, gap) if gap else (0.0,):
            solids += [bar(foot + [x, 0, 0], elbow + [x, 0, 0], thick), bar(elbow + [x, 0, 0], head + [x, 0, 0], thick)]
        for joint in (foot + [0, 0.02, 0], elbow, head):
            solids.append(bar(joint - [gap + 0.014, 0, 0], joint + [gap + 0.014, 0, 0], 0.04))
    tilt = rng.uniform(-10, 60)
    size = rng.uniform(0.06, 0.11)
    if maybe(rng, 0.25):  # a flat light bar
        return [*solids, box((rng.uniform(0.06, 0.4), 0.025, 0.14), head + [0, 0, 0.02], 0.008)]
    t = np.linspace(0, 1, 6)
    r = size * pick(rng, (np.sqrt(1 - 0.93 * t**2), 1 - 0.7 * t, np.where(t < 0.4, 1.0, 0.45)))
    y = t * 1.5 * size
    shade = revolve(np.concatenate([np.stack([r, y], 1), np.stack([0.9 * r, y - 0.004], 1)[::-1]]), 16, hollow=True)
    bulb = [ellipsoid((0.9 * size, size, 0.9 * size), (0, 0.7 * size, 0), 10, 6)]
    cap = revolve([(0.5 * size, 1.2 * size), (0.4 * size, 1.7 * size)], 12)
    parts = [p.moved(y=-1.5 * size).rotated("x", -tilt) for p in (shade, *bulb, cap)]
    return solids + all_moved(parts, *head)


def _pendant(rng: np.random.Generator) -> list[Solid]:
    """One to five shades hanging from a ceiling rose or rail."""
    drop = rng.uniform(0.25, 0.9)
    count = pick(rng, {1: 4, 2: 1, 3: 1.5, 5: 0.5})
    radius, height = rng.uniform(0.12, 0.32) / (1 if count == 1 else 1.5), rng.uniform(0.12, 0.32)
    if count == 1:
        solids = [slab(ellipse(0.12, 0.12, 16), 0.03).moved(y=drop + height)]
    else:
        length = 2.4 * radius * count
        solids = [box((length, 0.035, 0.07), (0, drop + height + 0.015, 0))]
    state = rng.bit_generator.state
    for k in range(count):  # all shades of the same kind
        rng.bit_generator.state = state
        x = 2.4 * radius * (k - (count - 1) / 2)
        solids += all_moved(_shade(rng, radius, height), x=x)
        solids.append(bar((x, 0.6 * height, 0), (x, drop + height + 0.01, 0), 0.014))
    return solids


def _chandelier(rng: np.random.Generator) -> list[Solid]:
    """Arms around a hanging column, each with a candle, a bowl or a small shade."""
    count, reach = int(rng.integers(3, 9)), rng.uniform(0.25, 0.45)
    drop = rng.uniform(0.3, 0.6)
    swing, rise = rng.uniform(0.02, 0.2), rng.uniform(-0.06, 0.16)
    t = np.linspace(0, 1, 9)
    r = 0.018 + rng.uniform(0.02, 0.05) * np.abs(np.sin(rng.uniform(1, 3) * np.pi * t))
    solids = [revolve(np.stack([r, -0.12 + 0.3 * t], 1), 12), bar((0, 0.1, 0), (0, drop, 0), 0.016)]
    solids.append(slab(ellipse(0.13, 0.13, 16), 0.03).moved(y=drop - 0.01))
    kind = pick(rng, ("candle", "shade", "globe", "bowl"))
    for angle in np.arange(count) * 360.0 / count + 90.0:
        path = rounded_path([(0, 0, 0), (0.5 * reach, -swing, 0), (reach, -swing * 0.5, 0), (reach, rise, 0)], 0.15, 4)
        parts = [tube(path, 0.009)]
        if kind == "globe":
            parts.append(ellipsoid((0.12, 0.12, 0.12), (reach, rise + 0.05, 0), 12, 8))
        else:
            parts.append(
                revolve([(0.012, 0), (0.045, 0.01), (0.045, 0.02), (0.012, 0.022)], 10).moved(reach, rise - 0.01)
            )
            parts.append(bar((reach, rise, 0), (reach, rise + 0.1, 0), 0.026))
        if kind in ("shade", "bowl"):
            cone = [(0.075, 0.0), (0.045, 0.1), (0.04, 0.1), (0.068, 0.0)]
            cone = cone if kind == "shade" else [(0.03, 0.0), (0.085, 0.09), (0.078, 0.09), (0.024, 0.01)]
            level = rise + (0.05 if kind == "shade" else 0.0)
            parts.append(revolve(cone, 12, hollow=True).moved(reach, level))
            parts.append(bar((reach - 0.055, level + 0.06, 0), (reach + 0.055, level + 0.06, 0), 0.012))
        solids += [part.rotated("y", angle) for part in parts]
    if maybe(rng, 0.4):
        turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        ring = np.stack([reach * np.cos(turn), np.full(24, rise - 0.01), reach * np.sin(turn)], 1)
        solids.append(tube(ring, 0.012, closed=True))
    return solids


def _lantern(rng: np.random.Generator) -> list[Solid]:
    """A cage of bars with a roof around a candle; standing, hanging from a ring or on a tall."""
    half, height = rng.uniform(0.08, 0.13), rng.uniform(0.2, 0.36)
    count = pick(rng, (4, 4, 6, 8))
    angles = np.arange(count) * 2 * np.pi / count + np.pi / count
    flat = ellipse(2.2 * half, 2.2 * half, count) @ np.array(
        [[np.cos(np.pi / count), np.sin(np.pi / count)], [-np.sin(np.pi / count), np.cos(np.pi / count)]]
    )
    taper = rng.uniform(0.7, 1.1)
    solids = [slab(taper * flat, 0.025)]
    solids.append(slab(flat, 0.02).moved(y=height - 0.01))
    for a in angles:
        foot = (taper * half * np.cos(a), 0.01, taper * half * np.sin(a))
        solids.append(bar(foot, (half * np.cos(a), height, half * np.sin(a)), 0.014))
    roof = revolve(
        [(1.15 * half, 0), (1.1 * half, 0.01), (0.3 * half, rng.uniform(0.04, 0.12)), (0.2 * half, 0.13)], count
    )
    solids.append(roof.rotated("y", 180.0 / count).moved(y=height))
    solids.append(revolve([(0.03, 0.02), (0.03, 0.55 * height), (0.008, 0.62 * height)], 12))
    top = height + 0.12
    if maybe(rng, 0.4):
        tall = rng.uniform(0.7, 1.6)
        stand = [
            bar((0, -tall, 0), (0, 0.01, 0), 0.05),
            revolve([(0.11, -tall), (0.1, 0.05 - tall), (0.03, 0.1 - tall)], 16),
        ]
        return solids + stand + [ellipsoid((0.05, 0.06, 0.05), (0, top + 0.02, 0), 10, 6)]
    turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = np.stack([0.05 * np.cos(turn), top + 0.045 + 0.05 * np.sin(turn), 0 * turn], 1)
    return [*solids, tube(ring, 0.007, closed=True)]
