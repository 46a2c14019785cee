"""A plant of index 3 whose filter of least deviation has another one in its stored numbers: it is read later."""

import numpy as np

import obsynth


def test_a_filter_that_reads_the_outputs_later_is_found() -> None:
    rng = np.random.default_rng([47, 3, 7])
    slow = int(rng.integers(1, 4))
    n = slow + 3
    modes = rng.normal(size=(slow, slow))
    modes *= 0.8 / max(np.abs(np.linalg.eigvals(modes)).max(), 0.1)
    e, a = np.zeros((n, n)), np.eye(n)
    e[:slow, :slow], e[slow:, slow:], a[:slow, :slow] = np.eye(slow), np.eye(3, k=1), modes
    rows, states = rng.normal(size=(n, n)), rng.normal(size=(n, n))
    plant = obsynth.DescriptorSystem(
        E=rows @ e @ states,
        A=rows @ a @ states,
        B=rng.normal(size=(n, 1)),
        C=rng.normal(size=(2, n)),
        Bf=rows @ rng.normal(size=(n, 1)),
        Bw=np.zeros((n, 2)),
        Dw=0.1 * np.eye(2),
        dt=1.0,
    )
    # The claimed deviation and that of the stored numbers were 1 % apart, and nothing was shipped.
    design = obsynth.optimal_filter(plant, norm="h2")
    assert design.report.passed
    assert 0.0 < design.least <= design.gain <= 1.2 * design.least
