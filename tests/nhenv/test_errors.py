"""What an environment refuses, and that it says what was given and what to do.

Each case lists words that the message must contain, in any order: what was given, what is known or expected.
"""

import inspect
import os
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import mechanics
import nhenv
from mechanics.mechanism import MechanismError
from nhenv.env import LocomotionEnv

SNAKEBOARD, RACER = "nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0"


def _message(error, *words):
    text = str(error.value)
    missing = [word for word in words if word not in text]
    assert not missing, f"{missing} not in {text!r}"


def _sleigh(**spec):
    return {**mechanics.get("chaplygin_sleigh").to_dict(), **spec}


# -- arguments ----------------------------------------------------------------------------------

ARGUMENTS = {
    "unknown parameter": (SNAKEBOARD, {"params": {"J_rr": 0.1}}, MechanismError, ["'J_rr'", "J_w", "mean 'J_r'"]),
    "impossible inertia": (SNAKEBOARD, {"params": {"J_r": 0.25}}, MechanismError, ["positive definite", "J_r=0.25"]),
    # m l^2 exactly: the tensor is singular.
    "singular inertia": (SNAKEBOARD, {"params": {"m": 4.0, "l": 0.5, "J_r": 1.0}}, MechanismError, ["definite", "m=4"]),
    "negative mass": (RACER, {"params": {"m": -1.0}}, MechanismError, ["positive definite", "m=-1"]),
    "no mass": (RACER, {"params": {"I_1": 0.0}}, MechanismError, ["positive definite", "I_1=0"]),
    "NaN parameter": (RACER, {"params": {"l_1": np.nan}}, MechanismError, ["l_1", "nan", "not finite"]),
    "infinite parameter": (SNAKEBOARD, {"params": {"m": np.inf}}, MechanismError, ["m", "inf", "not finite"]),
    "parameter no number": (RACER, {"params": {"l_1": "long"}}, MechanismError, ["l_1", "number", "'long'"]),
    "drag misspelt": (SNAKEBOARD, {"drag": {"b_phy": 0.1}}, MechanismError, ["'b_phy'", "C, b_psi", "mean 'b_phi'"]),
    "drag that drives": (RACER, {"drag": {"C": -0.1}}, MechanismError, ["drag coefficient C", "at least 0", "-0.1"]),
    "drag NaN": (RACER, {"drag": {"b_psi": np.nan}}, MechanismError, ["b_psi", "nan", "not finite"]),
    "drag infinite": (SNAKEBOARD, {"drag": {"C": np.inf}}, MechanismError, ["drag coefficient C", "inf", "not finite"]),
    "drag no number": (RACER, {"drag": {"C": "much"}}, MechanismError, ["drag coefficient C", "number", "'much'"]),
    "drag bare": (RACER, {"drag": 0.5}, MechanismError, ["drag", "True, False or coefficients", "0.5"]),
    "neither way": (RACER, {"params": {"l_2": 0.03}}, ValueError, ["l_1*I_2 - l_2*I_1 = 0", "change a parameter"]),
    "dt zero": (SNAKEBOARD, {"dt": 0}, ValueError, ["dt", "positive", "got 0"]),
    "dt negative": (SNAKEBOARD, {"dt": -0.05}, ValueError, ["dt", "positive", "-0.05"]),
    "dt NaN": (RACER, {"dt": np.nan}, ValueError, ["dt", "positive and finite", "nan"]),
    "dt no number": (RACER, {"dt": "slow"}, ValueError, ["dt", "number", "'slow'"]),
    "integrator misspelt": (SNAKEBOARD, {"integrator": "gaus4"}, ValueError, ["'gaus4'", "auto", "mean 'gauss4'"]),
    "integrator implicit": (RACER, {"integrator": "gauss4"}, ValueError, ["'gauss4'", "implicit", "psi", "'dop853'"]),
    "frame misspelt": (RACER, {"frame": "regulr"}, MechanismError, ["'regulr'", "paper", "mean 'regular'"]),
    "mechanism misspelt": (RACER, {"mechanism": "roler_racer"}, MechanismError, ["'roler_racer'", "known", "mean"]),
    "task misspelt": (SNAKEBOARD, {"task": "Foward"}, ValueError, ["'Foward'", "known", "mean 'Forward'"]),
    "weight misspelt": (RACER, {"ctrl_cost_wieght": 0.1}, TypeError, ["'ctrl_cost_wieght'", "mean 'ctrl_cost_weight'"]),
    "argument misspelt": (RACER, {"torque_limit": 1}, TypeError, ["'torque_limit'", "dt", "mean 'torque_limits'"]),
    "weight NaN": (RACER, {"ctrl_cost_weight": np.nan}, ValueError, ["ctrl_cost_weight", "finite", "nan"]),
    "backend misspelt": (RACER, {"backend": "nunba"}, ValueError, ["'nunba'", "numpy", "mean 'numba'"]),
    "substeps zero": (RACER, {"substeps": 0}, ValueError, ["substeps", "positive whole", "got 0"]),
    "substeps fraction": (RACER, {"substeps": 1.5}, ValueError, ["substeps", "whole", "1.5"]),
    "noise negative": (RACER, {"reset_noise_scale": -0.1}, ValueError, ["reset_noise_scale", "at least 0", "-0.1"]),
    "noise to the stop": (SNAKEBOARD, {"reset_noise_scale": 1.2}, ValueError, ["reset_noise_scale", "1.2", "below"]),
    "noise NaN": (RACER, {"reset_noise_scale": np.nan}, ValueError, ["reset_noise_scale", "nan"]),
    "torque limit unknown": (SNAKEBOARD, {"torque_limits": {"u_phy": 1}}, ValueError, ["'u_phy'", "mean 'u_phi'"]),
    "torque limit zero": (SNAKEBOARD, {"torque_limits": [1, 0]}, ValueError, ["torque limit of u_phi", "positive"]),
    "torque limit NaN": (RACER, {"torque_limits": np.nan}, ValueError, ["torque limit of u_psi", "finite", "nan"]),
    "torque limits shape": (RACER, {"torque_limits": [1, 2]}, ValueError, ["torque_limits", "u_psi", "[1, 2]"]),
    "joint limit unknown": (SNAKEBOARD, {"joint_limits": {"psi": 1}}, ValueError, ["'psi'", "known: phi"]),
    "joint limit negative": (SNAKEBOARD, {"joint_limits": {"phi": -1}}, ValueError, ["joint limit of phi", "positive"]),
    "dt too small": (RACER, {"dt": 5e-324}, ValueError, ["dt", "at least 1e-09 s", "5e-324"]),
    "tolerance zero": (RACER, {"tolerance": 0}, ValueError, ["tolerance", "positive", "got 0"]),
    "tolerance too small": (RACER, {"tolerance": 1e-20}, ValueError, ["tolerance", "at least 1e-13", "1e-20"]),
    "tolerance large": (RACER, {"tolerance": 2.0}, ValueError, ["tolerance", "below 1", "2.0"]),
    "no estimate": (
        SNAKEBOARD, {"tolerance": 1e-8, "integrator": "gauss2"}, ValueError, ["gauss2", "too few stages", "None"]
    ),
    "whole state": (RACER, {"whole_state": 1}, ValueError, ["whole_state", "True or False", "got 1"]),
    "kept energy": (RACER, {"keep_energy": 1}, ValueError, ["keep_energy", "True or False", "got 1"]),
    "kept energy, a force that turns": (
        "nhenv/CarForward-v0", {"keep_energy": True}, ValueError, ["'F_rear'", "theta", "keep_energy=False"],
    ),
    "picture of one number": (RACER, {"render_size": 640}, ValueError, ["render_size", "(width, height)", "640"]),
    "picture too small": (RACER, {"render_size": (640, 16)}, ValueError, ["render_size", "32 to 2048", "(640, 16)"]),
    "picture too large": (RACER, {"render_size": (640, 5000)}, ValueError, ["render_size", "32 to 2048", "5000"]),
    "picture of half a pixel": (RACER, {"render_size": (640, 40.5)}, ValueError, ["height", "whole", "40.5"]),
    "parameters bare": (RACER, {"params": [1.0]}, MechanismError, ["params", "map parameters to numbers", "[1.0]"]),
    "torque limits no numbers": (RACER, {"torque_limits": "a"}, ValueError, ["torque_limits", "u_psi", "'a'"]),
    "torque limits ragged": (SNAKEBOARD, {"torque_limits": [1, [2]]}, ValueError, ["torque_limits", "u_psi", "[2]"]),
    "dt beyond floats": (RACER, {"dt": 10**400}, ValueError, ["dt", "number", "1000"]),
    "a weight with a control's name": (
        SNAKEBOARD,
        {"task": {"name": "Own", "reward": {"r": "u_psi"}, "weights": {"u_psi": 5.0}, "max_episode_steps": 9}},
        ValueError,
        ["'u_psi'", "rename it"],
    ),
    "joint limit bare": (RACER, {"joint_limits": 1.0}, ValueError, ["joint_limits", "True, False", "1.0"]),
}  # fmt: skip


