
typedef int (*generated)(const double **arg, double **res, int *iw, double *w, int mem);

static void copy(double *to, const double *from, int n)
{
    int i;
    for (i = 0; i < n; i++) {
        to[i] = from[i];
    }
}

static int all_finite(const double *values, int n)
{
    int i;
    for (i = 0; i < n; i++) {
        if (!isfinite(values[i])) {
            return 0;
        }
    }
    return 1;
}

static int call(generated f, const double **inputs, int n_in, double **outputs, int n_out)
{
    const double *arg[WORK_ARG];
    double *res[WORK_RES];
    int iw[WORK_IW];
    double w[WORK_W];
    int i;
    for (i = 0; i < n_in; i++) {
        arg[i] = inputs[i];
    }
    for (i = 0; i < n_out; i++) {
        res[i] = outputs[i];
    }
    return f(arg, res, iw, w, 0);
}

/* A point of Newton's iteration: the unknowns, and there the residual, the scale of its rows, and the Newton step. */
struct point {
    double X[NX * STAGES];
    double value[NX * STAGES];
    double rows[NX * STAGES];
    double move[NX * STAGES];
};

static void evaluate(generated f, struct point *at, const double *x, const double *u, const double *theta)
{
    const double *inputs[4];
    double *outputs[3];
    inputs[0] = at->X;
    inputs[1] = x;
    inputs[2] = u;
    inputs[3] = theta;
    outputs[0] = at->value;
    outputs[1] = at->rows;
    outputs[2] = at->move;
    if (call(f, inputs, 4, outputs, 3) != 0) {
        at->move[0] = NAN;
    }
}

/* The largest residual in the scale of given rows; not a number where one is. */
static double largest(const double *rows, const double *value, int n)
{
    double found = 0.0;
    int i;
    for (i = 0; i < n; i++) {
        double size = fabs(rows[i] * value[i]);
        if (!(size <= found)) {
            found = size;
        }
        if (isnan(found)) {
            return found;
        }
    }
    return found;
}

/* Damped Newton from at->X; returns whether it converged. */
static int newton_loop(generated f, struct point *at, const double *x, const double *u, const double *theta, int stages,
                       double *residual)
{
    struct point tried;
    int n = NX * stages;
    int iteration, halvings, i;
    evaluate(f, at, x, u, theta);
    for (iteration = 0; iteration < MOST_ITERATIONS; iteration++) {
        double before = largest(at->rows, at->value, n);
        double share = 1.0;
        double step = 0.0;
        int found = 0;
        if (!all_finite(at->value, n) || !all_finite(at->move, n)) {
            return 0;
        }
        for (i = 0; i < n; i++) {
            step = fmax(step, fabs(at->move[i]) / fmax(fabs(at->X[i]), SIZES[i % NX]));
        }
        for (halvings = 0; halvings <= MOST_HALVINGS && !found; halvings++) {
            double after;
            for (i = 0; i < n; i++) {
                tried.X[i] = at->X[i] + share * at->move[i];
            }
            evaluate(f, &tried, x, u, theta);
            after = largest(at->rows, tried.value, n);
            if (step <= LAST_STEP) {
                *at = tried;
                *residual = after;
                return after <= LARGEST_RESIDUAL;
            }
            found = after < before;
            share *= 0.5;
        }
        if (!found) {
            return 0;
        }
        *at = tried;
    }
    return 0;
}

static double moved(const double *X, const double *start, int stages)
{
    double found = 0.0;
    int i;
    for (i = 0; i < NX * stages; i++) {
        found = fmax(found, fabs(X[i] - start[i]) / SIZES[i % NX]);
    }
    return found;
}

/* The implicit step from x; returns whether a solution was found, which is left in X. */
static int solve(double *X, const double *x, const double *before, const double *u, const double *theta,
                 double *residual)
{
    struct point at;
    double start[NX * STAGES];
    double between[LENGTH(NU)];
    double reached = 0.0;
    double fraction = FIRST_FRACTION;
    int changes = 0;
    int subsolves, converged, i;
    for (i = 0; i < NX * STAGES; i++) {
        start[i] = x[i % NX];
    }
    copy(at.X, start, NX * STAGES);
    converged = newton_loop(newton, &at, x, u, theta, STAGES, residual);
    for (i = 0; i < NU; i++) {
        changes = changes || before[i] != u[i];
    }
    if (converged && (!changes || moved(at.X, start, STAGES) <= LARGEST_MOVE)) {
        copy(X, at.X, NX * STAGES);
        return 1;
    }
    if (!changes) {
        return 0;
    }
    copy(at.X, start, NX * STAGES);
    if (!newton_loop(newton, &at, x, before, theta, STAGES, residual)) {
        return 0;
    }
    copy(X, at.X, NX * STAGES);
    for (subsolves = 1; reached < 1.0; subsolves++) {
        double target = fmin(1.0, reached + fraction);
        if (fraction < LEAST_FRACTION || subsolves > MOST_SUBSOLVES) {
            return 0;
        }
        for (i = 0; i < NU; i++) {
            between[i] = before[i] + target * (u[i] - before[i]);
        }
        copy(at.X, X, NX * STAGES);
        converged = newton_loop(newton, &at, x, between, theta, STAGES, residual);
        if (converged && moved(at.X, X, STAGES) <= LARGEST_MOVE) {
            copy(X, at.X, NX * STAGES);
            reached = target;
            fraction *= 2.0;
        } else {
            fraction *= 0.5;
        }
    }
    return 1;
}

