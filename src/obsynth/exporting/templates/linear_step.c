/* Start, step, and what to do where a sample is missing: as obsynth runs the design on a log. Sizes, tables and the
 * functions `say` and `next_of` stand before this text. */

static int all_finite(const REAL *values, int n)
{
    int i;
    for (i = 0; i < n; i++) {
        if (!isfinite(values[i])) {
            return 0;
        }
    }
    return 1;
}

static void copied(REAL *to, const REAL *from, int n)
{
    int i;
    for (i = 0; i < n; i++) {
        to[i] = from[i];
    }
}

static void filled(REAL *to, REAL value, int n)
{
    int i;
    for (i = 0; i < n; i++) {
        to[i] = value;
    }
}

#if MODEL
/* Add a matrix, row by row, times a vector. */
static void added(const REAL *matrix, int rows, int columns, const REAL *x, REAL *sum)
{
    int i, j;
    for (i = 0; i < rows; i++) {
        for (j = 0; j < columns; j++) {
            sum[i] += matrix[i * columns + j] * x[j];
        }
    }
}

/* The states of the plant model a sample later: inputs go from `before` to `u`, faults are held. */
static void model_after(REAL *x, const REAL *before, const REAL *u, const REAL *fault)
{
    REAL next[LENGTH(MODEL_STATES)] = {0};
#if STRAIGHT
    REAL rise[LENGTH(U_COUNT)] = {0};
    int i;
    for (i = 0; i < U_COUNT; i++) {
        rise[i] = u[i] - before[i];
    }
#else
    (void)u;
#endif
    filled(next, 0, MODEL_STATES);
    added(&model_A[0][0], MODEL_STATES, MODEL_STATES, x, next);
    added(&model_B[0][0], MODEL_STATES, U_COUNT, before, next);
    added(&model_F[0][0], MODEL_STATES, PLANT_FAULTS, fault, next);
#if STRAIGHT
    added(&model_R[0][0], MODEL_STATES, U_COUNT, rise, next);
#endif
    copied(x, next, MODEL_STATES);
}

static void model_outputs(const REAL *x, const REAL *u, const REAL *fault, REAL *y)
{
    filled(y, 0, Y_COUNT);
    added(&model_C[0][0], Y_COUNT, MODEL_STATES, x, y);
    added(&model_D[0][0], Y_COUNT, U_COUNT, u, y);
    added(&model_Df[0][0], Y_COUNT, PLANT_FAULTS, fault, y);
}

/* The square of the distance between measured outputs and those of the model. */
static REAL missed(const REAL *v, const REAL *x, const REAL *fault)
{
    REAL y[LENGTH(Y_COUNT)] = {0};
    REAL sum = 0;
    int i;
    model_outputs(x, v, fault, y);
    for (i = 0; i < Y_COUNT; i++) {
        sum += (v[U_COUNT + i] - y[i]) * (v[U_COUNT + i] - y[i]);
    }
    return sum;
}

static int any_left(const REAL *left, int n)
{
    int i;
    for (i = 0; i < n; i++) {
        if (left[i] != 0) {
            return 1;
        }
    }
    return 0;
}

/* Whether the model, after a gap in which it stood in for outputs, misses them by more than their whole size before and
 * after it; it is brought to this sample. */
static int is_lost(PREFIX_state *s, const REAL *v)
{
    static const REAL rest[LENGTH(MODEL_STATES)] = {0};
    static const REAL none[LENGTH(PLANT_FAULTS)] = {0};
    REAL before = missed(s->measured, rest, none);
    REAL now = missed(v, rest, none);
    REAL more;
    model_after(s->model, s->v, v, s->fault);
    if (!any_left(s->left + U_COUNT * Z_COUNT, Y_COUNT * Z_COUNT)) {
        return 0;
    }
    /* a <= b + c, of squares, without roots. */
    more = missed(v, s->model, s->fault) - before - now;
    return !(more <= 0 || more * more <= 4 * before * now);
}

/* Follow how inputs move: lowest and highest value, largest change from sample to sample, samples missing in a row; and
 * how far those that are missing may have moved since they were known. Missing ones stand in `u` as they last were. */
