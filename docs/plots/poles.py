"""An unknown-input PI observer of a published example."""

import obsynth

spec = obsynth.load_spec("designs/sharepasand/spec.yaml")
design = obsynth.design(spec.plant, spec.method, name=spec.name, **spec.options)
obsynth.plotting.plot_poles(design)
