"""The eleven steps of a DAE observer at each sample, as one CasADi graph that Python, C and checks share.

In this order (12)-(23) are explicit: the prediction and its covariance with K, H and L of k - 1; the innovation before
any update; the parameters; the state that follows from them; then H, L and K at the new estimate.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.graph_equations import definite_solved
from obsynth.observers.nonlinear.layouts import Layout, memory_layout, row_layout
from obsynth.observers.nonlinear.settings import DAESettings
from obsynth.plants.dae_functions import DAEFunctions
from obsynth.plants.implicit_step import StepGraph, input_effect, step_graph

Arrays = dict[str, Any]


@dataclass(frozen=True, eq=False)
class ObserverGraph:
    """The CasADi functions of an observer.

    Parameters
    ----------
    settings : DAESettings
        The observer's fields.
    memory, row : Layout
        The arrays that are carried to the next sample, and the further results of a sample.
    functions : DAEFunctions
        The model with its method of integration.
    step : StepGraph
        The implicit step of the model.
    first : casadi.Function
        The sample k = 0: ``(memory, y, seen)`` to memory and row, where ``seen`` is 1 for each received output.
    sample : casadi.Function
        A later sample after a solved step: ``(memory, stages, u, y, seen, missing)`` to memory and row, where
        ``missing`` is the covariance of `unknown`.
    whole : casadi.Function
        The implicit step and `sample` in one: ``(memory, [u; y; seen])`` to memory and row.
    """

    settings: DAESettings
    memory: Layout
    row: Layout
    functions: DAEFunctions
    step: StepGraph
    first: Any
    sample: Any
    whole: Any
    _repeated: dict[int, Any] = field(default_factory=dict, repr=False)

    @cached_property
    def unknown(self) -> Any:
        """Function of memory, stages, inputs and their variances: the covariance of the state by missing inputs.

        `None` for a model without inputs.
        """
        if not self.settings.model.nu:
            return None
        effect = input_effect(self.functions, self.settings.dt)
        packed, variances = ca.MX.sym("memory", self.memory.size), ca.MX.sym("variances", self.settings.model.nu)
        X, u = effect.mx_in(0), effect.mx_in(2)
        before = self.memory.symbols(packed)
        moved = effect(X, before["posterior"], u, before["theta"])
        return ca.Function("unknown", [packed, X, u, variances], [moved @ ca.diag(variances) @ moved.T])

    @cached_property
    def forecast(self) -> Any:
        """Function of memory and row of a sample without measurements: mean and covariance of its outputs."""
        packed, result = ca.MX.sym("memory", self.memory.size), ca.MX.sym("row", self.row.size)
        arrays = {**self.memory.symbols(packed), **self.row.symbols(result)}
        spread = arrays["spread"]
        y, H, L = self.functions.output_function(arrays["posterior"], arrays["theta"])
        cross = arrays["cross"] if self.settings.form == "augmented-kalman" else arrays["Upsilon"] @ spread
        through_both = H @ cross @ L.T
        covariance = (
            H @ arrays["covariance"] @ H.T + through_both + through_both.T + L @ spread @ L.T + ca.DM(self.settings.R)
        )
        return ca.Function("forecast", [packed, result], [ca.densify(y), ca.densify(covariance)])

    def over(self, samples: int) -> Any:
        """Return `whole` over several samples: a function of memory and columns ``[u; y; seen]``, one a sample."""
        if samples not in self._repeated:
            self._repeated[samples] = self.whole.mapaccum(samples)
        return self._repeated[samples]


def observer_graph(observer: DAESettings) -> ObserverGraph:
    """Return the CasADi functions of an observer."""
    functions = DAEFunctions(observer.model, observer.integration)
    step = step_graph(functions, observer.dt, np.inf if observer.largest_move is None else observer.largest_move)
    memory, row = memory_layout(observer), row_layout(observer)
    nx, nu, ny = observer.model.nx, observer.model.nu, observer.model.ny
    packed, X = ca.MX.sym("memory", memory.size), ca.MX.sym("stages", nx * functions.stages)
    u, y, seen = ca.MX.sym("u", nu), ca.MX.sym("y", ny), ca.MX.sym("seen", ny)
    missing = ca.MX.sym("missing", nx, nx)
    empty_row = {name: ca.MX(*shape) for name, shape in row.shapes.items()}
    start = {**empty_row, **memory.symbols(packed)}
    first = ca.Function(
        "first", [packed, y, seen], _outcome(_Update(observer, functions, y, seen).first(start), memory, row)
    )
    before = memory.symbols(packed)
    local = step.sensitivities(X, before["posterior"], u, before["theta"])
    predicted = _predicted(observer, before, X[-nx:], local, missing)
    updated = {**empty_row, **_Update(observer, functions, y, seen).later(predicted)}
    sample = ca.Function("sample", [packed, X, u, y, seen, missing], _outcome(updated, memory, row))
    if step.small:
        first, sample = first.expand(), sample.expand()
    arriving = ca.MX.sym("arriving", nu + 2 * ny)
    u, y, seen = arriving[:nu], arriving[nu : nu + ny], arriving[nu + ny :]
    before = memory.symbols(packed)
    stages, residual, trusted = step.step(before["posterior"], u, before["theta"])
    after, result = sample(packed, stages, u, y, seen, ca.DM.zeros(nx, nx))
    # The last two entries of a row are the residual of the step and whether it is trusted.
    result = ca.vertcat(result[: row.size - 2], residual, trusted)
    whole = ca.Function("whole", [packed, arriving], [after, result])
    return ObserverGraph(observer, memory, row, functions, step, first, sample, whole)


def _outcome(arrays: Arrays, memory: Layout, row: Layout) -> list[Any]:
    """Return the vectors of memory and row."""
    return [memory.column(arrays), row.column(arrays)]


def _predicted(observer: DAESettings, before: Arrays, x: Any, local: tuple[Any, ...], missing: Any) -> Arrays:
    """Steps 1 to 5: the prediction and its covariance, with K, H and L of k - 1; ``missing``: covariance by inputs."""
    F, G, noise, scaled = local
    P, K, H, L, spread = (before[name] for name in ("P", "K", "H", "L", "spread"))
    added = noise @ ca.DM(observer.Q) @ noise.T + missing
    error_map = ca.DM.eye(observer.model.nx) - K @ H
    after = {**before, "x": x, "F": F, "G": G, "noise": noise, "missing": missing, "kept": F @ error_map,
             "scaled": scaled}  # fmt: skip
    carried = F @ (error_map @ before["Upsilon"] - K @ L)
    if observer.form != "forgetting":
        # The step to a sample uses the parameters of that sample, so the random walk comes before the prediction.
        after["spread"] = walked = spread + ca.DM(observer.random_walk)
    if observer.form == "augmented-kalman":
        through = F @ before["cross"] @ G.T
        P = F @ P @ F.T + through + through.T + G @ walked @ G.T + added
        after["cross"] = F @ before["cross"] + G @ walked
    else:
        P = F @ (error_map @ P @ error_map.T + K @ ca.DM(observer.R) @ K.T) @ F.T + added
    if observer.form == "random-walk" and observer.random_walk.any():
        # The state depends on the parameters before their walk.  A share of this dependence is one on the parameters
        # after it, and the rest is noise of the state alone, so that both stay uncorrelated (Hsieh and Chen 1999).
        kept_share = definite_solved(walked, spread).T
        remaining_spread = spread - kept_share @ spread
        P, carried = P + carried @ (0.5 * (remaining_spread + remaining_spread.T)) @ carried.T, carried @ kept_share
        after["S"] = before["S"] + ca.DM(observer.random_walk)
    after["P"] = 0.5 * (P + P.T)
    after["Upsilon"] = carried + G
    return after


class _Update:
    """The measurement update of one sample; a missing output has an innovation of zero and no gain."""

    def __init__(self, observer: DAESettings, functions: DAEFunctions, y: Any, seen: Any) -> None:
        self.observer, self.functions, self.y, self.seen = observer, functions, y, seen
        # Rows and columns of R for missing outputs become those of the identity, so that R stays invertible.
        self.R = ca.DM(observer.R) * (seen @ seen.T) + ca.diag(1.0 - seen)

    def first(self, predicted: Arrays) -> Arrays:
        """Return the update at k = 0, of the state only: y(0) has no information on the parameters yet."""
        innovation = self._innovation(predicted)
        return self._joint(innovation, learns=False) if self._is_joint else self._state_update(innovation)

    def later(self, predicted: Arrays) -> Arrays:
        """Return the update of parameters and state."""
        innovation = self._innovation(predicted)
        if self._is_joint:
            return self._joint(innovation, learns=True)
        return self._state_update(self._parameter_update(innovation))

    @property
    def _is_joint(self) -> bool:
        return self.observer.form == "augmented-kalman"

    def _received_outputs(self, arrays: Arrays) -> tuple[Any, Any, Any, Any, Any]:
        """Return H and L, then innovation, H and L with zeros for the missing outputs."""
        predicted, H, L = self.functions.output_function(arrays["x"], arrays["theta"])
        mask = ca.diag(self.seen)
        return H, L, self.seen * (self.y - predicted), mask @ H, mask @ L

    def _innovation(self, arrays: Arrays) -> Arrays:
        """Step 6: the innovation, its covariance and normalised square, and its information on the parameters."""
        _, _, e, H, L = self._received_outputs(arrays)
        Sigma = H @ arrays["P"] @ H.T + self.R
        Omega = H @ arrays["Upsilon"] + L
        if self._is_joint:
            through = H @ arrays["cross"] @ L.T
            covariance = Sigma + through + through.T + L @ arrays["spread"] @ L.T
        else:
            covariance = Sigma + Omega @ arrays["spread"] @ Omega.T
        return {
            **arrays,
            "innovation": e,
            "expected": covariance,
            "nis": e.T @ definite_solved(covariance, e),
            "Sigma": Sigma,
            "Omega": Omega,
            "information": Omega.T @ definite_solved(Sigma, Omega),
            "score": Omega.T @ definite_solved(Sigma, e + Omega @ arrays["theta"]),
            "seen H": H,
            "seen L": L,
        }

    def _parameter_update(self, arrays: Arrays) -> Arrays:
        """Steps 7 to 9 and 11: (17)-(19); a sample without any measurement changes nothing."""
        observer, Sigma, Omega = self.observer, arrays["Sigma"], arrays["Omega"]
        prior, spread = self._prior(arrays["S"]), arrays["spread"]
        weight = self.R if observer.weight == "paper" else Sigma
        gain = definite_solved(weight + Omega @ prior @ Omega.T, Omega @ prior).T
        S = prior - gain @ Omega @ prior
        error_map = ca.DM.eye(observer.model.nq) - gain @ Omega
        theta = self._bounded(arrays["theta"] + gain @ arrays["innovation"])
        spread = error_map @ spread @ error_map.T + gain @ Sigma @ gain.T
        after = {
            "S": 0.5 * (S + S.T),
            "spread": 0.5 * (spread + spread.T),
            "theta": theta,
            "x": arrays["x"] + arrays["Upsilon"] @ (theta - arrays["theta"]),
        }
        anything = ca.sum1(self.seen) > 0.0
        return {**arrays, **{name: ca.if_else(anything, value, arrays[name]) for name, value in after.items()}}

    def _prior(self, S: Any) -> Any:
        """Return S before the measurement: S / lambda, or S itself where the prediction has added the random walk.

        With the guard, forgetting replaces lost information by a share of the initial one, so that S stays bounded.
        """
        observer = self.observer
        if observer.form == "random-walk":
            return S
        if observer.guard == "none" or observer.forgetting == 1.0:
            return S / observer.forgetting
        identity = ca.MX(ca.DM.eye(observer.model.nq))
        start = np.linalg.inv(observer.initial_parameter_covariance) if observer.model.nq else np.zeros((0, 0))
        information = observer.forgetting * definite_solved(S, identity) + (1.0 - observer.forgetting) * ca.DM(start)
        prior = definite_solved(information, identity)
        return 0.5 * (prior + prior.T)

    def _bounded(self, theta: Any) -> Any:
        entries = ca.vertsplit(theta) if theta.shape[0] else []
        for i, (low, high) in enumerate(zip(self.observer.lower, self.observer.upper, strict=True)):
            entries[i] = ca.fmax(entries[i], low) if np.isfinite(low) else entries[i]
            entries[i] = ca.fmin(entries[i], high) if np.isfinite(high) else entries[i]
        return ca.vertcat(*entries) if entries else theta

    def _state_update(self, arrays: Arrays) -> Arrays:
        """Step 10: the gain at the updated estimate, the state after the measurement, and its covariance."""
        full_H, full_L, e, H, _ = self._received_outputs(arrays)
        P = arrays["P"]
        K = definite_solved(H @ P @ H.T + self.R, H @ P).T @ ca.diag(self.seen)
        error_map = ca.DM.eye(self.observer.model.nx) - K @ full_H
        through = error_map @ arrays["Upsilon"] - K @ full_L
        own = error_map @ P @ error_map.T + K @ ca.DM(self.observer.R) @ K.T
        covariance = own + through @ arrays["spread"] @ through.T
        return {**arrays, "H": full_H, "L": full_L, "K": K, "posterior": arrays["x"] + K @ e, "covariance": covariance}

    def _joint(self, arrays: Arrays, *, learns: bool) -> Arrays:
        """Update states and parameters together, in Joseph's form."""
        nx, nq = self.observer.model.nx, self.observer.model.nq
        P, cross, spread, H, L = (arrays[name] for name in ("P", "cross", "spread", "seen H", "seen L"))
        joint = ca.vertcat(ca.horzcat(P, cross), ca.horzcat(cross.T, spread))
        rows, mask = ca.horzcat(H, L), ca.diag(self.seen)
        if learns:
            gain = definite_solved(rows @ joint @ rows.T + self.R, rows @ joint).T @ mask
        else:
            gain = ca.vertcat(definite_solved(H @ P @ H.T + self.R, H @ P).T @ mask, ca.DM.zeros(nq, mask.shape[0]))
        error_map = ca.DM.eye(nx + nq) - gain @ rows
        joint = error_map @ joint @ error_map.T + gain @ self.R @ gain.T
        joint = 0.5 * (joint + joint.T)
        correction = gain @ arrays["innovation"]
        after = {
            **arrays,
            "P": joint[:nx, :nx],
            "cross": joint[:nx, nx:],
            "spread": joint[nx:, nx:],
            "x": arrays["x"] + correction[:nx],
            "theta": self._bounded(arrays["theta"] + correction[nx:]),
            "K": gain[:nx, :],
            "covariance": joint[:nx, :nx],
        }
        full_H, full_L, *_ = self._received_outputs(after)
        return {**after, "H": full_H, "L": full_L, "posterior": after["x"]}
