
void PREFIX_reset(PREFIX_state *s)
{
    int i;
    begin(&s->running);
    for (i = 0; i < LENGTH(NU); i++) {
        s->u[i] = 0.0;
    }
    s->is_started = 0;
    s->status = s->phase = UPPER_WARM_UP;
    s->k = 0;
    s->time = s->from = 0.0;
    s->warm_up = WARM_UP_SECONDS;
    s->any_alarm = 0;
    for (i = 0; i < UPPER_WATCHED; i++) {
        s->level[i] = levels[0][i];
        s->alarm[i] = 0;
    }
    MONITOR_RESET
    for (i = 0; i < LENGTH(NQ); i++) {
        s->spread[i] = s->usual[i] = 0.0;
    }
}

/* A row before all inputs have been known, with which a nonlinear model has nothing to begin: nothing is said. */
static int waited(PREFIX_state *s, PREFIX_estimates *estimates)
{
    int i;
    WAITING_STEP
    for (i = 0; i < NX; i++) {
        estimates->states[i] = estimates->state_deviations[i] = NAN;
    }
    for (i = 0; i < NQ; i++) {
        estimates->faults[i] = estimates->fault_deviations[i] = NAN;
    }
    for (i = 0; i < NY; i++) {
        estimates->residuals[i] = NAN;
    }
    estimates->nis = estimates->step_residual = NAN;
    s->status = UPPER_GAP;
    s->any_alarm = 0;
    for (i = 0; i < UPPER_WATCHED; i++) {
        s->alarm[i] = 0;
    }
    return 1;
}

/* Whether a value of an output arrives in a row. */
static int is_due(long k, int i)
{
#if WAITS
    return k >= DELAYS[i] && (k - DELAYS[i]) % EVERY[i] == 0;
#else
    (void)k;
    (void)i;
    return 1;
#endif
}

/* What a row is: inputs that nobody measured, and outputs that were missing or left out (more of them are `refused`
   than before the row), make it another one. */
static int status_of(PREFIX_state *s, const double *seen, const int *refused, int inputs_known, int is_first)
{
    int known = 0;
    int all = 1;
    int i;
    if (is_first || (NU > 0 && !inputs_known)) {
        s->phase = s->phase == UPPER_WARM_UP || is_first ? UPPER_WARM_UP : UPPER_RECOVERING;
        s->from = s->time;
    }
    for (i = 0; i < NY; i++) {
        int is_refused = GATE && latest_of(&s->running)->refused[i] > refused[i];
        int is_received = !is_due(latest_of(&s->running)->k - 1, i) || (!isnan(seen[i]) && !is_refused);
        known = known || is_received;
        all = all && is_received;
    }
    s->is_whole = inputs_known && all;
    if (!inputs_known || !known) {
        return UPPER_GAP;
    }
    /* With the sample that only rounding calls earlier. */
    if (s->time < s->from + s->warm_up - SETTLING_SLACK * UPPER_DT) {
        return s->phase;
    }
    s->phase = UPPER_OK;
    return all ? UPPER_OK : UPPER_PARTIAL;
}

/* By how many times a fault estimate is less certain than before samples were missing: levels are as many times higher. */
static double unsure(PREFIX_state *s, int i, double spread, int is_first)
{
    if (is_first) {
        s->usual[i] = 0.0;
    } else if (!s->is_whole && !(s->usual[i] > 0.0)) {
        s->usual[i] = s->spread[i];
    }
    s->spread[i] = spread;
    if (!(spread > s->usual[i])) {
        s->usual[i] = 0.0;
    }
    return s->usual[i] > 0.0 ? spread / s->usual[i] : 1.0;
}

int PREFIX_step(PREFIX_state *s, ARGUMENTSconst double y[NY], PREFIX_estimates *estimates)
{
    double used[LENGTH(NU)];
    double held[LENGTH(NU)];
    double seen[NY];
    double none[NY];
    double received[NY];
    double said[ROW];
    double shown[UPPER_WATCHED];
    double share[LENGTH(NQ)];
    const double *after;
    int refused[NY];
    int inputs_known = 1;
    int is_first = !s->is_started;
    int is_deciding, i, failed;
    used[0] = held[0] = 0.0;
    for (i = 0; i < NU; i++) {
        int is_known = isfinite(INPUT[i]) != 0;
        held[i] = is_known ? INPUT[i] : s->u[i];
        used[i] = is_known ? INPUT[i] : NAN;
        inputs_known = inputs_known && is_known;
    }
    for (i = 0; i < NY; i++) {
        seen[i] = isfinite(y[i]) ? y[i] : NAN;
    }
    MONITOR_UNREPEAT
    if (is_first && !inputs_known) {
        return waited(s, estimates);
    }
    for (i = 0; i < NY; i++) {
        none[i] = NAN;
        refused[i] = latest_of(&s->running)->refused[i];
    }
    failed = advance(&s->running, used, seen, received, said);
    if (failed && !is_first) {
        /* A sample without a solution is predicted over; where that has none either, the observer starts again. */
        failed = advance(&s->running, used, none, received, said);
        if (failed) {
            struct PREFIX_observer before = s->running;
            begin(&s->running);
            is_first = 1;
            failed = advance(&s->running, held, seen, received, said);
            if (failed) {
                copy(seen, none, NY);
                failed = advance(&s->running, held, seen, received, said);
            }
            if (failed) {
                s->running = before;
            }
        } else {
            copy(seen, none, NY);
        }
    } else if (failed) {
        copy(seen, none, NY);
        failed = advance(&s->running, used, seen, received, said);
    }
    if (failed) {
        return 2;
    }
    s->is_started = 1;
    s->time = (double)s->k * UPPER_DT;
    s->k++;
    copy(s->u, held, LENGTH(NU));
    s->status = status_of(s, seen, refused, inputs_known, is_first);
    is_deciding = s->status == UPPER_OK || s->status == UPPER_PARTIAL;
    after = latest_of(&s->running)->memory;
    copy(estimates->states, after + AT_POSTERIOR, NX);
    copy(estimates->faults, after + AT_THETA, NQ);
    for (i = 0; i < NX; i++) {
        estimates->state_deviations[i] = sqrt(fmax(said[AT_COVARIANCE + i * (NX + 1)], 0.0));
    }
    for (i = 0; i < NQ; i++) {
        estimates->fault_deviations[i] = sqrt(fmax(after[AT_SPREAD + i * (NQ + 1)], 0.0));
        share[i] = unsure(s, i, estimates->fault_deviations[i], is_first);
    }
    for (i = 0; i < NY; i++) {
        estimates->residuals[i] = isnan(received[i]) ? NAN : said[AT_INNOVATION + i];
    }
    estimates->nis = said[AT_NIS];
    estimates->step_residual = said[AT_RESIDUAL];
    copy(shown, estimates->faults, NQ);
    copy(shown + NQ, estimates->residuals, NY);
    shown[NQ + NY] = estimates->nis;
    MONITOR_STEP
    s->any_alarm = 0;
    for (i = 0; i < UPPER_WATCHED; i++) {
        double level = i < NQ ? s->level[i] * share[i] : s->level[i];
        s->alarm[i] = is_deciding && s->level[i] > 0.0 && fabs(shown[i]) > level;
        s->any_alarm = s->any_alarm || s->alarm[i];
    }
    return !inputs_known;
}
