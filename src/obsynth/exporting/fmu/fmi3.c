/* FMI 3.0 for co-simulation around the observer. */
#include <stdbool.h>
#include <stdint.h>

#include "instance.h"

typedef void *fmi3Instance;
typedef void *fmi3InstanceEnvironment;
typedef void *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef float fmi3Float32;
typedef double fmi3Float64;
typedef int8_t fmi3Int8;
typedef uint8_t fmi3UInt8;
typedef int16_t fmi3Int16;
typedef uint16_t fmi3UInt16;
typedef int32_t fmi3Int32;
typedef uint32_t fmi3UInt32;
typedef int64_t fmi3Int64;
typedef uint64_t fmi3UInt64;
typedef bool fmi3Boolean;
typedef bool fmi3Clock;
typedef const char *fmi3String;
typedef uint8_t fmi3Byte;
typedef const fmi3Byte *fmi3Binary;
typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef enum { fmi3Independent, fmi3Constant, fmi3Fixed, fmi3Tunable, fmi3Discrete, fmi3Dependent } fmi3DependencyKind;
typedef enum { fmi3IntervalNotYetKnown, fmi3IntervalUnchanged, fmi3IntervalChanged } fmi3IntervalQualifier;
typedef void (*fmi3LogMessageCallback)(fmi3InstanceEnvironment, fmi3Status, fmi3String, fmi3String);
typedef void (*fmi3ClockUpdateCallback)(fmi3InstanceEnvironment);
typedef void (*fmi3LockPreemptionCallback)(void);
typedef void (*fmi3UnlockPreemptionCallback)(void);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment, fmi3Float64, fmi3Boolean, fmi3Boolean,
                                               fmi3Boolean, fmi3Boolean, fmi3Boolean *, fmi3Float64 *);

#define FMI(name) fmi3##name
#define OF_STATE(before, after) fmi3##before##FMUState##after
#define DESERIALIZED fmi3DeserializeFMUState
#include "common.h"

EXPORTED const char *fmi3GetVersion(void) { return "3.0"; }

EXPORTED fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                                   fmi3Boolean visible, fmi3Boolean logging,
                                                   fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    (void)name; (void)token; (void)resources; (void)visible; (void)logging; (void)environment; (void)log;
    return NULL;
}

EXPORTED fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                                  fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events,
                                                  fmi3Boolean early, const fmi3ValueReference required[], size_t n,
                                                  fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                                  fmi3IntermediateUpdateCallback update)
{
    (void)name; (void)resources; (void)visible; (void)logging; (void)events; (void)early; (void)required; (void)n;
    (void)environment; (void)log; (void)update;
    return made(token);
}

EXPORTED fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                                        fmi3Boolean visible, fmi3Boolean logging,
                                                        fmi3InstanceEnvironment environment,
                                                        fmi3LogMessageCallback log, fmi3ClockUpdateCallback clock,
                                                        fmi3LockPreemptionCallback lock,
                                                        fmi3UnlockPreemptionCallback unlock)
{
    (void)name; (void)token; (void)resources; (void)visible; (void)logging; (void)environment; (void)log; (void)clock;
    (void)lock; (void)unlock;
    return NULL;
}

EXPORTED fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance, fmi3Float64 tolerance,
                                                fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop)
{
    instance *m = c;
    (void)has_tolerance; (void)tolerance; (void)has_stop; (void)stop;
    m->real[0] = start;
    return fmi3OK;
}

EXPORTED fmi3Status fmi3EnterEventMode(fmi3Instance c) { (void)c; return fmi3Error; }

EXPORTED fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 values[],
                                   size_t n_values)
{
    const instance *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        if (n_values != n || vr[i] >= N_REAL) {
            return fmi3Error;
        }
        values[i] = m->real[vr[i]];
    }
    return fmi3OK;
}

EXPORTED fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 values[],
                                   size_t n_values)
{
    instance *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        if (n_values != n || !may_set(vr[i])) {
            return fmi3Error;
        }
        m->real[vr[i]] = values[i];
    }
    return fmi3OK;
}

EXPORTED fmi3Status fmi3GetBoolean(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Boolean values[],
                                   size_t n_values)
{
    const instance *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        if (n_values != n || vr[i] < N_REAL || vr[i] >= N_REAL + N_FLAG) {
            return fmi3Error;
        }
        values[i] = m->flag[vr[i] - N_REAL] != 0;
    }
    return fmi3OK;
}

#define NONE(name, type) \
    EXPORTED fmi3Status name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, type values[], size_t n_values) \
    { \
        (void)c; (void)vr; (void)values; (void)n_values; \
        return n == 0 ? fmi3OK : fmi3Error; \
    }
#define NONE_OF(kind) NONE(fmi3Get##kind, fmi3##kind) NONE(fmi3Set##kind, const fmi3##kind)
NONE_OF(Float32)
NONE_OF(Int8)
NONE_OF(UInt8)
NONE_OF(Int16)
NONE_OF(UInt16)
NONE_OF(Int32)
NONE_OF(UInt32)
NONE_OF(Int64)
NONE_OF(UInt64)
NONE_OF(String)
NONE(fmi3SetBoolean, const fmi3Boolean)

EXPORTED fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, size_t sizes[],
                                  fmi3Binary values[], size_t n_values)
{
    (void)c; (void)vr; (void)sizes; (void)values; (void)n_values;
    return n == 0 ? fmi3OK : fmi3Error;
}

