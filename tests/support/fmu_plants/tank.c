/* A tank that drains through a hole, for model exchange by FMI 2.0: level' = (inflow - c sqrt(level)) / area. */
#include <math.h>
#include <stdlib.h>

enum { LEVEL, DER_LEVEL, INFLOW, AREA, C, OUTFLOW, TEMPERATURE, DER_TEMPERATURE, WARM, N };
typedef struct { double v[N]; } tank;

static void calculate(tank *m)
{
    m->v[OUTFLOW] = m->v[C] * sqrt(m->v[LEVEL]);
    m->v[DER_LEVEL] = (m->v[INFLOW] - m->v[OUTFLOW]) / m->v[AREA];
    m->v[DER_TEMPERATURE] = m->v[INFLOW] * (m->v[WARM] - m->v[TEMPERATURE]) / (m->v[AREA] * m->v[LEVEL]);
}

static double partial(const tank *m, unsigned unknown, unsigned known)
{
    double level = m->v[LEVEL], rate = m->v[C] / (2 * sqrt(level)), volume = m->v[AREA] * level;
    double cooler = m->v[WARM] - m->v[TEMPERATURE];
    if (unknown == OUTFLOW) return known == LEVEL ? rate : 0;
    if (unknown == LEVEL) return known == LEVEL;
    if (unknown == TEMPERATURE) return known == TEMPERATURE;
    if (unknown == DER_LEVEL) return known == LEVEL ? -rate / m->v[AREA] : known == INFLOW ? 1 / m->v[AREA] : 0;
    if (known == LEVEL) return -m->v[INFLOW] * cooler / (volume * level);
    if (known == INFLOW) return cooler / volume;
    if (known == TEMPERATURE) return -m->v[INFLOW] / volume;
    return known == WARM ? m->v[INFLOW] / volume : 0;
}

static void *make(void)
{
    tank *m = calloc(1, sizeof *m);
    m->v[LEVEL] = 1; m->v[INFLOW] = 0.2; m->v[AREA] = 2; m->v[C] = 0.1; m->v[TEMPERATURE] = 300; m->v[WARM] = 300;
    return m;
}

#ifndef FMI3
typedef struct { int needed, terminate, nominals, values, defined; double time; } event;
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
void *fmi2Instantiate(const char *n, int t, const char *g, const char *r, const void *f, int v, int l) { return make(); }
void fmi2FreeInstance(void *c) { free(c); }
int fmi2SetupExperiment(void *c, int a, double b, double d, int e, double f) { return 0; }
int fmi2EnterInitializationMode(void *c) { return 0; }
int fmi2ExitInitializationMode(void *c) { return 0; }
int fmi2NewDiscreteStates(void *c, event *e) { e->needed = e->terminate = e->nominals = e->values = e->defined = 0; return 0; }
int fmi2EnterContinuousTimeMode(void *c) { return 0; }
int fmi2Terminate(void *c) { return 0; }
int fmi2GetReal(void *c, const unsigned vr[], size_t n, double value[])
{
    size_t i;
    calculate(c);
    for (i = 0; i < n; i++) value[i] = ((tank *)c)->v[vr[i]];
    return 0;
}
int fmi2SetReal(void *c, const unsigned vr[], size_t n, const double value[])
{
    size_t i;
    for (i = 0; i < n; i++) ((tank *)c)->v[vr[i]] = value[i];
    return 0;
}
int fmi2SetContinuousStates(void *c, const double x[], size_t n)
{
    ((tank *)c)->v[LEVEL] = x[0];
    ((tank *)c)->v[TEMPERATURE] = x[1];
    return 0;
}
int fmi2GetDirectionalDerivative(void *c, const unsigned u[], size_t nu, const unsigned k[], size_t nk,
                                 const double seed[], double value[])
{
    size_t i, j;
    for (i = 0; i < nu; i++)
        for (value[i] = 0, j = 0; j < nk; j++) value[i] += partial(c, u[i], k[j]) * seed[j];
    return 0;
}
#else
#include <stdbool.h>
const char *fmi3GetVersion(void) { return "3.0"; }
void *fmi3InstantiateModelExchange(const char *n, const char *t, const char *r, bool v, bool l, void *e, void *f) { return make(); }
void fmi3FreeInstance(void *c) { free(c); }
int fmi3EnterInitializationMode(void *c, bool a, double b, double d, bool e, double f) { return 0; }
int fmi3ExitInitializationMode(void *c) { return 0; }
int fmi3UpdateDiscreteStates(void *c, bool *a, bool *b, bool *d, bool *e, bool *f, double *t) { *a = *b = *d = *e = *f = 0; return 0; }
int fmi3EnterContinuousTimeMode(void *c) { return 0; }
int fmi3Terminate(void *c) { return 0; }
int fmi3GetFloat64(void *c, const unsigned vr[], size_t n, double value[], size_t nv)
{
    size_t i;
    calculate(c);
    for (i = 0; i < n; i++) value[i] = ((tank *)c)->v[vr[i]];
    return 0;
}
int fmi3SetFloat64(void *c, const unsigned vr[], size_t n, const double value[], size_t nv)
{
    size_t i;
    for (i = 0; i < n; i++) ((tank *)c)->v[vr[i]] = value[i];
    return 0;
}
int fmi3SetContinuousStates(void *c, const double x[], size_t n)
{
    ((tank *)c)->v[LEVEL] = x[0];
    ((tank *)c)->v[TEMPERATURE] = x[1];
    return 0;
}
int fmi3GetDirectionalDerivative(void *c, const unsigned u[], size_t nu, const unsigned k[], size_t nk,
                                 const double seed[], size_t ns, double value[], size_t nv)
{
    size_t i, j;
    for (i = 0; i < nu; i++)
        for (value[i] = 0, j = 0; j < nk; j++) value[i] += partial(c, u[i], k[j]) * seed[j];
    return 0;
}
#endif
