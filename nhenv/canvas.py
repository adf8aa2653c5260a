"""Shapes on pixels: everything that pygame does for us, on a surface in memory or in a window."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Canvas", "Colour", "Window", "pygame_module"]

Pixels = NDArray[np.uint8]
Colour = tuple[int, int, int]

# Shapes are drawn so many times larger and averaged, which smooths their edges whatever they are. A power of two: by
# three, pygame makes every colour two levels darker.
OVERSAMPLING = 4


def pygame_module() -> Any:
    """The library that draws, with its fonts ready; no display is opened."""
    try:
        import pygame
        import pygame.font
    except ImportError as error:
        raise ImportError(
            "drawing needs pygame-ce, which the extra `render` installs: pip install 'nhenv[render]'"
        ) from error
    pygame.font.init()
    return pygame


class Canvas:
    """A picture in the making. Places and sizes are in pixels, from the upper left corner, and may be fractions.

    Args:
        width: in pixels.
        height: in pixels.
    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self._pygame = pygame_module()
        self._fine = self._pygame.Surface((width * OVERSAMPLING, height * OVERSAMPLING))
        self._surface = self._pygame.Surface((width, height))
        self._words: list[tuple[str, float, float, int, Colour, str, Colour | None]] = []
        self._fonts: dict[int, Any] = {}

    def clear(self, colour: Colour) -> None:
        """Begin anew on a ground of one colour."""
        self._fine.fill(colour)
        self._words = []

    def polygon(self, corners: ArrayLike, colour: Colour) -> None:
        """Filled polygon with these corners, shape (c, 2)."""
        self._pygame.draw.polygon(self._fine, colour, _inside(corners))

    def line(self, points: ArrayLike, width: float, colour: Colour) -> None:
        """Line of this width through points, shape (p, 2), with round ends and corners."""
        array = np.asarray(points, dtype=float)
        along = np.diff(array, axis=0)
        length = np.hypot(*along.T)
        moves = length > 1e-9
        across = 0.5 * width * along[moves][:, ::-1] * (1, -1) / length[moves, None]
        starts, ends = array[:-1][moves], array[1:][moves]
        for quad in _inside(np.stack([starts + across, ends + across, ends - across, starts - across], axis=1)):
            self._pygame.draw.polygon(self._fine, colour, quad)
        if width > 1.5:  # thinner ones need no corners
            for point in _inside(array):
                self._pygame.draw.circle(self._fine, colour, point, 0.5 * width * OVERSAMPLING)

    def disc(self, middle: ArrayLike, radius: float, colour: Colour) -> None:
        """Filled circle."""
        self._pygame.draw.circle(self._fine, colour, _inside(middle), radius * OVERSAMPLING)

    def text(
        self,
        words: str,
        x: float,
        y: float,
        size: int,
        colour: Colour,
        anchor: str = "topleft",
        plate: Colour | None = None,
    ) -> None:
        """Words with one of pygame's anchors, such as "midbottom", at a place. They come on top of everything.

        A plate of another colour behind them keeps them legible.
        """
        self._words.append((words, x, y, size, colour, anchor, plate))

    def pixels(self) -> Pixels:
        """The picture, shape (height, width, 3)."""
        surface = self.surface()
        return np.array(self._pygame.surfarray.pixels3d(surface).swapaxes(0, 1), order="C")

    def surface(self) -> Any:
        """The picture as pygame has it, until the next one."""
        self._pygame.transform.smoothscale(self._fine, (self.width, self.height), self._surface)
        for words, x, y, size, colour, anchor, plate in self._words:
            picture = self._font(size).render(words, True, colour)
            place = picture.get_rect(**{anchor: (round(x), round(y))})
            if plate:
                self._pygame.draw.rect(self._surface, plate, place.inflate(6, 2))
            self._surface.blit(picture, place)
        return self._surface

    def _font(self, size: int) -> Any:
        if size not in self._fonts:
            self._fonts[size] = self._pygame.font.Font(None, size)  # it comes with pygame: the same everywhere
        return self._fonts[size]


class Window:
    """A window that shows pictures at the pace at which they were taken.

    Args:
        width: in pixels.
        height: in pixels.
        title: its heading.
        fps: pictures a second.
    """

    def __init__(self, width: int, height: int, title: str, fps: float) -> None:
        self._pygame = pygame_module()
        self._pygame.display.init()
        self._pygame.display.set_caption(title)
        self._display = self._pygame.display.set_mode((width, height))
        self._clock, self._fps = self._pygame.time.Clock(), fps

    def show(self, canvas: Canvas) -> None:
        """Show a picture and wait until the next one is due."""
        self._display.blit(canvas.surface(), (0, 0))
        self._pygame.event.pump()  # or the system takes the window for dead
        self._pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close it."""
        self._pygame.display.quit()


def _inside(points: ArrayLike) -> Any:
    """Points on the finer surface. What lies far outside is moved nearer, unseen: SDL would walk along all of it."""
    array = np.asarray(points, dtype=float) * OVERSAMPLING
    return np.clip(array, -30_000, 30_000).round().astype(int).tolist()
