"""What is timed is right, what is compared belongs together, and what is counted is there."""

import csv
import platform
import sys

import gymnasium as gym
import numpy as np
import pytest

from benchmarks import errors as errors_module
from benchmarks import memory as memory_module
from benchmarks.errors import errors
from benchmarks.floor import PARTS, Part, fma_rate, kernel_parts, loops
from benchmarks.peers import PEERS, Contender, actions, ours
from benchmarks.single_env import installed
from benchmarks.throughput import Arguments, Ours, Results, main, ratios

SNAKEBOARD = "nhenv/SnakeboardForward-v0"


class Counting(gym.vector.VectorEnv):
    """Episodes of 300 steps that count themselves; observed is the age of each."""

    def __init__(self, num_envs, value=0.0):
        self.num_envs, self.value = num_envs, value
        self.single_action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        self.ballast = np.ones((num_envs, 1000))

    def reset(self, *, seed=None, options=None):
        rows = slice(None) if options is None else options["reset_mask"]
        if options is None:
            self.age = np.zeros(self.num_envs, dtype=int)
        self.age[rows] = 0
        return self.age[:, None], {}

    def step(self, actions):
        assert actions.shape == (self.num_envs, 1)
        self.age += 1
        self.ended = self.age == 300
        self.age[self.ended] = 0
        nothing = np.zeros(self.num_envs, dtype=bool)
        return np.full((self.num_envs, 1), self.value), np.zeros(self.num_envs), nothing, self.ended.copy(), {}


@pytest.fixture
def counting(monkeypatch):
    """Make `gym.make_vec` return such, and keep the last."""
    made = []

    def make_vec(env_id, num_envs, value=0.0):
        made.append(Counting(num_envs, value))
        return made[-1]

    monkeypatch.setattr(gym, "make_vec", make_vec)
    return made


# -- a run -----------------------------------------------------------------------------------------


def test_a_tiny_run_has_a_row_for_every_contender_and_names_what_is_not_installed(monkeypatch, capsys, tmp_path):
    for name in ("envpool", "gymnax", "mujoco"):
        monkeypatch.setitem(sys.modules, name, None)  # as if it were not installed
    file = tmp_path / "throughput.csv"
    arguments = Arguments(
        env_ids=(SNAKEBOARD,), sizes=(1, 3), threads=(1,), rounds=2, seconds=1e-4, floor=False, csv=file
    )
    monkeypatch.setattr("benchmarks.throughput.errors", lambda *_: errors_module.Errors(1.5e-11, 2.5e-9))
    main(arguments)
    printed = capsys.readouterr().out
    for name in ("EnvPool", "gymnax", "MuJoCo"):
        assert f"skipped: {name} (" in printed
    with file.open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    contenders = ["SnakeboardForward, 1 thread", "CartPoleVectorEnv", "SyncVectorEnv of SnakeboardForward-v0"]
    assert [(row["environments"], row["contender"]) for row in rows] == [(n, c) for n in "13" for c in contenders]
    for row in rows:
        assert row["contender"] in printed
        assert 0 < float(row["seconds_q1"]) <= float(row["seconds"]) <= float(row["seconds_q3"])
    assert [row["hold_error"] for row in rows] == ["1.5e-11", "", ""] * 2
    assert float(rows[0]["times CartPoleVectorEnv"]) > 0


def test_a_ratio_is_formed_within_a_round_against_the_best_of_a_kind():
    one, two = Ours(SNAKEBOARD, 1, "float64"), Ours(SNAKEBOARD, 2, "float64")
    chosen = {row: ours(row.name, row.env_id, row.options) for row in (one, two)}
    pool = [Contender(name, "pool", lambda size: lambda steps: 0.0) for name in "ab"]
    results = Results()
    results.seconds = {
        (8, chosen[one]): [1.0, 2.0, 1.0],
        (8, chosen[two]): [1.0, 1.0, 0.5],
        (8, pool[0]): [3.0, 20.0, 4.0],
        (8, pool[1]): [9.0, 6.0, 9.0],
        (9, pool[0]): [0.1, 0.1, 0.1],
    }
    # 3/1, 6/2, 4/1; medians of each over medians of the other would give another number.
    assert ratios(results, 8, chosen[one], chosen) == {"pool": (3.0, 3.0, 3.5)}
    assert ratios(results, 8, chosen[two], chosen)["one thread"] == (1.5, 2.0, 2.0)


