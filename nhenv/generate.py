"""From a scene to the source of its kernel: the symbolic half of `nhenv.scene`.

Imported only when the cache has no kernel for a scene, so it may import what it likes.
"""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Iterable, Mapping

import sympy as sp

from mechanics.compiler import stops
from mechanics.compiler.codegen import BACKENDS, Program, operation_count
from mechanics.compiler.dataflow import Dataflow, analyse, initial
from mechanics.compiler.integrators import Method, method
from mechanics.expressions import ExpressionError, to_sympy
from mechanics.geometry.reduction import ReducedEquations, derive
from mechanics.geometry.symmetry import planar_symmetry
from nhenv.observation import default_observation
from nhenv.scene import BAD_ACTION, DIVERGED, HISTORY_FULL, RUNNING, TERMINATED, Scene
from nhenv.tasks import Task

__all__ = ["kernel_source"]

# Method and substeps where the graph has no core, and where it has one: the cheapest that keeps
# 10 s of the held-torque reference trajectories within 1e-7 (tests/nhenv/test_references.py).
LAYERED = ("gauss4", 1)
CORE = ("dop853", 2)

# Holds remembered when a state is pruned, so that `env.q` can still be worked out when asked for.
HISTORY = 512

TERMINATED_NOW = sp.Symbol("_terminated")  # 1 if the task ends the episode with this step, else 0


def kernel_source(scene: Scene) -> str:
    """Source of a scene's kernel module."""
    return _Generator(scene, derive(scene.mechanism, scene.frame)).module()


