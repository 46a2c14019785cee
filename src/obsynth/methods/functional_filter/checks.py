"""The error system of a functional filter: faults that follow their models, deviations by noise and by walks.

Checks of a functional filter, from the plant, the shipped realisation and T, T0 alone; gains without T and T0.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import flint
import numpy as np

from obsynth.analysis.plant_units import PlantUnits
from obsynth.methods.functional_filter.conditions import conditions, residual_sets
from obsynth.methods.ui_pi_observer.augmented_plant import shipped_model
from obsynth.methods.ui_pi_observer.checks import decoupling_norms
from obsynth.numerics.arguments import FloatArray, reachable
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import arb_matrix
from obsynth.proofs.products import EXPONENTIAL_BITS, as_ball, certain_noise_covariance
from obsynth.results.checks import Check, fitting_check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import (
    Identity,
    decay_row,
    equality,
    listed_gains,
    relative_tolerance,
    stability_row,
)
from obsynth.verification.error_system import ErrorModel, natural_scaling
from obsynth.verification.plant import condition_rows, plant_information

#: Regulator equations of more unknowns are solved in double precision.
MOST_RATIONAL_UNKNOWNS = 100


def tracking_map(
    plant: DescriptorSystem, observer: LinearObserver, t: FloatArray, phi: FloatArray, cw: FloatArray
) -> FloatArray:
    """Return Pi ``(nz, nw)``: where eps goes when every fault follows its model, ``Az Pi + b Cw = Pi Phi``."""
    from scipy.linalg import solve_sylvester

    entering = (observer.By @ plant.Df - t @ plant.Bf) @ cw
    if not entering.size:
        return np.zeros(entering.shape)
    exact = _with_digits_to_spare(observer.Az, phi, entering) if entering.size <= MOST_RATIONAL_UNKNOWNS else None
    return np.asarray(solve_sylvester(observer.Az, -phi, -entering)) if exact is None else exact


def _with_digits_to_spare(a: FloatArray, phi: FloatArray, entering: FloatArray) -> FloatArray | None:
    """Return Pi to its last digit, however near a slow pole is to the fault model; ``None`` where it has one."""
    order, count = entering.shape
    whole, right = np.kron(a, np.eye(count)), np.kron(np.eye(order), phi.T)
    with flint.ctx.workprec(EXPONENTIAL_BITS):
        own, model, known = (arb_matrix(np.asarray(part)) for part in (whole, right, entering.reshape(-1, 1)))
        try:
            found = (model - own).solve(known)
        except ZeroDivisionError:
            return None
    return as_ball(found).midpoint.reshape(order, count)


def wanted_faults(
    plant: DescriptorSystem, observer: LinearObserver, matrices: Mapping[str, FloatArray], *, mean: int
) -> FloatArray:
    """Return what rows should make of the models' states ``(rows, nw)``: the fault with the claimed delay, or
    nothing."""
    phi, cw = matrices["Phi"], matrices["Cw"]
    rows = np.zeros((len(observer.Cz), len(phi)))
    for row, (name, delay) in enumerate(zip(observer.fault_names, observer.fault_delays, strict=True)):
        first = delay - (mean - 1) // 2
        back = np.linalg.inv(phi) if delay or mean > 1 else np.eye(len(phi))
        powers = [np.linalg.matrix_power(back, first + j) for j in range(mean)]
        rows[row] = cw[plant.fault_names.index(name)] @ (sum(powers[1:], start=powers[0]) / mean)
    return rows


def estimate_deviations(
    plant: DescriptorSystem, observer: LinearObserver, matrices: Mapping[str, FloatArray]
) -> FloatArray:
    """Return deviations ``(faults, 2)`` of fhat under noise and of ``fhat - f`` with walks; dt = 0: per sqrt(s)."""
    errors = ErrorModel(plant, observer, matrices["T"], -matrices["T0"])
    rows = observer.fault_rows
    discrete = float(plant.dt > 0.0)
    noise = certain_noise_covariance(
        errors.Az, -errors.noise, observer.Cz[rows], discrete * errors.fault_output[3], plant.dt
    )
    walk = _walk_covariance(plant, observer, matrices, errors)
    alone = np.maximum(np.diag(noise), 0.0)
    return np.asarray(np.sqrt(np.column_stack([alone, alone + np.maximum(np.diag(walk), 0.0)])))


def _walk_covariance(
    plant: DescriptorSystem, observer: LinearObserver, matrices: Mapping[str, FloatArray], errors: ErrorModel
) -> FloatArray:
    """Return the covariance of ``fhat(k) - f(k - delay)`` that the walks of the fault models cause."""
    phi, cw, drive, pi = (matrices[name] for name in ("Phi", "Cw", "walks", "tracking"))
    rows, count = observer.fault_rows, len(phi)
    # In coordinates around the motion that follows the models, only what drives them is left.
    lag = max((0, *observer.fault_delays))
    order = observer.order
    a = np.zeros((order + lag * count, order + lag * count))
    b = np.zeros((len(a), drive.shape[1]))
    c = np.zeros((len(observer.fault_names), len(a)))
    a[:order, :order], b[:order] = observer.Az, -pi @ drive
    for j in range(lag):
        place = slice(order + j * count, order + (j + 1) * count)
        if j == 0:
            b[place] = drive
        else:
            a[place, order + (j - 1) * count : order + j * count] = np.eye(count)
    c[:, :order] = observer.Cz[rows]
    for row, (name, delay) in enumerate(zip(observer.fault_names, observer.fault_delays, strict=True)):
        # w(k) = Phi^delay w(k - delay) + the steps since; the estimate is of the oldest of them.
        for j in range(delay):
            back = np.linalg.matrix_power(np.linalg.inv(phi), delay - j)
            c[row, order + j * count : order + (j + 1) * count] = cw[plant.fault_names.index(name)] @ back
    return certain_noise_covariance(a, b, c, np.zeros((len(c), drive.shape[1])), plant.dt)


#: Estimates at a frequency may miss by this much, relative to terms that pass through the inverse of ``sI - Az``.
DECOUPLING_LEVEL = 1e-7


def decoupling_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the measured gains: of d to everything, of other faults into each estimate or set of residuals."""
    plant, observer = design.linear
    groups = [("unknown inputs", list(range(len(observer.Cz))), list[str]())] if plant.nd else []
    groups += [(f"free of others: {name}", rows, blind) for name, rows, blind in _blind_to(design) if blind]
    if not groups:
        return
    every = plant.replace(
        Bd=np.hstack([plant.Bd, plant.Bf]),
        Dd=np.hstack([plant.Dd, plant.Df]),
        disturbance_names=[*plant.disturbance_names, *(f"fault {fault}" for fault in plant.fault_names)],
    )
    known = range(plant.nd)
    inputs = [[*known, *(plant.nd + plant.fault_names.index(fault) for fault in blind)] for _, _, blind in groups]
    norms = decoupling_norms(every, observer, [(rows, of) for (_, rows, _), of in zip(groups, inputs, strict=True)])
    for (name, _, blind), found in zip(groups, norms, strict=True):
        claim = f"neither unknown inputs nor {', '.join(blind)} reach it, whatever their time course"
        yield upper_bound_check(
            name,
            claim if blind else "the unknown inputs reach neither estimates nor residuals",
            found.relative,
            DECOUPLING_LEVEL,
            source="computed from the transfer functions of plant and filter, without T and T0",
            detail=f"relative to the terms; worst at {found.frequency:.3g} rad/s",
        )