def test_rows_differ_in_what_they_are_made_with():
    assert Ours(SNAKEBOARD, 1, "float64").options == {}
    assert Ours(SNAKEBOARD, 2, "float32").options == {"threads": 2, "dtype": "float32"}
    assert Ours(SNAKEBOARD, 2, "float32").alone == Ours(SNAKEBOARD, 1, "float32")


# -- contenders ------------------------------------------------------------------------------------


@pytest.mark.parametrize("space", [gym.spaces.Box(-1, 1, (2,), np.float32), gym.spaces.Discrete(2)])
def test_actions_are_in_their_space_differ_and_drift_nowhere(space):
    size = 1 << 17  # 32 arrays and their opposites
    drawn = [action for action, _ in zip(actions(space, size), range(64), strict=False)]
    for action in drawn:
        assert action.shape == (size, *(space.shape or ()))
        assert all(space.contains(row) for row in action[:100])
    assert len({action.tobytes() for action in drawn}) == 64
    middle = 0.5 if isinstance(space, gym.spaces.Discrete) else 0.0
    np.testing.assert_allclose(np.mean(drawn, axis=0), middle, atol=1e-6)  # float32 sums


@pytest.mark.parametrize("size", [1, 7, 600])
def test_episodes_of_ours_end_at_a_steady_rate(counting, size):
    run = ours("name", SNAKEBOARD, {}).make(size)
    (envs,) = counting
    ends = []
    for _ in range(300):
        run(1)
        ends.append(envs.ended.sum())
    assert sum(ends) == size
    assert max(ends) == -(-size // 300)
    when = np.flatnonzero(ends)
    assert np.ptp(np.diff([*when, when[0] + 300])) <= 1


def test_what_is_not_finite_is_not_timed(counting):
    with pytest.raises(AssertionError):
        ours("name", SNAKEBOARD, {"value": np.nan}).make(3)(2)


@pytest.mark.parametrize("contender", [c for row in PEERS.values() for c in row], ids=lambda c: c.name)
def test_a_peer_steps_if_it_is_installed(contender):
    try:
        run = contender.make(3)
    except ImportError as error:
        pytest.skip(str(error))
    assert 0 < run(2) < 1


def test_a_single_environment_that_is_not_installed_is_skipped_by_name(monkeypatch):
    def make(env_id):
        if env_id == "HalfCheetah-v5":
            raise gym.error.DependencyNotInstalled("no MuJoCo")
        return real(env_id)

    real = gym.make
    monkeypatch.setattr(gym, "make", make)
    contenders, skipped = installed(["CartPole-v1", "HalfCheetah-v5"])
    assert list(contenders) == ["CartPole-v1"]
    assert skipped == ["skipped: HalfCheetah-v5 (no MuJoCo)"]


# -- errors ----------------------------------------------------------------------------------------


def test_errors_are_seen(monkeypatch):
    true = errors_module._state
    honest = errors(SNAKEBOARD, {}, runs=1, every=149)
    assert 0 < honest.hold < 1e-9
    assert 0 < honest.run < 1e-7
    moments = []

    def disturbed(envs):
        """Every other state that is looked at is wrong, by a thousandth in one velocity of each environment."""
        q, qdot = true(envs)
        qdot[:, 1] += 1e-3 * (len(moments) % 2)
        moments.append(envs)
        return q, qdot

    monkeypatch.setattr(errors_module, "_state", disturbed)
    wrong = errors(SNAKEBOARD, {}, runs=1, every=149)
    assert wrong.hold == pytest.approx(1e-3, rel=1e-5)
    assert wrong.run == pytest.approx(1e-3, rel=1e-3)


# -- memory ----------------------------------------------------------------------------------------


@pytest.mark.skipif(not memory_module.CLEAR.exists(), reason="the system does not tell")
def test_memory_is_that_of_the_environments(counting):
    found = memory_module._measure(SNAKEBOARD, {}, 1 << 14)
    # A thousand float64; the process itself gains and loses a megabyte, 60 bytes of each.
    assert found.kept == pytest.approx(8000, abs=200)
    assert found.peak == pytest.approx(8000, abs=200)
    assert memory_module.memory(SNAKEBOARD, {}, memory_module.SMALLEST - 1) is None


# -- floor -----------------------------------------------------------------------------------------

ASSEMBLY = """
f:
\tvmulpd\t%zmm0, %zmm1, %zmm2
.LBB0_1:
\tvmovupd\t(%rsi,%rcx,8), %zmm3
.LBB0_2:
\tvmovupd\t(%rdi,%rcx,8), %zmm0
\tvmulpd\t(%rsi,%rcx,8), %zmm0, %zmm1
\tvfmadd213pd\t.LCPI0_1(%rip){1to8}, %zmm0, %zmm1
\tvfnmsub231pd\t%zmm0, %zmm1, %zmm2
\tvaddpd\t-64(%rsp), %zmm1, %zmm1
\tvaddpd\t.LCPI0_2(%rip), %zmm1, %zmm1
\tvdivpd\t%zmm0, %zmm1, %zmm2
\tvsqrtpd\t%zmm0, %zmm2
\tvaddsd\t%xmm0, %xmm1, %xmm2
\tvcmpltpd\t%zmm0, %zmm1, %k1
\tjae\t.LBB0_9
\tvmovupd\t%zmm1, (%rdx,%rcx,8)
\taddq\t$8, %rcx
\tcmpq\t%rcx, %rax
\tjne\t.LBB0_2
\tjmp\t.LBB0_1
.LBB0_3:
\tvaddsd\t%xmm0, %xmm1, %xmm2
\tjne\t.LBB0_3
.LBB0_4:
\tvaddps\t%ymm0, %ymm1, %ymm2
\tvmulps\t%ymm0, %ymm1, %ymm2
\tjne\t.LBB0_4
.LBB0_9:
\tretq
"""


def test_instructions_of_innermost_vector_loops_are_counted():
    large, small = loops(ASSEMBLY, ASSEMBLY)  # the loop around the first and the scalar one do not count
    assert large.counts == {"move": 2, "multiply": 1, "fused": 2, "add": 2, "divide": 1, "root": 1, "other": 1}
    assert (large.lanes, large.arithmetic, large.moved, large.spilled) == (8, 5, 3 * 64, 64)
    assert (small.lanes, small.counts) == (8, {"add": 1, "multiply": 1})
    assert not small.double
    # 2 passes of 5 instructions for each of 8 rows at once, each of which does 8 of 1e10 multiply-adds a second.
    assert Part("name", 2, 1, large).floor(rate=1e10) == pytest.approx(1e-9)
    assert Part("name", 2, 2, large).floor(rate=1e10) == pytest.approx(0.5e-9)


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="not x86")
def test_kernels_are_vector_code_and_most_of_it_is_the_integrator():
    parts = {part.name: part for part in kernel_parts(SNAKEBOARD, {"substeps": 3})}
    assert set(parts) >= {"prepare_rows", "advance_rows", "screen_rows", "finish_rows"}
    assert set(parts) <= set(PARTS)
    assert {name: part.passes for name, part in parts.items() if part.passes != 1} == {"advance_rows": 3}
    assert parts["advance_rows"].loop.arithmetic > 2 * sum(
        part.loop.arithmetic for name, part in parts.items() if name != "advance_rows"
    )
    assert all(part.loop.counts.get("gather", 0) == 0 for part in parts.values())


def test_the_rate_of_fused_multiply_adds_is_that_of_a_processor():
    slow, fast = fma_rate(seconds=0.02), fma_rate(double=False, seconds=0.02)
    # From one number in 10 ns, where it is a call of a library, to 32 a cycle at 10 GHz.
    assert 1e8 < slow < 3.2e11
    assert 1e8 < fast < 6.4e11
