
/* Outliers, resets and bounds on states, around a plain step. */

/* Take a sample; where innovations have become too large, again with parameters known no better than at first. */
static int watched(const struct observer *state, const double *u, const double *variances, const double *y,
                   struct observer *after, double *said)
{
#if RESETS
    int i, degrees = 0;
#endif
    *after = *state;
    if (attempt(state->memory, state, u, variances, y, after->memory, said) != 0) {
        return 2;
    }
#if RESETS
    for (i = 0; i < NY; i++) {
        degrees += !isnan(y[i]);
    }
    if (state->k > 0) {
        double total = 0.0;
        int all = 0;
        if (after->watched == RESET_WINDOW) {
            copy(after->surprises, state->surprises + 2, 2 * (RESET_WINDOW - 1));
            after->watched--;
        }
        after->surprises[2 * after->watched] = said[AT_NIS];
        after->surprises[2 * after->watched + 1] = degrees;
        after->watched++;
        for (i = 0; i < after->watched; i++) {
            total += after->surprises[2 * i];
            all += (int)after->surprises[2 * i + 1];
        }
        if (all > 0 && !(total <= RESET_LIMITS[all])) {
            double respread[MEMORY];
            copy(respread, state->memory, MEMORY);
            copy(respread + AT_SPREAD, START + AT_SPREAD, NQ * NQ);
#if AT_CROSS >= 0
            copy(respread + AT_CROSS, START + AT_CROSS, NX * NQ);
#else
            copy(respread + AT_S, START + AT_S, NQ * NQ);
#endif
            if (attempt(respread, state, u, variances, y, after->memory, said) != 0) {
                return 2;
            }
            after->watched = 0;
            after->resets++;
        }
    }
#endif
    return 0;
}

#if OUTLIERS || BOUNDS
/* Factor L of a symmetric matrix M = L L' of n rows; 0 where one depends on those before, but for such a share. */
static int factored(const double *M, int n, double dependent, double *L)
{
    int i, j, k;
    for (i = 0; i < n; i++) {
        for (j = 0; j <= i; j++) {
            double sum = M[i * n + j];
            for (k = 0; k < j; k++) {
                sum -= L[i * n + k] * L[j * n + k];
            }
            if (i == j) {
                if (!(sum > dependent * M[i * n + i])) {
                    return 0;
                }
                L[i * n + i] = sqrt(sum);
            } else {
                L[i * n + j] = sum / L[j * n + j];
            }
        }
    }
    return 1;
}

/* Put the solution of L L' s = x in the place of x. */
static void substituted(const double *L, int n, double *x)
{
    int i, k;
    for (i = 0; i < n; i++) {
        for (k = 0; k < i; k++) {
            x[i] -= L[i * n + k] * x[k];
        }
        x[i] /= L[i * n + i];
    }
    for (i = n - 1; i >= 0; i--) {
        for (k = i + 1; k < n; k++) {
            x[i] -= L[k * n + i] * x[k];
        }
        x[i] /= L[i * n + i];
    }
}
#endif

#if OUTLIERS
/* Mean and covariance of outputs, from what is remembered alone. */
static int forecasted(const struct observer *state, const double *u, const double *variances, double *mean,
                      double *covariance)
{
    double nothing[NY];
    double after[MEMORY];
    double said[ROW];
    const double *inputs[2];
    double *outputs[2];
    int i;
    for (i = 0; i < NY; i++) {
        nothing[i] = NAN;
    }
    if (attempt(state->memory, state, u, variances, nothing, after, said) != 0) {
        return 2;
    }
    inputs[0] = after;
    inputs[1] = said;
    outputs[0] = mean;
    outputs[1] = covariance;
    return call(forecast, inputs, 2, outputs, 2) == 0 ? 0 : 2;
}

/* How far each sample is from what all others of its row say of it, and the deviation of that; `off`: from its
   prediction, NaN where it is missing. */
