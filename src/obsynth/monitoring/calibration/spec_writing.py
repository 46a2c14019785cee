"""A spec with the result of a calibration: constants, boxes, noise and steps, so that every command uses the same."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.outputs import FileKind, yaml_text
from obsynth.plants.noise import offset_state
from obsynth.specs.documents import read_yaml

if TYPE_CHECKING:
    from obsynth.monitoring.calibration.result import Calibration


#: What ``calibrate --write-spec`` writes, and may write over.
CALIBRATED_SPEC = FileKind("a spec that obsynth has calibrated", rb"\A# Calibrated by obsynth", suffix=".yaml")

#: Methods that take Q and R as options of their own.
_DAE, _RECURSIVE = "dae-adaptive-observer", ("descriptor-kalman", "adaptive-observer")

#: What a plant says of noise, all of which a calibration finds anew.
_CALIBRATED_NOISE = ("sensor_noise", "offset", "walks", "process_noise", "Bw", "Dw", "noise_names")


def calibrated_spec(path: Path, result: Calibration, *, calibration: Path | None = None) -> str:
    """Return the text of a spec with the result of its calibration.

    Parameters
    ----------
    path : Path
        The spec that was calibrated; what is written belongs beside it.
    result : Calibration
        What `obsynth.calibrate` returned for its plant.
    calibration : Path, optional
        The calibration's file beside the spec, to which a box of tolerances then refers.

    Raises
    ------
    SpecError
        The file holds a plant and no spec; or the steps were divided, which no design does.
    """
    document = read_yaml(path)
    if "plant" not in document:
        raise SpecError(
            f"{path} is a plant, not a spec: write a spec that refers to it and names a method.", path="method"
        )
    if result.substeps != 1:
        raise SpecError(
            f"The calibration takes {result.substeps} steps a sample, and designs take one: calibrate without "
            "substeps.",
            path="calibrate.substeps",
        )
    plant = dict(document["plant"])
    if "file" in plant:
        own = read_yaml(path.parent / plant["file"], where="plant.file")
        own.pop("schema_version", None)
        plant = own | {name: value for name, value in plant.items() if name != "file"}
    plant = {name: value for name, value in plant.items() if name not in _CALIBRATED_NOISE}
    linear = plant.get("kind") != "dae" or bool((plant.get("transform") or {}).get("linearise"))
    method = {"id": "auto", **(document.get("method") or {})}
    options = dict(method.get("options") or {})
    _set_constants(plant, result, calibration, with_ranges=linear and plant.get("kind") != "time-varying")
    if plant.get("kind") == "time-varying":
        if method["id"] in _RECURSIVE:
            names = plant.get("state_names") or [f"x{i + 1}" for i in range(len(plant["A"]))]
            variances = [float(result.Q.get(name, 0.0)) for name in names]
            options |= {"Q": np.diag(variances).tolist(), "R": np.diag(list(result.R.values())).tolist()}
    else:
        _set_noise(plant, result, linear=linear)
        if not linear:
            method["id"] = _DAE if method["id"] == "auto" else method["id"]
            options |= _nonlinear_options(result)
            if result.found_offsets or options.get("initial_state") is not None:
                options["initial_state"] = _started(plant, options.get("initial_state"), result)
        elif plant.get("kind") != "dae":
            _set_offsets(plant, result)
        if linear and method["id"] in _RECURSIVE:
            options = _recursive_options(options, result)
    section = {"unknown": {}, **(document.get("calibrate") or {}), "digest": result.box.digest}
    section |= {"input_delay": int(result.input_delay)}
    written = {**document, "plant": plant, "method": {**method, "options": options}, "calibrate": section}
    if document.get("inputs") is not None:
        # When the inputs act is as the calibration has them, whatever the spec or the command line said before.
        sampled = bool(plant.get("dt")) or bool((plant.get("transform") or {}).get("sample_time"))
        hold = {"hold": "ends" if plant.get("kind") == "dae" else "begins"} if sampled or not linear else {}
        written["inputs"] = {**hold, "delay": int(result.input_delay)}
    heading = f"# Calibrated by obsynth from {path.name} and {result.log['source'] or 'a log'}.\n"
    return heading + yaml_text(written)


def _set_constants(plant: dict[str, Any], result: Calibration, calibration: Path | None, *, with_ranges: bool) -> None:
    """Put nominal values in, with ranges where a design can use them."""
    stated, parameters = dict(plant.get("constants") or {}), dict(plant.get("parameters") or {})
    opened = {name for name, _ in result.box.open_sides}
    if not result.box.stands:
        calibration = None  # its ranges are stated, without a level
    other_ranges = any(isinstance(item, Mapping) for name, item in stated.items() if name not in result.nominal)
    for name, value in result.nominal.items():
        if name in parameters:
            parameters[name] = float(value)
        elif name in stated and with_ranges and name not in opened and calibration is None:
            unit = {"unit": result.units[name]} if result.units.get(name, "1") != "1" else {}
            ends = [float(result.box.low[name]), float(result.box.high[name])]
            stated[name] = {"nominal": float(value), "range": ends, **unit}
        elif name in stated:
            stated[name] = float(value)
    if stated:
        plant["constants"] = stated
    if parameters:
        plant["parameters"] = parameters
    ranges = with_ranges and not opened and bool(result.nominal)
    plant.pop("box", None)
    if ranges and calibration is not None:
        plant["box"] = {"file": calibration.name}
    elif ranges and not other_ranges and result.box.stands and set(stated) >= set(result.nominal):
        plant["box"] = {"source": "calibrated", "level": float(result.box.level), "digest": result.box.digest}


def _set_noise(plant: dict[str, Any], result: Calibration, *, linear: bool) -> None:
    """Put the noise in: of sensors, offsets, walks, and of the equations of what becomes a linear plant."""
    plant["sensor_noise"] = {
        name: {key: float(value) for key, value in result.sensor_noise[name].items()}
        if name in result.sensor_noise
        else float(variance**0.5)
        for name, variance in result.R.items()
    }
    for name, sizes in (("offset", result.offset), ("walks", result.walks)):
        if sizes:
            plant[name] = {key: float(value) for key, value in sizes.items()}
    if not linear:
        return
    # A rate to which a number is added for a step of dt seconds moves as white noise of this intensity does.
    step = 1.0 if plant.get("dt") else float(result.log["dt"]) ** 0.5
    own = {name: step * variance**0.5 for name, variance in result.Q.items() if name in result.own_equations}
    if plant.get("kind") == "dae":
        plant["process_noise"] = {name: float(value) for name, value in own.items() if value > 0.0}
        return
    rows = np.zeros((len(result.own_equations), len(own)))
    for column, (name, value) in enumerate(own.items()):
        rows[result.own_equations.index(name), column] = value
    if own:
        plant["Bw"] = rows.tolist()


def _set_offsets(plant: dict[str, Any], result: Calibration) -> None:
    """Put the offsets that were found into the operating point of a linear plant: its designs know of no first state,
    and those with a steady state took a thousand samples to find one."""
    point = dict(plant.get("operating_point") or {})
    for name, (value, deviation) in result.found_offsets.items():
        point[name] = float(point.get(name, 0.0) + value)
        plant["offset"][name] = float(deviation)
    if result.found_offsets:
        plant["operating_point"] = point


def _started(plant: Mapping[str, Any], stated: Any, result: Calibration) -> dict[str, float]:
    """Return the first state by name, as it was stated and with the offsets that were found."""
    own = stated if isinstance(stated, Mapping) else dict(zip(plant["states"], stated or (), strict=False))
    return {**own, **{offset_state(name): value for name, (value, _) in result.found_offsets.items()}}


def _nonlinear_options(result: Calibration) -> dict[str, Any]:
    # What rows without faults say of an offset, no later row can: a fault of the same sensor looks the same.
    offset_variances = {offset_state(name): deviation**2 for name, (_, deviation) in result.found_offsets.items()}
    return {
        "dt": float(result.log["dt"]),
        "Q": {name: float(value) for name, value in result.Q.items()},
        "R": {name: float(value) for name, value in result.R.items()},
        "integration": result.integration,
        "initial_covariance": {name: float(value) for name, value in result.initial_covariance.items()}
        | offset_variances,
        **({"outliers": "gate", "outlier_sizes": dict(result.outlier_sizes)} if result.outlier_sizes else {}),
    }


def _recursive_options(stated: Mapping[str, Any], result: Calibration) -> dict[str, Any]:
    """Return the options of a recursive filter of a linear plant, which has its noise from the plant now, and may have
    states more than it had: their start and its variances come after those that were stated."""
    options = {name: value for name, value in stated.items() if name not in ("Q", "R")}
    offsets = {name: deviation for name, (_, deviation) in result.found_offsets.items()}
    more = [
        *(noise["deviation"] ** 2 for noise in result.sensor_noise.values()),
        *(offsets.get(name, size) ** 2 for name, size in result.offset.items()),
        *(result.initial_covariance[name] for name in result.walks),
    ]
    if options.get("initial_state") is not None:
        options["initial_state"] = [*options["initial_state"], *np.zeros(len(more)).tolist()]
    if isinstance(options.get("initial_covariance"), list):
        own = np.array(options["initial_covariance"], dtype=np.float64)
        covariance = np.diag(np.concatenate([np.zeros(len(own)), more]))
        covariance[: len(own), : len(own)] = own
        options["initial_covariance"] = covariance.tolist()
    return options
