"""MuJoCo models of the two mechanisms, with wheels that roll on the ground.

The frame slides in the plane and turns about the vertical; on each axle sits one ball that rolls about it and holds by
friction. What the mechanisms have no mass for gets next to none: wheels of 0.1 g on axles whose inertia is right.
Contacts are elliptic cones, stiff, with friction enough for any torque here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco as mj
import numpy as np
from numpy.typing import NDArray

import mechanics

__all__ = ["RollingWheels"]

Array = NDArray[np.float64]

RADIUS, WHEEL = 0.03, 1e-4  # m, kg
NOTHING = 1e-4  # kg, of a body that MuJoCo wants a mass for
IMPRATIO = 100  # stiffness of friction over that of the normal force; more changes nothing
SETTLING = 0.5  # s, until the wheels have sunk in under the weight

_MODEL = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast" cone="elliptic" impratio="{impratio}"/>
  <default>
    <geom type="sphere" size="{radius}" friction="10 0 0" condim="3" solref="{stiff} 1"/>
    <equality solref="{stiff} 1"/>
  </default>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body pos="0 0 {radius}">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="theta" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
      {parts}
    </body>
  </worldbody>
  {rest}
</mujoco>
"""

_WHEEL = """
<body pos="{ahead} 0 0">
  <joint name="{name}" axis="0 1 0"/>
  <inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
  <geom/>
</body>
"""

_TURNING = """
<body pos="{ahead} 0 0">
  <joint name="{name}" axis="0 0 {sign}"/>
  <inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
  {parts}
</body>
"""


class RollingWheels:
    """A mechanism in MuJoCo.

    Args:
        mechanism: its name; default parameters.
        step: length of a step in s.
    """

    def __init__(self, mechanism: str, step: float) -> None:
        if mechanism not in _PLANS:
            raise ValueError(f"no model of {mechanism!r} for MuJoCo; there is one of {', '.join(_PLANS)}")
        data, self._plan = mechanics.get(mechanism), _PLANS[mechanism]
        self._params = data.resolve(None)
        text = _MODEL.format(
            step=step, impratio=IMPRATIO, radius=RADIUS, stiff=2 * step, **self._plan.build(self._params)
        )
        self.model = mj.MjModel.from_xml_string(text)
        self.data = mj.MjData(self.model)
        self._places = [self.model.joint(name).qposadr[0] for name in data.coordinates]
        for _ in range(round(SETTLING / step)):
            mj.mj_step(self.model, self.data)
        self._height = float(self.data.joint("z").qpos[0])

    def start(self, q: Array, qdot: Array) -> None:
        """Begin with coordinates and velocities (n,), the wheels rolling."""
        mj.mj_resetData(self.model, self.data)
        self.data.qpos[self._places], self.data.qvel[self._places] = q, qdot
        self.data.joint("z").qpos[0] = self._height
        for name, source in self._plan.copies.items():
            self.data.joint(name).qpos[0] = self.data.joint(source).qpos[0]
            self.data.joint(name).qvel[0] = self.data.joint(source).qvel[0]
        for name, (arm, turn) in self._plan.wheels.items():
            self.data.joint(name).qvel[0] = self._speed(q, qdot, arm, turn) / RADIUS

    def state(self) -> tuple[Array, Array]:
        """Coordinates and velocities (n,)."""
        return self.data.qpos[self._places].copy(), self.data.qvel[self._places].copy()

    def _speed(self, q: Array, qdot: Array, arm: Any, turn: Any) -> float:
        """Speed of a wheel along its heading."""
        theta, heading = q[2], q[2] + turn(q)
        across = arm(self._params) * qdot[2]
        velocity = qdot[:2] + across * np.array([-np.sin(theta), np.cos(theta)])
        return float(velocity @ [np.cos(heading), np.sin(heading)])


def _wheel(name: str, ahead: float = 0) -> str:
    return _WHEEL.format(name=name, ahead=ahead, mass=WHEEL, inertia=0.4 * WHEEL * RADIUS**2)


def _snakeboard(p: dict[str, float]) -> dict[str, Any]:
    def axle(name: str, ahead: float, sign: int) -> str:
        return _TURNING.format(
            name=name, ahead=ahead, sign=sign, mass=NOTHING, inertia=p["J_w"] / 2, parts=_wheel(f"{name}_wheel")
        )

    rotor = _TURNING.format(name="psi", ahead=0, sign=1, mass=NOTHING, inertia=p["J_r"], parts="")
    ends = 2 * (WHEEL + NOTHING)
    return {
        "mass": p["m"] - ends - NOTHING,
        "inertia": p["m"] * p["l"] ** 2 - p["J_r"] - p["J_w"] - ends * p["l"] ** 2,
        # The front axle turns against phi, the rear one with it.
        "parts": rotor + axle("phi", p["l"], -1) + axle("rear", -p["l"], 1),
        "rest": '<equality><joint joint1="rear" joint2="phi"/></equality>'
        '<actuator><motor joint="psi"/><motor joint="phi"/></actuator>',
    }


def _roller_racer(p: dict[str, float]) -> dict[str, Any]:
    axle = _wheel("front_wheel", p["l_2"])
    link = _TURNING.format(name="psi", ahead=p["l_1"], sign=1, mass=NOTHING, inertia=p["I_2"], parts=axle)
    return {
        "mass": p["m"] - NOTHING - 2 * WHEEL,
        "inertia": p["I_1"],
        "parts": _wheel("body_wheel") + link,
        "rest": '<actuator><motor joint="psi"/></actuator>',
    }


@dataclass(frozen=True)
class _Plan:
    """What is particular to a mechanism.

    Attributes:
        build: parameters -> what the model's text needs.
        wheels: wheel -> functions of parameters, how far ahead its pivot is, and of coordinates, how it is steered.
        copies: joint -> the joint that moves as it does.
    """

    build: Callable[[dict[str, float]], dict[str, Any]]
    wheels: dict[str, tuple[Callable[[dict[str, float]], float], Callable[[Array], float]]]
    copies: dict[str, str]


_PLANS = {
    "snakeboard": _Plan(
        _snakeboard,
        {"phi_wheel": (lambda p: p["l"], lambda q: -q[4]), "rear_wheel": (lambda p: -p["l"], lambda q: q[4])},
        {"rear": "phi"},
    ),
    # The front axle turns about the joint, which moves it across its own heading.
    "roller_racer": _Plan(
        _roller_racer,
        {"body_wheel": (lambda p: 0.0, lambda q: 0.0), "front_wheel": (lambda p: p["l_1"], lambda q: q[3])},
        {},
    ),
}
