/* OBSERVER */
/* VERIFIED */
ALARMS
#ifndef UPPER_H
#define UPPER_H

/* sha256 of the gain set */
#define UPPER_SHA256 "DIGEST"
/* seconds between samples */
#define UPPER_DT SECONDS
/* outputs that may be watched */
#define UPPER_WATCHED COUNT_OF_LEVELS

STATUSES

STRUCTS
typedef struct {
/* Read these after a step: what the row was, what passed its level. */
    int status;
    int alarm[SOME_LEVELS];
    int any_alarm;
/* Set these after the reset: levels (0 for none), and seconds without alarms after the start. */
    double level[SOME_LEVELS];
    double warm_up;
    MONITOR
/* Everything else is the observer's own. */
    struct PREFIX_observer running;
    double u[SOME_NU];
    double time, from;
    long k;
    double spread[SOME_NQ], usual[SOME_NQ];
    int is_started, is_whole, phase;
} PREFIX_state;

/* States after the measurement, parameters, their standard deviations; innovations (NaN where y is); */
/* their square in units of their covariance; the residual of the step in sizes of the states. */
typedef struct {
    double states[NX];
    double state_deviations[NX];
    double faults[SOME_NQ];
    double fault_deviations[SOME_NQ];
    double residuals[NY];
    double nis;
    double step_residual;
} PREFIX_estimates;

/* Start as the design does. */
void PREFIX_reset(PREFIX_state *state);

/* Take one sample: y at this sample, and u during the step that ends at it; what is missing is NaN. */
/* A missing output is replaced by its prediction, a missing input by its last value. Returns 0; 1 if */
/* inputs are missing (status GAP; estimates are NaN before all of them have been known); 2 if the */
/* step has no solution: state and estimates are left as they were then. */
SIGNALS
int PREFIX_step(PREFIX_state *state, INPUTSconst double y[NY], PREFIX_estimates *estimates);

#endif
