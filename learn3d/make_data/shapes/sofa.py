"""Procedural sofas, in metres: upholstered blocks, framed settees, chesterfields, corner sofas, chaises, daybeds."""

from __future__ import annotations

import numpy as np
import trimesh

from learn3d.make_data.shapes import supports
from learn3d.make_data.shapes.parts import Solid, assemble, bar, between, both_sides, ellipse, rectangle, sheet, slab
from learn3d.make_data.shapes.sampling import maybe, pick


def make_sofa(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random sofa."""
    maker = pick(rng, {_block_sofa: 4.0, _corner_sofa: 1.5, _settee: 1.6, _curved_sofa: 1.0, _daybed: 0.8})
    return assemble(maker(rng))


def _block_sofa(rng: np.random.Generator) -> list[Solid]:
    """One to four seats between upholstered arms; arms, cushions, feet and back of many kinds."""
    seats = pick(rng, {2: 3, 3: 4, 4: 1})
    width, depth = seats * rng.uniform(0.55, 0.72), rng.uniform(0.75, 1.0)
    seat = rng.uniform(0.36, 0.46)
    foot = rng.uniform(0.0, 0.16)
    soft = rng.uniform(0.02, 0.06)
    back, back_height = rng.uniform(0.12, 0.22), rng.uniform(0.66, 0.95)
    half, rear, front = width / 2, -depth / 2, depth / 2
    split = seat - rng.uniform(0.1, 0.17)
    solids = [between((-half, foot, rear), (half, split + 0.005, front - 0.03), 0.02)]
    solids += _back(rng, half, rear, back, split, back_height, seats, soft)
    arms = pick(rng, {"box": 3, "rolled": 2, "sloped": 1.5, "low": 1, "none": 0.7})
    if arms != "none":
        solids += _arms(
            rng, arms, half, rear, front, foot, seat, min(back_height - 0.03, rng.uniform(0.52, 0.68)), soft
        )
    solids += _cushions(rng, half, rear + 0.7 * back, front, split, seat, seats if maybe(rng, 0.75) else 1, soft)
    if foot > 0.04:
        solids += supports.feet(rng, half - 0.08, front - 0.09, foot + 0.015)
    if maybe(rng, 0.3):
        solids += _pillows(rng, half, rear + back, seat)
    return solids


def _back(
    rng: np.random.Generator, half: float, rear: float, back: float, low: float, high: float, seats: int, soft: float
) -> list[Solid]:
    """A straight, camel-humped or cushioned back."""
    lean = rng.uniform(0, 12)
    kind = pick(rng, ("plain", "cushions", "camel", "cushions"))
    pivot = (0, low, rear + back)
    if kind == "camel":
        x = np.linspace(-half, half, 21)
        hump = rng.uniform(0.06, 0.2) * np.cos(np.pi * x / (2 * half)) ** 2
        y = np.stack([np.full(21, low - 0.1), np.full(21, 0.5 * (low + high)), high - 0.1 + hump])
        grid = np.stack([np.broadcast_to(x, y.shape), y, np.full_like(y, rear + back / 2)], 2)
        return [sheet(grid, back).rotated("x", -lean / 2, pivot)]
    shell = between((-half, low - 0.1, rear), (half, high, rear + (0.5 if kind == "cushions" else 1) * back), soft)
    solids = [shell.rotated("x", -lean / 2, pivot)]
    if kind == "cushions":
        top = high + rng.uniform(-0.08, 0.08)
        each = 2 * half / seats
        for k in range(seats):
            x = -half + k * each
            lower, upper = (x + 0.01, low + 0.05, rear + 0.4 * back), (x + each - 0.01, top, rear + 1.15 * back)
            solids.append(between(lower, upper, 0.05).rotated("x", -lean, pivot))
    return solids


def _cushions(
    rng: np.random.Generator, half: float, rear: float, front: float, low: float, high: float, count: int, soft: float
) -> list[Solid]:
    """Seat cushions side by side."""
    each, gap = 2 * half / count, rng.uniform(0.004, 0.012)
    return [
        between((-half + k * each + gap, low, rear), (-half + (k + 1) * each - gap, high, front), soft)
        for k in range(count)
    ]


def _arms(
    rng: np.random.Generator,
    kind: str,
    half: float,
    rear: float,
    front: float,
    foot: float,
    seat: float,
    high: float,
    soft: float,
) -> list[Solid]:
    """A pair of arms outside x = +-half."""
    wide = rng.uniform(0.1, 0.24)
    if kind == "low":
        high = seat + 0.06
    if kind == "sloped":
        outline = rectangle(wide, 1.0, 0.03, 3)
        rings = []
        for z, top in ((front - 0.02, high - rng.uniform(0.02, 0.1)), (rear + 0.02, high + 0.06)):
            y = foot + (outline[:, 1] + 0.5) * (top - foot)
            rings.append(np.stack([half + wide / 2 - 0.005 + outline[:, 0], y, np.full(len(y), z)], 1))
        return both_sides(Solid(np.stack(rings)))
    solids = both_sides(between((half - 0.01, foot, rear), (half + wide, high, front - 0.01), soft))
    if kind == "rolled":
        x, radius = half + 0.5 * wide, 1.3 * wide
        roll = [(x, high - 0.05, z) for z in (rear + 0.02, front)]
        solids += both_sides(bar(*roll, radius, radius))
    return solids


def _pillows(rng: np.random.Generator, half: float, rear: float, seat: float) -> list[Solid]:
    """One to three loose pillows leaning on the back."""
    solids = []
    for x in rng.uniform(-0.75, 0.75, int(rng.integers(1, 4))) * half:
        size = rng.uniform(0.28, 0.4)
        lower, upper = (x - size / 2, seat - 0.01, rear), (x + size / 2, seat + 0.8 * size, rear + 0.13)
        solids.append(between(lower, upper, 0.05).rotated("x", -15, (x, seat, rear)))
    return solids


def _corner_sofa(rng: np.random.Generator) -> list[Solid]:
    """An L-shaped sofa: a long side along x and a chaise or a second side towards +z, left or right."""
    width, depth, reach = rng.uniform(2.1, 3.0), rng.uniform(0.8, 0.98), rng.uniform(1.4, 2.3)
    seat, foot, back, high = (
        rng.uniform(0.38, 0.44),
        rng.uniform(0.03, 0.12),
        rng.uniform(0.16, 0.24),
        rng.uniform(0.7, 0.9),
    )
    soft, arm = rng.uniform(0.03, 0.06), rng.uniform(0.1, 0.2)
    split, half = seat - 0.14, width / 2
    wing = rng.uniform(0.75, 0.95)
    chaise = maybe(rng, 0.5)  # its side is open; else the back goes around the corner
    solids = [
        between((-half, foot, 0), (half, split + 0.005, depth), 0.02),
        between((half - wing, foot, 0.3), (half, split + 0.005, reach), 0.02),
        between((-half, split - 0.08, 0), (half, high, back), soft),
        between((half - wing + 0.01, split, depth - 0.2), (half - 0.005, seat, reach), soft),
    ]
    end = half - back if not chaise else half
    solids.append(between((end - wing + 0.02, split, back - 0.05), (end, seat, depth - 0.19), soft))
    count = int(rng.integers(2, 4))
    each = (width - wing) / count
    for k in range(count):
        x = -half + k * each
        solids.append(between((x + 0.008, split, back - 0.05), (x + each - 0.008, seat, depth), soft))
        if maybe(rng, 0.8):
            solids.append(
                between((x + 0.012, seat - 0.02, back - 0.06), (x + each - 0.012, high + 0.03, back + 0.14), 0.05)
            )
    level = rng.uniform(0.52, high - 0.04)
    if chaise:
        solids.append(between((half - 0.01, foot, 0), (half + arm, level, depth), soft))
    else:
        solids.append(between((half - back, split - 0.08, 0), (half, high, reach), soft))
        solids.append(between((half - wing, foot, reach - 0.01), (half, level, reach + arm), soft))
    if maybe(rng, 0.8):
        solids.append(between((-half - arm, foot, 0), (-half + 0.01, level, depth), soft))
    for x, z in ((-half, 0), (-half, depth), (half, 0), (half, reach), (half - wing, reach)):
        inside = (x - np.sign(x - half + 0.5 * wing) * 0.08, z + (0.08 if z == 0 else -0.08))
        solids.append(slab(ellipse(0.08, 0.08, 10), foot + 0.02).moved(x=inside[0], z=inside[1]))
    side = pick(rng, (1.0, -1.0))
    return [solid.scaled(x=side) for solid in solids]


def _settee(rng: np.random.Generator) -> list[Solid]:
    """A framed settee: cushions on an open frame of wood or metal."""
    seats = pick(rng, {2: 3, 3: 2})
    half, depth = seats * rng.uniform(0.26, 0.34), rng.uniform(0.62, 0.82)
    seat, high, arm = rng.uniform(0.38, 0.46), rng.uniform(0.72, 0.95), rng.uniform(0.56, 0.66)
    size = rng.uniform(0.03, 0.06)
    rear, front = -depth / 2, depth / 2
    cushion = rng.uniform(0.08, 0.15)
    low = seat - cushion
    kind = pick(rng, {"legs": 3, "loops": 2, "panels": 1, "cross": 0.7})
    solids = supports.base(rng, kind, half - 0.02, 0.85 * front, low)
    solids.append(between((-half, low - 0.05, rear + 0.03), (half, low + 0.01, front - 0.03), 0.01))
    solids += _cushions(rng, half - 0.01, rear + 0.04, front, low, seat, seats, 0.04)
    lean = rng.uniform(5, 16)
    hinge = (0, low, rear + 0.06)
    frame = [bar((x, low - 0.04, rear + 0.04), (x, high, rear + 0.04), size, size) for x in (-half + 0.03, half - 0.03)]
    frame.append(bar((-half, high - 0.02, rear + 0.04), (half, high - 0.02, rear + 0.04), size, 1.3 * size))
    if maybe(rng, 0.55):
        frame += _cushions(rng, half - 0.02, rear + 0.04, rear + 0.17, seat - 0.04, high + 0.03, seats, 0.045)
    else:
        for x in np.linspace(-half + 0.03, half - 0.03, int(rng.integers(5, 12)) + 2)[1:-1]:
            frame.append(bar((x, low - 0.02, rear + 0.04), (x, high, rear + 0.04), 0.4 * size, 0.8 * size))
    solids += [part.rotated("x", -lean, hinge) for part in frame]
    if maybe(rng, 0.75):
        back_z = rear + 0.04 - np.tan(np.radians(lean)) * (arm - low)
        rest = bar((half - 0.02, arm, back_z), (half - 0.02, arm, front - 0.03), 1.6 * size, 0.8 * size, side=(1, 0, 0))
        solids += both_sides(rest)
        for z in (front - 0.08, 0.0) if maybe(rng, 0.4) else (front - 0.08,):
            solids += both_sides(bar((half - 0.02, low - 0.03, z), (half - 0.02, arm, z), size, size))
    return solids


def _curved_sofa(rng: np.random.Generator) -> list[Solid]:
    """A sofa on an arc, or a tub sofa whose back runs around into the arms."""
    half, depth, seat = rng.uniform(0.7, 1.25), rng.uniform(0.75, 0.95), rng.uniform(0.36, 0.44)
    foot, high, thick = rng.uniform(0.03, 0.14), rng.uniform(0.66, 0.85), rng.uniform(0.1, 0.2)
    turn = np.radians(rng.uniform(50, 88))
    angle = np.linspace(-turn, turn, 31)
    exponent = rng.uniform(0.5, 1.0)
    sine, cosine = np.sin(angle) / np.sin(turn), (np.cos(angle) - np.cos(turn)) / (1 - np.cos(turn))
    x = (half - thick / 2) * np.sign(sine) * np.abs(sine) ** exponent
    z = -depth / 2 + thick / 2 + (depth - thick) * (1 - cosine)
    fall = rng.uniform(0, 0.25) * (1 - cosine)
    t = np.linspace(0, 1, 4)[:, None]
    y = foot + t * (high - fall - foot)
    wrap = sheet(np.stack([np.broadcast_to(x, y.shape), y, np.broadcast_to(z, y.shape)], 2), thick)
    ring = np.stack([x, z], 1)[::-1]
    front = np.stack([np.linspace(x[0], x[-1], 9)[1:-1], np.full(7, z[0])], 1)
    bulge = rng.uniform(-0.1, 0.2) * (1 - (front[:, 0] / x[0]) ** 2)
    front[:, 1] += bulge
    outline = np.concatenate([ring, front])
    area = np.sum(outline[:, 0] * np.roll(outline[:, 1], -1) - outline[:, 1] * np.roll(outline[:, 0], -1))
    outline = outline if area > 0 else outline[::-1]
    solids = [wrap, slab(outline, seat - foot, 0.04).moved(y=foot)]
    solids += supports.feet(rng, 0.6 * half, 0.22 * depth, foot + 0.02)
    return solids + (_pillows(rng, 0.7 * half, -depth / 2 + thick, seat) if maybe(rng, 0.4) else [])


def _daybed(rng: np.random.Generator) -> list[Solid]:
    """A chaise longue or daybed: a long mattress with one raised end, perhaps a partial back."""
    half, depth, seat = rng.uniform(0.8, 1.0), rng.uniform(0.6, 0.85), rng.uniform(0.34, 0.45)
    thick, high = rng.uniform(0.1, 0.18), rng.uniform(0.6, 0.85)
    low = seat - thick
    kind = pick(rng, {"legs": 3, "loops": 1, "panels": 1})
    solids = supports.base(rng, kind, 0.88 * half, 0.4 * depth, low)
    solids.append(between((-half, low - 0.04, -depth / 2), (half, low + 0.01, depth / 2), 0.01))
    solids.append(between((-half + 0.01, low, -depth / 2 + 0.01), (half - 0.01, seat, depth / 2 - 0.01), 0.04))
    t = np.linspace(0, 1, 8)[:, None]
    flare = rng.uniform(0.05, 0.3)
    z = np.linspace(-1, 1, 5)[None] * (depth / 2 - 0.02)
    ends = [(1, high)] + ([(-1, rng.uniform(seat + 0.1, high))] if maybe(rng, 0.5) else [])
    for side, top in ends:
        x = side * (half - 0.06 + flare * t**2) + 0 * z
        end = np.stack([x, low + t * (top - low) + 0 * z, z + 0 * t], 2)
        solids.append(sheet(end, rng.uniform(0.06, 0.12)))
        if maybe(rng, 0.4):
            roll = [(side * (half - 0.06 + flare), top, s * depth / 2) for s in (-1, 1)]
            solids.append(bar(*roll, 0.14, 0.14))
    if maybe(rng, 0.5):
        x = np.linspace(half - 0.05, -half * rng.uniform(-0.2, 1.0), 12)
        top = high - (high - seat - 0.02) * np.linspace(0, 1, 12) ** rng.uniform(1.0, 3.0)
        y = np.stack([np.full(12, low - 0.02), top])
        solids.append(sheet(np.stack([np.broadcast_to(x, y.shape), y, np.full_like(y, -depth / 2 + 0.04)], 2), 0.08))
    side = pick(rng, (1.0, -1.0))
    return [solid.scaled(x=side) for solid in solids]
