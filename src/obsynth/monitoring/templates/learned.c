
/* The monitor that was learned from rows without faults: whitening, Hotelling's T2, exponentially weighted means, and
 * likelihood ratios of steps and ramps of any age. Sizes and tables stand before this text. */

static void monitor_calm(PREFIX_monitor *m)
{
    int i;
    for (i = 0; i < MEANS * CHANNELS + SHAPES; i++) {
        m->swing_high[i] = m->swing_low[i] = m->swing_count[i] = 0;
        m->swing_side[i] = 0;
    }
    m->swing_row = 0;
}

static void monitor_reset(PREFIX_monitor *m)
{
    int i, j;
    for (i = 0; i < ORDER; i++) {
        for (j = 0; j < CHANNELS; j++) {
            m->past[i * CHANNELS + j] = monitor_mean[0][j];
        }
    }
    for (i = 0; i < OLDEST * CHANNELS; i++) {
        m->white[i] = 0;
    }
    for (i = 0; i < MEANS * CHANNELS; i++) {
        m->means[i] = 0;
    }
    for (i = 0; i < CHANNELS; i++) {
        m->slow[i] = 0;
    }
    for (i = 0; i < (1 + MONITOR_WIDTH) * MONITOR_WIDTH; i++) {
        m->before[i] = NAN;
    }
    for (i = 0; i < MONITOR_ESTIMATES; i++) {
        m->centres[i] = monitor_centres[0][i];
    }
    for (i = 0; i < OLDEST * 2 * MONITOR_WIDTH; i++) {
        m->scores[i] = 0;
    }
    for (i = 0; i < CHANNELS + MONITOR_WIDTH; i++) {
        m->own[i] = 0;
    }
    monitor_calm(m);
    m->begun = m->ended = m->stood = 0;
    m->roots = 0;
    m->room = 1;
    for (i = 0; i < MONITOR_OUTPUTS; i++) {
        m->repeated[i] = 0;
        m->equal[i] = 0;
    }
    for (i = 0; i < OLDEST * MONITOR_INPUTS; i++) {
        m->raised[i] = 1;
    }
    for (i = 0; i < MONITOR_INPUTS; i++) {
        m->raised_now[i] = 1;
    }
    m->at = 0;
    m->taken = 0;
    m->decided = 0;
    m->to_wait = 0;
    m->statistic = NAN;
    m->alarm = m->event = m->quiet = m->alarmed = 0;
    m->fault = -1;
}

/* Leave out what each output repeats for longer than it ever did: its sensor may be stuck. */
static void monitor_unrepeat(PREFIX_monitor *m, REAL *y)
{
    int i;
    for (i = 0; i < MONITOR_OUTPUTS; i++) {
        if (!isfinite(y[i])) {
            continue;
        }
        m->equal[i] = m->equal[i] > 0 && y[i] == m->repeated[i] ? m->equal[i] + 1 : 1;
        m->repeated[i] = y[i];
        if (monitor_longest[i] > 0 && m->equal[i] >= monitor_longest[i]) {
            y[i] = NAN;
        }
    }
}

/* How many times the half of its range each input of a row is from the middle: one within what was learned. */
static void monitor_range(PREFIX_monitor *m, const REAL *u)
{
    int i;
    for (i = 0; i < MONITOR_INPUTS; i++) {
        REAL away = ABS(u[i] - monitor_middle[0][i]);
        m->raised_now[i] = monitor_half[0][i] > 0 && away > monitor_half[0][i] ? away / monitor_half[0][i] : 1;
    }
}

/* The levels, whose roots are raised by the share of them that follows each input. */
static void monitor_raise(const PREFIX_monitor *m, REAL *levels)
{
    REAL farthest[MONITOR_INPUTS + 1];
    int i, j;
    for (i = 0; i < MONITOR_INPUTS; i++) {
        farthest[i] = 1;
        for (j = 0; j < OLDEST; j++) {
            REAL far = m->raised[j * MONITOR_INPUTS + i];
            farthest[i] = far > farthest[i] ? far : farthest[i];
        }
    }
    for (j = 0; j < MONITOR_STATISTICS; j++) {
        REAL root = 1;
        for (i = 0; i < MONITOR_INPUTS; i++) {
            root += (farthest[i] - 1) * monitor_rates[i][j];
        }
        levels[j] = monitor_levels[0][j] * (root * root) * m->room;
    }
}

