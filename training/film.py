"""Film controllers side by side, each from the same start, as a GIF or MP4.

python -m training.film runs/compare/SnakeboardForward-v0/{gait,ppo-seed0}-*.{json,zip} --out film.gif
python -m training.film --env-id nhenv/CarGoal-v0 --out random.mp4
"""

from __future__ import annotations

import io
import itertools
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from scipy.spatial import cKDTree

from nhenv import render
from nhenv.canvas import Canvas
from nhenv.vector_env import LocomotionVectorEnv
from training.actors import Actor, actors_of, random_actor
from training.config import EVALUATION_SEEDS
from training.rollout import rollout
from training.store import write_bytes

__all__ = ["Film", "Take", "film", "frames", "gif", "mp4", "record"]

Pixels = NDArray[np.uint8]

# Trails, from the first panel down; a film of more begins anew.
TRAILS = ("blue", "orange", "green", "purple")
SHIFT = 2  # bits of a colour that make no difference to a GIF
STRIP = 56  # height in pixels of the strip that shows who is where
GAP = 4


@dataclass(frozen=True)
class Take:
    """One recorded episode.

    Attributes:
        label: whose it is.
        q: coordinates before each step and after the last, shape (T + 1, n).
        marker: where the target is, as `LocomotionVectorEnv.marker` has it.
        envs: the environment.
    """

    label: str
    q: NDArray[np.float64]
    marker: Mapping[str, float]
    envs: LocomotionVectorEnv


def record(actor: Actor, seed: int, **options: Any) -> Take:
    """Run one episode from the start of this seed."""
    envs = gym.make_vec(actor.env_id, 1, whole_state=True, **{**actor.env_kwargs, **options})
    assert isinstance(envs, LocomotionVectorEnv)
    q = rollout(actor.make(envs), envs, [seed]).q[0]
    return Take(actor.label, q, envs.marker(0), envs)


def frames(
    takes: Sequence[Take], *, width: int, height: int, speed: float, fps: float, seconds: float | None
) -> Iterator[Pixels]:
    """Pictures, shape (rows, width, 3), of all takes one above the other.

    Args:
        takes: at least one, of one environment.
        width: of the film in pixels.
        height: of each take in pixels.
        speed: simulated seconds a second.
        fps: pictures a second.
        seconds: how much of the episodes is shown, in s; None for all.
    """
    count = length(takes, speed, fps, seconds)
    canvas, strip = Canvas(width, height), _Strip(takes, width) if not takes[0].marker else None
    views = [_view(take, TRAILS[i % len(TRAILS)]) for i, take in enumerate(takes)]
    shown, gap = [0] * len(takes), np.full((GAP, width, 3), 255, np.uint8)
    for k in range(count):
        parts: list[Pixels] = []
        for i, (take, view) in enumerate(zip(takes, views, strict=True)):
            # A moment before a step's end still shows its beginning.
            now = min(math.floor(k * speed / (fps * take.envs.dt) + 1e-9), len(take.q) - 1)
            for q in take.q[shown[i] + 1 : now + 1]:
                view.follow(q)
            shown[i] = now
            view.paint(canvas)
            parts += [canvas.pixels(), gap]
        if strip:
            parts.append(strip.pixels([take.q[now] for take, now in zip(takes, shown, strict=True)]))
        else:
            parts.pop()
        yield np.concatenate(parts)


def length(takes: Sequence[Take], speed: float, fps: float, seconds: float | None) -> int:
    """Number of pictures of a film."""
    longest = max((len(take.q) - 1) * take.envs.dt for take in takes)
    return math.floor(min(longest, seconds or math.inf) * fps / speed + 1e-9) + 1


def _view(take: Take, trail: str) -> render.View:
    view = render.View(take.envs.mechanism, take.envs.params, take.envs.dt, take.label, trail)
    view.begin(take.q[0], take.marker)
    return view


