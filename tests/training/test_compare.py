import dataclasses
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from training import config
from training.compare import Compare, compare
from training.config import EvaluationConfig, GaitConfig, PPOConfig, TaskConfig
from training.progress import Job, run_jobs

SNAKEBOARD = "nhenv/SnakeboardForward-v0"
TINY = TaskConfig(
    gaits={"sinusoid": GaitConfig(population=7, generations=1, starts=1)},
    ppo=PPOConfig(timesteps=512, n_envs=4, n_steps=64, batch_size=64, n_epochs=1, curve_every=1, curve_episodes=1),
    evaluation=EvaluationConfig(episodes=2, fine_substeps=2),
)


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setitem(config.CONFIGS, "Forward", TINY)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A comparison that was made once, with its options and what it printed."""
    options = Compare(env_ids=(SNAKEBOARD,), seeds=(0,), out=tmp_path_factory.mktemp("compare"), processes=2)
    console = Console(file=io.StringIO(), width=120)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(config.CONFIGS, "Forward", TINY)
        return options, compare(options, ["python", "-m", "training.compare"], console), console.file.getvalue()


def silent():
    return Console(file=io.StringIO())


def test_it_writes_numbers_a_table_and_a_figure(finished):
    options, results, printed = finished
    written = json.loads((options.out / "results.json").read_text(encoding="utf-8"))
    assert written["command"] == "python -m training.compare"
    assert written["versions"].keys() >= {"python", "torch", "stable_baselines3", "gymnasium"}
    assert os.uname().nodename not in json.dumps(written["machine"]).split('"')
    one = written["environments"][SNAKEBOARD]
    for controller in (one["gaits"]["sinusoid"], *one["ppo"], one["ppo_over_seeds"]):
        for metric in ("distance_m", "energy_j", "cost_of_transport", "return"):
            assert controller[metric].keys() == {"mean", "std", "min", "max"}
    assert one["gaits"]["sinusoid"]["episodes"] == 14
    assert one["ppo"][0]["steps"] == 512
    assert one["ppo"][0]["distance_m"]["mean"] == results["environments"][SNAKEBOARD]["ppo"][0]["distance_m"]["mean"]
    assert one["config"]["ppo"]["timesteps"] == 512
    table = (options.out / "results.md").read_text(encoding="utf-8")
    for text in (table, printed):
        assert f"{one['gaits']['sinusoid']['distance_m']['mean']:.2f} ± " in text
        assert "PPO, seed 0" in text
    image = (options.out / "SnakeboardForward-v0.png").read_bytes()
    assert image.startswith(b"\x89PNG")
    assert int.from_bytes(image[16:20], "big") >= 900  # its width


def test_second_call_only_judges_and_finds_the_same(finished):
    options, results, _ = finished
    assert options.jobs() == []
    again = compare(options, [], silent())
    for controller in ("gaits", "ppo", "ppo_over_seeds"):
        assert again["environments"][SNAKEBOARD][controller] == results["environments"][SNAKEBOARD][controller]


def test_changed_settings_invalidate_what_they_concern(finished, monkeypatch):
    options, *_ = finished
    longer = dataclasses.replace(options, timesteps=1024)
    more = dataclasses.replace(options, seeds=(0, 1))
    assert [job.label for job in longer.jobs()] == ["SnakeboardForward-v0 PPO seed 0"]
    assert [job.label for job in more.jobs()] == ["SnakeboardForward-v0 PPO seed 1"]
    gaits = TINY.gaits | {"second": dataclasses.replace(TINY.gaits["sinusoid"], seed=1)}
    monkeypatch.setitem(config.CONFIGS, "Forward", dataclasses.replace(TINY, gaits=gaits))
    assert [job.label for job in options.jobs()] == ["SnakeboardForward-v0 second"]
    judged = dataclasses.replace(TINY, evaluation=EvaluationConfig(episodes=3))
    monkeypatch.setitem(config.CONFIGS, "Forward", judged)
    assert options.jobs() == []


def test_drag_is_another_experiment(finished):
    options, *_ = finished
    dragged = dataclasses.replace(options, drag=True)
    config = dragged.config(SNAKEBOARD)
    for part in (config.gaits["sinusoid"], config.ppo, config.evaluation):
        assert part.env_kwargs == {"drag": True}
    assert len(dragged.jobs()) == 2
    assert options.jobs() == []


def test_options_are_checked():
    with pytest.raises(ValueError, match="Did you mean 'nhenv/SnakeboardForward-v0'"):
        Compare(env_ids=("nhenv/SnakeBoardForward-v0",))
    with pytest.raises(ValueError, match="different numbers"):
        Compare(seeds=(1, 1))
    with pytest.raises(ValueError, match="seed of a run"):
        Compare(seeds=(-1,))


def test_defaults_take_every_environment_with_settings():
    assert set(Compare().env_ids) == {"nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0"}


@pytest.mark.slow
def test_failure_of_a_job_is_told(tmp_path):
    with pytest.raises(ValueError, match="unknown environment 'nhenv/Nothing-v0'"):
        run_jobs([Job("x", _fail, ())], 1, silent())


def _fail(report):
    config.check_env_id("nhenv/Nothing-v0")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_ctrl_c_keeps_what_is_done(tmp_path):
    command = [sys.executable, "-m", "training.train", "--env-id", SNAKEBOARD, "--out", str(tmp_path)]
    with subprocess.Popen(
        command, cwd=Path(__file__).parents[2], stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
    ) as process:
        deadline = time.monotonic() + 120
        while not list(tmp_path.rglob("*.checkpoint")):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.1)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to every process
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert b"interrupted; the same command goes on" in errors
    (checkpoint,) = tmp_path.rglob("*.checkpoint")
    assert checkpoint.stat().st_size > 0
