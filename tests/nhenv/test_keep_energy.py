"""The option keep_energy: energy over long unforced runs, against the torques' work, and through stops."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from mechanics.model import Model
from nhenv.configuration import Configuration
from nhenv.vector_env import LocomotionVectorEnv

SNAKEBOARD, RACER = "nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0"
EPSILON = np.finfo(float).eps
FREE = {"joint_limits": False, "whole_state": True}


def _unforced(mechanism, **arguments):
    """Environments of many initial velocities, max |q̇| from 0.1 to 5 rad/s or m/s, and the actions that do nothing."""
    rows, rng = 16, np.random.default_rng(0)
    env = LocomotionVectorEnv(mechanism, "Forward", rows, **FREE, **arguments)
    model, q = Model(env.mechanism), np.zeros((rows, env.mechanism.n))
    q[:, -1] = rng.uniform(-1.2, 1.2, rows)
    qdot = model.velocity(q, rng.normal(size=(rows, env.mechanism.rank)))
    qdot *= np.geomspace(0.1, 5, rows)[:, None] / np.abs(qdot).max(axis=1, keepdims=True)
    env.reset(options={"q": q, "qdot": qdot})
    return env, np.zeros((rows, len(env.mechanism.controls)), np.float32)


def _drift(mechanism, steps, **arguments):
    """Largest relative change of energy over the run, and largest violation of the constraints."""
    env, nothing = _unforced(mechanism, **arguments)
    model, energy, drift, slip = Model(env.mechanism), env.energy, 0.0, 0.0
    angles = [i for i, name in enumerate(env.mechanism.coordinates) if name not in env.mechanism.fibre[:2]]
    for i in range(steps):
        terminated = env.step(nothing)[2]
        if i % 100 == 99:
            assert not terminated.any()
            drift = max(drift, np.abs(env.energy / energy - 1).max())
            # An angle of 1e5 rad is itself rounded to 1e-11; where the wheels point, it matters up to a turn only.
            q = env.q
            q[:, angles] = np.remainder(q[:, angles], 2 * np.pi)
            slip = max(slip, np.abs(model.constraint_residual(q, model.velocity(q, env.v))).max())
    return drift, slip


@pytest.mark.slow
def test_unforced_energy_over_ten_thousand_steps():
    """It walks at random: 20,000 roundings."""
    kept, slip = _drift("roller_racer", 10_000, keep_energy=True)
    assert kept < 1e-12
    assert slip < 1e-12


@pytest.mark.slow
def test_unforced_energy_over_a_million_steps():
    """Fourteen hours of motion. The default's drift is that of the first fast turns, at up to 5 rad/s."""
    kept, slip = _drift("roller_racer", 1_000_000, keep_energy=True)
    assert kept < 1e-12
    assert slip < 1e-12
    default, _ = _drift("roller_racer", 1_000_000)
    assert 100 * kept < default < 1e-9


@pytest.mark.parametrize(
    ("steps", "backend"), [(100, "numpy"), pytest.param(1_000_000, "numba", marks=pytest.mark.slow)]
)
def test_the_snakeboards_energy_and_momenta_by_default(steps, backend):
    """Constants of the free motion; in the flat frame they are what is integrated, and nothing changes them."""
    env, nothing = _unforced("snakeboard", backend=backend)
    p, energy, first = env._configuration.params, env.energy, None
    for i in range(steps):
        env.step(nothing)
        if i % 100 == 99 or i < 100:
            assert np.abs(env.energy / energy - 1).max() < 1e-12
            (_, _, theta, _, phi), (x_dot, y_dot, theta_dot, psi_dot, _) = env.q.T, env.qdot.T
            # From the velocities themselves: the rotor's momentum, and that along the wheels' curve (PHYSICS: c1, c2).
            cos = np.where(np.abs(np.cos(phi)) > 0.2, np.cos(phi), np.nan)
            root = np.sqrt(p["m"] * p["l"] ** 2 - p["J_r"] * np.sin(phi) ** 2)
            speed = x_dot * np.cos(theta) + y_dot * np.sin(theta)
            momenta = np.array([p["J_r"] * (psi_dot + theta_dot), speed * root / (p["l"] * cos)])
            first = momenta if first is None else np.where(np.isnan(first), momenta, first)
            assert np.nanmax(np.abs(momenta / first - 1)) < 1e-12