static void beside_others(const double *off, const double *covariance, double *apart, double *deviation)
{
    double M[NY * NY] = {0};
    double L[NY * NY];
    double column[NY];
    double sizes[NY];
    int at[NY];
    int n = 0;
    int i, j;
    for (i = 0; i < NY; i++) {
        apart[i] = deviation[i] = NAN;
        sizes[i] = sqrt(covariance[i * (NY + 1)]);
        if (!isnan(off[i])) {
            at[n++] = i;
        }
    }
    for (i = 0; i < n; i++) {
        for (j = 0; j < n; j++) {
            M[i * n + j] = covariance[at[i] * NY + at[j]] / (sizes[at[i]] * sizes[at[j]]);
        }
    }
    if (!factored(M, n, 0.0, L)) {
        return;
    }
    for (i = 0; i < n; i++) {
        double total = 0.0;
        for (j = 0; j < n; j++) {
            column[j] = i == j ? 1.0 : 0.0;
        }
        substituted(L, n, column);
        for (j = n - 1; j >= 0; j--) {
            total += column[j] * off[at[j]] / sizes[at[j]];
        }
        apart[at[i]] = sizes[at[i]] * total / column[i];
        deviation[at[i]] = sizes[at[i]] / sqrt(column[i]);
    }
}

/* Whether a sample goes on with what was off before: with what was believed, or as far as the one that was left out:
   after LONGEST_REFUSAL of them, or on its side where the sensor's outliers are not known to be further off than `most`,
   which is as far as any sample is. */
static int follows(const struct observer *state, int i, double off, double most)
{
    double size = fabs(off);
    double left = state->left_out[i];
    double believed = state->believed[i];
    double other = fabs(left);
    int in_a_row = state->in_a_row[i] < 0 ? -state->in_a_row[i] : state->in_a_row[i];
    int on = (believed > 0.0 ? off : -off) > 0.0 && size <= COMPARABLE * fabs(believed);
    int like = other > 0.0 && size <= COMPARABLE * other && other <= COMPARABLE * size;
    int on_its_side = (left > 0.0 ? off : -off) > 0.0 && !(OUTLIER_SIZES[i] > FAR_OUT * most);
    return on || (like && (on_its_side || in_a_row >= LONGEST_REFUSAL));
}

/* Remember of a sample that is there how far off it was, and whether it was left out (or pulled). */
static void remember(const struct observer *state, struct observer *after, int i, int is_far, int is_gone, double off)
{
    int in_a_row = state->in_a_row[i] < 0 ? -state->in_a_row[i] : state->in_a_row[i];
    after->in_a_row[i] = is_far ? (off < 0.0 ? -1 : 1) * (in_a_row + 1) : 0;
    after->left_out[i] = !is_far ? 0.0 : is_gone ? off : state->left_out[i];
    after->believed[i] = !is_far ? 0.0 : is_gone ? state->believed[i] : off;
    after->refused[i] = state->refused[i] + is_gone;
}

