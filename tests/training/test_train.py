import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium.error import DependencyNotInstalled

from mechanics.compiler import kernels
from training.config import TUNING_SEEDS, PPOConfig
from training.evaluate import load_policy
from training.progress import Interrupted, ignore
from training.rollout import make_envs, rollout
from training.store import read_json
from training.train import Linear, Run, Train, make_model, ppo_path, train_piece

SNAKEBOARD = "nhenv/SnakeboardForward-v0"
TINY = PPOConfig(
    timesteps=1280, n_envs=4, n_steps=32, batch_size=64, n_epochs=2, curve_every=2, curve_episodes=1,
    checkpoint_every=3, reward_scale=0.1, start_energy=10.0,
)  # fmt: skip


def parameters(out, seed=0):
    policy = load_policy(ppo_path(SNAKEBOARD, TINY, seed, out).with_suffix(".zip")).model
    return torch.cat([value.flatten() for value in policy.policy.parameters()]).detach().numpy()


def curve(out):
    points = read_json(ppo_path(SNAKEBOARD, TINY, 0, out))["result"]["curve"]
    return [{name: value for name, value in point.items() if name != "cpu_s"} for point in points]


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    out = tmp_path_factory.mktemp("uninterrupted")
    train_piece(SNAKEBOARD, TINY, 0, out)
    return out


# Interrupted saves before it ends; a process that dies leaves the last checkpoint, of three updates.
@pytest.mark.parametrize("end", [Interrupted, MemoryError])
@pytest.mark.parametrize("updates", [2, 5])
def test_interrupted_run_ends_as_if_it_had_not_been(tmp_path, uninterrupted, end, updates):
    heard = []

    def interrupt(done, total, text):
        heard.append(done)
        if done == updates * 128:
            raise end

    def listen(done, total, text):
        heard.append(done)

    with pytest.raises(end):
        train_piece(SNAKEBOARD, TINY, 0, tmp_path, interrupt)
    path = ppo_path(SNAKEBOARD, TINY, 0, tmp_path)
    assert not path.exists()
    heard.clear()
    np.random.seed(1)  # noqa: NPY002 (a fresh process has other random states)
    torch.manual_seed(1)
    train_piece(SNAKEBOARD, TINY, 0, tmp_path, listen)
    assert heard[0] == 128 * (updates if end is Interrupted else updates - updates % 3)
    np.testing.assert_array_equal(parameters(tmp_path), parameters(uninterrupted))
    assert curve(tmp_path) == curve(uninterrupted)
    assert not path.with_suffix(".checkpoint").exists()


def test_finished_run_is_not_done_again(uninterrupted):
    before = {path: os.stat(path).st_mtime_ns for path in uninterrupted.rglob("*")}
    train_piece(SNAKEBOARD, TINY, 0, uninterrupted, lambda *message: pytest.fail("it trains again"))
    assert {path: os.stat(path).st_mtime_ns for path in uninterrupted.rglob("*")} == before


def test_history_says_how_the_policy_came_about(uninterrupted):
    written = read_json(ppo_path(SNAKEBOARD, TINY, 0, uninterrupted))
    assert written["settings"]["ppo"] == {
        name: list(value) if isinstance(value, tuple) else value for name, value in dataclasses.asdict(TINY).items()
    }
    assert written["settings"]["seed"] == 0
    assert written["result"]["steps"] == TINY.timesteps
    assert [point["steps"] for point in written["result"]["curve"]] == [0, 256, 512, 768, 1024, 1280]
    assert (
        written["result"]["best_steps"] == max(written["result"]["curve"], key=lambda point: point["return"])["steps"]
    )
    assert written["result"]["versions"].keys() >= {"torch", "stable_baselines3", "numpy"}


def test_the_best_policy_of_the_curve_is_kept(uninterrupted):
    """It has the return of that point again, on the same starts."""
    path = ppo_path(SNAKEBOARD, TINY, 0, uninterrupted)
    best = max(read_json(path)["result"]["curve"], key=lambda point: point["return"])
    assert best["steps"] not in (0, TINY.timesteps)  # or this test shows less than it says
    envs = make_envs(SNAKEBOARD, TINY.curve_episodes, whole_state=True)
    again = rollout(load_policy(path.with_suffix(".zip")), envs, [TUNING_SEEDS])
    assert again.returns.mean() == best["return"]


