"""Lemma 3.3: a group that leaves a mechanism as it is leaves its reduced equations as they are.

If inertia tensor, constraints, control forces, potential and drag do not change under a group action, then in a
frame of invariant vector fields neither do the generalized Christoffel symbols and the input coefficients.
`invariance` tries the hypothesis for any action, written as data. Two kinds of action are found unasked:

* the shift of one coordinate (`cyclic_coordinates`), on which the reduced equations then do not depend;
* the displacements SE(2) of the plane (`planar_symmetry`): (x, y) -> R(a)(x, y) + b, heading -> heading + a. Joint
  angles stay as they are; angles measured from the x axis, as the heading is, turn by a too. What is invariant
  may be computed at the identity x = y = heading = 0, which rids the algebra of the heading.

The tests are numerical, at random points: an identity between analytic functions that holds there holds, with
probability one, and every function of the language can be evaluated, whereas only some have a normal form. What is
flat at these points and a wall elsewhere would pass: so no coordinate that the potential names is taken to be cyclic,
no position that anything names to be free, and no heading that the potential names, unless with other angles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mechanics.expressions import ExpressionError, evaluate, names_in, to_sympy, unknown_name
from mechanics.mechanism import Matrix, Mechanism, MechanismError

__all__ = ["Invariance", "PlanarSymmetry", "cyclic_coordinates", "find_fibre", "invariance", "planar_symmetry"]

Array = NDArray[np.float64]
Values = Mapping[str, Any]  # name -> [p], at p points
Image = tuple[Values, Array]  # the points that some points are moved to, and the tangent maps [p, n, n] there
Frame = str | Sequence[Sequence[str]] | None

# Both sides are computed in double precision, in units that make them of order one: rounding is below 1e-13, a
# broken symmetry changes them by the order of the terms that break it.
TOLERANCE = 1e-9
POINTS = 6
# Fourth-order central differences: at steps of 1e-3 they err by 1e-12, for guesses that are tried afterwards.
STEP = 1e-3
STENCIL = {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}


@dataclass(frozen=True)
class Invariance:
    """Whether an action leaves a mechanism as it is: true if nothing is broken.

    Attributes:
        broken: part of the mechanism -> largest change seen, as a share of the part's own size. The
            parts are inertia, constraints, force 'NAME', potential, drag, vector field NUMBER.
    """

    broken: Mapping[str, float] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return not self.broken

    def __str__(self) -> str:
        changes = (f"{part} (changes by {100 * change:.3g} %)" for part, change in self.broken.items())
        return f"not invariant: {', '.join(changes)}" if self.broken else "invariant"


@dataclass(frozen=True)
class PlanarSymmetry:
    """The action of SE(2) that leaves a mechanism as it is, by indices of coordinates.

    Attributes:
        x: first coordinate of the position.
        y: second coordinate of the position.
        heading: angle of the body in the plane.
        turning: further angles measured from the x axis, which turn with the heading.
    """

    x: int
    y: int
    heading: int
    turning: tuple[int, ...] = ()


def invariance(mechanism: Mechanism, action: Mapping[str, str], frame: Frame = None) -> Invariance:
    """Try whether a mechanism, and perhaps a frame, is invariant under a group action.

    Args:
        mechanism: inertia, constraints, forces, potential and drag are tried, for parameters near the defaults.
            The constraints are invariant if D is; the one-forms may go over into combinations of each other.
        action: coordinate -> where it is moved, an expression in the coordinates and the group's parameters (every
            name that the mechanism does not use), such as {"x": "x + b_1"}. Coordinates left out stay.
        frame: name or [k, n] rows of vector fields; not looked at if None.

    Raises:
        MechanismError: the action cannot be read, or is not invertible.
    """
    probe = _Probe(mechanism, frame)
    return Invariance(probe.changes(_image(probe, action)))


def cyclic_coordinates(mechanism: Mechanism, frame: Frame = None) -> tuple[str, ...]:
    """Coordinates that make no difference: inertia, constraints, forces, potential, drag, frame allow their shift.

    By Lemma 3.3 the reduced equations in that frame do not depend on them either.

    Args:
        mechanism: the mechanism.
        frame: name or [k, n] rows of vector fields; not looked at if None.
    """
    probe = _Probe(mechanism, frame)
    amounts = probe.random(2)
    named = _named(mechanism, [mechanism.potential])
    free = (name for name in mechanism.coordinates if name not in named)
    return tuple(name for name in free if not probe.changes(probe.shift(name, amounts)))


def planar_symmetry(mechanism: Mechanism, frame: Frame = None) -> PlanarSymmetry | None:
    """Action of SE(2) that leaves inertia, constraints, forces, potential, drag and frame invariant, or None.

    Args:
        mechanism: the mechanism; if it declares no fibre, one is sought as by `find_fibre`.
        frame: name or [k, n] rows of vector fields; not looked at if None.
    """
    x, y, *heading = mechanism.fibre or ("x", "y")
    if x not in mechanism.coordinates or y not in mechanism.coordinates:
        return None
    rows = [*mechanism.inertia, *mechanism.one_forms, *mechanism.forces.values()]
    rows += (frame is not None and mechanism.frame_rows(frame)) or ()
    texts = [text for row in rows for text in row] + [mechanism.potential, mechanism.rayleigh]
    if {x, y} & _named(mechanism, texts):
        return None
    probe, in_potential = _Probe(mechanism, frame), _named(mechanism, [mechanism.potential])
    others = [name for name in mechanism.coordinates if name not in (x, y)]
    # An invariant tensor has no Lie derivative along x∂y - y∂x + Σ t_c ∂_c, with t_c = 1 for what turns, else 0.
    rotation = probe.derivative(partial(probe.displace, x, y, ()))
    shifts = {c: probe.derivative(partial(probe.shift, c)) for c in others}
    if not all(np.isfinite(column).all() for column in (rotation, *shifts.values())):
        return None
    must_turn = _solve(rotation, shifts)
    for name in heading or sorted(others, key=lambda c: c not in must_turn):
        turning = _solve(rotation + shifts[name], {c: column for c, column in shifts.items() if c != name})
        if len({name, *turning} & in_potential) == 1:
            continue
        if not probe.changes(probe.displace(x, y, (name, *turning), probe.random(math.pi), probe.random(2, 2))):
            index = mechanism.coordinates.index
            return PlanarSymmetry(index(x), index(y), index(name), tuple(map(index, turning)))
    return None


def find_fibre(mechanism: Mechanism, frame: Frame = None) -> tuple[str, ...]:
    """Names (x, y, heading) of a mechanism's fibre: the declared one, or one found, or ().

    One is found if there are coordinates named x and y and a planar symmetry about them. The heading is the first
    coordinate that has to turn with the plane, or else the first that may.

    Args:
        mechanism: the mechanism.
        frame: name or [k, n] rows of vector fields that must be invariant too; not looked at if None.
    """
    if mechanism.fibre:
        return mechanism.fibre
    symmetry = planar_symmetry(mechanism, frame)
    return tuple(mechanism.coordinates[i] for i in (symmetry.x, symmetry.y, symmetry.heading)) if symmetry else ()


def _named(mechanism: Mechanism, texts: Iterable[str]) -> set[str]:
    """Names in texts, and in the definitions that these use."""
    names = {name for text in texts for name in names_in(text)}
    for name, text in reversed([*mechanism.definitions.items()]):  # one may use those before it
        if name in names:
            names |= names_in(text)
    return names


def _solve(constant: Array, columns: Mapping[str, Array]) -> tuple[str, ...]:
    """Names of the columns whose sum cancels `constant`, if there are such; as few as that takes.

    Non-negative least squares: its solutions are sums of independent columns, so that a column that is zero or
    follows from the others stays out.
    """
    if not columns:
        return ()
    from scipy.optimize import nnls

    weights, _ = nnls(np.column_stack(list(columns.values())), -constant)
    return tuple(name for name, weight in zip(columns, weights, strict=True) if weight > 0.5)


def _image(probe: _Probe, action: Mapping[str, str]) -> Image:
    """Where random elements of the group move the probe's points."""
    import sympy as sp

    mechanism, coordinates = probe.mechanism, probe.mechanism.coordinates
    known = {*coordinates, *mechanism.parameters, *mechanism.definitions}
    group: dict[str, None] = {}
    for name, text in action.items():
        if name not in coordinates:
            raise MechanismError(f"{mechanism.name}: in the action: {unknown_name('coordinate', name, coordinates)}")
        try:
            new = sorted(names_in(text) - known)
        except ExpressionError as error:
            raise MechanismError(f"{mechanism.name}: in the action on {name!r}: {error}") from None
        if not new:
            raise MechanismError(
                f"{mechanism.name}: the action moves {name!r} to {text!r}, where no parameter of a group occurs: all "
                f"names are the mechanism's own ({', '.join(sorted(known))}); give the group's parameters other names"
            )
        group |= dict.fromkeys(new)
    # Real symbols, for which SymPy differentiates abs.
    symbols = {name: sp.Symbol(name, real=True) for name in (*coordinates, *mechanism.parameters, *group)}
    scope: dict[str, Any] = dict(symbols)
    for name, text in mechanism.definitions.items():
        scope[name] = to_sympy(text, scope)
    image = sp.Matrix([to_sympy(action.get(name, name), scope) for name in coordinates])
    tangent = image.jacobian([symbols[name] for name in coordinates])
    function = sp.lambdify(list(symbols.values()), [*image, *tangent], "numpy")

    values = {**probe.values, **{name: probe.random(2) for name in group}}
    results = function(*(values[name] for name in symbols))
    rows = np.array([np.broadcast_to(result, POINTS) for result in results], dtype=float)
    n = mechanism.n
    tangents = rows[n:].T.reshape(POINTS, n, n)
    if not (np.abs(np.linalg.det(tangents)) > TOLERANCE).all():
        raise MechanismError(f"{mechanism.name}: the action {dict(action)} is not invertible at some random point")
    return {**probe.values, **dict(zip(coordinates, rows[:n], strict=True))}, tangents