def _blind_to(design: ObserverDesign) -> Iterator[tuple[str, list[int], list[str]]]:
    """Yield, for groups of rows, their name, the rows and the faults that must not reach them."""
    plant, observer = design.linear
    options = design.options
    if options.get("residuals") is None:
        others = [name for name in plant.fault_names if name not in observer.fault_names]
        for row, name in enumerate(observer.fault_names):
            beside = [] if options.get("joint") else [other for other in observer.fault_names if other != name]
            yield name, [row], [*others, *beside]
        return
    sets = residual_sets(options["residuals"], plant) or []
    for seen in ([plant.fault_names[i] for i in indices] for indices in sets):
        label = f"{' '.join(seen)}: "
        rows = [row for row, name in enumerate(observer.residual_names) if len(sets) == 1 or name.startswith(label)]
        yield label.rstrip(": "), rows, [name for name in plant.fault_names if name not in seen]


#: The regulator equation may miss by this much, relative to its terms: its solution is no part of the gains.
TRACKING_TOLERANCE = 1e-8
#: Claimed deviations may be missed by this share: two ways through a Lyapunov equation.
DEVIATION_TOLERANCE = 1e-4


def noise_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield, for each estimate, the deviation that noise causes, and that of its error with the stated walk."""
    (plant, observer), matrices = design.linear, design.certificate.matrices
    if not plant.nw or not observer.fault_names:
        return
    found = estimate_deviations(plant, observer, matrices)
    unit = "" if plant.dt > 0.0 else " (for a sample time of 1 s, times its root for others)"
    for name, (alone, total), (claimed, claimed_total) in zip(
        observer.fault_names, found, matrices["deviations"], strict=True
    ):
        if np.isnan(alone) or np.isnan(claimed):
            yield information(
                f"noise in fhat[{name}]",
                "standard deviation under the stated noise",
                alone,
                source="recomputed, Lyapunov equation",
                detail="all digits are rounding errors" + (": no deviation is claimed" if np.isnan(claimed) else ""),
            )
            continue
        yield upper_bound_check(
            f"noise in fhat[{name}]",
            f"standard deviation under the stated noise is at most the claimed one{unit}",
            float(alone),
            float(claimed) * (1.0 + DEVIATION_TOLERANCE),
            source="recomputed, Lyapunov equation",
        )
        if np.isfinite(total) and matrices["walks"].any():
            yield upper_bound_check(
                f"error of fhat[{name}]",
                f"standard deviation of the error with the random walk of the fault{unit}",
                float(total),
                float(claimed_total) * (1.0 + DEVIATION_TOLERANCE),
                source="recomputed, Lyapunov equation",
            )


_FUNCTIONAL_MATRICES = ("T", "T0", "Phi", "Cw", "walks", "stability", "tracking", "deviations")
_SOURCE = "identities of the error z - T E x, ours"


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.methods.verifying.verify`."""
    (plant, observer), matrices = design.linear, design.certificate.matrices
    yield from plant_information(plant)
    fitting = _fits(design)
    yield fitting_check("observer, certificate and plant have matching signals and shapes", fits=fitting)
    if not fitting:
        return
    options = design.options
    yield from condition_rows(
        conditions(
            plant,
            fault_model=shipped_model(matrices, plant.nf),
            faults=options.get("faults"),
            residuals=options.get("residuals"),
        )
    )
    tolerance = relative_tolerance(printed_digits, plant.nx + plant.ny + observer.order)
    for name, claim, identity in _identities(plant, observer, matrices["T"], matrices["T0"]):
        yield equality(name, claim, identity.residual(), _SOURCE, bound=tolerance)
    yield listed_gains(design, {name: matrices[name] for name in ("T", "T0")})
    yield stability_row(observer.Az, matrices["stability"], plant.dt, "Lyapunov")
    claims = design.certificate.claims
    order = claims.get("order", float("nan"))
    yield upper_bound_check(
        "order",
        "the filter has as many states as claimed: difference",
        abs(observer.order - order),
        0.0,
        source="shipped realisation",
        kind="equality",
        detail=f"{observer.order} states",
    )
    if "decay" in claims:
        yield decay_row(observer, claims["decay"])
    for name, claim, identity in _tracking(plant, observer, design):
        yield equality(
            name, claim, identity.residual(), "regulator equation, ours", bound=max(tolerance, TRACKING_TOLERANCE)
        )
    yield from decoupling_rows(design)
    yield from noise_rows(design)


