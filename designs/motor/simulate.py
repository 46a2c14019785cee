"""scipy simulation of motor + flexible shaft + load; writes CSV with/without 5 % model error."""

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp


def sim(name, Jl=0.05, R=1.0, seed=0, noise=1.0, load=0.2, fault=0.1, T=20, dt=0.005):
    Jm, Kt, Ke, bm, k, c, bl = 0.01, 0.5, 0.5, 0.01, 50, 0.05, 0.02
    u = lambda t: 6 + 1.0 * np.sign(np.sin(0.7 * t))
    f = lambda t: fault * (t >= 8) * (t < 14)
    d = lambda t: load * np.sin(1.3 * t) + (load if t > 4 else 0)

    def rhs(t, x):
        tm, wm, tl, wl = x
        i = (u(t) - Ke * wm) / R
        return [
            wm,
            (Kt * i - bm * wm - k * (tm - tl) - c * (wm - wl) + f(t)) / Jm,
            wl,
            (k * (tm - tl) + c * (wm - wl) - bl * wl + d(t)) / Jl,
        ]

    t = np.arange(0, T, dt)
    s = solve_ivp(rhs, (0, T), [0, 0, 0, 0], t_eval=t, rtol=1e-8, atol=1e-9, max_step=0.01)
    rng = np.random.default_rng(seed)
    U = np.array([u(a) for a in t])
    tm, wm, tl, wl = s.y
    i = (U - Ke * wm) / R
    pd.DataFrame(
        {
            "time": t,
            "voltage": U,
            "theta m": tm + noise * 1e-3 * rng.standard_normal(t.size),
            "theta l": tl + noise * 1e-3 * rng.standard_normal(t.size),
            "i": i + noise * 1e-2 * rng.standard_normal(t.size),
        }
    ).to_csv(name, index=False)
    pd.DataFrame({"time": t, "f": [f(a) for a in t], "d": [d(a) for a in t], "wm": wm, "wl": wl}).to_csv(
        "true_" + name, index=False
    )


sim("log0.csv", noise=0)
sim("log.csv")
sim("log5.csv", Jl=0.0525, R=1.05)
sim("log5_n0.csv", Jl=0.0525, R=1.05, noise=0)
