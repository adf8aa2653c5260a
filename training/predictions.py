"""What theory predicts of gaits, beside what the equations of motion do.

python -m training.predictions

A prediction is a formula in the mechanism's parameters and the gait's amplitudes, with the order of its error in
them: halve the amplitudes, and the error shrinks by two to that power. Some are exact. The joints are made to follow
a sin(w t + b), see `training.prescribed`, or are shaken by fast torques, see `training.averaging`. Here a, w, b have an
index p for the snakeboard's rotor ψ and f for its steering φ; T = 2π/w with w the common measure of the frequencies.

Snakeboard. κ = J_r/(m l²), and S is the wheels' rolling speed over l: exactly Ṡ = κ sinφ ψ̈, θ̇ = -sinφ S and
ẋ = l cosφ cosθ S. Roller racer. α = (l_2 I_1 - l_1 I_2)/(m (l_1 + l_2)²), and p is the momentum along the unit vector
field of rolling with a stiff joint: exactly ṗ = -m H k f_1^(-3/2) ψ̇² with H = l_1 + l_2 cosψ, and k and f_1 as in
`mechanics.catalog.roller_racer`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.table import Table

import mechanics
from mechanics.mechanism import Mechanism
from training.averaging import averaged, shaken
from training.prescribed import Sinusoids, follow

__all__ = ["AVERAGING", "PREDICTIONS", "Comparison", "Prediction", "averaging", "compare", "main", "slope"]

Array = NDArray[np.float64]
Params = Mapping[str, float]

HALVINGS = 3  # amplitudes that an order is fitted to


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """A number that theory gives for a gait.

    Attributes:
        gait: what the gait is called.
        quantity: what is predicted, of the motion after n periods.
        mechanism: name in the catalogue.
        ratio: frequencies of the joints over w, shape (m,).
        phase: b in rad, shape (m,).
        amplitude: a in rad, shape (m,), the largest that the table shows.
        formula: (params, amplitude, phase, w, n) -> the prediction.
        reading: (mechanism, params, q, qdot) -> the number in a motion (T, ..., n) from beginning to end.
        order: of the error in the amplitudes; None if the prediction is exact.
        frequency: w in rad/s.
        periods: n.
    """

    gait: str
    quantity: str
    mechanism: str
    ratio: tuple[float, ...]
    phase: tuple[float, ...]
    amplitude: tuple[float, ...]
    formula: Callable[[Params, Array, Array, float, int], Array | float]
    reading: Callable[[Mechanism, Params, Array, Array], Array]
    order: int | None
    frequency: float = 2.0
    periods: int = 2


@dataclass(frozen=True)
class Comparison:
    """A prediction and the motion, for amplitudes that are halved again and again.

    Attributes:
        scale: what the amplitudes are multiplied by, shape (S,).
        predicted: shape (S,).
        simulated: shape (S,).
    """

    scale: Array
    predicted: Array
    simulated: Array

    @property
    def error(self) -> Array:
        """Magnitude of the differences, shape (S,)."""
        return np.abs(self.simulated - self.predicted)

    @property
    def relative_error(self) -> Array:
        """Errors over the prediction, shape (S,); over 1 where it predicts nothing."""
        size = np.abs(self.predicted)
        return self.error / np.where(size == 0, 1.0, size)

    @property
    def order(self) -> float:
        """Order of the error in the scale, fitted."""
        return slope(self.scale, self.error)


def slope(x: ArrayLike, y: ArrayLike) -> float:
    """Exponent e of the best y = c x^e."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def compare(prediction: Prediction, params: Params | None = None, halvings: int = HALVINGS) -> Comparison:
    """Hold a prediction against the motion, at its amplitudes, at half of them, and so on."""
    mechanism = mechanics.get(prediction.mechanism)
    values = mechanism.resolve(params)
    scale = np.ldexp(1.0, -np.arange(halvings))
    amplitude = scale[:, None] * prediction.amplitude
    phase, w, n = np.array(prediction.phase), prediction.frequency, prediction.periods
    shapes = Sinusoids(amplitude, w * np.array(prediction.ratio), phase)
    q, qdot = follow(mechanism, shapes, [0.0, n * 2 * np.pi / w], values)
    simulated = prediction.reading(mechanism, values, q, qdot)
    predicted = [prediction.formula(values, a, phase, w, n) for a in amplitude]
    return Comparison(scale, np.array(predicted, dtype=float), simulated)


