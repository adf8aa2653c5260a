"""What is conserved while controls are held, against the models' own energies and forces."""

import numpy as np
import pytest
import sympy as sp

import mechanics
from mechanics import Model
from mechanics.compiler.backends import BACKENDS
from mechanics.compiler.codegen import Program
from mechanics.geometry.energy import conserved
from mechanics.geometry.reduction import derive

# The snake's equations have definitions; the disk and the pendulum have potentials.
KEPT = (
    "snakeboard",
    "roller_racer",
    "snake",
    "falling_rolling_disk",
    "wheeled_inverted_pendulum",
    "vertical_rolling_disk",
)


@pytest.mark.parametrize("name", KEPT)
def test_kinetic_energy_and_potential_of_held_controls(name):
    """K + V is the model's energy; a control takes part in the potential with its covector, -u_a F_a q."""
    mechanism, equations = mechanics.get(name), derive(mechanics.get(name))
    parts = conserved(equations)
    symbols = (*equations.coordinates, *equations.pseudo_velocities, *equations.controls)
    program = Program(parts, equations.parameters, equations.definitions)
    source = [program.function("parts", symbols, list(parts), BACKENDS["numpy"])]
    source.append(program.constants_function("constants", equations.parameters))
    functions = {}
    exec("\n".join([BACKENDS["numpy"].header, *source]), functions)
    k = np.array(functions["constants"](list(mechanism.parameters.values())))
    model, rng = Model(mechanism), np.random.default_rng(0)
    at = {**mechanism.parameters, **dict.fromkeys(mechanism.coordinates, 0.3)}
    forces = mechanism.numeric(mechanism.forces.values(), at)
    for _ in range(5):
        q, v = rng.uniform(0.2, 1.0, mechanism.n), rng.normal(size=mechanism.rank)
        u = rng.normal(size=len(mechanism.forces))
        kinetic, potential = functions["parts"](*q, *v, *u, k)
        rest = float(model.energy(q, 0 * v))
        # Rounding of some tens of operations on numbers of order one to ten.
        assert kinetic == pytest.approx(float(model.energy(q, v)) - rest, rel=1e-12, abs=1e-13)
        assert potential == pytest.approx(rest - u @ forces @ q, rel=1e-12, abs=1e-13)


def test_a_control_whose_covector_changes_is_refused():
    with pytest.raises(ValueError, match=r"chaplygin_sleigh: .*constant covectors; that of 'F_long' depends on theta"):
        conserved(derive(mechanics.get("chaplygin_sleigh")))


def test_drag_is_refused():
    racer = mechanics.get("roller_racer")
    assert list(conserved(derive(racer))) == ["kinetic", "potential"]
    with pytest.raises(ValueError, match="roller_racer: with drag the energy is not conserved"):
        conserved(derive(racer, drag=True))


def test_without_controls_the_energy_itself_is_conserved():
    mechanism = mechanics.Mechanism.from_dict(
        {
            "name": "ball",
            "coordinates": ["a", "b"],
            "parameters": {"m": 2.0},
            "inertia": [["m", "0"], ["0", "m"]],
            "one_forms": [],
            "forces": {},
            "potential": "9*m*b",
        }
    )
    equations = derive(mechanism)
    parts = conserved(equations)
    assert sp.expand(sum(parts.values()) - equations.energy) == 0
    assert parts["potential"] == 9 * sp.Symbol("m") * sp.Symbol("b")
