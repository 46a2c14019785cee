/* Thresholds over the tolerances of the plant: the recursion of obsynth, for constants that stay the same.
 * Tables and sizes stand before this text; PREFIX is the name of the observer. */

static void begin_thresholds(PREFIX_thresholds *state, int again)
{
    int i;
    for (i = 0; i < P * NZ; i++) state->psi[i] = 0.0;
    for (i = 0; i < L * W; i++) state->ring[i] = 0.0;
    for (i = 0; i < L * NZ; i++) state->eps[i] = 0.0;
    for (i = 0; i < NR; i++) state->largest[i] = i == NR - 1 ? 1.0 : 0.0;
    state->at = 0;
    state->again = again;
    state->k = 0;
}

void PREFIX_thresholds_reset(PREFIX_thresholds *state) { begin_thresholds(state, 0); }

static int are_finite(const double *values, int n)
{
    int i;
    for (i = 0; i < n; i++) {
        if (!isfinite(values[i])) {
            return 0;
        }
    }
    return 1;
}

static double size_of(double value) { return value < 0.0 ? -value : value; }

void PREFIX_thresholds_step(PREFIX_thresholds *state, const double *u, const double *y, const double *rows,
                            double *total)
{
    double v[NV + 1], seen[ROWS + NO + 1], moved[ROWS + 1], middle[ROWS + NO + 1], first[NO + 1], shift[NO + 1];
    double next[NZ + 1], known[W + 1], older[M + NO + NZ], fixed[M + NO + 1], h[W + 1], channels[M + 1];
    const double *start, *later;
    int known_start;
    int i, j, p, r;
    if (!(are_finite(u, NU) && are_finite(y, NY) && are_finite(rows, OUT))) {
        /* What was missing has left an error of its own: the bounds begin again, as after a later start. */
        begin_thresholds(state, 1);
        for (i = 0; i < NO; i++) total[i] = HUGE_VAL;
        return;
    }
    known_start = state->k < (state->again ? AGAIN : START);
    start = thresholds_start[(state->again ? AGAIN_AT : 0) + (known_start ? state->k : 0)];
    later = thresholds_later[state->again ? LATER_AT : 0];
    for (i = 0; i < N; i++) {
        v[i] = 0.0;
        for (j = 0; j < OUT; j++) v[i] += thresholds_reading[i][j] * rows[j];
    }
    for (i = 0; i < NU; i++) v[N + i] = u[i];
    for (i = 0; i < ROWS; i++) moved[i] = 0.0;
    for (i = 0; i < NO; i++) first[i] = 0.0;
    for (i = 0; i < ROWS + NO; i++) middle[i] = 0.0;
    for (p = 0; p < P; p++) {
        double *psi = state->psi + p * NZ;
        for (r = 0; r < ROWS + NO; r++) {
            seen[r] = 0.0;
            for (j = 0; j < NV; j++) seen[r] += thresholds_drive[p * (NZ + ROWS + NO) + NZ + r][j] * v[j];
            for (j = 0; j < NZ; j++) seen[r] += thresholds_shown[r][j] * psi[j];
            middle[r] += thresholds_offsets[0][p] * seen[r];
            if (r < ROWS) moved[r] += size_of(seen[r]);
            else first[r - ROWS] += size_of(seen[r]);
        }
        for (r = 0; r < NZ; r++) {
            next[r] = 0.0;
            for (j = 0; j < NZ; j++) next[r] += thresholds_Az[r][j] * psi[j];
            for (j = 0; j < NV; j++) next[r] += thresholds_drive[p * (NZ + ROWS + NO) + r][j] * v[j];
        }
        for (r = 0; r < NZ; r++) psi[r] = next[r];
    }
    for (r = 0; r < ROWS; r++) moved[r] += size_of(middle[r]);
    for (r = 0; r < NO; r++) shift[r] = size_of(middle[ROWS + r]);
    for (i = 0; i < NU; i++) if (size_of(u[i]) > state->largest[i]) state->largest[i] = size_of(u[i]);
    for (i = 0; i < NY; i++) if (size_of(y[i]) > state->largest[NU + i]) state->largest[NU + i] = size_of(y[i]);
    for (i = 0; i < N; i++) if (size_of(v[i]) > state->largest[NU + NY + i]) state->largest[NU + NY + i] = size_of(v[i]);
    /* What the error does, and what the estimates do, through each channel; rows from SINGLE on share one. */
    for (i = 0; i < W; i++) known[i] = 0.0;
    for (i = 0; i < M; i++) channels[i] = 0.0;
    for (r = 0; r < ROWS; r++) {
        double value = 0.0;
        i = r < SINGLE ? r : SINGLE;
        if (moved[r] > channels[i]) channels[i] = moved[r];
        for (j = 0; j < N; j++) value += thresholds_channels[r][j] * v[j];
        if (r >= OWN && size_of(value) > known[i]) known[i] = size_of(value);
    }
    for (i = 0; i < DRIVEN; i++) known[M + i] = size_of(u[(int)thresholds_driven[0][i]]);
    for (i = 0; i < M + NO + NZ; i++) older[i] = 0.0;
    for (j = 0; j < L; j++) {
        const double *sample = state->ring + ((state->at + j) % L) * W;
        for (p = 0; p < W; p++)
            for (i = 0; i < M + NO + NZ; i++) older[i] += sample[p] * thresholds_kernels[j * W + p][i];
    }
    for (i = 0; i < M + NO + NZ; i++)
        for (j = 0; j < NZ; j++) older[i] += thresholds_tail[i][j] * state->eps[state->at * NZ + j];
    for (i = 0; i < M + NO; i++) {
        fixed[i] = 0.0;
        for (j = 0; j < NR; j++) fixed[i] += thresholds_rounding[i][j] * state->largest[j];
    }
    for (i = 0; i < M; i++) {
        h[i] = known[i] + older[i] + fixed[i] + thresholds_nominal[0][i];
        h[i] += known_start ? start[i] : 0.0;
        for (p = 0; p < W; p++) h[i] += known[p] * thresholds_same[p][i];
        for (p = 0; p < M; p++) h[i] += thresholds_solved[i][p] * channels[p];
        if (!known_start) {
            double left = 1.0;
            for (p = 0; p < state->k / L && p < 200; p++) left *= THETA;
            h[i] += left * later[i];
        }
    }
    for (i = M; i < W; i++) h[i] = known[i];
    for (i = 0; i < NO; i++) {
        double sum = thresholds_nominal[0][M + i] + first[i] + shift[i] + older[M + i] + fixed[M + i];
        double left = 1.0;
        if (known_start) sum += start[M + i];
        else {
            for (p = 0; p < state->k / L && p < 200; p++) left *= THETA;
            sum += left * later[M + i];
        }
        for (p = 0; p < W; p++) sum += h[p] * thresholds_same[p][M + i];
        total[i] = sum * ROUNDED;
    }
    for (i = 0; i < W; i++) state->ring[state->at * W + i] = h[i];
    for (i = 0; i < NZ; i++) state->eps[state->at * NZ + i] = older[M + NO + i];
    state->at = (state->at + 1) % L;
    if (state->k < 1000000000L) state->k++;
}
