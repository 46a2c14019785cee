"""Realisations of transfer functions, proper or not.

``G(s) = H(s) + P_1 s + ... + P_q s**q`` with ``H`` proper (polynomial division, entry by entry). ``H`` is realised by
python-control. Each input of the polynomial part has a chain of algebraic equations ``w_0 = u``, ``w_k = w_(k-1)'``,
and ``P_k w_k`` is added to the outputs (Dai 1989, section 2.2: the pencil of a chain is nilpotent).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray


def realised(system: Any, control: Any) -> tuple[Any, dict[str, FloatArray] | None]:
    """Return a system of states of python-control, or, for an improper transfer function, the transfer function itself
    and matrices ``E, A, B, C, D`` of a descriptor system.

    Raises
    ------
    SpecError
        It is improper in discrete time: its output needs inputs of the future.
    """
    polynomials, proper = _divided(system)
    if not polynomials:
        return control.ss(system), None
    if system.dt:
        raise SpecError(
            "The transfer function has more zeros than poles in discrete time: its outputs need inputs of later "
            "samples. Delay its outputs: divide it by z to the power of the difference.",
            path="system",
        )
    numerators, denominators = proper
    rest = control.ss(control.TransferFunction(numerators, denominators))
    return system, _with_chains(rest, polynomials)


def _divided(system: Any) -> tuple[dict[tuple[int, int], FloatArray], tuple[list[list[Any]], list[list[Any]]]]:
    """Return coefficients of ``s, s**2, ...`` by output and input, and the proper rest of each entry."""
    polynomials: dict[tuple[int, int], FloatArray] = {}
    numerators: list[list[Any]] = []
    denominators: list[list[Any]] = []
    for i in range(system.noutputs):
        numerators.append([])
        denominators.append([])
        for j in range(system.ninputs):
            top, bottom = (np.trim_zeros(np.atleast_1d(part[i][j]), "f") for part in (system.num, system.den))
            if len(top) > len(bottom):
                quotient, rest = np.polydiv(top, bottom)
                polynomials[i, j] = quotient[-2::-1]
                top = np.polyadd(quotient[-1] * bottom, rest)
            numerators[-1].append(top if top.size else np.zeros(1))
            denominators[-1].append(bottom)
    return polynomials, (numerators, denominators)


def _with_chains(rest: Any, polynomials: dict[tuple[int, int], FloatArray]) -> dict[str, FloatArray]:
    """Return a descriptor system of a proper part and of derivatives of inputs."""
    n, nu = np.shape(rest.A)[0], rest.ninputs
    orders = [max((len(p) for (_, j), p in polynomials.items() if j == column), default=-1) for column in range(nu)]
    starts = n + np.concatenate([[0], np.cumsum([order + 1 for order in orders])])
    size = int(starts[-1])
    e, a = np.zeros((size, size)), np.eye(size)
    b, c = np.zeros((size, nu)), np.zeros((rest.noutputs, size))
    e[:n, :n], a[:n, :n], b[:n], c[:, :n] = np.eye(n), rest.A, rest.B, rest.C
    for j, order in enumerate(orders):
        start = int(starts[j])
        if order >= 0:
            b[start, j] = -1.0
        for k in range(order):
            e[start + 1 + k, start + k] = 1.0
        for (i, column), coefficients in polynomials.items():
            if column == j:
                c[i, start + 1 : start + 1 + len(coefficients)] = coefficients
    return {"E": e, "A": a, "B": b, "C": c, "D": np.asarray(rest.D, dtype=np.float64)}
