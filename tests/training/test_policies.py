import dataclasses
import hashlib
import io
import json
import os
import pickle
import re
import struct
import subprocess
import sys
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from safetensors.numpy import save
from stable_baselines3 import PPO

import nhenv
from training import policies
from training.config import CONFIGS, EVALUATION_SEEDS, EvaluationConfig, PPOConfig, TaskConfig, for_env
from training.evaluate import Evaluate, load_policy, origin
from training.export import actor, chosen, command, export
from training.policies import Policy, PolicyError, load, pack, read
from training.rollout import PolicyController, make_envs, recorded, rollout
from training.store import read_json, write_json
from training.train import make_model, ppo_path, train_piece

ROOT = Path(__file__).parents[2]
SNAKEBOARD = "nhenv/SnakeboardForward-v0"
TINY = PPOConfig(
    env_kwargs={"torque_limits": 0.3}, timesteps=512, n_envs=4, n_steps=64, batch_size=64, n_epochs=2, hidden=(9, 5),
    curve_every=8, curve_episodes=1,
)  # fmt: skip
LAYERS = [(np.full((3, 2), 0.5), np.zeros(3)), (np.ones((1, 3)), np.array([0.1]))]


def card_of(content, **changes):
    card = {
        "format": policies.FORMAT, "env_id": SNAKEBOARD, "env_kwargs": {}, "observation": ["a", "b"],
        "network": {"activation": "tanh", "layers": [2, 3, 1]}, "sha256": hashlib.sha256(content).hexdigest(),
    }  # fmt: skip
    return card | changes


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("trained")
    train_piece(SNAKEBOARD, TINY, 1, out)
    return ppo_path(SNAKEBOARD, TINY, 1, out).with_suffix(".zip")


@pytest.fixture(scope="module")
def exported(trained, tmp_path_factory):
    config = TaskConfig(evaluation=EvaluationConfig(fine_substeps=2))  # of which other tests have the kernel too
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(CONFIGS, "Forward", config)
        return export(trained, tmp_path_factory.mktemp("exported"), episodes=4, why="the only one")


def observations_like(labels, count=2000):
    return np.random.default_rng(0).normal(0, 2, (count, len(labels))).astype(np.float32)


@pytest.mark.parametrize(
    "changes",
    [
        *({"activation": name} for name in policies.ACTIVATIONS),
        {"levels": 3},
        {"observation_scale": {"phi": 3.0, "speed": 0.5}},
    ],
    ids=str,
)
def test_it_acts_as_stable_baselines_does(changes, exported):
    model, policy = make_model(SNAKEBOARD, dataclasses.replace(TINY, **changes), 0), load(exported)
    with torch.no_grad():  # as decided as a policy is after a long training, and clipped now and then
        torch.manual_seed(0)
        torch.nn.init.normal_(model.policy.action_net.weight, std=0.5)
        for layer in model.policy.mlp_extractor.policy_net[::2]:  # whose biases are zero before any training
            torch.nn.init.normal_(layer.bias, std=0.5)
    network, layers = actor(PolicyController(model))
    policy = read(dict(policy.card, sha256=digest_of(model), network=network), pack(layers))
    observations = observations_like(policy.card["observation"])
    expected = model.predict(observations, deterministic=True)[0]
    assert 0.02 < (np.abs(expected) == 1).mean() < 0.95
    # What differs is the rounding of PyTorch's float32, which grows with the weights: with ten times these, 3e-6.
    np.testing.assert_allclose(policy(observations), expected, rtol=0, atol=1e-6)
    assert policy(observations).dtype == np.float32
    np.testing.assert_allclose(policy(observations[7]), expected[7], rtol=0, atol=1e-6)


def digest_of(model):
    return hashlib.sha256(pack(actor(PolicyController(model))[1])).hexdigest()