def test_curve_has_every_metric_of_the_task(uninterrupted):
    for point in read_json(ppo_path(SNAKEBOARD, TINY, 0, uninterrupted))["result"]["curve"]:
        assert point.keys() == {"steps", "cpu_s", "distance_m", "return", "energy_j", "cost_of_transport"}


def test_tensorboard_sees_the_run_and_changes_nothing(tmp_path, uninterrupted):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train_piece(SNAKEBOARD, TINY, 0, tmp_path / "out", tensorboard=tmp_path / "board")
    np.testing.assert_array_equal(parameters(tmp_path / "out"), parameters(uninterrupted))
    (file,) = (tmp_path / "board").rglob("events.out.tfevents.*")
    path = ppo_path(SNAKEBOARD, TINY, 0, tmp_path)
    assert file.parent == tmp_path / "board" / "SnakeboardForward-v0" / path.stem
    events = EventAccumulator(str(file.parent)).Reload()
    assert len(events.Scalars("train/loss")) == TINY.timesteps // 128  # of every update, the last one included
    drawn = [event.value for event in events.Scalars("curve/distance_m")]
    np.testing.assert_allclose(drawn, [point["distance_m"] for point in curve(tmp_path / "out")], rtol=1e-6)  # float32


def test_missing_tensorboard_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(DependencyNotInstalled, match=re.escape('pip install "nhenv[tensorboard]"')):
        Train(env_id=SNAKEBOARD, tensorboard=tmp_path)
    assert Train(env_id=SNAKEBOARD).tensorboard is None


def test_a_sprint_is_refused_where_there_is_none():
    with pytest.raises(ValueError, match="leave --sprint out"):
        Train(env_id=SNAKEBOARD, sprint=True)


def test_settings_reach_the_algorithm():
    # None of these is a default of Stable-Baselines3.
    config = PPOConfig(
        n_envs=2, n_steps=8, batch_size=4, n_epochs=3, learning_rate=(4e-3, 2e-3), gamma=0.9, gae_lambda=0.8,
        clip_range=0.3, target_kl=0.07, entropy=(0.01, 0.0), log_std=-0.5, hidden=(16, 8), activation="leaky_relu",
        reward_scale=0.25, start_energy=7.0, start_share=0.5, timesteps=6000,
    )  # fmt: skip
    model = make_model(SNAKEBOARD, config, 3)
    assert model.seed == 3000
    assert (model.n_envs, model.n_steps, model.batch_size, model.n_epochs) == (2, 8, 4, 3)
    assert (model.gamma, model.gae_lambda, model.clip_range(1.0), model.target_kl) == (0.9, 0.8, 0.3, 0.07)
    assert model.ent_coef == 0.01
    assert model.env.venv.factor == 0.25
    assert (model.env.venv.venv.energy, model.env.venv.venv.steps) == (7.0, 3000)
    assert [model.lr_schedule(remaining) for remaining in (1.0, 0.5, 0.0)] == pytest.approx([4e-3, 3e-3, 2e-3])
    assert model.policy.log_std.tolist() == [-0.5, -0.5]
    for net in (model.policy.mlp_extractor.policy_net, model.policy.mlp_extractor.value_net):
        assert [type(layer) for layer in net] == [torch.nn.Linear, torch.nn.LeakyReLU] * 2
        assert [layer.out_features for layer in net[::2]] == [16, 8]


def test_the_value_function_sees_the_time_and_the_policy_does_not():
    model = make_model(SNAKEBOARD, TINY, 0)
    shown = torch.tensor(model.env.reset())
    assert shown.shape[1] == 7
    later = shown.clone()
    later[:, -1] += 0.5
    values, means = zip(
        *((model.policy.predict_values(x), model.policy.get_distribution(x).distribution.mean) for x in (shown, later)),
        strict=True,
    )
    assert (values[0] != values[1]).all()
    assert torch.equal(*means)
    # It drives environments without a clock, too.
    with_time, without = (model.predict(x.numpy(), deterministic=True)[0] for x in (shown, shown[:, :-1]))
    assert np.array_equal(with_time, without)
    assert model.predict(shown[0, :-1].numpy(), deterministic=True)[0].shape == (2,)


def test_networks_see_scaled_observations():
    scaled = dataclasses.replace(TINY, observation_scale={"phi_dot": 4.0, "psi_dot": 0.5})
    models = [make_model(SNAKEBOARD, config, 0).policy for config in (scaled, TINY)]
    models[1].load_state_dict({name: value for name, value in models[0].state_dict().items() if "factors" not in name})
    shown = torch.tensor(np.random.default_rng(0).normal(size=(50, 7)), dtype=torch.float32)
    factors = torch.tensor([1.0, 4.0, 0.5, 1.0, 1.0, 1.0, 1.0])  # phi, phi_dot, psi_dot, speed, heading, time
    for ours, theirs in zip(models[0](shown, True), models[1](shown * factors, True), strict=True):
        assert torch.equal(ours, theirs)
    assert not torch.equal(models[0](shown, True)[0], models[1](shown, True)[0])


