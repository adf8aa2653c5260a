"""From a scene to expressions, and from these to the functions that its kernels share.

The symbolic half of `nhenv.compiled`: imported only when the cache has no kernel for a scene, so it may import what it
likes. `nhenv.one_kernel` and `nhenv.rows_kernel` put these functions around one environment and around many.
"""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Callable, Iterable, Mapping
from math import inf
from typing import Any

import sympy as sp

from mechanics.compiler import stops
from mechanics.compiler.backends import BACKENDS, Backend
from mechanics.compiler.codegen import Program, integrated, operation_count
from mechanics.compiler.dataflow import analyse, initial
from mechanics.compiler.integrators import Method, method
from mechanics.compiler.margins import trust
from mechanics.expressions import ExpressionError, to_sympy
from mechanics.geometry.energy import conserved
from mechanics.geometry.reduction import ReducedEquations, derive
from mechanics.geometry.symmetry import planar_symmetry
from nhenv.observation import default_observation
from nhenv.scene import Scene
from nhenv.tasks import START, Task

__all__ = ["Generator", "included", "items", "label"]

# Method and substeps where the graph has no core, and where it has one: the cheapest whose error of one hold stays
# below 1e-10 in 99 of 100 states that gaits, relays and random actions reach (1e-8 and 4e-9 with gauss4 and dop853).
LAYERED = ("lobatto6", 1)
CORE = ("verner9", 2)

TERMINATED_NOW = sp.Symbol("_terminated")  # 1 if the task ends the episode with this step, else 0