static void follow(PREFIX_state *s, const REAL *u, const int *unsure, int is_first)
{
    int i;
    for (i = 0; i < U_COUNT; i++) {
        REAL *moves = s->moves + 4 * i;
        REAL moved = ABS(u[i] - s->v[i]);
        if (is_first) {
            moves[0] = moves[1] = u[i];
            moves[2] = moves[3] = 0;
            continue;
        }
        moves[0] = u[i] < moves[0] ? u[i] : moves[0];
        moves[1] = u[i] > moves[1] ? u[i] : moves[1];
        if (moved / (moves[3] + 1) > moves[2]) {
            moves[2] = moved / (moves[3] + 1);
        }
        moved = moves[3] > 0 && !unsure[i] ? moved : 0;
        moves[3] = unsure[i] ? moves[3] + 1 : 0;
        /* In one sample an input is off by what it has changed since; in several it may have come and gone. */
        if (moves[3] > 1) {
            moved = moves[3] * moves[2] < moves[1] - moves[0] ? moves[3] * moves[2] : moves[1] - moves[0];
        }
        s->reach[i] = s->reach[i] > moved ? s->reach[i] : moved;
    }
}

/* Seconds after a gap in which nothing may be decided: until what the model missed by has become usual. */
static double recovering(PREFIX_state *s, const REAL *v)
{
    static const REAL zero[LENGTH(V_COUNT)] = {0};
    REAL miss[LENGTH(V_COUNT)] = {0}, moved[LENGTH(Z_COUNT)] = {0}, usual[LENGTH(SHOWN_COUNT)] = {0}, sum[LENGTH(SHOWN_COUNT)] = {0};
    REAL states[LENGTH(STATE_COUNT)] = {0}, shown[LENGTH(SHOWN_COUNT)] = {0};
    double waited = 0;
    int i, j, is_shown = s->counted >= LEAST_SHOWN;
#if STRAIGHT
    REAL one[LENGTH(V_COUNT)] = {0};
#endif
    if (!all_finite(s->left, Z_COUNT * V_COUNT)) {
        filled(s->carried, (REAL)INFINITY, SHOWN_COUNT);
        return s->warm_up;
    }
    model_outputs(s->model, v, s->fault, miss + U_COUNT);
    /* An input that was held was off by no more than it has changed since, or may have by how it moved before. */
    for (i = 0; i < V_COUNT; i++) {
        miss[i] = ABS(v[i] - (i < U_COUNT ? s->held[i] : miss[i]));
        if (i < U_COUNT && s->reach[i] > miss[i]) {
            miss[i] = s->reach[i];
        }
    }
#if STRAIGHT
    filled(one, 0, V_COUNT);
    for (j = 0; j < V_COUNT; j++) {
        one[j] = j >= U_COUNT && any_left(s->left + j * Z_COUNT, Z_COUNT);
        next_of(s->left + j * Z_COUNT, one, zero, moved);
        copied(s->left + j * Z_COUNT, moved, Z_COUNT);
        one[j] = 0;
    }
#endif
    for (j = 0; j < V_COUNT; j++) {
        for (i = 0; i < Z_COUNT; i++) {
            s->excess[j * Z_COUNT + i] = s->left[j * Z_COUNT + i] * miss[j];
        }
    }
    for (i = 0; i < SHOWN_COUNT; i++) {
        /* What fault estimates and residuals change by from sample to sample, or what the stated noise gives them. */
        REAL noise = noise_variances[0][i];
        usual[i] = is_shown ? LEFT_SHARE * LEFT_SHARE * s->changes[i] / (REAL)s->counted : 0;
        usual[i] = usual[i] > noise ? usual[i] : noise;
        if (!is_shown && !(noise > 0)) {
            return s->warm_up;
        }
    }
    while (waited < s->warm_up) {
        int quiet = 1;
        waited += UPPER_DT;
        filled(sum, 0, SHOWN_COUNT);
        for (j = 0; j < V_COUNT; j++) {
            next_of(s->left + j * Z_COUNT, zero, zero, moved);
            copied(s->left + j * Z_COUNT, moved, Z_COUNT);
            say(moved, zero, zero, states, shown, shown + FAULT_COUNT);
            for (i = 0; i < SHOWN_COUNT; i++) {
                sum[i] += ABS(shown[i]) * miss[j];
            }
        }
        for (i = 0; i < SHOWN_COUNT; i++) {
            quiet = quiet && sum[i] * sum[i] <= usual[i];
        }
        if (quiet) {
            break;
        }
    }
    return waited < s->warm_up ? waited : s->warm_up;
}

