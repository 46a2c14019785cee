"""
Methods side by side
====================

The picture of `obsynth.compare`: estimates of several methods on the same scenario (without `methods`, of every one
that exists for the plant).
"""

import obsynth

spec = obsynth.load_spec("../examples/thermal/spec.yaml")
methods = ["fault-estimation-filter", "pd-observer", "ui-pi-observer"]
obsynth.compare(spec.plant, methods=methods, scenario=spec.scenario, runs=5).plot()
