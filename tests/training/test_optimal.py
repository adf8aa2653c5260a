import dataclasses
import os
import signal
import subprocess
import sys
import time

import gymnasium as gym
import numpy as np
import pytest

from training import optimal
from training.actors import actor
from training.config import COMPARED
from training.optimal import FOLDER, Optimal, Reference, driven, improve, load, path_of, reference, replay, search
from training.policies import SHIPPED, SUFFIX
from training.rollout import make_envs

CELLS = [(env_id, drag) for env_id in COMPARED for drag in (False, True)]
SNAKEBOARD, RACER = COMPARED

# What an earlier prototype had found, in metres.
BEFORE = dict(zip(CELLS, (51.0, 14.85, 32.4, 14.04), strict=True))

every_cell = pytest.mark.parametrize(("env_id", "drag"), CELLS)


@every_cell
def test_reference_reaches_what_was_known_before(env_id, drag):
    assert reference(env_id, drag) >= BEFORE[env_id, drag]


@every_cell
def test_reference_replays_in_the_environments(env_id, drag):
    known = load(env_id, drag)
    assert known.actions.dtype == np.float32
    assert np.abs(known.actions).max() <= 1
    assert len(known.actions) == gym.spec(env_id).max_episode_steps
    # Interpreted, which spares a compilation for each.
    assert replay(known, backend="numpy") == pytest.approx(known.distance_m, abs=1e-3)
    for substeps in (None, 10):
        env = gym.make(env_id, drag=drag, backend="numpy", substeps=substeps)
        env.reset(options={"q": np.zeros(env.unwrapped.mechanism.n)})
        covered = 0.0
        for action in known.actions:
            _, _, terminated, truncated, info = env.step(action)
            covered += info["reward_forward"] * env.unwrapped.dt
        assert truncated
        assert not terminated
        assert covered == pytest.approx(known.distance_m, abs=1e-3)


@pytest.mark.parametrize("env_id", COMPARED)
def test_reference_is_a_maximum_among_its_neighbours(env_id):
    known = load(env_id, False)
    envs = make_envs(env_id, 256, whole_state=True)
    rng = np.random.default_rng(0)
    # Noise in a random stretch of the episode, also a single hold.
    first, length = rng.integers(0, 300, 256), rng.integers(1, 40, 256)
    steps = np.arange(300)
    within = (steps >= first[:, None]) & (steps < (first + length)[:, None])
    noise = rng.normal(0, 0.05, (256, *known.actions.shape)) * within[..., None]
    actions = np.clip(known.actions + noise, -1, 1).astype(np.float32)
    envs.reset(options={"q": np.zeros(envs.mechanism.n)})
    returns = sum(envs.step(np.ascontiguousarray(actions[:, i]))[1] for i in steps)
    # The return without what efforts cost, which is 0.02 times the mean square of the actions.
    covered = (returns + 0.02 * (actions**2).mean(axis=2).sum(axis=1)) * envs.dt
    assert covered.max() < known.distance_m + 0.01


def test_no_reference_where_nobody_has_looked():
    assert reference("nhenv/SnakeboardGoal-v0") is None
    assert reference(SNAKEBOARD, {"C": 0.5}) is None
    assert reference(SNAKEBOARD) == reference(SNAKEBOARD, False) != reference(SNAKEBOARD, True)


def test_reference_survives_its_file_to_the_last_bit(tmp_path):
    actions = np.random.default_rng(0).uniform(-1, 1, (300, 2)).astype(np.float32)
    Reference(env_id=SNAKEBOARD, drag=True, distance_m=1.5, actions=actions, found={"x": 1}).write(tmp_path / "a.json")
    again = Reference.read(tmp_path / "a.json")
    assert again.actions.dtype == np.float32
    np.testing.assert_array_equal(again.actions, actions)
    assert (again.env_id, again.drag, again.distance_m, again.found) == (SNAKEBOARD, True, 1.5, {"x": 1})