@pytest.mark.parametrize("env_id", [SNAKEBOARD, RACER])
def test_energy_changes_by_the_work_of_the_torques(env_id, bare, actions):
    """In each step, to rounding; without the option, the racer's is not so good."""
    errors = {}
    for keep in (True, False):
        # Not the default, so that there is something to correct.
        integrator = "dop853" if env_id == RACER else "lobatto4"
        env = bare(env_id, keep_energy=keep, integrator=integrator, backend="numpy", **FREE)
        at = {**env.params, **dict.fromkeys(env.mechanism.coordinates, 0.0)}
        forces = env.mechanism.numeric(env.mechanism.forces.values(), at)
        env.reset(seed=1)
        q, energy, errors[keep] = env.q, env.energy, 0.0
        for action in actions(env, 300):
            env.step(action)
            torques = forces.T @ (action.astype(float) * env.torque_limits)
            error = env.energy - energy - torques @ (env.q - q)
            errors[keep] = max(errors[keep], abs(error) / (env.energy + energy + np.abs(torques * q).sum()))
            q, energy = env.q, env.energy
    assert errors[True] < 20 * EPSILON  # roundings of two substeps, and of this test
    assert errors[False] > 100 * errors[True]


@pytest.mark.parametrize("env_id", [SNAKEBOARD, RACER])
def test_stops_take_energy_and_give_none(env_id, bare):
    """Unforced and against the stops again and again, energy falls at impacts and stays otherwise."""
    env = bare(env_id, keep_energy=True, whole_state=True, backend="numpy")
    joint, nothing = env.mechanism.coordinates.index(*env.joint_limits), np.zeros(env.action_space.shape)
    falls = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        q = np.zeros(env.mechanism.n)
        q[joint] = rng.uniform(-1, 1)
        env.reset(seed=seed, options={"q": q, "qdot": env._model.velocity(q, rng.uniform(-3, 3, env.mechanism.rank))})
        energy = env.energy
        for _ in range(60):
            env.step(nothing)
            assert env.energy <= energy * (1 + 20 * EPSILON)
            falls += env.energy < energy * (1 - 1e-6)
            energy = env.energy
    assert falls >= 5


@pytest.mark.parametrize(
    ("env_id", "arguments"),
    [
        pytest.param(RACER, {"torque_limits": {"u_psi": 2.0}}, marks=pytest.mark.slow),
        (SNAKEBOARD, {}),
        pytest.param(RACER, {"joint_limits": False}, marks=pytest.mark.slow),
    ],
    ids=["racer", "snakeboard", "no stops"],
)
def test_rows_equal_single_environments(env_id, arguments):
    """To the last bit: more than a block of rows, through stops and, if they are fast, in shorter flights."""
    size, arguments = 131, {"keep_energy": True, **arguments}
    native = gym.make_vec(env_id, num_envs=size, autoreset_mode="SameStep", max_episode_steps=37, **arguments)
    sync = gym.make_vec(
        env_id,
        num_envs=size,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        max_episode_steps=37,
        **arguments,
    )
    assert isinstance(sync, SyncVectorEnv)
    rng = np.random.default_rng(0)
    for env in (native, sync):
        env.reset(seed=0)
    for t in range(80):
        actions = np.sign(rng.uniform(-1, 1, native.action_space.shape)).astype(np.float32) * (t % 16 < 12)
        ours, theirs = native.step(actions), sync.step(actions)
        for one, other in zip(ours[:4], theirs[:4], strict=True):
            assert np.array_equal(one, other), t


@pytest.mark.parametrize("kind", ["one", "rows", "varied"])
@pytest.mark.parametrize("mechanism", ["snakeboard", "roller_racer"])
def test_no_trace_of_it_in_the_source_without_it(mechanism, kind):
    words = ("_kinetic", "_potential", "_stretch", "_kept", "_m_v1")
    source = Configuration(mechanism, "Goal").scene.source(kind)
    assert not [word for word in words if word in source]
    kept = Configuration(mechanism, "Goal", keep_energy=True).scene.source(kind)
    assert [word for word in words if word in kept] == list(words)


def test_what_the_energy_depends_on_is_followed():
    """The rotor's angle, which no task needs, says what work its torque does."""
    plain, kept = (
        Configuration("snakeboard", "Velocity", keep_energy=keep, backend="numpy").scene.kernel
        for keep in (False, True)
    )
    assert "psi" in plain.PRUNED
    assert "psi" in kept.STATES
    assert set(plain.STATES) < set(kept.STATES)


def test_what_is_not_followed_is_worked_out_alike(bare, actions):
    """`q` of an environment that prunes the pose is that of one that follows it."""
    q = []
    for whole in (False, True):
        env = bare(
            "nhenv/RollerRacerVelocity-v0", keep_energy=True, whole_state=whole, integrator="rk4", backend="numpy"
        )
        env.reset(seed=2)
        for action in actions(env, 30):
            env.step(action)
        q.append(env.q)
    np.testing.assert_allclose(*q, rtol=0, atol=1e-13)  # the same formulas, perhaps shared otherwise
