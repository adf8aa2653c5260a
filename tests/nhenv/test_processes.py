"""Environments in several processes and threads, and with caches that are missing, shared or damaged."""

import concurrent.futures
import multiprocessing
import os
import pickle
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import nhenv
from nhenv.vector_calls import Crew

ID = "nhenv/SnakeboardForward-v0"
ROOT = Path(__file__).parents[2]
CAN_FORK = pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="there is no fork here")


def _run(env, steps=30):
    """Everything that some steps return, as bytes."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(steps):
        found += [array.tobytes() for array in env.step(rng.uniform(-1, 1, env.action_space.shape))[:4]]
    return b"".join(found)


def _begin(seed=0, size=150, **arguments):
    """A vector environment in the middle of its episodes; 150 rows are more than one thread's share."""
    env = gym.make_vec(ID, num_envs=size, max_episode_steps=20, **arguments)
    env.reset(seed=seed)
    _run(env, 5)
    return env


def _in_process(method, function, *arguments, seconds=100):
    """Result of a function in a process of its own; an error if it hangs or dies."""
    context = multiprocessing.get_context(method)
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(sender, function, *arguments))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # from 3.12 on Python warns of forking with threads
        process.start()
    sender.close()
    try:
        assert receiver.poll(seconds), f"nothing came of the process in {seconds} s"
        return receiver.recv()
    finally:
        process.kill()
        process.join()
        receiver.close()


def _send(sender, function, *arguments):
    sender.send(function(*arguments))


_kept = {}


def _run_kept():
    return _run(_kept["env"])


@CAN_FORK
@pytest.mark.parametrize("threads", [1, 2])
def test_a_fork_goes_on_where_its_parent_is(threads):
    """Threads do not survive a fork; the child's environment must not wait for them."""
    _kept["env"] = env = _begin(threads=threads)
    assert (threads > 1) == isinstance(env._running, Crew)
    there = _in_process("fork", _run_kept)
    assert there == _run(env)
    env.close()


def _run_pickled(data):
    return _run(pickle.loads(data))


@pytest.mark.parametrize("method", ["spawn"])
def test_an_environment_may_be_sent_to_another_process(method):
    env = _begin()
    assert _in_process(method, _run_pickled, pickle.dumps(env)) == _run(env)


def _run_new(seed):
    return _run(_begin(seed))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_another_process_makes_the_same_environment(method):
    assert _in_process(method, _run_new, 3) == _run(_begin(3))


@pytest.mark.slow
def test_single_environments_in_processes_equal_rows():
    """Gymnasium's AsyncVectorEnv, whose workers load the kernel from the cache."""
    native = gym.make_vec(ID, num_envs=2, max_episode_steps=20)
    workers = gym.make_vec(ID, num_envs=2, max_episode_steps=20, vectorization_mode="async")
    for env in (native, workers):
        env.reset(seed=0)
    assert _run(native) == _run(workers)
    workers.close()


def test_environments_in_threads_of_one_process():
    """Two at once, which release the interpreter while they step: each does what it does alone."""
    alone = [_run(_begin(seed), 200) for seed in (0, 1)]
    envs = [_begin(seed) for seed in (0, 1)]
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        assert list(pool.map(lambda env: _run(env, 200), envs)) == alone


def test_environments_made_in_threads_of_one_process():
    """Loading the same kernel twice at once is harmless."""
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: _run(_begin(backend="numpy", size=3), 5), range(4)))
    assert len(set(found)) == 1


SCRIPT = """
import sys
import gymnasium as gym
import numpy as np
import nhenv
from nhenv.vector_calls import Crew

env = gym.make_vec("nhenv/SnakeboardForward-v0", num_envs=3, backend=sys.argv[1])
observations, _ = env.reset(seed=0)
observations = env.step(np.ones((3, 2), np.float32))[0]
print(observations.tobytes().hex())
"""


def _start(directory, backend, *options):
    return subprocess.Popen(
        [sys.executable, *options, "-c", SCRIPT, backend],
        cwd=ROOT,
        env={**os.environ, "NHENV_CACHE_DIR": str(directory)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _expected(backend):
    env = gym.make_vec(ID, num_envs=3, backend=backend)
    env.reset(seed=0)
    return f"{env.step(np.ones((3, 2), np.float32))[0].tobytes().hex()}\n"


BACKENDS = pytest.mark.parametrize("backend", ["numpy", pytest.param("numba", marks=pytest.mark.slow)])


@BACKENDS
def test_a_cache_that_cannot_be_written(backend, tmp_path):
    """Below a file, where not even root can make a directory: it warns, and works from memory."""
    (tmp_path / "file").write_text("")
    process = _start(tmp_path / "file" / "cache", backend)
    out, err = process.communicate(timeout=300)
    assert (process.returncode, out) == (0, _expected(backend)), err
    assert "cannot cache kernels" in err
    assert "NHENV_CACHE_DIR" in err


@BACKENDS
def test_processes_that_fill_a_cache_at_once(backend, tmp_path):
    """Neither sees half a file of the other's."""
    processes = [_start(tmp_path / "cache", backend, "-W", "error") for _ in range(2)]
    for process in processes:
        out, err = process.communicate(timeout=300)
        assert (process.returncode, out) == (0, _expected(backend)), err
    process = _start(tmp_path / "cache", backend, "-W", "error")
    out, err = process.communicate(timeout=300)
    assert (process.returncode, out) == (0, _expected(backend)), err


def test_id_of_this_file_is_registered():
    assert ID in nhenv.environment_ids()