/* What the autoregression says of the next row. */
static void monitor_predict(const PREFIX_monitor *m, REAL *predicted)
{
    int i, j, k;
    for (i = 0; i < CHANNELS; i++) {
        REAL sum = 0;
        for (k = 0; k < ORDER; k++) {
            for (j = 0; j < CHANNELS; j++) {
                sum += monitor_A[k * CHANNELS + i][j] * m->past[k * CHANNELS + j];
            }
        }
        predicted[i] = monitor_offset[0][i] + sum;
    }
}

/* Let the values that are not seen be what those that are make most likely. */
static void monitor_complete(const PREFIX_monitor *m, const int *seen, REAL *x)
{
    REAL predicted[CHANNELS];
    REAL away[CHANNELS];
    REAL rows[CHANNELS][CHANNELS];
    int i, j, k;
    monitor_predict(m, predicted);
    for (i = 0; i < CHANNELS; i++) {
        away[i] = seen[i] ? x[i] - predicted[i] : 0;
    }
    for (i = 0; i < CHANNELS; i++) {
        for (j = 0; j < CHANNELS; j++) {
            rows[i][j] = seen[i] || seen[j] ? (REAL)(i == j) : monitor_precision[i][j];
        }
        if (!seen[i]) {
            for (j = 0; j < CHANNELS; j++) {
                away[i] -= seen[j] ? monitor_precision[i][j] * (x[j] - predicted[j]) : 0;
            }
        }
    }
    /* Positive definite: no pivots are needed. */
    for (i = 0; i < CHANNELS; i++) {
        for (j = i + 1; j < CHANNELS; j++) {
            REAL share = rows[j][i] / rows[i][i];
            for (k = i; k < CHANNELS; k++) {
                rows[j][k] -= share * rows[i][k];
            }
            away[j] -= share * away[i];
        }
    }
    for (i = CHANNELS - 1; i >= 0; i--) {
        for (j = i + 1; j < CHANNELS; j++) {
            away[i] -= rows[i][j] * away[j];
        }
        away[i] /= rows[i][i];
        x[i] = seen[i] ? x[i] : predicted[i] + away[i];
    }
}

/* By which share of a row offsets follow it: also those that a start was taken for, and more slowly in an alarm. */
static REAL monitor_share(const PREFIX_monitor *m)
{
    if (m->ended) {
        return m->alarmed ? MONITOR_FOLLOW_LATER_IN_ALARM : MONITOR_FOLLOW_LATER;
    }
    return m->alarmed ? MONITOR_FOLLOW_IN_ALARM : MONITOR_FOLLOW;
}

/* Take a row of what is watched, whose evidence has a norm of `most` at most; `x` is NULL for one as predicted, and
 * `kept` is what later rows are predicted from. */
static void monitor_add(PREFIX_monitor *m, const REAL *x, const REAL *kept, REAL most)
{
    REAL predicted[CHANNELS];
    REAL *e;
    REAL size = 0;
    int i, j, k;
    monitor_predict(m, predicted);
    m->at = (m->at + 1) % OLDEST;
    e = m->white + m->at * CHANNELS;
    for (i = 0; i < CHANNELS; i++) {
        e[i] = 0;
        for (j = 0; x != NULL && most > 0 && j < CHANNELS; j++) {
            e[i] += monitor_whitener[i][j] * (x[j] - predicted[j]);
        }
        size += e[i] * e[i];
    }
    size = (REAL)sqrt(size);
    for (i = 0; size > most && i < CHANNELS; i++) {
        e[i] *= most / size;
    }
    /* Follow a slow offset, by no more than noise moves it; more slowly in an alarm. */
    for (i = 0; MONITOR_OFFSET && x != NULL && most > 0 && i < CHANNELS; i++) {
        REAL away = e[i] - m->slow[i];
        e[i] = away;
        away = away > MONITOR_FOLLOWED_MOST ? MONITOR_FOLLOWED_MOST : away;
        away = away < -MONITOR_FOLLOWED_MOST ? -MONITOR_FOLLOWED_MOST : away;
        m->slow[i] += monitor_share(m) * (isnan(away) ? 0 : away);
    }
    for (k = 0; k < MEANS; k++) {
        for (i = 0; i < CHANNELS; i++) {
            REAL *mean = m->means + k * CHANNELS + i;
            *mean = (1 - monitor_shares[0][k]) * *mean + monitor_shares[0][k] * e[i];
        }
    }
    for (i = ORDER * CHANNELS - 1; i >= CHANNELS; i--) {
        m->past[i] = m->past[i - CHANNELS];
    }
    for (i = 0; ORDER > 0 && i < CHANNELS; i++) {
        m->past[i] = x != NULL ? kept[i] : predicted[i];
    }
}

