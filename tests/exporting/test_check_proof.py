"""The program that checks proof files, on plants of one state: every claim is sharp where it is by hand."""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from benchmarks.campaigns._changed_proofs import as_array, as_data, checker

from obsynth.proofs.witnesses import Dyadic, definite_witness, inverse_above, lyapunov_witness, root_above


@cache
def program() -> ModuleType:
    return checker()


def data(value: Any) -> dict[str, Any]:
    return Dyadic.of(np.atleast_2d(np.asarray(value, dtype=np.float64))).data()


IDENTITIES = {"claim": "identities", "share": data(2.0**-20), "floor": data(0.0)}


def file_of(
    claim: dict[str, Any], *, az: float = 0.25, by: float = 0.25, rows: Any = (("residual", "r", 0),), dt: float = 1.0,
    **changes: Any,
) -> dict[str, Any]:  # fmt: skip
    """Return a file: ``x+ = x / 2 + u + f + d + w``, ``y = x``; ``z+ = az z + u + by y``, ``r = y - z`` in each row."""
    one, count = data(1.0), len(rows)
    plant = {"E": one, "A": data(0.5), "B": one, "C": one, "D": data(0.0), "Bf": one, "Df": data(0.0), "Bd": one,
             "Dd": data(0.0), "Bw": one, "Dw": data(0.0), "sample_time": data(dt),
             "names": {"states": ["x"], "faults": ["f"], "disturbances": ["d"]}}  # fmt: skip
    zero, ones = data(np.zeros((count, 1))), data(np.ones((count, 1)))
    observer = {"Az": data(az), "Bu": one, "By": data(by), "Cz": data(-np.ones((count, 1))), "Du": zero, "Dy": ones,
                "rows": [list(row) for row in rows]}  # fmt: skip
    follows = {"T": one, "T0": data(np.zeros((count, 1))), "Phi": data(np.zeros((0, 0))), "Cw": data(np.zeros((1, 0))),
               "lag": 0, "decoupled": False}  # fmt: skip
    # Claims on errors rest on the identities, which are exact here.
    claims = [claim] if claim["claim"] == "identities" else [claim, IDENTITIES]
    return {"format": "obsynth-proof", "version": 1, "about": "by hand", "plant": plant, "observer": observer,
            "follows": follows, "contraction": None, "claims": claims, "not_covered": [], **changes}  # fmt: skip


def accepted(file: dict[str, Any]) -> bool:
    verdicts, _ = program().check(file)
    return all(proved for _, proved, _ in verdicts)


def witness(matrix: Any) -> dict[str, Any]:
    """Return a witness, or one that cannot hold where there is none."""
    exact = Dyadic.of(np.atleast_2d(matrix))
    size = exact.shape[0]
    return definite_witness(exact) or {"factor": data(np.zeros((size, size))), "weights": [1] * size}


# The lemma.


@pytest.mark.parametrize(
    ("matrix", "factor", "weights", "holds"),
    [
        ([[2.0, 1.0], [1.0, 2.0]], [[0.0, 0.0]], [1, 1], True),
        ([[1.0, 2.0], [2.0, 1.0]], [[0.0, 0.0]], [1, 1], False),
        ([[1.0, 1.0], [1.0, 1.0]], [[0.0, 0.0]], [1, 1], False),
        ([[4.0, 3.0], [3.0, 4.0]], [[1.5, 1.5]], [1, 1], True),
        ([[1.0, 3.0], [3.0, 10.0]], [[0.9, 3.0]], [2, 1], True),
        ([[1.0, 3.0], [3.0, 10.0]], [[0.9, 3.0]], [1, 2], False),
        ([[1.0, 3.0], [3.0, 10.0]], [[0.9, 3.0]], [0, 0], False),
        ([[-1.0, 0.0], [0.0, -1.0]], [[0.0, 0.0]], [-1, -1], False),
        ([[-1.0, 0.0], [0.0, -1.0]], [[0.0, 0.0]], [1, 1], False),
        ([[2.0, 1.5], [0.0, 2.0]], [[0.0, 0.0]], [1, 1], False),
        ([[2.0, 0.0], [0.0, 2.0]], [[2.0, 0.0]], [1, 1], False),
        ([[2.0, 0.0], [0.0, 0.0]], [[0.0, 0.0]], [1, 1], False),
        ([[2.0, -1.9], [-1.9, 2.0]], [[0.0, 0.0]], [1, 1], True),
    ],
)
def test_positive_definite_is_what_a_factor_and_a_dominant_rest_show(
    matrix: Any, factor: Any, weights: list[int], holds: bool
) -> None:
    module = program()
    given = {"factor": data(factor), "weights": weights}
    read = module.read_matrix(data(matrix))
    if holds:
        module.require_positive_definite(read, given, "S")
        assert np.all(np.linalg.eigvalsh(np.array(matrix)) > 0.0)
        return
    with pytest.raises(module.Refused):
        module.require_positive_definite(read, given, "S")


