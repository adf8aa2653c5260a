"""What is observed of mechanisms that do not say what to observe."""

import dataclasses

import numpy as np
import pytest

import mechanics
from mechanics.mechanism import Mechanism
from nhenv.env import LocomotionEnv
from nhenv.observation import default_observation

# Written down by hand: what a user would expect of each.
EXPECTED = {
    # The rotor's angle makes no difference; wheels do not drift.
    "snakeboard": {
        "phi": "phi/1.2",
        "psi_dot": "psi_dot",
        "phi_dot": "phi_dot",
        "speed": "speed",
        "heading_dot": "heading_dot",
    },
    "roller_racer": {"psi": "psi/1.2", "psi_dot": "psi_dot", "speed": "speed", "heading_dot": "heading_dot"},
    # An arm that may turn right round.
    "sleigh_with_arm": {
        "cos_phi": "cos(phi)",
        "sin_phi": "sin(phi)",
        "phi_dot": "phi_dot",
        "speed": "speed",
        "heading_dot": "heading_dot",
    },
    # Angles of the links from the x axis: seen from the first link.
    "snake": {
        "cos_theta2": "cos(theta2 - theta)",
        "sin_theta2": "sin(theta2 - theta)",
        "cos_theta3": "cos(theta3 - theta)",
        "sin_theta3": "sin(theta3 - theta)",
        "theta2_dot": "theta2_dot",
        "theta3_dot": "theta3_dot",
        "speed": "speed",
        "heading_dot": "heading_dot",
    },
    # No constraint: it drifts.
    "planar_rigid_body": {"speed": "speed", "drift": "drift", "heading_dot": "heading_dot"},
    # Nothing but angles, and no plane.
    "suslov": {
        "cos_beta": "cos(beta)",
        "sin_beta": "sin(beta)",
        "cos_gamma": "cos(gamma)",
        "sin_gamma": "sin(gamma)",
        "alpha_dot": "alpha_dot",
        "beta_dot": "beta_dot",
        "gamma_dot": "gamma_dot",
    },
}

# A body on a knife edge that carries a mass on a spring along its axis.
SLIDER = {
    "name": "slider",
    "coordinates": ["px", "py", "th", "s"],
    "parameters": {"m": 1.0, "I": 0.1, "k": 2.0},
    "inertia": [["m", "0", "0", "0"], ["0", "m", "0", "0"], ["0", "0", "I + m*s**2", "0"], ["0", "0", "0", "m"]],
    "one_forms": [["-sin(th)", "cos(th)", "0", "0"]],
    "forces": {"f": ["0", "0", "0", "1"]},
    "potential": "k*s**2/2",
    "frame": [["cos(th)", "sin(th)", "0", "0"], ["0", "0", "1", "0"], ["0", "0", "0", "1"]],
    "fibre": ["px", "py", "th"],
}


@pytest.mark.parametrize("name", EXPECTED)
def test_default_observation(name):
    assert default_observation(mechanics.get(name)) == EXPECTED[name]


def test_a_length_is_observed_as_it_is():
    assert default_observation(Mechanism.from_dict(SLIDER)) == {
        "s": "s", "s_dot": "s_dot", "speed": "speed", "heading_dot": "heading_dot",
    }  # fmt: skip


def test_a_potential_makes_a_coordinate_matter():
    """Nothing else depends on the slider's place here; without the spring it would not be observed."""
    level = {**SLIDER, "inertia": [["m" if i == j else "0" for j in range(4)] for i in range(4)]}
    assert "s" in default_observation(Mechanism.from_dict(level))
    assert "s" not in default_observation(Mechanism.from_dict({**level, "potential": "0", "parameters": {"m": 1.0}}))


def test_without_a_fibre_every_coordinate_is_shape():
    bare = dataclasses.replace(mechanics.get("roller_racer"), fibre=(), observation={})
    assert default_observation(bare) == {
        # x and y make no difference
        "cos_theta": "cos(theta)", "sin_theta": "sin(theta)", "psi": "psi/1.2",
        "x_dot": "x_dot", "y_dot": "y_dot", "theta_dot": "theta_dot", "psi_dot": "psi_dot",
    }  # fmt: skip


@pytest.mark.parametrize(
    "name", ["snakeboard", "sleigh_with_arm", "planar_rigid_body", pytest.param("snake", marks=pytest.mark.slow)]
)
def test_the_default_is_what_an_environment_observes(name, actions):
    """Values of the labels, from env.q and env.qdot."""
    env = LocomotionEnv(dataclasses.replace(mechanics.get(name), observation={}), "Forward", backend="numpy")
    assert env.observation_labels == (*EXPECTED[name], "cos_heading", "sin_heading")
    env.reset(seed=0)
    for action in actions(env, 20):
        observation = env.step(action)[0]
        q = dict(zip(env.mechanism.coordinates, env.q, strict=True))
        rates = {f"{c}_dot": rate for c, rate in zip(env.mechanism.coordinates, env.qdot, strict=True)}
        cos, sin = np.cos(q["theta"]), np.sin(q["theta"])
        body = {
            "speed": cos * rates["x_dot"] + sin * rates["y_dot"],
            "drift": cos * rates["y_dot"] - sin * rates["x_dot"],
            "heading_dot": rates["theta_dot"],
        }
        scope = {**q, **rates, **body, "cos": np.cos, "sin": np.sin}
        expected = [eval(text, scope) for text in (*EXPECTED[name].values(), "cos(theta)", "sin(theta)")]
        # float32 rounds to 6e-8 of the value.
        assert observation == pytest.approx(expected, rel=2e-7, abs=1e-8)


def test_what_a_mechanism_declares_goes_before():
    mechanism = dataclasses.replace(mechanics.get("roller_racer"), observation={"angle": "psi"})
    env = LocomotionEnv(mechanism, "Goal", backend="numpy")
    assert env.observation_labels == ("angle", "goal_ahead", "goal_left", "goal_distance")