@pytest.mark.parametrize(("env_id", "arguments", "kind", "words"), ARGUMENTS.values(), ids=ARGUMENTS)
def test_impossible_arguments(env_id, arguments, kind, words):
    with pytest.raises(kind) as error:
        gym.make(env_id, **arguments)
    _message(error, *words)


def test_every_kind_of_argument_is_refused_somewhere():
    """A new argument of the environment needs a case above."""
    tried = {name for _, arguments, _, _ in ARGUMENTS.values() for name in arguments}
    named = inspect.signature(LocomotionEnv).parameters
    tried -= {"ctrl_cost_weight", "ctrl_cost_wieght", "torque_limit"}
    assert tried == set(named) - {"render_mode", "weights"}  # its case is in test_render.py


# -- reset --------------------------------------------------------------------------------------


@pytest.fixture(params=[SNAKEBOARD, RACER])
def env(request, bare):
    return bare(request.param)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"Q": [0]}, ["'Q'", "known: q, qdot"]),
        ({"q_dot": [0]}, ["'q_dot'", "mean 'qdot'"]),
        ({"q": [0.1]}, ["'q'", "(1,)", "x, y, theta"]),
        ({"q": 0.1}, ["'q'", "()", "x, y, theta"]),
        ({"qdot": np.zeros((2, 2))}, ["'qdot'", "(2, 2)", "x, y, theta"]),
    ],
    ids=["unknown option", "misspelt option", "short q", "scalar q", "matrix qdot"],
)
def test_impossible_reset_options(env, options, words):
    with pytest.raises(ValueError, match="reset option") as error:
        env.reset(options=options)
    _message(error, *words)


