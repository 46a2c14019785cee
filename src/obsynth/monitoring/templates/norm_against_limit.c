
/* The norm of the residual against a limit: statistic, alarm, and the fault with the largest estimate in its unit. */
static void monitor_decide(PREFIX_monitor *m, int deciding, REAL limit, const REAL *faults, const REAL *residuals)
{
    REAL norm = 0, largest = -1;
    int i;
    for (i = 0; i < MONITOR_RESIDUALS; i++) {
        norm = hypot(norm, residuals[i]);
    }
    m->alarm = 0;
    m->fault = -1;
    if (!deciding || isnan(norm)) {
        m->statistic = m->norm = m->threshold = NAN;
        return;
    }
    m->norm = norm;
    m->threshold = limit;
    m->alarm = norm > limit;
    m->statistic = limit > 0 ? norm / limit : norm > 0 ? (REAL)HUGE_VAL : 0;
    /* A quotient may be rounded to one. */
    m->statistic = m->alarm && m->statistic <= 1 ? nextafter((REAL)1, (REAL)2) : m->statistic;
    for (i = 0; m->alarm && i < MONITOR_FAULTS; i++) {
        const REAL share = fabs(faults[i]) / monitor_scales[0][i];
        if (!isfinite(faults[i])) {
            m->fault = -1;
            break;
        }
        if (share > largest) {
            largest = share;
            m->fault = i;
        }
    }
}
