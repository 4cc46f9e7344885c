"""Car bodies, in metres: one loft from front to rear with cut wheel arches, and the wheels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from learn3d.make_data.shapes.parts import Solid, revolve, rounded_path


@dataclass(frozen=True)
class Body:
    """The measures of a car body; lengthwise positions run from the front bumper (0) to the rear (length)."""

    length: float
    half: float  # half of the width
    wheel: float  # radius of the wheels
    front_axle: float
    rear_axle: float
    clearance: float  # of the floor over the ground
    nose: float  # height of the front face
    hood: float  # height of the bonnet at its front edge
    cowl: tuple[float, float]  # position and height of the foot of the windscreen
    roof: tuple[float, float, float]  # front end, rear end, height
    rear_glass: tuple[float, float]  # position and height of the foot of the rear window
    tail: float  # height of the rear edge
    belt: tuple[float, float]  # height of the shoulder line at the front and at the rear
    tumble: float = 0.3  # how far the side windows lean inwards per height
    taper: tuple[float, float] = (0.2, 0.12)  # narrowing at the front and at the rear
    ledge: float = 0.03  # step between shoulder and windows
    open_from: float = 0.0  # an open box (pick-up bed, cabin without a roof) from here ...
    open_to: float = 0.0  # ... to here
    open_floor: float = 0.5  # height of its floor
    tyre: float = 0.22  # width of the wheels
    softness: float = 0.15  # rounding of the side view, metres


def hull(body: Body) -> Solid:
    """The body: cross-sections from front to rear, with the wheel arches cut into their lower corners."""
    b = body
    arch = b.wheel + 0.055
    knots = [(0, b.nose), (0.06, 0.4 * b.nose + 0.6 * b.hood), (0.22, b.hood), b.cowl, (b.roof[0], b.roof[2])]
    knots += [((b.roof[0] + b.roof[1]) / 2, b.roof[2] + 0.015), (b.roof[1], b.roof[2] - 0.02)]
    if b.rear_glass[0] < b.length - 0.2:
        knots += [b.rear_glass, (b.length - 0.08, b.tail), (b.length, 0.85 * b.tail)]
    else:
        knots += [b.rear_glass, (b.length, b.tail)]
    line = rounded_path(np.array(knots, dtype=float), b.softness, 2)
    line[:, 0] = np.maximum.accumulate(line[:, 0] + 1e-4 * np.arange(len(line)))
    stations = [line[:, 0], np.linspace(0, b.length, 7)]
    for axle in (b.front_axle, b.rear_axle):
        stations += [axle + arch * np.array([-1.02, 1.02]), axle - arch * 0.999 * np.cos(np.linspace(0, np.pi, 8))]
    if b.open_to > b.open_from:
        stations += [np.array([b.open_from - 0.015, b.open_from + 0.015, b.open_to - 0.015, b.open_to + 0.015])]
    s = np.unique(np.concatenate(stations).round(3))
    s = np.unique(s[(s >= 0) & (s <= line[-1, 0])])
    s = s[np.concatenate([[True], np.diff(s) > 0.004])]

    top = np.interp(s, line[:, 0], line[:, 1])
    from_front, from_rear = s / b.length, 1 - s / b.length
    w = (
        b.half
        * (1 - b.taper[0] * np.clip(1 - from_front / 0.18, 0, 1) ** 2)
        * (1 - b.taper[1] * np.clip(1 - from_rear / 0.15, 0, 1) ** 2)
    )
    floor = b.clearance + 0.12 * np.clip(1 - from_front / 0.08, 0, 1) + 0.15 * np.clip(1 - from_rear / 0.1, 0, 1)
    shoulder = np.minimum(np.interp(s, [0, b.length], b.belt), top - 0.03)
    cut = floor + 0.002
    for axle in (b.front_axle, b.rear_axle):
        inside = np.abs(s - axle) < arch
        rise = b.wheel + np.sqrt(np.maximum(arch**2 - (s - axle) ** 2, 0.0))
        cut = np.where(inside, np.maximum(rise, cut), cut)
    middle = np.maximum(0.55 * floor + 0.45 * shoulder, 0.5 * (cut + shoulder))
    inner = np.full_like(s, b.half - b.tyre - 0.06)
    edge = np.maximum(top - 0.045 - 0.1 * np.clip(top - shoulder - 0.1, 0, 0.3), shoulder + 0.01)
    roof = np.maximum(0.96 * w - b.ledge - b.tumble * (edge - shoulder), 0.45 * w)
    upper = [
        (0.97 * w, shoulder), (0.97 * w - b.ledge, shoulder + 0.006), (roof, edge),
        (0.88 * roof, 0.5 * (edge + top)), (0.6 * roof, top - 0.008), (0.3 * roof, top - 0.002), (0.0 * w, top),
    ]  # fmt: skip
    if b.open_to > b.open_from:
        is_open = (s > b.open_from) & (s < b.open_to)
        rim, well = shoulder + 0.02, np.full_like(s, b.open_floor)
        hump = np.maximum(well + 0.004, np.minimum(cut + 0.03, rim - 0.03))  # the wheel arch seen from inside
        bed = [
            (0.97 * w, shoulder), (0.95 * w - 0.02, rim), (0.92 * w - 0.05, rim - 0.01), (0.9 * w - 0.06, hump),
            (inner - 0.03, hump - 0.001), (inner - 0.032, well), (0.0 * w, well),
        ]  # fmt: skip
        upper = [
            (np.where(is_open, x1, x0), np.where(is_open, y1, y0))
            for (x0, y0), (x1, y1) in zip(upper, bed, strict=True)
        ]
    lower = [(0.0 * s, floor), (inner, floor), (inner, cut), (0.95 * w, cut), (w, middle)]
    half = np.stack([np.stack(point, 1) for point in lower + upper], 1)  # [S, 12, 2]
    ring = np.concatenate([half, half[:, -2:0:-1] * [-1, 1]], 1)
    z = np.broadcast_to((b.length / 2 - s)[:, None, None], (*ring.shape[:2], 1))
    return Solid(np.concatenate([ring, z], 2))


def road_wheel(radius: float, width: float, dish: float) -> Solid:
    """A wheel about the x axis, its hub dished by `dish` (share of the width) on both sides."""
    half = width / 2
    profile = [
        (0.5, dish - 1), (0.62, -0.95), (0.92, -1), (1, -0.7), (1, 0.7), (0.92, 1), (0.62, 0.95), (0.5, 1 - dish),
    ]  # fmt: skip
    return revolve([(radius * r, half * y) for r, y in profile], 16).rotated("z", 90)