@pytest.mark.parametrize("key", ["q", "qdot"])
def test_reset_options_must_be_finite(env, key):
    with pytest.raises(ValueError, match="must be finite") as error:
        env.reset(options={key: np.full(env.mechanism.n, np.nan)})
    _message(error, repr(key), "nan")


def test_reset_names_both_shapes(env):
    with pytest.raises(ValueError, match="shape") as error:
        env.reset(options={"q": np.zeros(2)})
    _message(error, f"({env.mechanism.n},)", "(2,)")


def test_reset_beyond_a_stop(env):
    """Refused beyond the stop, accepted on it, and beyond it where there is none."""
    joint, limit = next(iter(env.mechanism.joint_limits.items()))
    q = np.zeros(env.mechanism.n)
    q[env.mechanism.coordinates.index(joint)] = -limit
    env.reset(options={"q": q})
    q[env.mechanism.coordinates.index(joint)] = -limit - 1e-9
    with pytest.raises(ValueError, match="beyond its stop") as error:
        env.reset(options={"q": q})
    _message(error, joint, str(limit), "joint_limits=False")


@pytest.mark.parametrize("speed", [0.5, 1e160])  # the square of the second is too large for a float
def test_reset_with_a_velocity_that_slips(env, speed):
    qdot = np.zeros(env.mechanism.n)
    qdot[1] = speed  # sideways, and every wheel points along x
    with pytest.raises(MechanismError, match="violates the rolling constraints") as error:
        env.reset(options={"q": np.zeros(env.mechanism.n), "qdot": qdot})
    _message(error, str(speed), "nearest feasible velocity")


