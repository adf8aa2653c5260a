"""The solvers that our environments are compared with: SciPy, diffrax, torchdiffeq, multipliers, MuJoCo.

SciPy, diffrax and torchdiffeq get our reduced equations, compiled for them (`benchmarks.equations`), in float64, and
begin each hold with a step that suits them; "multipliers" is the same motion without any reduction, a linear solve in
each right-hand side; MuJoCo has a model of its own (`benchmarks.rolling_wheels`).

To add one: a function that makes a `Solver`, and a row in `_ROWS`.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.equations import Equations, multipliers
from benchmarks.motions import Problem
from benchmarks.solvers import PEER, Contender, Solver, States, pair

__all__ = ["PEERS", "peers"]

Array = NDArray[np.float64]

ABSOLUTE = 1e-2  # absolute tolerance, of the relative one
DIFFRAX_SIZE, TORCH_SIZE = 256, 1024
QUARTERS = 4


# -- one motion at a time --------------------------------------------------------------------------


def _one_by_one(problem: Problem, motion: Callable[[int], tuple[Array, Array]]) -> Solver:
    """A solver of one motion after the other: number of the row -> states (T + 1, B, n) of one."""

    def motions() -> States:
        q, qdot = zip(*(motion(row) for row in range(problem.count)), strict=True)
        return np.stack(q, axis=1), np.stack(qdot, axis=1)

    def turn(number: int) -> float:
        begun = time.perf_counter()
        for row in pair(problem, number):
            motion(row)
        return (time.perf_counter() - begun) / (2 * problem.seconds)

    return Solver(motions, turn)


def scipy(method: str, tolerance: float) -> Callable[[Problem], Solver]:
    """A class of scipy.integrate, which steps through each hold and begins with the step that the last ended with."""

    def make(problem: Problem) -> Solver:
        from scipy import integrate

        equations = Equations(problem.mechanism)
        right, k = equations.compiled(), equations.constants
        solver_class = getattr(integrate, method)
        begin = equations.start(problem.q, problem.qdot)
        options = {"rtol": tolerance, "atol": ABSOLUTE * tolerance}

        def motion(row: int) -> States:
            y = np.empty((problem.holds + 1, equations.size))
            y[0], step = begin[row], problem.dt
            for hold, u in enumerate(problem.torques[:, row]):
                solver = solver_class(
                    lambda t, y: right(y, u, k),  # noqa: B023 (called before u changes)
                    0.0,
                    y[hold],
                    problem.dt,
                    first_step=min(step, problem.dt),
                    **options,
                )
                while solver.status == "running":
                    solver.step()
                    if solver.t < problem.dt:  # the last step is cut short
                        step = solver.step_size
                assert solver.status == "finished"
                y[hold + 1] = solver.y
                step = max(step, solver.step_size)
            return equations.states(y)

        return _one_by_one(problem, motion)

    return make


def multiplier_rk4(steps: int) -> Callable[[Problem], Solver]:
    """The formulation with multipliers under the classical method: all holds of a motion in one compiled loop."""

    def make(problem: Problem) -> Solver:
        from numba import njit

        right = multipliers(problem.mechanism)

        @njit(error_model="numpy")
        def integrate(y: Array, torques: Array, dt: float, steps: int, out: Array) -> None:
            h = dt / steps
            out[0] = y
            for hold in range(len(torques)):
                u = torques[hold]
                for _ in range(steps):
                    a = right(y, u)
                    b = right(y + h / 2 * a, u)
                    c = right(y + h / 2 * b, u)
                    d = right(y + h * c, u)
                    y = y + h / 6 * (a + 2 * b + 2 * c + d)
                out[hold + 1] = y

        begin = np.concatenate([problem.q, problem.qdot], axis=1)
        torques = [np.ascontiguousarray(problem.torques[:, row]) for row in range(problem.count)]
        n = problem.q.shape[1]

        def motion(row: int) -> States:
            out = np.empty((problem.holds + 1, 2 * n))
            integrate(begin[row], torques[row], problem.dt, steps, out)
            return out[:, :n], out[:, n:]

        return _one_by_one(problem, motion)

    return make


def multiplier_scipy(tolerance: float) -> Callable[[Problem], Solver]:
    """The formulation with multipliers, compiled, under SciPy's DOP853."""

    def make(problem: Problem) -> Solver:
        from scipy.integrate import DOP853

        right, n = multipliers(problem.mechanism), problem.q.shape[1]
        begin = np.concatenate([problem.q, problem.qdot], axis=1)

        def motion(row: int) -> States:
            y = np.empty((problem.holds + 1, 2 * n))
            y[0] = begin[row]
            for hold, u in enumerate(problem.torques[:, row]):
                solver = DOP853(
                    lambda t, y: right(y, u),  # noqa: B023 (called before u changes)
                    0.0,
                    y[hold],
                    problem.dt,
                    first_step=problem.dt,
                    rtol=tolerance,
                    atol=ABSOLUTE * tolerance,
                )
                while solver.status == "running":
                    solver.step()
                y[hold + 1] = solver.y
            return y[:, :n], y[:, n:]

        return _one_by_one(problem, motion)

    return make


