"""DTS200 three-tank: linearise (finite differences), write spec, simulate the nonlinear plant with scipy."""

import json

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

A, S, g = 0.0154, 5e-5, 9.81
a13, a32, a20 = 0.5, 0.5, 0.6
sg = lambda x: np.sign(x) * np.sqrt(2 * g * abs(x))


def rhs(h, q, leak, clog, a13=a13, a20=a20, a32=a32):
    q13 = a13 * S * sg(h[0] - h[2]) * (1 - clog)
    q32 = a32 * S * sg(h[2] - h[1])
    q20 = a20 * S * sg(h[1])
    l = [leak[i] * S * sg(max(h[i], 0)) for i in range(3)]
    return np.array([(q[0] - q13 - l[0]) / A, (q[1] + q32 - q20 - l[1]) / A, (q13 - q32 - l[2]) / A])


q0 = np.array([3e-5, 2e-5])
h0 = fsolve(lambda h: rhs(h, q0, [0] * 3, 0), [0.5, 0.2, 0.35])


def jac(fun, x, e=1e-6):
    return np.column_stack([(fun(x + e * d) - fun(x - e * d)) / (2 * e) for d in np.eye(len(x))])


Ac = jac(lambda h: rhs(h, q0, [0] * 3, 0), h0)
Bc = jac(lambda q: rhs(h0, q, [0] * 3, 0), q0, 1e-8)
F = jac(lambda f: rhs(h0, q0, [f[0], f[1], 0], f[2]), np.zeros(3), 1e-6)  # leak 1, leak 2, clog 13
if __name__ == "__main__":
    print(h0)
    r = lambda M: json.dumps(np.round(M, 10).tolist())
    open("tank.yaml", "w").write(f"""schema_version: 1
name: tank
plant:
  dt: 0
  state_names: [h1, h2, h3]
  input_names: [q1, q2]
  fault_names: [leak 1, leak 2, clog 13]
  E: [[1,0,0],[0,1,0],[0,0,1]]
  A: {r(Ac)}
  B: {r(Bc)}
  Bf: {r(F)}
  C: {{outputs: [h1, h2, h3]}}
  sensor_noise: {{h1: 1.0e-3, h2: 1.0e-3, h3: 1.0e-3}}
  operating_point: {{h1: {h0[0]}, h2: {h0[1]}, h3: {h0[2]}, q1: {q0[0]}, q2: {q0[1]}}}
  transform: {{sample_time: 1}}
method:
  id: fault-estimation-filter
""")

    def sim(name, noise=1, seed=1, **p):
        h = h0.copy() if not p else fsolve(lambda h: rhs(h, q0, [0] * 3, 0, **p), h0)
        rng = np.random.default_rng(seed)
        rows = []
        tr = []
        for k in range(1500):
            q = q0 * (1 + 0.1 * np.sign(np.sin(k / 70)))
            lk = [0.1 if k >= 500 else 0, 0, 0]
            cl = 0.3 if k >= 1000 else 0
            rows.append([k, *q, *(h + noise * 1e-3 * rng.standard_normal(3))])
            tr.append([k, lk[0], 0, cl])
            h = solve_ivp(lambda t, x: rhs(x, q, lk, cl, **p), (0, 1), h, rtol=1e-8, atol=1e-10).y[:, -1]
        pd.DataFrame(rows, columns=["time", "q1", "q2", "h1", "h2", "h3"]).to_csv(name, index=False)
        pd.DataFrame(tr, columns=["time", "leak 1", "leak 2", "clog 13"]).to_csv("true_" + name, index=False)

    sim("log0.csv", 0)
    sim("log.csv")
    sim("log5.csv", a13=0.525, a20=0.63)
