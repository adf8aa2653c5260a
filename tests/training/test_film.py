"""Films show what was recorded, all of it, at the pace that was asked for."""

import dataclasses
import io
import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import tyro
from PIL import Image
from rich.console import Console

from nhenv import render
from training import film as films
from training.actors import random_actor
from training.config import EVALUATION_SEEDS
from training.film import TRAILS, Film, film, frames, gif, length, mp4, record
from training.policies import SHIPPED, SUFFIX
from training.store import settings

RACER, GOAL = "nhenv/RollerRacerForward-v0", "nhenv/RollerRacerGoal-v0"
SIZE = {"width": 160, "height": 80}


@pytest.fixture(scope="module")
def take():
    """A whole episode of random actions; nothing is compiled."""
    return record(random_actor(RACER), EVALUATION_SEEDS, backend="numpy", max_episode_steps=60)


@pytest.fixture(scope="module")
def goal():
    return record(random_actor(GOAL, "somebody"), 3, backend="numpy", max_episode_steps=20)


def filmed(*takes, speed=1.0, fps=20, seconds=None, **size):
    return list(frames(takes, speed=speed, fps=fps, seconds=seconds, **(SIZE | size)))


def colour_at(pictures, colour):
    """Mean place (x) of what has this colour in each picture; NaN where there is none."""
    places = []
    for picture in pictures:
        near = (np.abs(picture.astype(int) - colour).max(axis=-1) < 8).nonzero()[1]
        places.append(near.mean() if len(near) else np.nan)
    return np.array(places)


def test_a_take_is_an_episode(take, goal):
    envs = take.envs
    assert take.q.shape == (61, 4)
    assert take.label == "random actions"
    assert (take.marker, goal.label) == ({}, "somebody")
    envs.reset(seed=EVALUATION_SEEDS)
    np.testing.assert_array_equal(envs.q[0], take.q[0])
    rng = np.random.default_rng(0)
    for _ in range(60):
        envs.step(rng.uniform(-1, 1, (1, 1)).astype(np.float32))
    np.testing.assert_array_equal(envs.q[0], take.q[-1])
    targets = goal.envs.targets
    assert goal.marker == {"x": targets["goal_x"][0], "y": targets["goal_y"][0], "radius": 0.15}


def test_a_take_shows_the_target_as_large_as_it_was():
    take = record(random_actor(GOAL), 3, backend="numpy", max_episode_steps=2, goal_radius=0.4)
    assert take.marker["radius"] == 0.4


@pytest.mark.parametrize(("speed", "fps", "seconds", "count"), [(1, 20, None, 61), (2, 20, None, 31), (1, 10, 1.5, 16)])
def test_a_film_lasts_as_long_as_what_it_shows(take, speed, fps, seconds, count):
    pictures = filmed(take, speed=speed, fps=fps, seconds=seconds)
    assert len(pictures) == length([take], speed, fps, seconds) == count
    assert {picture.shape for picture in pictures} == {(80 + films.GAP + films.STRIP, 160, 3)}
    assert all((a != b).any() for a, b in zip(pictures[::5], pictures[5::5], strict=False))


def test_each_picture_is_that_of_its_state(take, monkeypatch):
    """Twice as fast, every other state is shown, and none is left out of the trail."""
    shown = []
    monkeypatch.setattr(render.View, "paint", lambda self, canvas: shown.append((self.q, len(self._points))))
    filmed(take, speed=2)
    np.testing.assert_array_equal([q for q, _ in shown], take.q[::2])
    assert [points for _, points in shown] == [*range(1, 62, 2)]


def test_takes_stand_one_above_the_other(take, goal):
    take = dataclasses.replace(take, q=np.linspace(0, -5, 61)[:, None] * (1, 0, 0, 0))
    both = filmed(take, take)
    alone = filmed(take)
    np.testing.assert_array_equal(both[30][:80], alone[30][:80])
    # Another colour of the trail is all the difference.
    lower = both[30][80 + films.GAP : 160 + films.GAP]
    assert 0 < (lower != alone[30][:80]).any(axis=-1).mean() < 0.1
    with_target = filmed(goal)
    assert with_target[0].shape == (80, 160, 3)
    assert np.isfinite(colour_at(with_target, render.COLOURS["green"])).all()


def test_one_that_is_over_waits_for_the_others(take):
    short = dataclasses.replace(take, q=take.q[:11])
    pictures = filmed(short, take)
    assert len(pictures) == 61
    np.testing.assert_array_equal(pictures[10][:80], pictures[60][:80])
    assert (pictures[9][:80] != pictures[10][:80]).any()