@pytest.mark.parametrize("seed", range(6))
def test_whatever_the_witness_is_no_indefinite_matrix_is_accepted(seed: int) -> None:
    rng, module = np.random.default_rng([47, seed]), program()
    for _ in range(40):
        size = int(rng.integers(1, 5))
        root = rng.integers(-8, 9, (size, size)).astype(float)
        matrix = root + root.T + np.diag(rng.integers(-4, 30, size).astype(float))
        near = np.linalg.cholesky(matrix + 40.0 * np.eye(size)).T if rng.random() < 0.5 else root
        given = {"factor": data(np.round(near * 4.0) / 4.0), "weights": rng.integers(-1, 4, size).tolist()}
        try:
            module.require_positive_definite(module.read_matrix(data(matrix)), given, "S")
        except module.Refused:
            continue
        assert np.min(np.linalg.eigvalsh(matrix)) > 0.0


@pytest.mark.parametrize("seed", range(6))
def test_a_witness_is_found_for_every_definite_matrix_and_no_other(seed: int) -> None:
    rng = np.random.default_rng([48, seed])
    for _ in range(20):
        size = int(rng.integers(1, 7))
        scale = 2.0 ** rng.integers(-40, 41, size)
        root = rng.standard_normal((size, size))
        matrix = (root @ root.T + 1e-9 * np.eye(size)) * scale * scale[:, None]
        matrix = 0.5 * (matrix + matrix.T)
        lowest = np.min(np.linalg.eigvalsh(matrix / scale / scale[:, None]))
        if lowest > 1e-12:
            assert definite_witness(Dyadic.of(matrix)) is not None
        indefinite = matrix - (lowest + 1e-3) * np.diag(scale**2)
        assert definite_witness(Dyadic.of(0.5 * (indefinite + indefinite.T))) is None


def test_arithmetic_is_exact() -> None:
    module = program()
    one, tiny = module.read_matrix(data([[1.0, 2.0], [3.0, 4.0]])), module.read_matrix(data([[2.0**-1000, 0.0]] * 2))
    assert (one + tiny - one - tiny).is_zero()
    assert (one @ tiny).fraction(1, 0) == Fraction(7, 2**1000)
    assert (one.T.T - one).is_zero()
    assert module.Matrix.blocks([[one, tiny]]).fraction(0, 2) == Fraction(1, 2**1000)
    assert (-one).absolute().fraction(1, 1) == 4
    assert one.times(module.read_matrix(data(0.5))).fraction(0, 1) == 1
    with pytest.raises(module.Refused):
        one @ module.read_matrix(data([[1.0, 2.0, 3.0]]))


@pytest.mark.parametrize(("value", "up", "down"), [(Fraction(4, 3), "1.334", "1.333"), (Fraction(1), "1", "1"),
                                                   (Fraction(1000001, 1000000), "1.001", "1"),
                                                   (Fraction(99999, 100), "1000", "999.9")])  # fmt: skip
def test_printed_numbers_are_rounded_to_the_side_on_which_they_hold(value: Fraction, up: str, down: str) -> None:
    assert program().shown(value) == up
    assert program().shown(value, down=True) == down
    assert Fraction(program().shown(-value)) >= -value


# Claims: e+ = e / 4 + f + d + w, r = e.


@pytest.mark.parametrize(("rate", "proved"), [(0.26, True), (0.25, False), (0.24, False), (1.0, False), (0.0, False)])
def test_a_decay(rate: float, proved: bool) -> None:
    claim = {"claim": "stable", "rate": data(rate), "P": data(1.0), "P_positive": witness(1.0),
             "decreases": witness(rate**2 - 0.0625)}  # fmt: skip
    assert accepted(file_of(claim)) == proved


@pytest.mark.parametrize(("rate", "proved"), [(0.7, True), (0.75, False), (0.76, False), (0.0, True), (-0.1, False)])
def test_a_decay_in_continuous_time(rate: float, proved: bool) -> None:
    claim = {"claim": "stable", "rate": data(rate), "P": data(1.0), "P_positive": witness(1.0),
             "decreases": witness(1.5 - 2.0 * rate)}  # fmt: skip
    assert accepted(file_of(claim, az=-0.75, by=1.25, dt=0.0)) == proved