@pytest.mark.parametrize("options", [3, "q", ["q"]])
@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
def test_reset_options_that_are_no_dictionary(make, options):
    env = make(SNAKEBOARD, backend="numpy")
    with pytest.raises(ValueError, match="reset options must be a dictionary, got"):
        env.unwrapped.reset(options=options)


def test_a_refused_reset_leaves_the_episode_as_it_was(env):
    env.reset(seed=0)
    before = env.q
    with pytest.raises(ValueError, match="reset option"):
        env.reset(options={"q": [0]})
    assert np.array_equal(env.q, before)


@pytest.mark.parametrize("options", [{"foo": 1}, {"q": [0]}, "slips"])
def test_a_refused_reset_draws_nothing(env, options):
    if options == "slips":
        options = {"q": np.zeros(env.mechanism.n), "qdot": np.eye(env.mechanism.n)[1]}
    env.reset(seed=0)
    state = env.np_random.bit_generator.state
    for seed in (None, 5):
        with pytest.raises(ValueError, match="reset option|violates"):
            env.reset(seed=seed, options=options)
        assert env.np_random.bit_generator.state == state
    assert env.np_random_seed == 0


# -- step ---------------------------------------------------------------------------------------


def test_step_before_reset(env):
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        env.step(np.zeros(env.action_space.shape, np.float32))


@pytest.mark.parametrize("name", ["q", "qdot", "v", "energy"])
def test_state_before_reset(env, name):
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        getattr(env, name)


def test_nan_action(env):
    """Refused whichever element it is, and the state stays as it was."""
    env.reset(seed=0)
    env.step(np.ones(env.action_space.shape, np.float32))
    before = env.q
    for i in range(env.action_space.shape[0]):
        action = np.zeros(env.action_space.shape, np.float32)
        action[i] = np.nan
        with pytest.raises(ValueError, match="not a number") as error:
            env.step(action)
        _message(error, "nan", "policy")
        assert np.array_equal(env.q, before)
    twin = LocomotionEnv(env.mechanism.name)
    twin.reset(seed=0)
    for other in (env, twin):
        other.step(np.ones(env.action_space.shape, np.float32))
    twin.step(np.ones(env.action_space.shape, np.float32))
    assert np.array_equal(env.q, twin.q)  # what was refused is not replayed either


@pytest.mark.parametrize("shape", [(), (0,), (3,), (1, 2), (2, 1)])
def test_action_of_another_shape(env, shape):
    env.reset(seed=0)
    for action in (np.zeros(shape, np.float32), np.zeros(shape).tolist()):
        with pytest.raises(ValueError, match="shape") as error:
            env.step(action)
        _message(error, str(env.action_space.shape), str(shape), *env.mechanism.controls)


def _equal_actions(m):
    """One action of m elements in the guises in which it may come."""
    plain = np.full(m, 0.5, np.float32)
    frozen = plain.copy()
    frozen.flags.writeable = False
    return {
        "float32": plain,
        "float64": plain.astype(float),
        "float16": plain.astype(np.float16),
        "list": plain.tolist(),
        "tuple": tuple(plain.tolist()),
        "list of scalars": list(plain),
        "non-contiguous": np.full(3 * m, 0.5, np.float32)[::3],
        "reversed": plain[::-1],
        "another byte order": plain.astype(">f4"),
        "read-only": frozen,
    }