class Generator:
    """Everything symbolic about one scene."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.equations = equations = derive(scene.mechanism, scene.frame, drag=scene.drag)
        self.backend = BACKENDS[scene.backend]
        self.actions = [sp.Symbol(f"_a_{control}") for control in scene.mechanism.controls]
        self.joints = [_joint(equations, name) for name in scene.joints]
        self.free = [sp.Symbol(f"_free_{angle.name}") for angle, _ in self.joints]
        self.held = (*equations.controls, *self.free)  # constant over a step
        observation, judgement, ending = self._task_expressions()
        velocities = dict(zip(equations.coordinates, equations.velocity, strict=True))
        accelerations = dict(zip(equations.pseudo_velocities, equations.acceleration, strict=True))
        held = {rate: free for (_, rate), free in zip(self.joints, self.free, strict=True)}
        rates = {**velocities, **{v: rate * held.get(v, 1) for v, rate in accelerations.items()}}
        self.speeds = equations.pseudo_velocities if scene.keep_energy else ()
        parts = conserved(equations) if scene.keep_energy else {}
        self.energy = {f"energy:{part}": expression for part, expression in parts.items()}
        outputs = [*observation.values(), *judgement.values(), *ending.values(), *self.energy.values()]
        wanted = self._wanted(rates, outputs)
        self.flow = analyse(rates, wanted, equations.definitions)
        self.joint_rates = {f"qdot:{angle}": velocities[angle] for angle, _ in self.joints}
        joint_accelerations = {f"vdot:{angle}": accelerations[rate] for angle, rate in self.joints}
        self.motion = {**self.joint_rates, **joint_accelerations}
        self.observation, self.judgement, self.ending = list(observation), list(judgement), list(ending)
        self.targets = self._targets([*observation.values(), *judgement.values(), *ending.values()])
        judged = {symbol for expression in judgement.values() for symbol in expression.free_symbols}
        self.remembered = [state for state in self.flow.states if initial(state) in judged]
        self.rules = self._rules()
        self.method, self.substeps = self._method()
        self.controlled = scene.tolerance < inf  # then a flight may turn out not to be right
        self.trust = self._trust() if self.controlled else {}
        # A hold may be wrong by the tolerance, however many flights it takes. Estimates of a low order, as some methods
        # have that are asked for by name, would make them too many.
        shared = self.controlled and scene.integrator == "auto"
        self.pace = {"pace": self.substeps / sp.Symbol("dt")} if shared else {}
        self.events = bool(self.joints) or self.controlled  # so that a hold may take more than one flight
        texts = {
            **observation,
            **judgement,
            **ending,
            **self.motion,
            **self.rules,
            **self.energy,
            **self.trust,
            **self.pace,
        }
        self.program = Program(
            {**integrated(self.flow), **texts}, [sp.Symbol(name) for name in scene.parameters], equations.definitions
        )

    def _task_expressions(self) -> tuple[dict[str, sp.Expr], dict[str, sp.Expr], dict[str, sp.Expr]]:
        """Observation, judgement (reward terms, then info) and termination as expressions in the states."""
        task = self.scene.task
        if task is None:
            return {}, {}, {}
        scope = _scope(self.scene, self.equations, self.actions)
        scope |= self._definitions(task, scope)

        def read(kind: str, texts: Mapping[str, str], **more: sp.Symbol) -> dict[str, sp.Expr]:
            return {f"{kind}:{label}": _read(task, kind, text, {**scope, **more}) for label, text in texts.items()}

        seen = self.scene.mechanism.observation or default_observation(self.scene.mechanism)
        observation = read("observation", {**seen, **task.observation})
        ending = read("terminated", {"": task.terminated} if task.terminated is not None else {})
        over = {"terminated": TERMINATED_NOW} if ending else {}
        judgement = {**read("reward", task.reward, **over), **read("info", task.info, **over)}
        of_a_step = {*self.actions, *map(initial, self.equations.coordinates)}
        for kind, expression in (*observation.items(), *ending.items()):
            if expression.free_symbols & of_a_step:
                raise ExpressionError(
                    f"task {task.name!r}, {kind.rstrip(':')}: what is observed, and whether an episode ends, must "
                    "follow from the state and the targets alone, without effort and NAME_before"
                )
        return observation, judgement, ending

    def _definitions(self, task: Task, scope: Mapping[str, sp.Expr]) -> dict[str, sp.Expr]:
        """Meaning of the task's shorthands, after the step and, where coordinates suffice, before it."""
        before = {q: initial(q) for q in self.equations.coordinates}
        fixed = {sp.Symbol(name) for name in (*self.scene.parameters, *task.targets)}
        meanings: dict[str, sp.Expr] = {}
        for name, text in task.definitions.items():
            meanings[name] = _read(task, "definitions", text, {**scope, **meanings})
            if meanings[name].free_symbols <= fixed | before.keys():
                meanings[f"{name}_before"] = meanings[name].xreplace(before)
        return meanings

    def _targets(self, outputs: list[sp.Expr]) -> list[sp.Symbol]:
        """The task's targets that something depends on."""
        names = self.scene.task.targets if self.scene.task else ()
        used = {symbol for output in outputs for symbol in output.free_symbols}
        return [symbol for symbol in map(sp.Symbol, names) if symbol in used]

    def _rules(self) -> dict[str, sp.Expr]:
        """Targets that follow from those before them, as expressions."""
        task = self.scene.task
        texts = task.targets if task else {}
        scope = {name: sp.Symbol(name) for name in texts} | {name: _at_start(name) for name in START}
        return {
            f"target:{n}": _read(task, "targets", t, scope) for n, t in texts.items() if task and isinstance(t, str)
        }

    def _wanted(self, rates: Iterable[sp.Symbol], outputs: list[sp.Expr]) -> list[sp.Expr]:
        """What must be known after a step; without a task, everything."""
        if self.scene.task is None or self.scene.whole_state:
            return list(rates)
        now = {initial(state): state for state in rates}
        return [*(output.xreplace(now) for output in outputs), *(angle for angle, _ in self.joints)]

    def _method(self) -> tuple[Method, int]:
        """Integrator and substeps: as asked, or the default for this graph."""
        name, substeps = CORE if self.flow.core else LAYERED
        if self.scene.integrator != "auto":
            name, substeps = self.scene.integrator, 1
        return method(name), self.scene.substeps or substeps

    def _trust(self) -> dict[str, sp.Expr]:
        """Shares of the tolerance that may be used near poles of the frame, as far as this scene knows where it is."""
        known = {*self.flow.states, *self.equations.parameters, *(symbol for symbol, _ in self.equations.definitions)}
        frame = self.scene.mechanism.frame_rows(self.scene.frame)
        shares = trust(self.equations, frame, self.scene.tolerance)
        return {f"trust:{i}": share for i, share in enumerate(shares) if share.free_symbols <= known}

    def may_release(self, angle: sp.Symbol, rate: sp.Symbol) -> bool:
        """Whether what presses a joint against its stop can change while the controls are held and the joint rests."""
        meanings: dict[sp.Symbol, sp.Expr] = {}
        for symbol, meaning in self.equations.definitions:
            meanings[symbol] = meaning.xreplace(meanings)
        resting = {rate: sp.S.Zero}
        push = self.motion[f"vdot:{angle}"].xreplace(meanings).xreplace(resting)
        moving = [state for state in push.free_symbols & self.flow.rates.keys() if state != rate]
        return any(self.flow.rates[state].xreplace(meanings).xreplace(resting) != 0 for state in moving)

    # -- text ----------------------------------------------------------------------------------

    def tables(self, **more: object) -> str:
        """Names and places, so that a loaded kernel needs nothing symbolic."""
        tables = {
            "STATES": tuple(state.name for state in self.flow.states),
            "PRUNED": tuple(state.name for state in self.flow.pruned),
            "OBSERVATION": tuple(label(name) for name in self.observation),
            "JUDGEMENT": tuple(label(name) for name in self.judgement),
            "TARGETS": tuple(target.name for target in self.targets),
        } | more
        return "".join(f"{name} = {value!r}\n" for name, value in tables.items())

    def constants(self) -> str:
        """Source of `constants`: the parameters of a scene to what the functions take as `_k`."""
        return self.program.constants_function("constants", [sp.Symbol(name) for name in self.scene.parameters])

    def functions(self, backend: Backend, substeps: int, carried: Mapping[str, sp.Expr] | None = None) -> list[str]:
        """Source of what a row of numbers goes through, whether alone or beside others."""
        program, flow = self.program, self.flow
        states, controls = flow.states, self.equations.controls
        before = [initial(state) for state in states]
        judged = (*states, *before, *self.actions, *self.targets, *([TERMINATED_NOW] if self.ending else []))
        parts = [
            self.step_function("advance_states", substeps, backend, carried),
            program.function("observe", (*states, *self.targets), self.observation, backend),
            program.function("judge", judged, self.judgement, backend),
        ]
        if self.ending:
            parts.append(program.function("ends", (*states, *self.targets), self.ending, backend))
        if self.joints:
            parts += [
                program.function("joint_rates", states, list(self.joint_rates), backend),
                program.function("move_joints", (*states, *controls), list(self.motion), backend),
                self._clear_joints(backend),
            ]
        return [*parts, *self._start(backend)]

    def step_function(
        self, name: str, substeps: int, backend: Backend, carried: Mapping[str, sp.Expr] | None = None, streams: int = 1
    ) -> str:
        """Source of the flight: see `Program.step_function`."""
        return self.program.step_function(
            name,
            self.flow,
            self.method,
            substeps,
            self.held,
            backend,
            carried,
            streams,
            self.scene.tolerance,
            self.speeds,
            list(self.trust),
            *self.pace,
        )

    def _clear_joints(self, backend: Backend) -> str:
        """Whether a free flight met no stop, from both its ends; where that is not sure, the answer is no.

        A joint that turned was farthest out at the parabola's peak if its rate changes evenly. Where only states exact
        in time do so, twice that excursion allows for the rest: the cubic's share is a small part of it for holds
        shorter than the motion's own times.
        """
        states = [state.name for state in self.flow.states]
        old, new = (", ".join(f"{name}__{when}" for name in states) for when in ("old", "new"))
        frees, stops_ = ([f"_{kind}_{angle.name}" for angle, _ in self.joints] for kind in ("free", "stop"))
        lines = [f"rates_old = joint_rates({old}, _k)", f"rates_new = joint_rates({new}, _k)"]
        clear = []
        for j, (angle, rate) in enumerate(self.joints):
            margin = repr(0.5 * (1 + 1e-9)) if angle in self.flow.solutions else "1.0"
            lines += [
                f"room = {stops_[j]} - fabs({angle.name}__old)",
                f"excursion = {margin}*dt*rates_old[{j}]*rates_old[{j}]",
                f"within = excursion < room*fabs(rates_old[{j}] - rates_new[{j}])",
                f"within = within | ({rate.name}__old*{rate.name}__new >= 0.0)",
                f"clear_{j} = ({frees[j]} == 0.0) | (within & (fabs({angle.name}__new) < {stops_[j]}))",
            ]
            clear.append(f"clear_{j}")
        body = textwrap.indent("\n".join([*lines, f"return {' & '.join(clear)}"]), "    ")
        arguments = ", ".join(("dt", old, new, *frees, *stops_, "_k"))
        return f"{backend.decorator}def clear_joints({arguments}):\n{body}\n"

    def _start(self, backend: Backend) -> list[str]:
        """Where an episode begins: uniform numbers to coordinates and targets, unless these are given."""
        task, noisy = self.scene.task, self.scene.noisy
        rules = task.targets if task else {}
        parts, lines = [], [f"_q_{name} = -_noise + (_noise + _noise)*_u{i}" for i, name in enumerate(noisy)]
        draw = len(noisy)
        known = [_at_start(role).name for role in self.scene.start]
        # Where an episode starts, unless that is given, is what was drawn, or else the origin.
        for (role, coordinate), name in zip(self.scene.start.items(), known, strict=True):
            drawn = f"_q_{coordinate}" if coordinate in noisy else "0.0"
            lines.append(f"{name} = either(_given_{role}, {drawn})")
        for name, rule in rules.items():
            if isinstance(rule, str):
                arguments = [sp.Symbol(other) for other in known]
                parts.append(self.program.function(f"_rule_{name}", arguments, [f"target:{name}"], backend))
                value = f"_rule_{name}({', '.join((*known, '_k'))})[0]"
            else:
                low, high = map(float, rule)
                value, draw = f"{low!r} + {high - low!r}*_u{draw}", draw + 1
            lines.append(f"{name} = either(_given_{name}, {value})")
            known.append(name)
        # Coordinates, then the targets that something depends on.
        kept = [f"_q_{name}" for name in noisy] + [target.name for target in self.targets]
        lines.append(f"return ({''.join(f'{name}, ' for name in kept)})")
        given = (f"_given_{name}" for name in self.scene.givable)
        arguments_ = ", ".join((*(f"_u{i}" for i in range(draw)), "_noise", *given, "_k"))
        body = textwrap.indent("\n".join(lines), "    ")
        return [*parts, f"{backend.decorator}def start({arguments_}):\n{body}\n"]

    def title(self, kind: str) -> str:
        """What a generated module says of itself."""
        task = self.scene.task.name if self.scene.task else "whole state"
        kinds = ", ".join(f"{layer.kind} ({' '.join(s.name for s in layer.states)})" for layer in self.flow.layers)
        return (
            f"{self.scene.mechanism.name}, {task}, {kind}. Generated from the reduced equations; do not edit.\n\n"
            f"States: {kinds}. Pruned: {' '.join(s.name for s in self.flow.pruned) or 'none'}.\n"
            f"Integrator: {self.method.name} ({self.method.source}), {self.substeps} step(s) a hold.\n"
            f"{operation_count(self.program)} operations in all rates, observations and rewards together.\n"
        )

    def stop_functions(self, backend: Backend) -> list[str]:
        """Source of the way through impacts: `mechanics.compiler.stops` over this scene's `advance` and `motion`."""
        constants = "".join(f"{name} = {getattr(stops, name)!r}\n" for name in stops.CONSTANTS)
        places = {state: i for i, state in enumerate(self.flow.states)}
        constants += f"ANGLES = array({[places[angle] for angle, _ in self.joints]}, int64)\n"
        constants += f"RATES = array({[places[rate] for _, rate in self.joints]}, int64)\n"
        pure = included(stops.PURE, backend.inlined())
        return [constants, *self._array_forms(backend), *pure, *included(stops.SOURCES, backend)]

    def _array_forms(self, backend: Backend) -> list[str]:
        """`advance` and `motion` over arrays, for the stops."""
        n, m, joints = len(self.flow.states), len(self.actions), len(self.joints)
        state, control, free = items("state", n), items("control", m), items("free", joints)
        move = f"{items('out', 2 * joints)}, = move_joints({state}, {control}, k)" if joints else "pass"
        held = f"{control}, {free}, " if joints else f"{control}, "
        return [
            f"{backend.decorator}def advance(h, state, control, free, k, new):\n"
            f"{textwrap.indent(self.advance(items('new', n), state, held), '    ')}\n    return right\n",
            f"{backend.decorator}def motion(state, control, k, out):\n    {move}\n",
        ]

    def advance(self, new: str, state: str, held: str) -> str:
        """Lines that advance a state by `h`, through all substeps, and say whether it is `right`."""
        return f"{new}, right = advance_states(h, {state}, {held}k)"


