"""Drag in the environments: the same as in `mechanics.simulate`, and no trace of it where it is not asked for."""

import dataclasses
import re

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scipy.integrate import simpson

import mechanics
import nhenv
from mechanics.mechanism import Mechanism, MechanismError
from nhenv import tasks
from nhenv.compiled import CompiledScene
from nhenv.env import LocomotionEnv
from nhenv.registration import as_mechanism
from nhenv.vector_env import LocomotionVectorEnv

COMPILED = ("snakeboard", "roller_racer")
DRAGGED = [name for name in mechanics.names(in_the_plane=True) if mechanics.get(name).rayleigh != "0"]
SOURCES = [("snakeboard", "Forward"), ("roller_racer", "Goal"), ("car", "Velocity"), ("trailer", "Forward")]


def _env(name, **arguments):
    """An environment with drag that follows the whole state, interpreted unless asked."""
    return LocomotionEnv(name, whole_state=True, **{"backend": "numpy", "drag": True, **arguments})


def _start(env, rng, speed=1.0):
    """Somewhere within the stops, moving."""
    q = rng.uniform(-0.5, 0.5, env.mechanism.n)
    v = rng.uniform(-speed, speed, env.mechanism.rank)
    model = mechanics.Model(env.mechanism, env.params, env._scene.frame)
    env.reset(seed=0, options={"q": q, "qdot": model.velocity(q, v)})


def _random_actions(env, rng):
    return rng.uniform(-1, 1, env.action_space.shape)


# -- against simulate ---------------------------------------------------------------------------


@pytest.mark.parametrize("drag", [True, "threefold"])
@pytest.mark.parametrize("name", DRAGGED)
def test_a_hold_is_that_of_simulate(name, drag):
    """From states that random torques reach, without stops, which `simulate` does not have."""
    if drag == "threefold":
        drag = {coefficient: 3 * value for coefficient, value in mechanics.get(name).drag.items()}
    # Some of the others fall over, slowly at first, and take shorter steps: here the equations are looked at.
    steps, how = (40, {"backend": "numba"}) if name in COMPILED else (5, {"substeps": 4})
    env, rng, moved = _env(name, drag=drag, joint_limits=False, **how), np.random.default_rng(1), 0.0
    _start(env, rng)
    for t in range(steps):
        q, v, action = env.q, env.v, _random_actions(env, rng)
        env.step(action)
        if t < 5 or t % 5 == 0:
            u = env.torque_limits * action
            motion = _simulated(env, q, v, u, drag=drag)
            # The project's bound for an error of one hold. `simulate` is held to 1e-14.
            assert env.q == pytest.approx(motion.q[-1], rel=0, abs=1e-10)
            assert env.v == pytest.approx(motion.v[-1], rel=0, abs=1e-10)
            assert env.energy == pytest.approx(motion.energy[-1], rel=0, abs=1e-9)
            moved = max(moved, np.abs(motion.v[-1] - _simulated(env, q, v, u).v[-1]).max())
    assert moved > 1e-4  # drag makes a difference


def _simulated(env, q, v, u, **drag):
    return mechanics.simulate(
        env.mechanism, [0, env.dt], q, v0=v, controls=lambda t: u, params=env.params, rtol=1e-12, atol=1e-14, **drag
    )


@pytest.mark.parametrize("name", COMPILED)
def test_what_a_scene_prunes_is_replayed_with_drag(name):
    """What nothing depends on, such as y, is not followed; when asked for they are those of the whole motion."""
    env, rng = LocomotionEnv(name, drag={"C": 0.7}, backend="numpy"), np.random.default_rng(2)
    env.reset(seed=0)
    q, v = env.q, env.v
    assert env._scene.kernel.PRUNED
    for _ in range(20):
        action = _random_actions(env, rng) / 4  # the stops are not reached
        u = env.torque_limits * action
        motion = _simulated(env, q, v, u, drag={"C": 0.7})
        q, v = motion.q[-1], motion.v[-1]
        env.step(action)
    assert np.abs(env.q - q).max() < 1e-10  # as for one hold: these motions amplify little in a second
    assert np.abs(env.qdot - motion.qdot[-1]).max() < 1e-10
    assert env.energy == pytest.approx(motion.energy[-1], abs=1e-10)


