"""Whether one certificate covers a whole region: decided by a verified design, where that is fast."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.errors import InfeasibleError, PreconditionError, SolverError, SpecError, VerificationError
from obsynth.methods.method import Method
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.results.design import ObserverDesign

#: The condition's name, and the beginning of its row's.
REGION_CONDITION = "certificate over the region"
#: Plants of more than this (vertices times squared number of states) are not designed for a check: that takes a minute
#: and more (64 vertices of order 4, or 4 of order 16, take some 10 s).
MOST_TRIED = 1024


def region_condition(
    plant: PolytopicSystem, method: Method, designed: Callable[[], ObserverDesign]
) -> Condition | None:
    """Return whether a design over the region of a plant is verified; ``None`` where a trial would take too long.

    Conditions at points of a region are necessary only: whether one certificate covers every course of the parameters
    is decided by its inequalities.

    Parameters
    ----------
    plant : PolytopicSystem
        The plant, whose conditions at points hold.
    method : Method
        With its options.
    designed : callable
        Returns the verified design.
    """
    if plant.count * plant.nx**2 > MOST_TRIED:
        return None
    words = f"over {plant.scheduling.sentence()}"

    def outcome(detail: str, *, holds: bool = False, unclear: bool = False) -> Condition:
        return Condition(
            REGION_CONDITION, f"one certificate covers every course of the parameters {words}", holds,
            float(holds), 1.0, "a design with these options, verified", detail, unclear=unclear, of_the_method=True,
        )  # fmt: skip

    try:
        design = designed()
    except (PreconditionError, InfeasibleError) as error:
        return outcome(str(error))
    except (SolverError, VerificationError, np.linalg.LinAlgError) as error:
        return outcome(str(error), unclear=True)
    except SpecError:
        return None  # what a design needs besides is reported as a condition of its own
    claims = design.certificate.claims
    proved = [
        f"{meaning.meaning} {claims[name]:.6g}{f' {meaning.unit}' if meaning.unit else ''}"
        for name, meaning in type(method).claims.items()
        if name in claims and meaning.row in {row.name for row in design.report.checks if row.kind == "proved"}
    ]
    return outcome("; ".join(proved), holds=True)
