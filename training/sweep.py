"""Train with many settings, several seeds each, and compare them.

python -m training.sweep --env-id nhenv/SnakeboardForward-v0 --gamma 0.99 0.999 0.9999 --seeds 0 1 2
python -m training.sweep --env-id nhenv/SnakeboardForward-v0 --gamma 0.99..0.9999 --clip-range 0.1..0.3 --draws 8

Every field of `PPOConfig` is an option that takes several values, and all their combinations are
trained; a range LOW..HIGH is drawn from instead, --draws times. Finished runs are found by their settings,
so a sweep goes on where it was interrupted, and a larger one takes over what a smaller one did.

Settings are judged on the starts for tuning, so that choosing among them does not touch those on which
everything is judged in the end.
"""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import os
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.stats import qmc

from training.config import TUNING_SEEDS, PPOConfig, check_env_id, for_env
from training.evaluate import evaluate, load_policy
from training.metrics import headline
from training.options import Seeds, check_seeds
from training.progress import Job, run_jobs
from training.report import cell, markdown_table
from training.rollout import make_envs
from training.statistics import summary
from training.store import machine, read_json, versions, write_bytes, write_json
from training.train import ppo_path, train_piece

__all__ = ["Range", "Sweep", "combinations", "parsed", "sweep"]

# Swept by name; what an environment is made with and how it is seen are the same for all.
FIELDS = tuple(f.name for f in dataclasses.fields(PPOConfig) if f.name not in ("env_kwargs", "observation_scale"))
# Of these, what is missing to 1 is drawn evenly in its logarithm: 0.99 to 0.999 is as far as 0.999 to 0.9999.
DISCOUNTS = ("gamma", "gae_lambda")
DIGITS = 3  # of a number that is drawn; of what is missing to 1 of a discount


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`, drawn evenly: in their logarithm if both are positive.

    Attributes:
        name: field of `PPOConfig`.
        low: smallest.
        high: largest.
        whole: whether it is for whole numbers.
    """

    name: str
    low: float
    high: float
    whole: bool

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(f"{self.name}: a range is LOW..HIGH with LOW below HIGH, got {self.low}..{self.high}")
        if self.name in DISCOUNTS and self.high >= 1:
            raise ValueError(f"{self.name}: a range of discounts must end below 1, got {self.low}..{self.high}")

    def at(self, share: float) -> float | int:
        """The number at this share of the way from `low` to `high`."""
        if self.name in DISCOUNTS:
            return 1 - _rounded(_between(1 - self.low, 1 - self.high, share))
        number = _rounded(_between(self.low, self.high, share))
        return round(number) if self.whole else number


def parsed(name: str, text: str) -> Any:
    """Value, or range, of a field of `PPOConfig`; fields of several numbers have commas between them."""
    default = getattr(PPOConfig(), name)
    try:
        if ends := re.fullmatch(r"(.+)\.\.(.+)", text):
            if isinstance(default, tuple | str):
                raise ValueError
            return Range(name, float(ends[1]), float(ends[2]), isinstance(default, int))
        if isinstance(default, tuple):
            return tuple(type(default[0])(part) for part in text.split(","))
        return type(default)(text)
    except ValueError as problem:
        if str(problem).startswith(f"{name}:"):
            raise
        more = {"tuple": ", with commas between", "str": ""}.get(type(default).__name__, ", or a range LOW..HIGH")
        raise ValueError(f"{name}: expected a value such as {_text(default)}{more}; got {text!r}") from None


def combinations(given: Mapping[str, Sequence[str]], draws: int) -> list[dict[str, Any]]:
    """Fields of each setting: all combinations of the values, each with every draw from the ranges.

    Args:
        given: field -> texts, as `parsed` takes them.
        draws: how many points are drawn from the ranges together: the first of a Halton sequence, which fills a box
            more evenly than random points, and of which more draws only add to fewer. A range is one text alone.
    """
    values = {name: [parsed(name, text) for text in texts] for name, texts in given.items() if texts}
    ranges = [one for several in values.values() for one in several if isinstance(one, Range)]
    for one in ranges:
        if len(values.pop(one.name, [])) != 1:
            raise ValueError(f"{one.name}: give one range alone, or values; got {' '.join(given[one.name])}")
    if bool(ranges) != (draws > 0):
        raise ValueError(f"--draws is for ranges LOW..HIGH, and they need it: got {draws} draws, {len(ranges)} ranges")
    # Unscrambled, it begins in a corner, which is left out.
    points = qmc.Halton(len(ranges), scramble=False).fast_forward(1).random(draws) if ranges else [()]
    drawn = [{one.name: one.at(share) for one, share in zip(ranges, point, strict=True)} for point in points]
    grid = [dict(zip(values, chosen, strict=True)) for chosen in itertools.product(*values.values())]
    return [{**chosen, **numbers} for chosen in grid for numbers in drawn]


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Which settings to train with, on which environment.

    Attributes:
        env_id: environment.
        fields: field of `PPOConfig` -> its values or its range as text; the others are those of the task.
        draws: how many points are drawn from ranges.
        seeds: numbers of the runs with each setting; 0-9 is short for ten of them.
        drag: let the mechanism's drag act.
        out: folder of the results.
        processes: processes side by side.
    """

    env_id: str
    fields: Mapping[str, Sequence[str]] = field(default_factory=dict)
    draws: int = 0
    seeds: Seeds = (0, 1, 2)
    drag: bool = False
    out: Path = Path("runs/sweep")
    processes: int = os.cpu_count() or 1

    def __post_init__(self) -> None:
        check_env_id(self.env_id)
        check_seeds(self.seeds)
        if self.processes < 1:
            raise ValueError(f"processes must be at least 1, got {self.processes}")
        self.settings()

    def settings(self) -> list[tuple[dict[str, Any], PPOConfig]]:
        """Each setting: what is varied, and the whole of it."""
        config = for_env(self.env_id, self.drag).ppo
        return [(one, dataclasses.replace(config, **one)) for one in combinations(self.fields, self.draws)]

    def jobs(self) -> list[Job]:
        """What is not done yet."""
        return [
            Job(f"{_label(varied)} seed {seed}", train_piece, (self.env_id, config, seed, self.out))
            for seed in self.seeds
            for varied, config in self.settings()
            if not ppo_path(self.env_id, config, seed, self.out).exists()
        ]


def sweep(options: Sweep, command: Sequence[str], console: Console) -> dict[str, Any]:
    """Train what is left to train, judge everything, write sweep.json and sweep.md; return what the former holds."""
    run_jobs(options.jobs(), options.processes, console)
    judging = for_env(options.env_id, options.drag).evaluation
    metric = headline(make_envs(options.env_id, 1, **judging.env_kwargs).task)
    rows: list[dict[str, Any]] = []
    for varied, config in options.settings():
        scores, cpu_s = [], []
        for seed in options.seeds:
            path = ppo_path(options.env_id, config, seed, options.out)
            _, numbers = evaluate(load_policy(path.with_suffix(".zip")), options.env_id, judging, seeds=TUNING_SEEDS)
            scores.append(numbers[metric.name])
            cpu_s.append(read_json(path)["result"]["cpu_s"])
        over_seeds = summary(np.array(scores), metric.statistic)
        rows.append({"setting": varied, metric.name: over_seeds, "cpu_s": float(np.median(cpu_s))})
    rows.sort(key=lambda row: -metric.better * row[metric.name]["estimate"])
    results = {
        "command": shlex.join(command),
        "env_id": options.env_id,
        "env_kwargs": judging.env_kwargs,
        "seeds": options.seeds,
        "episodes": judging.episodes,
        "machine": machine(),
        "versions": versions(),
        "settings": rows,
    }
    headings = [*(rows[0]["setting"] or {"setting": ""}), metric.heading, "worst", "best", "CPU (s)"]
    cells = [
        [
            *(map(_text, row["setting"].values()) if row["setting"] else ["as it is"]),
            cell(row[metric.name], metric),
            *(f"{row[metric.name][end]:.{metric.digits}f}" for end in ("min", "max")[:: metric.better]),
            f"{row['cpu_s']:.0f}",
        ]
        for row in rows
    ]
    title = f"{options.env_id}, {len(options.seeds)} seeds of {judging.episodes} episodes: {metric.statistic}"
    write_json(options.out / "sweep.json", results)
    text = f"## {title}\n\n{markdown_table(headings, cells)}\n\n`{results['command']}`\n"
    write_bytes(options.out / "sweep.md", text.encode())
    table = Table(*headings, title=title)
    for row in cells:
        table.add_row(*row)
    console.print(table)
    console.print(f"written to {options.out}: sweep.json and sweep.md")
    return results


def _between(low: float, high: float, share: float) -> float:
    if low > 0 and high > 0:
        return float(low * (high / low) ** share)
    return low + share * (high - low)


def _rounded(number: float) -> float:
    return float(f"{number:.{DIGITS}g}")


def _label(varied: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {_text(value)}" for name, value in varied.items()) or "as it is"


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line: the fields of `PPOConfig` are options of it."""
    own = [f for f in dataclasses.fields(Sweep) if f.name != "fields"]
    hints = {"env_id": str, "draws": int, "seeds": Seeds, "drag": bool, "out": Path, "processes": int}
    entries: list[Any] = [
        (f.name, hints[f.name]) if f.default is dataclasses.MISSING else (f.name, hints[f.name], f.default) for f in own
    ]
    swept: list[Any] = [(name, tuple[str, ...], ()) for name in FIELDS]
    # What each option means is said where it is declared.
    attributes = (inspect.cleandoc(str(one.__doc__)).partition("Attributes:")[2] for one in (Sweep, PPOConfig))
    said = {"__doc__": f"Settings of a sweep.\n\nAttributes:{''.join(attributes)}"}
    command = dataclasses.make_dataclass("Command", entries + swept, namespace=said)
    given = dict(vars(tyro.cli(command, prog="python -m training.sweep", description=__doc__, args=arguments)))
    options = Sweep(fields={name: given.pop(name) for name in FIELDS}, **given)
    called = ["python", "-m", "training.sweep", *(sys.argv[1:] if arguments is None else arguments)]
    try:
        sweep(options, called, Console())
    except KeyboardInterrupt:
        sys.exit("interrupted; what is finished is kept, and the same command goes on from there")


if __name__ == "__main__":
    main()
