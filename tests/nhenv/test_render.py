"""Pictures: what they show is where things are, and drawing changes nothing but pictures."""

import dataclasses
import os
import pickle
import subprocess
import sys
import time
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import mechanics
import nhenv
from mechanics import Mechanism
from mechanics.placing import place
from nhenv import canvas
from nhenv.canvas import Canvas
from nhenv.compiled import CompiledScene
from nhenv.render import COLOURS, GROUND, TRAIL_PARTS, View, marker_of
from nhenv.tasks import Task

ROOT = Path(__file__).parents[2]
RACER, GOAL = "nhenv/RollerRacerForward-v0", "nhenv/RollerRacerGoal-v0"
SIZE = (320, 200)
# Nothing is compiled for pictures: what they show does not depend on it.
DRAWN = {"render_mode": "rgb_array", "render_size": SIZE, "backend": "numpy"}
MECHANISMS = mechanics.names(in_the_plane=True)
every_mechanism = pytest.mark.parametrize("name", MECHANISMS)


class Notes:
    """Stands in for a canvas and notes what is drawn on it."""

    def __init__(self, width=SIZE[0], height=SIZE[1]):
        self.width, self.height = width, height
        self.middle = np.array([width, height]) / 2
        self.clear(None)

    def clear(self, colour):
        self.polygons, self.lines, self.discs, self.words = [], [], [], []

    def polygon(self, corners, colour):
        self.polygons.append((np.array(corners), colour))

    def line(self, points, width, colour):
        self.lines.append((np.array(points), colour))

    def disc(self, middle, radius, colour):
        self.discs.append((np.array(middle), colour))

    def text(self, words, x, y, size, colour, anchor="topleft", plate=None):
        self.words.append(words)


def painted(view):
    notes = Notes()
    view.paint(notes)
    return notes


def picture(view, size=SIZE):
    drawn = Canvas(*size)
    view.paint(drawn)
    return drawn.pixels()


def view_of(name, q=None, **marker):
    mechanism = mechanics.get(name)
    view = View(mechanism, mechanism.parameters, 0.05, name)
    view.begin(np.zeros(mechanism.n) if q is None else q, marker)
    return view


def random_q(mechanism, seed=0):
    return np.random.default_rng(seed).uniform(0.1, 0.5, mechanism.n)


# -- views --------------------------------------------------------------------------------------


@every_mechanism
def test_every_mechanism_draws(name):
    view = view_of(name, random_q(mechanics.get(name)))
    pixels = picture(view)
    assert pixels.shape == (SIZE[1], SIZE[0], 3)
    assert pixels.dtype == np.uint8
    bodies = place(view.mechanism, view.q)
    seen = {COLOURS["black" if b.body.shape in ("wheel", "axle") else b.body.colour] for b in bodies}
    colours, counts = np.unique(pixels.reshape(-1, 3), axis=0, return_counts=True)
    area = dict(zip(map(tuple, colours.tolist()), counts.tolist(), strict=True))
    for colour in seen:
        assert area.get(colour, 0) > 15, colour
    assert area[GROUND] > 0.6 * SIZE[0] * SIZE[1]
    mechanism_area = sum(area.get(colour, 0) for colour in seen)
    assert mechanism_area > 0.005 * SIZE[0] * SIZE[1]  # large enough to see what it does


@every_mechanism
def test_a_picture_changes_with_every_coordinate(name):
    mechanism = mechanics.get(name)
    q = random_q(mechanism)
    before = picture(view_of(name, q))
    for i, coordinate in enumerate(mechanism.coordinates):
        view = view_of(name, q)
        view.follow(q + 0.3 * np.eye(mechanism.n)[i])
        words = np.zeros_like(before, bool)
        words[:45] = True  # the upper corner, where the time stands
        assert (picture(view) != before)[~words].sum() > 100, coordinate


@every_mechanism
def test_a_view_goes_with_its_mechanism(name):
    """Moved and turned from the beginning, it looks moved and turned: about the middle, where the camera is."""
    mechanism = mechanics.get(name)
    q = random_q(mechanism)
    turn, (dx, dy) = 0.7, (30.0, -20.0)
    moved = q.copy()
    moved[:2] = [dx, dy]
    moved[[i for i, c in enumerate(mechanism.coordinates) if c.startswith("theta")]] += turn
    before, after = painted(view_of(name, q)), painted(view_of(name, moved))
    # The axis y of a picture points down.
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    assert len(before.polygons) == len(after.polygons) >= len(mechanism.bodies)
    for (old, colour), (new, same) in zip(before.polygons, after.polygons, strict=True):
        assert colour == same
        # A pixel is some 2 mm; roundings of 30 m are 4e-15 m.
        expected = (old - before.middle) @ rotation.T + before.middle
        np.testing.assert_allclose(new, expected, rtol=0, atol=1e-9)


