"""The tables of a comparison, for the terminal and for a file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from rich.table import Table

__all__ = ["markdown", "tables"]

_HEADINGS = ("", "distance (m)", "energy (J)", "cost of transport", "simulated", "CPU (s)")
_IN_TERMINAL = 4


def tables(results: Mapping[str, Any]) -> Iterator[Table]:
    """Tables for the terminal, one for each environment, without the columns that 80 characters do not hold."""
    for env_id, one in results["environments"].items():
        shown = Table(title=f"{env_id}\n{_verdict(one)}")
        for heading in _HEADINGS[:_IN_TERMINAL]:
            shown.add_column(heading, justify="right" if heading else "left")
        for row in _rows(one):
            shown.add_row(*row[:_IN_TERMINAL])
        yield shown


def markdown(results: Mapping[str, Any]) -> str:
    """The same tables as a Markdown document, with the command that made them."""
    lines = []
    for env_id, one in results["environments"].items():
        lines += [f"## {env_id}", "", f"![{env_id}]({env_id.rpartition('/')[2]}.png)", "", _verdict(one), ""]
        lines += [_line(_HEADINGS), _line(["---"] + ["---:"] * (len(_HEADINGS) - 1)), *map(_line, _rows(one)), ""]
    machine = results["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    lines += [
        "Mean ± standard deviation: over episodes, and over the seeds' means in the last row. Distance is along the "
        "mechanism's forward direction, energy is the integral of |torque × joint rate|, cost of transport is energy "
        "over weight times distance; *simulated* is what the tuning or the training took.",
        "",
        f"`{results['command']}`, {machine['logical_cpus']} × {machine['processor']}, {versions}. "
        f"{results['wall_s']:.0f} s by the clock in the last call, {results['cpu_s']:.0f} s of CPU time in all.",
        "",
    ]
    return "\n".join(lines)


def _verdict(one: Mapping[str, Any]) -> str:
    judged = (*one["gaits"].values(), *one["ppo"])
    change = max(abs(c["distance_m"]["mean"] - c["distance_m_finely_integrated"]["mean"]) for c in judged)
    farther = " and ".join(f"{count} farther than the {name}" for name, count in one["seeds_farther_than"].items())
    return (
        f"Of {len(one['ppo'])} PPO seeds, {farther}. With {one['config']['evaluation']['fine_substeps']} integrator "
        f"steps a hold no mean distance changes by more than {change:.1g} m."
    )


def _rows(one: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    policies = one["ppo"]
    for name, gait in one["gaits"].items():
        yield (name, *_numbers(gait), f"{gait['episodes']:,} episodes", f"{gait['cpu_s']:.0f}")
    for policy in policies:
        yield (f"PPO, seed {policy['seed']}", *_numbers(policy), f"{policy['steps']:,} steps", f"{policy['cpu_s']:.0f}")
    cpu = sum(policy["cpu_s"] for policy in policies)
    yield (f"PPO, {len(policies)} seeds", *_numbers(one["ppo_over_seeds"]), "", f"{cpu:.0f}")


def _numbers(one: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(
        f"{one[metric]['mean']:.{digits}f} ± {one[metric]['std']:.{digits}f}"
        for metric, digits in (("distance_m", 2), ("energy_j", 1), ("cost_of_transport", 4))
    )


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
