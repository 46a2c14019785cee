"""The oven of the first steps: design, log, and what the design says of it."""

import runpy
import tempfile
from contextlib import chdir

import obsynth

spec = obsynth.load_spec("docs/examples/thermal/spec.yaml")
design = obsynth.design(spec.plant, spec.method, name=spec.name, recovery=spec.transformation.recovery)
script = runpy.run_path("docs/examples/thermal/make_log.py")
with tempfile.TemporaryDirectory() as folder, chdir(folder):
    script["main"]()
    run = obsynth.run_on_data(design, "oven.csv", time_column="Timestamp", thresholds={"fhat[heater fault]": 1.0})
obsynth.plotting.plot_data(run, design=design, show=["outputs", "faults"])