static REAL square(const REAL *x)
{
    REAL sum = 0;
    int i;
    for (i = 0; i < CHANNELS; i++) {
        sum += x[i] * x[i];
    }
    return sum;
}

/* By how much a value is further from zero than a band; what is no number stays none. */
static REAL beyond(REAL value, REAL band)
{
    REAL far = ABS(value) - band;
    return far <= 0 ? 0 : far;
}

/* How far a statistic is on each side of late, whose ratio to its level has the sign of that; return by which factor
 * levels are raised where it swings: it changes sides, where a fault stays on one. */
static REAL monitor_swing(PREFIX_monitor *m, int i, REAL ratio)
{
    REAL both;
    int side;
    ratio = isfinite(ratio) ? ratio : 0;
    side = ABS(ratio) > MONITOR_SWING ? (ratio > 0 ? 1 : -1) : 0;
    m->swing_high[i] *= MONITOR_SWING_KEPT;
    m->swing_low[i] *= MONITOR_SWING_KEPT;
    m->swing_count[i] *= MONITOR_SWING_KEPT;
    m->swing_high[i] = ratio > m->swing_high[i] ? ratio : m->swing_high[i];
    m->swing_low[i] = -ratio > m->swing_low[i] ? -ratio : m->swing_low[i];
    if (side != 0 && side != m->swing_side[i]) {
        m->swing_side[i] = side;
        m->swing_count[i] += 1;
    }
    both = m->swing_high[i] < m->swing_low[i] ? m->swing_high[i] : m->swing_low[i];
    /* Noise that is slower makes means larger than single rows. */
    both /= m->swing_row > 1 ? m->swing_row : 1;
    return m->swing_count[i] > MONITOR_LEAST_SWINGS && both > MONITOR_SWING
               ? 1 + MONITOR_SWING_ROOM * (both - MONITOR_SWING)
               : 1;
}

/* The largest likelihood ratio over all ages of one step or ramp, and its sign. */
static REAL likelihood_ratio(const PREFIX_monitor *m, int shape, int *sign)
{
    REAL flat = 0;
    REAL rising = 0;
    REAL weighted = 0;
    REAL largest = 0;
    int back = 0;
    int age, i, j;
    *sign = 1;
    for (age = 0; age < AGES; age++) {
        REAL fit;
        int is_below;
        for (; back < monitor_ages[age]; back++) {
            const REAL *e = m->white + (m->at - back + OLDEST) % OLDEST * CHANNELS;
            REAL slope = 0;
            for (i = 0; i < CHANNELS; i++) {
                flat += monitor_flat[shape][i] * e[i];
                slope += monitor_slopes[shape][i] * e[i];
            }
            rising += slope;
            weighted += (REAL)back * slope;
        }
        fit = flat + (REAL)(monitor_ages[age] - 1) * rising - weighted;
        for (j = 0; j < ORDER && j < monitor_ages[age]; j++) {
            const REAL *e = m->white + (m->at - (monitor_ages[age] - 1 - j) + OLDEST) % OLDEST * CHANNELS;
            for (i = 0; i < CHANNELS; i++) {
                fit += monitor_early[shape * (ORDER + 1) + j][i] * e[i];
            }
        }
        is_below = fit < 0;
        fit = beyond(fit * monitor_roots[shape][age], monitor_effects[shape][age]);
        fit = fit * fit;
        if (!(fit <= largest)) {
            largest = isnan(fit) ? (REAL)HUGE_VAL : fit;
            *sign = is_below ? -1 : 1;
        }
    }
    return largest;
}

