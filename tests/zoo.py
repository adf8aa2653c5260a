"""Eight more mechanisms from the literature, in `data/zoo`, as `Mechanism`s."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mechanics.mechanism import Mechanism

__all__ = ["FOLDER", "NAMES", "load", "read"]

FOLDER = Path(__file__).parent / "data" / "zoo"
NAMES = tuple(sorted(path.stem for path in FOLDER.glob("*.json")))


def read(name: str) -> dict[str, Any]:
    return json.loads((FOLDER / f"{name}.json").read_text())


def load(name: str, frame: bool = True, fibre: bool = True) -> Mechanism:
    """Mechanism with parameters in the middle of their ranges.

    Args:
        name: one of `NAMES`.
        frame: whether to give the natural basis of D, which need not be orthogonal, or none.
        fibre: whether to declare that the first three coordinates are the pose in the plane.
    """
    data = read(name)
    spec = {
        "name": name,
        "coordinates": data["coordinates"],
        "parameters": {key: (low + high) / 2 for key, (low, high) in data["parameters"].items()},
        "inertia": data["M"],
        "one_forms": data["constraints"],
        "forces": data["inputs"],
        "potential": data["potential"],
        "fibre": data["coordinates"][:3] if fibre else [],
        "citation": data["citation"],
    }
    return Mechanism.from_dict(spec | ({"frame": data["D_basis"]} if frame else {}))
