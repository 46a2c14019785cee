"""The least threshold of the drive against the time since the step, for two courses."""

import obsynth

spec = obsynth.load_spec("designs/drive/guaranteed_test.yaml")
test = obsynth.guaranteed_test(
    spec.plant, course="step", before=10, disturbance_bounds={"load torque": 1.0}, noise_bound=3
)
test.plot()