def test_a_camera_follows():
    """What moves evenly is in the middle, whatever its speed, and what swings is not what the camera follows."""
    view = view_of("snakeboard")
    for k in range(1, 301):
        view.follow([0.15 * k, 0.3 * np.sin(0.5 * k), 0, 0, 0])  # 3 m/s, 10 rad/s
    scale = view._projection(Notes()).scale  # pixels a metre
    middles = []
    for k in range(301, 364):  # five swings
        view.follow([0.15 * k, 0.3 * np.sin(0.5 * k), 0, 0, 0])
        (trail,) = (points for points, colour in painted(view).lines if colour == COLOURS["orange"])
        middles.append(trail[-1] - np.array(SIZE) / 2)
    swing = np.ptp(middles, axis=0) / scale
    assert np.abs(np.mean(middles, axis=0)).max() < 1
    assert swing[0] < 1e-6
    assert swing[1] > 0.4  # of 0.6 m: in the picture it is the mechanism that swings, and less so the ground


@pytest.mark.parametrize("marker", [{}, {"x": 1.0, "y": 2.0}])
def test_the_mechanism_stays_in_the_picture(marker):
    view, rng = view_of("roller_racer", **marker), np.random.default_rng(0)
    q, velocity = np.zeros(4), np.zeros(2)
    for _ in range(300):
        velocity = 0.95 * velocity + rng.normal(size=2) * 0.3  # 5 m/s and more
        q[:2] += velocity * 0.05 * 5
        view.follow(q)
        notes = painted(view)
        corners = np.concatenate([corners for corners, _ in notes.polygons])
        assert (corners > -20).all()
        assert (corners < np.array(SIZE) + 20).all()
        if marker:
            assert (notes.discs[0][0] > 0).all()
            assert (notes.discs[0][0] < SIZE).all()


@pytest.mark.parametrize("far", [1.0, 1e6, 1e12, 1e200])
def test_a_grid_has_few_lines_however_much_is_seen(far):
    lines = painted(view_of("roller_racer", x=far, y=-far)).lines
    assert 4 <= len(lines) < 40


def test_a_marker_is_where_the_target_is():
    """In the coordinates in which the mechanism is drawn, with its radius and heading."""
    view = view_of("roller_racer", x=1.0, y=0.5, radius=0.2, heading=np.pi / 2)
    notes = painted(view)
    ((middle, _),) = notes.discs
    green = [points for points, colour in notes.lines if colour == COLOURS["green"]]
    ring, arrow, _ = green
    body, _ = notes.polygons[0]
    view.begin([1.0, 0.5, 0, 0], view.marker)
    again = painted(view)
    ((now, _),) = again.discs
    np.testing.assert_allclose(np.linalg.norm(ring - middle, axis=1), np.ptp(ring[:, 0]) / 2, rtol=1e-2)
    assert arrow[1][0] == pytest.approx(arrow[0][0], abs=1e-9)
    assert arrow[1][1] < arrow[0][1]  # up
    # The racer on its target: the rod of its rear axle is around the marker's dot.
    rod, _ = again.polygons[0]
    np.testing.assert_allclose(rod.mean(axis=0), now, atol=1e-9)
    assert np.ptp(middle - body.mean(axis=0)) > 10
    wide = np.ptp(ring[:, 0])
    metres = np.linalg.norm(middle - body.mean(axis=0)) / (wide / 0.4)
    assert metres == pytest.approx(np.hypot(1.0, 0.5), rel=1e-2)


def test_words():
    view = view_of("car")
    for k in range(1, 41):
        view.follow([-0.1 * k, 0, 0, 0])
    assert (view.time, view.speed, view.reach) == pytest.approx((2.0, 2.0, 4.0))
    words = painted(view).words
    assert {"car", "2.0 s", "2.0 m/s", "4.0 m away"} <= set(words)
    # Signs at the lines of the grid: along x they are where they say.
    notes = painted(view)
    assert any(word.endswith(" m") and float(word[:-2]) < -3 for word in notes.words)


