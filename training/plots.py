"""The figure of a comparison: where the mechanism went, what its joints did, and how learning went."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nhenv.vector_env import LocomotionVectorEnv
from training.metrics import headline, joint_index
from training.rollout import Rollout
from training.store import write_bytes

__all__ = ["GAITS", "POLICY", "Shown", "draw", "mathtext", "median_and_range"]

# Okabe and Ito's colours, which the colour-blind tell apart; line styles repeat what colours say.
GAITS, POLICY = ("#0072B2", "#56B4E9", "#009E73", "#E69F00", "#CC79A7", "#000000"), "#D55E00"
JOINTS = ("#000000", "#009E73", "#CC79A7", "#E69F00")
STYLES = ("-", "--", "-.", ":")
GREEK = ("theta", "psi", "phi")
WINDOW = 4.0  # s, the last ones of the episode
IN_A_ROW = 4  # entries of a legend

# What learning curves are drawn against: key of their points, label, and how many there are of the unit of the label.
AGAINST = (("steps", "environment steps (millions)", 1e6), ("cpu_s", "CPU time of a seed (s)", 1.0))


@dataclass(frozen=True)
class Shown:
    """What is drawn of one controller.

    Attributes:
        label: its name.
        color: its colour.
        episodes: recorded episodes, of which the first is drawn.
    """

    label: str
    color: str
    episodes: Rollout


def draw(
    path: Path,
    title: str,
    envs: LocomotionVectorEnv,
    shown: Sequence[Shown],
    curves: Sequence[Sequence[Mapping[str, Any]]],
    reached: Mapping[str, float],
) -> None:
    """Write the figure as PNG, legible at 900 pixels.

    Args:
        path: file.
        title: heading.
        envs: environments of the episodes.
        shown: controllers; the joints of the first and the last are drawn side by side.
        curves: learning curve of each seed.
        reached: gait -> its value of the metric by which the task is judged.
    """
    height, lines = _height_of_paths(envs, shown), 0.25 * -(-(len(reached) + 1) // IN_A_ROW)
    figure = Figure(figsize=(9, 7.7 + height + lines), dpi=150, layout="constrained")
    figure.suptitle(title, fontweight="bold")
    axes = figure.subplot_mosaic(
        [["path", "path"], ["legend", "legend"], ["curve0", "curve1"], ["angle0", "angle1"], ["torque0", "torque1"]],
        height_ratios=[height, lines, 2.3, 1.8, 1.8],
    )
    _paths(axes["path"], envs, shown)
    for i, against in enumerate(AGAINST):
        _curves(axes[f"curve{i}"], envs, curves, reached, *against)
    axes["curve1"].sharey(axes["curve0"])
    axes["legend"].axis("off")
    entries = axes["curve0"].get_legend_handles_labels()
    axes["legend"].legend(*entries, loc="center", ncols=min(len(entries[1]), IN_A_ROW), frameon=False)
    for i, one in enumerate((shown[0], shown[-1])):
        _angles(axes[f"angle{i}"], envs, one)
        _torques(axes[f"torque{i}"], envs, one)
    for name in ("angle", "torque"):
        pair = [axes[f"{name}{i}"] for i in range(2)]
        low, high = zip(*(ax.get_ylim() for ax in pair), strict=True)
        for ax in pair:
            ax.set_ylim(min(low), max(high))
    for ax in axes.values():
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(alpha=0.3)
    content = io.BytesIO()
    figure.savefig(content, format="png")
    write_bytes(path, content.getvalue())


def mathtext(name: str) -> str:
    """Name in the notation of Matplotlib's formulas: u_psi is u with the index ψ."""
    return "_".join(rf"\{part}" if part in GREEK else part for part in name.split("_"))


def _height_of_paths(envs: LocomotionVectorEnv, shown: Sequence[Shown]) -> float:
    """Height in inches at which the paths fill the width of the figure, and a line of legend fits."""
    x, y, _ = (envs.mechanism.coordinates.index(name) for name in envs.mechanism.fibre)
    wide, high = (np.ptp(np.concatenate([one.episodes.q[0][:, i] for one in shown])) for i in (x, y))
    return float(np.clip(9 * high / max(wide, 1e-9), 0.5, 3.5)) + 0.5


