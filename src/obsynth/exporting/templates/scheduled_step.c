void PREFIX_reset(PREFIX_state *s)
{
    int i;
    for (i = 0; i < LENGTH(Z_COUNT); i++) {
        s->z[i] = 0;
    }
    for (i = 0; i < VERTICES; i++) {
        s->weights[i] = first_weights[0][i];
    }
    for (i = 0; i < PARAMETERS; i++) {
        s->parameters[i] = NAN;
    }
    for (i = 0; i < LENGTH(U_COUNT); i++) {
        s->u[i] = 0;
    }
    for (i = 0; i < Y_COUNT; i++) {
        s->y[i] = 0;
    }
    s->status = UPPER_WARM_UP;
    s->unclaimed = 0;
    s->settling = 0;
    s->is_started = 0;
    s->is_recovering = 0;
    s->warm_up = WARM_UP_SECONDS;
    s->any_alarm = 0;
    for (i = 0; i < LENGTH(WATCHED); i++) {
        s->level[i] = levels[0][i];
        s->alarm[i] = 0;
    }
#if MONITORS
    monitor_reset(&s->monitor);
#endif
}

/* After a row with its status: which outputs passed their levels. */
static void watch(PREFIX_state *s, const REAL *shown)
{
    int i;
    s->any_alarm = 0;
#if MONITOR_FOLLOWS
    monitor_follow(&s->monitor, s->status == UPPER_OK, shown - STATE_COUNT, s->u, s->parameters, s->weights);
#endif
#if MONITORS
    monitor_take(&s->monitor, s->status == UPPER_OK, shown, shown + FAULT_COUNT);
#endif
    for (i = 0; i < WATCHED; i++) {
#if MONITORS
        const REAL value = i == WATCHED - 1 ? s->monitor.statistic : shown[i];
#else
        const REAL value = shown[i];
#endif
        s->alarm[i] = s->status == UPPER_OK && s->level[i] > 0 && fabs(value) > s->level[i];
        s->any_alarm = s->any_alarm || s->alarm[i];
    }
}

/* The sum over the vertices of weights times matrices times a vector is added to `sum`. */
static void scheduled(const REAL *tables, int rows, int columns, const REAL *weights, const REAL *x, REAL *sum)
{
    int v, i, j;
    for (v = 0; v < VERTICES; v++) {
        const REAL *matrix = tables + (long)v * rows * columns;
        if (weights[v] == 0) {
            continue;
        }
        for (i = 0; i < rows; i++) {
            REAL row = 0;
            for (j = 0; j < columns; j++) {
                row += matrix[i * columns + j] * x[j];
            }
            sum[i] += weights[v] * row;
        }
    }
}

static void fixed(const REAL *matrix, int rows, int columns, const REAL *x, REAL *sum)
{
    int i, j;
    for (i = 0; i < rows; i++) {
        for (j = 0; j < columns; j++) {
            sum[i] += matrix[i * columns + j] * x[j];
        }
    }
}

#if DIVIDES || IS_CONTINUOUS
/* Solve a x = x, by elimination with pivots; a is n by n and is overwritten. */
static void solve(REAL *a, int n, REAL *x)
{
    int i, j, k;
    for (k = 0; k < n; k++) {
        int best = k;
        REAL kept;
        for (i = k + 1; i < n; i++) {
            best = fabs(a[i * n + k]) > fabs(a[best * n + k]) ? i : best;
        }
        for (j = 0; j < n; j++) {
            kept = a[k * n + j];
            a[k * n + j] = a[best * n + j];
            a[best * n + j] = kept;
        }
        kept = x[k];
        x[k] = x[best];
        x[best] = kept;
        for (i = k + 1; i < n; i++) {
            const REAL factor = a[i * n + k] / a[k * n + k];
            for (j = k; j < n; j++) {
                a[i * n + j] -= factor * a[k * n + j];
            }
            x[i] -= factor * x[k];
        }
    }
    for (k = n - 1; k >= 0; k--) {
        for (j = k + 1; j < n; j++) {
            x[k] -= a[k * n + j] * x[j];
        }
        x[k] /= a[k * n + k];
    }
}

/* A square matrix, the sum over the vertices of weights times matrices. */
static void mean_matrix(const REAL *tables, int n, const REAL *weights, REAL *sum)
{
    int v, i;
    for (i = 0; i < n * n; i++) {
        sum[i] = 0;
        for (v = 0; v < VERTICES; v++) {
            sum[i] += weights[v] * tables[(long)v * n * n + i];
        }
    }
}
#endif

/* Weights of the vertices at parameters; returns whether all of them are there, in their ranges and not too fast. */
static int scheduling_of(PREFIX_state *s, const REAL *given, REAL *weights)
{
    REAL p[PARAMETERS];
    int i, inside = 1;
    for (i = 0; i < PARAMETERS; i++) {
        const REAL before = s->parameters[i];
        if (!(given[i] >= lowest[0][i] && given[i] <= highest[0][i]) || fabs(given[i] - before) > steps[0][i]) {
            inside = 0;
        }
        if (isnan(given[i])) {
            p[i] = isnan(before) ? middle[0][i] : before;
        } else {
            p[i] = given[i] < lowest[0][i] ? lowest[0][i] : given[i] > highest[0][i] ? highest[0][i] : given[i];
        }
        s->parameters[i] = p[i];
    }
#if GIVES_WEIGHTS
    {
        REAL total = 0, asked = 0;
        for (i = 0; i < PARAMETERS; i++) {
            total += p[i];
            asked += given[i];
        }
        inside = inside && fabs(asked - 1) <= WEIGHT_TOLERANCE;
        for (i = 0; i < PARAMETERS; i++) {
            weights[i] = total > 0 ? p[i] / total : (REAL)1 / PARAMETERS;
        }
    }
#else
    {
        int count = 1, j;
        REAL a[FUNCTIONS];
        FUNCTION_VALUES
        weights[0] = 1;
        for (i = 0; i < FUNCTIONS; i++) {
            REAL share = (a[i] - bounds[i][0]) / (bounds[i][1] - bounds[i][0]);
            share = share < 0 ? 0 : share > 1 ? 1 : share;
            for (j = count - 1; j >= 0; j--) {
                const REAL weight = weights[j];
                weights[2 * j] = weight * (1 - share);
                weights[2 * j + 1] = weight * share;
            }
            count *= 2;
        }
    }
#endif
    return inside;
}

