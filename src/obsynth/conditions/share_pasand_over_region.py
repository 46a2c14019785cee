r"""The unknown-input PI observer over the region of a polytopic plant: inequalities at the vertices of its errors.

With constant ``U_a, D_a`` of (19) for all directions of the unknown inputs, ``e+ = (U_a A_a(mu) - K_a(mu) C_a) e``, and
what drives the fault models enters their states: a vertex problem (V1) in discrete time; in continuous time one gain
is enough where what drives is not seen at once (`obsynth.conditions.polytope`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.analysis.existence.augmented_pencils import AugmentedPlant
from obsynth.analysis.existence.sharepasand_over_region import pi_conditions_over_region, with_all_directions
from obsynth.conditions.augmented_plant import Decoupled, decouple, direct_part, with_faults
from obsynth.conditions.polytope import vertex_inequalities
from obsynth.conditions.problem import Conditions, Values, require_data
from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.faults import Exosystem, exosystem
from obsynth.plants.plant_units import PlantUnits, noise_inputs
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.results.registered import registered
from obsynth.verification.error_polytope import ErrorPolytope
from obsynth.verification.identities import EQUALITY_TOLERANCE

#: How strongly states are driven by default, beside fault models: a plant is better known than how a fault evolves.
PROCESS_SHARE = 0.1
#: Noise on innovations that have none of their own, relative to the outputs' noise.
INNOVATION_NOISE = 0.1


@dataclass(frozen=True, eq=False)
class PiOverRegion:
    """What is constant of the observer, and its error system at each vertex, in units of the plant's own."""

    model: Exosystem
    units: PlantUnits
    decoupled: Decoupled
    U: FloatArray  # (na, na), of the scaled augmented plant
    D: FloatArray  # (na, ny)
    injected: tuple[FloatArray, ...]  # (na, ny) at each vertex: U times what is fed with y where d is seen directly
    errors: ErrorPolytope

    def letters(self, gains: list[FloatArray]) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
        """Return ``U_a``, ``D_a`` and ``K_a`` at each vertex in the plant's units."""
        units = self.units
        states, outputs = units.augmented_states[:, None], units.outputs
        each = gains * (self.errors.count if len(gains) == 1 else 1)
        K = [
            states * (free @ self.decoupled.undisturbed + injected) * outputs / units.rate
            for free, injected in zip(each, self.injected, strict=True)
        ]
        return states * self.U * units.augmented_equations, states * self.D * outputs, K


def pi_over_region(plant: PolytopicSystem, model: Exosystem, *, noise: Mapping[str, Any] | None = None) -> PiOverRegion:
    """Return the constant parts and the error system; the existence conditions must hold.

    ``noise``: deviations and weights as for `obsynth.ui_pi_observer`.
    """
    weights = dict(noise or {})
    widened = with_all_directions(plant)
    units = PlantUnits.of(widened, model).for_decoupling(widened)
    scaled_model = units.scaled_model(model)
    decoupled = decouple(units.scaled_plant(widened))
    names = widened.disturbance_names
    works = [
        units.scaled_plant(
            vertex.replace(
                Bd=np.hstack([vertex.Bd, np.zeros((vertex.nx, widened.nd - vertex.nd))]),
                Dd=widened.Dd,
                disturbance_names=names,
                exact=None,
            )
        )
        for vertex in plant.vertices
    ]
    u, d = with_faults(decoupled.U, decoupled.Dhat, works[0], scaled_model)
    bw, dw = noise_inputs(works[0], units, weights.get("measurement"))
    size = float(np.sqrt(np.mean(np.sum(dw**2, axis=1)))) if dw.any() else 1.0
    order, ny = scaled_model.order, widened.ny
    strength = np.concatenate(
        [
            np.full(widened.nx, PROCESS_SHARE * weights.get("process", 1.0)),
            np.full(order, weights.get("fault", 1.0)),
        ]
    )
    A, B, injected = [], [], []
    for work in works:
        augmented = AugmentedPlant.of(work, scaled_model)
        fed = np.vstack([direct_part(work)[1], np.zeros((order, ny))])
        F = u @ (augmented.A - fed @ augmented.C)
        noise_effect = u @ np.vstack([bw, np.zeros((order, bw.shape[1]))]) - F @ d @ dw - u @ fed @ dw
        A.append(F)
        # Noise that enters the states counts as another than that of the innovations: what is proved is no less true.
        B.append(np.hstack([size * np.diag(strength), noise_effect]))
        injected.append(u @ fed)
    own_c = decoupled.undisturbed @ AugmentedPlant.of(works[0], scaled_model).C
    own_d = decoupled.undisturbed @ (np.eye(ny) - AugmentedPlant.of(works[0], scaled_model).C @ d) @ dw
    m = len(own_c)
    D = np.hstack([np.zeros((m, B[0].shape[1])), own_d, INNOVATION_NOISE * size * np.eye(m)])
    B = [np.hstack([b, np.zeros((len(b), D.shape[1] - b.shape[1]))]) for b in B]
    errors = ErrorPolytope(A, own_c, B=B, D=D, dt=1.0 if units.discrete else 0.0)
    return PiOverRegion(model, units, decoupled, u, d, tuple(injected), errors)


def share_pasand_over_region(plant: PolytopicSystem, *, fault_model: Any, margin: float) -> Conditions:
    """Return the inequalities at every vertex in P and ``Y[1]``, ...; see `obsynth.conditions.sharepasand`."""
    model = exosystem(fault_model, plant.fault_names, plant.dt)
    conditions = pi_conditions_over_region(plant, model)
    require_data(conditions, solvers=())
    parts = pi_over_region(plant, model)
    inequalities = vertex_inequalities(parts.errors, margin=margin)

    def gains(values: Values) -> dict[str, FloatArray]:
        own = inequalities._gains(values)
        free = [own[name] for name in (f"L[{i + 1}]" for i in range(parts.errors.count)) if name in own]
        U_a, D_a, K_a = parts.letters(free)
        return {"U_a": U_a, "D_a": D_a} | {f"K_a[{i + 1}]": K for i, K in enumerate(K_a)}

    def design(own: dict[str, FloatArray], name: str) -> Any:
        return registered("design_of_conditions")("sharepasand over region", plant, fault_model, own, name)

    data = {f"UA[{i + 1}]": A for i, A in enumerate(parts.errors.A)} | {"C_seen": parts.errors.C[0]}
    data |= {"U_a": parts.U, "D_a": parts.D, "Phi": model.Phi, "Cw": model.Cw}
    return replace(
        inequalities,
        source="Share Pasand, Aliyari, Taghirad, (13), (19) at every vertex",
        data=data,
        _examined=lambda: conditions,
        _gains=gains,
        _design=design,
    )


def checked_free_gains(parts: PiOverRegion, K_a: list[FloatArray]) -> list[FloatArray]:
    """Return the free gains of ``K_a`` at each vertex in the plant's units; `SpecError` where they decouple nothing."""
    units, undisturbed = parts.units, parts.decoupled.undisturbed
    gains = []
    for K, injected in zip(K_a, parts.injected, strict=True):
        scaled = K / units.augmented_states[:, None] / units.outputs * units.rate
        free = (scaled - injected) @ undisturbed.T
        miss = float(np.abs(free @ undisturbed + injected - scaled).max())
        if not miss <= EQUALITY_TOLERANCE * (1.0 + float(np.abs(scaled).max())):
            raise SpecError("K_a does not decouple the unknown inputs.", path="K_a")
        gains.append(free)
    return gains
