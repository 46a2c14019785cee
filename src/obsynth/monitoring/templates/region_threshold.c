
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
    REAL limit;
    if (m->is_decided && !deciding) {
        m->row = 0;
    }
    m->is_decided = deciding;
    limit = m->row < TABLE_LENGTH ? monitor_table[0][m->row] : MONITOR_LIMIT;
    m->row += m->row < TABLE_LENGTH;
    monitor_decide(m, deciding, limit, faults, residuals);
}
