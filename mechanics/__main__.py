"""Print the reduced equations of a mechanism: `python -m mechanics snakeboard --frame paper`.

`python -m mechanics FILE.toml` does the same for a mechanism of your own (`Mechanism.from_file`),
`python -m mechanics` lists the catalogue, and `--scene ID` shows what an environment computes of it.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import tyro

from mechanics.catalog import get, names
from mechanics.expressions import to_sympy
from mechanics.mechanism import Mechanism, MechanismError

if TYPE_CHECKING:
    from mechanics.geometry import ReducedEquations

__all__ = ["catalogue", "main", "report"]

SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
GREEK = dict(
    zip(
        "alpha beta gamma delta epsilon theta lambda mu rho sigma tau phi chi psi omega".split(),
        "αβγδεθλμρστφχψω",
        strict=True,
    )
)
DOT = "\N{COMBINING DOT ABOVE}"
TILDE = "\N{COMBINING TILDE}"


def main(
    name: Annotated[str, tyro.conf.Positional] = "",
    frame: str | None = None,
    drag: bool = False,
    shorthands: bool = True,
    scene: str = "",
) -> None:
    """Derive and print the equations of motion of a mechanism.

    Args:
        name: a mechanism of the catalogue, such as snakeboard or roller_racer, or a file that ends in .toml or
            .json; the catalogue is listed if left out.
        frame: name of one of its frames; the default frame if left out.
        drag: let the mechanism's drag act.
        shorthands: write the mechanism's own shorthands (such as f_1) instead of what they stand for.
        scene: id of an environment, such as nhenv/SnakeboardForward-v0: print which states it integrates, which it
            leaves out, and the operations of a step, as `python -m nhenv` does; nothing else is needed then.
    """
    if scene:
        # A command line may look upward, at run time and when asked; nothing of this package does.
        importlib.import_module("nhenv.__main__").main((scene,), drag=drag)
        return
    if not name:
        print("\n".join(catalogue()))
        return
    try:
        mechanism = Mechanism.from_file(name) if _is_path(name) else get(name)
        mechanism.frame_rows(frame)
        mechanism.drag_coefficients(drag)
    except MechanismError as error:
        _fail(str(error), *(() if _is_path(name) or name in names() else catalogue()))

    from rich.console import Console

    from mechanics.geometry.reduction import derive

    try:
        equations = derive(mechanism, frame, drag=drag)
    except (ValueError, ArithmeticError, RecursionError) as error:
        _fail(f"{mechanism.name} cannot be reduced: {error}")
    # Soft wrap: a formula is cut by the terminal, not by us, and copies as one line.
    console = Console(highlight=False, soft_wrap=True, markup=False)
    frame = frame or next(iter(mechanism.frames), None)
    for title, lines in report(equations, frame, shorthands):
        console.print(title, style="bold cyan")
        for line in lines:
            console.print(f"  {line}")


def catalogue() -> Iterator[str]:
    """A line on each mechanism of the catalogue."""
    width = max(map(len, names()))
    for m in map(get, names()):
        numbers = f"{m.n} coordinates, {m.rank} velocities, controls: {len(m.controls)}"
        yield f"{m.name:{width}}  {numbers}: {m.citation.split(';')[0]}"


def _is_path(name: str) -> bool:
    return bool(Path(name).suffix) or Path(name).name != name


def _fail(*lines: str) -> NoReturn:
    print("\n".join(("error: " + lines[0], *lines[1:])), file=sys.stderr)
    raise SystemExit(2)


def report(e: ReducedEquations, frame: str | None, shorthands: bool = True) -> Iterator[tuple[str, list[str]]]:
    """Sections of the printout, each with its title and lines.

    Args:
        e: the reduced equations.
        frame: what to call their frame, None if it was found.
        shorthands: write the mechanism's definitions by name.
    """
    from mechanics.compiler.codegen import needed
    from mechanics.geometry.counting import count_operations

    write = _Writer(e.mechanism, shorthands)
    q = [write.name(s.name) for s in e.coordinates]
    v = [write.name(s.name) for s in e.pseudo_velocities]
    k = range(len(v))
    m = e.mechanism
    yield m.name, [m.citation or "no source given"]
    yield f"Coordinates ({m.n}) and controls ({len(m.controls)})", [", ".join(q), _names(write, m.controls)]
    yield "Parameters, with defaults in SI units", [f"{write.name(p)} = {value:g}" for p, value in m.parameters.items()]
    columns = [
        f"X{_sub(i)} = {_vector(write, q, [e.frame[a, i] for a in range(m.n)])}    ‖X{_sub(i)}‖² = "
        f"{write(e.squared_norms[i])}"
        for i in k
    ]
    which = "Frame found" if frame is None else f"Frame {frame!r}"
    yield f"{which} of the velocities that the constraints allow", columns
    gamma = [
        f"Γ{TILDE}{_sup(up)}{_sub(i)}{_sub(j)} = {write(e.christoffel[up, i, j])}"
        for up in k
        for i in k
        for j in k
        if e.christoffel[up, i, j] != 0
    ]
    yield f"Generalized Christoffel symbols: {len(gamma)} of {len(v) ** 3} do not vanish", gamma
    inputs = [
        f"Y{_sup(i)}({write.name(u.name)}) = {write(e.input_coefficients[i, a])}"
        for i in k
        for a, u in enumerate(e.controls)
        if e.input_coefficients[i, a] != 0
    ]
    yield "Input coefficients", inputs
    if m.potential != "0":
        gradients = [f"-X{_sub(i)}(V)/‖X{_sub(i)}‖² = {write(e.potential_acceleration[i])}" for i in k]
        yield "Potential energy and what it adds to the accelerations", [f"V = {write.text(m.potential)}", *gradients]
    if any(e.drag):
        tensor = [f"R{_sup(i)}{_sub(j)} = {write(e.drag[i, j])}" for i in k for j in k if e.drag[i, j] != 0]
        defaults = [f"{write.name(c)} = {value:g}" for c, value in m.drag.items()]
        yield (
            "Drag: Rayleigh's function, its defaults in SI units, and what multiplies -v",
            [
                f"R = {write.text(m.rayleigh)}",
                *defaults,
                *tensor,
            ],
        )
    yield "Kinematic equations", [f"{_dot(a)} = {write(r)}" for a, r in zip(q, e.velocity, strict=True)]
    yield "Dynamic equations", [f"{_dot(a)} = {write(r)}" for a, r in zip(v, e.acceleration, strict=True)]
    printed = [e.frame, e.squared_norms, e.christoffel, e.input_coefficients, e.potential_acceleration, e.drag]
    formulas = [*e.velocity, *e.acceleration]
    if steps := needed([*formulas, *(entry for array in printed for entry in array)], e.definitions):
        yield "Steps that these formulas share", [f"{s.name} = {write(value)}" for s, value in steps.items()]
    if where := write.used():
        yield "where", where
    everything = [*needed(formulas, e.definitions).values(), *formulas]
    yield (
        "Operations of one evaluation, common subexpressions shared",
        [
            f"{count_operations(everything, ())} in all, {count_operations(everything, e.parameters)} "
            "when what depends on parameters alone is computed before"
        ],
    )


class _Writer:
    """Writes expressions on one line, as in a paper, and remembers which shorthands it used."""

    def __init__(self, mechanism: Mechanism, shorthands: bool) -> None:
        import sympy as sp
        from sympy.printing.str import StrPrinter

        class Printer(StrPrinter):
            def _print_Symbol(self, symbol: Any) -> str:
                return _name(symbol.name)

            def _print_Pow(self, power: Any, rational: bool = False) -> str:
                base, exponent = power.as_base_exp()
                if exponent == sp.S.Half:
                    return f"√({self._print(base)})"
                if exponent.is_Integer and exponent > 0:
                    if isinstance(base, sp.sin | sp.cos):  # sin²(ψ)
                        return f"{base.func.__name__}{_digits(exponent)}({self._print(base.args[0])})"
                    return f"{self.parenthesize(base, 60)}{_digits(exponent)}"
                return super()._print_Pow(power, rational=rational)

        self.print = Printer().doprint
        self.name = _name
        self.mechanism = mechanism
        self._seen: set[str] = set()
        # Longest first: f_1 contains c, and is looked for before it.
        self.scope = mechanism.scope()
        self.rules = {
            self.scope[name]: sp.Symbol(name) for name in reversed(tuple(mechanism.definitions)) if shorthands
        }

    def __call__(self, expression: Any) -> str:
        """One line for an expression."""
        short = expression.xreplace(self.rules)
        self._seen |= {s.name for s in short.free_symbols}
        return self.print(short).replace("*", " ")

    def text(self, text: str) -> str:
        """One line for an expression of the mechanism."""
        import sympy as sp

        rates = {rate: sp.Symbol(rate) for rate in self.mechanism.rates}
        return self(to_sympy(text, self.scope | rates))

    def used(self) -> list[str]:
        """Lines `name = expression` of the shorthands used so far and of those they use."""
        lines = []
        for expression, symbol in self.rules.items():
            if symbol.name in self._seen:
                rules, self.rules = self.rules, {a: b for a, b in self.rules.items() if b != symbol}
                lines.append(f"{self.name(symbol.name)} = {self(expression)}")
                self.rules = rules
        return lines[::-1]


def _name(name: str) -> str:
    """u_psi as u_ψ, l_1 as l₁, J_r as J_r, x_dot as ẋ."""
    if name.endswith("_dot"):
        return _dot(_name(name.removesuffix("_dot")))
    base, _, index = name.partition("_")
    if not index and base[-1:].isdigit():
        base, index = base.rstrip("0123456789"), base[len(base.rstrip("0123456789")) :]
    base, index = (GREEK.get(part, part) for part in (base, index))
    return base + (index.translate(SUBSCRIPTS) if index.isdigit() else f"_{index}" if index else "")


def _names(write: _Writer, names: Iterable[str]) -> str:
    return ", ".join(write.name(name) for name in names) or "none"


def _vector(write: _Writer, coordinates: list[str], components: list[Any]) -> str:
    terms = []
    for name, component in zip(coordinates, components, strict=True):
        if component != 0:
            text = write(component)
            text = "" if component == 1 else f"({text}) " if component.is_Add or text.startswith("-") else f"{text} "
            terms.append(f"{text}∂{name}")
    return " + ".join(terms) or "0"


def _digits(number: Any) -> str:
    return str(number).translate(SUPERSCRIPTS)


def _sup(index: int) -> str:
    return str(index + 1).translate(SUPERSCRIPTS)


def _sub(index: int) -> str:
    return str(index + 1).translate(SUBSCRIPTS)


def _dot(name: str) -> str:
    return name[0] + DOT + name[1:]


if __name__ == "__main__":
    tyro.cli(main, prog="python -m mechanics")