def _fits(design: ObserverDesign) -> bool:
    (plant, observer), matrices = design.linear, design.certificate.matrices
    if any(name not in matrices for name in _FUNCTIONAL_MATRICES):
        return False
    # A deviation of which all digits are rounding errors is claimed as NaN: not at all.
    if not all(np.all(np.isfinite(matrices[name])) for name in _FUNCTIONAL_MATRICES if name != "deviations"):
        return False
    order, count = observer.order, len(matrices["Phi"])
    shapes = {
        "T": (order, plant.nx),
        "T0": (len(observer.Cz), plant.nx),
        "Phi": (count, count),
        "Cw": (plant.nf, count),
        "walks": (count, count),
        "stability": (order, order),
        "tracking": (order, count),
        "deviations": (len(observer.fault_names), 2),
    }
    finite = all(np.all(np.isfinite(part)) for part in (observer.Az, observer.Bu, observer.By, observer.Cz))
    return bool(
        all(matrices[name].shape == shape for name, shape in shapes.items())
        and finite
        and observer.input_names == plant.input_names
        and observer.output_names == plant.output_names
        and observer.state_names == ()
        and set(observer.fault_names) <= set(plant.fault_names)
        and (observer.fault_names or observer.residual_names)
        and observer.dt == plant.dt
        and list(observer.fault_names) == list(design.options.get("faults") or [])
        and all(delay == _delay(design) for delay in observer.fault_delays)
    )


def _delay(design: ObserverDesign) -> int:
    return int(design.options.get("delay", 0)) + (int(design.options.get("mean", 1)) - 1) // 2


