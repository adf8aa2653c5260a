"""The figure of shapes shows the loops that were recorded, over the heights where they run."""

import dataclasses
import io

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from mechanics.geometry.local_connection import height_functions
from training import shapes as figures
from training.film import Take
from training.rollout import make_envs
from training.shapes import PARTS, Shapes, draw, loops, shapes

DT = 0.05


@pytest.fixture(scope="module")
def take():
    """A snakeboard whose rotor swings while it turns steadily, and whose wheels swing about an angle."""
    envs = make_envs("nhenv/SnakeboardForward-v0", 1, backend="numpy")
    time = DT * np.arange(201)
    q = np.zeros((201, 5))
    q[:, 3], q[:, 4] = 2 * time + 0.8 * np.sin(3 * time), 0.1 + 0.4 * np.cos(3 * time)
    return Take("somebody", q, {}, envs)


def test_loops(take):
    r, rates = loops(take, 2.0, 8.0)
    assert r.shape == rates.shape == (120 * PARTS + 1, 2)
    time = np.linspace(2, 8, 120 * PARTS + 1)
    # The swing of the rotor less a straight line, and none left: rates have all of it. Splines through sines of 0.15
    # rad a step err by some 0.15⁴/384, and more at their ends, of which the rate shows ten times as much.
    np.testing.assert_allclose(np.diff((r[:, 0] - 0.8 * np.sin(3 * time))[::PARTS], 2), 0, atol=1e-12)
    assert np.polynomial.Polynomial.fit(time, r[:, 0], 1).convert().coef == pytest.approx([0, 0], abs=1e-12)
    np.testing.assert_allclose(r[:, 1], 0.1 + 0.4 * np.cos(3 * time), atol=1e-4)
    np.testing.assert_allclose(rates, np.stack([2 + 2.4 * np.cos(3 * time), -1.2 * np.sin(3 * time)], 1), atol=5e-3)
    with pytest.raises(ValueError, match="somebody lasts 10 s: nothing of it lies in 11 to 15 s"):
        loops(take, 11, 15)


def test_a_figure(take, monkeypatch):
    asked = []

    def heights(mechanism, shape, params):
        asked.append(shape)
        return height_functions(mechanism, shape, params)

    monkeypatch.setattr(figures, "height_functions", heights)
    one = draw([take], "a title", 2.0, 8.0)
    with Image.open(io.BytesIO(one)) as image:
        assert image.format == "PNG"
        assert image.width == 1350
    (shape,) = asked
    r, _ = loops(take, 2.0, 8.0)
    assert (shape.min(axis=(0, 1)) < r.min(axis=0)).all()
    assert (shape.max(axis=(0, 1)) > r.max(axis=0)).all()
    other = dataclasses.replace(take, label="another", q=take.q * (1, 1, 1, 1, 0.5))
    assert draw([take, other], "a title", 2.0, 8.0) != one


def test_the_command(take, tmp_path, monkeypatch):
    monkeypatch.setattr("training.actors.actor", lambda path, label: Named(str(path)))
    monkeypatch.setattr(figures, "record", lambda one, seed: dataclasses.replace(take, label=one.env_id))
    options = Shapes(pieces=("a", "a"), out=tmp_path / "shapes.png", first=2, last=8)
    shapes(options, Console(file=io.StringIO()))
    with Image.open(options.out) as image:
        assert image.width == 1350
    with pytest.raises(ValueError, match="of one environment go together, not of a and b"):
        shapes(dataclasses.replace(options, pieces=("a", "b")), Console(file=io.StringIO()))
    with pytest.raises(ValueError, match="from 1 to 4 files can be drawn, got 0"):
        Shapes(pieces=())
    with pytest.raises(ValueError, match="first must be at least 0 and before last"):
        Shapes(pieces=("a",), first=3, last=2)


@dataclasses.dataclass
class Named:
    env_id: str
    env_kwargs: dict = dataclasses.field(default_factory=dict)
