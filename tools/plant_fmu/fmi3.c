/* The plant as FMI 3.0 sees it. */
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"
#include "plant.h"

struct instance {
    struct plant plant;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
};

static void tell(const struct instance *instance, const char *text)
{
    if (instance->log != NULL) {
        instance->log(instance->environment, fmi3Error, "logStatusError", text);
    }
}

static fmi3Status done(const struct instance *instance, bool is_good)
{
    if (!is_good) {
        tell(instance, instance->plant.text);
    }
    return is_good ? fmi3OK : fmi3Error;
}

/* For what an FMU may leave out. */
static fmi3Status not_there(fmi3Instance handle, const char *name)
{
    if (handle != NULL) {
        struct instance *const instance = handle;
        (void)strcpy(instance->plant.text, "this FMU has no variables or abilities for ");
        (void)strncat(instance->plant.text, name, 64);
        tell(instance, instance->plant.text);
    }
    return fmi3Error;
}

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance handle, fmi3Boolean on, size_t count,
                               const fmi3String categories[])
{
    (void)on, (void)count, (void)categories; /* errors are always told, and there is nothing else */
    return handle != NULL ? fmi3OK : fmi3Error;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                         fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean event_mode,
                                         fmi3Boolean early_return, const fmi3ValueReference intermediate[],
                                         size_t intermediates, fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    (void)name, (void)resources, (void)visible, (void)logging, (void)event_mode, (void)early_return;
    (void)intermediate, (void)intermediates, (void)update;
    struct instance *const instance = calloc(1, sizeof *instance);
    if (instance == NULL) {
        return NULL;
    }
    instance->environment = environment;
    instance->log = log;
    plant_reset(&instance->plant);
    if (token == NULL || strcmp(token, PLANT_TOKEN) != 0) {
        tell(instance,
             "the instantiation token is not this FMU's: modelDescription.xml and binary do not belong "
             "together");
        free(instance);
        return NULL;
    }
    return instance;
}

void fmi3FreeInstance(fmi3Instance handle)
{
    free(handle);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance handle, fmi3Boolean tolerance_given,
                                       fmi3Float64 tolerance, fmi3Float64 start_s, fmi3Boolean stop_given,
                                       fmi3Float64 stop_s)
{
    (void)tolerance_given, (void)tolerance, (void)stop_given, (void)stop_s;
    struct instance *const instance = handle;
    return instance == NULL ? fmi3Error
                            : done(instance, plant_enter_initialisation(&instance->plant, start_s));
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance handle)
{
    struct instance *const instance = handle;
    return instance == NULL ? fmi3Error : done(instance, plant_exit_initialisation(&instance->plant));
}

fmi3Status fmi3Terminate(fmi3Instance handle)
{
    struct instance *const instance = handle;
    return instance == NULL ? fmi3Error : done(instance, plant_terminate(&instance->plant));
}

fmi3Status fmi3Reset(fmi3Instance handle)
{
    struct instance *const instance = handle;
    if (instance == NULL) {
        return fmi3Error;
    }
    plant_reset(&instance->plant);
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance handle, const fmi3ValueReference references[], size_t count,
                          fmi3Float64 values[], size_t places)
{
    struct instance *const instance = handle;
    if (instance == NULL || places != count || (count > 0u && (references == NULL || values == NULL))) {
        return fmi3Error;
    }
    bool is_good = true;
    for (size_t k = 0; k < count && is_good; k++) {
        is_good = plant_get(&instance->plant, references[k], &values[k]);
    }
    return done(instance, is_good);
}

fmi3Status fmi3SetFloat64(fmi3Instance handle, const fmi3ValueReference references[], size_t count,
                          const fmi3Float64 values[], size_t places)
{
    struct instance *const instance = handle;
    if (instance == NULL || places != count || (count > 0u && (references == NULL || values == NULL))) {
        return fmi3Error;
    }
    bool is_good = true;
    for (size_t k = 0; k < count && is_good; k++) {
        is_good = plant_set(&instance->plant, references[k], values[k]);
    }
    return done(instance, is_good);
}

