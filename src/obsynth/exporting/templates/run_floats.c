#include "observer.h"
int run(const float *in, double *out, int samples)
{
    static PREFIX_state state;
    PREFIX_estimates found;
    int k, i;
    PREFIX_reset(&state);
    for (k = 0; k < samples; k++) {
        if (PREFIX_step(&state, ARGUMENTS, &found) == 2) {
            return k;
        }
        for (i = 0; i < STATES; i++) {
            out[i] = found.states[i];
        }
        for (i = 0; i < FAULTS; i++) {
            out[STATES + i] = found.faults[i];
        }
        in += TAKEN;
        out += STATES + FAULTS;
    }
    return samples;
}
