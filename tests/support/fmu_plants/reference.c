/* Equations of three reference models of FMI, written for these tests, for model exchange by FMI 2.0 (-DFMI2) or 3.0:
   Dahlquist x' = -k x; Van der Pol x0' = x1, x1' = mu (1 - x0^2) x1 - x0; a state space x' = A x + B u, y = C x + D u
   of arrays. With -DDERIVATIVES they tell directional derivatives, but none of outputs that are states. */
#include <stdbool.h>
#include <stdlib.h>

#ifdef DAHLQUIST
enum { TIME, X, DER_X, K, N };
static const int at[] = {0, 1, 2, 3, 4};
static const int states[] = {X};
static const double start[] = {0, 1, 0, 1.5};
static void calculate(double *v) { v[DER_X] = -v[K] * v[X]; }
static double partial(const double *v, int row, int column) { return row == DER_X && column == X ? -v[K] : 0; }
#endif
#ifdef VANDERPOL
enum { TIME, X0, DER_X0, X1, DER_X1, MU, N };
static const int at[] = {0, 1, 2, 3, 4, 5, 6};
static const int states[] = {X0, X1};
static const double start[] = {0, 2, 0, 0, 0, 1};
static void calculate(double *v)
{
    v[DER_X0] = v[X1];
    v[DER_X1] = v[MU] * (1 - v[X0] * v[X0]) * v[X1] - v[X0];
}
static double partial(const double *v, int row, int column)
{
    if (row == DER_X0) return column == X1;
    if (row == DER_X1) return column == X0 ? -2 * v[MU] * v[X0] * v[X1] - 1 : column == X1 ? v[MU] * (1 - v[X0] * v[X0]) : 0;
    return 0;
}
#endif
#ifdef STATESPACE
/* x of 2, u of 1, y of 3; the reference of a variable is its number, its entries follow each other. */
enum { TIME, A, B, C, D, U, X, DER_X, Y, N };
static const int at[] = {0, 1, 5, 7, 13, 16, 17, 19, 21, 24};
static const int states[] = {X};
static const double start[] = {0, -1, .5, 0, -2, 1, 2, 1, 0, 3, 4, 0, 0, 0, 5, .25, .1, 0, 0, 0, 0, 0, 0, 0};
static void calculate(double *v)
{
    int i, j;
    for (i = 0; i < 2; i++)
        for (v[at[DER_X] + i] = v[at[B] + i] * v[at[U]], j = 0; j < 2; j++)
            v[at[DER_X] + i] += v[at[A] + 2 * i + j] * v[at[X] + j];
    for (i = 0; i < 3; i++)
        for (v[at[Y] + i] = v[at[D] + i] * v[at[U]], j = 0; j < 2; j++)
            v[at[Y] + i] += v[at[C] + 2 * i + j] * v[at[X] + j];
}
static double partial(const double *v, int row, int column)
{
    /* Rows and columns are entries here. */
    int i = row - at[DER_X], y = row - at[Y], x = column - at[X];
    if (row >= at[Y]) return column == at[U] ? v[at[D] + y] : x >= 0 && x < 2 ? v[at[C] + 2 * y + x] : 0;
    if (row >= at[DER_X]) return column == at[U] ? v[at[B] + i] : x >= 0 && x < 2 ? v[at[A] + 2 * i + x] : 0;
    return 0;
}
#endif

static void *make(void)
{
    double *v = calloc(at[N], sizeof *v);
    int i;
    for (i = 0; i < at[N]; i++) v[i] = start[i];
    return v;
}
static int got(void *c, const unsigned vr[], size_t n, double value[])
{
    double *v = c;
    size_t i;
    int k;
    calculate(v);
    for (i = 0; i < n; i++)
        for (k = at[vr[i]]; k < at[vr[i] + 1]; k++) *value++ = v[k];
    return 0;
}
static int set(void *c, const unsigned vr[], size_t n, const double value[])
{
    double *v = c;
    size_t i;
    int k;
    for (i = 0; i < n; i++)
        for (k = at[vr[i]]; k < at[vr[i] + 1]; k++) v[k] = *value++;
    return 0;
}
static int set_states(void *c, const double x[])
{
    double *v = c;
    size_t i;
    int k;
    for (i = 0; i < sizeof states / sizeof *states; i++)
        for (k = at[states[i]]; k < at[states[i] + 1]; k++) v[k] = *x++;
    return 0;
}
static int directional(void *c, const unsigned u[], size_t nu, const unsigned known[], size_t nk, const double seed[], double value[])
{
#ifdef DERIVATIVES
    size_t i, j;
    int row, column;
    for (i = 0; i < nu; i++)
        for (row = at[u[i]]; row < at[u[i] + 1]; row++, value++) {
            const double *of = seed;
            for (*value = 0, j = 0; j < nk; j++)
                for (column = at[known[j]]; column < at[known[j] + 1]; column++) *value += partial(c, row, column) * *of++;
        }
    return 0;
#else
    return 3;
#endif
}

#ifdef FMI2
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
int fmi2GetReal(void *c, const unsigned vr[], size_t n, double value[]) { return got(c, vr, n, value); }
int fmi2SetReal(void *c, const unsigned vr[], size_t n, const double value[]) { return set(c, vr, n, value); }
int fmi2SetContinuousStates(void *c, const double x[], size_t n) { return set_states(c, x); }
int fmi2GetDirectionalDerivative(void *c, const unsigned u[], size_t nu, const unsigned k[], size_t nk,
                                 const double seed[], double value[]) { return directional(c, u, nu, k, nk, seed, value); }
#else
const char *fmi3GetVersion(void) { return "3.0"; }
void *fmi3InstantiateModelExchange(const char *n, const char *t, const char *r, bool v, bool l, void *e, void *f) { return make(); }
void fmi3FreeInstance(void *c) { free(c); }
int fmi3EnterInitializationMode(void *c, bool a, double b, double d, bool e, double f) { return 0; }
int fmi3ExitInitializationMode(void *c) { return 0; }
int fmi3UpdateDiscreteStates(void *c, bool *a, bool *b, bool *d, bool *e, bool *f, double *t) { *a = *b = *d = *e = *f = 0; return 0; }
int fmi3EnterContinuousTimeMode(void *c) { return 0; }
int fmi3Terminate(void *c) { return 0; }
int fmi3GetFloat64(void *c, const unsigned vr[], size_t n, double value[], size_t nv) { return got(c, vr, n, value); }
int fmi3SetFloat64(void *c, const unsigned vr[], size_t n, const double value[], size_t nv) { return set(c, vr, n, value); }
int fmi3SetContinuousStates(void *c, const double x[], size_t n) { return set_states(c, x); }
int fmi3GetDirectionalDerivative(void *c, const unsigned u[], size_t nu, const unsigned k[], size_t nk, const double seed[],
                                 size_t ns, double value[], size_t nv) { return directional(c, u, nu, k, nk, seed, value); }
#endif