class _Strip:
    """Who is where along the way, on one scale: what pictures that each follow one mechanism do not show."""

    def __init__(self, takes: Sequence[Take], width: int) -> None:
        mechanism = takes[0].envs.mechanism
        self._forward = mechanism.direction(takes[0].envs.params)
        self._x = mechanism.coordinates.index(mechanism.fibre[0])
        self._starts = [take.q[0, self._x] for take in takes]
        ways = [self._way(i, take.q) for i, take in enumerate(takes)]
        self._low, self._high = min(way.min() for way in ways), max(*(way.max() for way in ways), 1.0)
        self._canvas = Canvas(width, STRIP)

    def _way(self, i: int, q: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._forward * (q[..., self._x] - self._starts[i])

    def pixels(self, states: Sequence[NDArray[np.float64]]) -> Pixels:
        """The strip with everybody at coordinates (n,)."""
        canvas = self._canvas
        canvas.clear(render.WHITE)
        left, right, y = 24.0, canvas.width - 24.0, 20.0

        def place(way: float) -> float:
            return left + (right - left) * (way - self._low) / (self._high - self._low)

        canvas.line([(left, y), (right, y)], 3.0, render.AXES)
        step = render.grid_step(60 * (self._high - self._low) / (right - left))
        for i in range(math.ceil(self._low / step), math.floor(self._high / step) + 1):
            canvas.line([(place(i * step), y - 5), (place(i * step), y + 5)], 2.0, render.AXES)
            canvas.text(f"{i * step:g} m", place(i * step), y + 14, 18, render.FAINT, "midtop")
        for i, q in enumerate(states):
            x = place(float(self._way(i, q)))
            canvas.disc((x, y), 10.0, render.WHITE)
            canvas.disc((x, y), 8.5, render.COLOURS[TRAILS[i % len(TRAILS)]])
        return canvas.pixels()


# -- files --------------------------------------------------------------------------------------


def gif(pictures: Iterable[Pixels], fps: float) -> bytes:
    """A GIF that repeats for ever, in the colours of `nhenv.render` and what lies between them."""
    from PIL import Image

    palette = _palette()
    nearest = _nearest(palette)

    def indexed(picture: Pixels) -> Image.Image:
        red, green, blue = np.moveaxis(picture >> SHIFT, -1, 0)
        image = Image.fromarray(nearest[red, green, blue])
        image.putpalette(palette.reshape(-1).tolist())
        return image

    images = map(indexed, pictures)
    first, content = next(images), io.BytesIO()
    # The format counts hundredths of a second.
    first.save(content, "GIF", save_all=True, append_images=images, duration=10 * round(100 / fps), loop=0)
    return content.getvalue()


def _palette() -> NDArray[np.uint8]:
    """At most 256 colours, shape (c, 3): those that are drawn, and three steps from each to what it borders on."""
    grounds = np.array([render.GROUND, render.WHITE], float)
    drawn = np.array([*render.COLOURS.values(), render.GRID, render.AXES, render.FAINT], float)
    shares = np.linspace(0, 1, 5)[:, None, None, None]
    mixed = shares * drawn[:, None] + (1 - shares) * grounds
    return np.unique(mixed.reshape(-1, 3).round().astype(np.uint8), axis=0)


def _nearest(palette: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Place in the palette (c, 3) of every colour, given by the upper bits of its parts: shape (64, 64, 64).

    Pillow's own search takes white for the ground, which is nearly white.
    """
    levels = np.arange(256 >> SHIFT) * 2**SHIFT + 2 ** (SHIFT - 1)
    cube = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1)
    nearest: NDArray[np.uint8] = np.asarray(cKDTree(palette).query(cube.astype(float))[1], np.uint8)
    nearest[tuple((palette >> SHIFT).T)] = np.arange(len(palette))
    return nearest


def mp4(pictures: Iterable[Pixels], fps: float) -> bytes:
    """An MP4 (H.264) that browsers show."""
    from imageio_ffmpeg import get_ffmpeg_exe  # which brings the program; its own pipes are not closed in order

    pictures = iter(pictures)
    first = _even(next(pictures))
    rows, columns = first.shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{columns}x{rows}", "-r", f"{fps:g}", "-i", "-"]
        wanted = ["-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path)]
        with subprocess.Popen([get_ffmpeg_exe(), "-v", "error", *given, *wanted], stdin=subprocess.PIPE) as process:
            assert process.stdin is not None
            for picture in itertools.chain([first], map(_even, pictures)):
                process.stdin.write(picture.tobytes())
        if process.returncode:
            raise RuntimeError(f"ffmpeg could not make an MP4 of {columns} x {rows} pixels; it says why above")
        return path.read_bytes()


def _even(picture: Pixels) -> Pixels:
    """Without an odd last row or column, which H.264 has no room for."""
    rows, columns = (2 * (size // 2) for size in picture.shape[:2])
    return picture[:rows, :columns]


_FORMATS: dict[str, Callable[[Iterable[Pixels], float], bytes]] = {".gif": gif, ".mp4": mp4}


# -- the command --------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Film:
    """Film controllers side by side, each from the same start.

    Loading a policy unpickles it, which can run any code: only film files that you trust.

    Attributes:
        pieces: gait-*.json or ppo-*.zip of a results folder, or *.safetensors. None for random actions.
        env_id: environment of the random actions; the files name their own.
        labels: what the film calls them, in their order.
        out: file to write, .gif or .mp4. It is there whole or not at all.
        seed: number of the start, counted among those on which controllers are judged.
        seconds: how much of the episode is shown, in s.
        speed: simulated seconds a second.
        fps: pictures a second.
        width: in pixels.
        height: of each controller's picture, in pixels.
        drag: whether the mechanism's drag acts; None for what the files say.
    """

    pieces: tyro.conf.Positional[tuple[Path, ...]] = ()
    env_id: str | None = None
    labels: tuple[str, ...] = ()
    out: Path = Path("film.gif")
    seed: int = 0
    seconds: float | None = None
    speed: float = 1.0
    fps: int = 20
    width: int = 800
    height: int = 180
    drag: bool | None = None

    def __post_init__(self) -> None:
        if self.out.suffix not in _FORMATS:
            raise ValueError(f"a film ends in {' or '.join(_FORMATS)}, got {self.out}")
        if not self.pieces and self.env_id is None:
            raise ValueError("say what to film: files of gaits and policies, or --env-id for random actions")
        if self.pieces and self.env_id is not None:
            raise ValueError("--env-id is for random actions; files of gaits and policies name their environment")
        if len(self.labels) > max(1, len(self.pieces)):
            raise ValueError(f"{len(self.labels)} labels for {max(1, len(self.pieces))} controllers")
        for name in ("speed", "fps", "width", "height"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")

    def actors(self) -> list[Actor]:
        """Who is filmed."""
        if self.env_id is not None:
            return [random_actor(self.env_id, next(iter(self.labels), None))]
        return actors_of(self.pieces, self.labels, same_arguments=self.drag is None)


def film(options: Film, console: Console) -> None:
    """Record, draw and write."""
    more = {} if options.drag is None else {"drag": options.drag}
    with console.status("recording"):
        takes = [record(actor, EVALUATION_SEEDS + options.seed, **more) for actor in options.actors()]
    pictures = frames(
        takes,
        width=options.width,
        height=options.height,
        speed=options.speed,
        fps=options.fps,
        seconds=options.seconds,
    )
    count = length(takes, options.speed, options.fps, options.seconds)
    shown = track(pictures, "drawing", count, console=console)
    content = _FORMATS[options.out.suffix](shown, options.fps)
    write_bytes(options.out, content)
    console.print(f"{options.out}: {count} pictures, {count / options.fps:.1f} s, {len(content) / 1e6:.2f} MB")


def main(options: Film) -> None:
    """Run from the command line."""
    try:
        film(options, Console())
    except KeyboardInterrupt:
        sys.exit("interrupted; nothing was written")


if __name__ == "__main__":
    main(tyro.cli(Film, prog="python -m training.film"))
