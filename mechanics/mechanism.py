"""`Mechanism`: a simple mechanical control system with nonholonomic constraints, as data.

It is the tuple of section 2 and 3 of Bullo and Zefran (configuration manifold, inertia tensor,
constraint one-forms, control one-forms), written as expressions in the coordinates and the
parameters, plus what an environment needs to know (limits, which coordinates are the pose).
Everything else in this project is derived from it.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
import reprlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from mechanics import spec as specs
from mechanics.bodies import COLOURS, SHAPES, Body
from mechanics.expressions import (
    MAX_SIZE,
    QUANTITY,
    ExpressionError,
    Extent,
    check_name,
    evaluate,
    extent,
    names_in,
    to_sympy,
    unknown_name,
)
from mechanics.spec import Matrix, MechanismError

if TYPE_CHECKING:
    import sympy as sp
    from numpy.typing import ArrayLike, NDArray

__all__ = ["Matrix", "Mechanism", "MechanismError"]

# Two independent evaluations of an identity that holds agree to about 1e-15 of its terms; one
# that does not hold fails by the order of its terms at a random point.
IDENTITY_TOLERANCE = 1e-9
# Smallest eigenvalue of the inertia tensor scaled to unit diagonal that counts as positive: well
# above rounding, below J_r = m l^2 (1 - 1e-9) on the snakeboard.
POSITIVE_TOLERANCE = 1e-12
SAMPLES = 6

# With these, checking a mechanism takes less than a second whatever it is (tests/mechanics/test_spec.py).
MOST = {
    "coordinate": 64,
    "parameter": 256,
    "control": 64,
    "definition": 256,
    "drag coefficient": 64,
    "frame": 16,
    "body": 256,
}
MAX_CHARACTERS = 100_000  # of all expressions together; a snake of twenty links has 23,000


@dataclass(frozen=True, kw_only=True)
class Mechanism:
    """Inertia tensor, constraint one-forms and control forces over n coordinates.

    The object checks itself on construction, numerically at a few random configurations: names,
    sizes, a positive definite inertia tensor, independent constraints, frames that are
    independent and annihilated by the one-forms, drag that does not drive.

    Attributes:
        name: lower-case identifier.
        coordinates: n names q^i. Angles in rad, lengths in m.
        parameters: name -> default value (SI units).
        inertia: [n, n] entries M_ij(q) of the kinetic energy 1/2 M_ij q̇^i q̇^j.
        one_forms: [c, n] rows omega with omega(q) q̇ = 0 (rows are covectors); may be empty.
        forces: control name -> [n] covector F_a(q); the force on the mechanism is sum_a u_a F_a.
        potential: potential energy V(q) in J.
        definitions: shorthand -> expression, as in the source; one may use those before it.
        frames: frame name -> [k, n] rows = vector fields X_i(q) that span the k = n - c dimensional
            distribution D. The first is the default. One that is not orthogonal in the inertia
            tensor is orthogonalised, row after row, where it is used; without any, one is found.
        citation: where the model comes from.
        fibre: names of (x, y, heading) when the mechanism moves in the plane, else empty.
        joint_limits: coordinate -> largest |q| in rad (inelastic stops).
        torque_limits: control -> largest |u| in N m (or N).
        observation: label -> expression that an environment observes by default.
        forward: expression in the parameters whose sign says which way along x the mechanism is
            driven by its gaits.
        rayleigh: Rayleigh's function R in W, quadratic in the rates NAME_dot of the coordinates, with
            coefficients named in `drag`; the drag is the one-form -dR/dq̇. It acts where it is asked for.
        drag: coefficient of R -> default value (N s/m for wheels, N m s for joints).
        bodies: name -> what is drawn of the mechanism, seen from above. No equation follows from them.
    """

    name: str
    coordinates: tuple[str, ...]
    parameters: Mapping[str, float]
    inertia: Matrix
    one_forms: Matrix
    forces: Mapping[str, tuple[str, ...]]
    frames: Mapping[str, Matrix] = field(default_factory=dict)
    potential: str = "0"
    definitions: Mapping[str, str] = field(default_factory=dict)
    citation: str = ""
    fibre: tuple[str, ...] = ()
    joint_limits: Mapping[str, float] = field(default_factory=dict)
    torque_limits: Mapping[str, float] = field(default_factory=dict)
    observation: Mapping[str, str] = field(default_factory=dict)
    forward: str = "1"
    rayleigh: str = "0"
    drag: Mapping[str, float] = field(default_factory=dict)
    bodies: Mapping[str, Body] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._check_names()
        self._check_bodies()
        self._check_amount()
        self._check_sizes()
        self._check_expressions()
        with np.errstate(all="ignore"):  # what is not finite is seen, and said better, below
            self.resolve({})
            self._check_geometry()

    @classmethod
    def from_dict(cls, spec: Mapping[str, Any]) -> Mechanism:
        """Build a mechanism from plain data.

        Args:
            spec: name, coordinates, parameters {name: default}, inertia [[str]], one_forms [[str]], forces
                {name: [str]} and optionally potential, frame [[str]] (rows = vector fields, the default frame),
                frames {name: [[str]]} and the other attributes of this class. A number may stand in
                place of an expression, and definitions may be in any order.
        """
        return cls(**specs.arguments(spec))

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Mechanism:
        """Build a mechanism from a TOML or JSON file (UTF-8) with the keys that `from_dict` takes."""
        spec = specs.read(path)
        try:
            return cls.from_dict(spec)
        except MechanismError as error:
            raise MechanismError(f"{os.fspath(path)}: {error}") from None

    def to_dict(self, *, drawing: bool = True) -> dict[str, Any]:
        """Return the plain data of this mechanism; `from_dict` makes an equal one of it.

        Args:
            drawing: whether with the bodies, from which nothing follows but pictures.
        """
        data = dataclasses.asdict(self)
        if not drawing:
            del data["bodies"]
        return data

    # -- sizes ---------------------------------------------------------------------------------

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return len(self.coordinates)

    @property
    def rank(self) -> int:
        """Number k = n - c of pseudo-velocities."""
        return self.n - len(self.one_forms)

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the m controls."""
        return tuple(self.forces)

    def frame_rows(self, frame: str | Sequence[Sequence[str]] | None = None) -> Matrix | None:
        """Rows of a frame given by name, by vector fields, or by None (the default frame, None if there is none)."""
        if frame is None:
            return next(iter(self.frames.values()), None)
        if isinstance(frame, str):
            if frame not in self.frames:
                raise MechanismError(f"{self.name}: {unknown_name('frame', frame, self.frames)}")
            return self.frames[frame]
        rows = specs.matrix(frame, "frame")
        self._check_frame_size(rows, "given")
        for text in (text for row in rows for text in row):
            self._extent("frame 'given'", text, self._known)
        with np.errstate(all="ignore"):
            self._check_frame(rows, "given")
        return rows

    # -- values --------------------------------------------------------------------------------

    def resolve(self, params: Mapping[str, float] | None) -> dict[str, float]:
        """All parameters, defaults replaced by `params`; raise `MechanismError` for impossible ones."""
        values = dict(self.parameters)
        if not isinstance(params, Mapping | None):
            raise MechanismError(f"{self.name}: params must map parameters to numbers, got {params!r}")
        for name, value in (params or {}).items():
            if name not in values:
                raise MechanismError(f"{self.name}: {unknown_name('parameter', str(name), values)}")
            values[name] = value
        values = {name: specs.number(value, f"{self.name}: parameter {name}") for name, value in values.items()}
        points = self._sample_configurations()
        inertia = self._finite("the inertia tensor", self.inertia, {**values, **points})
        with np.errstate(all="ignore"):  # of a negative number, for one
            scale = 1 / np.sqrt(np.diagonal(inertia, axis1=1, axis2=2))
            scaled = inertia * scale[:, :, None] * scale[:, None, :]
        usable = np.asarray(np.isfinite(scaled).all(axis=(1, 2)))
        smallest = np.linalg.eigvalsh(np.where(usable[:, None, None], scaled, 0.0))[:, 0]
        if (refused := np.flatnonzero(~(smallest > POSITIVE_TOLERANCE))).size:
            sample = refused[0]
            given = ", ".join(f"{name}={value:g}" for name, value in values.items())
            raise MechanismError(
                f"{self.name}: the inertia tensor is not positive definite with {given}; such a body cannot exist. "
                f"At {_at(points, sample)} it is {reprlib.repr(np.round(inertia[sample], 6).tolist())}"
            )
        return values

    def numeric(self, entries: Matrix | Iterable[str], values: Mapping[str, ArrayLike]) -> NDArray[np.float64]:
        """Numbers for a matrix or a row of expressions, given coordinates and parameters by name.

        Args:
            entries: rows of expressions, or one row.
            values: numbers, or arrays of one shape, which the result has in front: (..., rows, columns).
        """
        scope = {name: np.asarray(value, dtype=float) for name, value in values.items()}
        shape = np.broadcast_shapes(*(value.shape for value in scope.values()))
        for name, text in self.definitions.items():
            scope[name] = evaluate(text, scope)
        rows: list[Any] = list(entries)
        single = bool(rows) and isinstance(rows[0], str)
        table = [rows] if single else rows
        result = np.empty((*shape, len(table), len(table[0]) if table else self.n))
        for i, row in enumerate(table):
            for j, text in enumerate(row):
                result[..., i, j] = evaluate(text, scope)
        return result[..., 0, :] if single else result

    def direction(self, params: Mapping[str, float]) -> float:
        """The way along x in which gaits drive it with these parameters: +1, -1, or 0 for neither."""
        return float(np.sign(evaluate(self.forward, params)))

    def drag_coefficients(self, drag: bool | Mapping[str, float] | None) -> dict[str, float] | None:
        """Coefficients of the drag that acts, or None if none does: here, and nowhere else, this is decided.

        Args:
            drag: None or False for none, True for the defaults, or coefficients by name that replace some of them.

        Raises:
            MechanismError: the mechanism has no drag, or a coefficient is misspelt, negative or not a finite number.
        """
        if drag is None or (isinstance(drag, bool | np.bool_) and not drag):
            return None
        if not isinstance(drag, bool | np.bool_ | Mapping):
            raise MechanismError(f"{self.name}: drag must be True, False or coefficients by name, got {drag!r}")
        if self.rayleigh == "0":
            raise MechanismError(
                f"{self.name} has no drag: it declares no Rayleigh function (rayleigh, and drag for its coefficients), "
                f"as these do: {', '.join(_with_drag())}"
            )
        values = {name: float(value) for name, value in self.drag.items()}
        for name, value in drag.items() if isinstance(drag, Mapping) else ():
            if name not in values:
                raise MechanismError(f"{self.name}: {unknown_name('drag coefficient', str(name), values)}")
            values[name] = specs.number(value, f"{self.name}: drag coefficient {name}")
        self._check_coefficients(values)
        return values

    def without_drag(self) -> Mechanism:
        """The same mechanism, as if no drag were known of it."""
        return self if self.rayleigh == "0" else dataclasses.replace(self, rayleigh="0", drag={})

    @property
    def rates(self) -> tuple[str, ...]:
        """Names of the rates of the coordinates."""
        return tuple(f"{name}_dot" for name in self.coordinates)

    @property
    def symbols(self) -> dict[str, sp.Symbol]:
        """SymPy symbols of the coordinates, parameters, controls and drag coefficients, by name."""
        import sympy as sp

        names = (*self.coordinates, *self.parameters, *self.controls, *self.drag)
        return {name: sp.Symbol(name) for name in names}

    def scope(self, fixed: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """SymPy meaning of every name, definitions written out, with the values in `fixed` put in."""
        scope: dict[str, Any] = {**self.symbols, **(fixed or {})}
        for name, definition in self.definitions.items():
            scope[name] = to_sympy(definition, scope)
        return scope

    def symbolic(self, text: str) -> sp.Expr:
        """Exact SymPy expression of one entry."""
        return to_sympy(text, self.scope())

    # -- checks --------------------------------------------------------------------------------

    def _check_names(self) -> None:
        try:
            check_name(self.name, "mechanism name")
            self._check_quantities()
        except ExpressionError as error:
            raise MechanismError(str(error)) from None

    def _check_quantities(self) -> None:
        groups: dict[str, Iterable[str]] = {
            "coordinate": self.coordinates,
            "parameter": self.parameters,
            "control": self.forces,
            "definition": self.definitions,
            "drag coefficient": self.drag,
        }
        seen: dict[str, str] = {}
        for kind, names in groups.items():
            for name in names:
                check_name(name, kind)
                if re.fullmatch(r"v\d+", name):
                    raise MechanismError(f"{self.name}: {kind} {name!r} is kept for the pseudo-velocities")
                if name.endswith("_dot"):
                    raise MechanismError(f"{self.name}: {kind} {name!r}: the ending _dot is kept for rates")
                if name in seen:
                    raise MechanismError(f"{self.name}: {name!r} is both a {seen[name]} and a {kind}")
                seen[name] = kind

    def _check_amount(self) -> None:
        amounts = (
            self.coordinates,
            self.parameters,
            self.forces,
            self.definitions,
            self.drag,
            self.frames,
            self.bodies,
        )
        for (kind, most), things in zip(MOST.items(), amounts, strict=True):
            if len(things) > most:
                several = "bodies" if kind == "body" else f"{kind}s"
                raise MechanismError(f"{self.name}: {len(things)} {several}; at most {most} are handled")
        texts = [*self.definitions.values(), *self.observation.values(), *(text for _, text in self._entries())]
        if (total := sum(len(str(text)) for text in texts)) > MAX_CHARACTERS:
            raise MechanismError(
                f"{self.name}: expressions of {total} characters; at most {MAX_CHARACTERS} are handled. "
                "Definitions save writing the same twice"
            )

    def _check_sizes(self) -> None:
        n = self.n
        if not n:
            raise MechanismError(f"{self.name}: at least one coordinate is needed")
        if len(self.inertia) != n or any(len(row) != n for row in self.inertia):
            raise MechanismError(f"{self.name}: inertia must be {n} x {n}, got {_size(self.inertia)}")
        if any(len(row) != n for row in self.one_forms) or len(self.one_forms) >= n:
            raise MechanismError(
                f"{self.name}: one_forms must be c rows of {n} with c < {n}, got {_size(self.one_forms)}"
            )
        for name, row in self.forces.items():
            if len(row) != n:
                raise MechanismError(f"{self.name}: force {name!r} must have {n} components, got {len(row)}")
        for name, rows in self.frames.items():
            self._check_frame_size(rows, name)
        for kind, names, known in (
            ("joint limit for", self.joint_limits, self.coordinates),
            ("torque limit for", self.torque_limits, self.controls),
            ("fibre coordinate", self.fibre, self.coordinates),
        ):
            for name in names:
                if name not in known:
                    raise MechanismError(f"{self.name}: {unknown_name(kind, name, known)}")
        for name, limit in (*self.joint_limits.items(), *self.torque_limits.items()):
            if not (math.isfinite(limit) and limit > 0):
                raise MechanismError(f"{self.name}: the limit of {name} must be positive and finite, got {limit}")
        if len(set(self.fibre)) != len(self.fibre) or len(self.fibre) not in (0, 3):
            raise MechanismError(f"{self.name}: fibre names (x, y, heading), got {self.fibre}")
        self._check_coefficients(self.drag)

    def _check_bodies(self) -> None:
        before: list[str] = []
        for name, body in self.bodies.items():
            where = f"{self.name}: body {name!r}"
            if not isinstance(body, Body) or not name:
                raise MechanismError(f"{where} must be a mechanics.Body with a name, got {body!r}")
            if body.shape not in SHAPES:
                raise MechanismError(f"{where}: {unknown_name('shape', body.shape, SHAPES)}")
            if len(body.pose) != 3:
                raise MechanismError(f"{where}: pose must be (x, y, angle), got {body.pose}")
            if len(body.size) != len(SHAPES[body.shape]):
                raise MechanismError(
                    f"{where}: the size of a {body.shape} must be ({', '.join(SHAPES[body.shape])}), got {body.size}"
                )
            if body.colour not in COLOURS:
                raise MechanismError(f"{where}: {unknown_name('colour', body.colour, COLOURS)}")
            if body.on and body.on not in before:
                raise MechanismError(f"{where}, on: {unknown_name('body before it', body.on, before)}")
            before.append(name)

    def _check_frame_size(self, rows: Matrix, name: str) -> None:
        if len(rows) != self.rank or any(len(row) != self.n for row in rows):
            raise MechanismError(
                f"{self.name}: frame {name!r} must be {self.rank} vector fields of {self.n}, got {_size(rows)}"
            )

    def _check_coefficients(self, drag: Mapping[str, float]) -> None:
        for name, value in drag.items():
            if not (math.isfinite(value) and value >= 0):
                raise MechanismError(f"{self.name}: drag coefficient {name} must be at least 0 and finite, got {value}")

    # -- checks of expressions -----------------------------------------------------------------

    def _entries(self) -> Iterator[tuple[str, str]]:
        """Every expression in coordinates, parameters and definitions, after what it is part of."""
        matrices = {"inertia": self.inertia, "one_forms": self.one_forms}
        matrices |= {f"force {name!r}": (row,) for name, row in self.forces.items()}
        matrices |= {f"frame {name!r}": rows for name, rows in self.frames.items()}
        matrices["potential"] = ((self.potential,),)
        matrices |= {f"body {name!r}": (body.pose, body.size) for name, body in self.bodies.items()}
        return ((kind, text) for kind, rows in matrices.items() for row in rows for text in row)

    @cached_property
    def _known(self) -> dict[str, Extent]:
        """How large the meaning of each name is: coordinates, parameters and definitions."""
        known = dict.fromkeys((*self.coordinates, *self.parameters), QUANTITY)
        for name, text in self.definitions.items():
            known[name] = self._extent(f"definition {name!r}", text, known)
        return known

    def _extent(self, kind: str, text: str, known: Mapping[str, Extent]) -> Extent:
        try:
            for name in names_in(text) - known.keys():
                if name in self.definitions and kind.startswith("definition"):
                    raise ExpressionError(f"{name!r} is used before it is defined")
            return extent(text, known)
        except ExpressionError as error:
            raise MechanismError(f"{self.name}: in {kind}: {error}") from None

    def _check_expressions(self) -> None:
        known = self._known
        sizes = [known[name].size for name in self.definitions]
        sizes += [self._extent(kind, text, known).size for kind, text in self._entries()]
        if (size := sum(sizes)) > MAX_SIZE:
            raise MechanismError(
                f"{self.name}: with all definitions written out there are {size} operations; "
                f"at most {MAX_SIZE} are handled"
            )
        self._extent("forward", self.forward, dict.fromkeys(self.parameters, QUANTITY))
        self._extent("rayleigh", self.rayleigh, known | dict.fromkeys((*self.drag, *self.rates), QUANTITY))
        for label, text in self.observation.items():
            try:
                names_in(text)  # tasks know more names than we do here
            except ExpressionError as error:
                raise MechanismError(f"{self.name}: in observation {label!r}: {error}") from None

    # -- checks of numbers, at random points ---------------------------------------------------

    def _check_geometry(self) -> None:
        points = self._sample_points()
        inertia = self._finite("the inertia tensor", self.inertia, points)
        size = np.sqrt(np.abs(np.diagonal(inertia, axis1=1, axis2=2)))
        skew = np.abs(inertia - inertia.swapaxes(1, 2)) > IDENTITY_TOLERANCE * size[:, :, None] * size[:, None, :]
        if skew.any():
            sample, i, j = np.argwhere(skew)[0]
            raise MechanismError(
                f"{self.name}: the inertia tensor is not symmetric: entry ({i + 1}, {j + 1}) is "
                f"{inertia[sample, i, j]} "
                f"and entry ({j + 1}, {i + 1}) is {inertia[sample, j, i]} at {_at(points, sample)}"
            )
        if self.one_forms:
            forms, _ = _unit_rows(self._finite("one_forms", self.one_forms, points))
            if not _independent(forms):
                raise MechanismError(
                    f"{self.name}: the {len(self.one_forms)} constraint one-forms are not independent at a random "
                    "configuration; leave out those that follow from the others"
                )
        for name, row in (*self.forces.items(), ("potential", (self.potential,))):
            # A logarithm may have no value at some configurations, but must have one somewhere.
            if not np.isfinite(self.numeric(row, points)).all(axis=1).any():
                kind = name if name == "potential" else f"force {name!r}"
                raise MechanismError(f"{self.name}: {kind} is not finite at any of {SAMPLES} random configurations")
        for name, rows in self.frames.items():
            self._check_frame(rows, name)
        self._check_drag()
        for name, body in self.bodies.items():
            self._finite(f"the pose of body {name!r}", (body.pose,), points)
            size = self._finite(f"the size of body {name!r}", (body.size,), points)[:, 0]
            if (size < 0).any():
                sample, entry = np.argwhere(size < 0)[0]
                raise MechanismError(
                    f"{self.name}: body {name!r}: its {SHAPES[body.shape][entry]} must be at least 0, but "
                    f"{body.size[entry]!r} is {size[sample, entry]:.3g} at {_at(points, sample)}"
                )

    def _finite(self, what: str, entries: Matrix, points: Mapping[str, Any]) -> NDArray[np.float64]:
        """Values [samples, rows, columns] of a matrix, all finite."""
        values = self.numeric(entries, points)
        finite = np.isfinite(values)
        if not finite.all():
            sample, row, column = np.argwhere(~finite)[0]
            raise MechanismError(
                f"{self.name}: {what} is not finite: entry ({row + 1}, {column + 1}), {entries[row][column]!r}, "
                f"is {values[sample, row, column]} at {_at(points, sample)}"
            )
        return values

    def _check_frame(self, rows: Matrix, name: str) -> None:
        """Check that the rows span D."""
        where = f"{self.name}: frame {name!r}"
        points = self._sample_points()
        fields, size = _unit_rows(self._finite(f"frame {name!r}", rows, points))
        if not size.all():
            sample, row = np.argwhere(size == 0)[0]
            raise MechanismError(f"{where}: vector field {row + 1} is zero at {_at(points, sample)}")
        if self.one_forms:
            forms, _ = _unit_rows(self.numeric(self.one_forms, points))
            residual = np.abs(forms @ fields.swapaxes(1, 2)).max(axis=0)
            if residual.max() > IDENTITY_TOLERANCE:
                form, row = np.unravel_index(residual.argmax(), residual.shape)
                raise MechanismError(f"{where}: vector field {row + 1} violates constraint one-form {form + 1}")
        if not _independent(fields):
            raise MechanismError(
                f"{where}: its {self.rank} vector fields are not independent at a random configuration; "
                f"{self.rank} independent ones are needed to span D"
            )

    def _check_drag(self) -> None:
        """Check that R is a quadratic form in the rates that no motion makes negative."""
        if self.rayleigh == "0":
            return
        # A coefficient of zero would hide what it multiplies.
        points: dict[str, Any] = {**self._sample_points(), **{name: value or 1.0 for name, value in self.drag.items()}}
        tensor = self.drag_tensor(points)
        qdot = np.random.default_rng(4).uniform(-1, 1, (SAMPLES, self.n))
        power = self._rayleigh(qdot, points)
        quadratic = 0.5 * np.einsum("sa,sab,sb->s", qdot, tensor, qdot)
        largest = np.abs(tensor).max(axis=(1, 2))
        if not (np.abs(power - quadratic) <= IDENTITY_TOLERANCE * largest).all():
            raise MechanismError(
                f"{self.name}: rayleigh must be quadratic in the rates {', '.join(self.rates)} of the coordinates"
            )
        if not (np.linalg.eigvalsh(tensor)[:, 0] >= -IDENTITY_TOLERANCE * largest).all():
            raise MechanismError(f"{self.name}: rayleigh is negative for some velocities: it would drive, not brake")

    def drag_tensor(self, values: Mapping[str, ArrayLike]) -> NDArray[np.float64]:
        """[..., n, n] second derivatives of R in the rates, given coordinates, parameters and coefficients by name."""
        scope = {name: np.asarray(value, dtype=float)[..., None, None] for name, value in values.items()}
        e = np.eye(self.n)
        single = self._rayleigh(e[:, None], scope)  # [..., n, 1]
        return self._rayleigh(e[:, None] + e, scope) - single - single.swapaxes(-1, -2)

    def _rayleigh(self, qdot: NDArray[np.float64], values: Mapping[str, ArrayLike]) -> NDArray[np.float64]:
        """R for rates [..., n]."""
        return self.numeric(
            (self.rayleigh,), {**values, **dict(zip(self.rates, np.moveaxis(qdot, -1, 0), strict=True))}
        )[..., 0]

    def _sample_configurations(self) -> dict[str, NDArray[np.float64]]:
        """Fixed pseudo-random configurations within the joint limits: coordinate -> [samples]."""
        limits = np.array([[self.joint_limits.get(name, math.pi)] for name in self.coordinates])
        points = limits * np.random.default_rng(0).uniform(-1, 1, (SAMPLES, self.n)).T
        return dict(zip(self.coordinates, points, strict=True))

    def _sample_points(self) -> dict[str, NDArray[np.float64]]:
        """Configurations with parameters near the defaults: identities must hold at all of them."""
        factors = np.random.default_rng(1).uniform(0.9, 1.1, (SAMPLES, len(self.parameters))).T
        values = (value * factor for value, factor in zip(self.parameters.values(), factors, strict=True))
        return {**dict(zip(self.parameters, values, strict=True)), **self._sample_configurations()}


def _with_drag() -> list[str]:
    """Names of the mechanisms of the catalogue that declare drag."""
    from mechanics.catalog import get, names  # which is made of mechanisms

    return [name for name in names() if get(name).rayleigh != "0"]


def _unit_rows(matrices: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Matrices [..., r, n] with rows of length one where they are not zero, and sizes [..., r] of the rows given."""
    size = np.abs(matrices).max(axis=-1, initial=0.0)
    rows = matrices / np.where(size > 0, size, 1.0)[..., None]  # first, lest a square overflow
    length = np.linalg.norm(rows, axis=-1)
    unit: NDArray[np.float64] = rows / np.where(length > 0, length, 1.0)[..., None]
    return unit, size


def _independent(matrices: NDArray[np.float64]) -> bool:
    """Whether the rows, of length one, are independent in every matrix."""
    return bool((np.linalg.svd(matrices, compute_uv=False)[..., -1] > IDENTITY_TOLERANCE).all())


def _at(points: Mapping[str, NDArray[np.float64]], sample: int) -> str:
    return ", ".join(f"{name}={values[sample]:.3g}" for name, values in points.items() if np.ndim(values))


def _size(rows: Matrix) -> str:
    return f"{len(rows)} rows of {sorted({len(row) for row in rows})}"
