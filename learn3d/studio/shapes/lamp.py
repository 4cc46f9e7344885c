"""Procedural lamps, in metres: table, floor, arc and desk lamps, pendants, chandeliers."""

import numpy as np

from .draw import Draw, Perhaps, ellipse, points, recipe, rectangle, rounded_path, shares
from .parts import Part, bar, crossbar, ellipsoid, join, pole, revolve, slab, tube


def _shell(radius: np.ndarray, y: np.ndarray, sides: int = 20) -> Part:
    """A thin wall around the y axis, open at both ends: outer radius [N] at heights y [N]."""
    inner = radius - 0.03 * radius.max()
    return revolve(np.r_[np.c_[radius, y], np.c_[inner, y][::-1]], sides, hollow=True)


@recipe(top=(0.3, 0.75), form={"cone": 4, "drum": 2, "bell": 1.5, "dome": 1.5}, sides={20: 5, 4: 1})
def _shade(draw: Draw, radius: float, height: float, *, top, form, sides) -> Part:
    """A lamp shade from y = 0 to `height`, with a bulb, and two wires across that hold it."""
    t = shares(7)
    scale = {
        "cone": 1 - (1 - top) * t,
        "drum": 1 - 0.1 * t,
        "bell": top + (1 - top) * (1 - t) ** 2,
        "dome": np.sqrt(1 - (0.98 * t) ** 2),
    }[form]
    reach = 0.985 * radius * float(np.interp(0.85, t, scale))  # the wires end inside the wall
    shade = _shell(radius * scale, height * t, sides)
    shade += crossbar((-reach, 0.85 * height, 0), 0.012)
    shade += bar((0, 0.85 * height, -reach), (0, 0.85 * height, reach), 0.012)
    shade += ellipsoid((0.07, 0.11, 0.07), (0, 0.62 * height, 0), 10, 6)
    return shade + pole(-0.02, 0.88 * height, 0.02)


@recipe(outline=[ellipse, rectangle], thickness=(0.02, 0.05))
def _foot(draw: Draw, size: float, *, outline, thickness) -> Part:
    return slab(outline(size, size), thickness)


@recipe(
    height=(0.2, 0.38),
    width=(0.06, 0.13),
    belly=(0.3, 0.7),
    balls=range(2, 5),
    form=["vase", "balls", "hourglass", "cone", "stick"],
    sides={20: 3, 8: 1, 4: 1},
    neck=(0.02, 0.06),
    shade=(1.15, 2.2),
    shade_height=(0.15, 0.3),
)
def table_lamp(
    draw: Draw, *, height, width, belly, balls, form, sides, neck, shade, shade_height
) -> Part:
    """A turned base under a shade."""
    t = shares(17)
    radius = {
        "vase": 0.22 + 0.8 * np.exp(-(((t - belly) / 0.22) ** 2)),
        "balls": 0.2 + 0.6 * np.abs(np.sin(balls * np.pi * t)),
        "hourglass": 0.25 + 0.7 * np.abs(2 * t - 1) ** 1.6,
        "cone": 0.9 - 0.75 * t,
        "stick": np.full(17, 0.15),
    }[form]
    profile = np.r_[[(1.0, 0.0), (1.0, 0.04)], np.c_[radius, 0.06 + 0.94 * t]]
    top = height + neck
    lamp = revolve(profile * [width, height], sides) + pole(0.7 * height, top + 0.03, 0.025)
    return lamp + _shade(draw, shade * max(width, 0.09), shade_height).moved(y=top - 0.02)


@recipe(height=(1.0, 1.5), thick=(0.025, 0.04), plate=0.5, tray=Perhaps(0.15, (0.3, 0.55)))
def floor_lamp(draw: Draw, *, height, thick, plate, tray) -> Part:
    """A tall pole on a plate or on three legs, with a shade on top, perhaps with a tray."""
    if plate:
        lamp = _foot(draw, draw(0.26, 0.4)) + pole(0.01, height, thick)
    else:
        reach = draw(0.22, 0.34)
        knee = draw(0.5, 0.95) * height
        lamp = pole(knee - 0.03, height, 1.3 * thick)
        for angle in np.radians([90, 210, 330]):
            lamp += bar((reach * np.cos(angle), 0, reach * np.sin(angle)), (0, knee, 0), thick)
    if tray:
        size = draw(0.3, 0.5)
        if not plate:  # down to the tray, which may be below the knee
            lamp += pole(tray * height, height, thick)
        lamp += slab(draw.pick([ellipse, rectangle])(size, size), 0.025, y=tray * height)
    return lamp + _shade(draw, draw(0.17, 0.3), draw(0.2, 0.36)).moved(y=height - 0.02)


