"""The strongest known answer to a task without feedback: torques found by direct optimal control.

python -m training.optimal --replay      # what is known, replayed in the environments
python -m training.optimal               # look on from there, in parallel; Ctrl-C keeps what was found
python -m training.optimal --fresh --out runs/optimal    # find it again from nothing
python -m training.optimal --starts runs/compare/SnakeboardForward-v0/*.json    # begin with what these drive as well

An episode is one function of its T·m actions. `training.climbing` climbs it by sequential linear programming through
the simulator; then a stretch of the actions is changed at random and climbs again, and the best is kept. The first
starts are what is known, or the best of a family of torques that hold still, then swing, by differential evolution, and
what gaits, laws and policies do from rest. What is found is a lower bound of what is possible: no proof says that there
is nothing better.

Every episode begins at rest with all angles at zero, the middle of the environment's starts. The files hold float32
actions, as the environment takes them, and the distance that these reach in it.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.table import Table
from scipy.optimize import Bounds

from training.actors import Actor, actor
from training.climbing import TRIALS, climb
from training.config import COMPARED, check_env_id
from training.evolution import evolve
from training.progress import Job, Report, ignore, run_jobs
from training.rollout import make_envs
from training.shooting import Shooting
from training.store import read_json, versions, write_json

__all__ = ["FOLDER", "Optimal", "Reference", "driven", "load", "path_of", "reference", "replay", "search", "swings"]

Array = NDArray[np.float64]

FOLDER = Path(__file__).parent / "references"


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A sequence of actions and what it reaches.

    Attributes:
        env_id: environment.
        drag: whether the mechanism's drag acts.
        distance_m: metres along the mechanism's forward direction.
        actions: shape (T, m), float32, from rest with all coordinates at zero.
        found: how it was found, and on what.
    """

    env_id: str
    drag: bool
    distance_m: float
    actions: NDArray[np.float32]
    found: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> Reference:
        """What `write` wrote."""
        data = read_json(path)
        return cls(**{**data, "actions": np.array(data["actions"], np.float32)})

    def write(self, path: Path) -> None:
        """Put it in a file; float32 actions survive the digits that are printed."""
        printed = [[float(str(value)) for value in row] for row in self.actions.astype(np.float32)]
        write_json(path, {**dataclasses.asdict(self), "actions": printed})


def path_of(env_id: str, drag: bool, folder: Path = FOLDER) -> Path:
    """File of a reference."""
    return folder / f"{env_id.rpartition('/')[2]}{'-drag' if drag else ''}.json"


def load(env_id: str, drag: bool, folder: Path = FOLDER) -> Reference | None:
    """The reference of this environment, None if there is none."""
    path = path_of(env_id, drag, folder)
    return Reference.read(path) if path.is_file() else None


def reference(env_id: str, drag: bool | Mapping[str, float] | None = None) -> float | None:
    """Metres that are known to be possible in this environment; None where nobody has looked.

    Args:
        env_id: environment, with its own limits and length.
        drag: as the environment takes it; nobody has looked at other coefficients than the mechanism's own.
    """
    if isinstance(drag, Mapping):
        return None
    known = load(env_id, bool(drag))
    return None if known is None else known.distance_m


def replay(known: Reference, **env_kwargs: Any) -> float:
    """Metres that the actions reach in the environment, made with these further arguments."""
    return Shooting(known.env_id, drag=known.drag, **env_kwargs).distance(known.actions)


# -- where to start --------------------------------------------------------------------------------


def swings(numbers: Array, steps: int) -> Array:
    """Torques that are held for a while and swing then, a family (..., T, m) with numbers (..., 3 + 3m) in 0 to 1.

    Numbers: the share of the time in which they are held; the frequency of the swings at first and at last; for each
    control the level that is held, the height of the swings and their phase.
    """
    numbers = numbers[..., None, :]  # (..., 1, 3 + 3m)
    held, first, last = (numbers[..., i] for i in range(3))
    level, height, phase = np.split(numbers[..., 3:], 3, axis=-1)
    t = np.arange(steps) / steps
    since = np.maximum(t - held, 0.0)
    # Up to 60 swings an episode: 4 a second.
    turned = 2 * np.pi * 60 * (first * since + (last - first) * since**2 / 2 / np.maximum(1 - held, 1e-9))
    swinging = np.clip(2 * height * np.sin(turned[..., None] + 2 * np.pi * phase), -1, 1)
    return np.where((t < held)[..., None], np.clip(4 * level - 2, -1, 1), swinging)


