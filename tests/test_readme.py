"""The README's programs run as they stand there, its pictures exist, and its numbers are those of the results."""

import dataclasses
import re
from pathlib import Path

import gymnasium as gym
import pytest

import mechanics
import nhenv
from nhenv.__main__ import cost, scene_of
from nhenv.registration import as_mechanism

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
PROGRAMS = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
RESULTS = {path.parent.name: path.read_text(encoding="utf-8") for path in ROOT.glob("training/results/*/results.md")}
WORDS = " ".join(TEXT.split())


def test_there_are_programs():
    assert len(PROGRAMS) == 6


@pytest.mark.parametrize("number", range(len(PROGRAMS)))
def test_programs_run(number, capsys):
    exec(compile(PROGRAMS[number], f"README program {number + 1}", "exec"), {})
    assert re.search(r"\d", capsys.readouterr().out)  # each prints numbers


def test_files_exist():
    files = re.findall(r"\]\(([^)#]+)\)", TEXT) + re.findall(r"`((?:tests|mechanics|benchmarks)/[\w/]+\.py)`", TEXT)
    assert files
    missing = [name for name in files if "NAME" not in name and not (ROOT / name).exists()]
    assert missing == []


def test_estimates_with_intervals_are_those_of_the_results():
    estimates = re.findall(r"\d+\.\d+ \[[\d.]+, [\d.]+\]", TEXT.replace("*", "").replace("\n", " "))
    assert len(estimates) > 40
    assert [one for one in estimates if not any(one in text for text in RESULTS.values())] == []


@pytest.mark.parametrize("name", RESULTS)
def test_results_stand_beside_the_command_that_makes_them(name):
    (command, cpu_s) = re.search(
        r"`(python -m training.compare.*?)`.*, (\d+) s of CPU time in all", RESULTS[name]
    ).groups()
    after = WORDS.partition(f"`{command}`")[2]
    assert f"{int(cpu_s):,} s of CPU time" in after[:100]


def test_counts_are_those_of_the_code():
    # Without those that programs and tests register.
    made_of = [as_mechanism(gym.spec(one).kwargs["mechanism"]).name for one in nhenv.environment_ids()]
    assert f"all {sum(name in mechanics.names() for name in made_of)})" in WORDS
    scene = scene_of("nhenv/SnakeboardForward-v0")
    own, whole = (cost(one).operations for one in (scene, dataclasses.replace(scene, whole_state=True)))
    assert f"{own} of the {whole} that the whole state takes" in WORDS
