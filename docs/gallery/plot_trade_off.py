"""
Noise against speed
===================

`obsynth.plotting.plot_trade_off` draws one claim of several designs against another one.
"""

import obsynth

spec = obsynth.load_spec("../examples/thermal/spec.yaml")
designs = [obsynth.ui_pi_observer(spec.plant, decay=decay) for decay in (0.002, 0.004, 0.008, 0.016, 0.032)]
obsynth.plotting.plot_trade_off(designs, "decay", "noise_amplification")
