"""
Methods side by side
====================

The picture of `obsynth.compare`: estimates of every method on the same scenario.
"""

import obsynth

spec = obsynth.load_spec("../examples/thermal/spec.yaml")
obsynth.compare(spec.plant, scenario=spec.scenario, runs=5).plot()