def test_a_rolling_disk_slows_down_exponentially():
    """I v' = u - c v for each of its two velocities, in closed form."""
    env = _env("vertical_rolling_disk", drag={"c_phi": 0.02})
    rolling, turning = (env.mechanism.coordinates.index(name) for name in ("phi", "theta"))
    assert env.drag == {"c_phi": 0.02, "c_theta": env.mechanism.drag["c_theta"]}
    env.reset(seed=0)
    inertia = _effective_inertia(env)
    steps = 30
    for _ in range(steps):
        env.step(np.array([0.5, -0.25]))
    time, u = steps * env.dt, env.torque_limits * [0.5, -0.25]  # controls: rolling, turning
    for place, torque, coefficient in ((rolling, u[0], "c_phi"), (turning, u[1], "c_theta")):
        c = env.drag[coefficient]
        assert env.qdot[place] == pytest.approx(torque / c * -np.expm1(-c * time / inertia[place]), rel=1e-13)


def _effective_inertia(env):
    """2 T for a unit rate of each coordinate that is free to turn, with what rolling makes of it."""
    model, q = mechanics.Model(env.mechanism, env.params), np.zeros(env.mechanism.n)
    found = {}
    for unit in np.eye(env.mechanism.rank):
        qdot = model.velocity(q, unit)
        for place, name in enumerate(env.mechanism.coordinates):
            if name in ("phi", "theta") and qdot[place]:
                found[place] = 2 * model.energy(q, unit) / qdot[place] ** 2
    return found


# -- energy -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", DRAGGED)
def test_energy_never_rises_unforced(name):
    env = _env(name)
    _start(env, np.random.default_rng(3))
    energies = [env.energy]
    for _ in range(25):
        env.step(np.zeros(env.action_space.shape))
        energies.append(env.energy)
    # It falls in every hold, impacts on stops included: at 1 m/s by far more than rounding.
    assert (np.diff(energies) < 0).all()
    assert energies[-1] < energies[0] - 1e-3


@pytest.mark.parametrize("name", DRAGGED)
def test_energy_changes_by_work_less_dissipation(name):
    """Both from the mechanism's own data: powers u <F, q̇> and q̇ᵀ R'' q̇, integrated by Simpson's rule."""
    env = _env(name, dt=0.002, joint_limits=False)
    mechanism, rng = env.mechanism, np.random.default_rng(4)
    _start(env, rng)
    action = _random_actions(env, rng)
    energies, driving, braking = [], [], []
    for step in range(41):
        if step:
            env.step(action)
        values = {**env.params, **env.drag, **dict(zip(mechanism.coordinates, env.q, strict=True))}
        forces = mechanism.numeric(mechanism.forces.values(), values)
        driving.append(env.torque_limits * action @ forces @ env.qdot)
        braking.append(env.qdot @ mechanism.drag_tensor(values) @ env.qdot)
        energies.append(env.energy)
    work, dissipated = (simpson(powers, dx=env.dt) for powers in (driving, braking))
    assert min(braking) > 0
    # Simpson's rule errs by dt^4/180 times the fourth derivative of the power over 0.08 s, less than 1e-9 here.
    assert energies[-1] - energies[0] == pytest.approx(work - dissipated, abs=1e-8)
    assert dissipated > 1e-5


@pytest.mark.parametrize("name", COMPILED)
def test_no_coefficient_no_drag(name):
    """All coefficients zero: the terms are there, and do nothing."""
    none = dict.fromkeys(mechanics.get(name).drag, 0.0)
    env, ideal, rng = _env(name, drag=none), _env(name, drag=None), np.random.default_rng(5)
    for other in (env, ideal):
        other.reset(seed=0)
    for _ in range(20):
        action = _random_actions(env, rng) / 4
        for other in (env, ideal):
            other.step(action)
    # Two integrators of the snakeboard, whose errors of a hold are below 1e-12 here.
    assert env.q == pytest.approx(ideal.q, rel=0, abs=1e-11)


# -- no trace -----------------------------------------------------------------------------------

# Its drag depends on the heading and on psi, and nothing else does: with it, they are no symmetries.
UNEVEN = {
    "name": "uneven",
    "coordinates": ["x", "y", "theta", "psi"],
    "parameters": {"m": 1.0, "I": 0.1, "J": 0.02},
    "inertia": [["m", "0", "0", "0"], ["0", "m", "0", "0"], ["0", "0", "I + J", "J"], ["0", "0", "J", "J"]],
    "one_forms": [["-sin(theta)", "cos(theta)", "0", "0"]],
    "forces": {"u_psi": list("0001"), "u_x": ["cos(theta)", "sin(theta)", "0", "0"]},
    "rayleigh": "wind*x_dot**2 + rough*(2 + sin(psi/2))*psi_dot**2",
    "drag": {"wind": 0.3, "rough": 0.01},
    "fibre": ["x", "y", "theta"],
}

MECHANISMS = {**{name: mechanics.get(name) for name, _ in SOURCES}, "uneven": Mechanism.from_dict(UNEVEN)}


