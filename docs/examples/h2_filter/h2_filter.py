"""A method of one's own: Wang's filter with the least H2 norm and its eigenvalues in a disk, on obsynth.conditions."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from obsynth.analysis.existence.condition import Condition, require_all
from obsynth.methods.fault_estimation_filter.method import FaultEstimationFilter
from obsynth.methods.method import ClaimMeaning, Method, PlantKind, Synthesis
from obsynth.numerics.arguments import Positive
from obsynth.results.checks import Check, upper_bound_check
from obsynth.results.design import Certificate, ObserverDesign

ROOM = 1e-6  # what a claim keeps to the number found


@dataclass(frozen=True)
class H2Filter(Method):
    """Design a fault-estimation filter with the least H2 norm from the disturbances to the fault errors.

    Parameters
    ----------
    plant : DescriptorSystem
        As for `obsynth.fault_estimation_filter`, without Dd.
    radius : float, optional, dimensionless
        Every eigenvalue lies in the disk of this radius around 0.

    Returns
    -------
    ObserverDesign
        ``certificate.claims``: ``h2_norm`` and ``radius`` beside those of `obsynth.fault_estimation_filter`.
    """

    id: ClassVar[str] = "h2-filter"
    plants: ClassVar[tuple[PlantKind, ...]] = ("time-invariant",)
    time: ClassVar[str] = "discrete"
    summary: ClassVar[str] = "fault estimates with the least H2 norm from the disturbances"
    source: ClassVar[str] = "Wang, Rodrigues, Theilliol, Shen 2015; Scherer, Gahinet, Chilali 1997"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        **FaultEstimationFilter.claims,
        "h2_norm": ClaimMeaning("", "H2 norm from the disturbances to the fault errors", "h2_norm"),
        "radius": ClaimMeaning("", "spectral radius of the filter", "radius"),
    }
    witnesses: ClassVar[frozenset[str]] = FaultEstimationFilter.witnesses
    error_model = FaultEstimationFilter.error_model

    radius: Positive = 1.0

    def existence(self, plant: Any, *, exactly: bool = True) -> tuple[Condition, ...]:
        """Return the conditions of the filter, and that outputs show no disturbance at once."""
        found = FaultEstimationFilter().existence(plant, exactly=exactly)
        direct = float(np.abs(plant.Dd).max(initial=0.0))
        return (*found, Condition("Dd = 0", "no direct effect of a disturbance", not direct, direct, 0.0, "ours"))

    def synthesise(self, plant: Any, *, progress: Callable[[str], None]) -> Synthesis:
        """Solve the H2 inequalities and that of the disk, with P and Y of (45)."""
        import cvxpy as cp

        from obsynth import conditions

        require_all(self.existence(plant))
        progress("solving the H2 inequalities")
        paper = conditions.wang2015(plant)
        P, Y, data = paper.variables["P"], paper.variables["Y"], paper.data
        A1, C1, TD, nd = data["A1"], data["C1"], data["TD"], plant.nd
        Z, shown = cp.Variable((nd, nd), symmetric=True, name="Z"), data["W"] @ plant.C
        own = conditions.h2(A1, TD, shown, np.zeros((plant.nf, nd)), P, Z, plant.dt, Y=Y, Cy=C1)
        disk = conditions.disk(0.0, self.radius)
        own += conditions.region(A1, P, disk, Y=Y, Cy=C1, margin=1e-9)  # P has its scale by (45)
        problem = paper.changed(constraints=own, drop=["(45)"], objective=cp.trace(Z))
        problem.solve()
        design = problem.design()
        norm, radius = _norm_and_radius(plant, design)
        claims = {**design.certificate.claims, "h2_norm": (1 + ROOM) * norm, "radius": (1 + ROOM) * radius + ROOM}
        certificate = Certificate(design.certificate.matrices, claims)
        return Synthesis(self.as_plain(), design.gains, design.observer, certificate)

    @classmethod
    def checks(cls, design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
        """Yield the rows of the filter, and one for each claim of ours."""
        matrices, claims = design.certificate.matrices, design.certificate.claims
        known = {name: claims[name] for name in FaultEstimationFilter.claims if name in claims}
        yield from FaultEstimationFilter.checks(
            design.replace(certificate=Certificate(matrices, known)), printed_digits
        )
        for name, value in zip(("h2_norm", "radius"), _norm_and_radius(design.plant, design), strict=True):
            yield upper_bound_check(name, cls.claims[name].meaning, value, claims[name], source="recomputed")


def _norm_and_radius(plant: Any, design: ObserverDesign) -> tuple[float, float]:
    """Return the H2 norm by a Lyapunov equation of the shipped numbers, and the spectral radius."""
    from scipy.linalg import solve_discrete_lyapunov

    observer, tracking = design.observer, design.certificate.matrices["tracking"]
    entering = tracking[:, : plant.nx] @ plant.Bd
    gram = solve_discrete_lyapunov(observer.Az, entering @ entering.T)
    shown = observer.Cz[observer.fault_rows]
    return float(np.sqrt(np.trace(shown @ gram @ shown.T))), float(np.abs(np.linalg.eigvals(observer.Az)).max())