def test_a_sampled_decay_proves_nothing_of_continuous_time() -> None:
    claim = {"claim": "stable", "rate": data(0.26), "P": data(1.0), "P_positive": witness(1.0),
             "decreases": witness(0.26**2 - 0.0625)}  # fmt: skip
    assert not accepted(file_of(claim, dt=0.0))


def gain_claim(gamma: float, p: float, signal: str = "disturbances") -> dict[str, Any]:
    # e+ = e / 4 + d, r = e: P - P/16 - 1, -P/4; gamma^2 - P.
    whole = np.array([[p - p / 16.0 - 1.0, -p / 4.0], [-p / 4.0, gamma**2 - p]])
    return {"claim": "gain", "signal": signal, "rows": ["residual"], "states": 1, "gamma": data(gamma), "P": data(p),
            "P_positive": witness(p), "bounded_real": witness(whole)}  # fmt: skip


@pytest.mark.parametrize("signal", ["disturbances", "noise", "faults"])
def test_a_gain_is_proved_above_the_norm_alone(signal: str) -> None:
    """The norm is the gain at rest, 1 / (1 - 1/4)."""
    gammas = (1.2, 1.33, 1.3333, 1.34, 1.4, 2.0)
    found = [
        any(accepted(file_of(gain_claim(gamma, p, signal))) for p in np.linspace(0.5, 3.0, 81)) for gamma in gammas
    ]
    assert found == [gamma > 4.0 / 3.0 for gamma in gammas]


def test_a_gain_is_not_of_states_that_are_left_out() -> None:
    claim = {
        **gain_claim(1.34, 1.3333),
        "states": 0,
        "P": data(np.zeros((0, 0))),
        "P_positive": witness(np.zeros((0, 0))),
    }
    claim["bounded_real"] = witness(1.34**2)
    assert not accepted(file_of(claim))


def test_a_gain_is_of_rows_that_exist() -> None:
    assert not accepted(file_of({**gain_claim(1.4, 1.4), "rows": ["fault"]}))
    assert not accepted(file_of({**gain_claim(1.4, 1.4), "gamma": data(-1.4)}))
    assert not accepted(file_of({**gain_claim(1.4, 1.4), "signal": "wind"}))


@pytest.mark.parametrize(
    ("variance", "bound", "proved"), [(1.07, 1.04, True), (1.07, 1.03, False), (1.06, 1.04, False)]
)
def test_a_deviation(variance: float, bound: float, proved: bool) -> None:
    """The variance of e is 1 / (1 - 1/16) = 1.0667, its root 1.0328."""
    claim = {"claim": "deviation", "rows": ["residual"], "X": data(variance), "X_positive": witness(variance),
             "covers": witness(variance * 15.0 / 16.0 - 1.0), "deviations": data(bound)}  # fmt: skip
    assert accepted(file_of(claim)) == proved
    assert not accepted(file_of({**claim, "deviations": data(-bound)}))


@pytest.mark.parametrize(("share", "proved"), [(2.0**-19, True), (2.0**-22, False), (0.01, False), (0.0, False)])
def test_identities_hold_to_a_share_of_their_terms(share: float, proved: bool) -> None:
    claim = {"claim": "identities", "share": data(share), "floor": data(0.0)}
    assert accepted(file_of(claim, by=0.25 + 2.0**-21)) == proved
    exact = file_of({**claim, "share": data(0.0)})
    assert accepted(exact)


CHANGES = {
    "the state": lambda file: file["plant"].update(A=data(0.5 + 2.0**-30)),
    "a known input": lambda file: file["observer"].update(Bu=data(1.0 + 2.0**-30)),
    "an input in the rows": lambda file: file["observer"].update(Du=data(2.0**-30)),
    "the rows": lambda file: file["observer"].update(Dy=data(1.0 + 2.0**-30)),
    "equations that are added": lambda file: file["follows"].update(T0=data(2.0**-30)),
    "feedthrough": lambda file: file["plant"].update(D=data(2.0**-30)),
}


@pytest.mark.parametrize("change", CHANGES)
def test_every_identity_counts(change: str) -> None:
    file = file_of({"claim": "identities", "share": data(2.0**-40), "floor": data(0.0)})
    assert accepted(file)
    CHANGES[change](file)
    assert not accepted(file)


