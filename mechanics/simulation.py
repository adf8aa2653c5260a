"""`simulate`: the reduced equations under SciPy's adaptive solvers, for any torque u(t)."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics.jumps import first_jump
from mechanics.mechanism import Mechanism, MechanismError
from mechanics.model import Model

__all__ = ["SimulationError", "Trajectory", "simulate"]

Array = NDArray[np.float64]
Torque = Callable[[float], Array]

# Errors of single steps add up and grow along a motion. A hundredth of the tolerance in each keeps
# the result within it for 10 s of the reference trajectories, which grow up to a hundredfold.
SAFETY = 100
SMALLEST_TOLERANCE = 3e-14  # SciPy's own bound
LEAST_TRUST = 1e-4  # near a pole of the frame; with less, steps would become ever shorter


class SimulationError(RuntimeError):
    """The solver gave up, or the motion ceased to be finite."""


@dataclass(frozen=True)
class Trajectory:
    """A motion at the times that were asked for.

    Attributes:
        t: times in s, shape (N,).
        q: coordinates, shape (N, n).
        qdot: velocities, shape (N, n).
        v: pseudo-velocities in the frame of the simulation, shape (N, k).
        energy: kinetic plus potential energy in J, shape (N,).
        work: work that the controls have done since t[0] in J, shape (N,).
    """

    t: Array
    q: Array
    qdot: Array
    v: Array
    energy: Array
    work: Array


def simulate(
    mechanism: Mechanism,
    t: ArrayLike,
    q0: ArrayLike,
    *,
    v0: ArrayLike | None = None,
    qdot0: ArrayLike | None = None,
    controls: Callable[[float], ArrayLike] | None = None,
    params: Mapping[str, float] | None = None,
    frame: str | Sequence[Sequence[str]] | None = None,
    drag: bool | Mapping[str, float] | None = None,
    rtol: float = 1e-10,
    atol: float = 1e-12,
) -> Trajectory:
    """Integrate the motion of a mechanism with an adaptive Runge-Kutta method of order 8.

    The solver steps onto each requested time, so that no interpolation error enters. Joint limits do
    not act.

    Args:
        mechanism: what moves.
        t: increasing times in s, shape (N,); the motion starts at t[0].
        q0: coordinates at t[0], shape (n,).
        v0: pseudo-velocities in `frame` at t[0], shape (k,); or
        qdot0: velocities at t[0], shape (n,), which must satisfy the constraints. At rest if neither is given.
        controls: function of time -> (m,) controls in N m; none by default. It may jump: the solver
            stops where it does.
        params: values that replace the mechanism's default parameters.
        frame: frame of the pseudo-velocities, as in `mechanics.reduce`.
        drag: False or None for none, True for the mechanism's own, or coefficients by name.
        rtol: relative accuracy aimed at; single steps are held to a hundredth of it.
        atol: absolute accuracy aimed at, likewise.

    Raises:
        SimulationError: the solver failed or the motion ceased to be finite.
        MechanismError: an argument has the wrong shape, is not finite, or violates the constraints.
    """
    model = Model(mechanism, params, frame, drag)
    times = _times(t)
    n, k = mechanism.n, mechanism.rank
    q = _vector(mechanism, q0, n, "q0")
    if v0 is not None and qdot0 is not None:
        raise MechanismError("give v0 or qdot0, not both")
    v = np.zeros(k) if v0 is None else _vector(mechanism, v0, k, "v0")
    if qdot0 is not None:
        v = model.feasible(q, _vector(mechanism, qdot0, n, "qdot0"))
    states = np.empty((len(times), n + k + 1))
    states[0] = np.concatenate([q, v, [0.0]])
    for name, value in (("rtol", rtol), ("atol", atol)):
        if not isinstance(value, Real) or not (math.isfinite(value) and value > 0):
            raise MechanismError(f"{name} must be a positive finite number, got {value!r}")
    rtol, atol = max(rtol / SAFETY, SMALLEST_TOLERANCE), atol / SAFETY
    if controls is not None and not callable(controls):
        raise MechanismError(f"{mechanism.name}: controls must be a function of the time, got {controls!r}")
    torque = None if controls is None else _checked(mechanism, controls)
    if torque is not None and not mechanism.forces:
        torque(times[0])
        torque = None  # nothing of which jumps could be looked for
    with np.errstate(all="ignore"):  # what is not finite is found and named
        for index, (start, end) in enumerate(zip(times[:-1], times[1:], strict=True)):
            states[index + 1] = _integrate(model, torque, start, end, states[index], rtol, atol)
    q_t, v_t, work = states[:, :n], states[:, n : n + k], states[:, -1]
    return Trajectory(times, q_t, model.velocity(q_t, v_t), v_t, model.energy(q_t, v_t), work)


def _integrate(
    model: Model, torque: Torque | None, start: float, end: float, state: Array, rtol: float, atol: float
) -> Array:
    """State at `end`, from jump to jump of the controls."""
    from scipy.integrate import DOP853

    zero = [0.0] * len(model.mechanism.forces)
    while start < end:
        bound, following = end, end

        def rates(time: float, y: Array) -> Array:
            # The last stage may be rounded beyond the end of a piece, to the far side of a jump.
            u = zero if torque is None else torque(min(time, bound)).tolist()  # noqa: B023 (the present bound)
            return np.array(model.scalar_rates(y.tolist(), u))

        solver: Any = DOP853(rates, start, state, bound, rtol=rtol, atol=atol)
        while solver.status == "running":
            if torque is not None:
                jump = first_jump(torque, solver.t, min(solver.t + solver.h_abs, bound))
                if jump is not None and jump[0] < bound:
                    bound, following = jump
                    solver = DOP853(rates, solver.t, solver.y, bound, rtol=rtol, atol=atol)
                    if solver.t == bound:
                        break
            time, y = solver.t, solver.y
            trust = model.trust(y.tolist(), rtol * SAFETY)
            # An absolute error is what a pole makes large; it leaves a relative one as it is.
            solver.rtol, solver.atol = max(rtol * trust**2, SMALLEST_TOLERANCE), atol * trust**2
            # A step size that is not a number would be halved for ever.
            message = solver.step() if trust > LEAST_TRUST and np.isfinite(solver.h_abs) else None
            after = model.trust(solver.y.tolist(), rtol * SAFETY)
            lost = solver.status == "failed" or min(trust, after) <= LEAST_TRUST
            if lost or not np.isfinite([*solver.y, solver.h_abs]).all():
                raise SimulationError(
                    f"{model.mechanism.name}: the motion could not be followed beyond t = {solver.t:.6g} s "
                    f"({message or 'it is not finite there, or too near a pole of the frame'}); last configuration "
                    f"{state[: model.mechanism.n].tolist()}. A frame with a pole, such as the roller racer's "
                    "'paper' frame, fails where the mechanism does not."
                )
            if after < trust / 2:  # it came closer to a pole than it had been careful for
                solver = DOP853(rates, time, y, bound, rtol=rtol, atol=atol, first_step=(solver.t - time) / 2)
        state, start = solver.y, following
    return state


def _checked(mechanism: Mechanism, controls: Callable[[float], ArrayLike]) -> Torque:
    """Controls as arrays whose shape is checked at every call."""
    m, names = len(mechanism.forces), ", ".join(mechanism.controls)

    def torque(time: float) -> Array:
        given = controls(time)
        value = _floats(given)
        if value is None or value.shape != (m,) or not np.isfinite(value).all():
            raise MechanismError(
                f"{mechanism.name}: controls({time:.6g}) must be {m} finite number(s) ({names}), "
                f"got {reprlib.repr(given)}"
            )
        return value

    return torque


def _floats(value: Any) -> Array | None:
    """A copy of `value` as floats, or None if that is not possible."""
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return None


def _times(t: ArrayLike) -> Array:
    times = _floats(t)
    if (
        times is None
        or times.ndim != 1
        or len(times) < 1
        or not np.isfinite(times).all()
        or not (np.diff(times) > 0).all()
    ):
        raise MechanismError(f"t must be a row of increasing finite times, got {reprlib.repr(t)}")
    return times


def _vector(mechanism: Mechanism, value: ArrayLike, size: int, label: str) -> Array:
    vector = _floats(value)
    if vector is None:
        raise MechanismError(f"{mechanism.name}: {label} must be {size} numbers, got {reprlib.repr(value)}")
    if vector.shape != (size,):
        raise MechanismError(f"{mechanism.name}: {label} must have shape ({size},), got {vector.shape}")
    if not np.isfinite(vector).all():
        raise MechanismError(f"{mechanism.name}: {label} must be finite, got {vector.tolist()}")
    return vector
