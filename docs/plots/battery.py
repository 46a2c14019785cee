"""The battery of the how-to page: its log, as it is, and what the design says of it."""

import obsynth

spec = obsynth.load_spec("docs/examples/battery/spec.yaml")
design = obsynth.design(spec.plant, spec.method, name=spec.name, recovery=spec.transformation.recovery)
run = obsynth.run_on_data(
    design, "docs/examples/battery/log.csv", time_column="Zeit", thresholds={"fhat[heater fault]": 2.0}
)
obsynth.plotting.plot_data(run, design=design, show=["outputs", "faults"])
