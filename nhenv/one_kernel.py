"""The kernel of one environment: what a step does to a flat memory, as source."""

from __future__ import annotations

import textwrap

from nhenv.generate import Generator, items, label
from nhenv.scene import BAD_ACTION, DIVERGED, HISTORY_FULL, LARGEST, RUNNING, TERMINATED

__all__ = ["OneKernel"]

# Holds remembered when a state is pruned, so that `env.q` can still be worked out when asked for.
HISTORY = 512


class OneKernel(Generator):
    """Source of `respond`, `begin` and `look` over one environment's memory."""

    def module(self) -> str:
        """Text of the generated module."""
        self.memory = self._memory()
        parts = [
            f'"""{self.title("one environment")}"""\n\n{self.backend.header}from numpy import array, int64\n',
            self._tables(),
            self.constants(),
            *self.functions(self.backend.inlined(), self.substeps),
            *(self.stop_functions(self.backend) if self.events else []),
            self._begin(),
            self._respond(),
        ]
        return "\n\n".join(parts)

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

    def _tables(self) -> str:
        """Names and places, so that a loaded kernel needs nothing symbolic."""
        return self.tables(MEMORY=self.memory, SIZE=max(end for _, end in self.memory.values()))

    def _begin(self) -> str:
        """`begin`: what an episode begins with, from uniform numbers; `look`: what is observed of a memory."""
        place, givable = self._places(), len(self.scene.givable)
        given = [items("given", givable)] * bool(givable)
        drawn = [items("drawn", self.scene.draws)] * bool(self.scene.draws)
        values = ", ".join((*drawn, "noise", *given, "k"))
        seen = [items("memory", len(self.flow.states), place["state"])]
        if self.targets:
            seen.append(items("memory", len(self.targets), place["target"]))
        observation = items("observation", len(self.observation))
        first, last = self.memory["k"]
        look = f"{observation}, = observe({', '.join(seen)}, memory[{first}:{last}])" if observation else "pass"
        return (
            f"{self._entry('float64[::1], float64, float64[::1], float64[::1]')}"
            f"def begin(drawn, noise, given, k):\n    return start({values})\n\n\n"
            f"{self._entry('float64[::1], float32[::1]')}"
            f"def look(memory, observation):\n    {look}\n"
        )

    def _entry(self, types: str) -> str:
        """Decorator of a function that Python calls: compiled for these types when the module is loaded, and cached."""
        return self.backend.decorator.replace("@njit(", f'@njit("({types})", cache=CACHE__, ')

    def _wrapped(self) -> str:
        """Import and decorator that make `respond`, which `env.step` calls, of the kernel."""
        sizes = f"actions={len(self.actions)}, info={tuple(map(label, self.judgement))!r}"
        if not self.backend.decorator:
            return f"from nhenv.response import plain\n\n\n@plain({sizes})\n"
        sizes = f"memory=SIZE, observations={len(self.observation)}, {sizes}"
        decorator = self.backend.decorator.replace("@njit(", f"@compiled({sizes}, cache=CACHE__, ")
        return f"from nhenv.entry import compiled\n\n\n{decorator}"

    def _respond(self) -> str:
        """The kernel, (memory, action) -> (status, reward, *info, *observation): clip, hold, check, judge."""
        # Names of the user's get two underscores in the middle: they cannot meet those of the kernel.
        states = [state.name for state in self.flow.states]
        old, new = (f"{', '.join(f'{name}__{when}' for name in states)}, " for when in ("old", "new"))
        controls = [f"{control.name}__u" for control in self.equations.controls]
        place = self._places()
        state = items("memory", len(states), place["state"])
        nothing = "0.0, " * (1 + len(self.judgement) + len(self.observation))
        lines = [f"{', '.join(action.name for action in self.actions)}, = action"]
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
                f"{action} = clip({action}, -1.0, 1.0)",
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
        flight = f"{new}right = advance_states(dt, {old}{held}k)"
        lines += self._from_event_to_event(old, new, controls, flight) if self.events else [flight]
        lines += [
            f"status = {RUNNING}",
            f"if not ({' and '.join(f'fabs({name}__new) < {LARGEST}' for name in states) or 'True'}):",
            f"    {new}= {old}",
            f"    status = {DIVERGED}",
            f"{state}, = {new}",
        ]
        aim = "".join(f"memory[{place['target'] + i}], " for i in range(len(self.targets)))
        if self.observation:
            lines.append(f"seen = observe({new}{aim}k)")
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
        outcome = [f"judged[{i}]" for i in range(len(self.judgement))]
        outcome += [f"seen[{i}]" for i in range(len(self.observation))]
        lines.append(f"return ({', '.join(('status', reward, *outcome))})")
        text = textwrap.indent("\n".join(lines), "    ")
        return f"{self._wrapped()}def respond(memory, action):\n{text}\n"

    def _from_event_to_event(self, old: str, new: str, controls: list[str], flight: str) -> list[str]:
        """Accept free flight if it is right and no joint can have met its stop, else go from event to event."""
        place = self._places()
        away = [f"fabs({a.name}__old) < memory[{place['stop'] + j}]" for j, (a, _) in enumerate(self.joints)]
        stops = items("memory", len(self.joints), place["stop"])
        parts = ("state", "control", "k", "stop", "free", "work", "hits", "new")
        arrays = ", ".join(f"memory[{start}:{end}]" for start, end in (self.memory[part] for part in parts))
        n = len(self.flow.states)
        clear = f" and clear_joints(dt, {old}{new}{'1.0, ' * len(self.joints)}{stops}, k)" if self.joints else ""
        return [
            f"accepted = {' and '.join(away) or 'True'}",
            f"{new}= {old}",
            "if accepted:",
            f"    {flight}",
            f"    accepted = right{clear}",
            "if not accepted:",
            f"    {items('memory', len(controls), place['control'])}, = {', '.join(controls)},",
            f"    held = hold(dt, {arrays})",
            f"    {new}= {items('memory', n, place['state'])},",
            "    if not held:",
            f"        {new}= {'nan, ' * n}",
        ]