# -- what is read off a motion ---------------------------------------------------------------------


def _change(name: str) -> Callable[[Mechanism, Params, Array, Array], Array]:
    """How far a coordinate has moved."""

    def reading(mechanism: Mechanism, params: Params, q: Array, qdot: Array) -> Array:
        moved = q[..., mechanism.coordinates.index(name)]
        return moved[-1] - moved[0]

    return reading


def _speed(mechanism: Mechanism, params: Params, q: Array, qdot: Array) -> Array:
    """Last velocity along the heading."""
    theta = q[-1, ..., 2]
    return np.cos(theta) * qdot[-1, ..., 0] + np.sin(theta) * qdot[-1, ..., 1]


def _rolling(mechanism: Mechanism, params: Params, q: Array, qdot: Array) -> Array:
    """Change of the snakeboard's S, from ẋ and ẏ."""
    x_dot, y_dot, theta, phi = qdot[..., 0], qdot[..., 1], q[..., 2], q[..., 4]
    rolling = (np.cos(theta) * x_dot + np.sin(theta) * y_dot) / (params["l"] * np.cos(phi))
    return rolling[-1] - rolling[0]


def _momentum(mechanism: Mechanism, params: Params, q: Array, qdot: Array) -> Array:
    """Change of the racer's p = ⟨⟨X, q̇⟩⟩, X = (c cosθ, c sinθ, sinψ, 0)/√f_1."""
    m, l_1, l_2, I_1, I_2 = (params[name] for name in ("m", "l_1", "l_2", "I_1", "I_2"))
    theta, psi = q[..., 2], q[..., 3]
    c = l_2 + l_1 * np.cos(psi)
    forward = np.cos(theta) * qdot[..., 0] + np.sin(theta) * qdot[..., 1]
    turning = (I_1 + I_2) * qdot[..., 2] + I_2 * qdot[..., 3]
    f_1 = m * c**2 + (I_1 + I_2) * np.sin(psi) ** 2
    p = (m * c * forward + np.sin(psi) * turning) / np.sqrt(f_1)
    return p[-1] - p[0]


# -- snakeboard: amplitudes and phases of (ψ, φ) ---------------------------------------------------


def _kappa(params: Params) -> float:
    return params["J_r"] / (params["m"] * params["l"] ** 2)


def _drive_rolling(params: Params, a: Array, b: Array, w: float, n: int) -> float:
    """∫ κ sinφ ψ̈ dt: the sine of a sine has Bessel functions as Fourier coefficients."""
    from scipy.special import j1

    return float(-2 * np.pi * n * _kappa(params) * w * a[0] * j1(a[1]) * np.cos(b[1] - b[0]))


def _drive_x(params: Params, a: Array, b: Array, w: float, n: int) -> float:
    apart, both = b[1] - b[0], b[1] + b[0]
    grown = -(np.pi**2) * n**2 * np.cos(apart)
    begun = n * (np.pi / 2 * np.sin(both) + np.pi * np.sin(apart))
    return float(params["l"] * _kappa(params) * a[0] * a[1] * (grown + begun))


def _drive_theta(params: Params, a: Array, b: Array, w: float, n: int) -> float:
    return float(-np.pi * n * _kappa(params) * a[1] ** 2 * a[0])


def _rotate_theta(params: Params, a: Array, b: Array, w: float, n: int) -> float:
    return float(2 * np.pi * n * _kappa(params) * a[1] ** 2 * a[0] * np.cos(2 * b[1] - b[0]))


