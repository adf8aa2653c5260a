"""A mechanism's spec: plain data from a file or a program, made the arguments of a `Mechanism`.

Here everything gets its type, or a refusal that says where it stands and what belongs there. What
the data mean is judged by `Mechanism` itself.
"""

from __future__ import annotations

import json
import math
import os
import re
import reprlib
import tomllib
from collections.abc import Callable, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from numbers import Real
from pathlib import Path
from typing import Any

from mechanics.bodies import Body
from mechanics.expressions import ExpressionError, names_in, wrong_keys

__all__ = ["Matrix", "MechanismError", "arguments", "matrix", "number", "read"]

Matrix = tuple[tuple[str, ...], ...]

# The longest file that is read. A snake of twenty links takes 42 kB, and tomllib 0.4 s for the worst
# that was found to put into this much.
MAX_BYTES = 250_000

_REQUIRED = ("name", "coordinates", "parameters", "inertia", "one_forms", "forces")


class MechanismError(ValueError):
    """The data do not describe a mechanism; the message says what was given and expected."""


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Plain data in a TOML or JSON file, told apart by the ending of its name."""
    path = Path(path)
    parse = _PARSERS.get(path.suffix.lower())
    if parse is None:
        raise MechanismError(f"{path}: the file of a mechanism ends in {' or '.join(_PARSERS)}")
    if not path.is_file():  # a pipe or a device could keep us waiting
        raise MechanismError(f"{path}: there is no such file")
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise MechanismError(f"{path}: cannot be read: {error.strerror}") from None
    if len(data) > MAX_BYTES:
        raise MechanismError(f"{path}: longer than {MAX_BYTES} bytes, the most that is read")
    try:
        return parse(data.decode("utf-8-sig"))  # some editors mark UTF-8
    except UnicodeDecodeError as error:
        raise MechanismError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from None
    except RecursionError:
        raise MechanismError(f"{path}: nests too deep") from None
    except ValueError as error:  # what both parsers raise, and int() for thousands of digits
        raise MechanismError(f"{path}: {error}") from None


def arguments(spec: Any) -> dict[str, Any]:
    """Arguments of `Mechanism` from a spec as described at `Mechanism.from_dict`."""
    if not isinstance(spec, Mapping):
        raise MechanismError(f"a mechanism's spec must be a mapping, not {type(spec).__name__}")
    if problem := wrong_keys(spec, _READERS, _REQUIRED, "the mechanism's spec"):
        raise MechanismError(problem)
    result = {key: _READERS[key](value, key) for key, value in spec.items()}
    if "frame" in result:
        frames = result.get("frames", {})
        if "default" in frames:
            raise MechanismError("'frame' is the frame 'default', which 'frames' has too; give it once")
        result["frames"] = {"default": result.pop("frame"), **frames}
    if "definitions" in result:
        result["definitions"] = _ordered(result["definitions"])
    return result


def number(value: Any, what: str) -> float:
    """`value` as a finite float; `what` says in errors what it is."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise MechanismError(f"{what} must be a number, not {_show(value)}")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise MechanismError(f"{what} is not finite: {_show(value)}")
    return result


def matrix(rows: Any, what: str) -> Matrix:
    """`rows` as rows of expressions."""
    if isinstance(rows, str) or not isinstance(rows, Sequence):
        raise MechanismError(f"{what} must be a list of rows, not {_show(rows)}")
    return tuple(_row(row, what) for row in rows)


def _row(values: Any, what: str) -> tuple[str, ...]:
    return tuple(_expression(value, what) for value in _list(values, what))


def _names(values: Any, what: str) -> tuple[str, ...]:
    return tuple(_string(value, what) for value in _list(values, what))


def _list(values: Any, what: str) -> Sequence[Any]:
    if isinstance(values, str | bytes) or not isinstance(values, Sequence):
        raise MechanismError(f"{what} must be a list of strings, not {_show(values)}")
    return values


