"""An observer of a DAE in motion: the eleven steps of each sample, in the order that makes (12)-(23) explicit."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.models.dae_functions import DAEFunctions
from obsynth.models.dae_step import ImplicitStep, Sensitivities
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae import DAEObserver
from obsynth.observers.dae_estimates import DAEEstimates, DAERow
from obsynth.observers.records import measured_record

#: A step of backward Euler this much shorter than dt puts a state onto its constraint and moves it no further.
PROJECTION_SHARE = 1e-6
#: Smaller moves, in sizes of the states, are the motion during that step and no projection.
PROJECTION_NOTICE = 1e-5


class RunningDAEObserver:
    """An observer in motion.

    Parameters
    ----------
    observer : DAEObserver
        The observer at rest.
    """

    def __init__(self, observer: DAEObserver) -> None:
        self.observer = observer
        self.functions = DAEFunctions(observer.model, observer.integration)
        self.implicit = ImplicitStep(self.functions, observer.dt, largest_move=observer.largest_move)
        nx, ny, nq = observer.model.nx, observer.model.ny, observer.model.nq
        self.k = 0
        self.joint = observer.form == "augmented-kalman"
        self.x = np.array(observer.initial_state)
        self.posterior = self.x
        self.theta = np.array(observer.initial_parameters)
        self.P = np.array(observer.initial_covariance)
        self.S = np.array(observer.initial_parameter_covariance)
        self.spread = self.S.copy()
        self.cross = np.zeros((nx, nq))
        self.Upsilon = np.zeros((nx, nq))
        self.K = np.zeros((nx, ny))
        self.H, self.L = np.zeros((ny, nx)), np.zeros((ny, nq))
        self.u = np.zeros(observer.model.nu)
        self.informations: deque[FloatArray] = deque(maxlen=observer.window)
        self.local: Sensitivities | None = None

    def step(self, y: ArrayLike, u: ArrayLike = ()) -> DAEEstimates:
        """Take one sample and return the estimates at that sample.

        Parameters
        ----------
        y : array_like
            Outputs ``(ny,)``; NaN marks a missing one.
        u : array_like, optional
            Known inputs ``(nu,)`` during the step that ends at this sample.

        Raises
        ------
        SpecError
            A sample has the wrong length, or an input is not finite; nothing is changed then.
        SolverError
            The step has no solution; k, iteration and worst equation are named.
        """
        model = self.observer.model
        outputs = measured_record(np.atleast_2d(np.asarray(y)), model.ny)[0]
        inputs = np.asarray(u, dtype=np.float64)
        if inputs.shape != (model.nu,) or not np.isfinite(inputs).all():
            raise SpecError(f"u must be {model.nu} finite number(s) at k = {self.k}.", path="u")
        row = self.raw_step(outputs, inputs)
        return DAEEstimates.of(self.observer, [row], informations=list(self.informations))

    def raw_step(self, y: FloatArray, u: FloatArray) -> DAERow:
        """Advance without checking the sample.

        Parameters
        ----------
        y, u : FloatArray
            ``(ny,)`` and ``(nu,)``.
        """
        observer, seen = self.observer, ~np.isnan(y)
        residual, condition, contraction = 0.0, 1.0, 0.0
        moved = np.zeros_like(self.x)
        if self.k == 0:
            moved = self._project(u)
        else:
            residual, condition, contraction = self._predict(u)
        predicted, H, L = self.functions.outputs(self.x, self.theta)
        e = (y - predicted)[seen]
        H, L = H[seen], L[seen]
        Sigma = H @ self.P @ H.T + observer.R[np.ix_(seen, seen)]
        Omega = H @ self.Upsilon + L
        nis = self._nis(e, H, L, Sigma, Omega)
        information = Omega.T @ np.linalg.solve(Sigma, Omega)
        if self.joint:
            self._update_joint(e, H, L, seen)
        else:
            self._update_parameters(e, Sigma, Omega, seen)
            self._correct(y, seen)
        self.u, self.k = u, self.k + 1
        self.informations.append(information)
        innovation = np.full(len(y), np.nan)
        innovation[seen] = e
        return DAERow(
            self.posterior.copy(), self.theta.copy(), self._covariance(), self.spread.copy(), innovation, nis,
            int(seen.sum()), information, residual, condition, contraction, moved,
        )  # fmt: skip

    def _project(self, u: FloatArray) -> FloatArray:
        """Put the initial state onto the algebraic equations; return how far it moved."""
        model, start = self.observer.model, self.x
        short = ImplicitStep(DAEFunctions(model), PROJECTION_SHARE * self.observer.dt)
        found = short.solve(start, u, self.theta).x
        if np.abs((found - start) / model.state_scales).max() <= PROJECTION_NOTICE:
            return np.zeros_like(start)
        self.x = self.posterior = found
        return found - start

    def _predict(self, u: FloatArray) -> tuple[float, float, float]:
        """Steps 1 to 5: from the corrected state to the prediction and its covariance, with K, H and L of k - 1."""
        observer = self.observer
        solution = self.implicit.solve(self.posterior, u, self.theta, before=self.u, k=self.k)
        local = self.implicit.sensitivities(solution, self.posterior, u, self.theta)
        added = local.noise @ observer.Q @ local.noise.T
        kept = np.eye(len(self.x)) - self.K @ self.H
        if self.joint:
            moved = local.F @ self.cross + local.G @ self.spread
            self.P = (
                local.F @ self.P @ local.F.T + local.F @ self.cross @ local.G.T
                + local.G @ self.cross.T @ local.F.T + local.G @ self.spread @ local.G.T + added
            )  # fmt: skip
            self.cross, self.spread = moved, self.spread + observer.random_walk
        else:
            self.P = local.F @ (kept @ self.P @ kept.T + self.K @ observer.R @ self.K.T) @ local.F.T + added
        self.P = 0.5 * (self.P + self.P.T)
        self.Upsilon = local.F @ kept @ self.Upsilon + local.G - local.F @ self.K @ self.L
        self.x, self.local = solution.x, local
        radius = float(np.abs(np.linalg.eigvals(local.F @ kept)).max())
        return solution.residual, local.condition, radius

    def _nis(self, e: FloatArray, H: FloatArray, L: FloatArray, Sigma: FloatArray, Omega: FloatArray) -> float:
        if self.joint:
            cross = H @ self.cross @ L.T
            whole = Sigma + cross + cross.T + L @ self.spread @ L.T
        else:
            whole = Sigma + Omega @ self.spread @ Omega.T
        return float(e @ np.linalg.solve(whole, e))

    def _update_parameters(self, e: FloatArray, Sigma: FloatArray, Omega: FloatArray, seen: FloatArray) -> None:
        """Steps 6 to 9 and 11: (17)-(19) from the innovation before any update; y(0) corrects the state only."""
        observer = self.observer
        if self.k == 0 or not seen.any():
            return
        before = self.theta
        prior = self._remembered()
        weight = observer.R[np.ix_(seen, seen)] if observer.weight == "paper" else Sigma
        gain = np.linalg.solve(weight + Omega @ prior @ Omega.T, Omega @ prior).T
        self.S = prior - gain @ Omega @ prior
        self.S = 0.5 * (self.S + self.S.T)
        kept = np.eye(len(before)) - gain @ Omega
        walked = self.spread + observer.random_walk if observer.form == "random-walk" else self.spread
        self.spread = kept @ walked @ kept.T + gain @ Sigma @ gain.T
        self.theta = np.clip(before + gain @ e, observer.lower, observer.upper)
        self.x = self.x + self.Upsilon @ (self.theta - before)

    def _remembered(self) -> FloatArray:
        """Return S / lambda, or its walk, or what is left of the information beside that of S_0."""
        observer = self.observer
        if observer.form == "random-walk":
            return np.asarray(self.S + observer.random_walk)
        if observer.guard == "none":
            return np.asarray(self.S / observer.forgetting)
        start = np.linalg.inv(observer.initial_parameter_covariance)
        kept = observer.forgetting * np.linalg.inv(self.S) + (1.0 - observer.forgetting) * start
        return np.asarray(np.linalg.inv(kept))

    def _correct(self, y: FloatArray, seen: FloatArray) -> None:
        """Step 10: the gain at the updated estimate, and the state after the measurement."""
        predicted, self.H, self.L = self.functions.outputs(self.x, self.theta)
        H = self.H[seen]
        self.K = np.zeros_like(self.K)
        self.K[:, seen] = np.linalg.solve(H @ self.P @ H.T + self.observer.R[np.ix_(seen, seen)], H @ self.P).T
        self.posterior = self.x + self.K[:, seen] @ (y - predicted)[seen]

    def _update_joint(self, e: FloatArray, H: FloatArray, L: FloatArray, seen: FloatArray) -> None:
        """Update states and parameters together, in Joseph's form; y(0) corrects the state only, as above."""
        observer, nx = self.observer, len(self.x)
        whole = np.block([[self.P, self.cross], [self.cross.T, self.spread]])
        rows, noise = np.hstack([H, L]), observer.R[np.ix_(seen, seen)]
        if self.k == 0:
            gain = np.zeros((len(whole), len(e)))
            gain[:nx] = np.linalg.solve(H @ self.P @ H.T + noise, H @ self.P).T
        else:
            gain = np.linalg.solve(rows @ whole @ rows.T + noise, rows @ whole).T
        kept = np.eye(len(whole)) - gain @ rows
        whole = kept @ whole @ kept.T + gain @ noise @ gain.T
        self.P, self.cross, self.spread = whole[:nx, :nx], whole[:nx, nx:], whole[nx:, nx:]
        theta = self.theta + gain[nx:] @ e
        self.theta = np.clip(theta, observer.lower, observer.upper)
        self.x = self.posterior = self.x + gain[:nx] @ e
        self._state_gain(H, seen, gain[:nx])

    def _state_gain(self, H: FloatArray, seen: FloatArray, gain: FloatArray) -> None:
        """Keep the gain of the state for the regressor and the rate of contraction."""
        _, self.H, self.L = self.functions.outputs(self.x, self.theta)
        self.K = np.zeros_like(self.K)
        self.K[:, seen] = gain

    def _covariance(self) -> FloatArray:
        """Return the covariance of the state after the measurement, with what the parameters add to it."""
        if self.joint:
            return self.P
        kept = np.eye(len(self.x)) - self.K @ self.H
        through = kept @ self.Upsilon - self.K @ self.L
        own = kept @ self.P @ kept.T + self.K @ self.observer.R @ self.K.T
        return np.asarray(own + through @ self.spread @ through.T)
