"""What a picture of an environment shows: the mechanism from above on a grid of metres, its trail and its target.

A `View` knows what there is to see and where the camera is, a canvas of `nhenv.canvas` has the pixels. Who does not ask
for pictures never gets here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics.expressions import evaluate
from mechanics.mechanism import Mechanism
from mechanics.placing import Placed, place
from nhenv.canvas import Canvas, Colour, Window, pygame_module
from nhenv.tasks import Task

__all__ = ["COLOURS", "Projection", "Screen", "View", "grid_step", "marker_of"]

Array = NDArray[np.float64]

# Okabe and Ito's colours, which the colour-blind tell apart.
COLOURS: dict[str, Colour] = {
    "blue": (0, 114, 178),
    "sky": (86, 180, 233),
    "orange": (213, 94, 0),
    "yellow": (230, 159, 0),
    "green": (0, 158, 115),
    "purple": (204, 121, 167),
    "grey": (150, 150, 146),
    "black": (34, 34, 34),
}
GROUND: Colour = (250, 250, 247)
GRID: Colour = (226, 226, 220)
AXES: Colour = (190, 190, 182)
FAINT: Colour = (118, 118, 112)
WHITE: Colour = (255, 255, 255)

SHARE = 0.24  # of the picture's height (or 5/8 of its width) that the mechanism takes
FOLLOWING = 2.5  # rad/s: the camera follows what changes more slowly, and not each swing
MARGIN = 1.3  # of the part of the plane that is shown with a target, over what must be seen
LEAST_STEP = 0.1  # smallest distance of two lines of the grid, in m
SPACING = 80.0  # smallest distance of two lines of the grid, in pixels
WORDS = 52.0  # height of the words at the top, in pixels
TRAIL_PARTS = 4  # straight parts of the trail between two states, which are some 0.2 m apart at full speed
OUTLINE = 1.6  # width of the light line around a body, in pixels


class View:
    """What is seen of one environment from the beginning of an episode on.

    Without a target, the camera goes with the mechanism; with one, it stands and shows both of them.

    Args:
        mechanism: what is drawn.
        params: values of its parameters.
        dt: time between two states, in s.
        title: words in the upper left corner.
        trail: colour of the trail, one of `COLOURS`.
    """

    def __init__(
        self, mechanism: Mechanism, params: Mapping[str, float], dt: float, title: str = "", trail: str = "orange"
    ) -> None:
        self.mechanism, self.params, self.dt, self.title, self.trail = mechanism, dict(params), dt, title, trail
        self._extent, self._radius = self._measure()
        self.begin(np.zeros(mechanism.n), {})

    def begin(self, q: ArrayLike, marker: Mapping[str, float]) -> None:
        """Begin an episode at the coordinates q, shape (n,), with the numbers of a task's marker."""
        self.q, self.marker = np.array(q, dtype=float), dict(marker)
        self._points = [self._point()]
        self._camera, self._drift = self._points[0].copy(), np.zeros(2)
        self._seen = [self._points[0], self._points[0]]  # corners of what must be seen
        if marker:
            self._see(np.array([marker["x"], marker["y"]]))

    def follow(self, q: ArrayLike) -> None:
        """Take note of the coordinates q, shape (n,), `dt` later."""
        self.q = np.array(q, dtype=float)
        self._points.append(point := self._point())
        if self.marker:
            self._see(point)
        else:  # a filter of second order: it keeps up with what moves evenly, and averages over swings
            self._camera += self._drift * self.dt
            gap, gain = point - self._camera, min(FOLLOWING * self.dt, 0.5)
            self._camera += 2 * gain * gap
            self._drift += gain**2 / self.dt * gap

    @property
    def time(self) -> float:
        """Time since the beginning of the episode, in s."""
        return (len(self._points) - 1) * self.dt

    @property
    def speed(self) -> float:
        """Mean speed since the last state, in m/s."""
        return float(math.dist(*self._points[-2:]) / self.dt) if len(self._points) > 1 else 0.0

    @property
    def reach(self) -> float:
        """Distance from where the episode began, in m."""
        return math.dist(self._points[0], self._points[-1])

    # -- painting ------------------------------------------------------------------------------

    def paint(self, canvas: Canvas) -> None:
        """Paint what is there now."""
        place_of = self._projection(canvas)
        canvas.clear(GROUND)
        self._paint_grid(canvas, place_of)
        self._paint_start(canvas, place_of)
        if self.marker:
            self._paint_marker(canvas, place_of)
        if len(self._points) > 1:
            canvas.line(place_of(_smooth(np.array(self._points))), 3.0, COLOURS[self.trail])
        for placed in place(self.mechanism, self.q, self.params):
            self._paint_body(canvas, place_of, placed)
        self._paint_words(canvas)

    def _projection(self, canvas: Canvas) -> Projection:
        """Where the camera is, and how large a metre."""
        room = min(canvas.height, 0.625 * canvas.width)
        above = 0.0
        scale = SHARE * room / self._extent
        middle = self._camera
        if self.marker:
            low, high = self._seen
            middle = 0.5 * (low + high)
            needed = MARGIN * (high - low) + 2 * self._radius
            above = min(WORDS, canvas.height / 3)  # no target behind words
            scale = min(scale, canvas.width / needed[0], (canvas.height - above) / needed[1])
        else:  # whatever the filter does, the mechanism stays in the picture
            reach = np.maximum(0.5 * np.array([canvas.width, canvas.height]) / scale - self._radius, 0.0)
            middle = np.clip(middle, self._points[-1] - reach, self._points[-1] + reach)
        return Projection(middle, scale, (canvas.width, canvas.height), above)

    def _paint_grid(self, canvas: Canvas, place_of: Projection) -> None:
        step = grid_step(SPACING / place_of.scale)
        (left, bottom), (right, top) = place_of.corners
        for axis, (low, high) in enumerate(((left, right), (bottom, top))):
            for i in range(math.ceil(low / step), math.floor(high / step) + 1):
                ends = np.array(
                    [[i * step, bottom], [i * step, top]] if axis == 0 else [[left, i * step], [right, i * step]]
                )
                canvas.line(place_of(ends), 2.0 if i == 0 else 1.0, AXES if i == 0 else GRID)
                x, y = place_of(ends)[0]
                label = f"{i * step:g} m" if axis == 0 else f"{i * step:g}"
                if axis == 0 and 20 < x < canvas.width - 20:
                    canvas.text(label, x + 3, canvas.height - 3, 17, FAINT, "bottomleft")
                if axis == 1 and 60 < y < canvas.height - 24:
                    canvas.text(label, 4, y - 1, 17, FAINT, "bottomleft")

    def _paint_start(self, canvas: Canvas, place_of: Projection) -> None:
        x, y = place_of(self._points[0])
        for end in ((5, 5), (5, -5)):
            canvas.line([(x - end[0], y - end[1]), (x + end[0], y + end[1])], 2.0, FAINT)

    def _paint_marker(self, canvas: Canvas, place_of: Projection) -> None:
        """The target: a ring of its radius, or a dot; an arrow if it has a heading."""
        middle, colour = np.array([self.marker["x"], self.marker["y"]]), COLOURS["green"]
        radius = self.marker.get("radius", 0.0)
        around = np.linspace(0, 2 * np.pi, 49)
        if radius:
            canvas.line(place_of(middle + radius * np.stack([np.cos(around), np.sin(around)], axis=1)), 3.0, colour)
        canvas.disc(place_of(middle), 5.0, colour)
        if "heading" in self.marker:
            length = max(1.3 * self._extent, 1.5 * radius)
            tip = np.array([[0.0, 0.0], [length, 0.0], [0.8 * length, 0.12 * length], [0.8 * length, -0.12 * length]])
            points = place_of(_moved(tip, np.array([*middle, self.marker["heading"]])))
            canvas.line(points[:2], 4.0, colour)
            canvas.line(points[[2, 1, 3]], 4.0, colour)

    def _paint_body(self, canvas: Canvas, place_of: Projection, placed: Placed) -> None:
        colour, sizes = COLOURS[placed.body.colour], np.maximum(placed.size, 0.0)
        match placed.body.shape:
            case "rectangle":
                self._paint_outline(canvas, place_of, placed.pose, _rounded(*sizes), colour)
            case "disc":
                self._paint_outline(canvas, place_of, placed.pose, _ellipse(*sizes), colour)
            case "bar":
                self._paint_outline(canvas, place_of, placed.pose, _rectangle(*sizes) + (0.5 * sizes[0], 0), colour)
            case "wheel":
                self._paint_outline(canvas, place_of, placed.pose, _rounded(*sizes), COLOURS["black"])
            case "axle":
                track, diameter, width = sizes
                rod = _rectangle(0.5 * width, track)
                self._paint_outline(canvas, place_of, placed.pose, rod, FAINT)
                for side in (-0.5, 0.5):
                    wheel = _rounded(diameter, width) + (0, side * track)
                    self._paint_outline(canvas, place_of, placed.pose, wheel, COLOURS["black"])

    def _paint_outline(self, canvas: Canvas, place_of: Projection, pose: Array, corners: Array, colour: Colour) -> None:
        """A filled outline with a light edge, so that bodies on one another stay apart."""
        points = place_of(_moved(corners, pose))
        canvas.line([*points, points[0]], 2 * OUTLINE, WHITE)
        canvas.polygon(points, colour)

    def _paint_words(self, canvas: Canvas) -> None:
        y = 8.0
        if self.title:
            canvas.text(self.title, 10, y, 24, COLOURS["black"], plate=GROUND)
            y += 20
        # Each in a place of its own: nothing jumps when a digit more is needed.
        for x, words in ((10, f"{self.time:.1f} s"), (75, f"{self.speed:.1f} m/s"), (155, f"{self.reach:.1f} m away")):
            canvas.text(words, x, y, 21, COLOURS["black"], plate=GROUND)

    # -- geometry ------------------------------------------------------------------------------

    def _point(self) -> Array:
        """Where the mechanism is; a mechanism without a place stays at the origin."""
        if not self.mechanism.fibre:
            return np.zeros(2)
        return self.q[[self.mechanism.coordinates.index(name) for name in self.mechanism.fibre[:2]]]

    def _see(self, point: Array) -> None:
        low, high = self._seen
        self._seen = [np.minimum(low, point), np.maximum(high, point)]

    def _measure(self) -> tuple[float, float]:
        """How far the mechanism reaches in m, from its middle and from its point in the plane, as it stands at zero."""
        corners = []
        for placed in place(self.mechanism, np.zeros(self.mechanism.n), self.params):
            half = 0.5 * np.max(placed.size)
            away = placed.size[0] if placed.body.shape == "bar" else 0.0
            middle = placed.pose[:2] + 0.5 * away * np.array([np.cos(placed.pose[2]), np.sin(placed.pose[2])])
            corners += [middle - half, middle + half]
        extent, radius = 0.5 * float(np.max(np.ptp(corners, axis=0))), float(np.abs(corners).max())
        return max(extent, 0.01), max(radius, 0.01)


