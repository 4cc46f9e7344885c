"""Car bodies, in metres: one loft from front to rear with cut wheel arches, and the wheels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from learn3d.make_data.shapes.parts import Solid, revolve, rounded_path

TYRE = 0.22  # width of the wheels


@dataclass(frozen=True)
class Body:
    """The measures of a car body: in metres, or as shares of the length (0 = front bumper) and of the height."""

    length: float
    width: float
    height: float
    wheel: float  # radius of the wheels, metres
    clearance: float  # of the floor over the ground, metres
    bonnet: float  # its length, a share
    screen: float  # length of the windscreen behind it, a share
    roof: float  # where the roof ends, a share
    window: float  # where the rear window meets the boot, a share
    belt: float  # height of the shoulder line under the windows, a share
    lean: float  # how far the side windows lean inwards per height
    has_bed: bool = False  # an open box behind the cabin

    @property
    def shoulder(self) -> float:
        """Height of the shoulder line in metres; it stays above the wheel arches."""
        return max(self.belt * self.height, 2 * self.wheel + 0.15)

    @property
    def axles(self) -> tuple[float, float]:
        """Distance of the front and of the rear axle from the front bumper, in metres."""
        return self.wheel + 0.48, self.length - self.wheel - 0.44


def hull(body: Body) -> Solid:
    """The body: cross-sections from front to rear, with the wheel arches cut into their lower corners."""
    length, half, belt = body.length, body.width / 2, body.shoulder
    cabin = np.array([body.bonnet, body.bonnet + body.screen, body.roof]) * length
    glass = min(body.window * length, length - 0.12)
    side_view = [(0, 0.75 * belt), (0.06, 0.9 * belt), (0.22, belt), (cabin[0], belt + 0.08), (cabin[1], body.height)]
    side_view += [((cabin[1] + cabin[2]) / 2, body.height + 0.015), (cabin[2], body.height - 0.02)]
    side_view += [(glass, belt + 0.07), (length - 0.08, belt + 0.04), (length, 0.85 * belt)]
    line = rounded_path(side_view, 0.12, 2)
    line[:, 0] = np.maximum.accumulate(line[:, 0] + 1e-4 * np.arange(len(line)))
    bed = (glass + 0.06, length - 0.08) if body.has_bed else (length, length)  # from, to; empty without a bed
    arch = body.wheel + 0.055  # radius of the wheel arches
    around_wheel = arch * np.append([-1.02, 1.02], 0.999 * np.cos(np.linspace(0, np.pi, 8)))
    at_bed = [end + side for end in bed for side in (-0.015, 0.015)]
    s = np.concatenate([line[:, 0], np.linspace(0, length, 7), *(axle + around_wheel for axle in body.axles), at_bed])
    s = np.unique(s[(s >= 0) & (s <= length)].round(3))
    s = s[np.append(True, np.diff(s) > 0.004)]  # [S] distances of the cross-sections from the front bumper

    top = np.interp(s, line[:, 0], line[:, 1])
    to_front, to_rear = s / length, 1 - s / length
    side = half * (1 - 0.15 * np.clip(1 - to_front / 0.18, 0, 1) ** 2)
    side = side * (1 - 0.06 * np.clip(1 - to_rear / 0.15, 0, 1) ** 2)
    floor = body.clearance + 0.12 * np.clip(1 - to_front / 0.08, 0, 1) + 0.15 * np.clip(1 - to_rear / 0.1, 0, 1)
    shoulder = np.minimum(belt, top - 0.03)
    cut = floor + 0.002
    for axle in body.axles:
        rise = body.wheel + np.sqrt(np.maximum(arch**2 - (s - axle) ** 2, 0.0))
        cut = np.where(np.abs(s - axle) < arch, np.maximum(rise, cut), cut)
    middle = np.maximum(0.55 * floor + 0.45 * shoulder, 0.5 * (cut + shoulder))
    inner = np.full_like(s, half - TYRE - 0.06)
    edge = np.maximum(top - 0.045 - 0.1 * np.clip(top - shoulder - 0.1, 0, 0.3), shoulder + 0.01)
    roof = np.maximum(0.96 * side - 0.03 - body.lean * (edge - shoulder), 0.45 * side)

    # The right half of each cross-section: points (x, y) from the middle of the floor outwards and up to the middle.
    zero = np.zeros_like(s)
    lower = [(zero, floor), (inner, floor), (inner, cut), (0.95 * side, cut), (side, middle), (0.97 * side, shoulder)]
    closed = [
        (0.97 * side - 0.03, shoulder + 0.006), (roof, edge), (0.88 * roof, 0.5 * (edge + top)),
        (0.6 * roof, top - 0.008), (0.3 * roof, top - 0.002), (zero, top),
    ]  # fmt: skip
    rim, bottom = shoulder + 0.02, np.full_like(s, belt - 0.38)
    hump = np.maximum(bottom + 0.004, np.minimum(cut + 0.03, rim - 0.03))  # the wheel arch seen from inside
    opened = [
        (0.95 * side - 0.02, rim), (0.92 * side - 0.05, rim - 0.01), (0.9 * side - 0.06, hump),
        (inner - 0.03, hump - 0.001), (inner - 0.032, bottom), (zero, bottom),
    ]  # fmt: skip
    upper = np.where((bed[0] < s) & (s < bed[1]), np.array(opened), np.array(closed))  # [6, 2, S]
    right = np.concatenate([lower, upper]).transpose(2, 0, 1)
    outline = np.concatenate([right, right[:, -2:0:-1] * [-1, 1]], 1)
    return Solid(np.insert(outline, 2, (length / 2 - s)[:, None], 2))


def road_wheel(radius: float, width: float, dish: float) -> Solid:
    """A wheel about the x axis, its hub dished by `dish` (share of the width) on both sides."""
    rim = np.array([(0.5, dish - 1), (0.62, -0.95), (0.92, -1), (1, -0.7)])
    profile = np.concatenate([rim, rim[::-1] * [1, -1]])
    return revolve(profile * [radius, width / 2], 16).rotated("z", 90)