def _at_start(role: str) -> sp.Symbol:
    """Where an episode starts: x, y or heading."""
    return sp.Symbol(f"_start_{role}")


def _scope(scene: Scene, equations: ReducedEquations, actions: list[sp.Symbol]) -> dict[str, sp.Expr]:
    """Meaning of every name that a task may use with this mechanism."""
    mechanism, task = scene.mechanism, scene.task
    scope: dict[str, sp.Expr] = {name: sp.Symbol(name) for name in scene.parameters}
    for q, rate in zip(equations.coordinates, equations.velocity, strict=True):
        scope[q.name] = q
        scope[f"{q.name}_dot"] = rate
        scope[f"{q.name}_before"] = initial(q)
    scope["effort"] = sp.Add(*(a**2 for a in actions)) / len(actions)
    if mechanism.fibre:
        x, y, heading = mechanism.fibre
        # Velocities in the body's axes do not depend on the pose: read them where the axes agree.
        symmetry = planar_symmetry(mechanism, mechanism.frame_rows(scene.frame))
        pose = dict.fromkeys(map(sp.Symbol, mechanism.fibre), sp.S.Zero) if symmetry and not symmetry.turning else {}
        cos, sin = sp.cos(scope[heading]), sp.sin(scope[heading])
        vx, vy = scope[f"{x}_dot"], scope[f"{y}_dot"]
        roles = {
            "x": scope[x],
            "y": scope[y],
            "heading": scope[heading],
            "x_dot": vx,
            "y_dot": vy,
            "heading_dot": scope[f"{heading}_dot"],
            "x_before": scope[f"{x}_before"],
            "y_before": scope[f"{y}_before"],
            "heading_before": scope[f"{heading}_before"],
            "speed": (cos * vx + sin * vy).xreplace(pose),
            "drift": (cos * vy - sin * vx).xreplace(pose),
        }
        for name, meaning in roles.items():
            if scope.get(name, meaning) != meaning:
                raise ExpressionError(
                    f"{mechanism.name} has its own {name!r}, which tasks in the plane use for {meaning}; rename it"
                )
        scope |= roles
    words = (*task.weights, *task.targets, *task.definitions) if task else ()
    for name in (*words, "dt", "forward", "effort", "terminated"):
        if name in (*mechanism.coordinates, *mechanism.parameters, *mechanism.drag, *mechanism.controls):
            raise ExpressionError(f"{mechanism.name} has its own {name!r}, a word that tasks use; rename it")
    return scope | {name: sp.Symbol(name) for name in (task.targets if task else ())}


