
static void monitor_reset(PREFIX_monitor *m)
{
    int k;
    m->statistic = m->norm = m->threshold = NAN;
    m->alarm = m->has_before = 0;
    m->fault = -1;
    m->limit = HUGE_VAL;
    for (k = 0; k < BOUNDS; k++) {
        m->size[k] = bound_starts[0][k] < 0 ? 0 : bound_starts[0][k];
        m->share[k] = bound_starts[0][k] < 0 ? 1 : 0;
    }
}

/* Add a matrix times a vector to a sum. */
static void monitor_add(const REAL *matrix, int rows, int columns, REAL factor, const REAL *x, REAL *sum)
{
    int i, j;
    for (i = 0; i < rows; i++) {
        for (j = 0; j < columns; j++) {
            sum[i] += factor * matrix[i * columns + j] * x[j];
        }
    }
}

/* The norm of a matrix times a vector. */
static REAL monitor_norm_of(const REAL *matrix, int rows, int columns, const REAL *x)
{
    REAL total = 0;
    int i, j;
    for (i = 0; i < rows; i++) {
        REAL sum = 0;
        for (j = 0; j < columns; j++) {
            sum += matrix[i * columns + j] * x[j];
        }
        total += sum * sum;
    }
    return sqrt(total);
}

/* The norm of a vector in the units of the states. */
static REAL monitor_size_of(const REAL *x)
{
    REAL total = 0;
    int i;
    for (i = 0; i < MOTIONS; i++) {
        total += (x[i] / motion_units[0][i]) * (x[i] / motion_units[0][i]);
    }
    return sqrt(total);
}

/* By how much each weight may differ from that at this row since the row before: parameters stay between their values
 * at both. */
static void monitor_turned(const PREFIX_monitor *m, const REAL *parameters, const REAL *weights, REAL *turned)
{
    int i, changed = 0;
    for (i = 0; i < PARAMETERS; i++) {
        changed = changed || m->parameters[i] != parameters[i];
    }
    for (i = 0; i < VERTICES; i++) {
        turned[i] = changed ? fabs(m->weights[i] - weights[i]) : 0;
    }
#if !GIVES_WEIGHTS
    if (changed) {
        REAL least[VERTICES], most[VERTICES];
        int j, count = 1;
        least[0] = most[0] = 1;
        for (i = 0; i < FUNCTIONS; i++) {
            const REAL now = parameters[function_places[i]], before = m->parameters[function_places[i]];
            const REAL width = bounds[i][1] - bounds[i][0];
            const REAL one = fmin(fmax((fmin(now, before) - bounds[i][0]) / width, 0), 1);
            const REAL other = fmin(fmax((fmax(now, before) - bounds[i][0]) / width, 0), 1);
            for (j = count - 1; j >= 0; j--) {
                const REAL lower = least[j], upper = most[j];
                least[2 * j] = lower * (1 - other);
                least[2 * j + 1] = lower * one;
                most[2 * j] = upper * (1 - one);
                most[2 * j + 1] = upper * other;
            }
            count *= 2;
        }
        for (i = 0; i < VERTICES; i++) {
            turned[i] = fmax(fmax(most[i] - weights[i], weights[i] - least[i]), 0) * OUTWARD;
        }
    }
#endif
}

/* What a step of the observer misses of the plant's own motion since the row before, and the bound of the error after
 * it, in the norm of each Lyapunov matrix. */
