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
