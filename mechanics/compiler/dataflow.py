"""The dependency graph of the states: what a scene needs, and how each part may be integrated.

Nodes are states; an edge says "this rate uses that state". `analyse` keeps what the outputs
reach, and sorts it into layers, each of one kind:

exact       the rate is a polynomial in time while the controls are held: integrated in closed form
quadrature  the rate uses earlier states only: any nodes and weights integrate it explicitly
core        states that need one another (a strongly connected component): Runge-Kutta only
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from graphlib import TopologicalSorter
from typing import Literal

import numpy as np
import sympy as sp

__all__ = ["TAU", "Dataflow", "Layer", "analyse", "initial"]

TAU = sp.Symbol("_tau")  # time since the beginning of the step
# Above this degree a closed form costs more than a quadrature that is exact to rounding.
MAX_DEGREE = 4

Kind = Literal["exact", "quadrature", "core"]


def initial(state: sp.Symbol) -> sp.Symbol:
    """Symbol of the value that `state` has at the beginning of a step."""
    return sp.Symbol(f"{state.name}__0")


@dataclass(frozen=True)
class Layer:
    """States that are integrated together once the layers before are known."""

    kind: Kind
    states: tuple[sp.Symbol, ...]


@dataclass(frozen=True)
class Dataflow:
    """What is left of a system after pruning, in order of evaluation.

    Attributes:
        rates: state -> its rate, for the states kept.
        layers: the states kept, in an order in which each layer uses earlier ones only.
        solutions: exact state -> its value at time `TAU` into the step, in terms of `initial`
            values and of symbols that are constant over the step.
        pruned: the states that no output needs.
    """

    rates: Mapping[sp.Symbol, sp.Expr]
    layers: tuple[Layer, ...]
    solutions: Mapping[sp.Symbol, sp.Expr]
    pruned: tuple[sp.Symbol, ...]

    @property
    def states(self) -> tuple[sp.Symbol, ...]:
        """The states kept, in order of evaluation."""
        return tuple(state for layer in self.layers for state in layer.states)

    @property
    def core(self) -> tuple[sp.Symbol, ...]:
        """The states in strongly connected components; empty if layers are all there is."""
        return tuple(state for layer in self.layers if layer.kind == "core" for state in layer.states)


def analyse(
    rates: Mapping[sp.Symbol, sp.Expr],
    outputs: Iterable[sp.Expr],
    definitions: Iterable[tuple[sp.Symbol, sp.Expr]] = (),
) -> Dataflow:
    """Prune the states that `outputs` do not reach, and sort the others into layers.

    Args:
        rates: state -> rate as an expression in states and in symbols constant over a step.
        outputs: expressions that are wanted at the end of a step.
        definitions: pairs of a symbol that rates and outputs may use and what it stands for.
    """
    behind: dict[sp.Symbol, set[sp.Symbol]] = {state: {state} for state in rates}
    for symbol, expression in definitions:
        behind[symbol] = _states_in(expression, behind)
    uses = {state: _states_in(rate, behind) for state, rate in rates.items()}
    kept = _reach(uses, {state for output in outputs for state in _states_in(output, behind)})
    states = [state for state in rates if state in kept]
    layers: list[Layer] = []
    solutions: dict[sp.Symbol, sp.Expr] = {}
    for component in _components(states, uses):
        if len(component) > 1 or component[0] in uses[component[0]]:
            layers.append(Layer("core", component))
            continue
        (state,) = component
        solution = _polynomial(state, rates[state], uses[state], solutions)
        if solution is not None:
            solutions[state] = solution
        layers.append(Layer("quadrature" if solution is None else "exact", component))
    pruned = tuple(state for state in rates if state not in kept)
    return Dataflow({state: rates[state] for state in states}, tuple(layers), solutions, pruned)


def _states_in(expression: sp.Expr, behind: Mapping[sp.Symbol, set[sp.Symbol]]) -> set[sp.Symbol]:
    symbols = sp.sympify(expression).free_symbols
    return {state for symbol in symbols if symbol in behind for state in behind[symbol]}


def _reach(uses: Mapping[sp.Symbol, set[sp.Symbol]], wanted: set[sp.Symbol]) -> set[sp.Symbol]:
    reached: set[sp.Symbol] = set()
    while wanted:
        state = wanted.pop()
        if state not in reached:
            reached.add(state)
            wanted |= uses[state]
    return reached


def _components(states: Sequence[sp.Symbol], uses: Mapping[sp.Symbol, set[sp.Symbol]]) -> list[tuple[sp.Symbol, ...]]:
    """Strongly connected components in topological order, ties in the order of `states`."""
    from scipy.sparse.csgraph import connected_components

    if not states:
        return []
    adjacency = np.array([[other in uses[state] for other in states] for state in states])
    count, labels = connected_components(adjacency, connection="strong")
    members: list[list[sp.Symbol]] = [[] for _ in range(count)]
    for state, label in zip(states, labels, strict=True):
        members[label].append(state)
    label_of = dict(zip(states, map(int, labels), strict=True))
    sorter: TopologicalSorter[int] = TopologicalSorter()
    for state in states:
        earlier = {label_of[other] for other in uses[state]} - {label_of[state]}
        sorter.add(label_of[state], *sorted(earlier, key=lambda label: states.index(members[label][0])))
    return [tuple(members[label]) for label in sorter.static_order()]


def _polynomial(
    state: sp.Symbol, rate: sp.Expr, used: set[sp.Symbol], solutions: Mapping[sp.Symbol, sp.Expr]
) -> sp.Expr | None:
    """Value of `state` at `TAU` if its rate is a polynomial in time of low degree, else None."""
    if not used <= solutions.keys() & rate.free_symbols:  # a definition hides what it does with a state
        return None
    in_time = rate.xreplace({other: solutions[other] for other in used})
    if not in_time.is_polynomial(TAU):
        return None
    coefficients = sp.Poly(in_time, TAU).all_coeffs()[::-1]
    if len(coefficients) > MAX_DEGREE:
        return None
    powers = (coefficient / (power + 1) for power, coefficient in enumerate(coefficients))
    return initial(state) + sum((c * TAU ** (i + 1) for i, c in enumerate(powers)), sp.S.Zero)