@pytest.mark.parametrize(
    ("name", "task", "kind"),
    [
        *((name, task, "one") for name, task in [*SOURCES, ("uneven", "Forward")]),
        ("snakeboard", "Forward", "rows"),
        ("snakeboard", "Forward", "varied"),
    ],
)
def test_without_drag_the_source_is_that_of_a_mechanism_that_has_none(name, task, kind):
    mechanism, task = MECHANISMS[name], tasks.get(task)
    ideal = dataclasses.replace(mechanism, rayleigh="0", drag={})
    text = CompiledScene(mechanism, task).source(kind)
    assert text == CompiledScene(ideal, task).source(kind)
    assert not _words(text) & mechanism.drag.keys()
    with_drag = CompiledScene(mechanism, task, drag=True)
    assert mechanism.drag.keys() <= _words(with_drag.source(kind))
    assert set(with_drag.parameters) - set(CompiledScene(mechanism, task).parameters) == mechanism.drag.keys()


def _words(text):
    return set(re.findall(r"\w+", text))


def test_drag_may_decide_what_is_observed():
    """What nothing depends on is not observed; with this drag, friction depends on psi."""
    ideal, env = (LocomotionEnv(UNEVEN, backend="numpy", drag=drag) for drag in (False, True))
    assert ideal.observation_labels == ("psi_dot", "speed", "heading_dot", "cos_heading", "sin_heading")
    assert env.observation_labels == ("psi", *ideal.observation_labels)


@pytest.mark.parametrize("off", [None, False, np.False_])
def test_off_is_the_default(off, actions, rollout):
    env, default = (LocomotionEnv("snakeboard", backend="numpy", **given) for given in ({"drag": off}, {}))
    assert env.drag is default.drag is None
    assert env._scene == default._scene
    given = actions(env, 20)
    assert np.array_equal(rollout(env, given)[0], rollout(default, given)[0])


def test_default_integrators_with_drag():
    """Friction in the joints makes a core of what was exact in time."""
    text = CompiledScene(mechanics.get("snakeboard"), tasks.get("Forward"), drag=True).source()
    assert "States: core (v3), quadrature (phi), core (v1 v2), quadrature (theta), quadrature (x)." in text
    assert "Integrator: verner9" in text
    assert "Pruned: y psi." in text


# -- rows ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_rows_equal_single_environments_to_the_last_bit():
    """Compiled, more than a block, with stops and resets; interpreted variants are in test_vector_equality.py."""
    size, arguments = 131, {"drag": True, "max_episode_steps": 47}
    native = gym.make_vec("nhenv/SnakeboardForward-v0", size, autoreset_mode="SameStep", **arguments)
    sync = gym.make_vec(
        "nhenv/SnakeboardForward-v0", size, vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP}, **arguments,
    )  # fmt: skip
    assert np.array_equal(native.reset(seed=0)[0], sync.reset(seed=0)[0])
    rng, on_stop = np.random.default_rng(0), 0
    for t in range(100):
        actions = rng.uniform(-1, 1, native.action_space.shape) if t % 20 < 10 else np.ones(native.action_space.shape)
        for ours, theirs in zip(native.step(actions)[:4], sync.step(actions)[:4], strict=True):
            assert np.array_equal(ours, theirs)
        on_stop += int((np.abs(native.q[:, 4]) == 1.2).sum())
    assert on_stop > 1000


OWN = {"C": np.array([0.0, 0.6, 2.5]), "b_phi": 0.05}


def _row(drag, row):
    return {name: float(np.broadcast_to(value, 3)[row]) for name, value in drag.items()}


def _singles(backend, drag):
    return [
        lambda row=row: gym.make(
            "nhenv/SnakeboardForward-v0", drag=_row(drag, row), backend=backend, whole_state=True, max_episode_steps=17
        )
        for row in range(3)
    ]


BACKENDS = pytest.mark.parametrize("backend", ["numpy", pytest.param("numba", marks=pytest.mark.slow)])


@BACKENDS
def test_rows_may_have_drag_of_their_own(backend):
    native = LocomotionVectorEnv("snakeboard", num_envs=3, drag=OWN, backend=backend, whole_state=True,
                                 max_episode_steps=17)  # fmt: skip
    sync = SyncVectorEnv(_singles(backend, OWN))
    assert np.array_equal(native.reset(seed=0)[0], sync.reset(seed=0)[0])
    rng = np.random.default_rng(0)
    for _ in range(40):
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        for ours, theirs in zip(native.step(actions)[:4], sync.step(actions)[:4], strict=True):
            assert np.array_equal(ours, theirs)
    for name in ("q", "v", "qdot", "energy"):
        assert np.array_equal(getattr(native, name), [getattr(env.unwrapped, name) for env in sync.envs])
    assert native.drag["C"].tolist() == [0.0, 0.6, 2.5]
    assert (native.drag["b_psi"], native.drag["b_phi"]) == (native.mechanism.drag["b_psi"], 0.05)
    native.drag["C"][:] = 9.0  # a copy
    assert native.drag["C"].tolist() == [0.0, 0.6, 2.5]