EXPORTED fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const size_t sizes[],
                                  const fmi3Binary values[], size_t n_values)
{
    (void)c; (void)vr; (void)sizes; (void)values; (void)n_values;
    return n == 0 ? fmi3OK : fmi3Error;
}

EXPORTED fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Clock values[])
{
    (void)c; (void)vr; (void)values;
    return n == 0 ? fmi3OK : fmi3Error;
}

EXPORTED fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Clock values[])
{
    (void)c; (void)vr; (void)values;
    return n == 0 ? fmi3OK : fmi3Error;
}

EXPORTED fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference vr, size_t *n)
{
    (void)c; (void)vr; (void)n;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference vr, size_t of_dependent[],
                                                fmi3ValueReference independents[], size_t of_independents[],
                                                fmi3DependencyKind kinds[], size_t n)
{
    (void)c; (void)vr; (void)of_dependent; (void)independents; (void)of_independents; (void)kinds; (void)n;
    return fmi3Error;
}

#define NO_DERIVATIVE(name) \
    EXPORTED fmi3Status name(fmi3Instance c, const fmi3ValueReference unknowns[], size_t n_unknowns, \
                             const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[], \
                             size_t n_seed, fmi3Float64 values[], size_t n_values) \
    { \
        (void)c; (void)unknowns; (void)n_unknowns; (void)knowns; (void)n_knowns; (void)seed; (void)n_seed; \
        (void)values; (void)n_values; \
        return fmi3Error; \
    }
NO_DERIVATIVE(fmi3GetDirectionalDerivative)
NO_DERIVATIVE(fmi3GetAdjointDerivative)

EXPORTED fmi3Status fmi3EnterConfigurationMode(fmi3Instance c) { (void)c; return fmi3Error; }
EXPORTED fmi3Status fmi3ExitConfigurationMode(fmi3Instance c) { (void)c; return fmi3Error; }
EXPORTED fmi3Status fmi3EnterStepMode(fmi3Instance c) { (void)c; return fmi3Error; }
EXPORTED fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c) { (void)c; return fmi3Error; }

EXPORTED fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *update, fmi3Boolean *terminate,
                                             fmi3Boolean *nominals, fmi3Boolean *values, fmi3Boolean *defined,
                                             fmi3Float64 *time)
{
    (void)c; (void)update; (void)terminate; (void)nominals; (void)values; (void)defined; (void)time;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                             const fmi3Int32 orders[], fmi3Float64 values[], size_t n_values)
{
    (void)c; (void)vr; (void)orders; (void)values; (void)n_values;
    return n == 0 ? fmi3OK : fmi3Error;
}

EXPORTED fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_return,
                               fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
    (void)no_return;
    *event = false;
    *terminate = false;
    *early = false;
    if (advance_to(c, time, step)) {
        *last = time;
        return fmi3Error;
    }
    *last = time + step;
    return fmi3OK;
}

/* Clocks, model exchange and scheduled execution: this unit has none of them, but a library must have all functions. */
#define NO_CLOCK(name, ...) \
    EXPORTED fmi3Status name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, __VA_ARGS__) \
    { \
        (void)c; (void)vr; \
        return n == 0 ? fmi3OK : fmi3Error; \
    }
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif
NO_CLOCK(fmi3GetIntervalDecimal, fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
NO_CLOCK(fmi3GetIntervalFraction, fmi3UInt64 counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[])
NO_CLOCK(fmi3GetShiftDecimal, fmi3Float64 shifts[])
NO_CLOCK(fmi3GetShiftFraction, fmi3UInt64 counters[], fmi3UInt64 resolutions[])
NO_CLOCK(fmi3SetIntervalDecimal, const fmi3Float64 intervals[])
NO_CLOCK(fmi3SetIntervalFraction, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
NO_CLOCK(fmi3SetShiftDecimal, const fmi3Float64 shifts[])
NO_CLOCK(fmi3SetShiftFraction, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])

#define REFUSED(name, ...) \
    EXPORTED fmi3Status name(__VA_ARGS__) \
    { \
        return fmi3Error; \
    }
REFUSED(fmi3EnterContinuousTimeMode, fmi3Instance c)
REFUSED(fmi3CompletedIntegratorStep, fmi3Instance c, fmi3Boolean no_set, fmi3Boolean *event, fmi3Boolean *terminate)
REFUSED(fmi3SetTime, fmi3Instance c, fmi3Float64 time)
REFUSED(fmi3SetContinuousStates, fmi3Instance c, const fmi3Float64 states[], size_t n)
REFUSED(fmi3GetContinuousStateDerivatives, fmi3Instance c, fmi3Float64 derivatives[], size_t n)
REFUSED(fmi3GetEventIndicators, fmi3Instance c, fmi3Float64 indicators[], size_t n)
REFUSED(fmi3GetContinuousStates, fmi3Instance c, fmi3Float64 states[], size_t n)
REFUSED(fmi3GetNominalsOfContinuousStates, fmi3Instance c, fmi3Float64 nominals[], size_t n)
REFUSED(fmi3GetNumberOfEventIndicators, fmi3Instance c, size_t *n)
REFUSED(fmi3GetNumberOfContinuousStates, fmi3Instance c, size_t *n)
REFUSED(fmi3ActivateModelPartition, fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time)
