"""
Poles of the observer
=====================

`obsynth.plotting.plot_poles` draws the eigenvalues of the observer, the zeros that faults have, and the region that was
asked for.
"""

import obsynth

spec = obsynth.load_spec("../../designs/sharepasand/spec.yaml")
design = obsynth.design(spec.plant, spec.method, name=spec.name, **spec.options)
obsynth.plotting.plot_poles(design)