def test_a_trail_is_the_way_of_the_fibre():
    view = view_of("snakeboard")
    way = np.cumsum(np.random.default_rng(0).normal(size=(30, 2)) * 0.02, axis=0)
    for x, y in way:
        view.follow([x, y, 0, 0, 0])
    (trail,) = (points for points, colour in painted(view).lines if colour == COLOURS["orange"])
    assert len(trail) == 30 * TRAIL_PARTS + 1
    trail = trail[::TRAIL_PARTS]
    scale = np.ptp(trail[1:, 0]) / np.ptp(way[:, 0])
    np.testing.assert_allclose((trail[1:] - trail[1]) / (scale, -scale), way - way[0], atol=1e-9)


def test_a_canvas_is_smooth():
    """The edge of a shape at half a pixel is half as dark, and a line has its width."""
    drawn = Canvas(60, 40)
    drawn.clear((0, 0, 0))
    drawn.line([(10, 20), (50, 20)], 7.0, (255, 255, 255))
    pixels = drawn.pixels()[:, 30, 0].astype(float)
    assert pixels.sum() / 255 == pytest.approx(7, abs=0.4)
    drawn.clear((0, 0, 0))
    drawn.disc((30, 20), 10, (255, 255, 255))
    assert drawn.pixels()[..., 0].sum() / 255 == pytest.approx(100 * np.pi, rel=0.03)
    assert len(np.unique(drawn.pixels())) > 5
    before = drawn.pixels()
    drawn.clear((9, 9, 9))
    began = time.process_time()
    drawn.polygon([(-1e9, -1e9), (1e9, -1e9), (1e9, 1e9), (-1e9, 1e9)], (255, 0, 0))
    assert time.process_time() - began < 3  # some 20 s, if all of it were looked at
    assert (drawn.pixels() == (255, 0, 0)).all()
    assert before.max() == 255  # a picture of its own


# -- markers ------------------------------------------------------------------------------------

PARK = {
    "name": "ParkThere",
    "reward": {"reward_x": "x_dot"},
    "targets": {"aside": (0.3, 1.0)},
    "weights": {"near": 0.1},
    "max_episode_steps": 10,
    "marker": {
        "x": "2*aside",
        "y": "-aside",
        "heading": "sin(aside)",
        "radius": "2*near",
    },
}


def test_a_marker_follows_from_targets_and_weights():
    marker = marker_of(Task.from_dict(PARK), {"aside": 0.5, "near": 0.1})
    assert marker == pytest.approx({"x": 1.0, "y": -0.5, "heading": np.sin(0.5), "radius": 0.2})
    assert marker_of(Task.from_dict({**PARK, "marker": {}}), {}) == {}


@pytest.mark.parametrize(
    ("marker", "reason"),
    [
        ({"x": "0"}, "a marker needs 'x' and 'y', got x"),
        ({"x": "0", "y": "0", "colour": "1"}, "unknown key 'colour'; known: x, y, heading, radius"),
        ({"x": "0", "y": "asid"}, "marker, y: unknown name 'asid'.*Did you mean 'aside'"),
        ({"x": "0", "y": "x_dot"}, "unknown name 'x_dot'"),
        ({"x": "0", "y": "open(1)"}, "marker, y: .*unknown function"),
    ],
)
def test_impossible_markers(marker, reason):
    with pytest.raises(ValueError, match=reason):
        Task.from_dict({**PARK, "marker": marker})


def test_no_kernel_depends_on_the_drawing(monkeypatch):
    """Neither on bodies nor on markers: not the source, and not the key under which it is kept."""
    keys = []
    monkeypatch.setattr("nhenv.compiled.kernels.load", lambda name, given, build, deriving: keys.append((name, given)))
    racer, goal = mechanics.get("roller_racer"), nhenv.tasks.get("Goal")
    scenes = [
        CompiledScene(racer, goal),
        CompiledScene(dataclasses.replace(racer, bodies={}), dataclasses.replace(goal, marker={})),
    ]
    for scene in scenes:
        scene._load("one")
    assert keys[0] == keys[1]
    assert scenes[0].source() == scenes[1].source()