def test_the_strip_is_to_scale(take):
    """Dots are as far along it as the mechanisms are along x, forward to the right: -x for the racer."""
    way = np.linspace(0, -5, 61)[:, None] * (1, 0, 0, 0)
    whole, half = dataclasses.replace(take, q=way), dataclasses.replace(take, q=0.5 * way)
    pictures = [picture[-films.STRIP :] for picture in filmed(whole, half, width=400)]
    first, second = (colour_at(pictures[10:], render.COLOURS[trail]) for trail in TRAILS[:2])
    assert first[-1] == pytest.approx(400 - 24, abs=2)
    np.testing.assert_allclose(first - 24, 2 * (second - 24), atol=3)
    assert (np.diff(first) > 0).all()


def test_a_gif_holds_every_picture(take):
    pictures = filmed(take)
    with Image.open(io.BytesIO(gif(iter(pictures), 20))) as image:
        assert image.size == (160, 80 + films.GAP + films.STRIP)
        assert image.info["loop"] == 0
        lasted, i = 0, 0
        while True:
            # Equal pictures are written once, and shown longer.
            image.seek(i)
            seen = np.array(image.convert("RGB")).astype(int)
            error = np.abs(seen - pictures[lasted // 50]).max(axis=-1)
            # Colours of the palette, or between: few are far from any.
            assert np.quantile(error, 0.99) <= 40
            assert np.median(error) <= 1
            lasted += image.info["duration"]
            i += 1
            if i == image.n_frames:
                break
    assert lasted == 61 * 50
    assert len(films._palette()) <= 256


def test_an_mp4_holds_every_picture(take, tmp_path):
    path, pictures = tmp_path / "film.mp4", [picture[:-1] for picture in filmed(take)[:20]]  # an odd number of rows
    path.write_bytes(mp4(iter(pictures), 20))
    rows, columns = pictures[0].shape[0] - 1, pictures[0].shape[1]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    read = subprocess.run(command, capture_output=True, check=True)
    assert f"{columns}x{rows}" in read.stderr.decode()
    assert "20 fps" in read.stderr.decode()
    seen = np.frombuffer(read.stdout, np.uint8).reshape(-1, rows, columns, 3)
    for one, picture in zip(seen, pictures, strict=True):
        assert np.abs(one.astype(int) - picture[:rows]).mean() < 6  # colours are kept at half of the resolution


def test_a_film_is_written_whole_or_not_at_all(take, tmp_path, monkeypatch):
    monkeypatch.setattr(films, "record", lambda *args, **options: take)
    options = Film(env_id=RACER, out=tmp_path / "sub" / "film.gif", fps=10, seconds=1, **SIZE)
    film(options, Console(file=io.StringIO()))
    with Image.open(options.out) as image:
        assert image.n_frames == 11
    before = options.out.read_bytes()

    def broken(*args, **options):
        yield from frames([take], **(SIZE | {"speed": 1, "fps": 10, "seconds": 0.3}))
        raise KeyboardInterrupt

    monkeypatch.setattr(films, "frames", broken)
    with pytest.raises(SystemExit, match="nothing was written"):
        films.main(options)
    assert options.out.read_bytes() == before
    assert [path.name for path in options.out.parent.iterdir()] == ["film.gif"]


def test_impossible_films():
    for options, reason in (
        ({}, "say what to film"),
        ({"env_id": RACER, "pieces": (Path("gait-0.json"),)}, "--env-id is for random actions"),
        ({"env_id": RACER, "out": Path("film.avi")}, r"ends in \.gif or \.mp4"),
        ({"env_id": RACER, "labels": ("a", "b")}, "2 labels for 1 controllers"),
        ({"env_id": RACER, "speed": 0.0}, "speed must be positive"),
    ):
        with pytest.raises(ValueError, match=reason):
            Film(**options)


def test_only_a_film_that_says_the_drag_shows_controllers_made_for_another():
    pieces = tuple(SHIPPED / f"{name}{SUFFIX}" for name in ("RollerRacerForward-v0", "RollerRacerForward-v0-drag"))
    with pytest.raises(ValueError, match="if --drag says in which"):
        Film(pieces=pieces).actors()
    assert len(Film(pieces=pieces, drag=True).actors()) == 2


def test_the_command_shows_its_options(monkeypatch, capsys):
    with pytest.raises(SystemExit):
        tyro.cli(Film, args=["--help"])
    assert "--speed" in capsys.readouterr().out


def test_results_do_not_follow_from_pictures():
    """A body drawn otherwise makes no result old."""
    data = settings(GOAL, "code")
    assert "bodies" not in data["mechanism"]
    assert "marker" not in data["task"]
    assert data["mechanism"]["inertia"]
    assert data["task"]["reward"]