@pytest.mark.parametrize("guise", _equal_actions(1))
def test_an_action_may_come_in_any_guise(env, guise):
    m = env.action_space.shape[0]
    results, states = [], []
    for name in ("float32", guise):
        env.reset(seed=0)
        results.append(env.step(_equal_actions(m)[name]))
        states.append(env.q)
    assert results[0][0].tobytes() == results[1][0].tobytes()
    assert results[0][1:] == results[1][1:]
    assert np.array_equal(*states)


def test_whole_numbers_are_an_action(env):
    m = env.action_space.shape[0]
    results = []
    for action in (np.ones(m, np.float32), np.ones(m, int), [1] * m, np.ones(m, bool)):
        env.reset(seed=0)
        results.append(env.step(action)[0].tobytes())
    assert len(set(results)) == 1


@pytest.mark.parametrize("stops", [True, False], ids=["stops", "free"])
def test_divergence_ends_the_episode_with_a_finite_observation(env, stops):
    """A step that overflows: terminated, flagged, and the last finite state stays."""
    stormy = LocomotionEnv(env.mechanism, torque_limits=1e308, joint_limits=stops, dt=1e3)
    calm, _ = stormy.reset(seed=0)
    one = np.ones(env.action_space.shape, np.float32)
    for _ in range(20):
        observation, reward, terminated, truncated, info = stormy.step(one)
        if terminated:
            break
        calm = observation
    assert terminated
    assert not truncated
    assert info["diverged"] is True
    assert np.array_equal(observation, calm)
    assert np.isfinite(observation).all()
    assert np.isfinite(reward)
    assert np.isfinite(stormy.q).all()


DIVERGE_LATE = """
import sys
import numpy as np
from nhenv.env import LocomotionEnv

env = LocomotionEnv(sys.argv[1], torque_limits=1e308, joint_limits=False, dt=1e3)
env.reset(seed=0)
nothing = np.zeros(env.action_space.shape, np.float32)
for _ in range(int(sys.argv[2])):
    env.step(nothing)
assert env.step(nothing + 1)[4]["diverged"]
for _ in range(20000):
    env.step(nothing)
assert np.isfinite(env.q).all()
print("survived")
"""


@pytest.mark.parametrize("steps", [510, 511, 512])
def test_stepping_on_after_divergence_is_safe_at_any_time(steps, kernel_cache):
    """Also where the kernel's memory of 512 actions has just filled up: a fault there would write beyond it.

    In a process of its own, because it would be killed.
    """
    command = [sys.executable, "-W", "error", "-c", DIVERGE_LATE, "snakeboard", str(steps)]
    root = Path(__file__).parents[2]
    result = subprocess.run(command, cwd=root, env=dict(os.environ), capture_output=True, text=True)
    assert (result.returncode, result.stdout) == (0, "survived\n"), result.stderr


def test_ids_of_this_file_are_registered():
    assert {SNAKEBOARD, RACER} <= set(nhenv.environment_ids())


def test_a_forward_that_is_no_number():
    with pytest.raises(ValueError, match="neither way") as error:
        gym.make("nhenv/ChaplyginSleighForward-v0", mechanism=_sleigh(forward="sqrt(m - 2)"))
    _message(error, "sqrt(m - 2) = nan", "change a parameter")


def test_a_control_with_a_name_that_tasks_use():
    with pytest.raises(ValueError, match="'dt'") as error:
        gym.make("nhenv/ChaplyginSleighForward-v0", mechanism=_sleigh(forces={"dt": ["0", "0", "1"]}, torque_limits={}))
    _message(error, "rename it")


def test_elapsed_steps_are_counts():
    envs = gym.make_vec(SNAKEBOARD, 2, backend="numpy").unwrapped
    envs.reset(seed=0)
    envs.elapsed_steps = [3, 4]
    for steps in (-5, np.nan, [1, -1], 2.5):
        with pytest.raises(ValueError, match="whole numbers that are not negative"):
            envs.elapsed_steps = steps
    assert envs.elapsed_steps.tolist() == [3, 4]