/* Put the inverse of a definite matrix in its place; return whether there is one. */
static int inverted(REAL *a)
{
    int is_finite = 1;
    int i, j, k;
    for (k = 0; k < MONITOR_ESTIMATES; k++) {
        REAL pivot = 1 / a[k * MONITOR_WIDTH + k];
        a[k * MONITOR_WIDTH + k] = 1;
        for (j = 0; j < MONITOR_ESTIMATES; j++) {
            a[k * MONITOR_WIDTH + j] *= pivot;
        }
        for (i = 0; i < MONITOR_ESTIMATES; i++) {
            REAL share = a[i * MONITOR_WIDTH + k];
            if (i == k) {
                continue;
            }
            a[i * MONITOR_WIDTH + k] = 0;
            for (j = 0; j < MONITOR_ESTIMATES; j++) {
                a[i * MONITOR_WIDTH + j] -= share * a[k * MONITOR_WIDTH + j];
            }
        }
    }
    for (i = 0; i < MONITOR_ESTIMATES * MONITOR_ESTIMATES; i++) {
        is_finite = is_finite && isfinite(a[i]);
    }
    return is_finite;
}

/* What a sample says of the faults: what it added to the information on them, and the score of a change, which counts
 * less of a sample without all outputs. */
static void monitor_score(PREFIX_monitor *m, const REAL *theta, const REAL *covariance, int has_all)
{
    REAL own[MONITOR_WIDTH * MONITOR_WIDTH];
    REAL prior[MONITOR_WIDTH * MONITOR_WIDTH];
    REAL *row = m->scores + m->at * 2 * MONITOR_WIDTH;
    int says = 1;
    int any = 0;
    int i, j;
    for (i = 0; i < 2 * MONITOR_WIDTH; i++) {
        row[i] = 0;
    }
    if (covariance == NULL) {
        return;
    }
    for (i = 0; i < MONITOR_ESTIMATES; i++) {
        says = says && isfinite(theta[i]) && isfinite(m->before[i]);
        for (j = 0; j < MONITOR_ESTIMATES; j++) {
            int at = i * MONITOR_WIDTH + j;
            own[at] = covariance[at];
            prior[at] = m->before[MONITOR_WIDTH + at] + monitor_walk[i][j];
        }
    }
    says = inverted(own) && inverted(prior) && says;
    for (i = 0; i < MONITOR_ESTIMATES; i++) {
        REAL added = own[i * MONITOR_WIDTH + i] - prior[i * MONITOR_WIDTH + i];
        REAL least = MONITOR_LEAST * own[i * MONITOR_WIDTH + i];
        /* A covariance that has grown beside its walk has started again. */
        says = says && added >= -least;
        any = any || added > least;
    }
    for (i = 0; says && any && i < MONITOR_ESTIMATES; i++) {
        for (j = 0; j < MONITOR_ESTIMATES; j++) {
            int at = i * MONITOR_WIDTH + j;
            row[i] += own[at] * (theta[j] - m->centres[j]);
            row[i] -= prior[at] * (m->before[j] - m->centres[j]);
        }
        row[i] *= has_all ? 1 : monitor_partly_measured[0][i];
        row[MONITOR_WIDTH + i] = own[i * MONITOR_WIDTH + i] - prior[i * MONITOR_WIDTH + i];
    }
    for (i = 0; i < MONITOR_ESTIMATES; i++) {
        m->before[i] = theta[i];
        for (j = 0; j < MONITOR_ESTIMATES; j++) {
            m->before[MONITOR_WIDTH + i * MONITOR_WIDTH + j] = covariance[i * MONITOR_WIDTH + j];
        }
    }
}

