"""What a mechanism looks like from above, as data: bodies with a place, in the language of everything else.

A body is a shape in a pose (x, y, angle), all of them expressions in the coordinates, parameters and definitions. A
pose is relative to that of the body it is `on`, so that a wheel of a truck of a board says only how it steers. Bodies
are drawn in their order, the last on top. They are drawn and nothing else: no equation, kernel or result follows from
them.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["COLOURS", "SHAPES", "Body"]

# shape -> its sizes in m. Rectangle, disc, wheel and axle have their middle at the pose, a bar begins there; lengths,
# and the diameter of a wheel seen from above, lie along the angle, widths across it. A wheel rolls along its angle, as
# an edge slides. An axle is two wheels, a track apart.
SHAPES: dict[str, tuple[str, ...]] = {
    "rectangle": ("length", "width"),
    "disc": ("length", "width"),
    "bar": ("length", "width"),
    "wheel": ("diameter", "width"),
    "axle": ("track", "diameter", "width"),
}
COLOURS = ("blue", "sky", "orange", "yellow", "green", "purple", "grey", "black")


@dataclass(frozen=True)
class Body:
    """Something to draw.

    Attributes:
        shape: one of `SHAPES`.
        pose: x in m, y in m and angle in rad, relative to the body `on`.
        size: numbers in m, as `SHAPES` says; at least 0.
        on: name of a body before this one; "" for the ground.
        colour: one of `COLOURS`; wheels are black whatever it is.
    """

    shape: str
    pose: tuple[str, str, str]
    size: tuple[str, ...]
    on: str = ""
    colour: str = "blue"