# -- environments -------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [RACER, GOAL, "nhenv/RollerRacerVelocity-v0"])
def test_drawing_changes_no_result(make, actions, rollout, env_id):
    """To the last bit; and what the scene leaves out is in the picture all the same."""
    watched, plain = make(env_id, **DRAWN), make(env_id, backend="numpy")
    given = actions(plain, 40)
    for seen, expected in zip(rollout(watched, given), rollout(plain, given), strict=True):
        if isinstance(seen, np.ndarray):
            np.testing.assert_array_equal(seen, expected)
        else:
            assert seen == expected
    view = watched.unwrapped._view
    np.testing.assert_array_equal(view.q, plain.unwrapped.q)
    assert view.time == pytest.approx(2.0)
    pixels = watched.render()
    assert pixels.shape == (SIZE[1], SIZE[0], 3)
    watched.step(given[0])
    assert (watched.render() != pixels).any()
    assert watched.metadata["render_fps"] == 20


def test_gymnasium_agrees():
    env = gym.make(RACER, backend="numpy")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*Box observation space.*infinity")  # they have no bounds
        check_env(env.unwrapped)
    assert env.unwrapped.metadata["render_modes"] == ["human", "rgb_array"]
    env.close()


def test_a_window(monkeypatch):
    """It is shown by reset and step, at the pace of the episode, and closes."""
    shown, waits = [], []
    env = gym.make(RACER, **(DRAWN | {"render_mode": "human"}), dt=0.04)
    monkeypatch.setattr(
        canvas.Window, "show", lambda self, drawn: (shown.append(drawn.pixels()), waits.append(self._fps))
    )
    env.reset(seed=0)
    env.step(np.ones(1, np.float32))
    assert len(shown) == 2
    assert (shown[0] != shown[1]).any()
    assert waits == [25, 25]
    assert env.render() is None
    monkeypatch.undo()
    env.step(np.ones(1, np.float32))  # a real one, if nobody sees it
    pygame = canvas.pygame_module()
    assert pygame.display.get_surface().get_size() == SIZE
    assert "roller racer, Forward" in pygame.display.get_caption()
    env.close()
    assert not pygame.display.get_init()
    env.close()


def test_the_shape_of_time():
    for dt, fps in ((0.05, 20), (0.04, 25), (0.03, 1 / 0.03)):
        env = gym.make(RACER, dt=dt, backend="numpy")
        assert env.metadata["render_fps"] == pytest.approx(fps)
    assert isinstance(gym.make(RACER, backend="numpy").metadata["render_fps"], int)


def test_a_reset_begins_a_new_picture(make):
    env = make(GOAL, **DRAWN)
    env.reset(seed=0, options={"q": [1.0, 2.0, 0.5, 0.1], "target": {"goal_x": 3.0, "goal_y": 2.0}})
    view = env.unwrapped._view
    assert view.marker == {"x": 3.0, "y": 2.0, "radius": 0.15}
    np.testing.assert_array_equal(view.q, [1.0, 2.0, 0.5, 0.1])
    first = env.render()
    env.step(np.ones(1, np.float32))
    assert view.time > 0
    env.reset(seed=0, options={"q": [1.0, 2.0, 0.5, 0.1], "target": {"goal_x": 3.0, "goal_y": 2.0}})
    assert view.time == 0
    np.testing.assert_array_equal(env.render(), first)


def test_each_row_has_the_marker_of_its_own_target():
    envs = gym.make_vec(GOAL, 2, backend="numpy", goal_radius=0.4).unwrapped
    with pytest.raises(gym.error.ResetNeeded):
        envs.marker(0)
    envs.reset(seed=0, options={"target": {"goal_x": np.array([3.0, -1.0]), "goal_y": 2.0}})
    assert [envs.marker(row) for row in range(2)] == [{"x": x, "y": 2.0, "radius": 0.4} for x in (3.0, -1.0)]


def test_pickled_environments_go_on_drawing(make, actions):
    env = make(RACER, **DRAWN)
    env.reset(seed=0)
    given = actions(env, 6)
    for action in given[:3]:
        env.step(action)
    env.render()
    copy = pickle.loads(pickle.dumps(env))
    for action in given[3:]:
        env.step(action)
        copy.step(action)
    np.testing.assert_array_equal(copy.render(), env.render())


def test_without_a_mode_nothing_is_drawn(make):
    env = make(RACER, backend="numpy")
    env.reset(seed=0)
    with pytest.warns(UserWarning, match=r"RollerRacerForward-v0.*render_mode=.*rgb_array"):
        assert env.render() is None
    envs = gym.make_vec(RACER, 2, backend="numpy")
    envs.reset(seed=0)
    with pytest.warns(UserWarning, match=r"make_vec.*render_mode=.*rgb_array"):
        assert envs.render() is None


