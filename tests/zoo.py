"""Eight more mechanisms from the literature, in `data/zoo`, as `Mechanism`s."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mechanics.mechanism import Mechanism

__all__ = ["FOLDER", "NAMES", "gram_schmidt", "load", "read"]

FOLDER = Path(__file__).parent / "data" / "zoo"
NAMES = tuple(sorted(path.stem for path in FOLDER.glob("*.json")))


def read(name: str) -> dict[str, Any]:
    return json.loads((FOLDER / f"{name}.json").read_text())


def load(name: str, fibre: bool = True) -> Mechanism:
    """Mechanism with parameters in the middle of their ranges and an orthogonal frame."""
    data = read(name)
    return Mechanism.from_dict(
        {
            "name": name,
            "coordinates": data["coordinates"],
            "parameters": {key: (low + high) / 2 for key, (low, high) in data["parameters"].items()},
            "inertia": data["M"],
            "one_forms": data["constraints"],
            "forces": data["inputs"],
            "potential": data["potential"],
            "frame": gram_schmidt(data["D_basis"], data["M"]),
            "fibre": data["coordinates"][:3] if fibre else [],
            "citation": data["citation"],
        }
    )


def gram_schmidt(basis: Sequence[Sequence[str]], inertia: Sequence[Sequence[str]]) -> list[list[str]]:
    """Orthogonal rows by eq. (9) of Bullo and Zefran, X_2 = X_2' - <<X_2', X_1>>/|X_1|^2 X_1, as text."""
    rows: list[list[str]] = []
    for field in basis:
        new = list(field)
        for other in rows:
            if product := _inner(field, other, inertia):
                new = [
                    f"({a}) - ({product})/({_inner(other, other, inertia)})*({b})"
                    for a, b in zip(new, other, strict=True)
                ]
        rows.append(new)
    return rows


def _inner(a: Sequence[str], b: Sequence[str], inertia: Sequence[Sequence[str]]) -> str:
    terms = ((x, m, y) for x, row in zip(a, inertia, strict=True) for m, y in zip(row, b, strict=True))
    return " + ".join(f"({x})*({m})*({y})" for x, m, y in terms if "0" not in (x, m, y))
