"""The kernel of many environments side by side: loops over the rows of a block, as source.

What a row goes through is the same text as in the kernel of one environment, and `nhenv.rows` drives the loops. Each
loop reads and writes few arrays at constant distances, which is what lets LLVM turn it into vector code.
"""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Iterable, Sequence

from mechanics.compiler.backends import Backend
from nhenv import random_streams, rows
from nhenv.generate import Generator, included, items
from nhenv.scene import BAD_ACTION, DIVERGED, LARGEST, RUNNING, TERMINATED, Scene

__all__ = ["RowsKernel"]

# Rows in a block: enough to hide the latency of long chains, few enough that the scratch fields stay in the first
# cache. The stride between fields is not a power of two, lest all of them share the same few lines of that cache.
ROWS, STRIDE = 128, 136


class RowsKernel(Generator):
    """Source of `step_rows`, `begin_rows` and `look_rows`.

    Args:
        scene: what to simulate.
        varied: whether each row has parameters, torque limits and stops of its own.
    """

    def __init__(self, scene: Scene, *, varied: bool) -> None:
        super().__init__(scene)
        self.varied = varied
        states = [state.name for state in self.flow.states]
        controls = [control.name for control in self.equations.controls]
        angles = [angle.name for angle, _ in self.joints]
        self.carried = self.program.carried(self.flow, self.method)
        carried = list(self.carried)
        own = {"k": [constant.name for constant in self.program.constants], "limit": controls, "stop": angles}
        # Field -> its place: of what lasts, of what a step needs on its way, and of what holds for all rows.
        lasting = {
            "s": states,
            "c": carried,
            "t": [target.name for target in self.targets],
            "steps": [""],
            "over": [""],
        }
        self.lasting = _places({**lasting, **(own if varied else {})}, "p")
        motion = {"x": states, "c": carried, "u": controls, "free": angles, "time": [""]}
        judged = {
            "a": controls,
            "bad": [""],
            "before": [state.name for state in self.remembered],
            "o": [str(i) for i in range(len(self.observation))],
            "reward": [""],
            "status": [""],
        }
        search = ("search", "missed", "trial", "low", "high", "end", "side", "gap", "toward")
        kept = ["right", "left", "longest"] * self.controlled + ["hit"] * self.events + [*search] * bool(angles)
        departure = {"y": states} if self.controlled else {}
        self.scratch = _places({**motion, **judged, **departure, **{name: [""] for name in kept}}, "w")
        shared = {**({} if varied else own), **{name: [""] for name in ("dt", "noise", "max_steps", "mode")}}
        shared["nothing"] = list(scene.givable)
        self.shared = _places(shared, "n")

    def module(self) -> str:
        """Text of the generated module."""
        strict, inline = self.backend, self.backend.inlined()
        kind = "many environments, each with parameters of its own" if self.varied else "many environments"
        parts = [
            f'"""{self.title(kind)}"""\n\n{strict.header}{random_streams.IMPORTS}{_IMPORTS}',
            self._tables(),
            self.constants(),
            *self.functions(inline, 1, self.carried),
            *([] if self.varied else [self._twice(inline)]),
            self.program.carry_function("carry", self.flow, self.carried, inline),
            *(self.stop_functions(strict) if self.events else []),
            *self._constants(),
            *included(random_streams.SOURCES, inline),
            *self._loops(),
            self._start_row(),
            self._look_row(),
            *self._driver(),
        ]
        return "\n\n".join(parts)

    def _twice(self, backend: Backend) -> str:
        """Source of `advance_states_twice`, which advances two rows in turn, operation by operation."""
        return self.step_function("advance_states_twice", 1, backend, self.carried, streams=2)

    def advance(self, new: str, state: str, held: str) -> str:
        """Lines that advance a state by `h`, through all substeps, and say whether it is `right`."""
        carried = f"*carry({new}, k), " if self.carried else ""
        step = f"{new}, each = advance_states(h, {new}, {carried}{held}k)\n    right = right & each"
        start = f"right = True\n{new}, = {state},\nh = {self._share('h')}\n"
        return f"{start}for _ in range({self.substeps}):\n    {step}"

    # -- names ---------------------------------------------------------------------------------

    def _tables(self) -> str:
        size = STRIDE * max(len(self.lasting), len(self.scratch))
        return self.tables(
            ROWS=ROWS,
            STRIDE=STRIDE,
            SIZE=STRIDE * len(self.lasting),
            SCRATCH=size,
            LASTING={name: STRIDE * i for name, i in self.lasting.items()},
            SHARED=self.shared,
        )

    def _constants(self) -> list[str]:
        """Places of the fields: unsigned in loops, where a negative one would have to be allowed for; else plain."""
        fields = {**self.lasting, **self.scratch}
        lines = [f"{name} = uint64({STRIDE * i})\n" for name, i in fields.items()]
        lines.append("EIGHT, SIXTEEN = uint64(8), uint64(16)\n")
        plain = {
            "SUBSTEPS": self.substeps, "STREAMS": 1 if self.varied else 2, "JOINTS": len(self.joints),
            "EVENTS": int(self.events), "KINDS": 2 if self.controlled else 1,
            "N_STATES": len(self.flow.states),
            "N_CONTROLS": len(self.actions), "N_OBSERVATIONS": len(self.observation),
            "STATE": 0, "STEPS": STRIDE * self.lasting["steps__p"], "OVER": STRIDE * self.lasting["over__p"],
            "DT": self.shared["dt__n"], "MAX_STEPS": self.shared["max_steps__n"], "MODE": self.shared["mode__n"],
            "RUNNING": RUNNING, "DIVERGED": DIVERGED, "TERMINATED": TERMINATED,
            "NOTHING": len(self.shared) - len(self.scene.givable),
            "NEXT_STEP": rows.NEXT_STEP, "SAME_STEP": rows.SAME_STEP,
        }  # fmt: skip
        first = {"X": "x", "CONTROL": "u", "BAD": "bad", "HIT": "hit", "STATUS": "status"}
        for name, kind in first.items():
            places = [i for field, i in self.scratch.items() if field.startswith(f"{kind}_")]
            plain[name] = STRIDE * min(places, default=0)
        lines += [f"{name} = {value!r}\n" for name, value in plain.items()]
        lines += [f"{name} = {getattr(rows, name)!r}\n" for name in rows.CONSTANTS]
        lines += [f"{name} = {getattr(random_streams, name)!r}\n" for name in random_streams.CONSTANTS]
        return ["".join(lines)]

    def _states(self, kind: str, array: str = "w") -> str:
        """Source of the states in a field, separated and followed by commas."""
        return _listed(f"{array}[{kind}_{state.name}__{array} + j]" for state in self.flow.states)

    def _fields(self, kind: str, names: Iterable[str], array: str = "w") -> str:
        return _listed(f"{array}[{kind}_{name}__{array} + j]" for name in names)

    @property
    def _aims(self) -> str:
        return self._fields("t", (target.name for target in self.targets), "p")

    @property
    def _control_names(self) -> list[str]:
        return [control.name for control in self.equations.controls]

    @property
    def _joint_names(self) -> list[str]:
        return [angle.name for angle, _ in self.joints]

    # -- loops ---------------------------------------------------------------------------------

    def _own(self, kind: str, names: Sequence[str], j: str = "j") -> list[str]:
        """Source of what a row has of its own, or shares with all."""
        if self.varied:
            return [f"p[{kind}_{name}__p + {j}]" for name in names]
        return [f"numbers[{self.shared[f'{kind}_{name}__n']}]" for name in names]

    def _known(self, j: str = "j") -> list[str]:
        """Lines that put constants, limits and stops under short names."""
        constants = self._own("k", [constant.name for constant in self.program.constants], j)
        lines = [f"k = ({_listed(constants)})"]
        limits = self._own("limit", self._control_names, j)
        lines += [f"limit_{name} = {text}" for name, text in zip(self._control_names, limits, strict=True)]
        stops = self._own("stop", self._joint_names, j)
        return lines + [f"stop_{name} = {text}" for name, text in zip(self._joint_names, stops, strict=True)]

    def _loop(
        self,
        name: str,
        arguments: str,
        body: Sequence[str],
        total: str = "",
        over: Sequence[str] = ("for j in range(uint64(count)):",),
    ) -> str:
        """Source of a function over the rows of a block; it may count some."""
        lines, inner = [], list(body)
        if "numbers" in arguments:
            lines += [f"{name} = numbers[{self.shared[f'{name}__n']}]" for name in ("dt", "max_steps")]
            lines, inner = (lines, self._known() + inner) if self.varied else (lines + self._known(), inner)
        lines += [f"{total} = 0"] * bool(total)
        indent = " " * (len(over[-1]) - len(over[-1].lstrip()) + 4)
        lines += [*over, *(indent + line for line in inner)]
        lines += [f"return {total}"] * bool(total)
        text = textwrap.indent("\n".join(lines), "    ")
        return f"{self.backend.decorator}def {name}({arguments}):\n{text}\n"

    def _loops(self) -> list[str]:
        block = "p, w, count, numbers"
        actions = [action.name for action in self.actions]
        observed = [str(i) for i in range(len(self.observation))]
        changed = [f"(w[x_{v.name}__w + j] != p[s_{v.name}__p + j])" for _, v in self.joints if self.carried]
        return [
            self._loop(
                "load_rows",
                "w, count, actions",
                [
                    *(f"{action} = float(actions[j, {i}])" for i, action in enumerate(actions)),
                    f"bad = {' | '.join(f'({action} != {action})' for action in actions)}",
                    *(
                        f"w[a_{control}__w + j] = clip(0.0 if bad else {action}, -1.0, 1.0)"
                        for action, control in zip(actions, self._control_names, strict=True)
                    ),
                    f"w[bad__w + j] = {BAD_ACTION} if bad else {RUNNING}",
                ],
            ),
            self._loop(
                "prepare_rows",
                block,
                [
                    *(f"w[u_{u}__w + j] = limit_{u}*w[a_{u}__w + j]" for u in self._control_names),
                    *self._settled(self._states("s", "p")),
                    *(
                        [f"{self._fields('c', self.carried)} = {self._fields('c', self.carried, 'p')}"]
                        * bool(self.carried)
                    ),
                    f"w[time__w + j] = {self._share('dt')}",
                    *self._trusted(),
                    f"count_changed += 1 if {' | '.join(changed) or 'False'} else 0",
                ],
                "count_changed",
            ),
            self._advance_rows(block),
            self._loop("see_rows", block, self._seen(self._states("x"))),
            *(self._event_loops() if self.events else []),
            self._finish(block),
            self._inform(),
            self._loop(
                "emit_rows",
                "w, count, observations, rewards",
                [
                    *(f"observations[j, {i}] = w[o_{i}__w + j]" for i in observed),
                    "rewards[j] = w[reward__w + j]",
                ],
            ),
        ]

    def _carry(self) -> list[str]:
        """Lines that work out what is carried from step to step."""
        if not self.carried:
            return []
        return [f"{self._fields('c', self.carried)} = carry({self._states('x')}k)"]

    def _seen(self, states: str) -> list[str]:
        """Lines that work out what is carried and observed of states: together, as they have much in common."""
        lines = [f"{self._fields('c', self.carried)} = carry({states}k)"] * bool(self.carried)
        if self.observation:
            seen = _listed(f"w[o_{i}__w + j]" for i in range(len(self.observation)))
            lines.append(f"{seen} = observe({states}{self._aims}k)")
        return lines or ["pass"]

    def _share(self, time: str) -> str:
        return f"{time}*{1 / self.substeps!r}" if self.substeps > 1 else time

    def _advance_rows(self, block: str) -> str:
        """The loop that moves: rows in pairs, eight and eight, each pair as two streams; surplus rows do no harm.

        Rows that have constants of their own go one by one: two sets of these would not leave room for anything else.
        """
        states = [state.name for state in self.flow.states]
        new = [_listed(f"{name}__{i}" for name in states) for i in (0, 1)]
        right = [f"{given}right__{i}, " for i, given in enumerate(new)]
        old = (
            f"w[time__w + j], {self._states('x')}{self._fields('c', self.carried)}"
            f"{self._fields('u', self._control_names)}{self._fields('free', self._joint_names)}"
        )
        outcome = [[f"{self._states('x')} = {each}", *self._seen(each)] for each in new]
        if self.controlled:
            for i, lines in enumerate(outcome):
                lines.append(f"w[right__w + j] = w[right__w + j] if right__{i} else 0.0")
        if self.varied:
            return self._loop("advance_rows", block, [f"{right[0]} = advance_states({old}k)", *outcome[0]])
        body = [
            "j = pair*SIXTEEN + i",
            "jj = j + EIGHT",
            f"{right[0]}{right[1]} = advance_states_twice({old}{old.replace('+ j]', '+ jj]')}k)",
            *outcome[0],
            *(line.replace("+ j]", "+ jj]") for line in outcome[1]),
        ]
        over = ("align_stack()", "for pair in range(uint64((count + 15)//16)):", "    for i in range(EIGHT):")
        return self._loop("advance_rows", block, body, over=over)

    def _settled(self, states: str) -> list[str]:
        """Lines that put states into the field x, joints settled on the stops that they are pressed against."""
        if not self.joints:
            return [f"{self._states('x')} = {states}"]
        controls = self._fields("u", self._control_names)
        stops = _listed(f"stop_{name}" for name in self._joint_names)
        freed = self._fields("free", self._joint_names)
        return [f"{self._states('x')}{freed} = settle_states({states}{controls}{stops}k)"]

    def _trusted(self) -> list[str]:
        """Lines that take a flight for right until it turns out not to be."""
        return ["w[right__w + j] = 1.0"] * self.controlled

    def _clear(self, old: str, time: str) -> list[str]:
        """Lines that say whether a flight from `old` to the field x was `clear` of stops, and of releases from them."""
        if not self.joints:
            return ["clear = True"]
        stops = _listed(f"stop_{name}" for name in self._joint_names)
        new, free = self._states("x"), self._fields("free", self._joint_names)
        lines = [f"clear = clear_joints({time}, {old}{new}{free}{stops}k)"]
        if any(self.may_release(*joint) for joint in self.joints):
            lines.append(f"_push = move_joints({new}{self._fields('u', self._control_names)}k)")
            for i, name in enumerate(self._joint_names, len(self.joints)):
                pressed = f"(_push[{i}]*w[x_{name}__w + j] >= 0.0)"
                lines.append(f"clear = clear & ((w[free_{name}__w + j] != 0.0) | {pressed})")
        return lines

    def _screen(self, block: str) -> str:
        """The loop that finds the rows whose free flight is not all there is to their step."""
        lines = [*self._clear(self._states("s", "p"), "dt"), "event = 0.0 if clear else STOPPED"]
        if self.controlled:
            lines.append("event = event if w[right__w + j] != 0.0 else LATE")
        lines += [
            "event = event if p[over__p + j] == 0.0 else 0.0",
            "w[hit__w + j] = event",
            "hits += 1 if event != 0.0 else 0",
        ]
        return self._loop("screen_rows", block, lines, "hits")

    def _flight_loops(self, block: str) -> list[str]:
        """Loops that take rows through a hold in shorter flights: `mechanics.compiler.stops.hold` without events."""
        states = [state.name for state in self.flow.states]
        begin = [
            f"{self._states('y')} = {self._states('s', 'p')}",
            "w[left__w + j], w[longest__w + j], w[hit__w + j] = dt, dt, 0.0",
        ]
        depart = [
            *self._settled(self._states("y")),
            "flying = w[left__w + j] > 0.0",
            *(f"w[x_{name}__w + j] = w[x_{name}__w + j] if flying else w[y_{name}__w + j]" for name in states),
            f"{self._states('y')} = {self._states('x')}",
            *self._carry(),
            "flight = min(w[longest__w + j], w[left__w + j])",
            f"w[time__w + j] = {self._share('flight')}",
            *self._trusted(),
        ]
        arrive = [
            "left = w[left__w + j]",
            "flight, flying = min(w[longest__w + j], left), left > 0.0",
            *self._clear(self._states("y"), "flight"),
            "right = w[right__w + j] != 0.0",
            "there = flying & right & clear",
            "lost = flying & ((right & (not clear)) | ((not right) & (0.5*flight < SHORTEST*dt)))",
            "w[hit__w + j] = STOPPED if lost else w[hit__w + j]",
            "w[longest__w + j] = 2.0*flight if right else 0.5*flight",
            "left = left - flight if there else (0.0 if lost else left)",
            "w[left__w + j] = left",
            *(f"w[y_{name}__w + j] = w[x_{name}__w + j] if there else w[y_{name}__w + j]" for name in states),
            "count_flying += 1 if left > 0.0 else 0",
        ]
        land = [
            f"{self._states('x')} = {self._states('y')}",
            "lost = (w[left__w + j] > 0.0) | (w[hit__w + j] != 0.0)",
            "w[hit__w + j] = STOPPED if lost else 0.0",
            "count_lost += 1 if lost else 0",
        ]
        return [
            self._loop("begin_flights", block, begin),
            self._loop("depart_rows", block, depart),
            self._loop("arrive_rows", block, arrive, "count_flying"),
            self._loop("end_flights", block, land, "count_lost"),
        ]

    def _event_loops(self) -> list[str]:
        """Loops of the way from event to event; those of a single joint follow `mechanics.compiler.stops` closely."""
        block = "p, w, count, numbers"
        parts = [*([self._settle_states()] if self.joints else []), self._screen(block), *self._moves()]
        if self.controlled:
            parts += self._flight_loops(block)
        if len(self.joints) != 1:
            return [*parts, *self._no_regular_rows()]
        ((_, rate),), (name,) = self.joints, self._joint_names
        controls = self._fields("u", self._control_names)
        old = _listed(f"{state.name}__old" for state in self.flow.states)
        free = f"free_{name}"
        settle = f"{old}{free}, = settle_states({self._states('s', 'p')}{controls}stop_{name}, k)"
        return [
            *parts,
            self._loop(
                "bracket_rows",
                block,
                [
                    settle,
                    f"angle, rate = w[x_{name}__w + j], w[x_{rate.name}__w + j]",
                    f"before = move_joints({old}{controls}k)",
                    f"after = move_joints({self._states('x')}{controls}k)",
                    # It turned on the way, perhaps beyond the stop that it went for first; or it ends beyond one.
                    f"side = copysign(1.0, {rate.name}__old)",
                    f"far = side*{name}__old + dt*fabs(before[0]) > stop_{name}",
                    f"turned = ({rate.name}__old*rate < 0.0) & far",
                    "side = side if turned else copysign(1.0, angle)",
                    f"crossed = fabs(angle) > stop_{name}",
                    f"regular = {free} != 0.0",
                    f"gap, toward = side*{name}__old - stop_{name}, side*before[0]",
                    f"low = -side*{rate.name}__old if turned else gap",
                    f"high = -side*rate if turned else side*angle - stop_{name}",
                    "low_rate = -side*before[1] if turned else toward",
                    "high_rate = -side*after[1] if turned else side*after[0]",
                    "met = turned | crossed",
                    "w[trial__w + j] = guess(low, high, low_rate, high_rate, dt) if met else dt",
                    "w[low__w + j], w[high__w + j], w[end__w + j] = 0.0, dt, dt",
                    "w[side__w + j], w[gap__w + j], w[toward__w + j] = side, gap, toward",
                    "w[missed__w + j] = 0.0 if met else 1.0",
                    "search = TURN if turned else (CROSSING if crossed else LAST)",
                    "w[search__w + j] = search if regular else 0.0",
                    "w[hit__w + j] = 0.0 if regular else 1.0",
                    "count_regular += 1 if regular else 0",
                ],
                "count_regular",
            ),
            self._loop(
                "rewind_rows",
                block,
                [
                    *self._settled(self._states("s", "p")),
                    *self._carry(),
                    f"w[time__w + j] = {self._share('w[trial__w + j]')}",
                    *self._trusted(),
                ],
            ),
            self._loop(
                "refine_rows",
                block,
                [
                    f"angle, rate = w[x_{name}__w + j], w[x_{rate.name}__w + j]",
                    f"motion = move_joints({self._states('x')}{controls}k)",
                    "search, side, trial = w[search__w + j], w[side__w + j], w[trial__w + j]",
                    "low, high, end = w[low__w + j], w[high__w + j], w[end__w + j]",
                    "turning = search == TURN",
                    f"over = side*angle - stop_{name}",
                    "value = -side*rate if turning else over",
                    "slope = -side*motion[1] if turning else side*motion[0]",
                    "bend = 0.0 if turning else side*motion[1]",
                    "better, low_, high_ = refine(trial, low, high, value, slope, bend, end)",
                    "found = better == trial",
                    # Where it turned: beyond the stop, so look for the crossing before; or it never got there.
                    "beyond, missed = turning & found & (over > 0.0), turning & found & (over <= 0.0)",
                    "crossing = guess(w[gap__w + j], over, w[toward__w + j], side*motion[0], trial)",
                    "searching = search != 0.0",
                    "w[low__w + j] = 0.0 if beyond else (low_ if searching else low)",
                    "w[high__w + j] = trial if beyond else (high_ if searching else high)",
                    "w[end__w + j] = trial if beyond else end",
                    "w[missed__w + j] = 1.0 if missed else w[missed__w + j]",
                    "trial = dt if missed else (crossing if beyond else (better if searching else trial))",
                    "w[trial__w + j] = trial",
                    f"w[hit__w + j] = 1.0 if (search == LAST) & (fabs(angle) > stop_{name}) else w[hit__w + j]",
                    "search = 0.0 if found | (search == LAST) else search",
                    "search = LAST if missed else (CROSSING if beyond else search)",
                    "w[search__w + j] = search",
                    "count_open += 1 if search != 0.0 else 0",
                ],
                "count_open",
            ),
            self._loop(
                "land_rows",
                block,
                [
                    f"angle, rate = w[x_{name}__w + j], w[x_{rate.name}__w + j]",
                    "missed = w[missed__w + j] != 0.0",
                    f"w[x_{name}__w + j], w[x_{rate.name}__w + j] = copysign(stop_{name}, angle), 0.0",
                    *self._settled(self._states("x")),
                    # Nothing is left of a flight that met no stop; as it ended, so it stays.
                    f"w[x_{name}__w + j] = angle if missed else w[x_{name}__w + j]",
                    f"w[x_{rate.name}__w + j] = rate if missed else w[x_{rate.name}__w + j]",
                    f"w[free_{name}__w + j] = 1.0 if missed else w[free_{name}__w + j]",
                    *self._carry(),
                    f"w[time__w + j] = {self._share('(dt - w[trial__w + j])')}",
                    *self._trusted(),
                ],
            ),
            self._loop(
                "check_rows",
                block,
                [
                    f"again = (w[free_{name}__w + j] != 0.0) & (fabs(w[x_{name}__w + j]) > stop_{name})",
                    "irregular = again | (w[hit__w + j] != 0.0) | (w[search__w + j] != 0.0)"
                    + " | (w[right__w + j] == 0.0)" * self.controlled,
                    "w[hit__w + j] = 1.0 if irregular else 0.0",
                    "count_irregular += 1 if irregular else 0",
                ],
                "count_irregular",
            ),
        ]

    def _moves(self) -> list[str]:
        """Loops that bring rows into the spare block, and back."""
        kinds = [("x", [state.name for state in self.flow.states]), *((kind, self._control_names) for kind in "ua")]
        needed = [f"{kind}_{name}__w" for kind, names in kinds for name in names] + ["bad__w", "hit__w"]
        observed = range(len(self.observation))
        return [
            self._loop(
                "take_rows",
                "p, w, count, rows, spare, v, held",
                [
                    "row, j = rows[i], uint64(held) + i",
                    *(f"spare[{field} + j] = p[{field} + row]" for field in self.lasting),
                    *(f"v[{field} + j] = w[{field} + row]" for field in needed),
                ],
                over=("for i in range(uint64(count)):",),
            ),
            self._loop(
                "give_rows",
                "v, count, rows, observations, rewards",
                [
                    "row = rows[j]",
                    *(f"observations[row, {i}] = v[o_{i}__w + j]" for i in observed),
                    "rewards[row] = v[reward__w + j]",
                ],
            ),
            self._loop(
                "put_rows",
                "spare, count, rows, blocks",
                [
                    f"block, row = rows[j] // uint64({ROWS}), rows[j] % uint64({ROWS})",
                    *(f"blocks[block, {field} + row] = spare[{field} + j]" for field in self.lasting),
                ],
            ),
        ]

    def _no_regular_rows(self) -> list[str]:
        """Without a joint, or with several, everything is left to `hold`."""
        block = "p, w, count, numbers"
        counted = [self._loop(f"{name}_rows", block, ["total += 0"], "total") for name in ("bracket", "refine")]
        counted.append(self._loop("check_rows", block, ["w[hit__w + j] = STOPPED", "total += 1"], "total"))
        return [*counted, *(self._loop(f"{name}_rows", block, ["pass"]) for name in ("rewind", "land"))]

    def _settle_states(self) -> str:
        """`mechanics.compiler.stops.settle` without branches: the states settled, and whether each joint is free."""
        # Two underscores in the middle: no name of a user's then hides a function that is called here.
        states = [f"{state.name}__s" for state in self.flow.states]
        controls = [f"{name}__u" for name in self._control_names]
        lines = []
        for j, (angle, rate) in enumerate(self.joints):
            a, v = f"{angle.name}__s", f"{rate.name}__s"
            stop, free = f"_stop_{angle.name}", f"_free_{angle.name}"
            lines += [
                f"_at = fabs({a}) >= {stop}",
                f"{a} = copysign({stop}, {a}) if _at else {a}",
                f"_pressed = _at & ({v}*{a} >= -AT_REST)",
                f"{v} = 0.0 if _pressed else {v}",
                f"_push = move_joints({_listed(states)}{_listed(controls)}_k)[{len(self.joints) + j}]",
                f"{free} = 0.0 if _pressed & (_push*{a} >= 0.0) else 1.0",
            ]
        frees = _listed(f"_free_{name}" for name in self._joint_names)
        lines.append(f"return ({_listed(states)}{frees})")
        arguments = f"{_listed(states)}{_listed(controls)}{_listed(f'_stop_{n}' for n in self._joint_names)}_k"
        body = textwrap.indent("\n".join(lines), "    ")
        return f"{self.backend.inline}def settle_states({arguments}):\n{body}\n"

    def _finish(self, block: str) -> str:
        """The loop that judges the outcome: what `step` of the kernel of one environment does after the motion."""
        states = [state.name for state in self.flow.states]
        new, old = (_listed(f"{name}__{when}" for name in states) for when in ("new", "old"))
        lines = [
            f"{old} = {self._states('s', 'p')}",
            f"{new} = {self._states('x')}",
            f"good = {' & '.join(f'(fabs({name}__new) < {LARGEST})' for name in states)}",
            *(f"{name}__new = {name}__new if good else {name}__old" for name in states),
            f"{self._states('s', 'p')} = {new}",
            f"{self._states('x')} = {new}",
            *(f"w[before_{state.name}__w + j] = {state.name}__old" for state in self.remembered),
        ]
        lines += [f"p[c_{c}__p + j] = w[c_{c}__w + j] if good else p[c_{c}__p + j]" for c in self.carried]
        lines.append(f"status = w[bad__w + j] if good else {DIVERGED}")
        if self.ending:
            lines += [
                f"over = good & (ends({new}{self._aims}k)[0] > 0.0)",
                f"status = {TERMINATED} if over else status",
            ]
        rewards = [i for i, name in enumerate(self.judgement) if name.startswith("reward:")]
        lines += [
            f"judged = {self._judge(new, old, '(1.0 if over else 0.0)')}",
            f"w[reward__w + j] = {' + '.join(f'judged[{i}]' for i in rewards) or '0.0'}",
            "w[status__w + j] = status",
            "steps = p[steps__p + j] + 1.0",
            "p[steps__p + j] = steps",
            f"due = (status != {RUNNING}) | (w[bad__w + j] != {RUNNING}) | (p[over__p + j] != 0.0)",
            "due = due | (steps >= max_steps)",
            "busy += 1 if due else 0",
        ]
        return self._loop("finish_rows", block, lines, "busy")

    def _judge(self, new: str, old: str, over: str) -> str:
        actions = self._fields("a", self._control_names)
        return f"judge({new}{old}{actions}{self._aims}{over + ', ' if self.ending else ''}k)"

    def _inform(self) -> str:
        """The loop that works out rewards and info one by one, for those who ask."""
        before = _listed(f"w[before_{s.name}__w + j]" if s in self.remembered else "0.0" for s in self.flow.states)
        over = f"(1.0 if w[status__w + j] == {TERMINATED} else 0.0)"
        lines = [
            f"values = {self._judge(self._states('x'), before, over)}",
            *(f"judged[{i}, start + int64(j)] = values[{i}]" for i in range(len(self.judgement))),
        ]
        return self._loop("inform_rows", "p, w, count, numbers, judged, start", lines)

    # -- rows ----------------------------------------------------------------------------------

    def _start_row(self) -> str:
        """The beginning of an episode: the next numbers of the row's own stream, and nothing else at random."""
        drawn = [f"_u{i}" for i in range(self.scene.draws)]
        given = [f"given[{i}]" for i in range(len(self.scene.givable))]
        values = _listed((*drawn, f"numbers[{self.shared['noise__n']}]", *given))
        states, noisy = [state.name for state in self.flow.states], self.scene.noisy
        lines = [
            *(f"{name} = uniform(streams, row)" for name in drawn),
            *self._known(),
            f"started = start({values}k)",
            *(f"p[s_{state}__p + j] = 0.0" for state in states),
            *(f"p[s_{name}__p + j] = started[{i}]" for i, name in enumerate(noisy) if name in states),
            *(f"p[t_{t.name}__p + j] = started[{len(noisy) + i}]" for i, t in enumerate(self.targets)),
            "p[steps__p + j] = 0.0",
            "p[over__p + j] = 0.0",
        ]
        body = textwrap.indent("\n".join(["j = uint64(j)", *lines]), "    ")
        return f"{self.backend.decorator}def start_row(p, j, streams, row, numbers, given):\n{body}\n"

    def _look_row(self) -> str:
        seen = items("observation", len(self.observation))
        lines = [
            "j = uint64(j)",
            *self._known(),
            *([f"{self._fields('c', self.carried, 'p')} = carry({self._states('s', 'p')}k)"] * bool(self.carried)),
            f"{seen}, = observe({self._states('s', 'p')}{self._aims}k)" if seen else "pass",
        ]
        body = textwrap.indent("\n".join(lines), "    ")
        return f"{self.backend.decorator}def look_row(p, j, numbers, observation):\n{body}\n"

    def _held_numbers(self) -> str:
        """What `hold` takes: constants and stops of a row."""
        stops = [f"limits[{i}] = stop_{name}" for i, name in enumerate(self._joint_names)]
        lines = ["j = uint64(j)", *self._known(), *stops, "return k"]
        body = textwrap.indent("\n".join(lines), "    ")
        return f"{self.backend.decorator}def held_numbers(p, j, numbers, limits):\n{body}\n"

    def _driver(self) -> list[str]:
        """What `nhenv.rows` says, for this scene."""
        entry = self.backend.decorator.replace("@njit(", "@njit(nogil=True, cache=CACHE__, ")
        entries = (rows.step_rows, rows.begin_rows, rows.look_rows)
        parts = [self._held_numbers()] if self.events else [_NO_EVENTS.replace("@", self.backend.inline)]
        for function in rows.SOURCES:
            if self.events or function not in rows.EVENTFUL:
                backend = dataclasses.replace(self.backend, decorator=entry) if function in entries else self.backend
                parts += included([function], backend)
        return parts


_IMPORTS = "from numpy import array, empty, int64, nan, zeros\n"

# Without joints, and without a tolerance, free flight is all there is.
_NO_EVENTS = """@def screen_rows(p, w, count, numbers):
    return 0


@def gather_rows(p, w, count, event, start, spare, v, held, places, own):
    return held


@def from_event_to_event(
    blocks, streams, spare, v, count, late, places, numbers, observations, rewards, terminated, truncated, finals,
    judged, flags,
):
    return 0
"""


def _places(fields: dict[str, list[str]], array: str) -> dict[str, int]:
    """Number of each field: KIND_NAME__ARRAY, which no name of a user's can meet, to its place."""
    names = [
        f"{kind}_{name}__{array}" if name else f"{kind}__{array}" for kind, each in fields.items() for name in each
    ]
    return {name: i for i, name in enumerate(names)}


def _listed(items: Iterable[str]) -> str:
    return "".join(f"{item}, " for item in items)
