"""The mechanisms that come with the project: one file each, and one line here."""

from __future__ import annotations

import importlib

from mechanics.expressions import unknown_name
from mechanics.mechanism import Mechanism, MechanismError

__all__ = ["get", "names"]

_NAMES = (
    "snakeboard",
    "roller_racer",
)


def names() -> tuple[str, ...]:
    """Names of the mechanisms in the catalogue."""
    return _NAMES


def get(name: str) -> Mechanism:
    """Mechanism of this name; raise `MechanismError` with the known names if there is none."""
    if name not in _NAMES:
        raise MechanismError(unknown_name("mechanism", str(name), _NAMES))
    return getattr(importlib.import_module(f"mechanics.catalog.{name}"), name)
