"""What a file holds of a gait or a policy drives as it was made to."""

import numpy as np
import pytest

from training.actors import actor, actors_of
from training.config import EVALUATION_SEEDS
from training.film import record
from training.policies import SHIPPED, SUFFIX, load, shipped
from training.store import write_json

RACER, GOAL = "nhenv/RollerRacerForward-v0", "nhenv/RollerRacerGoal-v0"


def piece(path, env_id=RACER, **settings):
    write_json(path, {"settings": {"env_id": env_id, **settings}, "result": {"vector": [0.6, 0.0, 8.0, 6.0]}})
    return path


GAIT = {"env_kwargs": {}, "steered": False}


def test_a_gait_is_an_actor(tmp_path):
    one = actor(piece(tmp_path / "gait-0.json", gait=GAIT))
    assert (one.label, one.env_id, one.env_kwargs) == ("sinusoid", RACER, {})
    take = record(one, EVALUATION_SEEDS, backend="numpy", max_episode_steps=5)
    assert np.isfinite(take.q).all()
    assert np.ptp(take.q[:, 3]) > 0.01
    assert actor(piece(tmp_path / "gait-1.json", gait=GAIT | {"steered": True})).label == "steered sinusoid"
    assert actor(tmp_path / "gait-1.json", "the best").label == "the best"


def test_a_policy_is_an_actor(tmp_path):
    (tmp_path / "ppo-seed3.zip").touch()
    piece(tmp_path / "ppo-seed3.json", ppo={"env_kwargs": {"drag": True}}, seed=3)
    one = actor(tmp_path / "ppo-seed3.zip")
    assert (one.label, one.env_kwargs) == ("PPO, seed 3", {"drag": True})


def test_a_shipped_policy_is_an_actor():
    policy = load(shipped()[0])
    one = actor(SHIPPED / f"{shipped()[0]}{SUFFIX}")
    assert (one.env_id, one.env_kwargs) == (policy.card["env_id"], policy.card["env_kwargs"])
    seen = np.ones(len(policy.card["observation"]), np.float32)
    assert np.array_equal(one.make(None)(seen), policy(seen))


def test_who_does_not_go_together(tmp_path):
    gait = piece(tmp_path / "gait-0.json", gait=GAIT)
    other = piece(tmp_path / "gait-1.json", env_id=GOAL, gait=GAIT)
    dragged = piece(tmp_path / "gait-2.json", gait=GAIT | {"env_kwargs": {"drag": True}})
    for pieces, reason in (
        ((gait, other), f"not of {RACER} and {GOAL}"),
        ((gait, dragged), r"sinusoid was made for {}, sinusoid for {'drag': True}: .* if --drag says in which"),
        ((tmp_path / "none.zip",), "there is no .*none.zip; training.compare writes"),
    ):
        with pytest.raises(ValueError, match=reason):
            actors_of(pieces, ())
    assert [one.label for one in actors_of((gait, dragged), ("a",), same_arguments=False)] == ["a", "sinusoid"]
    with pytest.raises(ValueError, match="neither kind that can drive: gait, ppo"):
        actor(piece(tmp_path / "sweep.json", sweep={}))
