"""Gains for a pair ``(F, C)``: the observable part, its poles, regions of poles, and Kalman gains."""
