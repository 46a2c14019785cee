"""What reaches the fault estimates at each frequency, and the poles of a continuous-time observer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.models.descriptor import DescriptorSystem
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.spectra import boundary_points, eigenvalues, response
from obsynth.observers.linear import LinearObserver
from obsynth.results.design import ObserverDesign
from obsynth.verification.decoupling import frequency_grid

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: A gain below this share of what is subtracted from one another in it is rounding: nothing gets through.
ROUNDING_SHARE = 1e-9
_STYLES: dict[str, dict[str, Any]] = {
    "faults": {"color": "black", "linewidth": 1.8, "linestyle": "-"},
    "disturbances": {"color": "tab:red", "linewidth": 1.6, "linestyle": "--"},
    "noise": {"color": "tab:blue", "linewidth": 1.6, "linestyle": ":"},
}
#: Inches.
_SIZE = (7.5, 4.0)


@dataclass(frozen=True, eq=False)
class FaultEstimateGains:
    """Largest singular values from what acts on a plant to the fault estimates.

    Parameters
    ----------
    frequencies : FloatArray
        ``(k,)``, rad/s.
    gains : dict of str to FloatArray
        ``faults``, ``disturbances``, ``noise`` as far as the plant has them: ``(k,)``, zero where only
        rounding is left.
    """

    frequencies: FloatArray
    gains: dict[str, FloatArray]


def fault_estimate_gains(design: ObserverDesign) -> FaultEstimateGains:
    """Return the singular values of the transfer functions that matter, from the plant and the shipped realisation.

    Parameters
    ----------
    design : ObserverDesign
        Linear, with faults.

    Returns
    -------
    FaultEstimateGains
        Around the poles of the observer.

    Raises
    ------
    SpecError
        The design is recursive or estimates no fault.
    """
    plant, observer = design.linear
    if not observer.fault_names:
        raise SpecError("The design estimates no faults.", path="observer")
    frequencies = frequency_grid(observer)[1:]
    points = boundary_points(frequencies, observer.dt)
    rows = observer.fault_rows
    to_estimate = response(observer.Az, observer.By, observer.Cz[rows], observer.Dy[rows], points)
    inputs = {"faults": (plant.Bf, plant.Df), "disturbances": (plant.Bd, plant.Dd), "noise": (plant.Bw, plant.Dw)}
    gains = {}
    for name, (b, d) in inputs.items():
        if not b.shape[1]:
            continue
        to_output = _plant_response(plant, b, d, points)
        sizes = np.linalg.norm(to_estimate @ to_output, 2, axis=(1, 2))
        terms = np.linalg.norm(to_estimate, axis=(1, 2)) * np.linalg.norm(to_output, axis=(1, 2))
        gains[name] = np.where(sizes > ROUNDING_SHARE * terms, sizes, 0.0)
    return FaultEstimateGains(frequencies, gains)


def _plant_response(plant: DescriptorSystem, b: FloatArray, d: FloatArray, points: ComplexArray) -> ComplexArray:
    pencils = points[:, None, None] * plant.E - plant.A
    return np.asarray(
        plant.C @ np.linalg.solve(pencils, np.broadcast_to(b.astype(complex), (len(points), *b.shape))) + d
    )


def plot_gains(design: ObserverDesign, *, axes: Axes | None = None) -> Axes:
    """Plot what reaches the fault estimates: faults (should be 1), disturbances and noise (should be small).

    Parameters
    ----------
    design : ObserverDesign
        Linear, with faults.
    axes : Axes, optional
        New ones by default.

    Returns
    -------
    Axes
        Largest singular values over the frequency, both logarithmic.

    Raises
    ------
    SpecError
        The design is recursive or estimates no fault.
    """
    found = fault_estimate_gains(design)
    panel = _new_axes(_SIZE) if axes is None else axes
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.axhline(1.0, color="0.7", linewidth=0.8, zorder=0)
    for name, gain in found.gains.items():
        if np.any(gain > 0.0):
            shown = np.where(gain > 0.0, gain, np.nan)
            panel.plot(found.frequencies, shown, label=f"{name} to fault estimates", **_STYLES[name])
        else:
            panel.plot([], [], label=f"{name}: nothing gets through", **_STYLES[name])
    panel.set_xlabel("frequency (rad/s)")
    panel.set_ylabel("largest singular value")
    panel.legend(loc="best")
    panel.grid(True, color="0.9", linewidth=0.6)
    return panel


def plot_continuous_poles(design: ObserverDesign, *, axes: Axes | None = None) -> Axes:
    """Plot the eigenvalues of a continuous-time observer; stable ones are left of the line.

    Parameters
    ----------
    design : ObserverDesign
        Linear, continuous time.
    axes : Axes, optional
        New ones by default.

    Returns
    -------
    Axes
        The complex plane, 1/s.

    Raises
    ------
    SpecError
        The design is recursive or sampled.
    """
    observer: LinearObserver = design.linear[1]
    if observer.dt > 0.0:
        raise SpecError("The design is sampled: use plot_poles.", path="dt")
    panel = _new_axes(_SIZE) if axes is None else axes
    poles = eigenvalues(observer.Az)
    panel.axhline(0.0, color="0.85", linewidth=0.8, zorder=0)
    panel.axvline(0.0, color="0.5", linewidth=1.0, linestyle="--", label="limit of stability")
    panel.plot(poles.real, poles.imag, marker="x", markersize=9, markeredgewidth=1.6, linestyle="none", color="black",
               label=f"observer eigenvalues ({len(poles)})")  # fmt: skip
    panel.set_xlabel("real part (1/s)")
    panel.set_ylabel("imaginary part (1/s)")
    panel.legend(loc="best")
    return panel


def _new_axes(size: tuple[float, float]) -> Axes:
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained").subplots()
