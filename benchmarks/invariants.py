"""What must not change along a motion, whatever the numbers: for `benchmarks.stability`.

Each function returns `Found`: the worst number and what it may be. What is compared follows from the mechanism's data
(inertia tensor, one-forms, control forces), not from the reduced equations that were integrated.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

import mechanics
from benchmarks.extremes import BOUND, CROSSING, reference, scaled
from mechanics.compiler.backends import BACKENDS
from mechanics.compiler.codegen import Program, integrated
from mechanics.compiler.dataflow import analyse
from mechanics.compiler.integrators import method
from mechanics.geometry.reduction import derive
from mechanics.mechanism import Mechanism
from mechanics.model import Model
from nhenv.env import LocomotionEnv

__all__ = [
    "Found", "SKIP", "drag_in_environments", "drag_in_simulate", "equivariance", "impacts", "long_run",
    "observed_order", "reversal", "simulated_balance", "work_energy",
]  # fmt: skip

Array = NDArray[np.float64]
Track = Callable[[Iterable[int], str], Iterable[int]]

SAMPLES = 1000  # of a long run
MILLION = 1_000_000
SKIP = "skipped"
STEPS = tuple(round(2 ** (k / 2)) for k in range(2, 17))  # of two seconds, to see orders; every other is twice as many
RESOLVED = 1e-15  # errors below are those of rounding, and so are those near the least
# Share of the torque limits by order: errors of high order stand above rounding on a rougher motion only.
SHARES = ((8, 0.1), (99, 0.3))
FINE = 64  # steps of the reference, lest its own error of 1e-14 be seen
FALLS = 0.3  # s, in which what stands upright does not yet lie flat


@dataclass(frozen=True)
class Found:
    """One number.

    Attributes:
        error: the worst; NaN if skipped.
        bound: what it may be; None where it is only stated.
        note: where, or why it is skipped.
        flagged: how many motions were said to have diverged.
    """

    error: float
    bound: float | None
    note: str = ""
    flagged: int = 0

    @property
    def held(self) -> bool:
        """Whether it is within its bound; NaN is not."""
        return self.bound is None or self.error <= self.bound


def _worst(values: Iterable[float]) -> float:
    """The largest, or NaN if one is, or if there are none."""
    array = np.array([*values], float)
    return float(array.max()) if len(array) and np.isfinite(array).all() else math.nan


# -- long runs -----------------------------------------------------------------------------------


@dataclass
class Run:
    """Largest relative changes over a long run without torque.

    Attributes:
        energy, residual: of the energy; of the constraints, over the speed or 1.
        momenta: of each momentum, by name.
        finite: whether all was, and nothing was flagged.
    """

    energy: float = 0.0
    residual: float = 0.0
    momenta: dict[str, float] = field(default_factory=dict)
    finite: bool = True


def long_run(name: str, steps: int, track: Track, options: dict[str, Any] | None = None) -> Run:
    """The worst of some motions of `steps` control periods of 0.05 s, without torque and without stops."""
    mechanism = mechanics.get(name)
    env = LocomotionEnv(name, joint_limits=False, whole_state=True, **(options or {}))
    nothing = np.zeros(len(mechanism.controls), np.float32)
    run, rng = Run(), np.random.default_rng(0)
    every = max(steps // SAMPLES, 1)
    for start in range(3):
        q = rng.uniform(-1, 1, mechanism.n)
        env.reset(options={"q": q, "qdot": Model(mechanism).velocity(q, rng.uniform(-1, 1, mechanism.rank))})
        first = _conserved(mechanism, env)
        for _ in track(range(steps // every), f"{name}, long run {start + 1} of 3"):
            for _ in range(every):
                run.finite &= not env.step(nothing)[2]
            q, qdot = env.q, env.qdot
            slip = np.abs(np.asarray(reference(name, None).residual(q[None], qdot[None], env.params), float)).max()
            run.residual = max(run.residual, float(slip / max(1, np.abs(qdot).max())))
            for key, value in _conserved(mechanism, env).items():
                change = abs(value - first[key]) / abs(first[key])
                run.finite &= bool(np.isfinite(change))
                if key == "energy":
                    run.energy = max(run.energy, change)
                else:
                    run.momenta[key] = max(run.momenta.get(key, 0.0), change)
    return run


def _conserved(mechanism: Mechanism, env: LocomotionEnv) -> dict[str, float]:
    """Energy, and the momenta ⟨q̇, E⟩ along the fields of a flat frame if there is one, from the inertia tensor."""
    q, qdot = env.q.astype(np.longdouble), env.qdot.astype(np.longdouble)
    at: dict[str, Any] = {**env.params, **dict(zip(mechanism.coordinates, q, strict=True))}
    momentum = mechanism.numeric(mechanism.inertia, at) @ qdot
    values = {"energy": float(0.5 * qdot @ momentum)}
    for i, row in enumerate(
        mechanism.numeric(mechanism.frames.get("flat", ()), at) if "flat" in mechanism.frames else ()
    ):
        values[f"p{i + 1}"] = float(row @ momentum)
    return values


# -- symmetries ------------------------------------------------------------------------------------


def observed_order(name: str, integrator: str) -> Found:
    """How far the observed order of a method stays below its own, on a mechanism under constant torque.

    One step of the generated integrator after the other, against multipliers. The order is read between the two finest
    step sizes whose errors stand well above rounding.
    """
    row, mechanism = method(integrator), mechanics.get(name)
    equations = derive(mechanism, mechanism.frame_rows(None))
    rates = dict(
        zip((*equations.coordinates, *equations.pseudo_velocities), (*equations.velocity, *equations.acceleration),
            strict=True)
    )  # fmt: skip
    flow = analyse(rates, list(rates), equations.definitions)
    if flow.core and not row.explicit:
        return Found(math.nan, None, f"{SKIP}: implicit on the racer's core, which the compiler refuses")
    parameters = [sp.Symbol(p) for p in mechanism.parameters]
    program = Program(integrated(flow), parameters, equations.definitions)
    backend = BACKENDS["numpy"]
    source = program.step_function("step", flow, row, 1, equations.controls, backend)
    namespace: dict[str, Any] = {}
    exec(f"{backend.header}\n{source}\n{program.constants_function('constants', parameters)}", namespace)
    # In long doubles, from rest, which all numbers are exact for: there is more to be seen above rounding.
    constants = np.array(namespace["constants"]([*mechanism.parameters.values()]), np.longdouble)
    q = np.random.default_rng(2).uniform(-0.8, 0.8, mechanism.n).astype(np.longdouble)
    share = next(share for order, share in SHARES if row.order <= order)
    u, duration = [np.longdouble(share * limit) for limit in mechanism.torque_limits.values()], np.longdouble(2)
    truth = reference(name, None).hold(
        q[None], np.zeros((1, mechanism.n)), [u], 2.0, mechanism.parameters, shortest=FINE
    )
    begin = dict(zip(rates, (*q, *np.zeros(mechanism.rank, np.longdouble)), strict=True))
    errors: list[float] = []
    for steps in STEPS:
        state = [begin[s] for s in flow.states]
        with np.errstate(all="ignore"):  # a step of a second may end anywhere
            for _ in range(steps):
                *state, _ = namespace["step"](duration / steps, *state, *u, constants)
        end = dict(zip(flow.states, state, strict=True))
        errors.append(float(scaled([np.array([end[s] for s in equations.coordinates]) - truth.q[0]], truth.q)[0]))
    floor = max(10 * np.nanmin(errors), RESOLVED)
    seen = [math.log2(a / b) for a, b in zip(errors[:-2], errors[2:], strict=True) if b > floor and a < 1e-2]
    if not seen:
        return Found(math.nan, 0.5, f"no two step sizes show the order: {errors}")
    return Found(row.order - seen[-1], 0.5, f"order {row.order}, observed {seen[-1]:.1f}")


def reversal(name: str, runs: int) -> Found:
    """How far from its start a motion ends that is turned round: holds forth, then the same torques in reverse."""
    env = LocomotionEnv(name, joint_limits=False, whole_state=True)
    model, rng, found = Model(env.mechanism, env.params), np.random.default_rng(3), []
    flagged = 0
    for _ in range(runs):
        q, v = rng.uniform(-1, 1, env.mechanism.n), rng.uniform(-1, 1, env.mechanism.rank)
        qdot = model.velocity(q, v)
        actions = rng.choice(np.array([-1, -0.5, 0, 0.5, 1], np.float32), (10, len(env.mechanism.controls)))
        env.reset(options={"q": q, "qdot": qdot})
        for part in (actions, actions[::-1]):
            for action in part:
                flagged += env.step(action)[2]
            end, back = env.q, -env.qdot
            env.reset(options={"q": end, "qdot": back})
        start = np.concatenate([q, qdot])
        found.append(scaled([np.concatenate([end, back]) - start], [start])[0])
    return Found(_worst(found), 10 * BOUND, f"{runs} times ten holds and back", flagged)


def equivariance(name: str, steps: int) -> Found:
    """How much else happens elsewhere: the same torques from rest at another pose, poses taken back."""
    envs = [LocomotionEnv(name, whole_state=True) for _ in range(2)]
    mechanism, rng, found = envs[0].mechanism, np.random.default_rng(4), []
    for shift in ([3.0, -7.0, 2.5], [-1e3, 1e4, -30.0]):
        q = rng.uniform(-0.5, 0.5, mechanism.n)
        q[:3] = 0
        for env, pose in zip(envs, ([0.0, 0.0, 0.0], shift), strict=True):
            env.reset(options={"q": [*pose, *q[3:]]})
        x, y, turn = shift
        cos, sin = math.cos(turn), math.sin(turn)
        for _ in range(steps):
            action = rng.uniform(-1, 1, len(mechanism.controls)).astype(np.float32)
            for env in envs:
                env.step(action)
            here, there = envs[0].q, envs[1].q
            moved = here.copy()
            moved[:3] = x + cos * here[0] - sin * here[1], y + sin * here[0] + cos * here[1], turn + here[2]
            found.append(scaled([there - moved], [moved])[0])
            found.append(scaled([envs[1].v - envs[0].v], [envs[0].v])[0])
    return Found(_worst(found), 1e-12, f"{steps} steps of random torques, two displacements")


# -- energy ----------------------------------------------------------------------------------------


def _constant_forms(mechanism: Mechanism) -> Array | None:
    """Control one-forms (m, n) if they are the same everywhere, else None."""
    rng = np.random.default_rng(0)
    forms = [
        mechanism.numeric(
            tuple(mechanism.forces.values()),
            {**mechanism.parameters, **dict(zip(mechanism.coordinates, q, strict=True))},
        )
        for q in rng.uniform(-1, 1, (3, mechanism.n))
    ]
    return forms[0] if all(np.array_equal(forms[0], other) for other in forms) else None


def _losses(env: LocomotionEnv, actions: Iterable[Array], forms: Array) -> Iterator[tuple[float, bool]]:
    """(work less gain of energy, over 1 + both; whether it was flagged) of each step; a flag begins an episode."""
    q, energy = env.q, env.energy
    for action in actions:
        diverged = env.step(action.astype(np.float32))[2]
        if diverged:
            env.reset()
        else:
            work = float(env.torque_limits * action.astype(np.float32) @ forms @ (env.q - q))
            yield (work - (env.energy - energy)) / (1 + abs(work) + abs(energy)), False
        q, energy = env.q, env.energy
        if diverged:
            yield 0.0, True


def work_energy(names: Iterable[str], steps: int, track: Track) -> Found:
    """Energy gained less work of the torques in every step of rollouts without stops, of many mechanisms."""
    found, flagged, left_out, tried = [], 0, [], []
    chosen = [*names]
    for index in track(range(len(chosen)), "work and energy"):
        name = chosen[index]
        forms = _constant_forms(mechanics.get(name))
        if forms is None:
            left_out.append(name)
            continue
        tried.append(name)
        env = LocomotionEnv(name, joint_limits=False, whole_state=True, backend="numpy")
        env.reset(seed=0)
        drawn = np.random.default_rng(5).uniform(-1, 1, (steps, len(env.mechanism.controls)))
        for loss, diverged in _losses(env, drawn, forms):
            found.append(abs(loss))
            flagged += diverged
    note = f"{steps} steps of {', '.join(tried)}"
    if left_out:
        note += f"; forms that depend on the place: {', '.join(left_out)}"
    return Found(_worst(found), BOUND, note, flagged)


def impacts(name: str, steps: int) -> tuple[Found, Found]:
    """(how far beyond a stop, rise of energy over the work) in rollouts of torques up to a hundred times the limit."""
    beyond, rises, flagged, resting = [], [], 0, 0
    ((joint, limit),) = mechanics.get(name).joint_limits.items()
    forms = _constant_forms(mechanics.get(name))
    assert forms is not None
    place = mechanics.get(name).coordinates.index(joint)
    for times in (1, 10, 100):
        for stop in (limit, 0.1):
            torques = [times * u for u in mechanics.get(name).torque_limits.values()]
            env = LocomotionEnv(name, whole_state=True, torque_limits=torques, joint_limits={joint: stop})
            env.reset(seed=0)
            rng = np.random.default_rng(6)
            actions = np.repeat(rng.choice([-1.0, 1.0], (steps // 3 + 1, len(torques))), 3, axis=0)[:steps]
            for loss, diverged in _losses(env, actions, forms):
                rises.append(-loss)
                flagged += diverged
                beyond.append(abs(env.q[place]) - stop)
                resting += abs(env.q[place]) == stop
                if env.energy > 1e6:  # a new start before everything else is small
                    env.reset()
    note = f"{len(beyond)} steps, torques to 100 times the limit, {resting} of them end on a stop"
    if not resting:  # nothing was tried
        beyond.append(math.nan)
        rises.append(math.nan)
    return Found(_worst(beyond), CROSSING, note, flagged), Found(_worst(rises), BOUND, note, flagged)


def simulated_balance(names: Iterable[str], track: Track) -> Found:
    """Energy less work of `mechanics.simulate`, of all mechanisms, under torques that vary."""
    found, chosen = [], [*names]
    for index in track(range(len(chosen)), "simulate"):
        mechanism = mechanics.get(chosen[index])
        sizes = np.array([0.3 * mechanism.torque_limits.get(c, 1.0) for c in mechanism.controls])
        run = mechanics.simulate(
            mechanism,
            np.linspace(0, FALLS, 21),
            np.full(mechanism.n, 0.3),
            controls=lambda t: sizes * np.cos(3 * t),  # noqa: B023
        )
        size = 1 + np.abs(run.energy) + np.abs(run.work)
        found.append(np.abs((run.energy - run.energy[0] - run.work) / size).max())
    return Found(_worst(found), 1e-10, f"{len(chosen)} mechanisms, {FALLS} s")


def drag_in_simulate(names: Iterable[str], track: Track) -> Found:
    """Rise of energy between any two stored times of `simulate(drag=True)` without torque."""
    chosen = [name for name in names if mechanics.get(name).rayleigh != "0"]
    found = []
    for index in track(range(len(chosen)), "drag"):
        mechanism = mechanics.get(chosen[index])
        rng = np.random.default_rng(7)
        q, v = rng.uniform(-0.5, 0.5, mechanism.n), rng.uniform(-1, 1, mechanism.rank)
        duration = 20.0 if mechanism.potential == "0" else FALLS
        run = mechanics.simulate(mechanism, np.linspace(0, duration, 401), q, v0=v, drag=True)
        found.append(np.diff(run.energy).max() / (1 + run.energy[0]))
        assert run.energy[-1] < run.energy[0]  # it does brake
    return Found(_worst(found), 1e-10, f"{', '.join(chosen)}; 20 s from rates of 1/s, {FALLS} s with a potential")


def drag_in_environments(names: Iterable[str], steps: int) -> Found:
    """Rise of energy over a step of an environment with drag and without torque."""
    if "drag" not in inspect.signature(LocomotionEnv).parameters:
        return Found(math.nan, None, f"{SKIP}: environments have no argument `drag`")
    found: list[float] = []
    chosen = [name for name in names if mechanics.get(name).rayleigh != "0"]
    for name in chosen:
        env = LocomotionEnv(name, whole_state=True, backend="numpy", drag=True)
        rng = np.random.default_rng(8)
        q, v = rng.uniform(-0.5, 0.5, env.mechanism.n), rng.uniform(-1, 1, env.mechanism.rank)
        env.reset(options={"q": q, "qdot": Model(env.mechanism).velocity(q, v)})
        energies = [env.energy]
        for _ in range(steps):
            env.step(np.zeros(len(env.mechanism.controls), np.float32))
            energies.append(env.energy)
        found.append(float(np.diff(energies).max()) / (1 + energies[0]))
        assert energies[-1] < energies[0]
    return Found(_worst(found), 1e-10, f"{steps} steps of {', '.join(chosen)}")
