
long state_bytes(void)
{
    return (long)sizeof(struct observer);
}

void start(struct observer *state)
{
    begin(state);
}

/* Go on over some samples; returns the number of those that were taken. */
int record(struct observer *state, int samples, const double *u, const double *y, double *after, double *said)
{
    int k;
    double received[NY];
    for (k = 0; k < samples; k++) {
        if (advance(state, u + k * NU, y + k * NY, received, said + (long)k * ROW) != 0) {
            return k;
        }
        copy(after + (long)k * MEMORY, state->memory, MEMORY);
    }
    return samples;
}

static void hand_out(double *out, const double *after, const double *said)
{
/* PARTS */
}

/* Run over several records one after the other, with inputs `apart` numbers apart; returns the first run that
   cannot be finished, or their number. */
int batch(int runs, int samples, long apart, const double *u, const double *y, double *out)
{
    struct observer state;
    double received[NY];
    double said[ROW];
    int run, k;
    for (run = 0; run < runs; run++) {
        begin(&state);
        for (k = 0; k < samples; k++) {
            long row = (long)run * samples + k;
            if (advance(&state, u + run * apart + (long)k * NU, y + row * NY, received, said) != 0) {
                return run;
            }
            hand_out(out + row * PARTS_SIZE, state.memory, said);
        }
    }
    return runs;
}