def mujoco(step: float) -> Callable[[Problem], Solver]:
    """A model with wheels that roll on the ground, in steps of this many seconds."""

    def make(problem: Problem) -> Solver:
        import mujoco as mj

        from benchmarks.rolling_wheels import RollingWheels

        wheels, count = RollingWheels(problem.mechanism, step), round(problem.dt / step)

        def motion(row: int) -> States:
            wheels.start(problem.q[row], problem.qdot[row])
            states = [wheels.state()]
            for torques in problem.torques[:, row]:
                wheels.data.ctrl[:] = torques
                mj.mj_step(wheels.model, wheels.data, nstep=count)
                states.append(wheels.state())
            q, qdot = zip(*states, strict=True)
            return np.array(q), np.array(qdot)

        return _one_by_one(problem, motion)

    return make


# -- many motions at once --------------------------------------------------------------------------


def diffrax(method: str, tolerance: float | None, steps: int = 1) -> Callable[[Problem], Solver]:
    """One compiled `scan` over the holds, rows by `vmap`: adaptive, or without a tolerance in equal steps."""

    def make(problem: Problem) -> Solver:
        import jax

        jax.config.update("jax_enable_x64", True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what its own dependencies are warned of
            import diffrax as dx
        import jax.numpy as jnp

        equations = Equations(problem.mechanism)
        rates = equations.function(sin=jnp.sin, cos=jnp.cos, sqrt=jnp.sqrt)
        k = [float(c) for c in equations.constants]
        term = dx.ODETerm(lambda t, y, u: jnp.stack(rates(*y, *u, k)))
        solver = getattr(dx, method)()
        controller: Any = dx.ConstantStepSize()
        if tolerance is not None:
            controller = dx.PIDController(rtol=tolerance, atol=ABSOLUTE * tolerance)

        def hold(y: Any, u: Any) -> tuple[Any, Any]:
            # The first step tried is the whole hold, which is cheaper than a guess.
            first = problem.dt / steps
            found = dx.diffeqsolve(
                term, solver, 0.0, problem.dt, first, y, args=u, stepsize_controller=controller, max_steps=4096
            )
            return found.ys[0], found.ys[0]

        run = jax.jit(jax.vmap(lambda y, torques: jax.lax.scan(hold, y, torques)[1], in_axes=(0, 1)))
        rows = np.arange(DIFFRAX_SIZE) % problem.count
        begin = equations.start(problem.q, problem.qdot)
        y, torques = jnp.asarray(begin[rows]), jnp.asarray(problem.torques[:, rows])

        def motions() -> States:
            found = np.asarray(run(y, torques))[: problem.count].swapaxes(0, 1)
            return equations.states(np.concatenate([begin[None], found]))

        def turn(number: int) -> float:
            begun = time.perf_counter()
            run(y, torques).block_until_ready()
            return (time.perf_counter() - begun) / (DIFFRAX_SIZE * problem.seconds)

        return Solver(motions, turn)

    return make


def torchdiffeq(method: str, tolerance: float | None, steps: int = 1) -> Callable[[Problem], Solver]:
    """A call of `odeint` for each hold of all rows, on one thread."""

    def make(problem: Problem) -> Solver:
        import torch
        import torchdiffeq as td

        equations = Equations(problem.mechanism)
        rates = equations.function(sin=torch.sin, cos=torch.cos, sqrt=torch.sqrt)
        k = [float(c) for c in equations.constants]
        rows = np.arange(TORCH_SIZE) % problem.count
        begin = equations.start(problem.q, problem.qdot)
        first = torch.tensor(begin[rows].T.copy())
        torques = [torch.tensor(u[rows].T.copy()) for u in problem.torques]
        times = torch.tensor([0.0, problem.dt], dtype=torch.float64)
        options: dict[str, Any] = {"options": {"step_size": problem.dt / steps}}
        if tolerance is not None:
            # It would step beyond the end of the hold and interpolate, which costs it four digits.
            stops = {"first_step": problem.dt, "step_t": times[1:]}
            options = {"rtol": tolerance, "atol": ABSOLUTE * tolerance, "options": stops}

        def run(begin: Any, torques: list[Any]) -> list[Any]:
            found = [begin]
            for u in torques:

                def right(t: Any, y: Any, u: Any = u) -> Any:
                    return torch.stack(torch.broadcast_tensors(*rates(*y, *u, k)))

                found.append(td.odeint(right, found[-1], times, method=method, **options)[1])
            return found

        def alone(function: Callable[[], Any]) -> Any:
            threads = torch.get_num_threads()
            torch.set_num_threads(1)
            try:
                with torch.inference_mode():
                    return function()
            finally:
                torch.set_num_threads(threads)

        # A turn is a quarter of the motions, from where the whole came by.
        part = max(problem.holds // QUARTERS, 1)
        passed = [first] * QUARTERS

        def motions() -> States:
            found = alone(lambda: run(first, torques))
            passed[:] = [found[i * part] for i in range(QUARTERS)]
            return equations.states(np.stack([y.numpy()[:, : problem.count].T for y in found]))

        def turn(number: int) -> float:
            i = number % QUARTERS
            begun = time.perf_counter()
            alone(lambda: run(passed[i], torques[i * part : (i + 1) * part]))
            return (time.perf_counter() - begun) / (TORCH_SIZE * part * problem.dt)

        return Solver(motions, turn)

    return make


# -- rows ------------------------------------------------------------------------------------------


def _decades(*exponents: int) -> list[tuple[str, tuple[Any, ...]]]:
    return [(f"1e-{exponent}", (10.0**-exponent,)) for exponent in exponents]


# Name -> environments, function that makes a solver, and its settings as printed and as passed.
_ROWS: dict[str, tuple[int, Callable[..., Callable[[Problem], Solver]], Iterable[tuple[str, tuple[Any, ...]]]]] = {
    "SciPy RK45": (1, lambda t: scipy("RK45", t), _decades(3, 5, 7, 9, 11)),
    "SciPy DOP853": (1, lambda t: scipy("DOP853", t), _decades(3, 5, 7, 9, 11, 13)),
    "SciPy LSODA": (1, lambda t: scipy("LSODA", t), _decades(3, 5, 7, 9, 11, 13)),
    "SciPy Radau": (1, lambda t: scipy("Radau", t), _decades(3, 5, 7, 9)),
    "multipliers, DOP853": (1, multiplier_scipy, _decades(3, 5, 7, 9, 11, 13)),
    "multipliers, RK4 in Numba": (1, multiplier_rk4, [(f"{steps} steps", (steps,)) for steps in (1, 4, 16, 64)]),
    "diffrax Tsit5": (DIFFRAX_SIZE, lambda t: diffrax("Tsit5", t), _decades(3, 5, 7, 9, 11)),
    "diffrax Dopri8": (DIFFRAX_SIZE, lambda t: diffrax("Dopri8", t), _decades(3, 5, 7, 9, 11)),
    "diffrax Dopri8, equal steps": (
        DIFFRAX_SIZE,
        lambda steps: diffrax("Dopri8", None, steps),
        [(f"{steps} steps", (steps,)) for steps in (1, 2, 4)],
    ),
    "torchdiffeq dopri5": (TORCH_SIZE, lambda t: torchdiffeq("dopri5", t), _decades(3, 5, 7, 9, 11)),
    "torchdiffeq dopri8": (TORCH_SIZE, lambda t: torchdiffeq("dopri8", t), _decades(3, 5, 7, 9, 11)),
    "torchdiffeq rk4, equal steps": (
        TORCH_SIZE,
        lambda steps: torchdiffeq("rk4", None, steps),
        [(f"{steps} steps", (steps,)) for steps in (1, 4, 16)],
    ),
    "MuJoCo, rolling wheels": (
        1,
        mujoco,
        [(f"{1000 * step:g} ms", (step,)) for step in (5e-3, 2.5e-3, 1e-3, 2.5e-4)],
    ),
}
PEERS = tuple(_ROWS)


def peers(names: Iterable[str] = PEERS) -> list[Contender]:
    """Their points."""
    return [
        Contender(name, setting, PEER, _ROWS[name][0], _ROWS[name][1](*arguments))
        for name in names
        for setting, arguments in _ROWS[name][2]
    ]
