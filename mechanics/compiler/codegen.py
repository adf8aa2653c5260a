"""Expressions to source: straight-line functions and one-step integrators, for any backend.

A `Program` lowers a set of expressions once: subexpressions of parameters alone are hoisted into
constants, functions and divisions are named, common subexpressions shared. Functions printed
from it compute only what their outputs need. Names that begin with an underscore are the
generator's own, names with two in the middle are made from a user's: `mechanics.expressions.check_name`
lets users have neither.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from math import inf
from operator import methodcaller

import sympy as sp

from mechanics.compiler.backends import BACKENDS, Backend
from mechanics.compiler.dataflow import TAU, Dataflow, initial
from mechanics.compiler.integrators import Method

__all__ = ["Program", "integrated", "needed", "operation_count"]


# In rad, within a step: beyond this, errors may be aliased, and so escape the estimate.
LARGEST_TURN = 1.5

# Of the tolerance, a substep may use this however short it is: less could not be had where motions are very fast.
LEAST_PART = 1 / 64

# Kept energy moves no velocity by more than this, in errors that the tolerance allows. Where hardly any kinetic energy
# is left to be corrected, a correction would do more harm than good; elsewhere, a step that is right needs one at most.
LARGEST_CORRECTION = 10.0
# What a quotient of two energies that are both zero is kept from being undefined by; far below any other, in J.
NO_ENERGY = 1e-300

# d sin = cos * rate, d cos = -sin * rate
_QUARTER_TURN: dict[type, tuple[type, str]] = {sp.sin: (sp.cos, ""), sp.cos: (sp.sin, "-")}


class Program:
    """A set of named expressions, lowered together.

    Args:
        outputs: name -> expression.
        parameters: the symbols that are constant for the life of a kernel.
        definitions: pairs of a symbol that the outputs may use and what it stands for.
    """

    def __init__(
        self,
        outputs: Mapping[str, sp.Expr],
        parameters: Iterable[sp.Symbol],
        definitions: Sequence[tuple[sp.Symbol, sp.Expr]] = (),
    ) -> None:
        self._parameters = frozenset(parameters)
        self._hoisted: dict[sp.Expr, sp.Symbol] = {}
        self._definition: dict[sp.Symbol, sp.Expr] = {}
        self._named: dict[sp.Expr, sp.Symbol] = {}
        expressions = {name: sp.sympify(expression) for name, expression in outputs.items()}
        definitions_used = needed(expressions.values(), definitions)
        self._roots = {
            power.base
            for expression in (*expressions.values(), *definitions_used.values())
            for power in expression.atoms(sp.Pow)
            if power.exp.is_Rational and power.exp.q == 2
        }
        lowered = {name: self._lower(expression) for name, expression in expressions.items()}
        temporaries = {symbol: self._lower(expression) for symbol, expression in definitions_used.items()}
        temporaries |= {symbol: expression for expression, symbol in self._named.items()}
        # The definitions of named functions take part in the search for common subexpressions.
        shared, reduced = sp.cse(
            [*lowered.values(), *temporaries.values()], symbols=sp.numbered_symbols("_s"), order="none"
        )
        self.outputs: dict[str, sp.Expr] = dict(zip(lowered, reduced[: len(lowered)], strict=True))
        self.temporaries: dict[sp.Symbol, sp.Expr] = dict(shared)
        self.temporaries |= dict(zip(temporaries, reduced[len(lowered) :], strict=True))
        used = {symbol for expression in self._everything() for symbol in expression.free_symbols}
        order = [symbol for symbol in self._definition if symbol in used]
        renamed = {symbol: sp.Symbol(f"_k{i}") for i, symbol in enumerate(order)}
        self.constants: dict[sp.Symbol, sp.Expr] = {renamed[s]: self._definition[s] for s in order}
        self.outputs = {name: expression.xreplace(renamed) for name, expression in self.outputs.items()}
        self.temporaries = {s: expression.xreplace(renamed) for s, expression in self.temporaries.items()}

    def _everything(self) -> list[sp.Expr]:
        return [*self.outputs.values(), *self.temporaries.values()]

    # -- lowering ------------------------------------------------------------------------------

    def _lower(self, expression: sp.Expr) -> sp.Expr:
        """Rewrite bottom-up: constants hoisted, functions, roots and divisions named."""
        if expression.is_Number:
            return expression
        if expression.free_symbols <= self._parameters:
            return self._hoist(expression)
        if expression.is_Symbol:
            return expression
        if expression.is_Pow:
            return self._lower_power(expression.base, expression.exp)
        if expression.is_Add:
            return self._gather(expression, sp.Add)
        if expression.is_Mul:
            return self._gather(expression, sp.Mul)
        return self._name(expression.func(*map(self._lower, expression.args)))

    def _gather(self, expression: sp.Expr, kind: type[sp.Add] | type[sp.Mul]) -> sp.Expr:
        """Lower a sum or product with its parameter part collected into one constant."""
        fixed, moving = kind.identity, []
        for argument in expression.args:
            # A product inside a product, or a sum inside a sum, brings its own constant.
            for part in kind.make_args(self._lower(argument)):
                if part.is_Number or part in self._definition:
                    fixed = kind(fixed, self._definition.get(part, part))
                else:
                    moving.append(part)
        if kind is sp.Mul and not fixed.is_Number and fixed.could_extract_minus_sign():
            return kind(-1, self._hoist(-fixed), *moving)
        return kind(self._hoist(fixed), *moving)

    def _lower_power(self, base: sp.Expr, exponent: sp.Expr) -> sp.Expr:
        lowered = self._lower(base)
        if not exponent.is_Rational or exponent.q not in (1, 2):
            raise ValueError(f"cannot generate code for the power ({base})**({exponent})")
        if base in self._roots:
            # One square root serves every power of this base, its inverse included.
            root = self._name(sp.sqrt(lowered)) if lowered.free_symbols else sp.sqrt(lowered)
            if exponent < 0:
                return self._name(1 / root) ** int(-2 * exponent)
            whole, half = divmod(int(2 * exponent), 2)
            return lowered**whole * root**half
        if exponent < 0:
            return self._name(1 / lowered) ** int(-exponent)
        return lowered**exponent

    def _hoist(self, expression: sp.Expr) -> sp.Expr:
        if expression.is_Number:
            return expression
        if expression not in self._hoisted:
            symbol = sp.Symbol(f"_c{len(self._hoisted)}")
            self._hoisted[expression] = symbol
            self._definition[symbol] = expression
        return self._hoisted[expression]

    def _name(self, expression: sp.Expr) -> sp.Symbol:
        if expression not in self._named:
            self._named[expression] = sp.Symbol(f"_f{len(self._named)}")
        return self._named[expression]

    # -- printing ------------------------------------------------------------------------------

    def constants_function(self, name: str, parameters: Sequence[sp.Symbol]) -> str:
        """Source of `name(p)`: parameter values in the given order -> tuple of constants."""
        lines = [f"{p.name} = _p[{i}]" for i, p in enumerate(parameters)]
        write = BACKENDS["numpy"].write
        values = "".join(f"{write(expression)},\n" for expression in self.constants.values())
        return _function(name, ["_p"], [*lines, f"return (\n{_indent(values)})"], "")

    def function(self, name: str, arguments: Sequence[sp.Symbol], outputs: Sequence[str], backend: Backend) -> str:
        """Source of `name(*arguments, k)` that returns a tuple of the named outputs."""
        body = _Body(self, backend)
        point = _Point("", {symbol: symbol.name for symbol in arguments})
        values = [body.value(self.outputs[output], point) for output in outputs]
        lines = [*self._unpack(body), *body.text(), f"return ({''.join(f'{value}, ' for value in values)})"]
        return _function(name, [*(a.name for a in arguments), "_k"], lines, backend.decorator)

    def step_function(
        self,
        name: str,
        flow: Dataflow,
        method: Method,
        substeps: int,
        held: Sequence[sp.Symbol],
        backend: Backend,
        carried: Mapping[str, sp.Expr] | None = None,
        streams: int = 1,
        tolerance: float = inf,
        speeds: Sequence[sp.Symbol] = (),
        trust: Sequence[str] = (),
        pace: str = "",
    ) -> str:
        """Source of `name(_h, *states, *carried, *held, _k)` -> states after _h seconds, and whether they are right.

        They are if no substep, by the method's own estimate, makes a state z wrong by more than `tolerance` (1 + |z|),
        or turns an angle so far that the estimate might be deceived; always, and unchecked, if that is infinite.
        Of the tolerance, the square of the least of the outputs `trust` at a substep's first and last node may be used,
        all of it above 1, none if that is not positive. If there is an output `pace`, no more may be used than it says
        for a second, but for very short substeps: then errors of many add up to the tolerance.

        With several streams, of one that takes these arguments for one system after the other, and does every
        operation for one after the other: what one waits for, another uses the time of.

        Given `speeds`, every substep ends with these states multiplied by what keeps the sum of the outputs
        "energy:kinetic", quadratic in them, and "energy:potential" as it was: see `_energy_kept`.

        Outputs of this program must include "rate:STATE" for each state of `flow` that is not
        exact and "solution:STATE:POWER" for each coefficient of each that is: see `integrated`.
        What is `carried`, see there, is taken as given at the beginning of the step.
        """
        if flow.core and not method.explicit:
            core = ", ".join(symbol.name for symbol in flow.core)
            raise ValueError(
                f"integrator {method.name!r} would be implicit on ({core}), which need one another; "
                "choose an explicit one such as 'dop853' or 'rk4', or 'auto'"
            )
        body = _Body(self, backend)
        base = {symbol: symbol.name for symbol in (*flow.states, *held)}
        base |= {initial(state): state.name for state in flow.states}
        carried = carried or {}
        base |= {expression: given for given, expression in carried.items()}
        start, end = _Point("", {**base, TAU: "_h"}), {}
        errors: dict[tuple[sp.Symbol, int], str] = {}
        stages = [_Stage(self, body, flow, method, i, start) for i in range(method.stages)]
        for stage in stages:
            stage.others = stages
        integrated_states = [state for state in flow.states if state not in flow.solutions]
        estimated = integrated_states if tolerance < inf else []
        estimates = [weights for weights, _ in method.estimates] if estimated else []
        for state in flow.solutions:
            end[state] = body.polynomial(state, "_h", start)
        if method.explicit:
            end |= {state: state.name for state in integrated_states}
            for i, (stage, weight) in enumerate(zip(stages, method.b, strict=True)):
                for state in integrated_states:
                    rate = stage.rate(state)
                    if weight:  # summed up on the way, lest all rates be kept until the end
                        total = backend.sum_of_products([(repr(weight), rate)], end[state])
                        end[state] = body.assign(f"_e_{state.name}{stage.suffix}", total)
                    for which, weights in enumerate(estimates):
                        if weights[i]:
                            total = backend.sum_of_products([(repr(weights[i]), rate)], errors.get((state, which), ""))
                            errors[state, which] = body.assign(f"_d{which}_{state.name}{stage.suffix}", total)
        else:  # layer after layer
            for state in integrated_states:
                total = body.moved(state.name, method.b, stages, methodcaller("rate", state))
                end[state] = body.assign(f"_e_{state.name}", total)
            for which, weights in enumerate(estimates):
                for state in estimated:
                    errors[state, which] = body.moved("", weights, stages, methodcaller("rate", state))
        right = ["_right"] * (substeps > 1)
        if estimated:
            limits = list(map(repr, method.thresholds(tolerance)))
            shares = []
            if trust:
                shares.append(self._trusted(body, trust, (stages[0], stages[-1])))
            if pace:
                part = body.assign("_pace", f"_h*{body.value(self.outputs[pace], start)}")
                shares.append(body.assign("_part", f"{part} if {part} > {LEAST_PART!r} else {LEAST_PART!r}"))
            if shares:
                least = body.assign("_least", reduce(_smaller, shares))
                limits = [body.assign(f"_limit{i}", f"{limit}*{least}") for i, limit in enumerate(limits)]
            for (state, which), error in errors.items():
                bound = backend.sum_of_products([(limits[which], f"fabs({end[state]})")], limits[which])
                right.append(f"(fabs({error}) <= {bound})")
            right += [f"(fabs({end[a]} - {a.name}) <= {LARGEST_TURN!r})" for a in self._turning(flow)]
        if speeds:
            beginning = next((stage for stage in stages if stage.is_start), start)
            end = self._energy_kept(body, beginning, end, held, speeds, tolerance)
        names = [state.name for state in flow.states]
        arguments = ["_h", *names, *carried, *(symbol.name for symbol in held)]
        names = [*names, "_right"]
        lines, values = body.text(), [*(end[state] for state in flow.states), " & ".join(right) or "True"]
        if streams > 1:
            local = _renamer([*arguments, *names, *(line.partition(" = ")[0] for line in lines)])
            lines = [local(line, i) for line in lines for i in range(streams)]
            values = [local(value, i) for i in range(streams) for value in values]
            names, arguments = (
                [local(name, i) for i in range(streams) for name in group] for group in (names, arguments)
            )
        text = _indent("".join(f"{value},\n" for value in values))
        lines.append(f"{', '.join(names)}, = (\n{text})")
        if substeps > 1:
            loop = _indent("\n".join(lines))
            lines = ["_right = True", f"_h = _h*{1 / substeps!r}", f"for _ in range({substeps}):\n{loop}"]
        lines = [*self._unpack(body), *lines, f"return ({''.join(f'{n}, ' for n in names)})"]
        return _function(name, [*arguments, "_k"], lines, backend.decorator)

    def _trusted(self, body: _Body, trust: Sequence[str], nodes: Sequence[_Stage]) -> str:
        """Lines that find out how much of a tolerance may be used, and the name of that."""
        share = "1.0"
        for name in trust:
            for node in nodes:
                value = body.assign(f"_{name.replace(':', '')}{node.suffix}", body.value(self.outputs[name], node))
                share = body.assign(f"_share{value}", _smaller(value, share))
        return body.assign("_square", f"{share}*fabs({share})")

    def _energy_kept(
        self,
        body: _Body,
        start: _Point,
        end: Mapping[sp.Symbol, str],
        held: Sequence[sp.Symbol],
        speeds: Sequence[sp.Symbol],
        tolerance: float,
    ) -> dict[sp.Symbol, str]:
        """Lines that scale the speeds, and the names of all states after that.

        By s = sqrt(K_wanted/K_1), with K_wanted = K_0 + U_0 - U_1 the kinetic energy that the potential U leaves for
        the end. The method's error in the energy is of its order, hence so is s - 1. It is written without a
        difference of almost equal numbers, so that roundings are those of the energy and do not drift.
        """
        end = {state: body.assign(f"_m_{state.name}", value) for state, value in end.items()}
        finish = _Point("__end", {**end, **{symbol: symbol.name for symbol in held}})
        kinetic, potential = self.outputs["energy:kinetic"], self.outputs["energy:potential"]
        before = body.assign("_kinetic__start", body.value(kinetic, start))
        after = body.assign("_kinetic__end", body.value(kinetic, finish))
        wanted = before
        if potential != 0:
            fall = [body.assign(f"_potential{p.suffix}", body.value(potential, p)) for p in (start, finish)]
            wanted = body.assign("_left", f"{before} + ({' - '.join(fall)})")
            # A rounding may leave less than nothing.
            wanted = body.assign("_wanted", f"0.5*({wanted} + fabs({wanted}))")
        stretch = body.assign("_stretch", f"({wanted} - {after})/({after} + sqrt({wanted}*{after}) + {NO_ENERGY!r})")
        if tolerance < inf:
            limit = repr(LARGEST_CORRECTION * tolerance)
            bounds = {v: body.sum_of_products([(limit, f"fabs({end[v]})")], limit) for v in speeds}
            small = " & ".join(f"(fabs({stretch}*{end[v]}) <= {bound})" for v, bound in bounds.items())
            stretch = body.assign("_stretch__kept", f"{stretch}*({small})")
        for v in speeds:
            end[v] = body.assign(f"_kept_{v.name}", body.sum_of_products([(stretch, end[v])], end[v]))
        return end

    def _turning(self, flow: Dataflow) -> list[sp.Symbol]:
        """The states of which a rate takes a sine or cosine."""
        rates = [self.outputs[f"rate:{state.name}"] for state in flow.rates if state not in flow.solutions]
        used, wanted = set[sp.Symbol](), {symbol for rate in rates for symbol in rate.free_symbols}
        while wanted:
            used |= wanted
            meanings = [self.temporaries[symbol] for symbol in wanted & self.temporaries.keys()]
            wanted = {symbol for meaning in meanings for symbol in meaning.free_symbols} - used
        circles = [self.temporaries[symbol] for symbol in used & self.temporaries.keys()]
        angles = {symbol for f in circles if f.func in _QUARTER_TURN for symbol in f.args[0].free_symbols}
        return [state for state in flow.states if state in angles]

    def carried(self, flow: Dataflow, method: Method) -> dict[str, sp.Expr]:
        """What a step needs of the state that it begins with and no control takes part in: name -> expression.

        It follows from the state at the end of the step before, where the observation needs most of it too. Nothing
        for a method whose first stage is not the beginning of the step.
        """
        if not any(_is_start(method, i) for i in range(method.stages)):
            return {}
        turned: dict[str, sp.Expr] = {}
        found: dict[str, sp.Expr] = {}
        wanted = [self.outputs[f"rate:{state.name}"] for state in flow.rates if state not in flow.solutions]
        seen: set[sp.Symbol] = set()
        while wanted:
            for symbol in sorted(wanted.pop().free_symbols & self.temporaries.keys() - seen, key=lambda s: s.name):
                seen.add(symbol)
                expression = self.temporaries[symbol]
                if _turns(expression, flow, method):
                    angle = expression.args[0]
                    turned |= {f"_{f.__name__}_{angle.name}": f(angle) for f in (sp.sin, sp.cos)}
                elif self._rests_on_states(symbol, flow) and not self._with_turning(symbol, flow, method):
                    found[f"_at{symbol.name}"] = symbol
                else:
                    wanted.append(expression)
        # What is a product of others that are carried anyway is not worth its place.
        symbols = set(found.values())
        for name, symbol in list(found.items()):
            inner = self.temporaries[symbol].free_symbols & self.temporaries.keys()
            if inner and inner <= symbols - {symbol}:
                del found[name]
        return {**turned, **found}

    def carry_function(self, name: str, flow: Dataflow, carried: Mapping[str, sp.Expr], backend: Backend) -> str:
        """Source of `name(*states, _k)` -> what is `carried`."""
        body = _Body(self, backend)
        point = _Point("", {state: state.name for state in flow.states})
        values = [body.value(expression, point) for expression in carried.values()]
        lines = [*self._unpack(body), *body.text(), f"return ({''.join(f'{value}, ' for value in values)})"]
        return _function(name, [*(state.name for state in flow.states), "_k"], lines, backend.decorator)

    def _rests_on_states(self, symbol: sp.Symbol, flow: Dataflow) -> bool:
        """Whether states and constants are all that a temporary follows from."""
        for inner in self.temporaries[symbol].free_symbols:
            if inner in self.temporaries:
                if not self._rests_on_states(inner, flow):
                    return False
            elif inner not in flow.rates and inner not in self.constants:
                return False
        return True

    def _with_turning(self, symbol: sp.Symbol, flow: Dataflow, method: Method) -> bool:
        """Whether sines that are integrated take part in a temporary, which then costs little at the start."""
        expression = self.temporaries[symbol]
        inner = expression.free_symbols & self.temporaries.keys()
        return _turns(expression, flow, method) or any(self._with_turning(s, flow, method) for s in inner)

    def _unpack(self, body: _Body) -> list[str]:
        return [f"{symbol.name} = _k[{i}]" for i, symbol in enumerate(self.constants) if symbol in body.constants]


class _Point:
    """Where in time expressions are evaluated: names of the symbols there, and what was computed."""

    def __init__(self, suffix: str, names: dict[sp.Expr, str]) -> None:
        self.suffix = suffix
        self.names = names

    def resolve(self, symbol: sp.Symbol) -> str | None:
        return self.names.get(symbol)


class _Stage(_Point):
    """A node of a method: states there are computed when first asked for."""

    def __init__(
        self, program: Program, body: _Body, flow: Dataflow, method: Method, index: int, start: _Point
    ) -> None:
        at_start = _is_start(method, index)
        super().__init__("" if at_start else f"__{index + 1}", start.names if at_start else {})
        self._program, self._body, self._flow, self._start = program, body, flow, start
        self._method, self._index, self.is_start = method, index, at_start
        self._rates: dict[sp.Symbol, str] = {}
        self._circle_rates: dict[tuple[type, sp.Symbol], str] = {}
        self.others: list[_Stage] = []

    def resolve(self, symbol: sp.Symbol) -> str | None:
        if symbol in self.names:
            return self.names[symbol]
        if symbol == TAU:
            self.names[symbol] = self._body.assign(f"_h{self.suffix}", f"_h*{self._method.c[self._index]!r}")
        elif symbol in self._flow.solutions:
            time = self.resolve(TAU)
            assert time is not None
            value = self._body.polynomial(symbol, time, self._start)
            self.names[symbol] = self._body.assign(f"{symbol.name}{self.suffix}", value)
        elif symbol in self._flow.rates:
            row = self._method.a[self._index]
            value = self._body.moved(symbol.name, row, self.others, methodcaller("rate", symbol))
            self.names[symbol] = self._body.assign(f"{symbol.name}{self.suffix}", value)
        else:
            return self._start.resolve(symbol)
        return self.names[symbol]

    def carries(self, expression: sp.Expr) -> bool:
        """Whether this is a sine or cosine that is integrated along with its angle."""
        return _turns(expression, self._flow, self._method)

    def circle(self, function: type[sp.sin] | type[sp.cos], angle: sp.Symbol) -> str:
        """Sine or cosine of an angle, integrated along with it from the beginning of the step.

        Both are states with rates of their own, cos * rate and -sin * rate: a few products where
        the function itself costs ten times as much. The error is of the method's order.
        """
        key = function(angle)
        if key not in self.names:
            name = f"_{function.__name__}_{angle.name}{self.suffix}"
            if self.is_start:
                value = f"{function.__name__}({angle.name})"
            else:
                row = self._method.a[self._index]
                first = self.others[0].circle(function, angle)
                value = self._body.moved(first, row, self.others, methodcaller("circle_rate", function, angle))
            self.names[key] = self._body.assign(name, value)
        return self.names[key]

    def circle_rate(self, function: type[sp.sin] | type[sp.cos], angle: sp.Symbol) -> str:
        key = (function, angle)
        if key not in self._circle_rates:
            partner, sign = _QUARTER_TURN[function]
            value = f"{sign}{self.circle(partner, angle)}*{self.rate(angle)}"
            name = f"_r_{function.__name__}_{angle.name}__{self._index + 1}"
            self._circle_rates[key] = self._body.assign(name, value)
        return self._circle_rates[key]

    def rate(self, state: sp.Symbol) -> str:
        """Rate of a state times the length of the step."""
        if state not in self._rates:
            value = self._body.value(self._program.outputs[f"rate:{state.name}"], self)
            self._rates[state] = self._body.assign(f"_r_{state.name}__{self._index + 1}", f"_h*({value})")
        return self._rates[state]


class _Body:
    """Lines of a function under construction."""

    def __init__(self, program: Program, backend: Backend) -> None:
        self.constants: set[sp.Symbol] = set()
        self._lines: list[tuple[str, str]] = []  # name, value
        self._program, self._backend = program, backend
        self._moving: dict[sp.Symbol, bool] = {}

    def assign(self, name: str, value: str) -> str:
        self._lines.append((name, value))
        return name

    def text(self) -> list[str]:
        """The lines."""
        return [f"{name} = {value}" for name, value in self._lines]

    def value(self, expression: sp.Expr, point: _Point) -> str:
        """Source of `expression` at `point`, what it needs emitted before."""
        return self._backend.write(expression.xreplace(self._names(expression, point)))

    def moved(
        self, base: str, weights: Sequence[float], stages: Sequence[_Stage], rate: Callable[[_Stage], str]
    ) -> str:
        """Source of base + weighted sum of rates; those of weight zero are not even computed.

        The newest rate comes last, so that nothing but one addition waits for it.
        """
        products = [(repr(w), rate(stage)) for w, stage in zip(weights, stages, strict=True) if w]
        return self._backend.sum_of_products(products, base)

    def sum_of_products(self, products: Sequence[tuple[str, str]], rest: str) -> str:
        """Source of rest + sum of a*b, for factors that are names or numbers."""
        return self._backend.sum_of_products(products, rest)

    def polynomial(self, state: sp.Symbol, time: str, start: _Point) -> str:
        """Source of an exact state after `time`, by Horner's rule; its coefficients hold for the whole step."""
        value, power = "", 1
        while f"solution:{state.name}:{power}" in self._program.outputs:
            power += 1
        for i in range(power - 1, 0, -1):
            coefficient = self._program.outputs[f"solution:{state.name}:{i}"]
            if coefficient == 0 and not value:
                continue
            key = sp.Symbol(f"solution:{state.name}:{i}")
            if key not in start.names:
                start.names[key] = self.assign(f"_p{i}_{state.name}", self.value(coefficient, start))
            value = self._horner(time, value, start.names[key])
        return self._horner(time, value, state.name)

    def _horner(self, time: str, value: str, coefficient: str) -> str:
        if not value:
            return coefficient
        return self._backend.sum_of_products([(time, value if self._backend.fused else f"({value})")], coefficient)

    def _names(self, expression: sp.Expr, point: _Point) -> dict[sp.Symbol, sp.Symbol]:
        names = {}
        for symbol in sorted(expression.free_symbols, key=lambda s: s.name):
            names[symbol] = sp.Symbol(self._resolve(symbol, point))
        return names

    def _resolve(self, symbol: sp.Symbol, point: _Point) -> str:
        program = self._program
        if symbol in program.constants:
            self.constants.add(symbol)
            return symbol.name
        if symbol in program.temporaries:
            if not isinstance(point, _Stage) or self._moves(symbol, point):
                if symbol not in point.names:
                    expression = program.temporaries[symbol]
                    if isinstance(point, _Stage) and point.carries(expression):
                        point.names[symbol] = point.circle(expression.func, expression.args[0])
                    else:
                        value = self.value(expression, point)
                        point.names[symbol] = self.assign(f"{symbol.name}{point.suffix}", value)
                return point.names[symbol]
            return self._resolve(symbol, point._start)
        name = point.resolve(symbol)
        if name is None:
            raise KeyError(f"{symbol} is neither an argument nor computed")
        return name

    def _moves(self, symbol: sp.Symbol, stage: _Stage) -> bool:
        """Whether a temporary depends on the stage at which it is evaluated."""
        if symbol not in self._moving:
            self._moving[symbol] = any(
                inner == TAU
                or inner in stage._flow.rates
                or (inner in self._program.temporaries and self._moves(inner, stage))
                for inner in self._program.temporaries[symbol].free_symbols
            )
        return self._moving[symbol]