def test_impossible_ways_to_draw(monkeypatch):
    with pytest.raises(ValueError, match="render_mode must be None or one of human, rgb_array, got 'ansi'"):
        nhenv.env.LocomotionEnv("roller_racer", render_mode="ansi")
    env = nhenv.env.LocomotionEnv("roller_racer", **DRAWN)
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        env.render()
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ImportError, match=r"pip install 'nhenv\[render\]'"):
        nhenv.env.LocomotionEnv("roller_racer", **DRAWN)


def test_a_mechanism_of_ones_own_is_drawn():
    """With its bodies, or with a marker in their place."""
    spec = mechanics.get("snakeboard").to_dict() | {"name": "my_board"}
    pictures = []
    for bodies in (spec["bodies"], {}):
        env = nhenv.env.LocomotionEnv(Mechanism.from_dict({**spec, "bodies": bodies}), **DRAWN)
        env.reset(seed=0)
        pictures.append(env.render())
    assert (pictures[0] != pictures[1]).any()


# -- many ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_rows_look_as_single_environments_do(make, mode):
    """The picture of row i is that of the environment with its seed, through ends of episodes too."""
    envs = gym.make_vec(GOAL, 2, max_episode_steps=4, autoreset_mode=mode, **DRAWN)
    singles = [make(GOAL, max_episode_steps=4, **DRAWN) for _ in range(2)]
    envs.reset(seed=7)
    for i, env in enumerate(singles):
        env.reset(seed=7 + i)
    over = np.zeros(2, bool)
    rng = np.random.default_rng(0)
    for step in range(9):
        if step == 2:  # from here on the rows are out of step
            envs.reset(options={"reset_mask": np.array([True, False])})
            singles[0].reset()
        given = rng.uniform(-1, 1, (2, 1)).astype(np.float32)
        if mode == "Disabled" and over.any():
            envs.reset(options={"reset_mask": over})
            for env, ended in zip(singles, over, strict=True):
                if ended:
                    env.reset()
            over[:] = False
        _, _, terminated, truncated, _ = envs.step(given)
        for i, env in enumerate(singles):
            if over[i]:  # the step that resets, in the mode NextStep
                env.reset()
                continue
            ended = any(env.step(given[i])[2:4])
            assert ended == (terminated | truncated)[i]
            if ended and mode == "SameStep":
                env.reset()
        over = terminated | truncated if mode != "SameStep" else np.zeros(2, bool)
        frames = envs.render()
        assert isinstance(frames, tuple)
        for frame, env in zip(frames, singles, strict=True):
            # The last bit of a coordinate may differ between a scene with the whole state and one that is replayed.
            assert (frame != env.render()).mean() < 1e-3, step
    envs.close()


def test_rows_of_different_sizes():
    """Each row is drawn with its own parameters, changed ones too."""
    envs = gym.make_vec(RACER, 2, params={"l_1": np.array([0.3, 0.6])}, **DRAWN)
    envs.reset(seed=[0, 0])
    before = envs.render()
    assert (before[0] != before[1]).any()
    envs.set_params({"l_1": np.array([0.3, 0.4])})
    after = envs.render()
    np.testing.assert_array_equal(after[0], before[0])
    assert (after[1] != before[1]).any()


# -- nothing is paid by others ------------------------------------------------------------------

SCRIPT = f"""
import sys
import warnings
import gymnasium as gym
import numpy as np
import nhenv.canvas, nhenv.render

for env in (gym.make("{RACER}", backend="numpy"), gym.make_vec("{RACER}", 2, backend="numpy")):
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
assert "pygame" not in sys.modules
env = gym.make("{RACER}", render_mode="rgb_array", backend="numpy")
assert "pygame" in sys.modules
env.reset(seed=0)
env.render()
pygame = sys.modules["pygame"]
assert not pygame.display.get_init()
"""


def test_who_does_not_draw_does_not_load_pygame():
    """And who draws into arrays opens no display, and writes nothing on the standard output."""
    env = {name: value for name, value in os.environ.items() if not name.startswith(("PYGAME", "SDL"))}
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", SCRIPT], cwd=ROOT, env=env, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout == ""


def test_without_a_mode_a_step_is_the_kernel_itself(make):
    env = make(RACER, backend="numpy").unwrapped
    env.reset(seed=0)
    assert env._respond is env._scene.kernel.respond
    envs = gym.make_vec(RACER, 2, backend="numpy")
    envs.reset(seed=0)
    assert envs.unwrapped._run is envs.unwrapped._running
