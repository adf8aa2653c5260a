"""The mechanisms that come with the project: one file each, and one line here."""

from __future__ import annotations

import importlib

from mechanics.expressions import unknown_name
from mechanics.mechanism import Mechanism, MechanismError

__all__ = ["get", "names"]

# Those with a pose in the plane and controls, which have environments. Said here, because asking the mechanisms
# would build all of them with every `import nhenv`, ten milliseconds each.
_IN_THE_PLANE = (
    "snakeboard",
    "roller_racer",
    "chaplygin_sleigh",
    "chaplygin_beanie",
    "sleigh_with_arm",
    "knife_edge_incline",
    "vertical_rolling_disk",
    "differential_drive",
    "car",
    "trailer",
    "snake",
    "roller_racer_massive",
    "planar_rigid_body",
    "falling_rolling_disk",
    "wheeled_inverted_pendulum",
)
# Those of them that come to rest in any pose nearby: locally configuration controllable from rest (section 6 of the
# paper); the differential drive's pose is, though its wheels' angles are not independent of it.
_ANY_POSE = (
    "snakeboard",
    "chaplygin_sleigh",
    "vertical_rolling_disk",
    "differential_drive",
    "car",
    "trailer",
    "snake",
    "planar_rigid_body",
)
_OTHERS = (
    "suslov",
    "chaplygin_sphere",
)


def names(*, in_the_plane: bool = False, any_pose: bool = False) -> tuple[str, ...]:
    """Names of the mechanisms in the catalogue.

    Args:
        in_the_plane: only those that can be steered through the plane.
        any_pose: only those of these that can be brought to rest in any pose nearby, from any.
    """
    if any_pose:
        return _ANY_POSE
    return _IN_THE_PLANE if in_the_plane else (*_IN_THE_PLANE, *_OTHERS)


def get(name: str) -> Mechanism:
    """Mechanism of this name; raise `MechanismError` with the known names if there is none."""
    if name not in names():
        raise MechanismError(unknown_name("mechanism", str(name), names()))
    return getattr(importlib.import_module(f"mechanics.catalog.{name}"), name)