def test_search_only_ever_improves():
    start = 0.5 * np.sin(np.arange(300) / 3)[:, None]
    heard = []
    distance, actions = search(
        RACER, False, {"sine": start}, hops=2, rounds=8, found=lambda metres, *_: heard.append(metres)
    )
    before = replay(Reference(env_id=RACER, drag=False, distance_m=0.0, actions=start.astype(np.float32)))
    assert heard == sorted(heard)
    assert heard[-1] == distance > before + 3
    again = Reference(env_id=RACER, drag=False, distance_m=distance, actions=actions)
    assert replay(again) == pytest.approx(distance, abs=1e-9)


def test_a_climb_that_ends_lower_is_forgotten(monkeypatch):
    tried, known = [], load(RACER, False)
    monkeypatch.setattr(optimal, "climb", lambda shooting, trial, rounds: (tried.append(trial), 0 * trial))
    distance, actions = search(
        RACER, False, {"known": known.actions}, hops=2, found=lambda *what: pytest.fail("it is no gain")
    )
    np.testing.assert_array_equal(actions, known.actions)
    assert distance == pytest.approx(known.distance_m, abs=1e-3)
    # The first climb is from what was given, the others from what a change has made of it.
    np.testing.assert_array_equal(tried[0], known.actions)
    assert [(trial != known.actions).any() for trial in tried] == [False, True, True]
    assert all((trial == known.actions).any() and np.abs(trial).max() <= 1 for trial in tried)


def test_the_best_start_is_climbed_on_from(monkeypatch):
    tried, heard = [], []
    known = load(RACER, False).actions
    monkeypatch.setattr(optimal, "climb", lambda shooting, trial, rounds: (tried.append(trial), trial))
    starts = {"still": 0 * known, "known": known, "half": known / 2}
    distance, actions = search(RACER, False, starts, hops=1, found=lambda *what: heard.append(what))
    np.testing.assert_array_equal(actions, known)
    assert [(metres, name) for metres, _, name in heard] == [(distance, "known")]
    for trial, start in zip(tried, starts.values(), strict=False):
        np.testing.assert_array_equal(trial, start)
    assert len(tried) == 4
    # What is changed at random, in a stretch or from somewhere on, is the best of them.
    assert (tried[3] != known).any()
    assert (tried[3] == known).mean() > (tried[3] == known / 2).mean()


def test_a_policy_drives_from_rest():
    one = actor(SHIPPED / f"RollerRacerForward-v0{SUFFIX}")
    actions = driven(one, False)
    assert (actions.shape, actions.dtype) == ((300, 1), np.float32)
    assert np.abs(actions).max() <= 1
    env = gym.make(RACER, backend="numpy")
    observation, _ = env.reset(options={"q": np.zeros(4)})
    policy = one.make(None)
    for action in actions:
        np.testing.assert_allclose(np.clip(policy(observation[None])[0], -1, 1), action, atol=1e-5)
        observation, *_ = env.step(action)


def test_only_what_was_made_for_a_cell_begins_there(tmp_path, monkeypatch):
    begun = {}
    monkeypatch.setattr(optimal, "search", lambda env_id, drag, starts, **others: begun.update({drag: starts}))
    monkeypatch.setattr(optimal, "driven", lambda one, drag: np.zeros((300, 1), np.float32))
    files = [SHIPPED / f"RollerRacerForward-v0{drag}{SUFFIX}" for drag in ("", "-drag")]
    for drag in (False, True):
        improve(RACER, drag, hops=0, seed=0, fresh=False, folder=tmp_path, starts=files)
    for drag, file in zip((False, True), files, strict=True):
        before, own = begun[drag]
        assert before == load(RACER, drag).found["start"]
        assert own == f"PPO ({file.name})"
    with pytest.raises(ValueError, match="which is not among what is searched"):
        Optimal(starts=files, drag=False)