/* Take a step; where its innovation is too long, ask each sensor and take the step again without the outliers. */
static int robust(const struct observer *state, const double *u, const double *variances, int is_missing,
                  const double *y, double *received, struct observer *after, double *said)
{
    double none[LENGTH(NU)];
    double mean[NY];
    double covariance[NY * NY];
    double off[NY];
    double apart[NY];
    double deviation[NY];
    double worst = 0.0;
    int accused = -1;
    int any_far = 0;
    int far[NY];
    int gone[NY];
    int failed, any = 0;
    int wary[NY];
    int is_back = 0;
    int any_wary = 0;
    int i;
    copy(received, y, NY);
    for (i = 0; i < NU; i++) {
        is_back = is_back || state->inputs[5 * i + 3] > 0.0;
    }
    /* What the inputs may have been meanwhile makes deviations so large that an outlier would pass once they are known
       again: what is as far off as outliers of its sensor are waits until others go on with it. */
    for (i = 0; i < NY; i++) {
        wary[i] = GATE && OUTLIER_SIZES[i] > 0.0 && (is_back || state->left_out[i] != 0.0) && !is_missing;
        any_wary = any_wary || wary[i];
    }
    failed = watched(state, u, variances, y, after, said);
    if (!failed && !is_missing && !any_wary && said[AT_NIS] <= OUTLIER_LIMIT * OUTLIER_LIMIT) {
        for (i = 0; i < NY; i++) {
            if (!isnan(y[i])) {
                remember(state, after, i, 0, 0, 0.0);
            }
        }
        return 0;
    }
    /* Where inputs are missing, samples are judged by the inputs as they last were: what these exclude may be wrong, or
       the inputs have moved. It counts once the next sample goes on with it, however near it is. */
    for (i = 0; i < LENGTH(NU); i++) {
        none[i] = 0.0;
    }
    if (forecasted(state, u, is_missing ? none : variances, mean, covariance) != 0) {
        return 2;
    }
    for (i = 0; i < NY; i++) {
        double most = OUTLIER_LIMIT * sqrt(covariance[i * (NY + 1)]);
        off[i] = y[i] - mean[i];
        any_far = any_far || fabs(off[i]) > (most < OUTLIER_SIZES[i] && !is_missing ? OUTLIER_SIZES[i] : most)
                  || fabs(y[i]) > OVERFLOW_LIMIT;
    }
    /* Where the model excludes no sample, the others of its row judge: what a fault may have done makes deviations large,
       but it moves all sensors together. Of those that accuse each other, the worst alone. */
    beside_others(off, covariance, apart, deviation);
    if (!any_far) {
        for (i = 0; i < NY; i++) {
            if (fabs(apart[i]) / deviation[i] > worst) {
                worst = fabs(apart[i]) / deviation[i];
                accused = i;
            }
        }
        if (accused >= 0 && !(worst > OUTLIER_LIMIT && (is_missing || fabs(apart[accused]) > OUTLIER_SIZES[accused]))) {
            accused = -1;
        }
    }
    for (i = 0; i < NY; i++) {
        int huge = fabs(y[i]) > OVERFLOW_LIMIT;
        double most = OUTLIER_LIMIT * (i == accused ? deviation[i] : sqrt(covariance[i * (NY + 1)]));
        double reach = most < OUTLIER_SIZES[i] && !is_missing ? OUTLIER_SIZES[i] : most;
        double pulled;
        if (i == accused) {
            mean[i] = y[i] - apart[i];
        }
        /* A second that is where the first was, and no further than it may be, goes on with it at once; so does one that
           is where the others of its row say. */
        int again = state->left_out[i] != 0.0 && fabs(y[i] - mean[i]) <= reach
                    && fabs(y[i] - mean[i] - state->left_out[i]) <= OUTLIER_SIZES[i];
        reach = wary[i] && !again && !(fabs(apart[i]) <= OUTLIER_SIZES[i]) ? OUTLIER_SIZES[i] : reach;
        pulled = mean[i] + reach * (y[i] > mean[i] ? 1.0 : -1.0);
        far[i] = fabs(y[i] - mean[i]) > reach || huge;
        off[i] = y[i] - mean[i];
        /* A wrong sample stands alone; of a sensor, or a plant, that has moved the next is on the same side, as far off. */
        gone[i] = far[i] && (!GATE || !follows(state, i, off[i], most) || huge);
        if (gone[i]) {
            received[i] = !GATE && isfinite(pulled) ? pulled : NAN;
        }
        any = any || gone[i];
    }
    if (failed || any) {
        if (watched(state, u, variances, received, after, said) != 0) {
            /* A sample that nothing predicts, and with which there is no step. */
            for (i = 0; i < NY; i++) {
                gone[i] = !isnan(y[i]);
                received[i] = NAN;
            }
            if (watched(state, u, variances, received, after, said) != 0) {
                return 2;
            }
        }
    }
    for (i = 0; i < NY; i++) {
        if (!isnan(y[i])) {
            remember(state, after, i, far[i], gone[i], off[i]);
        }
    }
    return 0;
}
#endif

#if BOUNDS
/* Solve M s = right on chosen rows by Cholesky; 0 where they are dependent. */
static int chosen_solution(const double *M, const double *right, const int *chosen, double *s)
{
    double part[BOUNDS * BOUNDS] = {0};
    double L[BOUNDS * BOUNDS];
    double x[BOUNDS];
    int at[BOUNDS];
    int n = 0;
    int i, j;
    for (i = 0; i < BOUNDS; i++) {
        if (chosen[i]) {
            at[n++] = i;
        }
    }
    for (i = 0; i < n; i++) {
        x[i] = right[at[i]];
        for (j = 0; j < n; j++) {
            part[i * n + j] = M[at[i] * BOUNDS + at[j]];
        }
    }
    if (!factored(part, n, DEPENDENT, L)) {
        return 0;
    }
    substituted(L, n, x);
    for (i = 0; i < n; i++) {
        s[at[i]] = x[i];
    }
    return 1;
}

/* Weights of the bounds that keep all of them at the least cost: M weights >= right, with equality where a weight is
   not zero (the active sets of Lawson and Hanson 1974, 23.3). */