static void monitor_advance(PREFIX_monitor *m, const REAL *states, const REAL *u, const REAL *weights,
                            const REAL *turned)
{
    const REAL h = UPPER_DT;
    REAL v[MOTIONS] = {0}, slope[MOTIONS] = {0}, moved[LENGTH(U_COUNT)], missed[BOUNDS] = {0}, spread = SLOPE_OF_NOISE;
    int i, k, at;
    monitor_add(&motion_estimated[0][0], MOTIONS, STATE_COUNT, 1, states, v);
    for (i = 0; i < U_COUNT; i++) {
        moved[i] = fabs(u[i] - m->u[i]);
        spread += moved[i] * slope_of_inputs[0][i];
        for (k = 0; k < BOUNDS; k++) {
            missed[k] += h * moved[i] * drive_of_inputs[k][i];
        }
    }
    for (at = 0; at < VERTICES; at++) {
        monitor_add(motion_A[at * MOTIONS], MOTIONS, MOTIONS, weights[at], v, slope);
        monitor_add(motion_B[at * MOTIONS], MOTIONS, U_COUNT, weights[at], u, slope);
    }
    for (at = 0; at < VERTICES; at++) {
        REAL turns[MOTIONS] = {0}, curve[MOTIONS] = {0};
        if (turned[at] == 0) {
            continue;
        }
        monitor_add(turned_A[at * MOTIONS], MOTIONS, MOTIONS, 1, v, turns);
        monitor_add(turned_B[at * MOTIONS], MOTIONS, U_COUNT, 1, u, turns);
        monitor_add(turned_A[at * MOTIONS], MOTIONS, MOTIONS, 1, slope, curve);
        spread += turned[at] * monitor_size_of(turns);
        for (k = 0; k < BOUNDS; k++) {
            missed[k] += h * turned[at]
                         * (monitor_norm_of(drive[k * Z_COUNT], Z_COUNT, MOTIONS, turns) + turned_noise[k][at]);
            missed[k] += SECOND_ORDER * turned[at] * monitor_norm_of(drive[k * Z_COUNT], Z_COUNT, MOTIONS, curve);
        }
    }
    for (k = 0; k < BOUNDS; k++) {
        REAL curve[MOTIONS] = {0}, own = drifts[0][k] * (SECOND_ORDER + THIRD_ORDER) * slopes_of_error[0][k], left;
        for (at = 0; at < VERTICES; at++) {
            monitor_add(motion_A[at * MOTIONS], MOTIONS, MOTIONS, weights[at], slope, curve);
            own += h * turned[at] * turned_error[k][at];
        }
        missed[k] += SECOND_ORDER * monitor_norm_of(drive[k * Z_COUNT], Z_COUNT, MOTIONS, curve);
        missed[k] += drifts[0][k] * ((SECOND_ORDER + THIRD_ORDER) * spread + THIRD_ORDER * monitor_size_of(slope));
        left = 1 + decays[0][k] * h - own * OUTWARD;
        m->size[k] = left > 0 ? (m->size[k] + (missed[k] + h * driven[0][k]) * OUTWARD) / left * OUTWARD : HUGE_VAL;
        m->share[k] = left > 0 ? m->share[k] * OUTWARD / left : HUGE_VAL;
    }
}

/* Follow the bounds of the error over one row; a row that is not claimed begins again, with an error of which nothing
 * is known. */
static void monitor_follow(PREFIX_monitor *m, int deciding, const REAL *states, const REAL *u, const REAL *parameters,
                           const REAL *weights)
{
    REAL turned[VERTICES];
    int i, k;
    m->limit = HUGE_VAL;
    if (!deciding) {
        m->has_before = 0;
        for (k = 0; k < BOUNDS; k++) {
            m->size[k] = 0;
            m->share[k] = 1;
        }
        return;
    }
    if (m->has_before) {
        monitor_turned(m, parameters, weights, turned);
        monitor_advance(m, states, u, weights, turned);
    }
    for (k = 0; k < BOUNDS; k++) {
        if (m->share[k] <= FORGOTTEN_SHARE) {
            m->limit = fmin(m->limit, gains[0][k] * m->size[k]);
        }
        if (!isfinite(m->size[k])) {
            /* A bound that was lost begins again. */
            m->size[k] = 0;
            m->share[k] = 1;
        }
    }
    m->limit = (m->limit + AT_ONCE) * OUTWARD;
    m->has_before = 1;
    for (i = 0; i < U_COUNT; i++) {
        m->u[i] = u[i];
    }
    for (i = 0; i < PARAMETERS; i++) {
        m->parameters[i] = parameters[i];
    }
    for (i = 0; i < VERTICES; i++) {
        m->weights[i] = weights[i];
    }
}

/* Take one row of estimates after its limit has followed; without one nothing is decided. */
static void monitor_take(PREFIX_monitor *m, int deciding, const REAL *faults, const REAL *residuals)
{
    monitor_decide(m, deciding && isfinite(m->limit), m->limit, faults, residuals);
}
