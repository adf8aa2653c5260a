"""The way into and out of compiled kernels, against the same in plain Python: results, refusals, references."""

import gc
import pickle
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from nhenv import entry
from nhenv.env import LocomotionEnv
from nhenv.response import plain

INFO = ("reward_first", "y")
SIZES = {"actions": 2, "info": INFO}


def _kernel(memory, action):
    a, b = action
    memory[0] += a
    return (memory[1], memory[0] - b, a, b, a * b, memory[0], 0.1)


@pytest.fixture(scope="module")
def respond():
    return entry.compiled(memory=3, observations=3, **SIZES)(_kernel)


@pytest.fixture
def memory():
    return np.zeros(3)


def _plain():
    return plain(**SIZES)(_kernel)


def _same(first, second):
    """Whether two responses are equal bit for bit, in type and in content."""
    kinds = [np.ndarray, float, type(first[2]), bool, dict]
    assert [type(item) for item in first] == [type(item) for item in second] == kinds
    assert first[0].dtype == second[0].dtype == np.float32
    assert first[0].tobytes() == second[0].tobytes()
    assert first[1:] == second[1:]
    assert list(first[4]) == list(second[4])
    assert {type(value) for value in first[4].values()} <= {float}
    return True


def test_it_is_in_use(respond):
    """Else every environment would be slow, and nothing else would tell."""
    assert entry.possible()
    assert type(respond) is type(len)


@pytest.mark.parametrize("status", [0.0, 3.0, np.nan])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_plain_python_would_do(respond, memory, status, dtype):
    memory[1] = status
    other = memory.copy()
    for action in np.random.default_rng(0).normal(size=(50, 2)).astype(dtype):
        mine, theirs = respond(memory, action), _plain()(other, action)
        assert repr(mine[2]) == repr(theirs[2])
        assert mine[2] is False or np.isnan(status) or _same(mine, theirs)
        assert status != 0 or _same(mine, theirs)
        assert memory.tobytes() == other.tobytes()


def _unaligned(values):
    return np.frombuffer(b"\0" + values.tobytes(), np.uint8)[1:].view(values.dtype)


