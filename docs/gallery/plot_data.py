"""
A log with its estimates and the alarm
======================================

`obsynth.plotting.plot_data` is the picture for a report: measured signals, estimates, residuals, and the rows of the alarm.
"""

import obsynth

spec = obsynth.load_spec("../examples/battery/spec.yaml")
design = obsynth.design(spec.plant, spec.method, name=spec.name, recovery=spec.transformation.recovery)
run = obsynth.run_on_data(
    design, "../examples/battery/log.csv", time_column="Zeit", thresholds={"fhat[heater fault]": 2.0}
)
obsynth.plotting.plot_data(run, design=design, show=["outputs", "faults"])