class Projection:
    """From metres in the plane to pixels.

    Args:
        middle: place in the middle of the picture, in m.
        scale: pixels a metre.
        size: width and height of the picture.
        above: height of what is not counted at the top, in pixels.
    """

    def __init__(self, middle: Array, scale: float, size: tuple[int, int], above: float = 0.0) -> None:
        self.middle, self.scale, self._size = middle, scale, np.array(size)
        self._centre = 0.5 * (self._size + (0, above))

    def __call__(self, points: ArrayLike) -> Array:
        """Pixels (..., 2) of places (..., 2)."""
        return self._centre + (np.asarray(points, dtype=float) - self.middle) * (self.scale, -self.scale)

    @property
    def corners(self) -> tuple[Array, Array]:
        """The lower left and the upper right corner, in m."""
        left, top = self.middle + self._centre / (-self.scale, self.scale)
        right, bottom = self.middle + (self._size - self._centre) / (self.scale, -self.scale)
        return np.array([left, bottom]), np.array([right, top])


class Screen:
    """Where views are shown: in a window, or nowhere but in arrays. What belongs to pygame is not pickled.

    Args:
        mode: "human" or "rgb_array".
        size: width and height in pixels.
        title: heading of the window.
        fps: pictures a second.
    """

    def __init__(self, mode: str, size: tuple[int, int], title: str, fps: float) -> None:
        pygame_module()  # so that what is missing is missed now
        self._mode, self._size, self._title, self._fps = mode, size, title, fps
        self._canvas: Canvas | None = None
        self._window: Window | None = None

    def show(self, view: View) -> NDArray[np.uint8] | None:
        """Paint a view; return the picture, shape (height, width, 3), unless it is shown in the window."""
        self._canvas = self._canvas or Canvas(*self._size)
        view.paint(self._canvas)
        if self._mode == "rgb_array":
            return self._canvas.pixels()
        self._window = self._window or Window(*self._size, self._title, self._fps)
        self._window.show(self._canvas)
        return None

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def __getstate__(self) -> dict[str, Any]:
        """Everything but canvas and window, which are made again."""
        return {**self.__dict__, "_canvas": None, "_window": None}