fmi3Status fmi3GetFMUState(fmi3Instance handle, fmi3FMUState *state)
{
    struct instance *const instance = handle;
    if (instance == NULL || state == NULL) {
        return fmi3Error;
    }
    return done(instance, plant_save(&instance->plant, &instance->plant, state));
}

fmi3Status fmi3SetFMUState(fmi3Instance handle, fmi3FMUState state)
{
    struct instance *const instance = handle;
    if (instance == NULL || state == NULL) {
        return fmi3Error;
    }
    instance->plant = *(const struct plant *)state;
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance handle, fmi3FMUState *state)
{
    (void)handle;
    plant_free_saved(state);
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance handle, fmi3FMUState state, size_t *size)
{
    if (handle == NULL || state == NULL || size == NULL) {
        return fmi3Error;
    }
    *size = sizeof(struct plant);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance handle, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    if (handle == NULL || state == NULL || bytes == NULL || size < sizeof(struct plant)) {
        return fmi3Error;
    }
    (void)memcpy(bytes, state, sizeof(struct plant));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance handle, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *state)
{
    struct instance *const instance = handle;
    if (instance == NULL || bytes == NULL || state == NULL || size != sizeof(struct plant)) {
        return fmi3Error;
    }
    return done(instance, plant_save(&instance->plant, bytes, state));
}

fmi3Status fmi3DoStep(fmi3Instance handle, fmi3Float64 time_s, fmi3Float64 step_s, fmi3Boolean no_return,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached_s)
{
    (void)no_return;
    struct instance *const instance = handle;
    if (instance == NULL) {
        return fmi3Error;
    }
    const bool is_good = plant_step(&instance->plant, time_s, step_s);
    if (event != NULL && terminate != NULL && early != NULL && reached_s != NULL) {
        *event = false;
        *terminate = false;
        *early = false;
        *reached_s = instance->plant.time_s;
    }
    return done(instance, is_good);
}

/* ---- what FMI 3.0 has and this FMU does not: each says so -------------------------------------------------- */

