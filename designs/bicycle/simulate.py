import json

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp


def mats(Cf=8e4, Cr=1e5, m=1500, Iz=2500, a=1.2, b=1.5, V=25, tau=0.1, lw=0.3):
    # vy r delta Fyf Fyr ay
    E = np.diag([m, Iz, tau, 0, 0, 0]).astype(float)
    A = np.array(
        [
            [0, -m * V, 0, 1, 1, 0],
            [0, 0, 0, a, -b, 0],
            [0, 0, -1, 0, 0, 0],
            [Cf / V, Cf * a / V, -Cf, 1, 0, 0],
            [Cr / V, -Cr * b / V, 0, 0, 1, 0],
            [0, 0, 0, -1, -1, m],
        ],
        float,
    )
    B = np.zeros((6, 1))
    B[2] = 1
    Bd = np.array([[1], [lw], [0], [0], [0], [-1]], float)
    return E, A, B, Bd


if __name__ == "__main__":
    E, A, B, Bd = mats()
    j = lambda M: json.dumps(M.tolist())
    open("bike.yaml", "w").write(f"""schema_version: 1
name: bike
plant:
  dt: 0
  state_names: [vy, r, delta, Fyf, Fyr, ay]
  input_names: [steer]
  disturbance_names: [wind]
  fault_names: [steering]
  E: {j(E)}
  A: {j(A)}
  B: {j(B)}
  Bd: {j(Bd)}
  Bf: {{states: [delta]}}
  C: {{outputs: [r, ay]}}
  sensor_noise: {{r: 2.0e-3, ay: 5.0e-2}}
  units: {{steer: rad, r: rad/s, ay: m/s^2, wind: N, steering: rad}}
method: {{id: ui-pi-observer}}
""")

    def sim(name, noise=1, seed=0, wind=1, **p):
        E, A, B, Bd = mats(**p)
        Bf = np.zeros((6, 1))
        Bf[2] = 1
        n = 3
        A11, A12, A21, A22 = A[:n, :n], A[:n, n:], A[n:, :n], A[n:, n:]
        Ei = np.linalg.inv(E[:n, :n])
        u = lambda t: 0.03 * np.sin(0.8 * t)
        f = lambda t: 0.01 * ((t > 6) & (t < 14))
        d = lambda t: wind * 400 * (t > 3) * (1 + 0.5 * np.sin(2 * t))
        z = lambda t, x: -np.linalg.solve(A22, A21 @ x + Bd[n:, 0] * d(t))
        rhs = lambda t, x: Ei @ (A11 @ x + A12 @ z(t, x) + B[:n, 0] * u(t) + Bd[:n, 0] * d(t) + Bf[:n, 0] * f(t))
        t = np.arange(0, 20, 0.01)
        s = solve_ivp(rhs, (0, 20), np.zeros(n), t_eval=t, max_step=0.01)
        ay = np.array([z(a, x)[2] for a, x in zip(t, s.y.T)])
        rng = np.random.default_rng(seed)
        pd.DataFrame(
            {
                "time": t,
                "steer": u(t),
                "r": s.y[1] + noise * 2e-3 * rng.standard_normal(t.size),
                "ay": ay + noise * 5e-2 * rng.standard_normal(t.size),
            }
        ).to_csv(name, index=False)
        pd.DataFrame({"time": t, "f": f(t), "d": d(t), "vy": s.y[0]}).to_csv("true_" + name, index=False)

    sim("log0.csv", 0)
    sim("log.csv")
    sim("log5.csv", Cf=8.4e4, Cr=0.95e5)
    sim("log5_nw.csv", wind=0, Cf=8.4e4, Cr=0.95e5)
