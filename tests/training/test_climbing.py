import itertools

import numpy as np
import pytest

from training import climbing
from training.climbing import ANGLE, TRIALS, WINDOW, best_change, climb, pressed
from training.config import COMPARED
from training.shooting import Shooting

SNAKEBOARD, RACER = COMPARED


@pytest.fixture(scope="module")
def board():
    return Shooting(SNAKEBOARD, trials=TRIALS)


def swinging(shape):
    """Rotor and steering in antiphase, which drives the snakeboard forwards."""
    turned = 0.3 * np.arange(shape[0])
    return 0.5 * np.stack([-np.sin(turned), np.cos(turned)], axis=1)


def test_small_changes_gain_what_they_promise(board):
    actions = swinging(board.shape)
    states, linear = board.linear(actions)
    change, promised = best_change(board, states, linear, actions, 1e-4)
    assert promised > 1e-4
    # What is left is of second order in changes of 1e-4, over an episode that magnifies them.
    assert board.distance(actions + change) - board.distance(actions) == pytest.approx(promised, rel=0.05)


def test_changes_stay_within_the_trust_region_and_the_limits(board):
    actions = np.clip(3 * swinging(board.shape), -1, 1)
    states, linear = board.linear(actions)
    radius = 1e-3
    change, _ = best_change(board, states, linear, actions, radius)
    assert np.abs(change).max() <= radius * (1 + 1e-6)
    assert np.abs(actions + change).max() <= 1 + 1e-9
    moved = board.states(actions + change) - states
    # In the linear picture ANGLE * radius at most; the rest is of second order.
    assert np.abs(moved[:, board.heading]).max() < 1.2 * ANGLE * radius
    assert np.abs(change).max() > 0.9 * radius


def test_no_change_of_a_linear_program_beats_it(board):
    actions = swinging(board.shape)
    states, linear = board.linear(actions)
    _, promised = best_change(board, states, linear, actions, 1e-4)
    gradient = linear.gradient()
    # Without the trust region of the angles, the best change is the sign of the gradient.
    assert promised <= 1e-4 * np.abs(gradient).sum() * (1 + 1e-6)
    assert promised > 0.01 * 1e-4 * np.abs(gradient).sum()


def test_climbs_never_lose(board):
    heard = []
    start = swinging(board.shape)
    distance, actions = climb(board, start, 6, heard=heard.append)
    assert heard == sorted(heard)
    assert distance == heard[-1] == board.distance(actions)
    assert distance > board.distance(start) + 1
    assert np.abs(actions).max() <= 1


def test_a_small_step_gains_what_its_linear_program_promises(board, monkeypatch):
    monkeypatch.setattr(climbing, "FIRST_RADIUS", 1e-4)
    start = swinging(board.shape)
    _, promised = best_change(board, *board.linear(start), start, 1e-4)
    distance, _ = climb(board, start, 1)
    assert distance - board.distance(start) == pytest.approx(promised, rel=0.05)


def test_what_gains_nothing_is_not_done(board, monkeypatch):
    monkeypatch.setattr(board, "distances", lambda trials: np.full(len(trials), -100.0))
    start = swinging(board.shape)
    heard = []
    distance, actions = climb(board, start, 60, heard=heard.append)
    np.testing.assert_array_equal(actions, start)
    assert distance == board.distance(start)
    # The trust region shrinks to a 64th each time, from 0.3 to less than 1e-5.
    assert len(heard) == 3


def test_a_climb_ends_where_little_is_gained(board, monkeypatch):
    reached = itertools.count(0.0, 1e-4)
    monkeypatch.setattr(board, "distances", lambda trials: np.full(len(trials), 1.0))
    monkeypatch.setattr(board, "distance", lambda actions: next(reached))
    heard = []
    climb(board, swinging(board.shape), 60, heard=heard.append)
    assert len(heard) == WINDOW


def test_joints_that_rest_on_their_stops_are_pressed_there(board):
    actions = np.zeros(board.shape)
    actions[:40, 1] = 0.1  # the steering reaches its stop within these 2 s
    actions[40:60, 1] = 1e-3
    actions[:, 0] = 0.2
    harder = pressed(board, actions)
    assert (harder[:, 0] == actions[:, 0]).all()
    assert (harder[40:59, 1] == 1).all()
    assert harder[0, 1] == 0.1
    np.testing.assert_allclose(board.states(harder), board.states(actions), rtol=0, atol=1e-8)


def test_a_climb_begins_within_the_limits_and_pressed(board):
    actions = np.zeros(board.shape)
    actions[:, 0] = -5
    actions[:60, 1] = 0.1
    _, begun = climb(board, actions, 0)
    assert (begun[:, 0] == -1).all()
    assert (begun[50:59, 1] == 1).all()


def test_what_a_climb_has_loosened_is_pressed_again(board, monkeypatch):
    actions = np.zeros(board.shape)
    actions[:40, 1] = 0.1
    actions[40:60, 1] = 1.0
    loosened = np.zeros(board.shape)
    loosened[45:55, 1] = -0.5
    monkeypatch.setattr(climbing, "best_change", lambda *given: (loosened, 0.0))
    monkeypatch.setattr(board, "distances", lambda trials: np.full(len(trials), 100.0))
    _, climbed = climb(board, actions, 1)
    assert (climbed[45:55, 1] == 1).all()


def test_mirrored_actions_are_pressed_to_the_other_stop(board):
    actions = np.zeros(board.shape)
    actions[:60, 1] = -0.1
    assert (pressed(board, actions)[50:59, 1] == -1).all()