/* Let the centres of the faults follow the estimates. */
static void monitor_centre(PREFIX_monitor *m, const REAL *theta, const REAL *covariance)
{
    int i;
    for (i = 0; monitor_share(m) > 0 && covariance != NULL && i < MONITOR_ESTIMATES; i++) {
        REAL deviation = (REAL)sqrt(covariance[i * (MONITOR_WIDTH + 1)]);
        REAL away = (theta[i] - m->centres[i]) / deviation;
        REAL moved;
        away = away > MONITOR_FOLLOWED_MOST ? MONITOR_FOLLOWED_MOST : away;
        away = away < -MONITOR_FOLLOWED_MOST ? -MONITOR_FOLLOWED_MOST : away;
        moved = m->centres[i]
            + monitor_share(m) / MONITOR_FAULTS_SLOWER * away * deviation;
        m->centres[i] = isfinite(moved) ? moved : m->centres[i];
    }
}

/* Let levels fall from where the start raised them, to what statistics still reach. */
static void monitor_make_room(PREFIX_monitor *m, REAL reached)
{
    REAL room = m->room * MONITOR_SWING_KEPT;
    reached = reached < m->room ? reached : m->room;
    room = reached > room ? reached : room;
    m->room = room > 1 ? room : 1;
}

/* Let the first rows of a log, once they are enough, be what is usual in it, where there is an alarm; statistics have
 * `reached` so much in units of the levels that were learned. */
static void monitor_own(PREFIX_monitor *m, const REAL *theta, const REAL *covariance, REAL reached)
{
    int is_finite = 1;
    int i;
    if (MONITOR_OWN == 0 || (MONITOR_ESTIMATES > 0 && covariance == NULL) || m->begun >= MONITOR_OWN_LATER) {
        return;
    }
    for (i = 0; i < CHANNELS; i++) {
        REAL white = m->white[m->at * CHANNELS + i] + m->slow[i];
        white = white > MONITOR_OWN_MOST ? MONITOR_OWN_MOST : white;
        white = white < -MONITOR_OWN_MOST ? -MONITOR_OWN_MOST : white;
        m->own[i] += isnan(white) ? 0 : white;
    }
    for (i = 0; i < MONITOR_ESTIMATES; i++) {
        m->own[CHANNELS + i] += theta[i];
    }
    m->begun++;
    if (m->alarmed && isfinite(reached)) {
        m->stood++;
        m->roots += (REAL)sqrt(reached);
    }
    for (i = 0; i < CHANNELS + MONITOR_ESTIMATES; i++) {
        is_finite = is_finite && isfinite(m->own[i]);
    }
    if (!m->alarmed || !is_finite || (m->begun != MONITOR_OWN && m->begun != MONITOR_OWN_LATER)) {
        return;
    }
    /* What is larger than any offset stays an alarm. */
    for (i = 0; i < CHANNELS; i++) {
        if (ABS(m->own[i] / (REAL)m->begun) > MONITOR_NEARLY_MOST * MONITOR_OWN_MOST) {
            return;
        }
    }
    for (i = 0; i < CHANNELS; i++) {
        m->slow[i] = m->own[i] / (REAL)m->begun;
    }
    for (i = 0; i < MONITOR_ESTIMATES; i++) {
        m->centres[i] = m->own[CHANNELS + i] / (REAL)m->begun;
    }
    for (i = 0; i < OLDEST * CHANNELS; i++) {
        m->white[i] = 0;
    }
    for (i = 0; i < MEANS * CHANNELS; i++) {
        m->means[i] = 0;
    }
    for (i = 0; i < OLDEST * 2 * MONITOR_WIDTH; i++) {
        m->scores[i] = 0;
    }
    /* Where nearly all of these rows were in alarm, levels rise by what it reached. */
    if ((REAL)m->stood > MONITOR_MOST_OF_START * (REAL)m->begun) {
        REAL root = m->roots / (REAL)m->stood;
        REAL room = MONITOR_ROOM * root * root;
        m->room = room > m->room ? room : m->room;
    }
    m->alarmed = 0;
    m->ended = 1;
    monitor_calm(m);
}

/* The largest likelihood ratios over all ages of a change of each fault; return the one of which a change alone is more
 * likely than of any other at the most likely age, or -1 where they are not distinguished. */