def _best_swings(env_id: str, drag: bool, seed: int, report: Report, generations: int = 100) -> Array:
    """Actions (T, m) of the family's best, by differential evolution."""
    size = 512
    envs = make_envs(env_id, size, drag=drag, whole_state=True)  # the kernel of all that follows
    steps, m = envs.max_episode_steps, len(envs.mechanism.controls)
    assert steps is not None
    rounds = 0

    def loss(numbers: Array) -> Array:
        nonlocal rounds
        count = numbers.shape[1]
        actions = np.zeros((steps, size, m))
        actions[:, :count] = np.moveaxis(swings(numbers.T, steps), 0, 1)
        envs.reset(options={"q": np.zeros(envs.mechanism.n)})
        # Efforts cost next to nothing, so that the return is the distance up to that.
        total = np.sum([envs.step(held)[1] for held in actions], axis=0)
        rounds += 1
        report(rounds, generations + 1, "starts")
        return -total[:count]

    bounds = Bounds(np.zeros(3 + 3 * m), np.ones(3 + 3 * m))
    return swings(evolve(loss, bounds, population=size, generations=generations, seed=seed), steps)


# -- the search ------------------------------------------------------------------------------------


class _Hop:
    """A random change of a stretch of the actions: noise, a shift in time, or all that follows slower or faster."""

    def __init__(self, shape: tuple[int, int], rng: np.random.Generator) -> None:
        self.shape, self.rng = shape, rng

    def __call__(self, actions: Array) -> Array:
        """Other actions (T, m)."""
        rng, (steps, m) = self.rng, self.shape
        actions = actions.copy()
        length = int(rng.integers(4, 60))
        first = int(rng.integers(0, steps - length))
        window = slice(first, first + length)
        match rng.integers(3):
            case 0:
                actions[window] += rng.normal(0.0, rng.choice([0.1, 0.3, 1.0]), (length, m))
            case 1:
                actions[window] = np.roll(actions[window], rng.choice([-2, -1, 1, 2]), axis=0)
            case _:
                t = np.arange(steps - first)
                warped = np.clip(t * (1 + rng.normal(0.0, 0.01)), 0, t[-1])
                actions[first:] = np.stack([np.interp(warped, t, column) for column in actions[first:].T], axis=-1)
        return np.clip(actions, -1, 1)


def search(
    env_id: str,
    drag: bool,
    starts: Mapping[str, ArrayLike],
    *,
    hops: int = 0,
    rounds: int = 60,
    seed: int = 0,
    found: Callable[[float, NDArray[np.float32], str], None] = lambda distance, actions, start: None,
    report: Report = ignore,
) -> tuple[float, NDArray[np.float32]]:
    """Climb from given actions, and hop on from the best: the distance reached, and the float32 actions that do it.

    Args:
        env_id: environment.
        drag: whether the mechanism's drag acts.
        starts: by name, actions (T, m); at least one. What the first reaches as it is counts as known.
        hops: changes to be tried after the climbs from the starts.
        rounds: of each climb, at most.
        seed: of the changes.
        found: hears of every improvement on what is known, and from which start it came.
        report: hears of every climb.
    """
    shooting, rng = Shooting(env_id, trials=TRIALS, drag=drag), np.random.default_rng(seed)
    hop = _Hop(shooting.shape, rng)
    origin, first = next(iter(starts.items()))
    best_actions = np.asarray(first, np.float32)
    best = shooting.distance(best_actions)
    count = len(starts) + hops
    for number in range(count):
        if number < len(starts):
            name, trial = list(starts.items())[number]
        else:
            name, trial = origin, hop(best_actions.astype(float))
        actions = climb(shooting, np.asarray(trial, float), rounds)[1].astype(np.float32)
        distance = shooting.distance(actions)  # as it is written down, and as it is replayed
        if distance > best:
            best, best_actions, origin = distance, actions, name
            found(best, best_actions, origin)
        report(number + 1, count, f"{best:.3f} m")
    return best, best_actions


def driven(one: Actor, drag: bool) -> NDArray[np.float32]:
    """Actions (T, m) of a controller from rest with all coordinates at zero."""
    envs = make_envs(one.env_id, 1, drag=drag, whole_state=True)
    drives = one.make(envs)
    drives.reset(1)
    steps = envs.max_episode_steps
    assert steps is not None
    observations, _ = envs.reset(options={"q": np.zeros(envs.mechanism.n)})
    actions = []
    for _ in range(steps):
        actions.append(np.clip(drives(observations), -1, 1))
        observations, *_ = envs.step(actions[-1])
    return np.concatenate(actions).astype(np.float32)


