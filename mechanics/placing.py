"""Where the bodies of a mechanism are, in configurations and with numbers for the parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["Placed", "default_bodies", "place"]

Array = NDArray[np.float64]


class Placed(NamedTuple):
    """A body where it is.

    Attributes:
        name: its name.
        body: its data.
        pose: x, y and angle in the plane, shape (..., 3).
        size: numbers in m, shape (..., sizes).
    """

    name: str
    body: Body
    pose: Array
    size: Array


def place(mechanism: Mechanism, q: ArrayLike, params: Mapping[str, ArrayLike] | None = None) -> list[Placed]:
    """All bodies of a mechanism in the configurations q, shape (..., n), in the order in which they are drawn."""
    coordinates = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    values = {**mechanism.parameters, **(params or {}), **dict(zip(mechanism.coordinates, coordinates, strict=True))}
    bodies = mechanism.bodies or default_bodies(mechanism)
    numbers = mechanism.numeric([text for body in bodies.values() for text in (*body.pose, *body.size)], values)
    poses: dict[str, Array] = {"": np.zeros(3)}
    placed, start = [], 0
    for name, body in bodies.items():
        middle, end = start + 3, start + 3 + len(body.size)
        poses[name] = _composed(poses[body.on], numbers[..., start:middle])
        placed.append(Placed(name, body, poses[name], numbers[..., middle:end]))
        start = end
    return placed


def default_bodies(mechanism: Mechanism) -> dict[str, Body]:
    """For a mechanism that declares no bodies: a disc with a nose, and a hand for each other coordinate."""
    if not mechanism.fibre:
        raise ValueError(
            f"{mechanism.name} cannot be drawn: it has no position and heading in the plane; declare bodies, or a "
            "fibre such as ('x', 'y', 'theta')"
        )
    x, y, heading = mechanism.fibre
    others = [name for name in mechanism.coordinates if name not in mechanism.fibre]
    marker = {
        "marker": Body("disc", (x, y, heading), ("0.2", "0.2")),
        "nose": Body("bar", ("0", "0", "0"), ("0.18", "0.03"), on="marker", colour="black"),
    }
    hands = {
        f"hand {name}": Body("bar", ("0", "0", name), (repr(0.16 / (1 + i)), "0.02"), on="marker", colour="orange")
        for i, name in enumerate(others)
    }
    return {**marker, **hands}


def _composed(base: Array, relative: Array) -> Array:
    """Pose (..., 3) of what stands in the pose `relative` on what stands in the pose `base`."""
    cos, sin = np.cos(base[..., 2]), np.sin(base[..., 2])
    x, y, angle = np.moveaxis(relative, -1, 0)
    return np.stack([base[..., 0] + cos * x - sin * y, base[..., 1] + sin * x + cos * y, base[..., 2] + angle], axis=-1)
