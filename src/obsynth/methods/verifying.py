"""Verification of a design: every claim is recomputed from the plant and the stored observer, without any solver."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.method import Method
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.methods.stored_options import wrong_options
from obsynth.numerics.arguments import arguments_checked, field_types, is_number, is_whole, shown
from obsynth.numerics.libraries import failed_computations, one_thread_if_small
from obsynth.observers.linear.observer import LinearObserver
from obsynth.results.checks import Check, nothing_wrong, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.results.verification_report import VerificationReport
from obsynth.verification.claims import before_the_mean, closed_claims, mean_noise_rows
from obsynth.verification.constant_faults import STEADY_ERROR, constant_fault_row
from obsynth.verification.error_system import error_model_row
from obsynth.verification.over_tolerances.rows import tolerance_rows
from obsynth.verification.plant import condition_rows, derivation_rows, stored_twice_rows
from obsynth.verification.platform import platform_rows
from obsynth.verification.requested_limits import requested_rows
from obsynth.verification.settled_faults import ConstantFaults
from obsynth.verification.stored_numbers import stored_number_rows

#: Methods of this package prove decay by checks of their own, each of which a test breaks.  Methods of other packages
#: get the checks that no method can leave out.
OWN_PACKAGE = "obsynth"


@arguments_checked
def verify(design: ObserverDesign, *, printed_digits: int | None = None) -> VerificationReport:
    """Recompute every claim of a design from its plant and its stored observer.

    Parameters
    ----------
    design : ObserverDesign
        Made by a method, loaded from a file, or put together by hand.
    printed_digits : int, optional
        Decimals to which the gains T, N, L and W were printed, for gains from a paper.  Equalities then have a
        tolerance of what half a unit in the last decimal of every entry changes, to first order.  By default the
        tolerance is that of double precision.

    Returns
    -------
    VerificationReport
        Inequalities are proved with bounds on rounding errors; equalities have a residual and a bound that scales
        with the data.

    Raises
    ------
    SpecError
        The design's method is unknown, or ``printed_digits`` is not between 1 and 15.
    SolverError
        LAPACK fails on the numbers of the design: the result is inconclusive.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> obsynth.verify(design).passed
    True
    """
    if design.method not in REGISTRY:
        raise SpecError(f"Designs of method {design.method!r} cannot be verified by this version.", path="method")
    if printed_digits is not None and not (is_whole(printed_digits) and 1 <= printed_digits <= 15):
        raise SpecError(f"printed_digits is {shown(printed_digits)}: give 1 to 15 decimals.", path="printed_digits")
    method = method_class(design.method)
    # A corrupted design may overflow; what is not a number fails its check, so no warning is needed.
    with np.errstate(all="ignore"), failed_computations(), one_thread_if_small(design.plant.nx):
        shipped, (design, mean_rows) = design, before_the_mean(design) if method.averaged else (design, ())
        rows = (*mean_rows, *_own_rows(method, design, printed_digits))
        own = method.__module__.partition(".")[0] == OWN_PACKAGE
        linear = isinstance(design.observer, LinearObserver)
        if linear and not own:
            rows = (*rows, *_existence_rows(method, design, rows))
            rows = (*rows, *platform_rows(*design.linear, open_loop=method.open_loop))
        # A method of this package may prove bounds of states instead; any other has to state an error model.
        tracked = linear and (not own or method.has_error_model(design))
        if tracked and all(row.passed for row in rows):
            model = method.error_model(design)
            rows = (*rows, error_model_row(model, printed_digits, constants_allowed=method.adds_constants))
            gamma = design.certificate.claims.get("gamma") if "gamma" in method.claims else None
            if model is not None and rows[-1].passed:
                rows = (*rows, *stored_number_rows(design, model, gamma), *derivation_rows(design, model))
                rows = (*rows, *_constant_fault_rows(method, shipped, printed_digits))
        if all(row.passed for row in rows):
            rows = (*rows, *stored_twice_rows(shipped), *_recursive_plant_rows(shipped), *tolerance_rows(shipped))
            if own:
                rows = (*rows, *_option_rows(method, shipped))
        covered = {name: meaning.row for name, meaning in method.claims.items()}
        meanings = {name: meaning.meaning for name, meaning in method.claims.items()}
        rows = rows if shipped is design else (*rows, *mean_noise_rows(shipped))
        return VerificationReport.of((*rows, *closed_claims(design, rows, covered, meanings, method.witnesses)))


def _constant_fault_rows(method: type[Method], shipped: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield the check of the estimates of constant faults, of the shipped observer with its averaging, if any."""
    model = method.error_model(shipped)
    if model is None or not model.fits or not model.observer.fault_names:
        return
    limit = shipped.options.get("steady_error_limit", STEADY_ERROR)
    if not (is_number(limit) and 0.0 < float(limit) < 1.0):
        yield upper_bound_check(
            "options", "steady_error_limit is a number between 0 and 1", 1.0, 0.0, source="options", detail=shown(limit)
        )
        return
    constant_faults = ConstantFaults(model, method.constant_fault_gain(shipped, model))
    row = constant_fault_row(constant_faults, float(limit), printed_digits)
    if row is not None:
        yield row
    elif float(limit) != STEADY_ERROR:
        yield nothing_wrong(
            "options",
            "what is claimed of constant faults is what steady_error_limit is for",
            ["nothing is claimed of constant faults here: leave steady_error_limit out"],
            source="options",
        )


def _recursive_plant_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the rows on the plant as written of a recursive design; its analysis is imported for such a design only."""
    if isinstance(design.observer, LinearObserver):
        return
    from obsynth.verification.recursive_plant import recursive_plant_rows

    yield from recursive_plant_rows(design)


def _existence_rows(method: type[Method], design: ObserverDesign, known: tuple[Check, ...]) -> Iterator[Check]:
    """Yield the method's conditions of existence, decided again on the plant, without those that are in ``known``."""
    try:
        options = {name: design.options[name] for name in field_types(method) if name in design.options}
        conditions = method.of(options).existence(design.plant)
    except (SpecError, TypeError) as error:
        yield upper_bound_check(
            "options", "the options are those of the method", 1.0, 0.0, source="options", detail=str(error)
        )
        return
    names = {row.name for row in known}
    yield from (row for row in condition_rows(conditions) if row.name not in names)


def _option_rows(method: type[Method], design: ObserverDesign) -> Iterator[Check]:
    """Yield the checks of the stored options: the method takes them, and the design keeps their limits."""
    wrong = [*wrong_options(method, design)]
    if wrong:
        yield nothing_wrong("options", "the options are those of the method", wrong, source="options")
        return
    yield from requested_rows(design, method.requested_limits(design), method.placed, method.fixed_modes)


def _own_rows(method: type[Method], design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield the method's own checks; a failing one where a changed file makes them impossible to compute."""
    try:
        yield from method.checks(design, printed_digits)
    except np.linalg.LinAlgError:
        raise
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        yield upper_bound_check(
            "readable",
            "options, gains and certificate are of the kinds that the method writes",
            1.0,
            0.0,
            source="options and certificate",
            detail=f"{type(error).__name__}: {error}",
        )
