"""One command line for each command, shown first in its help and in the reference."""

from __future__ import annotations

from typing import Final

EXAMPLES: Final[dict[str, str]] = {
    "design": "obsynth design --system spec.yaml",
    "check": "obsynth check --system spec.yaml",
    "sensors": "obsynth sensors --system spec.yaml --goal isolate",
    "verify": "obsynth verify oven.gains.json",
    "simulate": "obsynth simulate --system spec.yaml --gains oven.gains.json --out run.csv",
    "compare": "obsynth compare --system spec.yaml --out compare.html",
    "evaluate": "obsynth evaluate --system spec.yaml --monitor pointwise --runs 200",
    "sweep": "obsynth sweep --system spec.yaml --set gamma='[0.1, 0.2, 0.5]' --out sweep",
    "run": "obsynth run --gains oven.gains.json --data log.csv --out estimates.csv",
    "thresholds": 'obsynth thresholds --gains oven.gains.json --data ok.csv --false-alarms "1 per day" --out t.json',
    "export": "obsynth export --gains oven.gains.json --to oven.c",
    "plot": "obsynth plot --gains oven.gains.json --data log.csv --out oven.png",
    "report": "obsynth report --gains oven.gains.json --data log.csv --out oven.html",
    "linearise": "obsynth linearise --system spec.yaml --given level=4 --out plant.yaml",
    "calibrate": "obsynth calibrate --system spec.yaml --data normal.csv --write-spec calibrated.yaml",
    "validate": "obsynth validate --gains tank.gains.json --data normal.csv",
    "prove-alarm": "obsynth prove-alarm --gains drive.gains.json --data log.csv --row 215 --out alarm.json",
}