static int monitor_changes(const PREFIX_monitor *m, REAL *largest)
{
    REAL sums[2 * MONITOR_WIDTH];
    REAL best = -1;
    REAL second = 0;
    int back = 0;
    int fault = -1;
    int age, i;
    for (i = 0; i < 2 * MONITOR_WIDTH; i++) {
        sums[i] = 0;
    }
    for (i = 0; i < MONITOR_ESTIMATES; i++) {
        largest[i] = 0;
    }
    for (age = 0; age < AGES; age++) {
        REAL first = -1;
        REAL next = 0;
        int which = -1;
        for (; back < monitor_ages[age]; back++) {
            const REAL *row = m->scores + (m->at - back + OLDEST) % OLDEST * 2 * MONITOR_WIDTH;
            for (i = 0; i < 2 * MONITOR_WIDTH; i++) {
                sums[i] += row[i];
            }
        }
        for (i = 0; i < MONITOR_ESTIMATES; i++) {
            REAL power = sums[MONITOR_WIDTH + i];
            REAL far = beyond(sums[i], monitor_bands[0][i] * power);
            REAL ratio = power > 0 ? far * far / power : 0;
            largest[i] = ratio <= largest[i] ? largest[i] : ratio;
            /* Faults are compared without what their slow offsets explain: each has its own. */
            ratio = power > 0 ? sums[i] * sums[i] / power : 0;
            if (ratio > first) {
                next = which >= 0 ? first : 0;
                first = ratio;
                which = i;
            } else if (ratio > next) {
                next = ratio;
            }
        }
        if (first > best) {
            best = first;
            second = next;
            fault = which;
        }
    }
    return best - second > MONITOR_APART && best - second > MONITOR_SHARE * best ? fault : -1;
}

/* Take a row: fault estimates, then residuals; `covariance`: that of the fault estimates, or NULL where the observer has
 * none; `is_gap`: nothing was measured, and the estimates are those of before; `innovation`: its norm in the observer's
 * own covariance, or less than zero where the gain does not follow what is measured. */