def _identities(
    plant: DescriptorSystem, observer: LinearObserver, t: FloatArray, t0: FloatArray
) -> Iterator[tuple[str, str, Identity]]:
    """Yield the identities that leave neither x, nor u, nor d in the error: name, claim, terms."""
    az, bu, by, cz, du, dy = observer.Az, observer.Bu, observer.By, observer.Cz, observer.Du, observer.Dy
    scaling = natural_scaling(plant)
    units = scaling.states
    # What cancels down to rounding is judged by the terms that it was formed of.
    size_t, size_t0 = (_in_equations(matrix, scaling.equations) for matrix in (t, t0))
    yield (
        "state in the error",
        "Az T E + By C = T A",
        Identity(
            (az @ (t @ plant.E), by @ plant.C, -t @ plant.A),
            ((az, t, plant.E), (by, plant.C), (size_t, plant.A), (az, t, plant.A)),
            units,
        ),
    )
    yield (
        "inputs in the error",
        "Bu + By D = T B",
        Identity((bu, by @ plant.D, -t @ plant.B), ((by, plant.D), (size_t, plant.B))),
    )
    yield (
        "unknown inputs in the error",
        "By Dd = T Bd",
        Identity((by @ plant.Dd, -t @ plant.Bd), ((by, plant.Dd), (size_t, plant.Bd))),
    )
    yield "algebraic rows", "T0 E = 0", Identity((t0 @ plant.E,), ((size_t0, plant.E), (size_t0, plant.A)), units)
    yield (
        "state in the estimates",
        "Cz T E + Dy C = T0 A",
        Identity(
            (cz @ (t @ plant.E), dy @ plant.C, -t0 @ plant.A),
            ((cz, t, plant.E), (dy, plant.C), (size_t0, plant.A), (cz, t, plant.A)),
            units,
        ),
    )
    yield (
        "inputs in the estimates",
        "Du + Dy D = T0 B",
        Identity((du, dy @ plant.D, -t0 @ plant.B), ((dy, plant.D), (size_t0, plant.B))),
    )
    yield (
        "unknown inputs in the estimates",
        "Dy Dd = T0 Bd",
        Identity((dy @ plant.Dd, -t0 @ plant.Bd), ((dy, plant.Dd), (size_t0, plant.Bd), (cz, t, plant.Bd))),
    )


def _in_equations(matrix: FloatArray, equations: FloatArray) -> FloatArray:
    """Return the largest entry of each row, in the units of each equation: what a row is made of."""
    sizes = np.max(np.abs(matrix) / equations, axis=1, initial=0.0)
    return np.asarray(np.outer(sizes, equations))


def _tracking(
    plant: DescriptorSystem, observer: LinearObserver, design: ObserverDesign
) -> Iterator[tuple[str, str, Identity]]:
    """Yield what the estimates make of faults that follow their models: each its own, and no other."""
    matrices = design.certificate.matrices
    pi, phi, cw = matrices["tracking"], matrices["Phi"], matrices["Cw"]
    entering = observer.By @ plant.Df - matrices["T"] @ plant.Bf
    direct = observer.Dy @ plant.Df - matrices["T0"] @ plant.Bf
    # The filter's states are of like size: an entry that is nothing but rounding is judged beside them.
    largest = np.full_like(pi, np.max(np.abs(pi), initial=0.0))
    yield (
        "motion with the fault model",
        "Az Pi + (By Df - T Bf) Cw = Pi Phi",
        Identity((observer.Az @ pi, entering @ cw, -pi @ phi), ((observer.Az, largest), (largest, phi))),
    )
    if not observer.fault_names:
        return
    wanted = wanted_faults(plant, observer, matrices, mean=int(design.options.get("mean", 1)))[observer.fault_rows]
    rows, units = observer.fault_rows, _model_units(plant, phi, cw)
    # How large each state is that the faults move, in the natural unit of each of these.
    moved = np.max(np.abs(pi) * units, axis=1, initial=0.0, keepdims=True) / units
    yield (
        "fault models",
        "the gain of each estimate for its own fault model is one, for all others zero",
        Identity(
            (observer.Cz[rows] @ pi, direct[rows] @ cw, -wanted),
            ((observer.Cz[rows], moved), (np.abs(direct[rows]), cw)),
            units,
        ),
    )


def _model_units(plant: DescriptorSystem, phi: FloatArray, cw: FloatArray) -> FloatArray:
    """Return natural units of the states of the fault models ``(nw,)``: those of the faults that they make."""
    made = (cw != 0.0).astype(np.float64) @ reachable(phi) > 0.0
    found = np.max(np.where(made, PlantUnits.of(plant).rounded().faults[:, None], 0.0), axis=0, initial=0.0)
    return np.where(found > 0.0, found, 1.0)
