"""Its options, each with its range."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

from obsynth.methods.method_spec import MethodOptions
from obsynth.numerics.arguments import OpenUnitInterval


@dataclass(frozen=True)
class LuenbergerOptions(MethodOptions):
    """Options of the method as asked for."""

    METHOD: ClassVar[str] = "luenberger-observer"

    pole: OpenUnitInterval = 0.5
    kind: Literal["predictor", "slow"] = "predictor"

    def conflicts(self) -> Iterator[str]:
        if self.kind == "slow" and self.pole < 0.5:
            yield "a slow observer has a pole of at least 0.5."
