"""The snake on wheels: n equal links in a chain, a passive axle under each centre, torques on the joints.

(x, y) is the centre of the last link, which follows; theta, theta2, ..., thetan are the directions of the links
from there to the head, measured from the x axis. A link has mass m, length L and inertia J about its centre.

A joint is L/2 in front of one axle and L/2 behind the next, so both links give it the same speed:
V_i^2 + (L/2 thetai')^2, V_i the speed along link i, is one number along the whole snake. With
V_i = s cos(chi_i) and L/2 thetai' = s sin(chi_i), the next link has chi_(i+1) = thetai+1 - thetai - chi_i. Hence
two velocities are left for every n, those of the last link, and the frame below has no singularity. The joint angles
do not serve as well: with n = 3 they determine the motion (the snake is then principally kinematic) but where they are
equal, and the axles meet in a point or are parallel.
"""

from fractions import Fraction

from mechanics.bodies import Body
from mechanics.mechanism import Matrix, Mechanism, MechanismError

__all__ = ["n_link_snake", "snake"]


def n_link_snake(n: int, name: str | None = None) -> Mechanism:
    """Snake of n links, n >= 2, in the frame of the speed and the turning rate of its last link."""
    if isinstance(n, bool) or not isinstance(n, int) or n < 2:
        raise MechanismError(f"a snake has at least 2 links, in a whole number; got {n!r}")
    angles = ("theta", *(f"theta{i}" for i in range(2, n + 1)))
    links, joints = range(n), range(n - 1)
    relative = [f"{angles[i + 1]} - {angles[i]}" for i in joints]
    # a_i = chi_i - (+ or -) chi_1 of the text above: alternating sums of the joint angles.
    turn = ["0", *(f"a_{i + 1}" for i in range(1, n))]
    return Mechanism(
        name=name or f"snake_{n}",
        coordinates=("x", "y", *angles),
        parameters={"m": 1.0, "J": 0.02, "L": 0.4},
        definitions={turn[i + 1]: f"{relative[i]} - {turn[i]}" for i in joints},
        inertia=_inertia(angles),
        one_forms=tuple((f"-sin({angles[i]})", f"cos({angles[i]})", *_lever("cos", i, angles)) for i in links),
        forces={
            f"tau{i + 1}": ("0", "0", *("-1" if j == i else "1" if j == i + 1 else "0" for j in links)) for i in joints
        },
        frames={
            "last_link": (
                ("cos(theta)", "sin(theta)", "0", *(f"2/L*sin({a})" for a in turn[1:])),
                ("0", "0", "1", *(f"{'-' if i % 2 else ''}cos({turn[i]})" for i in links[1:])),
            ),
        },
        citation="P. S. Krishnaprasad and D. P. Tsakiris, G-snakes: nonholonomic kinematic chains on Lie groups, "
        "IEEE CDC 1994; J. Ostrowski and J. Burdick, Gait kinematics for a serpentine robot, IEEE ICRA 1996; "
        "E. A. Shammas, H. Choset and A. A. Rizzi, Geometric motion planning analysis for two classes of "
        "underactuated mechanical systems, Int. J. Robotics Research 26(10), 2007",
        fibre=("x", "y", "theta"),
        torque_limits={f"tau{i + 1}": 0.2 for i in joints},
        observation={
            **{f"sin_alpha{i + 1}": f"sin({relative[i]})" for i in joints},
            **{f"cos_alpha{i + 1}": f"cos({relative[i]})" for i in joints},
            **{f"alpha{i + 1}_dot": f"({angles[i + 1]}_dot - {angles[i]}_dot)/10" for i in joints},
            "speed": "speed",
        },
        rayleigh=_rayleigh(angles),
        drag={"c_w": 0.05, "c_j": 0.005},
        bodies=_bodies(angles),
    )


def _reach(i: int, j: int) -> Fraction:
    """Length of link j, in units of L, on the way from the centre of link 0 to that of link i."""
    if i == 0 or j > i:
        return Fraction(0)
    return Fraction(1, 2) if j in (0, i) else Fraction(1)


def _times(factor: Fraction, text: str) -> str:
    return f"{factor.numerator}*{text}/{factor.denominator}" if factor else "0"


def _lever(function: str, i: int, angles: tuple[str, ...]) -> list[str]:
    """What the turning of each link adds to the velocity of link i across (cos) or along (sin) its axis."""
    return [_times(_reach(i, j), f"L*{function}({angles[i]} - {angles[j]})") for j in range(len(angles))]


def _inertia(angles: tuple[str, ...]) -> Matrix:
    n = len(angles)
    links = range(n)
    sums = [sum((_reach(i, j) for i in links), Fraction(0)) for j in links]
    x = [_times(-sums[j], f"m*L*sin({angles[j]})") for j in links]
    y = [_times(sums[j], f"m*L*cos({angles[j]})") for j in links]
    turning = [
        [
            ("J + " if j == k else "")
            + _times(
                sum((_reach(i, j) * _reach(i, k) for i in links), Fraction(0)),
                "m*L**2" if j == k else f"m*L**2*cos({angles[j]} - {angles[k]})",
            )
            for k in links
        ]
        for j in links
    ]
    return (
        (f"{n}*m", "0", *x),
        ("0", f"{n}*m", *y),
        *((x[j], y[j], *turning[j]) for j in links),
    )


def _rayleigh(angles: tuple[str, ...]) -> str:
    """Friction of the wheels, which roll at the speeds V_i, and of the joints."""
    links = range(len(angles))
    speeds = [
        " + ".join(
            [f"cos({angles[i]})*x_dot + sin({angles[i]})*y_dot"]
            + [f"{a}*{angles[j]}_dot" for j, a in enumerate(_lever("sin", i, angles)) if a != "0"]
        )
        for i in links
    ]
    rates = [f"{angles[i + 1]}_dot - {angles[i]}_dot" for i in links[:-1]]
    return f"(c_w*({_squares(speeds)}) + c_j*({_squares(rates)}))/2"


def _bodies(angles: tuple[str, ...]) -> dict[str, Body]:
    """A link is a bar from joint to joint on its axle; the head is of another colour."""
    bodies: dict[str, Body] = {}
    for i, angle in enumerate(angles):
        pose = ("x", "y", "theta")
        if i:
            joint = f"{angle} - {angles[i - 1]}"
            pose = (f"L/2 + L/2*cos({joint})", f"L/2*sin({joint})", joint)
        axle, colour = f"axle {i + 1}", "orange" if i == len(angles) - 1 else "blue"
        bodies[axle] = Body("axle", pose, ("0.5*L", "0.28*L", "0.09*L"), on=f"axle {i}" if i else "")
        bodies[f"link {i + 1}"] = Body("rectangle", ("0", "0", "0"), ("0.94*L", "0.16*L"), on=axle, colour=colour)
    return bodies


def _squares(texts: list[str]) -> str:
    return " + ".join(f"({text})**2" for text in texts)


snake = n_link_snake(3, "snake")
