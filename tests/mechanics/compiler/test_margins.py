"""Where a frame fails: found for each mechanism, whatever its size, and nowhere else."""

import math

import numpy as np
import pytest
import sympy as sp

import mechanics
from mechanics.compiler.margins import trust
from mechanics.geometry.reduction import derive
from mechanics.model import Model

TOLERANCE = 1e-10
POLE = math.acos(-1 / 3)  # of the racer's frame "paper" with its default parameters

# Frames that fail somewhere, and where; the others never do.
SINGULAR = {
    ("roller_racer", "regular"): {"l_2": 0.3, "psi": math.pi},
    ("roller_racer", "orthonormal"): {"l_2": 0.3, "psi": math.pi},
    ("roller_racer", "paper"): {"psi": POLE},
    ("roller_racer_massive", "regular"): {"l_2": 0.3, "psi": math.pi},
    ("falling_rolling_disk", "principal"): {"phi": math.pi / 2},
    ("suslov", "body"): {"beta": math.pi / 2},
    ("chaplygin_sphere", "euler"): {"phi": math.pi / 2},
}


def _share(name, frame, values):
    """Smallest share of the tolerance at some coordinates and parameters; 1 if the frame is good everywhere."""
    mechanism = mechanics.get(name)
    params = {key: value for key, value in values.items() if key in mechanism.parameters}
    q = [values.get(coordinate, 0.2) for coordinate in mechanism.coordinates]
    return Model(mechanism, params, frame).trust(q, TOLERANCE)


@pytest.mark.parametrize(("name", "frame"), [(n, f) for n in mechanics.names() for f in mechanics.get(n).frames])
def test_what_fails_somewhere_is_watched_and_nothing_else(name, frame):
    found = trust(derive(mechanics.get(name), frame), mechanics.get(name).frame_rows(frame), TOLERANCE)
    assert bool(found) == ((name, frame) in SINGULAR)


@pytest.mark.parametrize(("name", "frame"), SINGULAR)
def test_nothing_is_trusted_where_a_frame_fails_and_little_beside(name, frame):
    place = SINGULAR[name, frame]
    angle = [*place][-1]
    assert _share(name, frame, place) <= 0
    shares = [_share(name, frame, {**place, angle: place[angle] + gap}) for gap in (1e-6, 1e-4, 1e-2, 0.2)]
    # Margins grow in proportion to the distance from a simple zero; a racer's l_1/(l_1 + l_2) is at most 3/4.
    assert shares[0] <= 0  # a rounding of the angle is 1e-10 of a margin of 1e-5
    assert 0.4 * 1e-4 < shares[1] < 2.1 * 1e-4
    assert 0.4 * 1e-2 < shares[2] < 2.1 * 1e-2
    assert shares[3] > 0.2


def test_the_default_racer_is_trusted_everywhere():
    """Or its ordinary step would take shorter flights than need be."""
    angles = np.linspace(-np.pi, np.pi, 10_001)
    model = Model(mechanics.get("roller_racer"))
    # Its least margin, at ψ = π, is 1/2; roundings are 1e-5 of what remains.
    assert min(model.trust([0, 0, 0, angle], TOLERANCE) for angle in angles) > 1 - 3e-5


def test_neither_units_nor_inertia_matter():
    for frame in ("regular", "paper"):
        for gap in (1e-4, 1e-2):
            base = {"psi": POLE + gap, "l_1": 0.3, "l_2": 0.1, "m": 3.0, "I_1": 0.05, "I_2": 0.005}
            other = {**base, "l_1": 3e4, "l_2": 1e4, "m": 1e-4, "I_1": 1e7, "I_2": 1e-9}
            assert _share("roller_racer", frame, other) == pytest.approx(_share("roller_racer", frame, base), rel=1e-9)


def test_a_smaller_tolerance_trusts_less():
    """Roundings are a larger share of it."""
    model, q = Model(mechanics.get("roller_racer"), frame="paper"), [0, 0, 0, POLE + 1e-4]
    assert 0 < model.trust(q, 1e-10) < model.trust(q, 1e-8)
    assert model.trust(q, 1e-12) <= 0


def test_a_pole_behind_a_definition_is_found():
    """Of a mechanism of a user's, in a frame with a pole that its texts hide."""
    sleigh = mechanics.Mechanism.from_dict(
        {
            "name": "sleigh", "coordinates": ["x", "y", "theta", "psi"], "parameters": {"m": 1.0, "I": 0.1, "J": 0.02},
            "inertia": [["m", "0", "0", "0"], ["0", "m", "0", "0"], ["0", "0", "I + J", "J"], ["0", "0", "J", "J"]],
            "one_forms": [["-sin(theta)", "cos(theta)", "0", "0"]], "forces": {"u_psi": ["0", "0", "0", "1"]},
            "definitions": {"s": "sin(psi) + cos(psi)/2"},
            "frame": [["cos(theta)/s", "sin(theta)/s", "0", "0"], ["0", "0", "1", "-1"], ["0", "0", "0", "1"]],
        }
    )  # fmt: skip
    shares = trust(derive(sleigh), sleigh.frame_rows(None), TOLERANCE)
    pole, elsewhere = (
        min(
            float(share.xreplace({sp.Symbol("psi"): sp.Float(psi), sp.Symbol("theta"): sp.Float(0.4)}))
            for share in shares
        )
        for psi in (-math.atan(0.5), 1.5)
    )
    assert pole <= 0
    assert elsewhere > 0.5