/* What gaps can have left in each output that is shown. */
static void left_in(const PREFIX_state *s, REAL *grown)
{
    static const REAL zero[LENGTH(V_COUNT)] = {0};
    REAL states[LENGTH(STATE_COUNT)] = {0}, shown[LENGTH(SHOWN_COUNT)] = {0};
    int i, j;
    copied(grown, s->carried, SHOWN_COUNT);
    for (j = 0; j < V_COUNT; j++) {
        say(s->excess + j * Z_COUNT, zero, zero, states, shown, shown + FAULT_COUNT);
        for (i = 0; i < SHOWN_COUNT; i++) {
            grown[i] += ABS(shown[i]);
        }
    }
}

/* The same a sample later. */
static void later(PREFIX_state *s)
{
    static const REAL zero[LENGTH(V_COUNT)] = {0};
    REAL moved[LENGTH(Z_COUNT)] = {0};
    int j;
    for (j = 0; j < V_COUNT; j++) {
        next_of(s->excess + j * Z_COUNT, zero, zero, moved);
        copied(s->excess + j * Z_COUNT, moved, Z_COUNT);
    }
}

/* By how much more than their levels outputs must be for an alarm in this complete sample. */
static void grow(PREFIX_state *s)
{
    if (s->status == UPPER_RECOVERING) {
        left_in(s, s->grown);
#if !STRAIGHT
        later(s);
#endif
    } else {
        filled(s->grown, 0, SHOWN_COUNT);
        filled(s->carried, 0, SHOWN_COUNT);
        filled(s->excess, 0, Z_COUNT * V_COUNT);
    }
}
#endif

static void restart(PREFIX_state *s)
{
    s->is_started = 0;
    s->is_gap = 0;
    s->kept = 0;
    s->phase = UPPER_WARM_UP;
    filled(s->v, 0, V_COUNT);
    filled(s->left, 0, Z_COUNT * V_COUNT);
    filled(s->reach, 0, U_COUNT);
    filled(s->excess, 0, Z_COUNT * V_COUNT);
    filled(s->carried, 0, SHOWN_COUNT);
    filled(s->grown, 0, SHOWN_COUNT);
}

/* Take inputs and outputs as those of this sample. */
static void taken(PREFIX_state *s, const REAL *v)
{
    int i;
#if !STRAIGHT
    REAL next[LENGTH(Z_COUNT)] = {0};
    next_of(s->z, v, v + U_COUNT, next);
    copied(s->z, next, Z_COUNT);
#endif
    copied(s->v, v, V_COUNT);
    if (s->kept == KEPT_INPUTS) {
        for (i = 0; i < (KEPT_INPUTS - 1) * U_COUNT; i++) {
            s->inputs[i] = s->inputs[i + U_COUNT];
        }
        s->kept--;
    }
    copied(s->inputs + s->kept * U_COUNT, v, U_COUNT);
    s->kept++;
}

#if STRAIGHT
/* Bring z to this sample along a straight line of inputs and outputs. */
static void flowed(PREFIX_state *s, const REAL *v)
{
    REAL next[LENGTH(Z_COUNT)] = {0};
    REAL rise[LENGTH(V_COUNT)] = {0};
    int i;
    for (i = 0; i < V_COUNT; i++) {
        rise[i] = v[i] - s->v[i];
    }
    next_of(s->z, s->v, rise, next);
    copied(s->z, next, Z_COUNT);
}
#endif

/* What is said where nothing is known: faults as they were. */
static int held(PREFIX_state *s, REAL *states, REAL *shown)
{
    int i;
    filled(states, NAN, STATE_COUNT);
    filled(shown, NAN, SHOWN_COUNT);
    for (i = 0; i < FAULT_COUNT; i++) {
        shown[i] = s->fault[told[i]];
    }
    s->status = UPPER_GAP;
    return 1;
}

