"""What the environment's docstring says of tasks is what the tasks are."""

import re

import numpy as np
import pytest

from mechanics.expressions import evaluate, names_in
from nhenv import tasks
from nhenv.env import LocomotionEnv

PLACE = {"Goal": "goal", "Turn": "start", "Park": "place"}


def rows():
    """Task, term and formula of the docstring's table of rewards, where the value is a formula and nothing else."""
    (table,) = re.findall(r"## Rewards(.*?)## Starting state", LocomotionEnv.__doc__, re.DOTALL)
    name = ""
    for line in table.splitlines():
        if match := re.fullmatch(r"\s*\| (?:(\w+) )?\| `(\w+)` \| `(.+)` \|", line):
            name = match[1] or name
            for task in tasks.TASKS if name == "all" else [tasks.get(name)]:
                yield pytest.param(task, *match.groups()[1:], id=f"{task.name} {match[2]}")


@pytest.mark.parametrize(("task", "term", "formula"), [*rows()])
def test_rewards_are_what_the_docstring_says(task, term, formula):
    place = PLACE.get(task.name)
    short = {"s": "forward", "e": "to_turn", "d": f"to_{place}", "d_before": f"to_{place}_before", "effort": "effort"}
    formula = formula.replace("mean(action**2)", "effort")
    rng = np.random.default_rng(0)
    for _ in range(5):
        values = {name: rng.uniform(0.1, 1) for name in names_in(task.reward[term])}
        values["to_turn"] = values.get("target_heading", 0.4) - values.get("heading", 0.0)
        said = {name: values[short.get(name, name)] for name in names_in(formula)}
        assert evaluate(formula, said) == pytest.approx(evaluate(task.reward[term], values), rel=1e-12)


def test_the_docstring_has_every_reward():
    (table,) = re.findall(r"## Rewards(.*?)## Starting state", LocomotionEnv.__doc__, re.DOTALL)
    assert {*re.findall(r"`(reward_\w+)`", table)} == {term for task in tasks.TASKS for term in task.reward}


def test_weights_are_what_the_docstring_says():
    (text,) = re.findall(r"\*\*weights: the task's weights\. (.*?)##", LocomotionEnv.__doc__, re.DOTALL)
    parts = re.findall(r"(\w+):\s(.*?)\.(?:\s|$)", text, re.DOTALL)
    said = {name: dict(re.findall(r"`(\w+)=([\d.]+)`", part)) for name, part in parts}
    everywhere = said.pop("All")
    for task in tasks.TASKS:
        weights = {name: float(value) for name, value in (said[task.name] | everywhere).items()}
        assert weights == task.weights
