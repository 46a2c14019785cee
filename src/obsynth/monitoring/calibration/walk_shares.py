"""How far parameters walk on a log: a design states how far they may, and rows without faults need not use it.

An innovation's expected covariance holds the stated walk.  Where parameters stay, that is more than the innovations
show, and the gain that belongs to it colours them: both are no fault of Q or R, so that rows are judged with as much of
the walk as their likelihood asks for, at most all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.recursive.observer import RecursiveObserver

#: Shares of a stated variance that are tried, from all of it: a factor of four apart, so that the right one is missed
#: by at most two; and none.
VARIANCE_SHARES = (*(0.25**i for i in range(8)), 0.0)


def stated_walk(observer: object) -> FloatArray:
    """Return the covariance of one step of the parameters ``(nq, nq)``; without entries where they do not walk."""
    if isinstance(observer, DAEObserver) and observer.form != "forgetting":
        return observer.random_walk
    if isinstance(observer, RecursiveObserver) and observer.adaptation is not None:
        return observer.adaptation.walk if observer.adaptation.form == "random-walk" else np.zeros((0, 0))
    return np.zeros((0, 0))


def with_walk(observer: DAEObserver | RecursiveObserver, walk: FloatArray) -> DAEObserver | RecursiveObserver:
    """Return the observer with another covariance of one step of the parameters ``(nq, nq)``."""
    if isinstance(observer, DAEObserver):
        return replace(observer, random_walk=walk)
    return observer if observer.adaptation is None else replace(
        observer, adaptation=replace(observer.adaptation, walk=walk)
    )  # fmt: skip


def shared_walk(walk: FloatArray, shares: FloatArray) -> FloatArray:
    """Return a walk ``(nq, nq)`` of which each parameter has a share ``(nq,)`` of its variance."""
    return np.asarray(walk * np.sqrt(np.outer(shares, shares)))


def likeliest_shares(walk: FloatArray, loss: Callable[[FloatArray], float]) -> FloatArray:
    """Return by parameter ``(nq,)`` the share of its walk for which ``loss(walk)``, in nats, is least."""
    shares = np.ones(len(walk))
    least = loss(walk) if walk.any() else 0.0
    for i in np.flatnonzero(np.diag(walk) > 0.0):
        for share in VARIANCE_SHARES[1:]:
            tried = np.where(np.arange(len(walk)) == i, share, shares)
            reached = loss(shared_walk(walk, tried))
            if reached < least:
                least, shares = reached, tried
    return shares


def sentences_on_shares(names: Sequence[str], walk: FloatArray, shares: FloatArray) -> list[str]:
    """Return a sentence for each parameter whose walk is not all used."""
    sentences = []
    for name, share, variance in zip(names, shares.tolist(), np.diag(walk).tolist(), strict=False):
        if variance > 0.0 and share == 0.0:
            sentences.append(f"These rows show no random walk of {name}: they are compared without it.")
        elif variance > 0.0 and share < 1.0:
            sentences.append(
                f"These rows show {share:.2g} of the variance by which {name} may walk: they are compared with that."
            )
    return sentences