static void monitor_take(PREFIX_monitor *m, const REAL *shown, const REAL *covariance, int deciding, int is_gap,
                         REAL innovation)
{
    REAL x[CHANNELS];
    REAL kept[CHANNELS];
    REAL changes[MONITOR_WIDTH];
    REAL ratio, statistic;
    REAL best = -1;
    REAL levels[MONITOR_STATISTICS];
    REAL slow = 0;
    REAL raised = 1;
    int changed = -1;
    int which = 0;
    int is_said = !is_gap;
    int is_whole = deciding;
    int has_all = 1;
    int is_partly = 0;
    int seen[CHANNELS];
    REAL most = (REAL)HUGE_VAL;
    int known, sign, i, j;
    /* The first rows are predicted from rows that were not there. */
    if (MONITOR_RESTS && innovation < 0 && m->taken == 0) {
        m->to_wait = ORDER;
    }
    m->taken += m->taken <= MONITOR_SETTLING;
    m->decided = m->decided || deciding;
    /* Rows that are predicted from those of a warm-up were not learned from. */
    if (MONITOR_RESTS && innovation < 0 && !m->decided) {
        m->to_wait = ORDER + 1;
    }
    for (i = 0; i < CHANNELS; i++) {
        x[i] = shown[monitor_places[i]];
        is_said = is_said && isfinite(x[i]);
        seen[i] = monitor_places[i] >= MONITOR_FAULTS && isfinite(x[i]);
        is_partly = is_partly || seen[i];
    }
    for (i = 0; i < MONITOR_WATCHED; i++) {
        has_all = has_all && (isfinite(shown[i]) || monitor_seldom[i]);
    }
    is_whole = is_whole && has_all;
    is_partly = is_partly && deciding && !is_whole && innovation >= 0;
    for (i = 0; i < CHANNELS; i++) {
        kept[i] = x[i];
    }
    if (is_partly) {
        monitor_complete(m, seen, x);
        for (i = 0; i < CHANNELS; i++) {
            kept[i] = isfinite(kept[i]) ? kept[i] : x[i];
        }
    }
    known = (is_whole || is_partly) && m->taken > MONITOR_SETTLING;
    /* Where the gain follows what is measured, a missing sample moves the estimates otherwise than was learned: rows
     * that are predicted from that one count by no more than the observer's own covariance, which has grown, says. In
     * that row itself the innovations that are there are what they always are. */
    if (m->to_wait > 0) {
        most = innovation < 0 ? 0 : innovation / monitor_innovation[0][0];
    }
    if (!is_whole && innovation >= 0) {
        m->to_wait = ORDER + 1;
    }
    m->to_wait -= m->to_wait > 0;
    /* What follows a warm-up is predicted from its last rows. */
    is_said = is_whole || ((innovation >= 0 || !m->decided) && (is_said || known));
    /* Rows that are predicted from a missing one add no evidence where a column is predicted closely. */
    if (MONITOR_RESTS && !is_said && innovation < 0) {
        m->to_wait = ORDER;
    }
    monitor_add(m, is_said ? x : NULL, kept, known ? most : 0);
    monitor_score(m, shown, covariance, has_all);
    if (deciding && m->taken > MONITOR_SETTLING) {
        monitor_centre(m, shown, covariance);
    }
    for (i = 0; i < MONITOR_INPUTS; i++) {
        m->raised[m->at * MONITOR_INPUTS + i] = m->raised_now[i];
        m->raised_now[i] = 1;
    }
    m->statistic = NAN;
    m->alarm = 0;
    m->fault = -1;
    /* Without evidence of its own a sample with fewer outputs is decided by the rows before it. */
    if (known || (deciding && innovation >= 0 && m->taken > MONITOR_SETTLING)) {
        monitor_raise(m, levels);
        statistic = square(m->white + m->at * CHANNELS) / levels[0];
        m->swing_row *= MONITOR_ROW_KEPT;
        m->swing_row = isfinite(statistic) && statistic > m->swing_row ? statistic : m->swing_row;
        for (i = 0; i < MEANS; i++) {
            ratio = square(m->means + i * CHANNELS) * monitor_sizes[0][i] / levels[1 + i];
            slow = ratio <= slow ? slow : ratio;
            for (j = 0; j < CHANNELS; j++) {
                REAL mean = m->means[i * CHANNELS + j];
                ratio = monitor_swing(m, i * CHANNELS + j, monitor_sizes[0][i] / levels[1 + i] * mean * ABS(mean));
                raised = ratio > raised ? ratio : raised;
            }
        }
        for (i = 0; i < SHAPES; i++) {
            ratio = likelihood_ratio(m, i, &sign);
            if (ratio > best) {
                best = ratio;
                which = i;
            }
            ratio /= levels[1 + MEANS + i];
            slow = ratio <= slow ? slow : ratio;
            ratio = monitor_swing(m, MEANS * CHANNELS + i, (REAL)sign * ratio);
            raised = ratio > raised ? ratio : raised;
        }
        slow /= raised;
        statistic = slow <= statistic ? statistic : slow;
        changed = monitor_changes(m, changes);
        for (i = 0; i < MONITOR_ESTIMATES; i++) {
            REAL away = beyond(shown[i] - m->centres[i], monitor_bands[0][i]);
            ratio = changes[i] / levels[1 + MEANS + SHAPES + i];
            statistic = ratio <= statistic ? statistic : ratio;
            if (covariance != NULL) {
                ratio = away * away / covariance[i * (MONITOR_WIDTH + 1)];
                ratio /= levels[1 + MEANS + SHAPES + MONITOR_ESTIMATES + i];
                statistic = ratio <= statistic ? statistic : ratio;
            }
        }
        m->statistic = isnan(statistic) ? (REAL)HUGE_VAL : statistic;
        m->alarm = m->statistic > 1;
        m->alarmed = m->alarm;
        statistic = m->statistic * m->room;
        monitor_make_room(m, statistic);
        if (known) {
            monitor_own(m, shown, covariance, statistic);
        }
    }
    if (m->alarm) {
        m->fault = MONITOR_ESTIMATES > 0 ? changed : monitor_told[which % (SHAPES / 2)];
        if (m->fault < 0 && MONITOR_ESTIMATES == 0) {
            best = -1;
            for (i = 0; i < MONITOR_FAULTS; i++) {
                ratio = ABS(shown[i] - monitor_centres[0][i]) / monitor_scales[0][i];
                if (ratio > best) {
                    best = ratio;
                    m->fault = i;
                }
            }
        }
        m->event = 1;
        m->quiet = 0;
    } else if (m->event && ++m->quiet >= MONITOR_HOLD) {
        m->event = 0;
    }
}