def _expression(value: Any, what: str) -> str:
    """A string, or a number in place of one."""
    if isinstance(value, Real) and not isinstance(value, bool):
        given = number(value, what)
        return str(int(value)) if isinstance(value, int) else repr(given)
    if not isinstance(value, str):
        raise MechanismError(f"{what} must be made of strings, not {_show(value)}")
    return value


def _string(value: Any, what: str) -> str:
    """A string that does no harm to the terminal on which it is printed."""
    if not isinstance(value, str):
        raise MechanismError(f"{what} must be made of strings, not {_show(value)}")
    if not value.replace("\n", " ").replace("\t", " ").isprintable():
        raise MechanismError(f"{what} has characters that cannot be printed: {_show(value)}")
    return value


def _table(entry: Callable[[Any, str], Any]) -> Callable[[Any, str], dict[str, Any]]:
    def read_table(values: Any, what: str) -> dict[str, Any]:
        if not isinstance(values, Mapping):
            raise MechanismError(f"{what} must map names to values, not {_show(values)}")
        return {_string(name, f"{what}: a name"): entry(value, f"{what}: {name}") for name, value in values.items()}

    return read_table


def _body(data: Any, what: str) -> Body:
    if not isinstance(data, Mapping):
        raise MechanismError(f"{what} must map {', '.join(_BODY)} to values, not {_show(data)}")
    if problem := wrong_keys(data, _BODY, ("shape", "pose", "size"), what):
        raise MechanismError(problem)
    return Body(**{key: _BODY[key](value, f"{what}, {key}") for key, value in data.items()})


_BODY: dict[str, Callable[[Any, str], Any]] = {
    "shape": _string,
    "pose": _row,
    "size": _row,
    "on": _string,
    "colour": _string,
}
_READERS: dict[str, Callable[[Any, str], Any]] = {
    "name": _string,
    "coordinates": _names,
    "parameters": _table(number),
    "inertia": matrix,
    "one_forms": matrix,
    "forces": _table(_row),
    "potential": _expression,
    "frame": matrix,
    "frames": _table(matrix),
    "definitions": _table(_expression),
    "citation": _string,
    "fibre": _names,
    "joint_limits": _table(number),
    "torque_limits": _table(number),
    "observation": _table(_expression),
    "forward": _expression,
    "rayleigh": _expression,
    "drag": _table(number),
    "bodies": _table(_body),
}


def _ordered(definitions: dict[str, str]) -> dict[str, str]:
    """The same definitions, each after those it uses; in the order given if that is so already."""
    uses = {}
    for name, text in definitions.items():
        try:
            uses[name] = names_in(text) & definitions.keys()
        except ExpressionError as error:
            raise MechanismError(f"in definition {_show(name)}: {error}") from None
    try:
        order = tuple(TopologicalSorter(uses).static_order())
    except CycleError as error:
        steps = pairwise(reversed(error.args[1]))
        raise MechanismError(f"cyclic definitions: {', '.join(f'{a} uses {b}' for a, b in steps)}") from None
    place = {name: index for index, name in enumerate(definitions)}
    if all(place[other] < place[name] for name in uses for other in uses[name]):
        return definitions
    return {name: definitions[name] for name in order}


def _json(text: str) -> Any:
    return json.loads(text, object_pairs_hook=_unique, parse_float=_finite, parse_constant=_finite)


# tomllib remembers every beginning of a dotted key: one of 100,000 parts takes all the memory there is.
_LONG_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')[ \t]*\.[ \t]*){32}""", re.ASCII)


def _toml(text: str) -> Any:
    if found := _LONG_KEY.search(text):
        raise ValueError(f"a key of more than 32 parts: {_show(found[0])}")
    return tomllib.loads(text, parse_float=_finite)


_PARSERS: dict[str, Callable[[str], Any]] = {".toml": _toml, ".json": _json}


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {_show(twice)} is there twice")
    return result


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is not a finite number")
    return value


def _show(value: Any) -> str:
    """Bounded picture of a value that does not belong where it stands."""
    try:
        return reprlib.repr(value)
    except ValueError:  # an integer of thousands of digits
        return f"a huge {type(value).__name__}"
