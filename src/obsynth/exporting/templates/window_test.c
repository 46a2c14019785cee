void PREFIX_reset(PREFIX_state *state)
{
    int i;
    state->at = state->rows = 0;
    for (i = 0; i < WIDTH; i++) {
        state->largest[i] = 0.0;
    }
}

SIGNATURE
{
    double *newest = state->window[state->at];
    double most = 1.0;
    int i, j, k, alarm = 0;
    COPY_INPUTS
    for (i = NU; i < WIDTH; i++) {
        newest[i] = y[i - NU];
    }
    state->rows = state->rows < LENGTH ? state->rows + 1 : LENGTH;
    for (i = 0; i < WIDTH; i++) {
        if (!isfinite(newest[i])) {
            state->rows = 0;
        } else if (fabs(newest[i]) > state->largest[i]) {
            state->largest[i] = fabs(newest[i]);
        }
    }
    for (k = 0; k < TESTS; k++) {
        double sum = constants[0][k], threshold = limits[0][k];
        for (i = 0; i < WIDTH; i++) {
            threshold += rounding[k][i] * state->largest[i];
        }
        for (j = 0; j < LENGTH && state->rows == LENGTH; j++) {
            const double *sample = state->window[(state->at + LENGTH - j) % LENGTH];
            const double *weight = weights[k] + j * WIDTH;
            for (i = 0; i < WIDTH; i++) {
                sum += weight[i] * sample[i];
            }
        }
        values[k] = state->rows == LENGTH ? sum : NAN;
        thresholds[k] = threshold;
        if (state->rows == LENGTH && fabs(sum) > most * threshold) {
            most = threshold > 0.0 ? fabs(sum) / threshold : HUGE_VAL;
            alarm = k + 1;
        }
    }
    state->at = (state->at + 1) % LENGTH;
    return alarm;
}
