"""Procedural tables, in metres: tops of many outlines on legs, pedestals, trestles or frames; and one-piece tables."""

from __future__ import annotations

import numpy as np
import trimesh

from learn3d.make_data.shapes import supports
from learn3d.make_data.shapes.parts import (
    Solid,
    assemble,
    bar,
    between,
    both_sides,
    ellipse,
    inset,
    post,
    rectangle,
    revolve,
    rounded_path,
    sheet,
    slab,
    tube,
)
from learn3d.make_data.shapes.sampling import maybe, pick
from learn3d.make_data.shapes.table_bodies import bent_table, desk, drum_table


def make_table(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random table."""
    family = pick(
        rng, {"legs": 3.5, "pedestal": 2.5, "trestle": 1.5, "desk": 2, "frame": 1.5, "bent": 0.6, "drum": 0.6}
    )
    family_maker = {"desk": desk, "bent": bent_table, "drum": drum_table}.get(family)
    if family_maker:
        return assemble(family_maker(rng))
    use = pick(rng, {"dining": 4, "coffee": 3, "side": 1.5, "bar": 1, "console": 1})
    length, ratio, height = {
        "dining": (rng.uniform(0.9, 2.4), rng.uniform(0.42, 0.85), rng.uniform(0.7, 0.78)),
        "coffee": (rng.uniform(0.7, 1.4), rng.uniform(0.45, 1.0), rng.uniform(0.32, 0.48)),
        "side": (rng.uniform(0.4, 0.6), rng.uniform(0.7, 1.0), rng.uniform(0.45, 0.7)),
        "bar": (rng.uniform(0.6, 1.3), rng.uniform(0.5, 1.0), rng.uniform(0.9, 1.1)),
        "console": (rng.uniform(0.9, 1.5), rng.uniform(0.25, 0.36), rng.uniform(0.72, 0.9)),
    }[use]
    outline, length, width, reach = _outline(rng, length, ratio, use, family)
    thickness = rng.uniform(0.018, 0.07)
    solids = _top(rng, outline, thickness, height)
    under = height - thickness
    half_x, half_z = reach * length / 2, reach * width / 2
    if family == "legs":
        solids += _legs(rng, half_x, half_z, under)
    elif family == "pedestal":
        solids += _pedestals(rng, length, width, under)
    elif family == "trestle":
        solids += _trestles(rng, half_x * rng.uniform(0.65, 0.95), half_z, under)
    else:
        solids += _frames(rng, half_x, half_z, under)
    return assemble(solids)


def _outline(
    rng: np.random.Generator, length: float, ratio: float, use: str, family: str
) -> tuple[np.ndarray, float, float, float]:
    """A top's outline [N, 2], its length and width, and how far out (0..1) the legs may stand."""
    kinds = {"rectangle": 4.0, "rounded": 1.5, "circle": 1.5, "oval": 0.8, "super": 1.0, "polygon": 0.7, "boat": 0.5}
    if family == "pedestal":
        kinds |= {"circle": 5.0, "rectangle": 1.5, "polygon": 1.5}
    if use == "console":
        kinds = {"rectangle": 3.0, "half": 1.5, "rounded": 1.0}
    kind = pick(rng, kinds)
    if kind in ("circle", "polygon") or (kind in ("rectangle", "super") and maybe(rng, 0.25)):
        length, ratio = min(length, 1.5), 1.0
    width = length * ratio
    if kind == "rectangle":
        return rectangle(length, width, rng.uniform(0.004, 0.02), 1), length, width, 0.95
    if kind == "rounded":
        return rectangle(length, width, rng.uniform(0.1, 0.45) * width, 4), length, width, 0.85
    if kind == "super":
        return ellipse(length, width, 32, rng.uniform(2.6, 5.0)), length, width, 0.74
    if kind == "polygon":
        count = int(pick(rng, (6, 8, 8, 12)))
        return ellipse(length, length, count), length, length, 0.62
    if kind == "boat":  # sides bulge, ends straight
        x = np.concatenate([np.linspace(1, -1, 11), np.linspace(-1, 1, 11)]) * length / 2
        bulge = 1 - rng.uniform(0.15, 0.4) * (2 * x / length) ** 2
        z = np.repeat([1.0, -1.0], 11) * width / 2 * bulge
        return np.stack([x, z], 1), length, width, 0.75
    if kind == "half":
        angle = np.linspace(0, np.pi, 20)
        outline = np.stack([length / 2 * np.cos(angle), width * np.sin(angle) ** 0.8 - width / 2], 1)
        return outline, length, width, 0.6
    return ellipse(length, width, 32), length, width, 0.64


def _top(rng: np.random.Generator, outline: np.ndarray, thickness: float, height: float) -> list[Solid]:
    """A table top, plain or with a profiled edge or made of planks, its upper side at `height`."""
    bevel = pick(rng, (0.1, 0.2, 0.45)) * thickness
    solids = [slab(outline, thickness, bevel).moved(y=height - thickness)]
    if maybe(rng, 0.15):
        solids.append(slab(inset(outline, 0.03), 0.02).moved(y=height - thickness - 0.018))
    return solids


def _legs(rng: np.random.Generator, half_x: float, half_z: float, under: float) -> list[Solid]:
    """Four legs at the corners, perhaps with an apron of drawers and a lower shelf."""
    size = rng.uniform(0.035, 0.11) * (0.5 + 0.7 * half_x)
    inset_x, inset_z = half_x - 0.6 * size - 0.01, half_z - 0.6 * size - 0.01
    solids = supports.four_legs(rng, inset_x, inset_z, under, size, shelf=maybe(rng, 0.3))
    if maybe(rng, 0.5):
        depth = rng.uniform(0.05, 0.16)
        solids += supports.apron(inset_x, inset_z, under, depth, 0.4 * size)
        if depth > 0.1:
            count = int(rng.integers(1, 4))
            for k in range(count):
                x = (2 * (k + 0.5) / count - 1) * inset_x
                front = inset_z + 0.2 * size
                half = 0.8 * inset_x / count
                solids.append(
                    between((x - half, under - depth + 0.015, front - 0.01), (x + half, under - 0.015, front + 0.012))
                )
                solids.append(bar((x, under - depth / 2, front), (x, under - depth / 2, front + 0.03), 0.02))
    return solids


def _pedestals(rng: np.random.Generator, length: float, width: float, under: float) -> list[Solid]:
    """One central pedestal, or two under a long top."""
    reach = rng.uniform(0.5, 0.85) * width / 2
    kind = pick(rng, ("disc", "claw", "claw", "star", "cross", "block", "cone", "flare"))
    places = [0.0]
    if length > 1.35 * width:
        reach = min(reach, 0.22 * length)
        places = [-0.27 * length, 0.27 * length]
    unit = _pedestal(rng, kind, reach, under)
    solids = [part.moved(x=x) for x in places for part in unit]
    if len(places) == 2 and maybe(rng, 0.5):
        y = rng.uniform(0.12, 0.5) * under
        solids.append(bar((places[0], y, 0), (places[1], y, 0), 0.05, 0.07))
    return solids


def _pedestal(rng: np.random.Generator, kind: str, reach: float, under: float) -> list[Solid]:
    """A pedestal of the given kind about the y axis."""
    if kind == "disc":
        return supports.disc_pedestal(rng, 1.1 * reach, 1.1 * reach, under)
    if kind == "star":
        return supports.star_pedestal(rng, 0.9 * reach, 0.9 * reach, under)
    thick = rng.uniform(0.03, 0.06) * (0.6 + reach)
    if kind == "cone":
        top = rng.uniform(0.3, 0.9)
        return [
            revolve([(reach, 0), (reach, 0.015), (top * 0.5 * reach, under * 0.5), (top * reach, under + 0.005)], 24)
        ]
    if kind == "flare":  # an hourglass
        t = np.linspace(0, 1, 11)
        waist, at = rng.uniform(0.2, 0.5), rng.uniform(0.4, 0.65)
        scale = waist + (1 - waist) * np.where(t < at, 1 - t / at, (t - at) / (1 - at)) ** 2
        return [revolve(np.stack([reach * scale, t * (under + 0.005)], 1), pick(rng, (6, 8, 24)))]
    if kind == "block":
        foot = slab(rectangle(1.8 * reach, 1.8 * reach), rng.uniform(0.03, 0.08))
        w = rng.uniform(0.25, 0.9) * reach
        return [foot, between((-w / 2, 0.02, -w / 2), (w / 2, under + 0.005, w / 2))]
    plate = slab(ellipse(reach, reach, 16), 0.03).moved(y=under - 0.025)
    if kind == "cross":
        solids = [between((-thick, 0.02, -thick), (thick, under + 0.003, thick)), plate]
        for a in (45, 135) if maybe(rng, 0.5) else (0, 90):
            solids.append(bar((-reach, 0.03, 0), (reach, 0.03, 0), 1.4 * thick, 0.058).rotated("y", a))
            solids.append(
                bar((-0.8 * reach, under - 0.02, 0), (0.8 * reach, under - 0.02, 0), 1.4 * thick, 0.04).rotated("y", a)
            )
        return solids
    # claw: a turned column on three or four curved feet
    low = rng.uniform(0.12, 0.3) * under
    s = rng.uniform(0.9, 1.6)
    profile = [
        (0.5, 0.6),
        (0.9, 0.75),
        (1.3, 1.1),
        (1.2, 1.6),
        (0.7, 2.1),
        (0.65, 2.9),
        (1.05, 3.4),
        (0.75, 3.8),
        (1.2, 4),
    ]
    column = revolve([(s * thick * r, 0.5 * low + (y - 0.6) / 3.4 * (under - 0.5 * low)) for r, y in profile], 14)
    solids = [column, plate]
    count = int(pick(rng, (3, 4)))
    for k in range(count):
        angle = 2 * np.pi * (k + 0.5) / count + np.pi / 2
        way = np.array([np.cos(angle), 0, np.sin(angle)])
        path = [
            way * thick * 0.4 + [0, 1.2 * low, 0],
            way * 0.45 * reach + [0, low * 1.1, 0],
            way * 0.75 * reach + [0, 0.1 * low, 0],
        ]
        path = rounded_path([*path, way * reach + [0, 0.025, 0]], 0.2, 4)
        section = rectangle(1.1 * thick, 1.3 * thick, segments=1)
        solids.append(tube(path, np.linspace(1.2, 0.7, len(path)), section, side=np.cross(way, (0, 1, 0))))
    return solids


def _trestles(rng: np.random.Generator, half_x: float, half_z: float, under: float) -> list[Solid]:
    """Two trestles (A, X, T, U or turned pairs) joined by a beam."""
    kind = pick(rng, ("A", "X", "T", "V", "pair", "board"))
    size = rng.uniform(0.035, 0.08)
    deep = 0.85 * half_z
    lean = rng.uniform(0, 0.12) * under if maybe(rng, 0.4) else 0.0
    beam_y = rng.uniform(0.2, 0.75) * under
    low, high = 0.012, under + 0.004
    top = between((half_x - 0.6 * size, under - size, -deep), (half_x + 0.6 * size, high, deep))
    side: list[Solid] = [top]
    x, foot_x = half_x, half_x + lean
    if kind in ("A", "V"):
        wide, narrow = (deep, 0.25 * deep) if kind == "A" else (0.3 * deep, 0.85 * deep)
        for s in (-1, 1):
            side.append(bar((foot_x, low, s * wide), (x, under - 0.2 * size, s * narrow), size, size, side=(1, 0, 0)))
        t = beam_y / under
        z = wide + t * (narrow - wide)
        side.append(bar((foot_x - t * lean, beam_y, -z), (foot_x - t * lean, beam_y, z), 0.8 * size, size))
        if kind == "V":
            side.append(between((foot_x - size / 2, 0, -deep * 0.7), (foot_x + size / 2, 0.05, deep * 0.7)))
    elif kind == "X":
        for s in (-1, 1):
            start = (foot_x, low, s * deep)
            side.append(
                bar(start, (x, under - 0.2 * size, -s * 0.9 * deep), size * (1 + 0.1 * s), size, side=(1, 0, 0))
            )
        beam_y = under / 2
    elif kind == "T":
        side.append(between((x - size / 2, 0.02, -0.9 * size), (x + size / 2, under - 0.2 * size, 0.9 * size)))
        side.append(between((x - 0.7 * size, 0, -deep), (x + 0.7 * size, 0.06, deep)))
        if maybe(rng, 0.5):
            for s in (-1, 1):
                brace = bar((x, 0.6 * under, 0), (x, under - 0.3 * size, 0.7 * s * deep), 0.7 * size, 0.7 * size)
                side.append(brace)
    elif kind == "pair":
        profile, turned = supports.leg_profile(rng)
        outline = ellipse(1.2 * size, 1.2 * size, 10) if turned else rectangle(size, size, segments=1)
        for s in (-1, 1):
            side.append(post((x, 0.03, s * 0.5 * deep), (x, under, s * 0.5 * deep), outline, profile))
        side.append(between((x - 0.7 * size, 0, -deep), (x + 0.7 * size, 0.06, deep)))
        side.append(between((x - 0.4 * size, beam_y - 0.04, -0.5 * deep), (x + 0.4 * size, beam_y + 0.04, 0.5 * deep)))
    else:
        waist = rng.uniform(0.4, 0.9)
        t = np.linspace(0, 1, 9)[:, None]
        wide = deep * (waist + (1 - waist) * (2 * t - 1) ** 2)
        z = np.linspace(-1, 1, 5)[None] * wide
        side.append(sheet(np.stack([np.full_like(z, x), t * under + 0 * z, z], 2), 0.7 * size))
    solids = [piece for part in side for piece in both_sides(part)]
    t = beam_y / under
    reach = half_x + (1 - t) * lean if kind in ("A", "V", "X") else half_x
    return [*solids, bar((-reach, beam_y, 0), (reach, beam_y, 0), 0.8 * size, 1.3 * size)]


def _frames(rng: np.random.Generator, half_x: float, half_z: float, under: float) -> list[Solid]:
    """Legs of metal or board: closed loops, panels, crossed or hairpin legs."""
    kind = pick(rng, {"loops": 2, "panels": 1.5, "cross": 1, "ends": 1.5})
    if kind != "ends":
        return supports.base(rng, kind, 0.9 * half_x, 0.9 * half_z, under)
    size = rng.uniform(0.03, 0.06)  # loops across the table: one at each end
    top, foot = 0.85 * half_z, rng.uniform(0.6, 1.0) * 0.85 * half_z
    x = rng.uniform(0.6, 0.92) * half_x
    lean = rng.uniform(-0.12, 0.12)
    low, high = size / 2, under - 0.3 * size
    corners = [(x + lean, low, foot), (x, high, top), (x, high, -top), (x + lean, low, -foot)]
    section = rectangle(size, pick(rng, (1.0, 1.8)) * size, segments=1)
    frame = tube(rounded_path(corners, 0.015, 2, closed=True), 1.0, section, closed=True, side=(1, 0, 0))
    solids = both_sides(frame)
    return [*solids, bar((-x, high, 0), (x, high, 0), size)] if maybe(rng, 0.5) else solids