/* A sample with something missing: the model of the plant stands in for what is. Inputs are held already. */
static int unmeasured(PREFIX_state *s, const REAL *u, const int *unsure, REAL *states, REAL *shown)
{
#if MODEL
    REAL v[LENGTH(V_COUNT)] = {0};
    int i;
    if (!s->is_started) {
        return held(s, states, shown);
    }
    if (s->phase == UPPER_WARM_UP) {
        s->from += UPPER_DT;
    }
    if (!s->is_gap) {
        left_in(s, s->grown);
        copied(s->carried, s->grown, SHOWN_COUNT);
        filled(s->excess, 0, Z_COUNT * V_COUNT);
        copied(s->held, s->v, U_COUNT);
        filled(s->model, 0, MODEL_STATES);
        added(&model_into[0][0], MODEL_STATES, SEEN_COUNT, s->seen, s->model);
#if !STRAIGHT
        for (i = 0; i < s->kept; i++) {
            model_after(s->model, s->inputs + i * U_COUNT, s->inputs + i * U_COUNT, s->fault);
        }
#else
        model_after(s->model, s->v, u, s->fault);
#endif
        s->is_gap = 1;
    } else {
        model_after(s->model, s->v, u, s->fault);
    }
    copied(v, u, U_COUNT);
    model_outputs(s->model, u, s->fault, v + U_COUNT);
    for (i = U_COUNT; i < V_COUNT; i++) {
        v[i] = unsure[i] ? v[i] : u[i];
    }
#if STRAIGHT
    flowed(s, v);
#endif
    follow(s, v, unsure, 0);
    for (i = 0; i < V_COUNT; i++) {
        REAL one[LENGTH(V_COUNT)] = {0};
        REAL moved[LENGTH(Z_COUNT)] = {0};
#if STRAIGHT
        static const REAL zero[LENGTH(V_COUNT)] = {0};
#endif
        filled(one, 0, V_COUNT);
        one[i] = unsure[i];
#if STRAIGHT
        next_of(s->left + i * Z_COUNT, one, zero, moved);
#else
        next_of(s->left + i * Z_COUNT, one, one + U_COUNT, moved);
#endif
        copied(s->left + i * Z_COUNT, moved, Z_COUNT);
    }
    say(s->z, v, v + U_COUNT, states, shown, shown + FAULT_COUNT);
    taken(s, v);
    for (i = 0; i < FAULT_COUNT; i++) {
        shown[i] = s->fault[told[i]];
    }
    filled(shown + FAULT_COUNT, NAN, SHOWN_COUNT - FAULT_COUNT);
    if (!all_finite(s->z, Z_COUNT)) {
        restart(s);
        return held(s, states, shown);
    }
    s->status = UPPER_GAP;
    return 1;
#else
    (void)u;
    (void)unsure;
    if (s->is_started) {
        restart(s);
    }
    return held(s, states, shown);
#endif
}

/* Whether so many seconds are over: with the sample that only rounding calls earlier. */
static int is_after(double time, double from, double seconds)
{
    return time >= from + seconds - SETTLING_SLACK * UPPER_DT;
}

/* A complete sample. */
static int measured(PREFIX_state *s, const REAL *v, REAL *states, REAL *shown)
{
    REAL fault[LENGTH(PLANT_FAULTS)] = {0};
    double waiting = s->warm_up;
    int was_gap = s->is_gap;
    int was_measured = s->is_started && !was_gap;
    int i;
#if MODEL
    static const int none[LENGTH(V_COUNT)] = {0};
    if (was_gap) {
        int has_lost = is_lost(s, v);
        waiting = recovering(s, v);
        /* What has become usual before a new start would have settled needs none. */
        if (has_lost && waiting >= s->warm_up) {
            restart(s);
            was_gap = 0;
        }
    }
#endif
    if (!s->is_started) {
#if MODEL
        follow(s, v, none, 1);
#endif
        copied(s->z, start[0], Z_COUNT);
        s->is_started = 1;
        s->from = s->time;
        s->phase = UPPER_WARM_UP;
        s->kept = 0;
    } else {
#if MODEL
#if STRAIGHT
        if (!was_gap) {
            later(s);
        }
#endif
        follow(s, v, none, 0);
#endif
#if STRAIGHT
        flowed(s, v);
#endif
    }
    say(s->z, v, v + U_COUNT, states, shown, shown + FAULT_COUNT);
    copied(s->measured, v, V_COUNT);
    filled(fault, 0, PLANT_FAULTS);
    for (i = 0; i < FAULT_COUNT; i++) {
        fault[told[i]] = shown[i];
    }
#if MODEL
#if SOLVED
    {
        REAL known[LENGTH(Z_COUNT + Y_COUNT)] = {0};
        REAL through[LENGTH(Y_COUNT)] = {0};
        filled(through, 0, Y_COUNT);
        added(&source_D[0][0], Y_COUNT, U_COUNT, v, through);
        added(&source_Df[0][0], Y_COUNT, PLANT_FAULTS, fault, through);
        copied(known, s->z, Z_COUNT);
        for (i = 0; i < Y_COUNT; i++) {
            known[Z_COUNT + i] = v[U_COUNT + i] - through[i];
        }
        filled(s->seen, 0, SEEN_COUNT);
        added(&model_solver[0][0], SEEN_COUNT, Z_COUNT + Y_COUNT, known, s->seen);
    }
#else
    copied(s->seen, states, SEEN_COUNT);
#endif
#endif
    taken(s, v);
    if (was_gap) {
        s->is_gap = 0;
        /* The initial-condition response settles in as many measured samples as without a gap. */
        if (s->phase != UPPER_WARM_UP || is_after(s->time, s->from, s->warm_up)) {
            s->from = s->time;
            s->waiting = waiting;
            s->phase = UPPER_RECOVERING;
        }
        filled(s->left, 0, Z_COUNT * V_COUNT);
        filled(s->reach, 0, U_COUNT);
    }
    if (!all_finite(s->z, Z_COUNT) || !all_finite(states, STATE_COUNT) || !all_finite(shown, SHOWN_COUNT)) {
        restart(s);
        return held(s, states, shown);
    }
    waiting = s->phase == UPPER_RECOVERING ? s->waiting : s->warm_up;
    s->status = is_after(s->time, s->from, waiting) ? UPPER_OK : s->phase;
#if MODEL
    grow(s);
#endif
    copied(s->fault, fault, PLANT_FAULTS);
    if (was_measured && (s->status == UPPER_OK || (s->status == UPPER_RECOVERING && s->counted < LEAST_SHOWN))) {
        for (i = 0; i < SHOWN_COUNT; i++) {
            REAL change = (shown[i] - s->shown[i]) * (shown[i] - s->shown[i]);
            s->changes[i] += isfinite(change) ? change : 0;
        }
        s->counted++;
    }
    copied(s->shown, shown, SHOWN_COUNT);
    return 0;
}