def test_swings_hold_then_swing():
    numbers = np.array([0.25, 0.5, 0.5, 1.0, 0.0, 0.5, 0.1, 0.0, 0.25])  # share, two frequencies, two of each kind
    actions = optimal.swings(numbers, 300)
    assert actions.shape == (300, 2)
    assert (actions[:75] == [1.0, -1.0]).all()
    assert np.abs(actions[75:, 1]).max() == pytest.approx(0.2, abs=1e-3)
    assert np.abs(actions).max() <= 1
    np.testing.assert_array_equal(optimal.swings(np.stack([numbers, numbers]), 300)[1], actions)


def test_swings_grow_faster_or_slower():
    # Of 60 swings an episode a tenth at first and three tenths at last, over three quarters of it: nine.
    held, *swinging = np.split(optimal.swings(np.array([0.25, 0.1, 0.3, 0.6, 0.25, 0.1]), 300)[:, 0], [75, 150])
    assert held == pytest.approx(0.4)
    assert np.abs(np.concatenate(swinging)).max() == pytest.approx(0.5, abs=0.01)
    early, late = (np.count_nonzero(np.diff(np.sign(half))) / 2 for half in (swinging[0], swinging[1]))
    assert early == pytest.approx(60 * (0.1 * 0.25 + 0.2 * 0.25**2 / 2 / 0.75), abs=0.5)
    assert early + late == pytest.approx(9, abs=0.5)


def test_what_is_known_is_only_replaced_by_better(tmp_path):
    path = path_of(RACER, False, tmp_path)
    load(RACER, False).write(path)
    before = path.read_bytes()
    improve(RACER, False, hops=1, seed=0, fresh=False, folder=tmp_path)
    after = Reference.read(path)
    assert path.read_bytes() == before or after.distance_m > reference(RACER, False)


def test_a_fresh_search_begins_with_what_the_folder_holds_or_with_swings(tmp_path, monkeypatch):
    begun = []
    monkeypatch.setattr(optimal, "search", lambda env_id, drag, starts, **others: begun.extend(starts.values()))
    monkeypatch.setattr(optimal, "_best_swings", lambda *given: np.full((300, 1), 0.5))
    for fresh in (True, False):
        improve(RACER, False, hops=1, seed=0, fresh=fresh, folder=tmp_path)
    own = dataclasses.replace(load(RACER, False), actions=np.full((300, 1), 0.25, np.float32))
    own.write(path_of(RACER, False, tmp_path))
    for fresh in (True, False):
        improve(RACER, False, hops=1, seed=0, fresh=fresh, folder=tmp_path)
    for start, expected in zip(begun, (0.5, load(RACER, False).actions, 0.25, 0.25), strict=True):
        np.testing.assert_array_equal(start, np.broadcast_to(expected, (300, 1)))


def test_impossible_options_are_refused():
    with pytest.raises(ValueError, match="Did you mean"):
        Optimal(env_ids=("nhenv/SnakebordForward-v0",))
    with pytest.raises(ValueError, match="at least 1"):
        Optimal(hops=-1)


@pytest.mark.slow
def test_interrupting_keeps_what_was_found(tmp_path):
    command = [
        sys.executable,
        "-m",
        "training.optimal",
        "--fresh",
        "--out",
        str(tmp_path),
        "--env-ids",
        RACER,
        "--drag",
        "False",
    ]
    process = subprocess.Popen([*command, "--hops", "10000"], stderr=subprocess.PIPE, text=True, start_new_session=True)
    path = path_of(RACER, False, tmp_path)
    try:
        until = time.monotonic() + 120
        while not path.exists():
            assert time.monotonic() < until
            assert process.poll() is None
            time.sleep(0.1)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does it
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 1
    assert "what was found is kept" in errors
    assert "Traceback" not in errors
    found = Reference.read(path)
    assert replay(found) == pytest.approx(found.distance_m, abs=1e-9)


def test_files_are_those_of_the_cells():
    assert {path.name for path in FOLDER.iterdir()} == {path_of(*cell).name for cell in CELLS}
    for cell in CELLS:
        known = load(*cell)
        assert (known.env_id, known.drag) == cell
        assert known.found["start"]
