import dataclasses
import io
import json

import numpy as np
import pytest
from rich.console import Console

from training import config
from training import sweep as module
from training.config import TUNING_SEEDS, EvaluationConfig, PPOConfig, TaskConfig
from training.evaluate import load_policy
from training.options import seeds
from training.rollout import recorded, rollout
from training.sweep import Range, Sweep, combinations, main, parsed, sweep
from training.train import ppo_path

SNAKEBOARD = "nhenv/SnakeboardForward-v0"
TINY = TaskConfig(
    gaits={},
    ppo=PPOConfig(timesteps=256, n_envs=4, n_steps=64, batch_size=64, n_epochs=1, curve_every=9, curve_episodes=1),
    evaluation=EvaluationConfig(episodes=3),
)


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setitem(config.CONFIGS, "Forward", TINY)


def test_values_are_read_as_the_settings_have_them():
    for field in dataclasses.fields(PPOConfig):
        if field.name in module.FIELDS:
            default = getattr(PPOConfig(), field.name)
            again = parsed(field.name, module._text(default))
            assert again == default
            assert type(again) is type(default)
    assert parsed("learning_rate", "1e-3,1e-4") == (1e-3, 1e-4)
    assert parsed("gamma", "1") == 1.0
    assert isinstance(parsed("gamma", "1"), float)
    assert parsed("n_steps", "8..64") == Range("n_steps", 8.0, 64.0, True)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("gamma", "high", "gamma: expected a value such as 0.99"),
        ("n_steps", "6.5", "n_steps: expected a value such as 64"),
        ("hidden", "64,x", "hidden: expected a value such as 64,64, with commas"),
        ("learning_rate", "1e-4..1e-3", "learning_rate: expected"),
        ("clip_range", "0.3..0.1", "clip_range: a range is LOW..HIGH"),
        ("gamma", "0.9..1", "must end below 1"),
        ("activation", "1..2", "activation: expected a value such as tanh; got"),
    ],
)
def test_wrong_values_are_answered_with_right_ones(name, text, problem):
    with pytest.raises(ValueError, match=problem):
        parsed(name, text)


def test_misspelt_activations_are_answered_with_what_was_meant():
    with pytest.raises(ValueError, match=r"known: tanh, leaky_relu\. Did you mean 'leaky_relu'\?"):
        Sweep(env_id=SNAKEBOARD, fields={"activation": ("leaky-relu",)})


def test_values_make_a_grid():
    grid = combinations({"gamma": ("0.9", "0.99"), "n_steps": ("8",), "n_epochs": (), "hidden": ("4", "8,8")}, 0)
    assert len(grid) == 4
    assert {tuple(one.items()) for one in grid} == {
        (("gamma", gamma), ("n_steps", 8), ("hidden", hidden)) for gamma in (0.9, 0.99) for hidden in ((4,), (8, 8))
    }
    assert combinations({}, 0) == [{}]


def test_ranges_are_filled_evenly_on_their_scales():
    ranges = {"gamma": ("0.9..0.9999",), "clip_range": ("0.1..0.4",), "log_std": ("-1..1",), "n_steps": ("16..256",)}
    drawn = combinations(ranges, 64)
    assert len(drawn) == 64
    shares = {
        "gamma": [np.log(0.1 / (1 - one["gamma"])) / np.log(1000) for one in drawn],
        "clip_range": [np.log(one["clip_range"] / 0.1) / np.log(4) for one in drawn],
        "log_std": [(one["log_std"] + 1) / 2 for one in drawn],
        "n_steps": [np.log(one["n_steps"] / 16) / np.log(16) for one in drawn],
    }
    for name, values in shares.items():
        # A quarter of them in each quarter: random points would miss by 4, a Halton sequence does by 1 or 2.
        counts, _ = np.histogram(values, 4, (0, 1))
        assert np.abs(counts - 16).max() <= 2, name
    assert all(isinstance(one["n_steps"], int) for one in drawn)
    assert combinations(ranges, 8) == drawn[:8]
    assert all(0 < values[0] < 1 for values in shares.values())  # not in a corner
    assert len(combinations(ranges | {"n_epochs": ("1", "2")}, 8)) == 16


def test_ranges_and_draws_belong_together():
    with pytest.raises(ValueError, match="got 0 draws, 1 ranges"):
        combinations({"gamma": ("0.9..0.99",)}, 0)
    with pytest.raises(ValueError, match="got 3 draws, 0 ranges"):
        combinations({"gamma": ("0.9",)}, 3)
    with pytest.raises(ValueError, match="one range alone"):
        combinations({"gamma": ("0.9..0.99", "0.5")}, 3)


def test_sweep_judges_every_setting_on_the_starts_for_tuning(tmp_path):
    options = Sweep(env_id=SNAKEBOARD, fields={"gamma": ("0.5", "0.99")}, seeds=(0, 1), out=tmp_path, processes=1)
    assert len(options.jobs()) == 4
    for job in options.jobs():  # in this process, which is quicker than to start others
        job.function(*job.arguments)
    assert options.jobs() == []
    console = Console(file=io.StringIO(), width=100)
    results = sweep(options, ["python", "-m", "training.sweep"], console)
    assert {row["setting"]["gamma"] for row in results["settings"]} == {0.5, 0.99}
    estimates = [row["distance_m"]["estimate"] for row in results["settings"]]
    assert estimates == sorted(estimates, reverse=True)
    best = results["settings"][0]
    values = []
    for seed in options.seeds:
        path = ppo_path(SNAKEBOARD, dataclasses.replace(TINY.ppo, **best["setting"]), seed, tmp_path)
        envs = recorded(SNAKEBOARD, 3)
        x = rollout(load_policy(path.with_suffix(".zip")), envs, range(TUNING_SEEDS, TUNING_SEEDS + 3)).q[:, :, 0]
        values.append(x[:, -1] - x[:, 0])
    assert best["distance_m"]["max"] == pytest.approx(np.max(values), rel=1e-12)
    assert best["distance_m"]["mean"] == pytest.approx(np.mean(values), rel=1e-9)
    assert json.loads((tmp_path / "sweep.json").read_text())["settings"][0]["setting"] == best["setting"]
    text = (tmp_path / "sweep.md").read_text(encoding="utf-8")
    for shown in (text, console.file.getvalue()):
        assert f"{best['distance_m']['estimate']:.2f} [" in shown
    more = dataclasses.replace(options, fields={"gamma": ("0.5", "0.9", "0.99")})
    assert [job.label for job in more.jobs()] == ["gamma 0.9 seed 0", "gamma 0.9 seed 1"]


def test_command_line_has_the_fields_as_options(monkeypatch):
    seen = []
    monkeypatch.setattr(module, "sweep", lambda options, command, console: seen.append((options, command)))
    given = ["--env-id", SNAKEBOARD, "--gamma", "0.9", "0.99", "--hidden", "8,8", "--seeds", "0-2", "7", "--drag"]
    main(given)
    ((options, command),) = seen
    assert options.seeds == (0, 1, 2, 7)
    assert [varied for varied, _ in options.settings()] == [{"gamma": gamma, "hidden": (8, 8)} for gamma in (0.9, 0.99)]
    assert all(config.env_kwargs == {"drag": True} for _, config in options.settings())
    assert command == ["python", "-m", "training.sweep", *given]


def test_seeds_may_be_ranges():
    assert seeds(["0-3", "7"]) == (0, 1, 2, 3, 7)
    for wrong in ("3-1", "x", "-1", "1-"):
        with pytest.raises(ValueError, match="ranges such as 0-9"):
            seeds([wrong])