def grid_step(least: float) -> float:
    """Distance of two lines, in m: the first of 0.1, 0.2, 0.5, 1, 2, 5, ... that is not below `least`."""
    power = 10.0 ** math.floor(math.log10(max(least, LEAST_STEP)))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= least)


def marker_of(task: Task, numbers: Mapping[str, float]) -> dict[str, float]:
    """The numbers of a task's marker in an episode.

    Args:
        task: what the episode is for.
        numbers: its targets and weights, by name.
    """
    return {key: float(evaluate(text, numbers)) for key, text in task.marker.items()}


def _smooth(points: Array) -> Array:
    """`TRAIL_PARTS` points for each of the points (p, 2) but the last, on cubics through them (Catmull and Rom)."""
    slopes = np.gradient(points, axis=0) if len(points) > 2 else np.diff(points, axis=0).repeat(2, axis=0)
    t = (np.arange(TRAIL_PARTS) / TRAIL_PARTS)[:, None]
    start, end, out, into = (array[:, None] for array in (points[:-1], points[1:], slopes[:-1], slopes[1:]))
    curve = start + t * (out + t * (3 * (end - start) - 2 * out - into + t * (2 * (start - end) + out + into)))
    return np.vstack([curve.reshape(-1, 2), points[-1:]])


def _moved(points: Array, pose: Array) -> Array:
    """Points (p, 2) of a body in its pose (3,)."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return points @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]


def _rectangle(length: float, width: float) -> Array:
    return 0.5 * np.array([[length, width], [-length, width], [-length, -width], [length, -width]])


def _rounded(length: float, width: float) -> Array:
    """Corners of a rectangle with round corners."""
    radius = 0.3 * min(length, width)
    angles = np.linspace(0, np.pi / 2, 6)
    quarter = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    middle = 0.5 * np.array([length, width]) - radius
    turns = [np.array([[1, 0], [0, 1]]), np.array([[0, 1], [-1, 0]]), -np.eye(2), np.array([[0, -1], [1, 0]])]
    signs = [(1, 1), (-1, 1), (-1, -1), (1, -1)]
    return np.concatenate([quarter @ turn + middle * sign for turn, sign in zip(turns, signs, strict=True)])


def _ellipse(length: float, width: float) -> Array:
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    return 0.5 * np.stack([length * np.cos(angles), width * np.sin(angles)], axis=1)