@recipe(
    height=(1.4, 1.9),
    reach=(0.5, 1.2),
    rise=(0.3, 0.7),
    turn=(0.7, 0.95),
    shade_height=(0.14, 0.26),
    drop=(0.0, 0.2),
    radius=(0.12, 0.24),
)
def arc_lamp(draw: Draw, *, height, reach, rise, turn, shade_height, drop, radius) -> Part:
    """A floor lamp with a pole that bends over to the front, and a shade that hangs from it."""
    rise *= height
    angle = np.linspace(0, np.pi * turn, 14)
    arc = points(0.0, height - rise + rise * np.sin(angle), reach / 2 * (1 - np.cos(angle)))
    hang = arc[-1] - [0, drop + shade_height, 0]
    shade = bar(arc[-1], hang + [0, 0.5 * shade_height, 0], 0.014)
    shade += _shade(draw, radius, shade_height).moved(*hang)
    return _foot(draw, 0.36) + tube([(0, 0.01, 0), *arc], 0.014) + shade


@recipe(
    lower_deg=(-35, 25),
    upper_deg=(20, 80),
    lower=(0.2, 0.42),
    upper=(0.2, 0.42),
    thick=(0.014, 0.022),
    foot=(0.16, 0.24),
)
def desk_lamp(draw: Draw, *, lower_deg, upper_deg, lower, upper, thick, foot) -> Part:
    """Two arms with joints, or one bent tube, that hold a head towards +z."""
    base = np.array([0, 0.02, 0])
    elbow = base + lower * _direction(lower_deg)
    head = elbow + upper * _direction(upper_deg)
    lamp = _foot(draw, foot)
    if draw.maybe(0.35):
        lamp += tube(rounded_path([base, elbow, head], 0.2, 7), thick / 2)
    else:
        lamp += bar(base, elbow, thick) + bar(elbow, head, thick)
        lamp += join(
            bar(joint - [0.02, 0, 0], joint + [0.02, 0, 0], 0.04) for joint in (elbow, head)
        )
    size = draw(0.06, 0.11)
    tilt_deg = draw(-10, 60)
    t = shares(6)
    profile = (
        np.sqrt(1 - 0.93 * t**2) if draw.pick(["round", "conical"]) == "round" else 1 - 0.7 * t
    )
    shade = _shell(size * profile, 1.5 * size * t, 16)
    shade += ellipsoid((0.9 * size, size, 0.9 * size), (0, 0.7 * size, 0), 10, 6)
    shade += revolve([(0.5 * size, 1.2 * size), (0.4 * size, 1.7 * size)], 12)
    return lamp + shade.moved(y=-1.5 * size).rotated("x", -tilt_deg).moved(*head)


def _direction(angle_deg: float) -> np.ndarray:
    """The unit vector in the plane x = 0 that is turned from y towards z by this angle."""
    angle = np.radians(angle_deg)
    return np.array([0, np.cos(angle), np.sin(angle)])


@recipe(count={1: 3, 2: 1, 3: 1.5}, radius=(0.12, 0.32), height=(0.12, 0.32), cord=(0.25, 0.9))
def pendant(draw: Draw, *, count, radius, height, cord) -> Part:
    """One to three shades of the same kind hanging from a ceiling plate."""
    ceiling = height + cord
    pitch = 2.4 * radius
    shade = _shade(draw, radius, height) + pole(0.6 * height, ceiling + 0.01, 0.014)
    plate = slab(rectangle(pitch * (count - 1) + 0.12, 0.12, 0.05, 4), 0.03, y=ceiling)
    return plate + join(shade.moved(x=x) for x in pitch * (np.arange(count) - (count - 1) / 2))


@recipe(
    count=range(3, 9),
    reach=(0.25, 0.45),
    drop=(0.3, 0.6),
    swing=(0.02, 0.2),
    rise=(-0.06, 0.16),
    globes=0.5,
    waves=(1, 3),
)
def chandelier(draw: Draw, *, count, reach, drop, swing, rise, globes, waves) -> Part:
    """Arms around a hanging column, each with a candle or a globe."""
    path = [(0, 0, 0), (0.5 * reach, -swing, 0), (reach, -0.5 * swing, 0), (reach, rise, 0)]
    arm = tube(rounded_path(path, 0.15, 4), 0.009)
    if globes:
        arm += ellipsoid((0.12, 0.12, 0.12), (reach, rise + 0.05, 0), 12, 8)
    else:
        arm += revolve([(0.012, 0), (0.045, 0.01), (0.045, 0.02), (0.012, 0.022)], 10).moved(
            reach, rise - 0.01
        )
        arm += bar((reach, rise, 0), (reach, rise + 0.1, 0), 0.026)
    t = shares(9)
    column = revolve(np.c_[0.02 + 0.04 * np.abs(np.sin(waves * np.pi * t)), -0.12 + 0.3 * t], 12)
    column += pole(0.1, drop, 0.016) + slab(ellipse(0.13, 0.13), 0.03, y=drop - 0.01)
    return column + arm.around(90 + 360 / count * np.arange(count))


KINDS = {
    table_lamp: 3.5,
    floor_lamp: 2.5,
    arc_lamp: 1,
    desk_lamp: 1.5,
    pendant: 1.8,
    chandelier: 1.2,
}