def _park_y(params: Params, a: Array, b: Array, w: float, n: int) -> float:
    return float(-81 * np.pi / 8 * n * params["l"] * _kappa(params) ** 2 * a[1] ** 3 * a[0] ** 2)


def _nothing(params: Params, a: Array, b: Array, w: float, n: int) -> float:
    return 0.0


# -- roller racer: amplitude and phase of ψ --------------------------------------------------------


def _alpha(params: Params) -> float:
    difference = params["l_2"] * params["I_1"] - params["l_1"] * params["I_2"]
    return difference / (params["m"] * (params["l_1"] + params["l_2"]) ** 2)


def _racer_momentum(params: Params, a: Array, b: Array, w: float, n: int) -> float:
    """∫ -m H k f_1^(-3/2) ψ̇² dt by the trapezoidal rule, which converges geometrically over whole periods."""
    m, l_1, l_2, I_1, I_2 = (params[name] for name in ("m", "l_1", "l_2", "I_1", "I_2"))
    turned = 2 * np.pi * np.arange(512) / 512
    psi, rate = a[0] * np.sin(turned + b[0]), a[0] * w * np.cos(turned + b[0])
    k = l_2 * I_1 - l_1 * I_2 * np.cos(psi)
    f_1 = m * (l_2 + l_1 * np.cos(psi)) ** 2 + (I_1 + I_2) * np.sin(psi) ** 2
    pushed = -m * (l_1 + l_2 * np.cos(psi)) * k * f_1**-1.5 * rate**2
    return float(pushed.mean() * n * 2 * np.pi / w)


def _racer_speed(params: Params, a: Array, b: Array, w: float, n: int) -> float:
    return float(-_alpha(params) * np.pi * w * a[0] ** 2 * n)


def _racer_theta(params: Params, a: Array, b: Array, w: float, n: int) -> float:
    return float(_alpha(params) * np.pi * n * a[0] ** 3 / (params["l_1"] + params["l_2"]))


def _snakeboard(
    gait: str,
    quantity: str,
    ratio: tuple[float, float],
    phase: tuple[float, float],
    formula: Callable[[Params, Array, Array, float, int], float],
    order: int | None,
    amplitude: tuple[float, float] = (0.5, 0.4),
    periods: int = 2,
) -> Prediction:
    readings = {"S": _rolling}
    return Prediction(
        gait=gait, quantity=quantity, mechanism="snakeboard", ratio=ratio, phase=phase, amplitude=amplitude,
        formula=formula, reading=readings.get(quantity, _change(quantity)), order=order, periods=periods,
    )  # fmt: skip


def _racer(
    quantity: str,
    phase: float,
    formula: Callable[[Params, Array, Array, float, int], float],
    order: int | None,
    amplitude: float = 0.4,
) -> Prediction:
    readings = {"p": _momentum, "speed": _speed}
    return Prediction(
        gait="swing", quantity=quantity, mechanism="roller_racer", ratio=(1.0,), phase=(phase,), amplitude=(amplitude,),
        formula=formula, reading=readings.get(quantity, _change(quantity)), order=order,
    )  # fmt: skip


