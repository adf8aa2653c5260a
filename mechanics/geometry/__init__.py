"""The theory: reduced equations of motion, symmetry, and the algebra they need."""

from mechanics.geometry.reduction import ReducedEquations, reduce

__all__ = ["ReducedEquations", "reduce"]
