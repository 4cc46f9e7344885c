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

    @property
    def arch(self) -> float:
        """Radius of the wheel arches, in metres."""
        return self.wheel + 0.055

    @property
    def boot(self) -> float:
        """Where the boot (or the bed) begins, in metres from the front bumper."""
        return min(self.window * self.length, self.length - 0.12)

    @property
    def bed(self) -> tuple[float, float]:
        """From where to where the body is an open box, in metres from the front bumper; an empty range if it is not."""
        return (self.boot + 0.06, self.length - 0.08) if self.has_bed else (self.length, self.length)


def hull(body: Body) -> Solid:
    """The body: cross-sections from front to rear, with the wheel arches cut into their lower corners."""
    side_view = _side_view(body)
    s = _stations(body, side_view)
    to_front, to_rear = s / body.length, 1 - s / body.length

    # Measures of each cross-section, all [S]. Widths are halves.
    top = np.interp(s, side_view[:, 0], side_view[:, 1])
    width = body.width / 2 * (1 - 0.15 * np.clip(1 - to_front / 0.18, 0, 1) ** 2)
    width = width * (1 - 0.06 * np.clip(1 - to_rear / 0.15, 0, 1) ** 2)
    floor = body.clearance + 0.12 * np.clip(1 - to_front / 0.08, 0, 1) + 0.15 * np.clip(1 - to_rear / 0.1, 0, 1)
    inner = np.full_like(s, body.width / 2 - TYRE - 0.06)  # of the floor between the wheels
    cut = np.maximum(floor + 0.002, _arch_height(body, s))
    shoulder = np.minimum(body.shoulder, top - 0.03)
    middle = np.maximum(0.55 * floor + 0.45 * shoulder, 0.5 * (cut + shoulder))
    edge = np.maximum(top - 0.045 - 0.1 * np.clip(top - shoulder - 0.1, 0, 0.3), shoulder + 0.01)  # of the roof
    roof = np.maximum(0.96 * width - 0.03 - body.lean * (edge - shoulder), 0.45 * width)
    rim, bottom = shoulder + 0.02, np.full_like(s, body.shoulder - 0.38)  # of the bed
    hump = np.maximum(bottom + 0.004, np.minimum(cut + 0.03, rim - 0.03))  # the wheel arch seen from the bed

    # The right half of each cross-section: points (x, y) from the middle of the floor outwards and up to the middle.
    zero = np.zeros_like(s)
    lower = [
        (zero, floor),
        (inner, floor),
        (inner, cut),
        (0.95 * width, cut),
        (width, middle),
        (0.97 * width, shoulder),
    ]
    cabin = [
        (0.97 * width - 0.03, shoulder + 0.006),
        (roof, edge),
        (0.88 * roof, 0.5 * (edge + top)),
        (0.6 * roof, top - 0.008),
        (0.3 * roof, top - 0.002),
        (zero, top),
    ]
    bed = [
        (0.95 * width - 0.02, rim),
        (0.92 * width - 0.05, rim - 0.01),
        (0.9 * width - 0.06, hump),
        (inner - 0.03, hump - 0.001),
        (inner - 0.032, bottom),
        (zero, bottom),
    ]
    upper = np.where((body.bed[0] < s) & (s < body.bed[1]), np.array(bed), np.array(cabin))
    right = np.concatenate([np.array(lower), upper]).transpose(2, 0, 1)  # [S, 12, 2]
    ring = np.concatenate([right, right[:, -2:0:-1] * [-1, 1]], 1)
    z = np.broadcast_to((body.length / 2 - s)[:, None, None], (*ring.shape[:2], 1))
    return Solid(np.concatenate([ring, z], 2))


def _side_view(body: Body) -> np.ndarray:
    """The upper edge of the body seen from the side [N, 2]: metres from the front bumper, and height."""
    length, belt, height = body.length, body.shoulder, body.height
    cowl = body.bonnet * length
    roof_front, roof_rear = cowl + body.screen * length, body.roof * length
    corners = [
        *[(0, 0.75 * belt), (0.06, 0.9 * belt), (0.22, belt), (cowl, belt + 0.08)],
        *[(roof_front, height), ((roof_front + roof_rear) / 2, height + 0.015), (roof_rear, height - 0.02)],
        *[(body.boot, belt + 0.07), (length - 0.08, belt + 0.04), (length, 0.85 * belt)],
    ]
    line = rounded_path(corners, 0.12, 2)
    line[:, 0] = np.maximum.accumulate(line[:, 0] + 1e-4 * np.arange(len(line)))
    return line


def _stations(body: Body, side_view: np.ndarray) -> np.ndarray:
    """Where the cross-sections are [S], in metres from the front bumper: at every corner, arch and end of the bed."""
    around_axle = body.arch * np.append([-1.02, 1.02], 0.999 * np.cos(np.linspace(0, np.pi, 8)))
    arches = [axle + around_axle for axle in body.axles]
    bed = [end + side for end in body.bed for side in (-0.015, 0.015)]
    s = np.concatenate([side_view[:, 0], np.linspace(0, body.length, 7), *arches, bed])
    s = np.unique(s[(s >= 0) & (s <= body.length)].round(3))
    return s[np.append(True, np.diff(s) > 0.004)]


def _arch_height(body: Body, s: np.ndarray) -> np.ndarray:
    """Height of the wheel arches at the stations [S], 0 beside them."""
    height = np.zeros_like(s)
    for axle in body.axles:
        rise = body.wheel + np.sqrt(np.maximum(body.arch**2 - (s - axle) ** 2, 0.0))
        height = np.where(np.abs(s - axle) < body.arch, rise, height)
    return height


def road_wheel(radius: float, width: float, dish: float) -> Solid:
    """A wheel about the x axis, its hub dished by `dish` (share of the width) on both sides."""
    rim = np.array([(0.5, dish - 1), (0.62, -0.95), (0.92, -1), (1, -0.7)])
    profile = np.concatenate([rim, rim[::-1] * [1, -1]])
    return revolve(profile * [radius, width / 2], 16).rotated("z", 90)