def test_preferred_levels_are_what_the_formula_says():
    layers = [(np.eye(2), np.zeros(2)), (np.array([[1, 0], [0, 1], [1, 1], [0, 0], [-1, 0], [0, -1.0]]), np.zeros(6))]
    content = pack(layers)
    policies_of = {
        levels: read(card_of(content, network={"activation": "tanh", "layers": [2, 2, 6], "levels": levels}), content)
        for levels in (2, 3)
    }
    # Of (1, 2) in units of the activation the outputs are 1, 2, 3, 0, -1, -2.
    assert policies_of[3]([0.1, 0.2]).tolist() == [1, -1]
    assert policies_of[2]([0.1, 0.2]).tolist() == [1, -1, -1]
    assert policies_of[3]([[-0.1, 0.2], [0.1, -0.3]]).tolist() == [[0, 0], [-1, 1]]
    assert policies_of[3](np.zeros((4, 3, 2))).shape == (4, 3, 2)
    assert policies_of[3]([0.1, 0.2]).dtype == np.float32


def test_it_drives_as_the_policy_it_was(trained, exported):
    envs = recorded(SNAKEBOARD, 3, torque_limits=0.3)
    ours, theirs = (rollout(load_policy(path), envs, range(3)) for path in (exported, trained))
    assert np.abs(theirs.q[:, -1] - theirs.q[:, 0]).max() > 1e-3
    # The roundings of float32 actions, in a motion that does not amplify them.
    np.testing.assert_allclose(ours.q, theirs.q, atol=1e-5)


def test_card_tells_what_the_file_does_and_how_it_came_about(trained, exported):
    card, policy = read_json(exported.with_suffix(".json")), load(exported)
    assert exported.name == "SnakeboardForward-v0-torque_limits-0.3.safetensors"
    assert (card["env_id"], card["env_kwargs"]) == (SNAKEBOARD, {"torque_limits": 0.3})
    assert card["observation"] == list(make_envs(SNAKEBOARD, 1).observation_labels)
    assert card["network"]["layers"] == [6, 9, 5, 2]
    assert card["training"]["settings"]["hidden"] == [9, 5]
    assert card["training"]["seed"] == 1
    assert card["training"]["command"] == f"python -m training.train --env-id {SNAKEBOARD} --seed 1 --timesteps 512"
    dragged = {"env_id": SNAKEBOARD, "seed": 2, "ppo": {"timesteps": 9, "env_kwargs": {"drag": True}}}
    assert command(dragged) == f"python -m training.train --env-id {SNAKEBOARD} --seed 2 --timesteps 9 --drag"
    racer = "nhenv/RollerRacerForward-v0"
    sprint = dataclasses.replace(for_env(racer, drag=True, sprint=True).ppo, timesteps=9)
    sprinted = json.loads(json.dumps({"env_id": racer, "seed": 2, "ppo": dataclasses.asdict(sprint)}))
    assert command(sprinted) == f"python -m training.train --env-id {racer} --seed 2 --timesteps 9 --drag --sprint"
    envs = recorded(SNAKEBOARD, 4, torque_limits=0.3)
    episodes = rollout(policy, envs, range(EVALUATION_SEEDS, EVALUATION_SEEDS + 4))
    assert card["evaluation"]["metrics"]["return"]["mean"] == pytest.approx(episodes.returns.mean(), rel=1e-12)
    fine, coarse = card["evaluation"]["finely_integrated"], card["evaluation"]["metrics"]
    assert fine["distance_m"]["mean"] == pytest.approx(coarse["distance_m"]["mean"], abs=1e-6)
    text = exported.with_suffix(".md").read_text(encoding="utf-8")
    for part in (SNAKEBOARD, "torque_limits=0.3", "the only one", card["training"]["command"], "| hidden | [9, 5] |"):
        assert part in text
    assert f"{coarse['distance_m']['estimate']:.2f} [" in text
    assert exported.stat().st_size < 2000


def test_evaluate_takes_either_file(trained, exported):
    assert origin(trained) == origin(exported) == (SNAKEBOARD, {"torque_limits": 0.3})
    assert Evaluate(exported).environment() == SNAKEBOARD
    assert Evaluate(exported, drag=True).env_kwargs() == {"torque_limits": 0.3, "drag": True}
    assert isinstance(load_policy(exported), Policy)