def test_a_misspelt_observation_is_answered_with_what_was_meant():
    config = dataclasses.replace(TINY, observation_scale={"phi_dott": 4.0})
    with pytest.raises(ValueError, match="observation_scale: unknown observation 'phi_dott'.* Did you mean 'phi_dot'"):
        make_model(SNAKEBOARD, config, 0)


def test_entropy_falls_from_its_first_value_to_its_last(tmp_path):
    config = dataclasses.replace(TINY, entropy=(0.4, 0.2))
    heard = []

    class Heard(Run):
        def _on_rollout_start(self):
            super()._on_rollout_start()
            heard.append(self.model.ent_coef)

    model = make_model(SNAKEBOARD, config, 0)
    model.learn(config.timesteps, callback=Heard(SNAKEBOARD, config, tmp_path / "checkpoint", ignore))
    steps = np.arange(len(heard)) * config.n_envs * config.n_steps
    assert len(heard) > 3
    assert heard == pytest.approx(0.4 - 0.2 * steps / config.timesteps)


def test_it_learns_in_the_environment_that_is_asked_for(tmp_path):
    config = dataclasses.replace(TINY, env_kwargs={"torque_limits": 0.25})
    (limits,) = make_model(SNAKEBOARD, config, 0).get_env().get_attr("torque_limits", 0)
    assert limits.tolist() == [0.25, 0.25]
    assert Run(SNAKEBOARD, config, tmp_path, ignore)._envs.torque_limits[0].tolist() == [0.25, 0.25]


def test_linear_schedule():
    assert [Linear(4.0, 2.0)(remaining) for remaining in (1, 0.5, 0)] == [4.0, 3.0, 2.0]


def test_first_episodes_end_out_of_phase_and_later_ones_do_not():
    count = TINY.n_envs
    envs = make_model(SNAKEBOARD, TINY, 0).get_env()
    envs.reset()
    ends = [[] for _ in range(count)]
    for step in range(1, 601):
        _, _, dones, infos = envs.step(np.zeros((count, 2), np.float32))
        for i in np.flatnonzero(dones):
            ends[i].append(step)
    first = [times[0] for times in ends]
    assert len(set(first)) == count
    assert all(1 <= time <= 300 for time in first)
    assert all(times[1] - times[0] == 300 for times in ends)


def compiled():
    """What is loaded of generated code, and how often each of its functions was compiled."""
    functions = ((key, name, f) for key, module in kernels._loaded.items() for name, f in vars(module).items())
    return {(key, name): len(getattr(f, "signatures", ())) for key, name, f in functions if callable(f)}


def test_nothing_is_derived_or_compiled_once_the_clock_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "_loaded", {})  # as in a process that has only begun
    seen = []
    monkeypatch.setattr("training.train.make_model", lambda *given: seen.append(compiled()) or make_model(*given))
    train_piece(SNAKEBOARD, dataclasses.replace(TINY, timesteps=128), 0, tmp_path)
    (before,) = seen
    assert sum(before.values()) > 0
    assert compiled() == before


def test_seconds_of_a_run_do_not_count_compilation(tmp_path, monkeypatch):
    order = []
    monkeypatch.setattr("training.train._compile", lambda *arguments: order.append("compiled"))
    monkeypatch.setattr("training.train._clocks", lambda: order.append("looked at the clock") or {})
    Run(SNAKEBOARD, TINY, tmp_path, ignore)
    assert order == ["compiled", "looked at the clock"]


PROGRAM = """
import sys
from pathlib import Path
from training.config import PPOConfig
from training.progress import ignore
from training.train import Run, make_model

config = PPOConfig(n_envs=1, n_steps=8, batch_size=8, curve_episodes=1)
Run("nhenv/SnakeboardForward-v0", config, Path("none"), ignore)
before = set(sys.modules)
make_model("nhenv/SnakeboardForward-v0", config, 0)
print(len(set(sys.modules) - before))
"""


def test_the_clock_of_a_run_starts_when_all_modules_are_imported():
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True
    )
    assert int(result.stdout) < 10  # of some hundred that the first optimizer imports
