"""What a controller can know: the quantities in its observations, by name, in the units of the mechanism."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics.expressions import ExpressionError, evaluate, names_in, unknown_name
from nhenv.env import LocomotionEnv
from nhenv.vector_env import LocomotionVectorEnv

__all__ = ["Observed", "Seen"]

Array = NDArray[np.float64]


class Observed:
    """Reads observations.

    The label of an observation names a quantity; where that is a coordinate, a rate or a speed of the mechanism,
    its expression only scales it, and the scale is taken out again.

    Attributes:
        labels: name of each element of an observation.
        forward: +1 or -1, the way along x in which the mechanism's gaits drive it.
    """

    def __init__(self, env: LocomotionEnv | LocomotionVectorEnv) -> None:
        mechanism = env.mechanism
        self.labels = (*mechanism.observation, *env.task.observation)
        units = [1 / evaluate(text, {label: 1.0}) for label, text in mechanism.observation.items()]
        self._units = np.array([*units, *[1.0] * len(env.task.observation)])
        self.forward = mechanism.direction(env.params)

    def values(self, observations: ArrayLike) -> Array:
        """Quantities (..., d) in observations (..., d)."""
        return np.asarray(observations, dtype=float) * self._units

    def __call__(self, observations: ArrayLike) -> Seen:
        """Quantities by name, each (...)."""
        return Seen(self, self.values(observations))

    def check(self, text: str) -> str:
        """Return an expression in what is observed; raise ExpressionError if it uses anything else."""
        for name in sorted(names_in(text) - {*self.labels, "forward"}):
            raise ExpressionError(f"in {text!r}: {unknown_name('observation', name, (*self.labels, 'forward'))}")
        return text


class Seen(Mapping[str, Array]):
    """Quantities by name; also `forward`."""

    def __init__(self, observed: Observed, values: Array) -> None:
        self._observed, self._values = observed, values

    def __getitem__(self, name: str) -> Array:
        if name == "forward":
            return np.array(self._observed.forward)
        return self._values[..., self._observed.labels.index(name)]

    def __iter__(self) -> Iterator[str]:
        return iter((*self._observed.labels, "forward"))

    def __len__(self) -> int:
        return len(self._observed.labels) + 1

    @property
    def heading(self) -> Array:
        """Heading in (-π, π], from its cosine and sine."""
        return np.arctan2(self["sin_heading"], self["cos_heading"])

    def value(self, text: str) -> Array:
        """Value (...) of an expression in these quantities."""
        return np.broadcast_to(evaluate(text, self), self._values.shape[:-1])
