"""Mechanisms with nonholonomic constraints and their reduced equations of motion.

mechanism = mechanics.get("snakeboard")
mechanics.reduce(mechanism).acceleration        # symbolic
mechanics.acceleration(mechanism, q, qdot, u)   # numbers
mechanics.simulate(mechanism, t, q0)            # motion
"""

from typing import TYPE_CHECKING, Any

from mechanics.bodies import Body
from mechanics.catalog import get, names
from mechanics.mechanism import Mechanism, MechanismError
from mechanics.model import Model, acceleration
from mechanics.simulation import SimulationError, Trajectory, simulate

if TYPE_CHECKING:
    from mechanics.geometry.reduction import ReducedEquations, reduce

__all__ = [
    "Body",
    "Mechanism",
    "MechanismError",
    "Model",
    "ReducedEquations",
    "SimulationError",
    "Trajectory",
    "acceleration",
    "get",
    "names",
    "reduce",
    "simulate",
]


def __getattr__(name: str) -> Any:
    # SymPy is loaded by those who derive, not by those who step an environment.
    if name in ("reduce", "ReducedEquations"):
        from mechanics.geometry import reduction

        return getattr(reduction, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