#define OFF __attribute__((unused))
#define REFUSED(name, ...)                                 \
    fmi3Status fmi3##name(fmi3Instance handle __VA_ARGS__) \
    {                                                      \
        return not_there(handle, #name);                   \
    }
#define REFERENCES , OFF const fmi3ValueReference references[], OFF size_t count
#define NO_VARIABLES(name)                                                     \
    REFUSED(Get##name, REFERENCES, OFF fmi3##name values[], OFF size_t places) \
    REFUSED(Set##name, REFERENCES, OFF const fmi3##name values[], OFF size_t places)

NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(Int32)
NO_VARIABLES(UInt32)
NO_VARIABLES(Int64)
NO_VARIABLES(UInt64)
NO_VARIABLES(Boolean)
NO_VARIABLES(String)
REFUSED(GetBinary, REFERENCES, OFF size_t sizes[], OFF fmi3Binary values[], OFF size_t places)
REFUSED(SetBinary, REFERENCES, OFF const size_t sizes[], OFF const fmi3Binary values[], OFF size_t places)
REFUSED(GetClock, REFERENCES, OFF fmi3Clock values[])
REFUSED(SetClock, REFERENCES, OFF const fmi3Clock values[])
REFUSED(GetIntervalDecimal, REFERENCES, OFF fmi3Float64 intervals[], OFF fmi3IntervalQualifier qualifiers[])
REFUSED(GetIntervalFraction, REFERENCES, OFF fmi3UInt64 counters[], OFF fmi3UInt64 resolutions[],
        OFF fmi3IntervalQualifier qualifiers[])
REFUSED(GetShiftDecimal, REFERENCES, OFF fmi3Float64 shifts[])
REFUSED(GetShiftFraction, REFERENCES, OFF fmi3UInt64 counters[], OFF fmi3UInt64 resolutions[])
REFUSED(SetIntervalDecimal, REFERENCES, OFF const fmi3Float64 intervals[])
REFUSED(SetIntervalFraction, REFERENCES, OFF const fmi3UInt64 counters[], OFF const fmi3UInt64 resolutions[])
REFUSED(SetShiftDecimal, REFERENCES, OFF const fmi3Float64 shifts[])
REFUSED(SetShiftFraction, REFERENCES, OFF const fmi3UInt64 counters[], OFF const fmi3UInt64 resolutions[])
REFUSED(GetOutputDerivatives, REFERENCES, OFF const fmi3Int32 orders[], OFF fmi3Float64 values[],
        OFF size_t places)
REFUSED(GetDirectionalDerivative, REFERENCES, OFF const fmi3ValueReference knowns[], OFF size_t known_count,
        OFF const fmi3Float64 seed[], OFF size_t seeds, OFF fmi3Float64 sensitivity[],
        OFF size_t sensitivities)
REFUSED(GetAdjointDerivative, REFERENCES, OFF const fmi3ValueReference knowns[], OFF size_t known_count,
        OFF const fmi3Float64 seed[], OFF size_t seeds, OFF fmi3Float64 sensitivity[],
        OFF size_t sensitivities)
REFUSED(GetNumberOfVariableDependencies, , OFF fmi3ValueReference reference, OFF size_t *dependencies)
REFUSED(GetVariableDependencies, , OFF fmi3ValueReference dependent, OFF size_t elements[],
        OFF fmi3ValueReference independents[], OFF size_t independent_elements[],
        OFF fmi3DependencyKind kinds[], OFF size_t dependencies)
REFUSED(EnterEventMode)
REFUSED(EnterConfigurationMode)
REFUSED(ExitConfigurationMode)
REFUSED(EvaluateDiscreteStates)
REFUSED(EnterContinuousTimeMode)
REFUSED(EnterStepMode)
REFUSED(UpdateDiscreteStates, , OFF fmi3Boolean *update, OFF fmi3Boolean *terminate,
        OFF fmi3Boolean *nominals, OFF fmi3Boolean *values, OFF fmi3Boolean *timed, OFF fmi3Float64 *time_s)
REFUSED(CompletedIntegratorStep, , OFF fmi3Boolean no_return, OFF fmi3Boolean *event,
        OFF fmi3Boolean *terminate)
REFUSED(SetTime, , OFF fmi3Float64 time_s)
REFUSED(SetContinuousStates, , OFF const fmi3Float64 states[], OFF size_t count)
REFUSED(GetContinuousStateDerivatives, , OFF fmi3Float64 derivatives[], OFF size_t count)
REFUSED(GetEventIndicators, , OFF fmi3Float64 indicators[], OFF size_t count)
REFUSED(GetContinuousStates, , OFF fmi3Float64 states[], OFF size_t count)
REFUSED(GetNominalsOfContinuousStates, , OFF fmi3Float64 nominals[], OFF size_t count)
REFUSED(GetNumberOfEventIndicators, , OFF size_t *count)
REFUSED(GetNumberOfContinuousStates, , OFF size_t *count)
REFUSED(ActivateModelPartition, , OFF fmi3ValueReference clock, OFF fmi3Float64 time_s)

fmi3Instance fmi3InstantiateModelExchange(OFF fmi3String name, OFF fmi3String token, OFF fmi3String resources,
                                          OFF fmi3Boolean visible, OFF fmi3Boolean logging,
                                          OFF fmi3InstanceEnvironment environment,
                                          OFF fmi3LogMessageCallback log)
{
    return NULL;
}

fmi3Instance
fmi3InstantiateScheduledExecution(OFF fmi3String name, OFF fmi3String token, OFF fmi3String resources,
                                  OFF fmi3Boolean visible, OFF fmi3Boolean logging,
                                  OFF fmi3InstanceEnvironment environment, OFF fmi3LogMessageCallback log,
                                  OFF fmi3ClockUpdateCallback update, OFF fmi3LockPreemptionCallback lock,
                                  OFF fmi3UnlockPreemptionCallback unlock)
{
    return NULL;
}
