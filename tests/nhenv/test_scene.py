"""What the generator makes of a mechanism and a task: what is left out, and that names do not matter."""

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import mechanics
import nhenv
from mechanics.compiler import backends
from mechanics.mechanism import Mechanism
from nhenv import tasks
from nhenv.compiled import CompiledScene
from nhenv.env import LocomotionEnv
from nhenv.scene import BACKENDS

NAMES = ("snakeboard", "roller_racer")
OTHERS = [name for name in mechanics.names(in_the_plane=True) if name not in NAMES]


@pytest.fixture(scope="session")
def source():
    """Generated source of a mechanism's Forward scene, derived once."""
    known = {}

    def text(name, **options):
        key = name, *sorted(options.items())
        if key not in known:
            known[key] = CompiledScene(mechanics.get(name), tasks.get("Forward"), **options).source()
        return known[key]

    return text


@pytest.mark.parametrize(("name", "pruned"), [("snakeboard", ["y", "psi"]), ("roller_racer", ["y"])])
@pytest.mark.parametrize("stops", [True, False], ids=["stops", "free"])
def test_forward_never_integrates_what_it_does_not_use(name, pruned, stops, source):
    """Nor does anything of it occur in the source: no name, no stage value, no rate."""
    text = source(name, stops=stops)
    assert f"Pruned: {' '.join(pruned)}." in text
    code = text.partition("OBSERVATION =")[2].replace("__", " ")
    words = set(re.findall(r"[A-Za-z0-9]+(?:_[A-Za-z0-9]+)*", code))
    assert words.isdisjoint(pruned)
    assert {"x", "theta", "v1", "v2"} <= words


def test_a_scene_introduces_itself(source):
    for name in NAMES:
        text = source(name)
        head = text[: text.index('"""', 3)]
        for word in (name, "Forward", "do not edit", "Integrator", "operations", "States"):
            assert word in head


def test_default_integrators_are_those_of_the_design(source):
    assert "Integrator: lobatto6" in source("snakeboard")
    assert "exact (v3), exact (v1), exact (phi), quadrature (v2), quadrature (theta), quadrature (x)" in re.sub(
        r"exact \(v1\), exact \(v3\)", "exact (v3), exact (v1)", source("snakeboard")
    )
    assert "Integrator: verner9" in source("roller_racer")
    assert re.search(r"core \((psi|v1|v2) (psi|v1|v2) (psi|v1|v2)\), quadrature \(theta\)", source("roller_racer"))


def test_no_stop_no_code_for_stops(source):
    for name in NAMES:
        assert "first_event" in source(name)
        assert "first_event" not in source(name, stops=False)


def test_no_target_and_no_end_no_code_for_them(source):
    goal = CompiledScene(mechanics.get("snakeboard"), tasks.get("Goal")).source()
    traces = ("'goal_x'", "'target'", "def ends", "over = ", "_terminated")
    assert all(trace in goal for trace in traces)
    for name in NAMES:
        assert not [trace for trace in traces if trace in source(name)]


def test_sources_do_not_depend_on_hashes(source):
    """The same text in every process, else Numba could not cache and no two machines would agree."""
    script = (
        "import sys, mechanics\nfrom nhenv import tasks\nfrom nhenv.compiled import CompiledScene\n"
        "sys.stdout.write(CompiledScene(mechanics.get('roller_racer'), tasks.get('Forward')).source())"
    )
    for seed in ("1", "2"):
        env = {**os.environ, "PYTHONHASHSEED": seed}
        root = Path(__file__).parents[2]
        result = subprocess.run([sys.executable, "-c", script], cwd=root, env=env, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        assert result.stdout == source("roller_racer")


# Names that a user may choose, and that a careless generator would use itself.
HOSTILE = {
    "x": "memory", "y": "status", "theta": "count", "psi": "judged", "phi": "k",
    "m": "observation", "l": "state", "J_r": "h", "J_w": "s", "u_psi": "action", "u_phi": "result",
}  # fmt: skip


def _renamed(mechanism, names):
    words = {**names, **{f"{c}_dot": f"{names[c]}_dot" for c in mechanism.coordinates}}

    def rename(data):
        if isinstance(data, str):
            return re.sub(r"[A-Za-z_]\w*", lambda word: words.get(word[0], word[0]), data)
        if isinstance(data, dict):
            return {words.get(key, key): rename(value) for key, value in data.items()}
        if isinstance(data, tuple | list):
            return [rename(value) for value in data]
        return data

    return Mechanism.from_dict({**rename(mechanism.to_dict()), "name": "renamed", "citation": ""})


def test_names_do_not_matter(actions):
    """A snakeboard by other names moves as the snakeboard does."""
    env, other = LocomotionEnv("snakeboard"), LocomotionEnv(_renamed(mechanics.get("snakeboard"), HOSTILE))
    first, second = env.reset(seed=0)[0], other.reset(seed=0)[0]
    assert np.array_equal(first, second)
    for action in actions(env, 30):
        first, reward, *_, info = env.step(action)
        second, other_reward, *_, other_info = other.step(action)
        # Terms are ordered by name, and so may be added in another order: float32 shows none of it, or one digit.
        assert second == pytest.approx(first, rel=1e-6, abs=1e-7)
        assert other_reward == pytest.approx(reward, rel=1e-12)
        assert other_info == pytest.approx(info, rel=1e-12, abs=1e-15)


def test_ids_are_camel_case_of_their_mechanisms():
    assert nhenv.environment_ids()[:6] == (
        "nhenv/SnakeboardForward-v0",
        "nhenv/SnakeboardVelocity-v0",
        "nhenv/SnakeboardGoal-v0",
        "nhenv/SnakeboardTurn-v0",
        "nhenv/SnakeboardPark-v0",
        "nhenv/RollerRacerForward-v0",
    )


@pytest.mark.parametrize(
    ("name", "task"),
    [
        *((name, task) for name in NAMES for task in ("Forward", "Goal")),
        *(pytest.param(name, "Goal", marks=pytest.mark.slow) for name in OTHERS),
    ],
)
def test_backends_agree_through_impacts(name, task):
    """The NumPy row interprets the text that the Numba row compiles, stops included."""
    env, rng = LocomotionEnv(name, task), np.random.default_rng(1)
    env.reset(seed=0)
    scenes = [dataclasses.replace(env._scene, backend=backend) for backend in BACKENDS]
    memories = [env._memory.copy() for _ in scenes]
    limits, impacts = env.joint_limits, 0
    for _ in range(100):
        action = rng.uniform(-1, 1, env.action_space.shape)
        one, other = (s.kernel.respond(m, action) for s, m in zip(scenes, memories, strict=True))
        # Compiled code contracts products and sums; a hundred holds and a dozen impacts amplify that rounding.
        assert memories[1] == pytest.approx(memories[0], rel=1e-9, abs=1e-9)
        assert other[0] == pytest.approx(one[0], rel=1e-6, abs=1e-6)  # float32
        assert other[1] == pytest.approx(one[1], rel=1e-9, abs=1e-9)
        assert [type(value) for value in other[1:4]] == [type(value) for value in one[1:4]] == [float, bool, bool]
        values = scenes[0].values(memories[0])
        impacts += any(abs(values[joint]) == limit for joint, limit in limits.items())
    assert impacts > 3 or not limits or name not in NAMES


def test_backends_are_those_of_the_generator():
    assert sorted(BACKENDS) == sorted(backends.BACKENDS)
