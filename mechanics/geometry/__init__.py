"""The theory of Bullo and Zefran, section by section: ../PAPER.md says what is where."""

from mechanics.geometry.connection import Connection
from mechanics.geometry.controllability import Controllability, analyse
from mechanics.geometry.reduction import ReducedEquations, reduce
from mechanics.geometry.symmetry import cyclic_coordinates, invariance, planar_symmetry

__all__ = [
    "Connection",
    "Controllability",
    "ReducedEquations",
    "analyse",
    "cyclic_coordinates",
    "invariance",
    "planar_symmetry",
    "reduce",
]