class _Generator:
    """Everything symbolic about one scene."""

    def __init__(self, scene: Scene, equations: ReducedEquations) -> None:
        self.scene, self.equations = scene, equations
        self.backend = BACKENDS[scene.backend]
        self.actions = [sp.Symbol(f"_a_{control}") for control in scene.mechanism.controls]
        self.joints = [_joint(equations, name) for name in scene.joints]
        self.free = [sp.Symbol(f"_free_{angle.name}") for angle, _ in self.joints]
        observation, judgement, ending = self._task_expressions()
        velocities = dict(zip(equations.coordinates, equations.velocity, strict=True))
        accelerations = dict(zip(equations.pseudo_velocities, equations.acceleration, strict=True))
        held = {rate: free for (_, rate), free in zip(self.joints, self.free, strict=True)}
        rates = {**velocities, **{v: rate * held.get(v, 1) for v, rate in accelerations.items()}}
        wanted = self._wanted(rates, [*observation.values(), *judgement.values(), *ending.values()])
        self.flow = analyse(rates, wanted, equations.definitions)
        self.joint_rates = {f"qdot:{angle}": velocities[angle] for angle, _ in self.joints}
        joint_accelerations = {f"vdot:{angle}": accelerations[rate] for angle, rate in self.joints}
        self.motion = {**self.joint_rates, **joint_accelerations}
        self.observation, self.judgement, self.ending = list(observation), list(judgement), list(ending)
        self.targets = self._targets([*observation.values(), *judgement.values(), *ending.values()])
        outputs = {**_integrated(self.flow), **observation, **judgement, **ending, **self.motion}
        self.program = Program(outputs, [sp.Symbol(name) for name in scene.parameters], equations.definitions)
        self.memory = self._memory()

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

    def _wanted(self, rates: Iterable[sp.Symbol], outputs: list[sp.Expr]) -> list[sp.Expr]:
        """What must be known after a step; without a task, everything."""
        if self.scene.task is None:
            return list(rates)
        now = {initial(state): state for state in rates}
        return [*(output.xreplace(now) for output in outputs), *(angle for angle, _ in self.joints)]

    def _memory(self) -> dict[str, tuple[int, int]]:
        """Part of the memory -> its first and last place."""
        n, m, joints = len(self.flow.states), len(self.actions), len(self.joints)
        history = HISTORY if self.flow.pruned else 0
        sizes = {
            "state": n, "limit": m, "stop": joints, "dt": 1, "k": len(self.program.constants),
            # for the way through an impact
            "control": m, "new": n, "free": joints, "work": 2 * joints, "hits": joints,
            "count": min(history, 1), "history": history * m,
        }  # fmt: skip
        if self.targets:
            sizes["target"] = len(self.targets)
        places, offset = {}, 0
        for name, size in sizes.items():
            places[name] = (offset, offset + size)
            offset += size
        return places

    def _places(self) -> dict[str, int]:
        """Part of the memory -> its first place."""
        return {name: start for name, (start, _) in self.memory.items()}

    def _method(self) -> tuple[Method, int]:
        """Integrator and substeps: as asked, or the default for this graph."""
        name, substeps = CORE if self.flow.core else LAYERED
        if self.scene.integrator != "auto":
            name, substeps = self.scene.integrator, 1
        return method(name), self.scene.substeps or substeps

    # -- text ----------------------------------------------------------------------------------

    def module(self) -> str:
        """Text of the generated module."""
        program, flow, backend = self.program, self.flow, self.backend
        chosen, substeps = self._method()
        states, controls = flow.states, self.equations.controls
        before = [initial(state) for state in states]
        judged = (*states, *before, *self.actions, *self.targets, *([TERMINATED_NOW] if self.ending else []))
        parts = [
            f'"""{self._title(chosen, substeps)}"""\n\n{backend.header}',
            self._tables(),
            program.constants_function("constants", [sp.Symbol(name) for name in self.scene.parameters]),
            program.step_function("advance_states", flow, chosen, substeps, (*controls, *self.free), backend),
            program.function("observe", (*states, *self.targets), self.observation, backend),
            program.function("judge", judged, self.judgement, backend),
        ]
        if self.ending:
            parts.append(program.function("ends", (*states, *self.targets), self.ending, backend))
        if self.joints:
            constants = "".join(f"{name} = {getattr(stops, name)!r}\n" for name in stops.CONSTANTS)
            parts += [
                program.function("joint_rates", states, list(self.joint_rates), backend),
                program.function("move_joints", (*states, *controls), list(self.motion), backend),
                constants,
                *self._array_forms(),
                *(backend.decorator + inspect.getsource(f).replace(": Array", "") for f in stops.SOURCES),
            ]
        parts += [self._step(), self._respond()]
        return "\n\n".join(parts)

    def _title(self, chosen: Method, substeps: int) -> str:
        task = self.scene.task.name if self.scene.task else "whole state"
        kinds = ", ".join(f"{layer.kind} ({' '.join(s.name for s in layer.states)})" for layer in self.flow.layers)
        return (
            f"{self.scene.mechanism.name}, {task}. Generated from the reduced equations; do not edit.\n\n"
            f"States: {kinds}. Pruned: {' '.join(s.name for s in self.flow.pruned) or 'none'}.\n"
            f"Integrator: {chosen.name} ({chosen.source}), {substeps} step(s) a hold.\n"
            f"{operation_count(self.program)} operations in all rates, observations and rewards together.\n"
        )

    def _tables(self) -> str:
        """Names and places, so that a loaded kernel needs nothing symbolic."""
        places = {state: i for i, state in enumerate(self.flow.states)}
        tables = {
            "STATES": tuple(state.name for state in self.flow.states),
            "PRUNED": tuple(state.name for state in self.flow.pruned),
            "OBSERVATION": tuple(_label(name) for name in self.observation),
            "ANGLES": tuple(places[angle] for angle, _ in self.joints),
            "RATES": tuple(places[rate] for _, rate in self.joints),
            "MEMORY": self.memory,
            "SIZE": max(end for _, end in self.memory.values()),
        }
        if self.targets:
            tables["TARGETS"] = tuple(target.name for target in self.targets)
        return "".join(f"{name} = {value!r}\n" for name, value in tables.items())

    def _respond(self) -> str:
        """Plain Python around `step`: (memory, action) -> what an environment's step returns, all fresh.

        The place of `terminated` has the status if that is not RUNNING. Unpacking by name costs half of
        what `*action` does, and a literal a third of `dict(zip(...))`.
        """
        actions = ", ".join(action.name for action in self.actions)
        entries = ", ".join(f"{_label(name)!r}: result[{i + 2}]" for i, name in enumerate(self.judgement))
        call, imports = [f"result = step(memory, observation, {actions})"], "dtype, empty"
        if not self.backend.decorator:  # NumPy's numbers warn where compiled ones do not, and are no floats
            call = ["with errstate(all='ignore'):", *(f"    {line}" for line in call), "result = [*map(float, result)]"]
            imports += ", errstate"
        lines = [
            f"{actions}, = action.tolist()",
            f"observation = empty({len(self.observation)}, FLOAT32)",
            *call,
            f"return observation, result[1], result[0] or False, False, {{{entries}}}",
        ]
        text = textwrap.indent("\n".join(lines), "    ")
        return f"from numpy import {imports}\n\nFLOAT32 = dtype('float32')\n\n\ndef respond(memory, action):\n{text}\n"

    def _array_forms(self) -> list[str]:
        """`advance` and `motion` over arrays, for the stops."""
        n, m, joints = len(self.flow.states), len(self.actions), len(self.joints)
        arguments = f"{_items('state', n)}, {_items('control', m)}"
        return [
            f"{self.backend.decorator}def advance(h, state, control, free, k, new):\n"
            f"    {_items('new', n)}, = advance_states(h, {arguments}, {_items('free', joints)}, k)\n",
            f"{self.backend.decorator}def motion(state, control, k, out):\n"
            f"    {_items('out', 2 * joints)}, = move_joints({arguments}, k)\n",
        ]

    def _step(self) -> str:
        """The kernel: unpack, clip, hold, check, judge."""
        # Names of the user's get two underscores in the middle: they cannot meet those of the kernel.
        states = [state.name for state in self.flow.states]
        old, new = (f"{', '.join(f'{name}__{when}' for name in states)}, " for when in ("old", "new"))
        controls = [f"{control.name}__u" for control in self.equations.controls]
        place = self._places()
        state = _items("memory", len(states), place["state"])
        nothing = "0.0, " * (1 + len(self.judgement))
        lines = []
        if self.flow.pruned:
            lines += [
                f"count = int(memory[{place['count']}])",
                f"if count == {HISTORY}:",
                f"    return ({HISTORY_FULL}, {nothing})",
            ]
        for i, (action, control) in enumerate(zip(self.actions, controls, strict=True)):
            lines += [
                f"if {action} != {action}:",
                f"    return ({BAD_ACTION}, {nothing})",
                f"{action} = min(max({action}, -1.0), 1.0)",
                f"{control} = memory[{place['limit'] + i}]*{action}",
            ]
        if self.flow.pruned:
            m = len(self.actions)
            lines += [
                *(f"memory[{place['history'] + i} + {m}*count] = {a}" for i, a in enumerate(self.actions)),
                f"memory[{place['count']}] = count + 1.0",
            ]
        held = f"{', '.join(controls)}, {'1.0, ' * len(self.joints)}"
        lines += [
            f"{old}= {state},",
            f"dt = memory[{place['dt']}]",
            f"k = memory[{self.memory['k'][0]}:{self.memory['k'][1]}]",
        ]
        flight = f"{new}= advance_states(dt, {old}{held}k)"
        lines += self._through_impacts(old, new, controls, flight) if self.joints else [flight]
        lines += [
            f"status = {RUNNING}",
            f"if not isfinite({' + '.join(f'0.0*{name}__new' for name in states)}):",
            f"    {new}= {old}",
            f"    status = {DIVERGED}",
            f"{state}, = {new}",
        ]
        aim = "".join(f"memory[{place['target'] + i}], " for i in range(len(self.targets)))
        if self.observation:
            seen = _items("observation", len(self.observation))
            lines.append(f"{seen}, = observe({new}{aim}k)")
        over = ""
        if self.ending:
            over = "over, "
            lines += [
                "over = 0.0",
                f"if status == {RUNNING} and ends({new}{aim}k)[0] > 0.0:",
                "    over = 1.0",
                f"    status = {TERMINATED}",
            ]
        reward = "0.0"
        if self.judgement:
            lines.append(f"judged = judge({new}{old}{', '.join(a.name for a in self.actions)}, {aim}{over}k)")
            rewards = [i for i, name in enumerate(self.judgement) if name.startswith("reward:")]
            reward = " + ".join(f"judged[{i}]" for i in rewards)
        lines.append(f"return (status, {reward}, {''.join(f'judged[{i}], ' for i in range(len(self.judgement)))})")
        # The one entry point is compiled for these types when the module is loaded, and cached.
        types = f"(float64[::1], float32[::1]{', float64' * len(self.actions)})"
        decorator = self.backend.decorator.replace("@njit(", f'@njit("{types}", cache=CACHE__, ')
        arguments = ", ".join(("memory", "observation", *(a.name for a in self.actions)))
        return f"{decorator}def step({arguments}):\n" + textwrap.indent("\n".join(lines), "    ") + "\n"

    def _through_impacts(self, old: str, new: str, controls: list[str], flight: str) -> list[str]:
        """Accept free flight if no joint can have met its stop, else integrate from impact to impact."""
        place = self._places()
        away, safe = [], []
        for j, (angle, rate) in enumerate(self.joints):
            stop = f"memory[{place['stop'] + j}]"
            excursion = f"fabs({angle}__old) + dt*fabs(joint_rates({old}k)[{j}]) < {stop}"
            away.append(f"fabs({angle}__old) < {stop}")
            safe += [f"fabs({angle}__new) < {stop}", f"({rate}__old*{rate}__new >= 0.0 or {excursion})"]
        parts = ("state", "control", "k", "stop", "free", "work", "hits", "new")
        arrays = ", ".join(f"memory[{start}:{end}]" for start, end in (self.memory[part] for part in parts))
        n = len(self.flow.states)
        return [
            f"if {' and '.join(away)}:",
            f"    {flight}",
            f"    accepted = {' and '.join(safe)}",
            "else:",
            f"    {new}= {old}",
            "    accepted = False",
            "if not accepted:",
            f"    {_items('memory', len(controls), place['control'])}, = {', '.join(controls)},",
            f"    {_items('memory', n, place['new'])}, = {new}",
            f"    hold(dt, {arrays})",
            f"    {new}= {_items('memory', n, place['state'])},",
        ]


def _integrated(flow: Dataflow) -> dict[str, sp.Expr]:
    """What the step function of `codegen` reads."""
    rates = {f"rate:{s.name}": rate for s, rate in flow.rates.items() if s not in flow.solutions}
    return {**rates, **{f"solution:{s.name}": solution for s, solution in flow.solutions.items()}}


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
        if name in mechanism.coordinates or name in mechanism.parameters:
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


def _items(array: str, count: int, start: int = 0) -> str:
    return ", ".join(f"{array}[{start + i}]" for i in range(count))


def _label(name: str) -> str:
    return name.partition(":")[2]
