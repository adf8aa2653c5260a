import dataclasses
import itertools

import numpy as np
import pytest
import torch
from torch.distributions import Categorical

from training.config import PPOConfig
from training.evaluate import load_policy
from training.levels import LevelPolicy
from training.progress import Interrupted
from training.store import read_json
from training.train import make_model, ppo_path, train_piece

SNAKEBOARD = "nhenv/SnakeboardForward-v0"
TINY = PPOConfig(
    timesteps=512, n_envs=4, n_steps=64, batch_size=64, n_epochs=2, hidden=(9, 5), curve_every=8, curve_episodes=1,
    levels=5,
)  # fmt: skip
VALUES = [-1.0, -0.5, 0.0, 0.5, 1.0]


@pytest.fixture
def model():
    """One whose choices are decided, but not all alike."""
    made = make_model(SNAKEBOARD, TINY, 0)
    with torch.no_grad():
        torch.nn.init.normal_(made.policy.action_net.weight, std=0.5)
    return made


def observations(count):
    return torch.tensor(np.random.default_rng(0).normal(0, 2, (count, 7)), dtype=torch.float32)


def strangers(policy, shown):
    """PyTorch's own distribution over the indices of the values, of each action."""
    logits = policy.action_net(policy.mlp_extractor.forward_actor(shown))
    return Categorical(logits=logits.reshape(len(shown), 2, 5))


def parameters(model):
    return torch.cat([value.flatten() for value in model.policy.parameters()])


def test_probabilities_are_those_of_a_stranger(model):
    shown = observations(200)
    theirs = strangers(model.policy, shown)
    indices = theirs.sample()
    values, log_prob, entropy = model.policy.evaluate_actions(shown, torch.tensor(VALUES)[indices])
    # Of float32, over probabilities down to e^-20.
    torch.testing.assert_close(log_prob, theirs.log_prob(indices).sum(1), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(entropy, theirs.entropy().sum(1), rtol=1e-5, atol=1e-5)
    assert values.shape == (200, 1)


def test_probabilities_of_all_actions_add_up_to_one(model):
    shown = observations(3)
    total = torch.zeros(3)
    for pair in itertools.product(VALUES, repeat=2):
        total += model.policy.evaluate_actions(shown, torch.tensor([pair] * 3))[1].exp()
    torch.testing.assert_close(total, torch.ones(3), rtol=1e-5, atol=1e-5)


def test_gradients_are_those_of_a_stranger(model):
    policy, shown = model.policy, observations(50)
    indices = strangers(policy, shown).sample()
    _, log_prob, entropy = policy.evaluate_actions(shown, torch.tensor(VALUES)[indices])
    (log_prob + 0.1 * entropy).sum().backward()
    ours = policy.action_net.weight.grad.clone()
    policy.zero_grad()
    theirs = strangers(policy, shown)
    (theirs.log_prob(indices).sum(1) + 0.1 * theirs.entropy().sum(1)).sum().backward()
    torch.testing.assert_close(ours, policy.action_net.weight.grad, rtol=1e-4, atol=1e-4)


def test_actions_are_drawn_with_their_probabilities(model):
    torch.manual_seed(1)
    shown, count = observations(1).expand(100_000, 7), 100_000
    actions, _, log_prob = model.policy(shown)
    assert set(actions.flatten().tolist()) <= set(VALUES)
    expected = strangers(model.policy, shown[:1]).probs[0]
    for action, probabilities in zip(actions.T, expected, strict=True):
        drawn = torch.stack([(action == value).float().mean() for value in VALUES])
        # Four standard deviations of a mean of so many.
        assert (drawn - probabilities).abs().max() < 4 * 0.5 / count**0.5
    torch.testing.assert_close(log_prob, model.policy.evaluate_actions(shown, actions)[1])


def test_the_deterministic_action_is_the_most_probable(model):
    shown = observations(200)
    best = torch.tensor(VALUES)[strangers(model.policy, shown).probs.argmax(-1)].numpy()
    assert np.array_equal(model.predict(shown[:, :-1].numpy(), deterministic=True)[0], best)
    assert np.array_equal(model.predict(shown[0, :-1].numpy(), deterministic=True)[0], best[0])
    assert len(np.unique(best)) == 5


def test_a_policy_that_is_read_back_chooses_the_same(tmp_path):
    train_piece(SNAKEBOARD, TINY, 0, tmp_path)
    path = ppo_path(SNAKEBOARD, TINY, 0, tmp_path)
    assert read_json(path)["settings"]["ppo"]["levels"] == 5
    trained = load_policy(path.with_suffix(".zip"))
    shown = observations(50)[:, :-1].numpy()
    chosen = trained(shown)
    assert set(chosen.flatten().tolist()) <= set(VALUES)
    trained.model.policy.save(tmp_path / "policy.pt")
    again = LevelPolicy.load(tmp_path / "policy.pt")
    assert np.array_equal(again.predict(shown, deterministic=True)[0], chosen)


def test_interrupted_run_ends_as_if_it_had_not_been(tmp_path):
    config = dataclasses.replace(TINY, observation_scale={"phi": 3.0})

    def interrupt(done, total, text):
        if done == 256:
            raise Interrupted

    with pytest.raises(Interrupted):
        train_piece(SNAKEBOARD, config, 0, tmp_path / "interrupted", interrupt)
    for folder in ("interrupted", "whole"):
        train_piece(SNAKEBOARD, config, 0, tmp_path / folder)
    ends = [
        parameters(load_policy(ppo_path(SNAKEBOARD, config, 0, tmp_path / folder).with_suffix(".zip")).model)
        for folder in ("interrupted", "whole")
    ]
    assert torch.equal(*ends)
    assert not torch.equal(ends[0], parameters(make_model(SNAKEBOARD, config, 0)))


@pytest.mark.parametrize("levels", [1, -3])
def test_impossible_levels_are_refused(levels):
    with pytest.raises(ValueError, match=f"levels must be 0 or at least 2, got {levels}"):
        dataclasses.replace(TINY, levels=levels)