class _Probe:
    """A mechanism's tensors at random points, as they are and as an action would have them.

    With T the tangent map of q -> g q, an invariant vector field has X(g q) = T X(q), a one-form F(g q) T = F(q),
    the inertia tensor T^T M(g q) T = M(q).
    """

    def __init__(self, mechanism: Mechanism, frame: Frame) -> None:
        self.mechanism = mechanism
        self.frame: Matrix | None = None if frame is None else mechanism.frame_rows(frame)
        self._rng = np.random.default_rng(2)
        self.values = {name: self.random(1.5) for name in (*mechanism.coordinates, *mechanism.rates)}
        for name, value in {**mechanism.parameters, **mechanism.drag}.items():
            # A symmetry that only the default has, such as that of a slope of 0, is none.
            self.values[name] = value * (1 + self.random(0.1)) + (abs(self.random(0.1)) if value == 0 else 0)
        self.here = (self.values, np.tile(np.eye(mechanism.n), (POINTS, 1, 1)))
        self._units = np.ones(mechanism.n)
        # Coordinates measured so that each has an inertia of order one: no entry is small by its unit alone.
        inertia = self.parts(self.here)["inertia"]
        self._units = np.sqrt(np.abs(np.diagonal(inertia, axis1=1, axis2=2)).max(axis=0))
        self._parts = self.parts(self.here)

    def random(self, size: float, *shape: int) -> Array:
        """Random numbers up to `size` for each point, [*shape, p]."""
        return self._rng.uniform(-size, size, (*shape, POINTS))

    def changes(self, image: Image) -> dict[str, float]:
        """Parts that a motion of the points changes, with the change as a share of the part."""
        moved = self.parts(image)
        broken = {}
        for part, here in self._parts.items():
            there = moved[part]
            change, size = np.abs(there - here).max(), max(np.abs(here).max(), np.abs(there).max())
            if not change <= TOLERANCE * size:  # also where either is not a number
                broken[part] = float(change / size)
        return broken

    def derivative(self, flow: Callable[[Array], Image]) -> Array:
        """Lie derivative of all parts along a flow of points, in one row."""
        sizes = {part: np.abs(here).max() or 1 for part, here in self._parts.items()}
        rows = []
        for place, weight in STENCIL.items():
            parts = self.parts(flow(np.full(POINTS, place * STEP)))
            rows.append(weight / STEP * np.concatenate([parts[part].ravel() / sizes[part] for part in parts]))
        return np.asarray(np.sum(rows, axis=0), dtype=float)

    def shift(self, name: str, amount: Array) -> Image:
        """One coordinate shifted."""
        return {**self.values, name: self.values[name] + amount}, self.here[1]

    def displace(self, x: str, y: str, turning: Sequence[str], angle: Array, shift: Any = (0, 0)) -> Image:
        """The plane displaced, and the angles `turning` with it."""
        px, py, cosine, sine = self.values[x], self.values[y], np.cos(angle), np.sin(angle)
        moved = {**self.values, **{name: self.values[name] + angle for name in turning}}
        moved[x], moved[y] = cosine * px - sine * py + shift[0], sine * px + cosine * py + shift[1]
        tangent = self.here[1].copy()
        i, j = self.mechanism.coordinates.index(x), self.mechanism.coordinates.index(y)
        tangent[:, i, i], tangent[:, i, j], tangent[:, j, i], tangent[:, j, j] = cosine, -sine, sine, cosine
        return moved, tangent

    def parts(self, image: Image) -> dict[str, Array]:
        """Name -> tensor [p, ...] at the points' images, brought back to the points by the tangent map T."""
        values, T = image
        m = self.mechanism
        scope = dict(values)

        def tensor(rows: Sequence[Sequence[str]]) -> Array:
            entries = [[np.broadcast_to(evaluate(text, scope), POINTS) for text in row] for row in rows]
            return np.moveaxis(np.array(entries, dtype=float), -1, 0)

        with np.errstate(all="ignore"):
            for name, text in m.definitions.items():
                scope[name] = evaluate(text, scope)
            units = self._units
            qdot = np.stack([values[name] for name in m.rates], axis=-1)
            scope |= dict(zip(m.rates, np.einsum("pij,pj->ip", T, qdot / units), strict=True))
            parts = {"inertia": np.swapaxes(T, 1, 2) @ tensor(m.inertia) @ T / np.outer(units, units)}
            if m.one_forms:
                forms = tensor(m.one_forms) @ T / units
                parts["constraints"] = np.linalg.pinv(forms) @ forms if np.isfinite(forms).all() else forms
            parts |= {f"force {name!r}": (tensor([row]) @ T)[:, 0] / units for name, row in m.forces.items()}
            parts["potential"] = tensor([[m.potential]])
            parts["drag"] = tensor([[m.rayleigh]])
            if self.frame is not None:
                fields = np.linalg.solve(T, np.swapaxes(tensor(self.frame), 1, 2))
                parts |= {f"vector field {i + 1}": fields[:, :, i] * units for i in range(fields.shape[2])}
        return parts
