"""`Mechanism`: a simple mechanical control system with nonholonomic constraints, as data.

It is the tuple of section 2 and 3 of Bullo and Zefran (configuration manifold, inertia tensor,
constraint one-forms, control one-forms), written as expressions in the coordinates and the
parameters, plus what an environment needs to know (limits, which coordinates are the pose).
Everything else in this project is derived from it.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from mechanics.expressions import (
    ExpressionError,
    check_name,
    evaluate,
    names_in,
    to_sympy,
    unknown_name,
)

if TYPE_CHECKING:
    import sympy as sp
    from numpy.typing import NDArray

__all__ = ["Matrix", "Mechanism", "MechanismError"]

Matrix = tuple[tuple[str, ...], ...]

# Two independent evaluations of an identity that holds agree to about 1e-15 of its terms; one
# that does not hold fails by the order of its terms at a random point.
IDENTITY_TOLERANCE = 1e-9
# Smallest eigenvalue of the inertia tensor scaled to unit diagonal that counts as positive: well
# above rounding, below J_r = m l^2 (1 - 1e-9) on the snakeboard.
POSITIVE_TOLERANCE = 1e-12
SAMPLES = 6

_SPEC_KEYS = (
    "name", "coordinates", "parameters", "inertia", "one_forms", "forces", "potential", "frame", "frames",
    "definitions", "citation", "fibre", "joint_limits", "torque_limits", "observation", "forward",
)  # fmt: skip
_MAPPINGS = ("parameters", "forces", "frames", "definitions", "joint_limits", "torque_limits", "observation")


class MechanismError(ValueError):
    """The data do not describe a mechanism; the message says what was given and expected."""


@dataclass(frozen=True, kw_only=True)
class Mechanism:
    """Inertia tensor, constraint one-forms and control forces over n coordinates.

    The object checks itself on construction, numerically at a few random configurations: names,
    sizes, a positive definite inertia tensor, independent constraints, frames that are
    orthogonal and annihilated by the one-forms.

    Attributes:
        name: lower-case identifier.
        coordinates: n names q^i. Angles in rad, lengths in m.
        parameters: name -> default value (SI units).
        inertia: [n, n] entries M_ij(q) of the kinetic energy 1/2 M_ij q̇^i q̇^j.
        one_forms: [c, n] rows omega with omega(q) q̇ = 0 (rows are covectors); may be empty.
        forces: control name -> [n] covector F_a(q); the force on the mechanism is sum_a u_a F_a.
        potential: potential energy V(q) in J.
        definitions: shorthand -> expression, as in the source; one may use those before it.
        frames: frame name -> [k, n] rows = vector fields X_i(q), orthogonal, spanning the k = n - c
            dimensional distribution D. The first is the default.
        citation: where the model comes from.
        fibre: names of (x, y, heading) when the mechanism moves in the plane, else empty.
        joint_limits: coordinate -> largest |q| in rad (inelastic stops).
        torque_limits: control -> largest |u| in N m (or N).
        observation: label -> expression that an environment observes by default.
        forward: expression in the parameters whose sign says which way along x the mechanism is
            driven by its gaits.
    """

    name: str
    coordinates: tuple[str, ...]
    parameters: Mapping[str, float]
    inertia: Matrix
    one_forms: Matrix
    forces: Mapping[str, tuple[str, ...]]
    frames: Mapping[str, Matrix]
    potential: str = "0"
    definitions: Mapping[str, str] = field(default_factory=dict)
    citation: str = ""
    fibre: tuple[str, ...] = ()
    joint_limits: Mapping[str, float] = field(default_factory=dict)
    torque_limits: Mapping[str, float] = field(default_factory=dict)
    observation: Mapping[str, str] = field(default_factory=dict)
    forward: str = "1"

    def __post_init__(self) -> None:
        self._check_names()
        self._check_sizes()
        self._check_expressions()
        self.resolve({})
        self._check_geometry()

    @classmethod
    def from_dict(cls, spec: Mapping[str, Any]) -> Mechanism:
        """Build a mechanism from plain data, such as a parsed TOML or JSON file.

        Args:
            spec: name, coordinates, parameters {name: default}, inertia [[str]], one_forms [[str]], forces
                {name: [str]} and optionally potential, frame [[str]] (rows = vector fields, the default frame),
                frames {name: [[str]]} and the other attributes of this class.
        """
        if not isinstance(spec, Mapping):
            raise MechanismError(f"a mechanism's spec must be a mapping, not {type(spec).__name__}")
        for key in spec:
            if key not in _SPEC_KEYS:
                raise MechanismError(f"in the mechanism's spec: {unknown_name('key', str(key), _SPEC_KEYS)}")
        for key in ("name", "coordinates", "parameters", "inertia", "one_forms", "forces"):
            if key not in spec:
                raise MechanismError(f"the mechanism's spec lacks {key!r}; it has {', '.join(map(str, spec))}")
        data = dict(spec)
        for key in _MAPPINGS:
            if not isinstance(data.get(key, {}), Mapping):
                raise MechanismError(f"{key} must map names to values, not {data[key]!r}")
        for key in ("parameters", "joint_limits", "torque_limits"):
            data[key] = {name: _number(value, f"{key}: {name}") for name, value in data.get(key, {}).items()}
        frames = {name: _matrix(rows, f"frame {name!r}") for name, rows in data.pop("frames", {}).items()}
        if "frame" in data:
            frames = {"default": _matrix(data.pop("frame"), "frame"), **frames}
        forces = {name: _row(row, f"force {name!r}") for name, row in data.pop("forces").items()}
        return cls(
            coordinates=_row(data.pop("coordinates"), "coordinates"),
            inertia=_matrix(data.pop("inertia"), "inertia"),
            one_forms=_matrix(data.pop("one_forms"), "one_forms"),
            fibre=_row(data.pop("fibre", ()), "fibre"),
            forces=forces,
            frames=frames,
            **data,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the plain data of this mechanism; `from_dict` makes an equal one of it."""
        return dataclasses.asdict(self)

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

    def frame_rows(self, frame: str | Sequence[Sequence[str]] | None = None) -> Matrix:
        """Rows of a frame given by name, by vector fields, or by None (the default frame)."""
        if frame is None:
            return next(iter(self.frames.values()))
        if isinstance(frame, str):
            if frame not in self.frames:
                raise MechanismError(f"{self.name}: {unknown_name('frame', frame, self.frames)}")
            return self.frames[frame]
        rows = _matrix(frame, "frame")
        self._check_frame(rows, "given")
        return rows

    # -- values --------------------------------------------------------------------------------

    def resolve(self, params: Mapping[str, float] | None) -> dict[str, float]:
        """All parameters, defaults replaced by `params`; raise `MechanismError` for impossible ones."""
        values = {name: float(value) for name, value in self.parameters.items()}
        for name, value in (params or {}).items():
            if name not in values:
                raise MechanismError(f"{self.name}: {unknown_name('parameter', name, values)}")
            values[name] = _number(value, f"{self.name}: parameter {name}")
        for name, value in values.items():
            if not math.isfinite(value):
                raise MechanismError(f"{self.name}: parameter {name} = {value} is not finite")
        for q in self._sample_configurations():
            inertia = self.numeric(self.inertia, {**values, **q})
            diagonal = np.diag(inertia)
            if np.isfinite(inertia).all() and (diagonal > 0).all():
                scale = 1 / np.sqrt(diagonal)
                if np.linalg.eigvalsh(inertia * np.outer(scale, scale))[0] > POSITIVE_TOLERANCE:
                    continue
            given = ", ".join(f"{name}={value:g}" for name, value in values.items())
            raise MechanismError(
                f"{self.name}: the inertia tensor is not positive definite with {given}; such a body cannot exist. "
                f"At {', '.join(f'{k}={v:.3f}' for k, v in q.items())} it is {np.round(inertia, 6).tolist()}"
            )
        return values

    def numeric(self, entries: Matrix | Iterable[str], values: Mapping[str, float]) -> NDArray[np.float64]:
        """Numbers for a matrix or a row of expressions, given coordinates and parameters by name."""
        scope = dict(values)
        with np.errstate(all="ignore"):
            for name, text in self.definitions.items():
                scope[name] = evaluate(text, scope)
            rows = [row if isinstance(row, str) else tuple(row) for row in entries]
            if rows and isinstance(rows[0], str):
                return np.array([float(evaluate(str(text), scope)) for text in rows])
            return np.array([[float(evaluate(text, scope)) for text in row] for row in rows], dtype=float)

    @property
    def symbols(self) -> dict[str, sp.Symbol]:
        """SymPy symbols of the coordinates, parameters and controls, by name."""
        import sympy as sp

        return {name: sp.Symbol(name) for name in (*self.coordinates, *self.parameters, *self.controls)}

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
        check_name(self.name, "mechanism name")
        groups: dict[str, Iterable[str]] = {
            "coordinate": self.coordinates,
            "parameter": self.parameters,
            "control": self.forces,
            "definition": self.definitions,
        }
        seen: dict[str, str] = {}
        for kind, names in groups.items():
            for name in names:
                check_name(name, kind)
                if re.fullmatch(r"v\d+", name):
                    raise MechanismError(f"{self.name}: {kind} {name!r} is kept for the pseudo-velocities")
                if name in seen:
                    raise MechanismError(f"{self.name}: {name!r} is both a {seen[name]} and a {kind}")
                seen[name] = kind

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
        if not self.frames:
            raise MechanismError(f"{self.name}: give at least one frame ({self.rank} vector fields that span D)")
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
        if len(self.fibre) not in (0, 3):
            raise MechanismError(f"{self.name}: fibre names (x, y, heading), got {self.fibre}")

    def _check_expressions(self) -> None:
        known = {*self.coordinates, *self.parameters}
        for name, text in self.definitions.items():
            self._check_known(f"definition {name!r}", text, known)
            known.add(name)
        entries = [("inertia", t) for row in self.inertia for t in row]
        entries += [("one_forms", t) for row in self.one_forms for t in row]
        entries += [(f"force {name!r}", t) for name, row in self.forces.items() for t in row]
        entries += [("potential", self.potential)]
        for kind, text in entries:
            self._check_known(kind, text, known)
        self._check_known("forward", self.forward, set(self.parameters))

    def _check_known(self, kind: str, text: str, known: set[str]) -> None:
        try:
            for name in names_in(text) - known:
                raise ExpressionError(unknown_name("name", name, sorted(known)))
        except ExpressionError as error:
            raise MechanismError(f"{self.name}: in {kind}: {error}") from None

    def _check_geometry(self) -> None:
        for values in self._sample_points():
            inertia = self.numeric(self.inertia, values)
            if not np.allclose(inertia, inertia.T, rtol=IDENTITY_TOLERANCE, atol=0):
                raise MechanismError(f"{self.name}: the inertia tensor is not symmetric: {inertia.tolist()}")
            if self.one_forms:
                singular = np.linalg.svd(self.numeric(self.one_forms, values), compute_uv=False)
                if not singular[-1] > IDENTITY_TOLERANCE * singular[0]:
                    raise MechanismError(
                        f"{self.name}: the {len(self.one_forms)} constraint one-forms are not independent at a random "
                        "configuration; leave out those that follow from the others"
                    )
        for name, rows in self.frames.items():
            self._check_frame(rows, name)

    def _check_frame(self, rows: Matrix, name: str) -> None:
        """Check that the rows span D and are orthogonal, at random points."""
        where = f"{self.name}: frame {name!r}"
        if len(rows) != self.rank or any(len(row) != self.n for row in rows):
            raise MechanismError(f"{where} must be {self.rank} vector fields of {self.n}, got {_size(rows)}")
        known = {*self.coordinates, *self.parameters, *self.definitions}
        for text in (text for row in rows for text in row):
            self._check_known(f"frame {name!r}", text, known)
        for values in self._sample_points():
            fields = self.numeric(rows, values)
            if not np.isfinite(fields).all():
                raise MechanismError(f"{where} is not finite at {values}")
            size = np.linalg.norm(fields, axis=1)
            if not size.all():
                raise MechanismError(f"{where}: vector field {int(size.argmin()) + 1} is zero at {values}")
            if self.one_forms:
                forms = self.numeric(self.one_forms, values)
                residual = np.abs(forms @ fields.T) / np.outer(np.linalg.norm(forms, axis=1), size)
                if residual.max() > IDENTITY_TOLERANCE:
                    form, row = np.unravel_index(residual.argmax(), residual.shape)
                    raise MechanismError(f"{where}: vector field {row + 1} violates constraint one-form {form + 1}")
            gram = fields @ self.numeric(self.inertia, values) @ fields.T
            norms = np.sqrt(np.diag(gram))
            cosines = np.abs(gram / np.outer(norms, norms) - np.eye(self.rank))
            if not cosines.max() <= IDENTITY_TOLERANCE:
                i, j = np.unravel_index(cosines.argmax(), cosines.shape)
                raise MechanismError(
                    f"{where}: vector fields {i + 1} and {j + 1} are not orthogonal in the inertia tensor "
                    f"(cosine {cosines[i, j]:.3g}); Theorem 3.2 needs an orthogonal frame"
                )

    def _sample_configurations(self) -> list[dict[str, float]]:
        """Fixed pseudo-random configurations within the joint limits."""
        rng = np.random.default_rng(0)
        limits = np.array([self.joint_limits.get(name, math.pi) for name in self.coordinates])
        points = rng.uniform(-limits, limits, (SAMPLES, self.n))
        return [dict(zip(self.coordinates, map(float, q), strict=True)) for q in points]

    def _sample_points(self) -> list[dict[str, float]]:
        """Configurations with parameters near the defaults: identities must hold at all of them."""
        rng = np.random.default_rng(1)
        return [
            {name: value * rng.uniform(0.9, 1.1) for name, value in self.parameters.items()} | q
            for q in self._sample_configurations()
        ]


def _number(value: Any, what: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise MechanismError(f"{what} must be a number, not {value!r}") from None


def _row(values: Any, what: str) -> tuple[str, ...]:
    if isinstance(values, str) or not isinstance(values, Sequence):
        raise MechanismError(f"{what} must be a list of strings, not {values!r}")
    for value in values:
        if not isinstance(value, str | int | float) or isinstance(value, bool):
            raise MechanismError(f"{what} must be a list of strings, got {value!r}")
    return tuple(str(value) for value in values)


def _matrix(rows: Any, what: str) -> Matrix:
    if isinstance(rows, str) or not isinstance(rows, Sequence):
        raise MechanismError(f"{what} must be a list of rows, not {rows!r}")
    return tuple(_row(row, what) for row in rows)


def _size(rows: Matrix) -> str:
    return f"{len(rows)} rows of {sorted({len(row) for row in rows})}"
