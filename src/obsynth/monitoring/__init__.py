"""From measured data to alarms, and to proofs of alarms.

`logs` reads data and runs observers on it, `thresholds` makes monitors (guaranteed, over tolerances, from stated noise,
or learned), `alarms` holds events and proofs, `calibration` fits plants to logs; `plots` and `verbs` show them.

Main names: `run_on_data`, `smooth`, `online_monitor`, `monitor`, `learn_thresholds`, `prove_alarm`, `calibrate`.
"""
