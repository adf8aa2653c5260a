"""The relay of the roller racer: full torque, turned round whenever the joint has swung far enough.

The racer's speed grows with the square of the joint's rate, whichever way it turns; the heading turns with the joint,
so the swing must shrink as the speed grows, and lean against the heading.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from training.laws.law import Law, side_of
from training.observed import Seen

__all__ = ["Relay"]

Array = NDArray[np.float64]


class Relay(Law):
    """The torque turns round when the joint, leaning against the heading and seen ahead, passes a threshold."""

    RANGES: ClassVar[Mapping[str, tuple[float, float]]] = {
        "threshold": (0.1, 1.6),  # rad, at the start; with the lookahead it may lie beyond the stop
        "last threshold": (0.0, 1.2),
        "decay": (0.2, 3.0),  # exponent of the way from the one to the other
        "heading gain": (0.0, 2.0),
        "lookahead": (0.0, 0.1),  # s
    }

    def first_side(self, seen: Seen) -> Array:
        """Push the way the joint is turned."""
        return side_of(seen["psi"])

    def actions(self, seen: Seen, t: float) -> tuple[Array, ...]:
        """Share of u_psi."""
        has = self.values
        threshold = has["threshold"] + (has["last threshold"] - has["threshold"]) * (1 - self.left(t)) ** has["decay"]
        swung = seen["psi"] + has["lookahead"] * seen["psi_dot"] - has["heading gain"] * seen.heading
        self.side = np.where(self.side * swung > threshold, -self.side, self.side)
        return (self.side,)