/* Put the initial state onto its constraint; a move that is only the motion during the short step is not taken. */
static int put_on_constraint(double *memory, const double *u)
{
    struct point at;
    double residual;
    copy(at.X, memory + AT_POSTERIOR, NX);
    if (!newton_loop(project, &at, memory + AT_POSTERIOR, u, memory + AT_THETA, 1, &residual)) {
        return 0;
    }
    if (moved(at.X, memory + AT_POSTERIOR, 1) > PROJECTION_NOTICE) {
        copy(memory + AT_POSTERIOR, at.X, NX);
        copy(memory + AT_X, at.X, NX);
    }
    return 1;
}

/* Take what is missing of the inputs (not a number) as it last was: `used`, and variances of what they may be off by.
   An input moves by no more from one sample to the next than it did before, and not out of its range; what one has been
   off by adds up, and one that is known again may have moved further than was thought of. */
static void take_inputs(const struct observer *state, const double *u, double *used, double *variances, double *history)
{
    int i;
    for (i = 0; i < NU; i++) {
        double *lowest = history + 5 * i;
        double held = state->u[i];
        double moved, reach, total;
        copy(lowest, state->inputs + 5 * i, 5);
        variances[i] = 0.0;
        used[i] = isnan(u[i]) ? held : u[i];
        if (state->k == 0) {
            lowest[0] = lowest[1] = used[i];
            continue;
        }
        moved = fabs(used[i] - held);
        reach = fmin((lowest[3] + 1.0) * lowest[2], lowest[1] - lowest[0]);
        total = lowest[4] + reach;
        if (isnan(u[i])) {
            variances[i] = total * total - lowest[4] * lowest[4];
        } else if (lowest[3] > 0.0 && moved > reach) {
            variances[i] = fmax(lowest[3] * moved * (lowest[3] * moved) - lowest[4] * lowest[4], 0.0);
        }
        lowest[0] = fmin(lowest[0], used[i]);
        lowest[1] = fmax(lowest[1], used[i]);
        lowest[2] = fmax(lowest[2], moved / (lowest[3] + 1.0));
        lowest[3] = isnan(u[i]) ? lowest[3] + 1.0 : 0.0;
        lowest[4] = isnan(u[i]) ? total : 0.0;
    }
}

/* Take one sample as it is, from what is remembered: 0, or 2 if the step has no solution; inputs may be off by
   `variances`. */
static int attempt(const double *given, const struct observer *state, const double *u, const double *variances,
                   const double *y, double *after, double *said)
{
    double memory[MEMORY];
    double X[NX * STAGES];
    double received[NY];
    double seen[NY];
    double missing[NX * NX];
    double residual = 0.0;
    const double *inputs[6];
    double *outputs[2];
    int failed, i;
    for (i = 0; i < NY; i++) {
        seen[i] = isnan(y[i]) ? 0.0 : 1.0;
        received[i] = isnan(y[i]) ? 0.0 : y[i];
    }
    copy(memory, given, MEMORY);
    outputs[0] = after;
    outputs[1] = said;
    inputs[0] = memory;
    if (state->k > 0) {
        if (!solve(X, memory + AT_POSTERIOR, state->u, u, memory + AT_THETA, &residual)) {
            return 2;
        }
        inputs[1] = X;
        inputs[2] = u;
        for (i = 0; i < NX * NX; i++) {
            missing[i] = 0.0;
        }
#if NU
        for (i = 0; i < NU; i++) {
            if (variances[i] > 0.0) {
                double *found[1];
                found[0] = missing;
                inputs[3] = variances;
                if (call(unknown, inputs, 4, found, 1) != 0) {
                    return 2;
                }
                break;
            }
        }
#else
        (void)variances;
#endif
        inputs[3] = received;
        inputs[4] = seen;
        inputs[5] = missing;
        failed = call(sample, inputs, 6, outputs, 2);
    } else {
        if (!put_on_constraint(memory, u)) {
            return 2;
        }
        inputs[1] = received;
        inputs[2] = seen;
        failed = call(first, inputs, 3, outputs, 2);
    }
    if (failed || !all_finite(after, MEMORY)) {
        return 2;
    }
    said[AT_RESIDUAL] = residual;
    return 0;
}
