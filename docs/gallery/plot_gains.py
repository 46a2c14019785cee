"""
What reaches the fault estimate
===============================

`obsynth.plotting.plot_gains` draws the singular values from faults, disturbances and noise to the estimates, over frequency:
up to which frequency an estimate follows, and what looks like a fault.
"""

import obsynth

spec = obsynth.load_spec("../../designs/smib/spec.yaml")
design = obsynth.design(spec.plant, spec.method, name=spec.name, **spec.options)
obsynth.plotting.plot_gains(design)