@BACKENDS
def test_new_drag_in_the_middle_of_an_episode(backend):
    """As in domain randomisation: the rows of a mask go on with it, nothing is compiled, the others notice nothing."""
    native = LocomotionVectorEnv("snakeboard", num_envs=3, drag=OWN, backend=backend, whole_state=True)
    native.reset(seed=0)
    rng = np.random.default_rng(0)
    native.step(rng.uniform(-1, 1, (3, 2)))
    kernel, signatures = native._kernel, len(getattr(native._kernel.step_rows, "signatures", ()))
    native.set_params(drag={"b_phi": np.array([7.0, 0.1, 0.2])}, mask=np.array([False, True, True]))
    assert native.drag["b_phi"].tolist() == [0.05, 0.1, 0.2]
    singles = [make().unwrapped for make in _singles(backend, {**OWN, "b_phi": np.array([0.05, 0.1, 0.2])})]
    for env, q, qdot in zip(singles, native.q, native.qdot, strict=True):
        env.reset(options={"q": q, "qdot": qdot})
    for _ in range(10):
        actions = rng.uniform(-1, 1, (3, 2))
        native.step(actions)
        for env, action, v in zip(singles, actions, native.v, strict=True):
            env.step(action)
            # v is projected from q̇, which leaves rounding errors that ten steps amplify little.
            assert env.v == pytest.approx(v, rel=0, abs=1e-11)
    assert native._kernel is kernel
    assert len(getattr(kernel.step_rows, "signatures", ())) == signatures


def test_the_same_drag_in_each_row_is_that_of_all():
    own = LocomotionVectorEnv("roller_racer", num_envs=3, drag={"C": np.full(3, 0.5)}, backend="numpy")
    shared = LocomotionVectorEnv("roller_racer", num_envs=3, drag={"C": 0.5}, backend="numpy")
    assert np.array_equal(own.reset(seed=0)[0], shared.reset(seed=0)[0])
    rng = np.random.default_rng(0)
    for _ in range(10):
        actions = rng.uniform(-1, 1, (3, 1))
        for ours, theirs in zip(own.step(actions)[:4], shared.step(actions)[:4], strict=True):
            assert np.array_equal(ours, theirs)
    assert shared.drag == {"C": 0.5, "b_psi": shared.mechanism.drag["b_psi"]}
    assert LocomotionVectorEnv("roller_racer", num_envs=3, backend="numpy").drag is None


def test_stable_baselines_gets_drag_too():
    sb3 = pytest.importorskip("nhenv.sb3")
    envs = sb3.make_sb3_vec_env("nhenv/SnakeboardForward-v0", 3, seed=0, staggered=False, drag=OWN, backend="numpy")
    twin = LocomotionVectorEnv("snakeboard", num_envs=3, drag=OWN, backend="numpy", autoreset_mode="SameStep")
    assert np.array_equal(envs.reset(), twin.reset(seed=0)[0])
    actions = np.full((3, 2), 0.5, np.float32)
    for _ in range(5):
        assert np.array_equal(envs.step(actions)[0], twin.step(actions)[0])
    assert envs.get_attr("drag")[0]["C"].tolist() == OWN["C"].tolist()


# -- refusals -----------------------------------------------------------------------------------


def test_a_mechanism_without_drag_names_those_that_have_it():
    ideal = {key: value for key, value in UNEVEN.items() if key not in ("rayleigh", "drag")}
    for make in (LocomotionEnv, LocomotionVectorEnv):
        with pytest.raises(MechanismError, match="uneven has no drag") as error:
            make(ideal, drag=True)
        for word in ("rayleigh", *DRAGGED):
            assert word in str(error.value)


def test_every_mechanism_that_has_environments_has_drag():
    # Other tests may have registered mechanisms that users write down, which an id holds as data.
    specs = map(gym.spec, nhenv.environment_ids())
    assert {as_mechanism(spec.kwargs["mechanism"]).name for spec in specs} >= set(DRAGGED)
    assert DRAGGED == list(mechanics.names(in_the_plane=True))


def test_a_coefficient_may_not_be_called_by_a_word_of_tasks():
    """Only where it acts; without drag nobody meets it."""
    spec = {**UNEVEN, "rayleigh": "dt*x_dot**2", "drag": {"dt": 0.1}}
    with pytest.raises(ValueError, match="has its own 'dt'"):
        LocomotionEnv(spec, backend="numpy", drag=True)
    LocomotionEnv(spec, backend="numpy")