def improve(
    env_id: str,
    drag: bool,
    *,
    hops: int,
    seed: int,
    fresh: bool,
    folder: Path,
    starts: Sequence[Path] = (),
    report: Report = ignore,
) -> None:
    """Look for a better reference, and write every one that is found into the folder at once."""
    path = path_of(env_id, drag, folder)
    known = load(env_id, drag, folder) or (None if fresh else load(env_id, drag))
    began = time.process_time()
    if known is None:
        swung = "the best of training.optimal.swings"
        tried: dict[str, ArrayLike] = {swung: _best_swings(env_id, drag, seed, report)}
        spent = 0.0
    else:
        tried, spent = {known.found["start"]: known.actions}, known.found.get("cpu_s", 0.0)
    for file in starts:
        one = actor(file)
        if (one.env_id, one.env_kwargs.get("drag", False)) == (env_id, drag):
            tried[f"{one.label} ({file.name})"] = driven(one, drag)

    def found(distance: float, actions: NDArray[np.float32], start: str) -> None:
        cpu_s = spent + time.process_time() - began
        how = {"start": start, "climbed": "training.climbing", "versions": versions(), "cpu_s": cpu_s}
        Reference(env_id=env_id, drag=drag, distance_m=distance, actions=actions, found=how).write(path)

    search(env_id, drag, tried, hops=hops, seed=seed, found=found, report=report)


# -- the command -----------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Optimal:
    """Look for torques that drive farther than any known.

    Attributes:
        env_ids: environments.
        drag: with drag or without; None for both.
        hops: changes to be tried in each; 0 to climb from the starts alone.
        seed: of the search; another one tries others.
        fresh: begin with nothing instead of with what is known, unless the folder holds some.
        starts: gait-*.json, ppo-*.json or *.safetensors, to begin with what these do as well; each in the environment
            for which it was made. Loading a policy's zip file unpickles it: only name files that you trust.
        out: folder of the references that are read and written.
        processes: processes side by side.
        replay: only replay what the folder holds.
    """

    env_ids: tuple[str, ...] = COMPARED
    drag: bool | None = None
    hops: int = 100
    seed: int = 0
    fresh: bool = False
    starts: tuple[Path, ...] = ()
    out: Path = FOLDER
    processes: int = 1
    replay: bool = False

    def __post_init__(self) -> None:
        for env_id in self.env_ids:
            check_env_id(env_id)
        if self.hops < 0 or self.processes < 1:
            raise ValueError(f"hops must be at least 0 and processes at least 1, got {self.hops} and {self.processes}")
        for one in map(actor, self.starts):
            if (one.env_id, one.env_kwargs.get("drag", False)) not in self.cells:
                raise ValueError(
                    f"{one.label} drives {one.env_id} with {dict(one.env_kwargs)}, which is not among what is searched"
                )

    @property
    def cells(self) -> list[tuple[str, bool]]:
        """Environments with and without drag."""
        return [(env_id, drag) for env_id in self.env_ids for drag in (False, True) if self.drag in (None, drag)]


def _table(options: Optimal) -> Table:
    """What the folder holds, as written and replayed."""
    table = Table(title="Strongest known, from rest with all angles at zero")
    for heading in ("", "drag", "metres", "replayed", "10 steps a hold", "at the limits"):
        table.add_column(heading, justify="right" if heading else "left")
    for env_id, drag in options.cells:
        known, name = load(env_id, drag, options.out), env_id.rpartition("/")[2]
        if known is None:
            table.add_row(name, "yes" if drag else "no", *["-"] * 4)
            continue
        again = [replay(known, **more) for more in ({}, {"substeps": 10})]
        saturated = np.mean(np.abs(known.actions) > 0.999)
        table.add_row(name, "yes" if drag else "no", f"{known.distance_m:.4f}", *(f"{x:.4f}" for x in again),
                      f"{saturated:.0%}")  # fmt: skip
    return table


def main(options: Optimal) -> None:
    """Run from the command line."""
    console = Console()
    jobs = []
    if not options.replay:
        better = partial(
            improve,
            hops=options.hops,
            seed=options.seed,
            fresh=options.fresh,
            folder=options.out,
            starts=options.starts,
        )
        for env_id, drag in options.cells:
            label = f"{env_id.rpartition('/')[2]}{', drag' if drag else ''}"
            jobs.append(Job(label, better, (env_id, drag)))
    try:
        run_jobs(jobs, options.processes, console)
    except KeyboardInterrupt:
        sys.exit("interrupted; what was found is kept, and the same command looks on from there")
    with console.status("replaying"):
        table = _table(options)
    console.print(table)


if __name__ == "__main__":
    # Under its own name, so that other processes find what is sent to them.
    from training.optimal import Optimal, main

    main(tyro.cli(Optimal, prog="python -m training.optimal"))