static void nonnegative(const double *M, const double *right, double *weights)
{
    double s[BOUNDS];
    int chosen[BOUNDS];
    int banned[BOUNDS];
    int rounds, i, j;
    for (i = 0; i < BOUNDS; i++) {
        weights[i] = 0.0;
        chosen[i] = banned[i] = 0;
    }
    for (rounds = 0; rounds < 6 * BOUNDS; rounds++) {
        int best = -1;
        double most = 0.0;
        for (i = 0; i < BOUNDS; i++) {
            double slope = right[i];
            for (j = 0; j < BOUNDS; j++) {
                slope -= M[i * BOUNDS + j] * weights[j];
            }
            if (!chosen[i] && !banned[i] && slope > DEPENDENT * (fabs(right[i]) + 1.0) && slope > most) {
                most = slope;
                best = i;
            }
        }
        if (best < 0) {
            return;
        }
        chosen[best] = 1;
        if (!chosen_solution(M, right, chosen, s)) {
            chosen[best] = 0;
            banned[best] = 1;
            continue;
        }
        for (;;) {
            double share = 1.0;
            int blocking = -1;
            for (i = 0; i < BOUNDS; i++) {
                if (chosen[i] && s[i] <= 0.0) {
                    double reach = weights[i] / (weights[i] - s[i]);
                    if (blocking < 0 || reach < share) {
                        share = reach;
                        blocking = i;
                    }
                }
            }
            for (i = 0; i < BOUNDS; i++) {
                if (chosen[i]) {
                    weights[i] += share * (s[i] - weights[i]);
                }
            }
            if (blocking < 0) {
                break;
            }
            weights[blocking] = 0.0;
            chosen[blocking] = 0;
            if (!chosen_solution(M, right, chosen, s)) {
                break;
            }
        }
    }
}

/* Project the states after a measurement onto their bounds, in the metric of their covariance. */
static void project_onto_bounds(struct observer *state, const double *said)
{
    double M[BOUNDS * BOUNDS];
    double gaps[BOUNDS];
    double sizes[BOUNDS];
    double weights[BOUNDS];
    double moved[NX];
    double *x = state->memory + AT_POSTERIOR;
    const double *P = said + AT_COVARIANCE;
    int outside = 0;
    int kept = 1;
    int i, j;
    for (i = 0; i < BOUNDS; i++) {
        outside = outside || BOUND_SIGNS[i] * x[BOUND_STATES[i]] < BOUND_SIGNS[i] * BOUND_ENDS[i];
    }
    if (!outside) {
        return;
    }
    for (i = 0; i < BOUNDS; i++) {
        long a = BOUND_STATES[i];
        sizes[i] = sqrt(fmax(P[a * (NX + 1)], 0.0));
        gaps[i] = sizes[i] > 0.0 ? BOUND_SIGNS[i] * (BOUND_ENDS[i] - x[a]) / sizes[i] : 0.0;
    }
    for (i = 0; i < BOUNDS; i++) {
        for (j = 0; j < BOUNDS; j++) {
            long a = BOUND_STATES[i], b = BOUND_STATES[j];
            double both = 0.5 * (P[a + b * NX] + P[b + a * NX]) * BOUND_SIGNS[i] * BOUND_SIGNS[j];
            double used = sizes[i] > 0.0 && sizes[j] > 0.0;
            M[i * BOUNDS + j] = used ? both / (sizes[i] * sizes[j]) : 0.0;
        }
    }
    nonnegative(M, gaps, weights);
    for (i = 0; i < BOUNDS; i++) {
        double left = gaps[i];
        for (j = 0; j < BOUNDS; j++) {
            left -= M[i * BOUNDS + j] * weights[j];
        }
        kept = kept && left <= SLACK * (fabs(gaps[i]) + 1.0);
    }
    for (i = 0; i < NX; i++) {
        moved[i] = x[i];
        for (j = 0; j < BOUNDS; j++) {
            long b = BOUND_STATES[j];
            /* Where no move keeps all of them, a state that is known exactly stands in the way. */
            if (kept && weights[j] > 0.0) {
                moved[i] += 0.5 * (P[i + b * NX] + P[b + i * NX]) * BOUND_SIGNS[j] * weights[j] / sizes[j];
            }
        }
    }
    copy(x, moved, NX);
    for (i = 0; i < BOUNDS; i++) {
        long a = BOUND_STATES[i];
        x[a] = BOUND_SIGNS[i] > 0.0 ? fmax(x[a], BOUND_ENDS[i]) : fmin(x[a], BOUND_ENDS[i]);
    }
#if AT_CROSS >= 0
    copy(state->memory + AT_X, x, NX);
#endif
}
#endif