int PREFIX_step(STEP_ARGUMENTS)
{
    REAL weights[VERTICES], next[LENGTH(Z_COUNT)] = {0}, rows[ROW_COUNT] = {0};
    int i, whole = 1;
#if IS_CONTINUOUS
    const int is_first = !s->is_started;
#endif
    COPY_U
    for (i = 0; i < Y_COUNT; i++) {
        if (isfinite(y[i])) {
            s->y[i] = y[i];
        } else {
            whole = 0;
        }
    }
    if (!s->is_started && !whole) {
        for (i = 0; i < ROW_COUNT; i++) {
            rows[i] = NAN;
        }
        COPY_ROWS
        s->status = UPPER_GAP;
        watch(s, rows + STATE_COUNT);
        return 1;
    }
    if (!s->is_started) {
        s->is_started = 1;
        s->settling = (int)fmin(fmax(ceil(s->warm_up / UPPER_DT - SETTLING_SLACK), 0), MOST_ROWS);
    }
    {
        const int inside = scheduling_of(s, u + U_COUNT, weights);
        s->unclaimed = inside ? fmax(s->unclaimed - FORGOTTEN, 0) : FORGETTING;
    }
#if IS_CONTINUOUS
    if (!is_first) {
        /* A step of implicit Euler: (I - h Az) z = z + h (Bu u + By y). */
        REAL matrix[LENGTH(Z_COUNT) * LENGTH(Z_COUNT)];
        mean_matrix(&Az[0][0], Z_COUNT, weights, matrix);
        scheduled(&By[0][0], Z_COUNT, Y_COUNT, weights, s->y, next);
#if U_COUNT
        scheduled(&Bu[0][0], Z_COUNT, U_COUNT, weights, s->u, next);
#endif
        for (i = 0; i < Z_COUNT * Z_COUNT; i++) {
            matrix[i] = (i % (Z_COUNT + 1) == 0 ? 1 : 0) - (REAL)UPPER_DT * matrix[i];
        }
        for (i = 0; i < Z_COUNT; i++) {
            s->z[i] += (REAL)UPPER_DT * next[i];
        }
        solve(matrix, Z_COUNT, s->z);
    }
#endif
    fixed(&Cz[0][0], ROW_COUNT, Z_COUNT, s->z, rows);
    fixed(&Dy[0][0], ROW_COUNT, Y_COUNT, s->y, rows);
#if U_COUNT
    fixed(&Du[0][0], ROW_COUNT, U_COUNT, s->u, rows);
#endif
#if CORRECTS
    {
        /* z was formed with the weights of the sample before; the states are those of the corrected z. */
        REAL moved[LENGTH(Z_COUNT)] = {0};
        scheduled(&correction[0][0], Z_COUNT, RESIDUAL_COUNT, s->weights, rows + STATE_COUNT + FAULT_COUNT, moved);
        fixed(&Cz[0][0], STATE_COUNT, Z_COUNT, moved, rows);
        for (i = 0; i < Z_COUNT; i++) {
            s->z[i] += moved[i];
        }
    }
#endif
#if DIVIDES
    {
        REAL effect[FAULT_COUNT * FAULT_COUNT];
        mean_matrix(&effectiveness[0][0], FAULT_COUNT, s->weights, effect);
        solve(effect, FAULT_COUNT, rows + STATE_COUNT);
    }
#endif
#if !IS_CONTINUOUS
    scheduled(&Az[0][0], Z_COUNT, Z_COUNT, weights, s->z, next);
    scheduled(&By[0][0], Z_COUNT, Y_COUNT, weights, s->y, next);
#if U_COUNT
    scheduled(&Bu[0][0], Z_COUNT, U_COUNT, weights, s->u, next);
#endif
    for (i = 0; i < Z_COUNT; i++) {
        s->z[i] = next[i];
    }
#endif
    for (i = 0; i < VERTICES; i++) {
        s->weights[i] = weights[i];
    }
    if (!whole) {
        for (i = 0; i < ROW_COUNT; i++) {
            rows[i] = NAN;
        }
        if (s->settling <= RECOVERING_ROWS) {
            s->settling = RECOVERING_ROWS;
        }
    }
    COPY_ROWS
    if (!whole) {
        s->status = UPPER_GAP;
    } else if (s->unclaimed > 0) {
        s->status = UPPER_OUT;
    } else if (s->settling > 0) {
        s->status = s->is_recovering ? UPPER_RECOVERING : UPPER_WARM_UP;
    } else {
        s->is_recovering = 1;
        s->status = UPPER_OK;
    }
    s->settling = s->settling > 0 ? s->settling - 1 : 0;
    watch(s, rows + STATE_COUNT);
    return s->status == UPPER_OK ? 0 : 1;
}
