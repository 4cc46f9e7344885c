"""Backs of chairs, in metres, upright in the plane z = 0 from y = 0: frames and their fillings, plates, pads, hoops."""

from __future__ import annotations

import numpy as np

from learn3d.make_data.shapes.parts import (
    Solid,
    bar,
    between,
    both_sides,
    ellipse,
    post,
    rectangle,
    rounded_path,
    sheet,
    tube,
)
from learn3d.make_data.shapes.sampling import maybe, pick


def back_parts(
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


def _bow(x: np.ndarray, half: float, curve: float) -> np.ndarray:
    """z of a back that is bent towards the sitter: `curve` at the stiles (x = half), zero in the middle."""
    return curve * (np.abs(x) / half) ** 2


def _rail(half: float, y: float, height: float, thickness: float, curve: float, arch: float = 0.0) -> Solid:
    """A horizontal board between the stiles, following the bow of the back, its middle lifted by `arch`."""
    x = np.linspace(-half, half, 9)
    path = np.stack([x, y + arch * (1 - (x / half) ** 2), _bow(x, half, curve)], 1)
    return tube(path, 1.0, rectangle(thickness, height, segments=1))


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
