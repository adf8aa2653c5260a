"""The tables of a comparison, for the terminal and for a file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from rich.table import Table

from training.metrics import METRICS, Metric, metric_of

__all__ = ["cell", "markdown", "markdown_table", "tables"]

NOTHING = "–"
NOTE = (
    "Interquartile means with 95 % intervals (of success the mean), over the starts, and in the last row over seeds "
    "and starts: 2000 resamples of seeds, and of the starts of each. The interval of a gait knows nothing of the luck "
    "of its tuning. Distance is along the mechanism's forward direction, energy is the integral of |torque × joint "
    "rate|, cost of transport is energy over weight times distance; time to success counts an episode without one as "
    "long as it may last; *of the strongest known* is the share of what direct optimal control reaches; *PPO passes "
    "it after* is the CPU time at which a seed's learning curve is first above what it would show of the gait, the "
    "mean over the starts of the curve, in the median over seeds; "
    "*simulated* is what the tuning or the training took."
)
_IN_TERMINAL = 4


def tables(results: Mapping[str, Any]) -> Iterator[Table]:
    """Tables for the terminal, one for each environment, without the columns that 80 characters do not hold."""
    for env_id, one in results["environments"].items():
        headings, rows = _table(one)
        shown = Table(title=f"{env_id}\n{_verdict(one)}")
        for heading in headings[:_IN_TERMINAL]:
            shown.add_column(heading, justify="right" if heading else "left")
        for row in rows:
            shown.add_row(*row[:_IN_TERMINAL])
        yield shown


def markdown(results: Mapping[str, Any]) -> str:
    """The same tables as a Markdown document, with the command that made them."""
    lines = []
    for env_id, one in results["environments"].items():
        lines += [f"## {env_id}", "", f"![{env_id}]({env_id.rpartition('/')[2]}.png)", "", _verdict(one), ""]
        lines += [markdown_table(*_table(one)), ""]
    machine = results["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    lines += [
        NOTE,
        "",
        f"`{results['command']}`, {machine['logical_cpus']} × {machine['processor']}, {versions}. "
        f"{results['wall_s']:.0f} s by the clock in the last call, {results['cpu_s']:.0f} s of CPU time in all.",
        "",
    ]
    return "\n".join(lines)


def markdown_table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown, the first column to the left and the others to the right."""
    return "\n".join(map(_line, [headings, ["---"] + ["---:"] * (len(headings) - 1), *rows]))


def cell(summary: Mapping[str, Any], metric: Metric) -> str:
    """An estimate with its interval."""
    estimate, low, high = (_number(summary[key], metric.digits) for key in ("estimate", "low", "high"))
    return NOTHING if estimate == NOTHING else f"{estimate} [{low}, {high}]"


def _verdict(one: Mapping[str, Any]) -> str:
    first = metric_of(one["headline"])
    better = "; ".join(f"{name} {count}" for name, count in one["seeds_better_than"].items())
    changes = [
        abs(judged["finely_integrated"]["estimate"] / judged[first.name]["estimate"] - 1)
        for judged in (*one["gaits"].values(), *one["ppo"])
        if judged[first.name]["estimate"]
    ]
    most = max(changes, default=0.0)
    by_how_much = f" by more than {100 * most:.1g} %" if most else ""
    return (
        f"By {first.heading}, of {len(one['ppo'])} PPO seeds so many are better than: {better}. At a tenth of the "
        f"integrator's step none changes{by_how_much}."
    )


def _table(one: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of an environment's table."""
    first, *others = (metric for metric in METRICS if metric.name in one["ppo_over_seeds"])
    reference = one["reference"]
    headings = [
        "", first.heading, *([] if reference is None else ["of the strongest known"]),
        *(metric.heading for metric in others), "at a tenth of the step", "PPO passes it after (CPU s)", "simulated",
        "CPU (s)",
    ]  # fmt: skip

    def row(name: str, judged: Mapping[str, Any], passed: str, simulated: str, cpu_s: float) -> list[str]:
        share = [] if reference is None else [f"{100 * judged[first.name]['estimate'] / reference:.1f} %"]
        numbers = [cell(judged[metric.name], metric) for metric in others]
        fine = _number(judged["finely_integrated"]["estimate"], first.digits + 1)
        return [name, cell(judged[first.name], first), *share, *numbers, fine, passed, simulated, f"{cpu_s:.0f}"]

    rows = []
    for name, gait in one["gaits"].items():
        passed = _number(one["cpu_s_to_pass"][name], 1)
        rows.append(row(name, gait, passed, f"{gait['episodes']:,} episodes", gait["cpu_s"]))
    policies = one["ppo"]
    for policy in policies:
        rows.append(row(f"PPO, seed {policy['seed']}", policy, "", f"{policy['steps']:,} steps", policy["cpu_s"]))
    cpu = sum(policy["cpu_s"] for policy in policies)
    rows.append(row(f"PPO, {len(policies)} seeds", one["ppo_over_seeds"], "", "", cpu))
    return headings, rows


def _number(value: float | None, digits: int) -> str:
    """A number, if it is one: the cost of transport of what does not move is none."""
    return NOTHING if value is None or not math.isfinite(value) else f"{value:z.{digits}f}"


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
