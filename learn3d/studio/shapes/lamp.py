"""Procedural lamps, in metres: table, floor, arc and desk lamps, pendants, chandeliers."""

import numpy as np

from .draw import Draw, ellipse, points, rectangle, rounded_path
from .parts import Part, bar, crossbar, ellipsoid, join, revolve, slab, tube


def _shell(radius: np.ndarray, y: np.ndarray, sides: int = 20) -> Part:
    """A thin wall around the y axis, open below and above: its outer radius [N] at the heights y [N]."""
    inner = radius - 0.03 * radius.max()
    return revolve(np.r_[np.c_[radius, y], np.c_[inner, y][::-1]], sides, hollow=True)


def _shade(draw: Draw, radius: float, height: float) -> Part:
    """A lamp shade from y = 0 to `height`, with a bulb, and two wires across that hold it."""
    t, top = np.linspace(0, 1, 7), draw(0.3, 0.75)
    cone, drum, bell = 1 - (1 - top) * t, 1 - 0.1 * t, top + (1 - top) * (1 - t) ** 2
    scale = draw.pick((cone, drum, bell, np.sqrt(1 - (0.98 * t) ** 2)), (4, 2, 1.5, 1.5))  # the last one is a dome
    shade = _shell(radius * scale, height * t, sides=draw.pick({20: 5, 4: 1}))
    level, reach = 0.85 * height, 0.985 * radius * float(np.interp(0.85, t, scale))  # the wires end inside the wall
    shade += crossbar((-reach, level, 0), 0.012) + bar((0, level, -reach), (0, level, reach), 0.012)
    shade += ellipsoid((0.07, 0.11, 0.07), (0, 0.62 * height, 0), 10, 6)
    return shade + bar((0, -0.02, 0), (0, 0.88 * height, 0), 0.02)


def _foot(draw: Draw, size: float) -> Part:
    return slab(draw.pick((ellipse(size, size), rectangle(size, size))), draw(0.02, 0.05))


def table_lamp(draw: Draw) -> Part:
    """A turned base under a shade."""
    height, width, t = draw(0.2, 0.38), draw(0.06, 0.13), np.linspace(0, 1, 17)
    vase = 0.22 + 0.8 * np.exp(-(((t - draw(0.3, 0.7)) / 0.22) ** 2))
    balls = 0.2 + 0.6 * np.abs(np.sin(draw.count(2, 4) * np.pi * t))
    hourglass, cone, stick = 0.25 + 0.7 * np.abs(2 * t - 1) ** 1.6, 0.9 - 0.75 * t, np.full(17, 0.15)
    profile = np.c_[draw.pick((vase, balls, hourglass, cone, stick)), 0.06 + 0.94 * t]
    sides, neck = draw.pick({20: 3, 8: 1, 4: 1}), height + draw(0.02, 0.06)
    base = revolve(np.r_[[(1.0, 0.0), (1.0, 0.04)], profile] * [width, height], sides)
    shade = _shade(draw, draw(1.15, 2.2) * max(width, 0.09), draw(0.15, 0.3)).moved(y=neck - 0.02)
    return base + bar((0, 0.7 * height, 0), (0, neck + 0.03, 0), 0.025) + shade


def floor_lamp(draw: Draw) -> Part:
    """A tall pole on a plate or on three legs, with a shade on top."""
    height, thick = draw(1.0, 1.5), draw(0.025, 0.04)
    if draw.maybe(0.5):
        lamp = _foot(draw, draw(0.26, 0.4)) + bar((0, 0.01, 0), (0, height, 0), thick)
    else:
        reach, knee = draw(0.22, 0.34), draw(0.5, 0.95) * height
        lamp = bar((0, knee - 0.03, 0), (0, height, 0), 1.3 * thick)
        for angle in np.radians([90, 210, 330]):
            lamp += bar((reach * np.cos(angle), 0, reach * np.sin(angle)), (0, knee, 0), thick)
    return lamp + _shade(draw, draw(0.17, 0.3), draw(0.2, 0.36)).moved(y=height - 0.02)


