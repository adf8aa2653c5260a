"""The figure of a comparison: where the mechanism went, how learning went, and what the joints did."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from nhenv.render import marker_of
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
TARGET = "#009E73"  # the green of pictures
WINDOW = 4.0  # s, the first ones where there is a target to reach, else the last ones of the episode
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
    beside: int,
    curves: Sequence[Sequence[Mapping[str, Any]]],
    reached: Mapping[str, float],
) -> None:
    """Write the figure as PNG, legible at 900 pixels.

    Args:
        path: file.
        title: heading.
        envs: environments of the episodes.
        shown: controllers, the policy last.
        beside: which of them is drawn beside the policy over time.
        curves: learning curve of each seed.
        reached: gait -> what a learning curve would show of it.
    """
    height, lines = _height_of_paths(envs, shown), 0.25 * -(-(len(reached) + 1) // IN_A_ROW)
    figure = Figure(figsize=(9, 9.9 + height + lines), dpi=150, layout="constrained")
    figure.suptitle(title, fontweight="bold")
    axes = figure.subplot_mosaic(
        [
            ["path", "path"],
            ["heading", "way"],
            ["legend", "legend"],
            ["curve0", "curve1"],
            ["angle0", "angle1"],
            ["torque0", "torque1"],
        ],
        height_ratios=[height, 1.9, lines, 2.3, 1.8, 1.8],
    )
    marker, pair = _marker(envs, shown[0]), (shown[beside], shown[-1])
    _paths(axes["path"], envs, shown, marker)
    _headings(axes["heading"], envs, pair, marker)
    _ways(axes["way"], envs, pair, marker)
    for i, against in enumerate(AGAINST):
        _curves(axes[f"curve{i}"], envs, curves, reached, *against)
    axes["curve1"].sharey(axes["curve0"])
    axes["legend"].axis("off")
    entries = axes["curve0"].get_legend_handles_labels()
    axes["legend"].legend(*entries, loc="center", ncols=min(len(entries[1]), IN_A_ROW), frameon=False)
    for i, one in enumerate(pair):
        _angles(axes[f"angle{i}"], envs, one)
        _torques(axes[f"torque{i}"], envs, one)
    for name in ("angle", "torque"):
        both = [axes[f"{name}{i}"] for i in range(2)]
        low, high = zip(*(ax.get_ylim() for ax in both), strict=True)
        for ax in both:
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


def _marker(envs: LocomotionVectorEnv, one: Shown) -> dict[str, float]:
    """Where the target of the episode is, with the keys of the task's marker."""
    numbers = {name: values[0] for name, values in one.episodes.targets.items()}
    return marker_of(envs.task, {**envs.task.weights, **numbers})


def _paths(ax: Axes, envs: LocomotionVectorEnv, shown: Sequence[Shown], marker: Mapping[str, float]) -> None:
    x, y, _ = (envs.mechanism.coordinates.index(name) for name in envs.mechanism.fibre)
    for one in shown:
        q = one.episodes.q[0]
        ax.plot(q[:, x], q[:, y], color=one.color, label=one.label, lw=1.2)
        ax.plot(*q[-1, [x, y]], "o", color=one.color, ms=5)
    if marker:
        x_of, y_of, radius = marker["x"], marker["y"], marker.get("radius", 0.0)
        ax.add_patch(Circle((x_of, y_of), radius, color=TARGET, alpha=0.4, lw=0, label="target"))
        if "heading" in marker:
            tip = x_of + radius * np.cos(marker["heading"]), y_of + radius * np.sin(marker["heading"])
            ax.annotate("", tip, (x_of, y_of), arrowprops={"arrowstyle": "->"})
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x (m)", ylabel="y (m)")
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 0.98), ncols=IN_A_ROW, frameon=False)


def _headings(ax: Axes, envs: LocomotionVectorEnv, shown: Sequence[Shown], marker: Mapping[str, float]) -> None:
    heading = envs.mechanism.coordinates.index(envs.mechanism.fibre[2])
    for one in shown:
        last = int(one.episodes.steps[0])
        ax.plot(np.arange(last + 1) * envs.dt, one.episodes.q[0, : last + 1, heading], color=one.color, lw=1.2)
    if "heading" in marker:
        ax.axhline(marker["heading"], color=TARGET, ls="--", lw=1.2)
    ax.set(xlabel="time (s)", ylabel="heading (rad)")


def _ways(ax: Axes, envs: LocomotionVectorEnv, shown: Sequence[Shown], marker: Mapping[str, float]) -> None:
    """How far each is from its target or, where there is no place to reach, how fast it goes."""
    x, y, _ = (envs.mechanism.coordinates.index(name) for name in envs.mechanism.fibre)
    for one in shown:
        last = int(one.episodes.steps[0])
        time, q = np.arange(last + 1) * envs.dt, one.episodes.q[0, : last + 1]
        if marker:
            ax.plot(time, np.hypot(q[:, x] - marker["x"], q[:, y] - marker["y"]), color=one.color, lw=1.2)
        else:
            ax.stairs(np.diff(q[:, x]) / envs.dt, time, baseline=None, color=one.color, lw=1.2)
    if "radius" in marker:
        ax.axhline(marker["radius"], color=TARGET, ls="--", lw=1.2)
    ax.set(xlabel="time (s)", ylabel="way to the target (m)" if marker else "velocity along x (m/s)")


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
    # What lies far below all gaits would flatten the rest.
    ends = sorted((*reached.values(), float(median[-1])), key=lambda value: metric.better * value)
    limit, (bottom, top) = 2 * ends[0] - ends[-1], ax.get_ylim()
    ax.set_ylim(*((max(bottom, limit), top) if metric.better > 0 else (bottom, min(top, limit))))


def _angles(ax: Axes, envs: LocomotionVectorEnv, one: Shown) -> None:
    time, window, when = _window(envs, one)
    for i, joint in enumerate(joint_index(envs.mechanism)):
        name = envs.mechanism.coordinates[joint]
        angle, label = one.episodes.q[0, window, joint], f"${mathtext(name)}$"
        if name not in envs.mechanism.joint_limits:  # a rotor may also turn steadily, which would dwarf the rest
            angle, label = angle - _drift(angle), f"{label}, drift removed"
        ax.plot(time, angle, color=JOINTS[i], ls=STYLES[i], label=label)
    ax.set(ylabel="joint angle (rad)", title=f"{one.label}, {when}")
    _legend_above(ax)


def _torques(ax: Axes, envs: LocomotionVectorEnv, one: Shown) -> None:
    time, window, _ = _window(envs, one)
    for i, control in enumerate(envs.mechanism.controls):
        torque = one.episodes.torques[0, window[:-1], i]
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


def _window(envs: LocomotionVectorEnv, one: Shown) -> tuple[np.ndarray, np.ndarray, str]:
    """Times of the part of the episode that is shown of the joints, its steps, and what part it is."""
    steps, shown = int(one.episodes.steps[0]), round(WINDOW / envs.dt)  # its own: others may last longer
    first = 0 if envs.task.targets else max(0, steps - shown)
    window = np.arange(first, min(steps, first + shown) + 1)
    return window * envs.dt, window, f"{'first' if envs.task.targets else 'last'} {WINDOW:g} s"