def _read(task: Task, kind: str, text: str, scope: Mapping[str, sp.Expr]) -> sp.Expr:
    """Expression of a task's text."""
    try:
        return to_sympy(text, scope)
    except ExpressionError as error:
        raise ExpressionError(f"task {task.name!r}, {kind}: {error}") from None


def _joint(equations: ReducedEquations, joint: str) -> tuple[sp.Symbol, sp.Symbol]:
    """Angle and pseudo-velocity of a joint with a stop.

    An inelastic impact is a clamp only if one vector field alone moves the joint.
    """
    index = [c.name for c in equations.coordinates].index(joint)
    row = list(equations.frame.row(index))
    moving = [v for v, entry in zip(equations.pseudo_velocities, row, strict=True) if entry != 0]
    if len(moving) != 1:
        raise ValueError(
            f"{equations.mechanism.name}: the joint limit of {joint!r} needs a frame in which one vector field alone "
            f"moves it; in this frame {len(moving)} do. Choose another frame, or joint_limits=False"
        )
    return equations.coordinates[index], moving[0]


def included(sources: Iterable[Callable[..., Any]], backend: Backend) -> list[str]:
    """Source of functions that a generated module takes in whole."""
    return [
        backend.decorator
        + inspect.getsource(function).replace(": Array", "").replace(": Count", "").replace(" -> Count", "")
        for function in sources
    ]


def items(array: str, count: int, start: int = 0) -> str:
    """Source of `count` elements of an array, separated by commas."""
    return ", ".join(f"{array}[{start + i}]" for i in range(count))


def label(name: str) -> str:
    """Name of an output without the word for its kind."""
    return name.partition(":")[2]
