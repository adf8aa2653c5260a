"""`python -m nhenv`: what is integrated and what is left out, of every registered environment."""

import dataclasses
import subprocess
import sys

import pytest

import nhenv
from mechanics.__main__ import main as mechanics_main
from nhenv.__main__ import cost, main, operations, scene_of


@pytest.mark.parametrize("env_id", nhenv.environment_ids())
def test_a_scene_integrates_some_states_and_leaves_out_the_others(env_id):
    scene = scene_of(env_id)
    own, whole = cost(scene), cost(dataclasses.replace(scene, whole_state=True))
    integrated = [state for _, states in own.layers for state in states]
    assert sorted([*integrated, *own.pruned]) == sorted(scene.states)
    assert not whole.pruned
    assert 0 < own.operations <= whole.operations
    assert (own.operations < whole.operations) == bool(own.pruned)


@pytest.mark.parametrize(
    ("env_id", "pruned"),
    [
        ("nhenv/SnakeboardForward-v0", {"y", "psi"}),
        ("nhenv/SnakeboardVelocity-v0", {"x", "y", "psi"}),
        ("nhenv/SnakeboardGoal-v0", {"psi"}),
        ("nhenv/RollerRacerForward-v0", {"y"}),
        ("nhenv/RollerRacerVelocity-v0", {"x", "y"}),
        ("nhenv/RollerRacerGoal-v0", set()),
    ],
)
def test_what_a_task_does_not_need_is_left_out(env_id, pruned):
    """By hand, from what each task observes, rewards and reports."""
    assert set(cost(scene_of(env_id)).pruned) == pruned


def test_operations_are_those_of_the_functions_asked_for():
    source = "def f(a, b):\n    c = a*b + sin(a)\n    return c, (a < b) & (b < c)\ndef g(a):\n    return a/2\n"
    assert operations(source, ["f"]) == 3
    assert operations(source, ["f", "g", "h"]) == 4


def test_it_prints_a_table(capsys):
    main(("nhenv/SnakeboardForward-v0",))
    text = capsys.readouterr().out
    for word in ("SnakeboardForward", "y psi", "lobatto6", "exact", "quadrature", "%"):
        assert word in text
    mechanics_main(scene="nhenv/SnakeboardForward-v0")
    assert capsys.readouterr().out == text


def test_an_unknown_id_gets_one_line():
    command = [sys.executable, "-m", "nhenv", "nhenv/Snekboard-v0"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr.strip() == (
        "error: no environment 'nhenv/Snekboard-v0'; python -m nhenv lists those that there are"
    )