def test_another_environment_is_refused(exported):
    policy = load(exported)
    racer = make_envs("nhenv/RollerRacerForward-v0", 1).observation_labels
    with pytest.raises(ValueError, match="give it the environment that it learned in"):
        policy.require(racer)
    policy.require(make_envs(SNAKEBOARD, 1).observation_labels)
    with pytest.raises(ValueError, match=re.escape("must have shape (..., 6)")):
        policy(np.zeros(4))


def test_it_runs_from_numpy_alone(exported):
    program = f"""
import sys
import numpy as np
from training.policies import load

policy = load({str(exported)!r})
print(policy(np.zeros(6)).shape, *{{name.partition(".")[0] for name in sys.modules}})
"""
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    shape, *loaded = result.stdout.replace("(2,)", "2").split()
    assert shape == "2"
    heavy = {"torch", "stable_baselines3", "gymnasium", "numba", "sympy", "scipy", "nhenv", "mechanics", "tyro", "rich"}
    assert heavy.isdisjoint(loaded)
    assert {"numpy", "safetensors"} <= set(loaded)


class Trap:
    """Something that leaves a file behind when it is unpickled."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return Path.touch, (self.trace,)


def saved(trap, save):
    """What a function writes of it into a file, as bytes."""
    file = io.BytesIO()
    save(file, trap)
    return file.getvalue()


PICKLING = {
    "pickle": lambda file, trap: pickle.dump(trap, file),
    "torch": lambda file, trap: torch.save(trap, file),
    "numpy": lambda file, trap: np.save(file, np.array([trap], object)),
}
OPENING = {
    "pickle": pickle.load,
    "torch": lambda file: torch.load(file, weights_only=False),
    "numpy": lambda file: np.load(file, allow_pickle=True),
}


@pytest.mark.parametrize("kind", PICKLING)
def test_loading_executes_nothing(exported, tmp_path, kind):
    trace, path = tmp_path / "trace", tmp_path / exported.name
    trap = saved(Trap(trace), PICKLING[kind])
    OPENING[kind](io.BytesIO(trap))
    assert trace.exists()  # so does whoever opens it
    trace.unlink()
    beside, card = path.with_suffix(".json"), read_json(exported.with_suffix(".json"))
    path.write_bytes(trap)
    write_json(beside, card | {"sha256": hashlib.sha256(trap).hexdigest()})
    with pytest.raises(PolicyError, match="not in the format safetensors"):
        load(path)
    path.write_bytes(exported.read_bytes())
    beside.write_bytes(trap)
    with pytest.raises(PolicyError, match="is not JSON"):
        load(path)
    assert not trace.exists()


def test_shipped_policies_are_found_by_name(exported, monkeypatch):
    monkeypatch.setattr(policies, "SHIPPED", exported.parent)
    assert policies.shipped() == (exported.stem,)
    assert load(exported.stem).card["env_id"] == SNAKEBOARD
    with pytest.raises(FileNotFoundError, match=re.escape(exported.stem)):
        load("SnakeboardForward-v1")


@pytest.mark.parametrize("name", policies.shipped())
def test_shipped_policies_fit_their_environments(name):
    policy = load(name)
    assert policy.card["env_id"] in nhenv.environment_ids()
    envs = gym.make_vec(policy.card["env_id"], 1, **policy.card["env_kwargs"])
    policy.require(envs.observation_labels)
    assert (policies.SHIPPED / f"{name}.md").is_file()
    assert (policies.SHIPPED / f"{name}.safetensors").stat().st_size < 100_000


@pytest.mark.parametrize(
    ("activation", "above", "below"), [("tanh", np.tanh(0.1), np.tanh(-0.1)), ("leaky_relu", 0.1, -0.001)]
)
def test_layers_are_what_the_formula_says(activation, above, below):
    network = {"activation": activation, "layers": [2, 3, 1]}
    policy = read(card_of(pack(LAYERS), network=network), pack(LAYERS))
    # Three times the activation of (0.4 - 0.2)/2, plus 0.1.
    assert policy([0.4, -0.2]) == pytest.approx([3 * above + 0.1], rel=1e-6)
    assert policy([-0.4, 0.2]) == pytest.approx([3 * below + 0.1], rel=1e-6)
    assert policy([9, 9]) == 1.0
    assert policy(np.zeros((4, 3, 2))).shape == (4, 3, 1)


def tensors(**changes):
    named = {}
    for i, (weight, bias) in enumerate(LAYERS):
        named |= {f"layer{i}.weight": weight.astype(np.float32), f"layer{i}.bias": bias.astype(np.float32)}
    return {name: value for name, value in {**named, **changes}.items() if value is not None}


HOSTILE_WEIGHTS = {
    "are not in the format": b"",
    "are not in the format safetensors": pack(LAYERS)[:-3],
    "not in the format": struct.pack("<Q", 1 << 40) + b"{}",
    "not in the": struct.pack("<Q", 2**64 - 1) + b"{}",
    "in the format safetensors": struct.pack("<Q", 1 << 20) + b"{" * (1 << 20),
    "the format safetensors": b"PK\x03\x04" + bytes(500),
    "the card tells of tensors": save(tensors(**{"layer1.bias": None})),
    "the weights are": save(tensors(more=np.zeros(1, np.float32))),
    "layer0.weight must be float32 of shape (3, 2)": save(tensors(**{"layer0.weight": np.zeros((2, 3), np.float32)})),
    "layer1.bias must be float32": save(tensors(**{"layer1.bias": np.zeros(1)})),
    "layer0.bias has numbers that are not finite": save(
        tensors(**{"layer0.bias": np.array([0, np.nan, 0], np.float32)})
    ),
    "layer1.weight has numbers that are not finite": save(
        tensors(**{"layer1.weight": np.array([[0, np.inf, 0]], np.float32)})
    ),
}


@pytest.mark.parametrize("problem", HOSTILE_WEIGHTS)
def test_hostile_weights_are_refused_kindly(problem):
    content = HOSTILE_WEIGHTS[problem]
    with pytest.raises(PolicyError, match=re.escape(problem)):
        read(card_of(content), content)


HOSTILE_CARDS = {
    "a card is a JSON object, got list": [],
    "'format' must be a str": {"format": None},
    "reads 'nhenv policy 1'": {"format": "nhenv policy 2"},
    "'sha256' must be a str": {"sha256": 5},
    "'network' must be a dict": {"network": [2, 3, 1]},
    "must be one of ['leaky_relu', 'tanh'], got \"__import__('os')\"": {
        "network": {"activation": "__import__('os')", "layers": [2, 3, 1]}
    },
    "got ['tanh']": {"network": {"activation": ["tanh"], "layers": [2, 3, 1]}},
    "the sizes of 2 observations": {"network": {"activation": "tanh", "layers": [3, 3, 1]}},
    "got [2]": {"network": {"activation": "tanh", "layers": [2]}},
    "got [2, -3, 1]": {"network": {"activation": "tanh", "layers": [2, -3, 1]}},
    "got 7": {"network": {"activation": "tanh", "layers": 7}},
    "divides 1 outputs, got 2": {"network": {"activation": "tanh", "layers": [2, 3, 1], "levels": 2}},
    "a number above 1 that divides 1 outputs, got 1": {
        "network": {"activation": "tanh", "layers": [2, 3, 1], "levels": 1}
    },
    "outputs, got [3]": {"network": {"activation": "tanh", "layers": [2, 3, 1], "levels": [3]}},
    "damaged or was replaced": {"sha256": "0" * 64},
    "must be float32 of shape (1000000000, 2)": {"network": {"activation": "tanh", "layers": [2, 10**9, 1]}},
}


@pytest.mark.parametrize("problem", HOSTILE_CARDS)
def test_hostile_cards_are_refused_kindly(problem):
    changes, content = HOSTILE_CARDS[problem], pack(LAYERS)
    card = changes if isinstance(changes, list) else card_of(content, **changes)
    with pytest.raises(PolicyError, match=re.escape(problem)):
        read(card, content)


def test_damaged_bytes_never_do_worse_than_being_refused():
    content = pack(LAYERS)
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(2000):
        damaged = bytearray(content)
        for place in rng.integers(len(content), size=rng.integers(1, 4)):
            damaged[place] = rng.integers(256)
        damaged = bytes(damaged[: len(content) - int(rng.integers(3))])
        try:
            policy = read(card_of(damaged), damaged)
        except PolicyError:
            refused += 1
        else:
            assert np.isfinite(policy(np.ones(2))).all()
    assert refused > 500


def test_files_are_checked_before_they_are_read(tmp_path):
    path, content = tmp_path / "p.safetensors", pack(LAYERS)
    with pytest.raises(FileNotFoundError, match=r"there is no .*p\.safetensors"):
        load(path)
    path.write_bytes(content)
    with pytest.raises(FileNotFoundError, match=r"there is no .*p\.json"):
        load(path)
    beside = path.with_suffix(".json")
    for text, problem in (("{", "is not JSON"), ("[" * 100_000, "is not JSON"), ('{"format": 1}', "must be a str")):
        beside.write_text(text)
        with pytest.raises(PolicyError, match=problem):
            load(path)
    os.truncate(beside, policies.LARGEST_CARD + 1)
    with pytest.raises(PolicyError, match="no policy has more"):
        load(path)
    beside.write_text(json.dumps(card_of(content)))
    assert load(path)([0.0, 0.0]) == pytest.approx([0.1])
    os.truncate(path, policies.LARGEST_WEIGHTS + 1)  # sparse: it takes no room on the disk
    with pytest.raises(PolicyError, match="no policy has more"):
        load(path)


def test_missing_library_is_named_with_its_extra(monkeypatch):
    content = pack(LAYERS)
    monkeypatch.setitem(sys.modules, "safetensors.numpy", None)
    with pytest.raises(ImportError, match=re.escape('pip install "nhenv[policies]"')):
        read(card_of(content), content)


@pytest.mark.parametrize(
    "other",
    [
        {"activation_fn": torch.nn.SiLU},
        {"activation_fn": partial(torch.nn.LeakyReLU, 0.2)},
        {"squash_output": True, "use_sde": True},
    ],
)
def test_other_networks_are_not_exported(other):
    use_sde = other.get("use_sde", False)
    kwargs = {name: value for name, value in other.items() if name != "use_sde"}
    envs = make_model(SNAKEBOARD, TINY, 0).get_env()
    model = PPO("MlpPolicy", envs, policy_kwargs={"activation_fn": torch.nn.Tanh, **kwargs}, use_sde=use_sde)
    with pytest.raises(ValueError, match="only networks of linear layers with one of"):
        actor(PolicyController(model))


def test_policies_of_another_mechanism_are_not_exported(trained, tmp_path):
    path = tmp_path / trained.name
    path.write_bytes(trained.read_bytes())
    with pytest.raises(ValueError, match=r"its \.json file beside it"):
        export(path, tmp_path)
    history = read_json(trained.with_suffix(".json"))
    history["settings"]["mechanism"]["parameters"]["m"] = 7.0
    write_json(path.with_suffix(".json"), history)
    with pytest.raises(ValueError, match="learned with another mechanism"):
        export(path, tmp_path)


def test_the_median_seed_of_a_comparison_is_chosen(tmp_path):
    distances = {0: 3.0, 1: 9.0, 2: 5.0, 3: 4.0}
    runs = [
        {"seed": seed, "distance_m": {"estimate": distance}, "file": f"SnakeboardForward-v0/ppo-seed{seed}.json"}
        for seed, distance in distances.items()
    ]
    write_json(tmp_path / "results.json", {"environments": {SNAKEBOARD: {"headline": "distance_m", "ppo": runs}}})
    ((path, why),) = chosen(tmp_path)
    assert path == tmp_path / "SnakeboardForward-v0" / "ppo-seed3.zip"
    assert why == "the median of 4 seeds by distance (m)"
    with pytest.raises(ValueError, match="finished training.compare"):
        list(chosen(tmp_path / "nothing"))
