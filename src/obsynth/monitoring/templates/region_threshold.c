
static void monitor_reset(PREFIX_monitor *m)
{
    m->statistic = m->norm = m->threshold = NAN;
    m->alarm = m->is_decided = 0;
    m->fault = -1;
    m->row = 0;
}

/* Take one row of estimates; nothing is decided in rows that are not claimed, and the table begins again after them. */
static void monitor_take(PREFIX_monitor *m, int deciding, const REAL *faults, const REAL *residuals)
{
    REAL norm = 0, limit, largest = -1;
    int i;
    if (m->is_decided && !deciding) {
        m->row = 0;
    }
    m->is_decided = deciding;
    limit = m->row < TABLE_LENGTH ? monitor_table[0][m->row] : MONITOR_LIMIT;
    m->row += m->row < TABLE_LENGTH;
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
