"""
What model errors cost
======================

`obsynth.plotting.plot_tolerances` draws false alarms, and the smallest fault that is detected in every run, against the
tolerance of the constants: for a fixed bound and for the adaptive threshold.
"""

import obsynth

spec = obsynth.load_spec("../../designs/drive/spec.yaml")
design = obsynth.design(spec.plant, spec.method, name=spec.name, **spec.options)
study = obsynth.tolerance_study(design, spec.scenario, tolerances=(0.0, 0.02, 0.05), runs=5)
obsynth.plotting.plot_tolerances(study)
