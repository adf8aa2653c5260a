import dataclasses

import numpy as np
import pytest
import scipy.integrate
import sympy as sp

import mechanics
from training import predictions
from training.averaging import mean_acceleration
from training.predictions import AVERAGING, PREDICTIONS, Comparison, averaging, compare, main
from training.prescribed import Sinusoids, follow

EXACT = [name for name, prediction in PREDICTIONS.items() if prediction.order is None]
APPROXIMATE = [name for name, prediction in PREDICTIONS.items() if prediction.order is not None]
DRIVES = ["drive, in phase", "drive, anti-phase"]

# A racer with a light body and a heavy link, which goes the other way, and other boards than the catalogue's.
OTHER_PARAMS = {
    "snakeboard": {"m": 4.0, "l": 0.3, "J_r": 0.11, "J_w": 0.02},
    "roller_racer": {"m": 2.0, "l_1": 0.25, "l_2": 0.15, "I_1": 0.01, "I_2": 0.04},
}


def both_params(prediction):
    return None, OTHER_PARAMS[prediction.mechanism]


@pytest.mark.parametrize("name", EXACT)
def test_exact_predictions_hold_at_large_amplitudes(name):
    for params in both_params(PREDICTIONS[name]):
        compared = compare(PREDICTIONS[name], params)
        # The solver's 3e-14 a step, some hundred steps; the numbers are of order 1.
        np.testing.assert_allclose(compared.simulated, compared.predicted, rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("name", APPROXIMATE)
def test_errors_shrink_with_the_order_stated(name):
    prediction = PREDICTIONS[name]
    for params in both_params(prediction):
        compared = compare(
            dataclasses.replace(prediction, amplitude=tuple(a / 2 for a in prediction.amplitude)), params
        )
        assert compared.relative_error[-1] < 0.02
        # What is left of the next order at these amplitudes bends the slope by a few hundredths.
        assert compared.order == pytest.approx(prediction.order, abs=0.2)


def test_in_phase_goes_backwards_and_anti_phase_forwards():
    in_phase, anti_phase = (compare(PREDICTIONS[name]).simulated for name in DRIVES)
    assert (in_phase < 0).all()
    assert (anti_phase > 0).all()


@pytest.mark.parametrize("params", [None, OTHER_PARAMS["roller_racer"]], ids=["heavy body", "heavy link"])
def test_racer_is_driven_away_from_its_lighter_link(params):
    racer = mechanics.get("roller_racer")
    p = racer.resolve(params)
    alpha = (p["l_2"] * p["I_1"] - p["l_1"] * p["I_2"]) / (p["m"] * (p["l_1"] + p["l_2"]) ** 2)
    assert (alpha > 0) == (params is None)
    speed = compare(PREDICTIONS["racer, speed"], params).simulated
    assert (np.sign(speed) == -np.sign(alpha)).all()


def test_joints_follow_what_is_prescribed_and_wheels_do_not_slip():
    snakeboard = mechanics.get("snakeboard")
    shapes = Sinusoids(np.array([[2.0, 1.1], [0.5, 0.3]]), np.array([3.0, 2.0]), np.array([0.3, 1.0]))
    times = np.linspace(0.0, 4.0, 9)
    q, qdot = follow(snakeboard, shapes, times)
    assert q.shape == qdot.shape == (9, 2, 5)
    # A double integration of accelerations of order 10 to 3e-14.
    np.testing.assert_allclose(q[..., 3:], [shapes.angle(t) for t in times], rtol=0, atol=1e-11)
    np.testing.assert_allclose(qdot[..., 3:], [shapes.rate(t) for t in times], rtol=0, atol=1e-11)
    assert np.abs(mechanics.Model(snakeboard).constraint_residual(q, qdot)).max() < 1e-12
    assert np.abs(q[-1, :, :3]).min() > 1e-3


def test_prescribed_motion_is_that_of_the_momentum_equation():
    """Ṡ = κ sinφ ψ̈ and three quadratures, by hand and by another solver."""
    p = mechanics.get("snakeboard").parameters
    kappa, w, (a_p, a_f), (b_p, b_f) = p["J_r"] / (p["m"] * p["l"] ** 2), 2.0, (1.5, 0.9), (0.3, 1.0)

    def rates(t, state):
        _, _, theta, rolling = state
        phi, psi_ddot = a_f * np.sin(w * t + b_f), -a_p * w**2 * np.sin(w * t + b_p)
        ahead = p["l"] * np.cos(phi) * rolling
        return ahead * np.cos(theta), ahead * np.sin(theta), -np.sin(phi) * rolling, kappa * np.sin(phi) * psi_ddot

    # The rotor's first impulse leaves v = S - κ sinφ ψ̇ at zero.
    begun = kappa * np.sin(a_f * np.sin(b_f)) * a_p * w * np.cos(b_p)
    by_hand = scipy.integrate.solve_ivp(rates, (0, 5), [0, 0, 0, begun], "LSODA", [5.0], rtol=1e-12, atol=1e-14)
    shapes = Sinusoids(np.array([a_p, a_f]), np.array([w, w]), np.array([b_p, b_f]))
    q, _ = follow(mechanics.get("snakeboard"), shapes, [0.0, 5.0])
    np.testing.assert_allclose(q[-1, :3], by_hand.y[:3, -1], rtol=0, atol=1e-9)  # LSODA's error


def leading_coefficient(prediction, n):
    """The lowest power in s of x, y or θ after n periods, for amplitudes s a: a series by SymPy, in exact numbers.

    The snakeboard's equations are solved power by power: Ṡ = κ sinφ ψ̈, θ̇ = -sinφ S, ẋ + iẏ = l cosφ S exp(iθ).
    """
    s, t, kappa, l, a_p, a_f = sp.symbols("s t kappa l a_p a_f", positive=True)
    top = prediction.order - 2  # between the leading term and the first that is left out there is none
    r_p, r_f = map(sp.Integer, prediction.ratio)
    phi, psi = s * a_f * sp.sin(r_f * t), s * a_p * sp.sin(r_p * t)

    def cut(e):
        e = sp.expand(e)
        return sum((e.coeff(s, i) * s**i for i in range(top + 1)), sp.S.Zero)

    def integral(e):
        # Products of sines as sums of exponentials, whose integrals are looked up.
        e = sp.expand(cut(e).rewrite(sp.exp))
        return sum((sp.integrate(term, (t, 0, t)) for term in sp.Add.make_args(e)), sp.S.Zero)

    sin_phi, cos_phi = phi - phi**3 / 6 + phi**5 / 120, 1 - phi**2 / 2 + phi**4 / 24
    rolling = integral(kappa * sin_phi * sp.diff(psi, t, 2))
    theta = integral(-sin_phi * rolling)
    rates = {"theta": -sin_phi * rolling, "x": l * cos_phi * rolling * (1 - theta**2 / 2), "y": l * rolling * theta}
    total = sp.expand(sp.simplify(integral(rates[prediction.quantity]).subs(t, 2 * sp.pi * n)))
    power = min(i for i in range(top + 1) if total.coeff(s, i) != 0)
    p = mechanics.get("snakeboard").parameters
    a = prediction.amplitude
    values = {kappa: p["J_r"] / (p["m"] * p["l"] ** 2), l: p["l"], a_p: a[0], a_f: a[1]}
    return power, float(total.coeff(s, power).subs(values))


@pytest.mark.parametrize("name", ["drive, in phase", "drive, heading", "rotate", "park"])
def test_formulas_are_the_leading_terms_of_the_series(name):
    prediction = PREDICTIONS[name]
    power, coefficient = leading_coefficient(prediction, prediction.periods)
    params = mechanics.get("snakeboard").parameters
    arguments = (np.array(prediction.phase), prediction.frequency, prediction.periods)
    formula = prediction.formula(params, np.array(prediction.amplitude), *arguments)
    assert formula == pytest.approx(coefficient, rel=1e-12)
    assert power < prediction.order


@pytest.mark.parametrize("name", AVERAGING)
def test_fast_torques_leave_the_averaged_motion(name):
    compared = averaging(name)
    # From rest, so that all of it is the average's doing; without the products nothing would move.
    assert abs(compared.predicted[0]) > 10 * compared.error[-1]
    assert compared.order == pytest.approx(1.0, abs=0.15)


def test_mean_acceleration_is_that_of_the_flat_frame():
    """There ċ2 = u_psi sinφ/√D is all that couples the joints, so that the mean is read off its derivative by φ."""
    board = mechanics.get("snakeboard")
    p, (A_psi, A_phi) = board.parameters, (0.3, 0.2)
    q = np.array([0.1, -0.2, 0.4, 0.5, 0.6])
    root = np.sqrt(p["m"] * p["l"] ** 2 - p["J_r"] * np.sin(q[4]) ** 2)
    slope = p["m"] * p["l"] ** 2 * np.cos(q[4]) / root**3 / p["J_w"]  # of sinφ/√D, for a unit torque on φ
    model = mechanics.Model(board, frame="flat")
    expected = model.velocity(q, np.array([0.0, -A_psi * A_phi / 2 * slope, 0.0]))
    np.testing.assert_allclose(mean_acceleration(board, (A_psi, A_phi))(q), expected, rtol=1e-12, atol=1e-14)


def test_the_command_prints_predictions_and_orders(capsys, monkeypatch):
    monkeypatch.setattr(predictions, "PREDICTIONS", {name: PREDICTIONS[name] for name in ("rotate", "racer, momentum")})
    monkeypatch.setattr(predictions, "AVERAGING", {})
    main()
    rotate, momentum = (line for line in capsys.readouterr().out.splitlines() if line.startswith("│"))
    assert "rotate 2:1" in rotate
    assert "5: 4.99" in rotate
    assert "exact" in momentum


def test_the_tables_fit_80_columns(capsys, monkeypatch):
    scale = np.array([1.0, 0.5, 0.25])
    widest = Comparison(scale, np.full(3, -7.10104), -7.10104 * (1 - 0.061 * scale**5))
    monkeypatch.setattr(predictions, "compare", lambda prediction: widest)
    monkeypatch.setattr(predictions, "averaging", lambda name: widest)
    monkeypatch.setenv("COLUMNS", "80")
    main()
    printed = capsys.readouterr().out
    assert printed.count(": 5.00") == sum(one.order is not None for one in PREDICTIONS.values()) + len(AVERAGING)
    assert "…" not in printed
    assert max(map(len, printed.splitlines())) <= 80