void PREFIX_reset(PREFIX_state *s)
{
    int i;
    s->k = 0;
    s->status = UPPER_WARM_UP;
    restart(s);
    copied(s->z, start[0], Z_COUNT);
    filled(s->fault, 0, PLANT_FAULTS);
    filled(s->changes, 0, SHOWN_COUNT);
    filled(s->held, 0, U_COUNT);
    filled(s->moves, 0, 4 * U_COUNT);
    s->counted = 0;
    s->time = s->from = s->waiting = 0;
    s->warm_up = WARM_UP_SECONDS;
    copied(s->level, levels[0], UPPER_WATCHED);
    for (i = 0; i < LENGTH(UPPER_WATCHED); i++) {
        s->alarm[i] = 0;
    }
    s->any_alarm = 0;
    MONITOR_RESET
}

int PREFIX_step(STEP_ARGUMENTS)
{
    REAL v[LENGTH(V_COUNT)] = {0};
    REAL shown[LENGTH(WATCHED_COUNT)] = {0};
    STATES_SCRATCH
    int i, missing;
    int unsure[LENGTH(V_COUNT)] = {0};
    COPY_IN
    MONITOR_UNREPEAT
    s->time = (double)s->k * UPPER_DT;
    s->k++;
    for (i = 0; i < V_COUNT; i++) {
        unsure[i] = !isfinite(v[i]);
    }
    missing = !all_finite(v, V_COUNT);
    if (missing) {
        for (i = 0; i < U_COUNT; i++) {
            v[i] = isfinite(v[i]) ? v[i] : s->v[i];
        }
        missing = unmeasured(s, v, unsure, states, shown);
    } else {
        missing = measured(s, v, states, shown);
    }
    MONITOR_STEP
    s->any_alarm = 0;
    for (i = 0; i < UPPER_WATCHED; i++) {
        REAL value = ABS(shown[watched[i]]);
        /* After a gap a level is passed where an output is beyond it by more than the gap can have left. */
        REAL more = watched[i] < SHOWN_COUNT ? s->grown[watched[i]] : (REAL)INFINITY;
        int is_known = s->status == UPPER_OK || (s->status == UPPER_RECOVERING && isfinite(more));
        s->alarm[i] = is_known && s->level[i] > 0 && value > s->level[i] + (s->status == UPPER_OK ? 0 : more);
        s->any_alarm = s->any_alarm || s->alarm[i];
    }
    COPY_OUT
    return missing;
}

/* Signals as they are, from deviations or to these. */
static void shifted(REAL *to, const REAL *from, const REAL *point, int sign, int n)
{
    int i;
    for (i = 0; i < n; i++) {
        to[i] = sign > 0 ? from[i] + point[i] : from[i] - point[i];
    }
}

int PREFIX_take(TAKE_ARGUMENTS)
{
    REAL deviation[LENGTH(V_COUNT)] = {0};
    int missing;
    LESS_POINT
    missing = PREFIX_step(TAKEN_SIGNALS);
    MORE_POINT
    return missing;
}