PREDICTIONS: dict[str, Prediction] = {
    "drive, rolling": _snakeboard("drive 1:1", "S", (1, 1), (0.0, 0.0), _drive_rolling, None, (2.0, 1.1)),
    "drive, rolling, any phase": _snakeboard("drive 1:1", "S", (1, 1), (0.3, 1.0), _drive_rolling, None, (2.0, 1.1)),
    "drive, in phase": _snakeboard("drive 1:1, in phase", "x", (1, 1), (0.0, 0.0), _drive_x, 4),
    "drive, anti-phase": _snakeboard("drive 1:1, anti-phase", "x", (1, 1), (np.pi, 0.0), _drive_x, 4),
    "drive, any phase": _snakeboard("drive 1:1, any phase", "x", (1, 1), (0.3, 1.0), _drive_x, 4),
    "drive, heading": _snakeboard("drive 1:1, in phase", "theta", (1, 1), (0.0, 0.0), _drive_theta, 5),
    "rotate": _snakeboard("rotate 2:1", "theta", (2, 1), (0.0, 0.0), _rotate_theta, 5, periods=1),
    "rotate, any phase": _snakeboard("rotate 2:1, any phase", "theta", (2, 1), (0.3, 1.0), _rotate_theta, 5, periods=1),
    "park": _snakeboard("park 3:2", "y", (3, 2), (0.0, 0.0), _park_y, 7, periods=1),
    "park, along": _snakeboard("park 3:2", "x", (3, 2), (0.0, 0.0), _nothing, None, (2.0, 1.1), 1),
    "park, heading": _snakeboard("park 3:2", "theta", (3, 2), (0.0, 0.0), _nothing, None, (2.0, 1.1), 1),
    "racer, momentum": _racer("p", 0.7, _racer_momentum, None, 1.1),
    "racer, speed": _racer("speed", 0.0, _racer_speed, 4),
    "racer, heading": _racer("theta", 0.0, _racer_theta, 5),
}


# -- fast torques ----------------------------------------------------------------------------------

# Amplitudes A in N m s of the torques, in phase, and where the shaking begins, so that it leads somewhere.
AVERAGING: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "snakeboard": ((0.05, 0.01), (0.0, 0.0, 0.2, 0.0, 0.3)),
    "roller_racer": ((0.02,), (0.0, 0.0, 0.2, 0.4)),
}


def averaging(name: str, time: float = 2.0, swings: int = 10, halvings: int = HALVINGS) -> Comparison:
    """Hold the averaged motion against torques that shake faster and faster: x after `time`, for a scale ε.

    The error is of first order in ε. Shaking ends halfway through a swing, where it is not smaller than elsewhere.
    """
    mechanism = mechanics.get(name)
    amplitudes, q0 = AVERAGING[name]
    # Half a swing more each time, so that ε is halved as nearly as that allows.
    scale: Array = time / (2 * np.pi * (swings * np.ldexp(1.0, np.arange(halvings)) + 0.5))
    slow = averaged(mechanism, amplitudes, [0.0, time], q0)[-1, 0]
    fast = [shaken(mechanism, amplitudes, epsilon, [0.0, time], q0)[-1, 0] for epsilon in scale]
    return Comparison(scale, np.full(halvings, slow), np.array(fast))


# -- the table -------------------------------------------------------------------------------------


def _rows(mechanism: str) -> Iterator[tuple[str, ...]]:
    for prediction in PREDICTIONS.values():
        if prediction.mechanism == mechanism:
            n = prediction.periods
            quantity = f"{prediction.quantity}({n if n > 1 else ''}T)"
            yield (prediction.gait, quantity, *_numbers(compare(prediction), prediction.order))
    if mechanism in AVERAGING:
        yield "fast torques", "x(2 s)", *_numbers(averaging(mechanism), 1)


def _numbers(compared: Comparison, order: int | None) -> tuple[str, str, str, str]:
    return (
        f"{compared.predicted[0]:.5f}",
        f"{compared.simulated[0]:.5f}",
        f"{compared.relative_error[0]:.1e}",
        "exact" if order is None else f"{order}: {compared.order:.2f}",
    )


def main() -> None:
    """Print the predictions beside the motions."""
    console = Console()
    for mechanism in dict.fromkeys(prediction.mechanism for prediction in PREDICTIONS.values()):
        table = Table(title=f"{mechanism}, from rest", pad_edge=False)  # to fit 80 columns
        for heading in ("gait", "", "predicted", "simulated", "error", "order"):
            table.add_column(heading, justify="left" if heading in ("gait", "") else "right", no_wrap=True)
        with console.status("integrating"):
            for row in _rows(mechanism):
                table.add_row(*row)
        console.print(table)
    console.print(
        "error: over the prediction. order: the power of the amplitudes (for fast torques of their period) with which "
        "the error should shrink: with which it does, from the amplitudes shown to a quarter of them."
    )


if __name__ == "__main__":
    main()