def _paths(ax: Axes, envs: LocomotionVectorEnv, shown: Sequence[Shown]) -> None:
    x, y, _ = (envs.mechanism.coordinates.index(name) for name in envs.mechanism.fibre)
    for one in shown:
        q = one.episodes.q[0]
        ax.plot(q[:, x], q[:, y], color=one.color, label=one.label, lw=1.2)
        ax.plot(*q[-1, [x, y]], "o", color=one.color, ms=5)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x (m)", ylabel="y (m)")
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 0.98), ncols=min(len(shown), IN_A_ROW), frameon=False)


def median_and_range(
    curves: Sequence[Sequence[Mapping[str, Any]]], key: str, metric: str, count: int = 200
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where all seeds have a curve: places (count,), and there the median, the lowest and the highest of the seeds.

    Args:
        curves: learning curve of each seed.
        key: what the curves are drawn against.
        metric: what is drawn; linear between the points of a curve.
        count: number of places.
    """
    where = [[point[key] for point in curve] for curve in curves]
    places = np.linspace(max(one[0] for one in where), min(one[-1] for one in where), count)
    values = [[point[metric] for point in curve] for curve in curves]
    seeds = np.array([np.interp(places, *one) for one in zip(where, values, strict=True)])
    return places, np.median(seeds, axis=0), seeds.min(axis=0), seeds.max(axis=0)


def _curves(
    ax: Axes,
    envs: LocomotionVectorEnv,
    curves: Sequence[Sequence[Mapping[str, Any]]],
    reached: Mapping[str, float],
    key: str,
    label: str,
    unit: float,
) -> None:
    metric = headline(envs.task)
    for i, (gait, value) in enumerate(reached.items()):
        color, style = GAITS[i % len(GAITS)], STYLES[i % len(STYLES)]
        ax.axhline(value, color=color, ls=style, lw=2, label=gait)
    places, median, low, high = median_and_range(curves, key, metric.name)
    several = f"median and range of {len(curves)} seeds" if len(curves) > 1 else "one seed"
    ax.fill_between(places / unit, low, high, color=POLICY, alpha=0.25, lw=0)
    ax.plot(places / unit, median, color=POLICY, lw=1.6, label=f"PPO, {several}")
    ax.set(xlabel=label, ylabel=metric.heading)


def _angles(ax: Axes, envs: LocomotionVectorEnv, one: Shown) -> None:
    time, last = _window(envs, one)
    for i, joint in enumerate(joint_index(envs.mechanism)):
        name = envs.mechanism.coordinates[joint]
        angle, label = one.episodes.q[0, last, joint], f"${mathtext(name)}$"
        if name not in envs.mechanism.joint_limits:  # a rotor may also turn steadily, which would dwarf the rest
            angle, label = angle - _drift(angle), f"{label}, drift removed"
        ax.plot(time, angle, color=JOINTS[i], ls=STYLES[i], label=label)
    ax.set(ylabel="joint angle (rad)", title=f"{one.label}, last {WINDOW:g} s")
    _legend_above(ax)


def _torques(ax: Axes, envs: LocomotionVectorEnv, one: Shown) -> None:
    time, last = _window(envs, one)
    for i, control in enumerate(envs.mechanism.controls):
        torque = one.episodes.torques[0, last[:-1], i]
        ax.stairs(torque, time, baseline=None, color=JOINTS[i], ls=STYLES[i], lw=1.3, label=f"${mathtext(control)}$")
    ax.set(xlabel="time (s)", ylabel="torque (N m)")
    _legend_above(ax)


def _legend_above(ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.25 * (high - low))  # room for the legend
    ax.legend(handles, labels, loc="upper right", frameon=False, ncols=len(labels), borderaxespad=0)


def _drift(values: np.ndarray) -> np.ndarray:
    """Parabola through values."""
    steps = np.arange(len(values))
    return np.polynomial.Polynomial.fit(steps, values, 2)(steps)


def _window(envs: LocomotionVectorEnv, one: Shown) -> tuple[np.ndarray, np.ndarray]:
    steps = int(one.episodes.steps[0])  # its own: others may last longer
    last = np.arange(max(0, steps - round(WINDOW / envs.dt)), steps + 1)
    return last * envs.dt, last