static void reset(struct observer *state)
{
    int i;
    copy(state->memory, START, MEMORY);
    for (i = 0; i < NU; i++) {
        state->u[i] = 0.0;
    }
    for (i = 0; i < 5 * NU; i++) {
        state->inputs[i] = 0.0;
    }
    for (i = 0; i < NY; i++) {
        state->in_a_row[i] = 0;
        state->left_out[i] = 0.0;
        state->believed[i] = 0.0;
        state->refused[i] = 0;
    }
    state->k = 0;
    state->watched = 0;
    state->resets = 0;
}

/* Take one sample by all that the observer does with it; `received` is what was used of it. */
static int taken(const struct observer *state, const double *u, const double *y, double *received, struct observer *after,
                 double *said)
{
    double used[LENGTH(NU)];
    double variances[LENGTH(NU)];
    double history[5 * LENGTH(NU)];
#if OUTLIERS
    int is_missing = 0;
    int i;
    for (i = 0; i < NU; i++) {
        is_missing = is_missing || isnan(u[i]);
    }
#endif
    take_inputs(state, u, used, variances, history);
#if OUTLIERS
    if (robust(state, used, variances, is_missing, y, received, after, said) != 0) {
        return 2;
    }
#else
    copy(received, y, NY);
    if (watched(state, used, variances, y, after, said) != 0) {
        return 2;
    }
#endif
#if BOUNDS
    project_onto_bounds(after, said);
#endif
    copy(after->u, used, NU);
    copy(after->inputs, history, 5 * NU);
    after->k = state->k + 1;
    return 0;
}

/* Whether sample k can be taken: inputs and outputs are finite or missing, but for inputs of the first one. */
static int is_sample(long k, const double *u, const double *y)
{
    int i;
    for (i = 0; i < NY; i++) {
        if (isinf(y[i])) {
            return 0;
        }
    }
    for (i = 0; i < NU; i++) {
        if (isinf(u[i]) || (k == 0 && isnan(u[i]))) {
            return 0;
        }
    }
    return 1;
}

#if WAITS
static void begin(struct waiting *state)
{
    reset(&state->latest);
    state->kept = 0;
}

static const struct observer *latest_of(const struct waiting *state)
{
    return &state->latest;
}

/* Take a row as it arrives: what is late is put where it belongs, and all samples from there are taken again. */
static int advance(struct waiting *state, const double *u, const double *y, double *received, double *said)
{
    struct waiting after = *state;
    struct observer at;
    int kept = state->kept;
    int earliest = kept;
    int dropped = kept + 1 > LATEST ? kept + 1 - LATEST : 0;
    int i, t;
    if (!is_sample(state->latest.k, u, y)) {
        return 1;
    }
    after.before[kept] = state->latest;
    copy(after.u + kept * NU, u, NU);
    for (i = 0; i < NY; i++) {
        long row = state->latest.k - DELAYS[i];
        int place = kept - (int)DELAYS[i];
        double value = row >= 0 && row % EVERY[i] == 0 ? y[i] : NAN;
        after.y[kept * NY + i] = DELAYS[i] == 0 ? value : NAN;
        if (DELAYS[i] > 0 && place >= 0 && !isnan(value)) {
            after.y[place * NY + i] = value;
            earliest = place < earliest ? place : earliest;
        }
    }
    for (t = earliest; t <= kept; t++) {
        if (taken(&after.before[t], after.u + t * NU, after.y + t * NY, received, &at, said) != 0) {
            return 2;
        }
        if (t < kept) {
            after.before[t + 1] = at;
        }
    }
    for (t = dropped; t <= kept; t++) {
        after.before[t - dropped] = after.before[t];
        copy(after.u + (t - dropped) * NU, after.u + t * NU, NU);
        copy(after.y + (t - dropped) * NY, after.y + t * NY, NY);
    }
    after.latest = at;
    after.kept = kept + 1 - dropped;
    *state = after;
    return 0;
}
#else
static void begin(struct observer *state)
{
    reset(state);
}

static const struct observer *latest_of(const struct observer *state)
{
    return state;
}

/* Take one sample: 0; 1 if a number is infinite, or an input of the first sample missing; 2 if the step has no solution. */
static int advance(struct observer *state, const double *u, const double *y, double *received, double *said)
{
    struct observer after;
    if (!is_sample(state->k, u, y)) {
        return 1;
    }
    if (taken(state, u, y, received, &after, said) != 0) {
        return 2;
    }
    *state = after;
    return 0;
}
#endif
