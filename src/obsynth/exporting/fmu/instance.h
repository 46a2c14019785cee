/* What both versions of FMI share: one instance, its values, and one sample. The sizes are in layout.h. */
#ifndef OBSYNTH_FMU_INSTANCE_H
#define OBSYNTH_FMU_INSTANCE_H

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "layout.h"

#if defined(_WIN32)
#define EXPORTED __declspec(dllexport)
#elif defined(__GNUC__) && __GNUC__ >= 4
#define EXPORTED __attribute__((visibility("default")))
#else
#define EXPORTED
#endif

/* The largest share of the sampling time by which a communication step may differ from a multiple of it. */
#define FITTING_SHARE 0.01

/* real[]: time, inputs, outputs, operating points, thresholds, warm-up; flag[]: one alarm each, any alarm, sample used. */
#define AT_IN 1
#define AT_OUT (AT_IN + N_IN)
#define AT_POINT (AT_OUT + N_OUT)
#define AT_THRESHOLD (AT_POINT + N_POINT)
#define AT_WARM_UP (AT_THRESHOLD + N_WATCHED)
#define N_REAL (AT_WARM_UP + 1)
#define AT_ANY N_WATCHED
#define AT_USED (N_WATCHED + 1)
#define N_FLAG (N_WATCHED + 2)

typedef struct {
    double real[N_REAL];
    int flag[N_FLAG];
    observer_memory memory;
} instance;

static double point_of(const instance *m, int i)
{
    return i < 0 ? 0.0 : m->real[AT_POINT + i];
}

static void begin(instance *m)
{
    int i;
    memcpy(m->real, start_values, sizeof m->real);
    for (i = 0; i < N_FLAG; i++) {
        m->flag[i] = 0;
    }
    begin_observer(&m->memory);
}

/* After the operating point may have been set: estimates start at it. */
static void show_start(instance *m)
{
    int i;
    for (i = 0; i < N_OUT; i++) {
        m->real[AT_OUT + i] = point_of(m, point_of_out[i]);
    }
}

/* One sample: the inputs as they are, the estimates at that sample. Returns 0; 1 where the model went on alone; 2 if
   nothing could be taken. */
static int sample(instance *m)
{
    double in[N_IN + 1];
    double out[N_OUT + 1];
    int i, failed;
    m->memory.warm_up = m->real[AT_WARM_UP];
    for (i = 0; i < N_WATCHED; i++) {
        m->memory.level[i] = m->real[AT_THRESHOLD + i];
    }
    for (i = 0; i < N_IN; i++) {
        in[i] = m->real[AT_IN + i] - point_of(m, point_of_in[i]);
    }
    failed = take_sample(&m->memory, in, out);
    m->flag[AT_USED] = failed != 2 && m->memory.status != OBSERVER_GAP;
    m->flag[AT_ANY] = 0;
    if (failed != 2) {
        for (i = 0; i < N_OUT; i++) {
            m->real[AT_OUT + i] = out[i] + point_of(m, point_of_out[i]);
        }
    }
    for (i = 0; i < N_WATCHED; i++) {
        m->flag[i] = failed != 2 && m->memory.alarm[i];
        m->flag[AT_ANY] |= m->flag[i];
    }
    return failed;
}

/* Samples for a communication step; the inputs are held where it spans several. Returns 0 if the step fits. */
static int advance_to(instance *m, double from, double step)
{
    double count = floor(step / DT + 0.5);
    long k, samples;
    if (!(count >= 1.0) || fabs(step - count * DT) > FITTING_SHARE * DT || count > 1e9) {
        return 1;
    }
    samples = (long)count;
    for (k = 0; k < samples; k++) {
        m->real[0] = from + (double)k * DT;
        sample(m);
    }
    m->real[0] = from + step;
    return 0;
}

static int may_set(size_t reference)
{
    return (reference >= AT_IN && reference < AT_OUT) || (reference >= AT_POINT && reference < N_REAL);
}

#endif
