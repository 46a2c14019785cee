/* FMI 2.0 for co-simulation around the observer. */
#include "instance.h"

typedef void *fmi2Component;
typedef void *fmi2ComponentEnvironment;
typedef void *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer;
typedef int fmi2Boolean;
typedef char fmi2Char;
typedef const fmi2Char *fmi2String;
typedef char fmi2Byte;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;
typedef void (*fmi2CallbackLogger)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
typedef struct {
    fmi2CallbackLogger logger;
    void *(*allocateMemory)(size_t, size_t);
    void (*freeMemory)(void *);
    void (*stepFinished)(fmi2ComponentEnvironment, fmi2Status);
    fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;

#define FMI(name) fmi2##name
#define OF_STATE(before, after) fmi2##before##FMUstate##after
#define DESERIALIZED fmi2DeSerializeFMUstate
#include "common.h"

EXPORTED const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORTED const char *fmi2GetVersion(void) { return "2.0"; }

EXPORTED fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String resources,
                                       const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)name; (void)resources; (void)functions; (void)visible; (void)logging;
    return type == fmi2CoSimulation ? made(token) : NULL;
}

EXPORTED fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start,
                                        fmi2Boolean has_stop, fmi2Real stop)
{
    instance *m = c;
    (void)has_tolerance; (void)tolerance; (void)has_stop; (void)stop;
    m->real[0] = start;
    return fmi2OK;
}

EXPORTED fmi2Status fmi2EnterInitializationMode(fmi2Component c) { (void)c; return fmi2OK; }

EXPORTED fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[])
{
    const instance *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        if (vr[i] >= N_REAL) {
            return fmi2Error;
        }
        value[i] = m->real[vr[i]];
    }
    return fmi2OK;
}

EXPORTED fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[])
{
    instance *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        if (!may_set(vr[i])) {
            return fmi2Error;
        }
        m->real[vr[i]] = value[i];
    }
    return fmi2OK;
}

EXPORTED fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Boolean value[])
{
    const instance *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        if (vr[i] < N_REAL || vr[i] >= N_REAL + N_FLAG) {
            return fmi2Error;
        }
        value[i] = m->flag[vr[i] - N_REAL];
    }
    return fmi2OK;
}

#define NONE(name, type) \
    EXPORTED fmi2Status name(fmi2Component c, const fmi2ValueReference vr[], size_t n, type value[]) \
    { \
        (void)c; (void)vr; (void)value; \
        return n == 0 ? fmi2OK : fmi2Error; \
    }
NONE(fmi2GetInteger, fmi2Integer)
NONE(fmi2GetString, fmi2String)
NONE(fmi2SetInteger, const fmi2Integer)
NONE(fmi2SetBoolean, const fmi2Boolean)
NONE(fmi2SetString, const fmi2String)

EXPORTED fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_return)
{
    (void)no_return;
    return advance_to(c, time, step) ? fmi2Error : fmi2OK;
}

EXPORTED fmi2Status fmi2CancelStep(fmi2Component c) { (void)c; return fmi2Error; }

EXPORTED fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value)
{
    (void)c; (void)s; (void)value;
    return fmi2Discard;
}

EXPORTED fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value)
{
    const instance *m = c;
    if (s != fmi2LastSuccessfulTime) {
        return fmi2Discard;
    }
    *value = m->real[0];
    return fmi2OK;
}

EXPORTED fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value)
{
    (void)c; (void)s; (void)value;
    return fmi2Discard;
}

EXPORTED fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value)
{
    (void)c;
    if (s != fmi2Terminated) {
        return fmi2Discard;
    }
    *value = 0;
    return fmi2OK;
}

EXPORTED fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value)
{
    (void)c; (void)s; (void)value;
    return fmi2Discard;
}

EXPORTED fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                                const fmi2Integer order[], const fmi2Real value[])
{
    (void)c; (void)vr; (void)order; (void)value;
    return n == 0 ? fmi2OK : fmi2Error;
}

EXPORTED fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                                 const fmi2Integer order[], fmi2Real value[])
{
    (void)c; (void)vr; (void)order; (void)value;
    return n == 0 ? fmi2OK : fmi2Error;
}

EXPORTED fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n_unknown,
                                                 const fmi2ValueReference known[], size_t n_known,
                                                 const fmi2Real seed[], fmi2Real value[])
{
    (void)c; (void)unknown; (void)n_unknown; (void)known; (void)n_known; (void)seed; (void)value;
    return fmi2Error;
}
