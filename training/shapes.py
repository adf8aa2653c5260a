"""What controllers do with the shape: loops over the height functions of the local connection, and phase portraits.

python -m training.shapes runs/compare/SnakeboardForward-v0/{gait,ppo-seed0}-*.json --out shapes.png
"""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from rich.console import Console
from scipy.interpolate import CubicSpline

from mechanics.geometry.local_connection import height_functions, shape_coordinates
from training.actors import actors_of
from training.config import EVALUATION_SEEDS
from training.film import Take, record
from training.plots import mathtext
from training.store import write_bytes

__all__ = ["Shapes", "draw", "loops", "shapes"]

Array = NDArray[np.float64]

# Okabe and Ito's orange, black, green and purple, which stand out from the blue and red of the heights, and from one
# another for the colour-blind; line styles repeat what colours say.
COLOURS = ("#000000", "#E69F00", "#009E73", "#CC79A7")
STYLES = ("-", "-", "--", ":")
HEIGHTS = (("along", "m/rad²"), ("across", "m/rad²"), ("turning", "rad/rad²"))
PARTS = 6  # of a step, so that curves look like curves
GRID = 81  # points each way
MARGIN = 0.15  # of the range of the loops that is shown around them


def loops(take: Take, first: float, last: float) -> tuple[Array, Array]:
    """Shape coordinates and their rates, shape (t, s) each, from the time `first` to `last` in s.

    Between the recorded states, cubic splines through them have `PARTS` points a step. What a joint without stops turns
    steadily is taken out of its angle, lest the loops run out of the picture; nothing depends on such an angle.
    """
    mechanism, dt = take.envs.mechanism, take.envs.dt
    names = shape_coordinates(mechanism)
    steps = np.arange(max(0, round(first / dt)), min(len(take.q) - 1, round(last / dt)) + 1)
    if len(steps) < 3:
        raise ValueError(
            f"{take.label} lasts {(len(take.q) - 1) * dt:g} s: nothing of it lies in {first:g} to {last:g} s"
        )
    way = CubicSpline(dt * steps, take.q[steps][:, [mechanism.coordinates.index(name) for name in names]])
    time = dt * np.linspace(steps[0], steps[-1], PARTS * (len(steps) - 1) + 1)
    r, rates = way(time), way(time, 1)
    for i, name in enumerate(names):
        if name not in mechanism.joint_limits:
            r[:, i] -= np.polynomial.Polynomial.fit(time, r[:, i], 1)(time)
    return r, rates


def draw(takes: Sequence[Take], title: str, first: float, last: float) -> bytes:
    """The figure as PNG, legible at 900 pixels."""
    mechanism = takes[0].envs.mechanism
    names = shape_coordinates(mechanism)
    moved = [loops(take, first, last) for take in takes]
    two = len(names) == 2
    figure = Figure(figsize=(9, 6.4 if two else 4.0), dpi=150, layout="constrained")
    figure.suptitle(title, fontweight="bold")
    portraits = [f"portrait{i}" for i in range(len(names))]
    columns = 6
    below = [portraits[min(i * len(names) // columns, len(names) - 1)] for i in range(columns)]
    above = [HEIGHTS[i // 2][0] for i in range(columns)]
    axes = figure.subplot_mosaic([above, below] if two else [below])  # type: ignore[list-item]
    if two:
        _heights(figure, [axes[name] for name, _ in HEIGHTS], takes, [r for r, _ in moved])
    for i, name in enumerate(names):
        ax = axes[portraits[i]]
        for k, (take, (r, rates)) in enumerate(zip(takes, moved, strict=True)):
            ax.plot(r[:, i], rates[:, i], color=COLOURS[k], ls=STYLES[k], lw=1.4, label=take.label)
        ax.set(xlabel=_angle(mechanism.joint_limits, name), ylabel=f"$\\dot{{{mathtext(name)}}}$ (rad/s)")
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
    handles, labels = axes[portraits[0]].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(takes), frameon=False)
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()


def _heights(figure: Figure, axes: Sequence[Axes], takes: Sequence[Take], moved: Sequence[Array]) -> None:
    mechanism, params = takes[0].envs.mechanism, takes[0].envs.params
    names = shape_coordinates(mechanism)
    points = np.concatenate(moved)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = MARGIN * (high - low)
    grids = np.meshgrid(
        *(np.linspace(a, b, GRID) for a, b in zip(low - margin, high + margin, strict=True)), indexing="ij"
    )
    heights = height_functions(mechanism, np.stack(grids, axis=-1), params)
    for j, (ax, (name, unit)) in enumerate(zip(axes, HEIGHTS, strict=True)):
        height = heights[..., j]
        most = max(float(np.abs(height).max()), 1e-12)
        vanishes = most < 1e-9  # it is rounding, which would look like something
        if vanishes:
            height, most = np.zeros_like(height), 1.0
        picture = ax.pcolormesh(
            *grids, height, cmap="RdBu_r", vmin=-1.5 * most, vmax=1.5 * most, shading="gouraud", rasterized=True
        )
        label, ticks = f"height {name} ({unit})", [0.0] if vanishes else [-most, 0.0, most]
        figure.colorbar(picture, ax=ax, location="top", label=label, ticks=ticks, format="%.2g", pad=0.02)
        for k, r in enumerate(moved):
            ax.plot(
                *r.T, color=COLOURS[k], ls=STYLES[k], lw=1.4, path_effects=[withStroke(linewidth=3, foreground="w")]
            )
        ax.set(xlabel=_angle(mechanism.joint_limits, names[0]), ylabel=_angle(mechanism.joint_limits, names[1]))


def _angle(stops: object, name: str) -> str:
    drifting = "" if name in stops else ", drift removed"  # type: ignore[operator]
    return f"${mathtext(name)}$ (rad{drifting})"


@dataclass(frozen=True, kw_only=True)
class Shapes:
    """Draw what controllers do with the shape, each from the same start.

    Loading a policy unpickles it, which can run any code: only draw files that you trust.

    Attributes:
        pieces: gait-*.json or ppo-*.zip of a results folder, or *.safetensors, one to four of one environment.
        labels: what the figure calls them, in their order.
        out: PNG to write.
        seed: number of the start, counted among those on which controllers are judged.
        first: where the window begins, in s.
        last: where it ends, in s.
    """

    pieces: tyro.conf.Positional[tuple[Path, ...]]
    labels: tuple[str, ...] = ()
    out: Path = Path("shapes.png")
    seed: int = 0
    first: float = 11.0
    last: float = 15.0

    def __post_init__(self) -> None:
        if not 1 <= len(self.pieces) <= len(COLOURS):
            raise ValueError(f"from 1 to {len(COLOURS)} files can be drawn, got {len(self.pieces)}")
        if not 0 <= self.first < self.last:
            raise ValueError(f"first must be at least 0 and before last, got {self.first} and {self.last}")


def shapes(options: Shapes, console: Console) -> None:
    """Record, draw and write."""
    actors = actors_of(options.pieces, options.labels)
    with console.status("recording"):
        takes = [record(one, EVALUATION_SEEDS + options.seed) for one in actors]
    title = f"{actors[0].env_id.rpartition('/')[2]}, from {options.first:g} to {options.last:g} s"
    write_bytes(options.out, draw(takes, title, options.first, options.last))
    console.print(f"{options.out} is written")


def main(options: Shapes) -> None:
    """Run from the command line."""
    try:
        shapes(options, Console())
    except KeyboardInterrupt:
        sys.exit("interrupted; nothing was written")


if __name__ == "__main__":
    main(tyro.cli(Shapes, prog="python -m training.shapes"))
