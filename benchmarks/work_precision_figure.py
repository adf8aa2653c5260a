"""The figure of `benchmarks.work_precision`: error against time, a panel for each mechanism."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from benchmarks.solvers import Point

__all__ = ["draw"]

OURS = {"single": "#c1272d", "batched": "#e8731a"}
WORDS = {"single": "one call a step", "batched": "at once"}
# Methods of ours; a star is the default.
MARKERS = {"default": "*", "lobatto": "o", "verner9": "s", "dop853": "D", "rk4": "^"}
# Library -> colour; its methods have different markers.
LIBRARIES = {
    "SciPy": "#3b6fb6",
    "diffrax": "#2a8f6d",
    "torchdiffeq": "#8a5fb0",
    "multipliers": "#777777",
    "MuJoCo": "#000000",
}
PEER_MARKERS = "ovsD^"


def draw(points: Sequence[Point], path: Path) -> None:
    """Write the figure; of ours at once, the largest number of environments."""
    mechanisms = list(dict.fromkeys(point.mechanism for point in points))
    figure, panels = plt.subplots(1, len(mechanisms), figsize=(6.4 * len(mechanisms), 6.6), sharey=True, squeeze=False)
    largest = max((p.contender.environments for p in points if p.contender.kind == "batched"), default=0)
    handles: dict[str, Any] = {}
    for panel, mechanism in zip(panels[0], mechanisms, strict=True):
        chosen = [point for point in points if point.mechanism == mechanism]
        names = dict.fromkeys(
            point.contender.name
            for point in chosen
            if point.contender.kind != "batched" or point.contender.environments == largest
        )
        for name in names:
            line = [point for point in chosen if point.contender.name == name]
            handles.setdefault(*_plot(panel, name, line, list(names)))
        panel.set(xscale="log", yscale="log", title=mechanism.replace("_", " "))
        panel.set_xlabel("largest error after 10 s (SI units, radians)")
        panel.set_xlim(1e-14, 30)
        panel.grid(which="major", color="#dddddd", linewidth=0.6)
        panel.set_axisbelow(True)
    panels[0, 0].set_ylabel("µs for a simulated second of one environment")
    labels = sorted(handles, key=_place)
    figure.legend(
        [handles[label] for label in labels], labels, loc="lower center", ncols=4, frameon=False, fontsize=8.5
    )
    figure.tight_layout(rect=(0, 0.17, 1, 1))
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _plot(panel: Any, name: str, line: list[Point], names: list[str]) -> tuple[str, Any]:
    kind = line[0].contender.kind
    errors, times = [max(point.error, 1e-14) for point in line], [point.time * 1e6 for point in line]
    if kind in OURS:
        method = name.removeprefix("nhenv ").split(",")[0]
        many = f"{line[0].contender.environments} " * (kind == "batched")
        label = f"nhenv {method}, {many}{WORDS[kind]}"
        style = {"color": OURS[kind], "marker": MARKERS.get(method, "P"), "linewidth": 1.6, "zorder": 4}
        style |= (
            {"markersize": 15, "markeredgecolor": "white", "zorder": 5} if method == "default" else {"markersize": 5}
        )
    else:
        library = next((library for library in LIBRARIES if name.startswith(library)), "")
        siblings = [other for other in names if library and other.startswith(library)]
        marker = PEER_MARKERS[siblings.index(name) % len(PEER_MARKERS)] if siblings else "x"
        label = name
        style = {"color": LIBRARIES.get(library, "#b0a000"), "marker": marker, "markersize": 4, "linewidth": 1}
    (handle,) = panel.plot(errors, times, **style)
    return label, handle


def _place(label: str) -> tuple[int, str]:
    order = ["nhenv", *LIBRARIES]
    return next((i for i, start in enumerate(order) if label.startswith(start)), len(order)), label
