"""Options that several commands have."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

from training.config import training_seed

__all__ = ["Seeds", "check_seeds", "seeds"]


def seeds(texts: Sequence[str]) -> tuple[int, ...]:
    """Numbers of runs, each written as 3 or, for several, as 0-9."""
    numbers: list[int] = []
    for text in texts:
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", text)
        if match is None or (match[2] and int(match[2]) < int(match[1])):
            raise ValueError(f"seeds must be numbers such as 3, or ranges such as 0-9, got {text!r}")
        numbers += range(int(match[1]), int(match[2] or match[1]) + 1)
    return tuple(numbers)


def check_seeds(numbers: Sequence[int]) -> None:
    """Raise ValueError unless runs may have these numbers, at least one and all different."""
    for number in numbers:
        training_seed(number)
    if not numbers or len(set(numbers)) < len(numbers):
        raise ValueError(f"seeds must be different numbers, at least one, got {tuple(numbers)}")


def _is_seeds(value: Any) -> bool:
    return isinstance(value, tuple) and all(isinstance(number, int) for number in value)


# What the command line reads as seeds.
Seeds = Annotated[
    tuple[int, ...],
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="SEED|FIRST-LAST ...",
        instance_from_str=seeds,
        is_instance=_is_seeds,
        str_from_instance=lambda numbers: [str(number) for number in numbers],
    ),
]
