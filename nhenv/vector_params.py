"""Parameters, drag and torque limits of rows, alike or each with its own."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mechanics.expressions import unknown_name
from mechanics.model import Model
from nhenv.configuration import Configuration
from nhenv.vector_memory import RowMemory

__all__ = ["RowParameters"]

Array = NDArray[np.float64]
Rows = NDArray[np.int64]  # numbers of rows


class RowParameters:
    """Parameters, drag and torque limits of N rows; at first those of a configuration.

    Args:
        configuration: what the rows have in common.
        size: number N of rows.
        varied: whether rows may differ.

    Attributes:
        varied: as given.
        values: name -> a number, or an array (N,) where rows differ.
        drag: name -> coefficient, likewise; None if no drag acts.
        torque_limits: (N, m) largest torques.
    """

    def __init__(self, configuration: Configuration, size: int, varied: bool) -> None:
        self._configuration, self.varied = configuration, varied
        self.values: dict[str, Any] = dict(configuration.params)
        self.drag: dict[str, Any] | None = None if configuration.drag is None else dict(configuration.drag)
        self.torque_limits = np.tile(configuration.torque_limits, (size, 1))

    def change(
        self,
        params: Mapping[str, Array],
        drag: Mapping[str, Array],
        limits: Mapping[str, Array],
        chosen: Rows,
        kernel: ModuleType,
        memory: RowMemory,
    ) -> None:
        """Check what each of the chosen rows has of its own, and write it where the kernel reads it."""
        configuration, controls = self._configuration, self._configuration.mechanism.controls
        torque_limits = self.torque_limits.copy()
        for name, values in limits.items():
            if name not in controls:
                raise ValueError(f"torque_limits: {unknown_name('control', name, controls)}")
            if not (np.isfinite(values[chosen]) & (values[chosen] > 0)).all():
                raise ValueError(f"torque_limits: those of {name} must be positive and finite, got {values[chosen]}")
            torque_limits[chosen, controls.index(name)] = values[chosen]
        if drag and self.drag is None:
            raise ValueError(
                f"drag: these environments have none, so {', '.join(drag)} cannot change: make them with drag=True"
            )
        new = self._merged("params", "parameter", self.values, params, chosen)
        new_drag = None if self.drag is None else self._merged("drag", "drag coefficient", self.drag, drag, chosen)
        fields = [name for name in kernel.LASTING if name.startswith("k_")]
        constants = np.empty((len(chosen), len(fields)))
        for place, row in enumerate(chosen.tolist()):
            try:
                of_row = configuration.mechanism.drag_coefficients(_row(new_drag, row))
                numbers = configuration.numbers(configuration.mechanism.resolve(_row(new, row)), of_row)
            except ValueError as error:
                raise type(error)(f"row {row}: {error}") from None
            constants[place] = kernel.constants([numbers[name] for name in configuration.scene.parameters])
        for i, field in enumerate(fields):
            memory.put(field, chosen, constants[:, i])
        for i, control in enumerate(controls):
            memory.put(f"limit_{control}__p", chosen, torque_limits[chosen, i])
        for joint, limit in configuration.joint_limits.items():
            memory.put(f"stop_{joint}__p", chosen, limit)
        self.values, self.drag, self.torque_limits = new, new_drag, torque_limits

    def _merged(
        self, what: str, kind: str, old: Mapping[str, Any], given: Mapping[str, Array], chosen: Rows
    ) -> dict[str, Any]:
        """Numbers by name, those given put in for the chosen rows."""
        new = dict(old)
        for name, values in given.items():
            if name not in new:
                raise ValueError(f"{what}: {unknown_name(kind, name, new)}")
            new[name] = np.array(np.broadcast_to(new[name], len(self.torque_limits)))
            new[name][chosen] = values[chosen]
        return new

    def evaluate(self, function: str, q: Array, other: Array, chosen: Rows) -> Array:
        """A function of the mechanism's model, of q and v or q̇ in the chosen rows."""
        if not self.varied:
            return getattr(self._configuration.model, function)(q, other)
        mechanism, frame = self._configuration.mechanism, self._configuration.scene.frame
        models = (Model(mechanism, _row(self.values, row), frame, _row(self.drag, row)) for row in chosen.tolist())
        return np.array([getattr(model, function)(*of_row) for model, *of_row in zip(models, q, other, strict=True)])


def _row(values: Mapping[str, Any] | None, row: int) -> dict[str, float] | None:
    """Numbers of one row, of numbers or arrays (N,); None of None."""
    return (
        None
        if values is None
        else {name: float(value[row]) if np.ndim(value) else value for name, value in values.items()}
    )
