"""Helpers for the tests of the compiler: from rates to a function that can be called."""

import numpy as np
import pytest
import sympy as sp

import mechanics
from mechanics.compiler.backends import BACKENDS
from mechanics.compiler.codegen import Program, integrated
from mechanics.compiler.dataflow import analyse
from mechanics.compiler.integrators import method
from mechanics.geometry.reduction import reduce


@pytest.fixture(scope="session")
def execute():
    """Run generated source for a backend and return its namespace."""

    def run(source, backend="numpy"):
        namespace = {}
        exec(compile(f"{BACKENDS[backend].header}\n{source}", "<generated>", "exec"), namespace)
        return namespace

    return run


@pytest.fixture(scope="session")
def two_streams(execute):
    """Assert that two streams are one twice to the last bit, and so is a step that is given what is carried."""

    def check(equations, program, flow, tableau, **options):
        held, backend = equations.controls, BACKENDS["numba"]
        carried = program.carried(flow, tableau)
        assert carried
        source = [
            program.step_function("once", flow, tableau, 1, held, backend, **options),
            program.step_function("carrying", flow, tableau, 1, held, backend, carried, **options),
            program.step_function("twice", flow, tableau, 1, held, backend, carried, streams=2, **options),
            program.carry_function("carry", flow, carried, backend),
            program.constants_function("constants", [sp.Symbol(p) for p in equations.mechanism.parameters]),
        ]
        functions = execute("\n\n".join(source), backend.name)
        k = np.array(functions["constants"](list(equations.mechanism.parameters.values())), dtype=float)
        rng = np.random.default_rng(8)
        states = rng.uniform(-1, 1, (2, len(flow.states))).tolist()
        controls = rng.uniform(-1, 1, (2, len(held))).tolist()
        one, other = (functions["once"](0.05, *s, *u, k) for s, u in zip(states, controls, strict=True))
        assert one != other
        kept = [functions["carry"](*s, k) for s in states]
        assert functions["carrying"](0.05, *states[0], *kept[0], *controls[0], k) == one
        both = functions["twice"](0.05, *states[0], *kept[0], *controls[0], 0.05, *states[1], *kept[1], *controls[1], k)
        assert both == (*one, *other)

    return check


@pytest.fixture(scope="session")
def stepper(execute):
    """Generate one step of a method for a system: (flow, function (h, state, held) -> state).

    The state is a dictionary by symbol, of the states that the dataflow keeps.
    """

    def make(
        rates,
        outputs,
        name,
        *,
        substeps=1,
        held=(),
        parameters=None,
        backend="numpy",
        energy=None,
        speeds=(),
        **options,
    ):
        flow = analyse(rates, outputs)
        parameters = parameters or {}
        program = Program({**integrated(flow), **(energy or {})}, parameters)
        options |= {"speeds": speeds} if energy else {}
        source = program.step_function("step", flow, method(name), substeps, held, BACKENDS[backend], **options)
        source += "\n\n" + program.constants_function("constants", list(parameters))
        functions = execute(source, backend)
        k = np.array(functions["constants"](list(parameters.values())), dtype=float)

        def step(h, state, controls=()):
            *values, right = functions["step"](h, *(state[s] for s in flow.states), *controls, k)
            assert right
            return dict(zip(flow.states, values, strict=True))

        step.source = source
        return flow, step

    return make


@pytest.fixture(scope="session", params=["snakeboard", "roller_racer"])
def equations(request):
    """Reduced equations in the default frame: one in layers, one with a core."""
    return reduce(mechanics.get(request.param))


@pytest.fixture(scope="session")
def rates_of():
    """State -> rate of reduced equations, coordinates first."""

    def rates(equations):
        velocity = dict(zip(equations.coordinates, equations.velocity, strict=True))
        return {**velocity, **dict(zip(equations.pseudo_velocities, equations.acceleration, strict=True))}

    return rates


@pytest.fixture(scope="session")
def symbols():
    """Symbols by name."""
    return lambda names: sp.symbols(names, seq=True)
