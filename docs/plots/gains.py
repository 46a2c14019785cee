"""A single machine on an infinite bus: the estimate of its mechanical torque."""

import obsynth

spec = obsynth.load_spec("designs/smib/spec.yaml")
design = obsynth.design(spec.plant, spec.method, name=spec.name, **spec.options)
obsynth.plotting.plot_gains(design)
