"""Options of the fault-estimation filter, checked before anything is computed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.conic.lmi import FILTER_SOLVERS

#: Who finds the gains: Riccati equations, or the matrix inequality started from them.
ENGINES = ("auto", "riccati", "lmi")
#: The least relative distance to the optimum at which a proof can be expected.
LEAST_MARGIN = 1e-2


@dataclass(frozen=True)
class FilterOptions:
    """Options of the method as asked for; see `obsynth.fault_estimation_filter`."""

    gamma: float | None = None
    gamma_search: str = "direct"
    gamma_margin: float = 0.05
    free_residual_weight: bool | None = None
    residual_weight_limit: float | None = None
    S: Any = None
    engine: str = "auto"
    solver: str = "auto"
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        problems = self._wrong_types()
        if problems:
            raise SpecError("Options of fault-estimation-filter:", path="method.options", problems=problems)
        if self.gamma is not None and not (np.isfinite(self.gamma) and self.gamma > 0.0):
            problems.append(f"gamma is {self.gamma}: give a positive number, or none for the least.")
        if self.gamma_search not in ("direct", "bisection"):
            problems.append(f"gamma_search is {self.gamma_search!r}: use 'direct' or 'bisection'.")
        if not (np.isfinite(self.gamma_margin) and self.gamma_margin >= LEAST_MARGIN):
            problems.append(
                f"gamma_margin is {self.gamma_margin}: give {LEAST_MARGIN} or more, such as 0.05; less leaves no room "
                "for a proof."
            )
        if self.engine not in ENGINES:
            problems.append(f"engine is {self.engine!r}: use one of {', '.join(ENGINES)}.")
        if self.solver not in FILTER_SOLVERS:
            problems.append(f"solver is {self.solver!r}: use one of {', '.join(FILTER_SOLVERS)}.")
        if not 0.0 < self.tolerance < 1.0:
            problems.append(f"tolerance is {self.tolerance}: give a number between 0 and 1.")
        limit = self.residual_weight_limit
        if limit is not None and not (np.isfinite(limit) and limit > 0.0):
            problems.append(f"residual_weight_limit is {limit}: give a positive number.")
        if limit is not None and self.free_residual_weight is False:
            problems.append("residual_weight_limit needs free_residual_weight: the weight is fixed otherwise.")
        if limit is not None and self.engine == "riccati":
            problems.append("residual_weight_limit is not covered by engine 'riccati': use 'auto' or 'lmi'.")
        if problems:
            raise SpecError("Options of fault-estimation-filter:", path="method.options", problems=problems)

    def _wrong_types(self) -> list[str]:
        optional = {"gamma": self.gamma, "residual_weight_limit": self.residual_weight_limit}
        numbers: dict[str, object] = {name: value for name, value in optional.items() if value is not None}
        numbers |= {"gamma_margin": self.gamma_margin, "tolerance": self.tolerance}
        wrong = [
            f"{name} is {value!r}: give a number."
            for name, value in numbers.items()
            if isinstance(value, bool) or not isinstance(value, (int, float))
        ]
        if self.free_residual_weight not in (None, True, False):
            wrong.append(f"free_residual_weight is {self.free_residual_weight!r}: use True, False or None.")
        return wrong
