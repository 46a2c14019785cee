"""Questions about a plant that may not be what was meant; nothing is refused because of them."""

from __future__ import annotations

import numpy as np

from obsynth.numerics.pencils import pencil_structure
from obsynth.plants.descriptor import DescriptorSystem

#: A sampled plant with an eigenvalue this far from zero grows so fast that it is hardly one.
_FAR = 3.0
#: Larger plants are not asked: their eigenvalues would take too long for a question.
_MOST_STATES = 200


def questions(plant: DescriptorSystem) -> tuple[str, ...]:
    """Return what to ask about a linear plant: matrices of continuous time with a dt, or the other way round."""
    if plant.nx > _MOST_STATES:
        return ()
    plain = plant.dense()
    values = np.asarray(pencil_structure(plain.E, plain.A).finite_eigenvalues)
    values = values[np.isfinite(values)]
    if not values.size:
        return ()
    if plant.is_discrete:
        far = int(np.sum(np.abs(values) > _FAR))
        if far and np.sum(values.real < 0.0) >= values.size / 2.0:
            return (
                f"dt is {plant.dt:g} s, but {far} of {values.size} eigenvalues lie far outside the unit circle (up to "
                f"{np.abs(values).max():.3g}): are these the matrices of a plant in continuous time? Then give dt: 0, "
                "and let transform.sample_time sample it.",
            )
        return ()
    close = (np.abs(values) < 1.0) & (values.real > 0.0)
    if values.size > 1 and bool(close.all()):
        return (
            "dt is 0, but all eigenvalues lie in the right half of the unit circle: are these the matrices of a "
            "sampled plant? Then give dt in seconds.",
        )
    return ()