def arc_lamp(draw: Draw) -> Part:
    """A floor lamp with a pole that bends over to the front, and a shade that hangs from it."""
    height, reach = draw(1.4, 1.9), draw(0.5, 1.2)
    rise, angle = draw(0.3, 0.7) * height, np.linspace(0, np.pi * draw(0.7, 0.95), 14)
    arc = points(0.0, height - rise + rise * np.sin(angle), reach / 2 * (1 - np.cos(angle)))
    tall = draw(0.14, 0.26)
    hang = arc[-1] - [0, draw(0.0, 0.2) + tall, 0]
    shade = bar(arc[-1], hang + [0, 0.5 * tall, 0], 0.014) + _shade(draw, draw(0.12, 0.24), tall).moved(*hang)
    return _foot(draw, 0.36) + tube([(0, 0.01, 0), *arc], 0.014) + shade


def desk_lamp(draw: Draw) -> Part:
    """Two arms with joints, or one bent tube, that hold a head towards +z."""
    lower, upper, foot = np.radians(draw(-35, 25)), np.radians(draw(20, 80)), np.array([0, 0.02, 0])
    elbow = foot + draw(0.2, 0.42) * np.array([0, np.cos(lower), np.sin(lower)])
    head = elbow + draw(0.2, 0.42) * np.array([0, np.cos(upper), np.sin(upper)])
    thick = draw(0.014, 0.022)
    lamp = _foot(draw, draw(0.16, 0.24))
    if draw.maybe(0.35):
        lamp += tube(rounded_path([foot, elbow, head], 0.2, 7), thick / 2)
    else:
        lamp += bar(foot, elbow, thick) + bar(elbow, head, thick)
        lamp += join(bar(joint - [0.02, 0, 0], joint + [0.02, 0, 0], 0.04) for joint in (elbow, head))
    size, tilt_deg = draw(0.06, 0.11), draw(-10, 60)
    t = np.linspace(0, 1, 6)
    shade = _shell(size * draw.pick((np.sqrt(1 - 0.93 * t**2), 1 - 0.7 * t)), 1.5 * size * t, 16)
    shade += ellipsoid((0.9 * size, size, 0.9 * size), (0, 0.7 * size, 0), 10, 6)
    shade += revolve([(0.5 * size, 1.2 * size), (0.4 * size, 1.7 * size)], 12)
    return lamp + shade.moved(y=-1.5 * size).rotated("x", -tilt_deg).moved(*head)


def pendant(draw: Draw) -> Part:
    """One to three shades of the same kind hanging from a ceiling plate."""
    count = draw.pick({1: 3, 2: 1, 3: 1.5})
    radius, height = draw(0.12, 0.32), draw(0.12, 0.32)
    ceiling, pitch = height + draw(0.25, 0.9), 2.4 * radius
    shade = _shade(draw, radius, height) + bar((0, 0.6 * height, 0), (0, ceiling + 0.01, 0), 0.014)
    plate = slab(rectangle(pitch * (count - 1) + 0.12, 0.12, 0.05, 4), 0.03).moved(y=ceiling)
    return plate + join(shade.moved(x=x) for x in pitch * (np.arange(count) - (count - 1) / 2))


def chandelier(draw: Draw) -> Part:
    """Arms around a hanging column, each with a candle or a globe."""
    count, reach, drop = draw.count(3, 8), draw(0.25, 0.45), draw(0.3, 0.6)
    swing, rise = draw(0.02, 0.2), draw(-0.06, 0.16)
    path = rounded_path([(0, 0, 0), (0.5 * reach, -swing, 0), (reach, -0.5 * swing, 0), (reach, rise, 0)], 0.15, 4)
    arm = tube(path, 0.009)
    if draw.maybe(0.5):
        arm += ellipsoid((0.12, 0.12, 0.12), (reach, rise + 0.05, 0), 12, 8)
    else:
        arm += revolve([(0.012, 0), (0.045, 0.01), (0.045, 0.02), (0.012, 0.022)], 10).moved(reach, rise - 0.01)
        arm += bar((reach, rise, 0), (reach, rise + 0.1, 0), 0.026)
    t = np.linspace(0, 1, 9)
    column = revolve(np.c_[0.02 + 0.04 * np.abs(np.sin(draw(1, 3) * np.pi * t)), -0.12 + 0.3 * t], 12)
    column += bar((0, 0.1, 0), (0, drop, 0), 0.016) + slab(ellipse(0.13, 0.13), 0.03).moved(y=drop - 0.01)
    return column + arm.around(90 + 360 / count * np.arange(count))


KINDS = {table_lamp: 3.5, floor_lamp: 2.5, arc_lamp: 1, desk_lamp: 1.5, pendant: 1.8, chandelier: 1.2}
