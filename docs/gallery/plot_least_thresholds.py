"""
The smallest detectable fault
=============================

`obsynth.plotting.plot_least_thresholds` draws the least threshold of all tests against the time that its samples take.
"""

import obsynth

spec = obsynth.load_spec("../../designs/drive/guaranteed_test.yaml")
test = obsynth.guaranteed_test(
    spec.plant, course="step", before=10, disturbance_bounds={"load torque": 1.0}, noise_bound=3
)
obsynth.plotting.plot_least_thresholds(test)
