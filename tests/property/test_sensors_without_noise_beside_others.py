"""One sensor more that has no noise, beside sensors and states that have some: functional filters use it."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

import obsynth


def plants(seed, dt):
    """A plant with noise of its states and sensors, and the same with a sensor more that has none."""
    rng = np.random.default_rng([71, seed, int(dt > 0)])
    n, noisy = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    a = rng.standard_normal((n, n)) - 1.5 * np.eye(n)
    c, bf, b, bw = (rng.standard_normal(shape).round(3) for shape in ((noisy + 1, n), (n, 1), (n, 1), (n, 1)))
    given = {
        "A": (scipy.linalg.expm(dt * a) if dt else a).round(3), "B": b, "Bf": bf, "dt": dt,
        "Bw": np.hstack([0.1 * bw, np.zeros((n, noisy))]),
    }  # fmt: skip
    noise = np.hstack([np.zeros((noisy + 1, 1)), 0.1 * np.eye(noisy + 1)[:, :noisy]])
    return (
        obsynth.DescriptorSystem(**given, C=c[:-1], Dw=noise[:-1]),
        obsynth.DescriptorSystem(**given, C=c, Dw=noise),
    )


@pytest.mark.one_in(4)
@pytest.mark.parametrize("dt", [0.0, 0.2])
@pytest.mark.parametrize("seed", range(4))
def test_a_sensor_without_noise_makes_no_estimate_worse(seed, dt):
    without, more = (obsynth.functional_filter(plant, fault_rate=0.5) for plant in plants(seed, dt))
    assert more.report.passed
    errors = [design.certificate.matrices["deviations"][:, 1] for design in (without, more)]
    assert np.all(errors[1] <= 1.001 * errors[0])
    assert any("No noise is stated for" in note for note in more.notes) == (dt == 0.0)


def test_without_any_noise_of_sensors_the_remedies_are_true():
    _, plant = plants(0, 0.0)
    silent = plant.replace(Dw=np.zeros_like(plant.Dw))
    with pytest.raises(obsynth.PreconditionError, match=r"state the noise .* or give poles"):
        obsynth.functional_filter(silent)
    assert obsynth.functional_filter(silent, poles=list(-np.linspace(1.0, 2.0, silent.nx + 1))).report.passed
    noise = dict.fromkeys(silent.output_names, 0.1)
    assert obsynth.functional_filter(silent, noise=noise).report.passed