def _is_start(method: Method, stage: int) -> bool:
    """Whether a stage of a method is the beginning of the step."""
    return method.c[stage] == 0 and not any(method.a[stage])


def _turns(expression: sp.Expr, flow: Dataflow, method: Method) -> bool:
    """Whether this is the sine or cosine of an integrated angle, under an explicit method."""
    return (
        expression.func in _QUARTER_TURN
        and expression.args[0] in flow.rates
        and expression.args[0] not in flow.solutions
        and method.explicit
    )


def integrated(flow: Dataflow) -> dict[str, sp.Expr]:
    """The outputs that a program's `step_function` reads.

    "rate:STATE" for each state that is not exact; for each that is, "solution:STATE:POWER" for every power of the time
    since the beginning of the step but the zeroth, whose coefficient is the state there.
    """
    outputs = {f"rate:{s.name}": rate for s, rate in flow.rates.items() if s not in flow.solutions}
    for state, solution in flow.solutions.items():
        for i, coefficient in enumerate(sp.Poly(solution, TAU).all_coeffs()[::-1]):
            if i:
                outputs[f"solution:{state.name}:{i}"] = coefficient
    return outputs


def needed(
    expressions: Iterable[sp.Expr], definitions: Sequence[tuple[sp.Symbol, sp.Expr]]
) -> dict[sp.Symbol, sp.Expr]:
    """The definitions that some expressions use, directly or through others."""
    wanted = {symbol for expression in expressions for symbol in expression.free_symbols}
    used = {}
    for symbol, expression in reversed(definitions):
        if symbol in wanted:
            used[symbol] = expression
            wanted |= expression.free_symbols
    return dict(reversed(used.items()))


def operation_count(program: Program) -> int:
    """Additions, multiplications, divisions, roots and functions of all outputs together."""
    return int(sum(sp.count_ops(expression) for expression in program._everything()))


def _renamer(names: Iterable[str]) -> Callable[[str, int], str]:
    """Function that gives these names in a text another ending for each stream."""
    pattern = re.compile(r"\b(?:" + "|".join(map(re.escape, set(names))) + r")\b")
    return lambda text, stream: pattern.sub(lambda found: f"{found[0]}__stream{stream}", text)


def _function(name: str, arguments: Sequence[str], lines: Sequence[str], decorator: str) -> str:
    return f"{decorator}def {name}({', '.join(arguments)}):\n" + _indent("\n".join(lines)) + "\n"


def _smaller(a: str, b: str) -> str:
    """The smaller of two numbers: Numba's `min` is careful about what is not a number, and slow."""
    return f"{a} if {a} < {b} else {b}"


def _indent(text: str) -> str:
    return "".join(f"    {line}\n" if line.strip() else "\n" for line in text.splitlines())