GUISES = {
    "strided": lambda a: np.repeat(a, 3)[::3],
    "reversed": lambda a: a[::-1].copy()[::-1],
    "a column": lambda a: np.stack([a, a], axis=1)[:, 0],
    "broadcast": lambda a: np.broadcast_to(a[:1], 2),
    "unaligned": _unaligned,
    "unpickled": lambda a: pickle.loads(pickle.dumps(a)),  # its dtype is another object
    "read-only": lambda a: np.frombuffer(a.tobytes(), a.dtype),
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("guise", GUISES)
def test_an_array_may_lie_anyhow(respond, memory, guise, dtype):
    action = GUISES[guise](np.array([0.25, -1.5], dtype))
    assert _same(respond(memory, action), _plain()(np.zeros(3), action))


class _Mine(np.ndarray):
    pass


REFUSED = {
    "a list": [0.0, 0.0],
    "None": None,
    "an object": object(),
    "a number": 1.0,
    "an array scalar": np.float32(1),
    "no dimension": np.float32(np.zeros(())),
    "too short": np.zeros(1),
    "too long": np.zeros(3),
    "empty": np.zeros(0),
    "two dimensions": np.zeros((2, 1)),
    "whole numbers": np.zeros(2, np.int64),
    "small whole numbers": np.zeros(2, np.int32),
    "half": np.zeros(2, np.float16),
    "long": np.zeros(2, np.longdouble),
    "complex": np.zeros(2, np.complex64),
    "objects": np.zeros(2, object),
    "text": np.zeros(2, "U8"),
    "time": np.zeros(2, "m8[s]"),
    "a record": np.zeros(2, [("x", "f4")]),
    "another byte order": np.zeros(2, np.dtype(np.float32).newbyteorder()),
    "another byte order, wide": np.zeros(2, np.dtype(np.float64).newbyteorder()),
    "a class of its own": np.zeros(2).view(_Mine),
}


@pytest.mark.parametrize("what", REFUSED)
def test_anything_else_is_refused(respond, memory, what):
    """By an exception, with nothing done; the environment then makes an array of it, or says what is wrong."""
    with pytest.raises(TypeError, match="array of 2"):
        respond(memory, REFUSED[what])
    if np.shape(REFUSED[what]) != (2,) or not isinstance(REFUSED[what], np.ndarray):
        with pytest.raises(TypeError):
            _plain()(memory, REFUSED[what])
    assert not memory.any()


@pytest.mark.parametrize(
    "memory",
    [
        None,
        [0.0] * 3,
        np.zeros(2),
        np.zeros(4),
        np.zeros(3, np.float32),
        np.zeros(3, int),
        np.zeros(6)[::2],
        np.zeros((1, 3)),
    ],
)
def test_a_memory_that_is_none_is_refused(respond, memory):
    with pytest.raises(TypeError, match="array of 3"):
        respond(memory, np.zeros(2))


@pytest.mark.parametrize("arguments", [(), (np.zeros(3),), (np.zeros(3), np.zeros(2), None)])
def test_another_number_of_arguments_is_refused(respond, arguments):
    with pytest.raises(TypeError):
        respond(*arguments)


def test_what_is_returned_belongs_to_the_caller(respond, memory):
    responses = []
    for _ in range(2):
        response = respond(memory, np.ones(2))
        assert sys.getrefcount(response) == 2  # the name, and the argument here
        assert [sys.getrefcount(response[i]) for i in (0, 1, 4)] == [2, 2, 2]  # the response, and the argument
        assert gc.is_tracked(response)
        observation = response[0]
        assert observation.flags.owndata
        assert observation.flags.writeable
        assert observation.flags.c_contiguous
        assert observation.base is None
        responses.append(response)
    first, second = responses
    assert not np.shares_memory(first[0], second[0])
    assert first[4] is not second[4]


def test_no_reference_is_lost_or_left(respond, memory):
    """Counts of everything that takes part, and of all that Python has allocated, over 20 000 calls and refusals."""
    action, refused = np.ones(2, np.float32), np.ones(3, np.float32)
    label = next(iter(respond(memory, action)[4]))
    watched = [memory, action, refused, False, None, label, np.ndarray, action.dtype, np.dtype(np.float32), respond]

    def run(times):
        for i in range(times):
            memory[1] = i % 2  # the place of the flag takes both
            respond(memory, action)
            try:
                respond(memory, refused)
            except TypeError:
                pass

    run(100)
    gc.collect()
    before, blocks = [sys.getrefcount(thing) for thing in watched], sys.getallocatedblocks()
    run(10_000)
    gc.collect()
    # A reference lost or left in each call would be 10 000; a few may move with caches of the interpreter.
    assert np.abs(np.subtract([sys.getrefcount(thing) for thing in watched], before)).max() < 50
    assert abs(sys.getallocatedblocks() - blocks) < 50


NO_MEMORY = """
import sys
import _testcapi
import numpy as np
from nhenv import entry

def kernel(memory, action):
    return (memory[1], memory[0], *action, 1.0, 2.0, 3.0)

respond = entry.compiled(memory=3, actions=2, observations=3, info=("a", "b"))(kernel)
memory, action = np.ones(3), np.ones(2, np.float32)
failures, kept = 0, [respond(memory, action) for _ in range(200)]  # leave no free lists
for allowed in range(40):
    kept += [respond(memory, action) for _ in range(100)]
    _testcapi.set_nomemory(allowed, 0)
    try:
        response = respond(memory, action)
    except MemoryError:
        failures += 1
    finally:
        _testcapi.remove_mem_hooks()
response = respond(memory, action)
assert response[1:] == (1.0, 1.0, False, {"a": 1.0, "b": 1.0}), response
print(failures)
"""


def test_without_memory_it_raises(kernel_cache):
    """The n-th allocation fails, for every n; in a process of its own, because it would be killed."""
    pytest.importorskip("_testcapi")
    root = Path(__file__).parents[2]
    result = subprocess.run([sys.executable, "-c", NO_MEMORY], cwd=root, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) >= 7  # an array, five floats, a dictionary, a tuple: free lists serve some of them


def test_threads_do_not_disturb_each_other(respond):
    actions = np.random.default_rng(1).normal(size=(5000, 2)).astype(np.float32)
    ends = {}

    def run(name, way):
        memory = np.zeros(3)
        for action in actions:
            response = respond(memory, way * action)
        ends[name] = way * response[1], *(way * response[0][[1]])

    threads = [threading.Thread(target=run, args=(i, (-1) ** i)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(ends.values())) == 1


@pytest.mark.parametrize("name", ["snakeboard", "roller_racer"])
def test_where_it_is_not_possible_the_same_comes_slowly(name, actions, monkeypatch):
    """The environment's own kernel, once each way."""
    env = LocomotionEnv(name)
    env.reset(seed=0)
    kernel = env._scene.kernel
    memory = env._memory.copy()
    monkeypatch.setattr(entry, "possible", lambda: False)
    source = Path(kernel.__file__).read_text(encoding="utf-8")
    module = {"CACHE__": False}
    exec(compile(source, "<slow>", "exec"), module)
    assert type(module["respond"]) is not type(kernel.respond)
    for action in actions(env, 20):
        first, second = env.step(action), module["respond"](memory, action)
        assert _same(first, second)
    for wrong in (np.zeros(5), [0.0]):
        with pytest.raises(TypeError):
            module["respond"](memory, wrong)