def contraction(az: float = 0.25, rate: float = 0.5) -> dict[str, Any]:
    found = lyapunov_witness(Dyadic.of([[az]]), np.ones(1), rate, discrete=True)
    assert found is not None
    p = found["P"]
    inverted = inverse_above(p)
    assert inverted is not None
    return {"rate": data(rate), "P": p.data(), "P_positive": found["P_positive"], "decreases": found["decreases"],
            "G": inverted[0].data(), "G_covers": inverted[1]}  # fmt: skip


@pytest.mark.parametrize(("bound", "proved"), [(2.0**-19 * 1.001, True), (2.0**-19 * 0.999, False), (0.0, False)])
def test_what_rounding_adds(bound: float, proved: bool) -> None:
    """By is off by 2^-20, which a contraction of one half doubles."""
    claim = {"claim": "rounding", "bounds": {"states": data(bound), "inputs": data(0.0)}}
    assert accepted(file_of(claim, by=0.25 + 2.0**-20, contraction=contraction())) == proved


def test_what_rounding_adds_to_known_inputs_counts() -> None:
    claim = {"claim": "rounding", "bounds": {"states": data(0.0), "inputs": data(0.0)}}
    file = file_of(claim, contraction=contraction())
    assert accepted(file)
    file["observer"]["Bu"] = data(1.0 + 2.0**-20)
    assert not accepted(file)
    file["claims"][0]["bounds"]["inputs"] = data(2.0**-19 * 1.001)
    assert accepted(file)


def test_an_observer_is_not_decoupled_because_a_file_says_so() -> None:
    """e+ = e / 4 + d: a contraction of one half makes two of it."""
    claim = {"claim": "rounding", "bounds": {"states": data(0.0), "inputs": data(0.0)}}
    file = file_of(claim, contraction=contraction())
    file["follows"]["decoupled"] = True
    for bound, proved in ((None, False), (0.0, False), (1.99, False), (2.01, True)):
        claim["bounds"] = {**claim["bounds"], **({} if bound is None else {"disturbances": data(bound)})}
        assert accepted(file) == proved


def test_a_contraction_needs_its_inverse_and_a_rate_of_decay() -> None:
    claim = {"claim": "rounding", "bounds": {"states": data(0.0), "inputs": data(0.0)}}
    kept = contraction()
    small = as_data(0.5 * as_array(kept["G"]))
    assert not accepted(file_of(claim, contraction={**kept, "G": small}))
    assert not accepted(file_of(claim, contraction={**kept, "rate": data(1.0)}))
    assert not accepted(file_of(claim, contraction={**kept, "rate": data(0.2)}))


FAULT_ROWS = (("fault", "f", 1), ("residual", "f", 0))


@pytest.mark.parametrize(("delay", "proved"), [(1, True), (2, False), (0, False)])
def test_a_fault_shows_after_its_delay(delay: int, proved: bool) -> None:
    """With az = 0, e+ = f: both rows show the fault one sample later, and never again."""
    rows = (("fault", "f", delay), FAULT_ROWS[1])
    claim = {"claim": "faults", "bounds": data([[0.0], [0.0]])}
    assert accepted(file_of(claim, az=0.0, by=0.5, rows=rows, contraction=contraction(0.0))) == proved


@pytest.mark.parametrize(("bound", "proved"), [(2.0**-19 * 1.01, True), (2.0**-20 * 0.99, False), (0.01, False)])
def test_what_stays_of_a_fault_is_bounded(bound: float, proved: bool) -> None:
    """With az = 2^-20 that much of a fault is left two samples later; an estimate off by 1 % is refused whatever."""
    az = 2.0**-20
    claim = {"claim": "faults", "bounds": data([[bound], [bound]])}
    file = file_of(claim, az=az, by=0.5 - az, rows=FAULT_ROWS, contraction=contraction(az))
    assert accepted(file) == proved


def test_a_file_with_another_version_is_no_proof() -> None:
    file = file_of({"claim": "stable"})
    for change in ({"version": 2}, {"format": "x"}, {"claims": []}):
        with pytest.raises(program().Refused):
            program().check({**file, **change})
    assert not accepted({**file, "claims": [{"claim": "gains"}]})


@pytest.mark.parametrize("value", [Fraction(2), Fraction(1, 3), Fraction(10**40), Fraction(1, 10**40), Fraction(9, 4)])
def test_roots_are_never_too_small(value: Fraction) -> None:
    ours, theirs = Fraction(root_above(value)), program().root_above(value)
    for found in (ours, theirs):
        assert found**2 >= value
    assert ours**2 <= value * Fraction(1001, 1000)
    assert theirs**2 <= value * Fraction(1001, 1000) + Fraction(1, 2**200)
