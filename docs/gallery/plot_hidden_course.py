"""
Why no test can do better
=========================

`obsynth.plotting.plot_hidden_course` draws a fault below the least threshold, with the disturbance and the noise that hide it:
every sample is the same as without a fault.
"""

import obsynth

spec = obsynth.load_spec("../../designs/drive/guaranteed_test.yaml")
test = obsynth.guaranteed_test(
    spec.plant, course="step", before=10, after=20, disturbance_bounds={"load torque": 1.0}, noise_bound=3
)
obsynth.plotting.plot_hidden_course(test)
