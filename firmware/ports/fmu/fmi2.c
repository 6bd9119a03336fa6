/* The ECU as FMI 2.0 sees it: a slave for co-simulation whose step is a tick. */
#include <fmi2Functions.h>
#include <stdlib.h>
#include <string.h>

#include "ports/fmu/instance.h"

struct component {
    struct instance instance;
    const fmi2CallbackFunctions *callbacks; /* FMI keeps them valid as long as the instance */
    char name[128];
};

static fmi2Status tell(const struct component *component, fmi2Status status, const char *text)
{
    const char *const category = status == fmi2Discard ? "logStatusDiscard" : "logStatusError";
    if (component->callbacks->logger != NULL) {
        component->callbacks->logger(component->callbacks->componentEnvironment, component->name, status,
                                     category, "%s", text);
    }
    return status;
}

static fmi2Status done(const struct component *component, bool is_good)
{
    return is_good ? fmi2OK : tell(component, fmi2Error, component->instance.text);
}

/* For what an FMU may leave out. */
static fmi2Status not_there(const struct component *component, const char *what)
{
    return component != NULL ? tell(component, fmi2Error, what) : fmi2Error;
}

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Status fmi2SetDebugLogging(fmi2Component handle, fmi2Boolean on, size_t count,
                               const fmi2String categories[])
{
    (void)on, (void)count, (void)categories; /* errors are always told, and there is nothing else */
    return handle != NULL ? fmi2OK : fmi2Error;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
                              fmi2Boolean logging)
{
    (void)resources, (void)visible, (void)logging;
    if (callbacks == NULL) {
        return NULL;
    }
    struct component *const component = calloc(1, sizeof *component);
    if (component == NULL) {
        return NULL;
    }
    component->callbacks = callbacks;
    (void)strncpy(component->name, name != NULL ? name : "", sizeof component->name - 1u);
    instance_reset(&component->instance);
    const char *wrong = NULL;
    if (type != fmi2CoSimulation) {
        wrong = "this FMU is for co-simulation";
    } else if (token == NULL || strcmp(token, FMU_TOKEN) != 0) {
        wrong = "the GUID is not this FMU's: modelDescription.xml and binary do not belong together";
    } else {
        return component;
    }
    (void)tell(component, fmi2Error, wrong);
    free(component);
    return NULL;
}

void fmi2FreeInstance(fmi2Component handle)
{
    free(handle);
}

fmi2Status fmi2SetupExperiment(fmi2Component handle, fmi2Boolean tolerance_given, fmi2Real tolerance,
                               fmi2Real start_s, fmi2Boolean stop_given, fmi2Real stop_s)
{
    (void)tolerance_given, (void)tolerance, (void)stop_given, (void)stop_s;
    struct component *const component = handle;
    if (component == NULL) {
        return fmi2Error;
    }
    component->instance.time_s = start_s;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component handle)
{
    struct component *const component = handle;
    if (component == NULL) {
        return fmi2Error;
    }
    if (component->instance.phase != PHASE_NEW) {
        return tell(component, fmi2Error, "initialisation is possible once, after instantiation or reset");
    }
    component->instance.phase = PHASE_INITIALISING;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component handle)
{
    struct component *const component = handle;
    return component == NULL ? fmi2Error : done(component, instance_start(&component->instance));
}

fmi2Status fmi2Terminate(fmi2Component handle)
{
    struct component *const component = handle;
    return component == NULL ? fmi2Error : done(component, instance_terminate(&component->instance));
}

fmi2Status fmi2Reset(fmi2Component handle)
{
    struct component *const component = handle;
    if (component == NULL) {
        return fmi2Error;
    }
    instance_reset(&component->instance);
    return fmi2OK;
}

/* ---- variables ---- */

static bool is_call_whole(const struct component *component, const fmi2ValueReference references[],
                          size_t count, const void *values)
{
    return component != NULL && (count == 0u || (references != NULL && values != NULL));
}

static bool unknown(struct instance *instance, fmi2ValueReference reference, const char *type)
{
    return instance_refuse(instance, "there is no %s with value reference %u for this", type,
                           (unsigned)reference);
}

/* What can be set before the steps only. */
static bool is_open(struct instance *instance, const char *name)
{
    return instance->phase == PHASE_NEW || instance->phase == PHASE_INITIALISING ||
           instance_refuse(instance, "%s cannot be set after initialisation", name);
}

static bool get_real(struct instance *instance, fmi2ValueReference reference, fmi2Real *value)
{
    if (reference - FMU_REFERENCE_OUTPUT < FMU_OUTPUT_COUNT) {
        *value = instance->output[reference - FMU_REFERENCE_OUTPUT];
    } else if (reference - FMU_REFERENCE_SENSOR < FMU_SENSOR_COUNT) {
        *value = instance->sensor[reference - FMU_REFERENCE_SENSOR];
    } else if (reference - FMU_REFERENCE_TARGET < JOINTS) {
        *value = instance->target_rad[reference - FMU_REFERENCE_TARGET];
    } else if (reference - FMU_REFERENCE_DURATION < JOINTS) {
        *value = instance->duration_s[reference - FMU_REFERENCE_DURATION];
    } else if (reference == FMU_REFERENCE_PERIOD) {
        *value = instance->period_s;
    } else if (reference >= FMU_REFERENCE_PARAMETER) {
        return instance_get_parameter(instance, reference - FMU_REFERENCE_PARAMETER, value);
    } else {
        return unknown(instance, reference, "Real");
    }
    return true;
}

static bool set_real(struct instance *instance, fmi2ValueReference reference, fmi2Real value)
{
    if (reference - FMU_REFERENCE_SENSOR < FMU_SENSOR_COUNT) {
        instance->sensor[reference - FMU_REFERENCE_SENSOR] = value;
    } else if (reference - FMU_REFERENCE_TARGET < JOINTS) {
        instance->target_rad[reference - FMU_REFERENCE_TARGET] = value;
    } else if (reference - FMU_REFERENCE_DURATION < JOINTS) {
        instance->duration_s[reference - FMU_REFERENCE_DURATION] = value;
    } else if (reference == FMU_REFERENCE_PERIOD) {
        if (!is_open(instance, "tick_period")) {
            return false;
        }
        instance->period_s = value;
    } else if (reference >= FMU_REFERENCE_PARAMETER) {
        return instance_set_parameter(instance, reference - FMU_REFERENCE_PARAMETER, value);
    } else {
        return unknown(instance, reference, "Real that can be set");
    }
    return true;
}

static bool get_integer(struct instance *instance, fmi2ValueReference reference, fmi2Integer *value)
{
    switch (reference) {
    case FMU_REFERENCE_REQUEST:
        *value = instance->request;
        break;
    case FMU_REFERENCE_CONTROLLER:
        *value = instance->controller;
        break;
    case FMU_REFERENCE_MODE:
        *value = (fmi2Integer)instance->ecu.mode;
        break;
    case FMU_REFERENCE_FAULT:
        *value = (fmi2Integer)instance->ecu.fault;
        break;
    case FMU_REFERENCE_REFUSED:
        *value = (fmi2Integer)instance->ecu.counters.refused;
        break;
    case FMU_REFERENCE_REFUSAL:
        *value = (fmi2Integer)instance->ecu.counters.last_refusal;
        break;
    default:
        return unknown(instance, reference, "Integer");
    }
    return true;
}

static bool set_integer(struct instance *instance, fmi2ValueReference reference, fmi2Integer value)
{
    switch (reference) {
    case FMU_REFERENCE_REQUEST:
        instance->request = value;
        break;
    case FMU_REFERENCE_CONTROLLER:
        instance->controller = value;
        break;
    default:
        return unknown(instance, reference, "Integer that can be set");
    }
    return true;
}

static bool get_boolean(struct instance *instance, fmi2ValueReference reference, fmi2Boolean *value)
{
    bool answer = false;
    if (reference - FMU_REFERENCE_MOVE < JOINTS) {
        answer = instance->move[reference - FMU_REFERENCE_MOVE];
    } else if (reference == FMU_REFERENCE_ACTIVE) {
        answer = instance->valves_active;
    } else {
        return unknown(instance, reference, "Boolean");
    }
    *value = answer ? fmi2True : fmi2False;
    return true;
}

static bool set_boolean(struct instance *instance, fmi2ValueReference reference, fmi2Boolean value)
{
    if (reference - FMU_REFERENCE_MOVE >= JOINTS) {
        return unknown(instance, reference, "Boolean that can be set");
    }
    instance->move[reference - FMU_REFERENCE_MOVE] = value != fmi2False;
    return true;
}

static bool get_string(struct instance *instance, fmi2ValueReference reference, fmi2String *value)
{
    if (reference != FMU_REFERENCE_IMAGE) {
        return unknown(instance, reference, "String");
    }
    *value = instance->image_path;
    return true;
}

static bool set_string(struct instance *instance, fmi2ValueReference reference, fmi2String value)
{
    if (reference != FMU_REFERENCE_IMAGE) {
        return unknown(instance, reference, "String");
    }
    if (!is_open(instance, "parameter_image")) {
        return false;
    }
    if (value == NULL || strlen(value) >= sizeof instance->image_path) {
        return instance_refuse(instance, "parameter_image must be a path of less than %u bytes",
                               (unsigned)sizeof instance->image_path);
    }
    (void)strcpy(instance->image_path, value);
    return true;
}

#define ACCESS(Type, type)                                                                              \
    fmi2Status fmi2Get##Type(fmi2Component handle, const fmi2ValueReference references[], size_t count, \
                             fmi2##Type values[])                                                       \
    {                                                                                                   \
        struct component *const component = handle;                                                     \
        if (!is_call_whole(component, references, count, values)) {                                     \
            return fmi2Error;                                                                           \
        }                                                                                               \
        bool is_good = true;                                                                            \
        for (size_t k = 0; k < count && is_good; k++) {                                                 \
            is_good = get_##type(&component->instance, references[k], &values[k]);                      \
        }                                                                                               \
        return done(component, is_good);                                                                \
    }                                                                                                   \
    fmi2Status fmi2Set##Type(fmi2Component handle, const fmi2ValueReference references[], size_t count, \
                             const fmi2##Type values[])                                                 \
    {                                                                                                   \
        struct component *const component = handle;                                                     \
        if (!is_call_whole(component, references, count, values)) {                                     \
            return fmi2Error;                                                                           \
        }                                                                                               \
        bool is_good = component->instance.phase != PHASE_TERMINATED ||                                 \
                       instance_refuse(&component->instance, "nothing can be set after termination");   \
        for (size_t k = 0; k < count && is_good; k++) {                                                 \
            is_good = set_##type(&component->instance, references[k], values[k]);                       \
        }                                                                                               \
        return done(component, is_good);                                                                \
    }

ACCESS(Real, real)
ACCESS(Integer, integer)
ACCESS(Boolean, boolean)
ACCESS(String, string)

/* ---- steps ---- */

fmi2Status fmi2DoStep(fmi2Component handle, fmi2Real time_s, fmi2Real step_s, fmi2Boolean no_return)
{
    (void)no_return;
    struct component *const component = handle;
    if (component == NULL) {
        return fmi2Error;
    }
    if (component->instance.phase == PHASE_STEPPING) {
        /* Refused means not done: the tool may come back with another step. */
        const bool is_good = instance_step(&component->instance, time_s, step_s);
        return is_good ? fmi2OK : tell(component, fmi2Discard, component->instance.text);
    }
    return done(component, instance_step(&component->instance, time_s, step_s));
}

fmi2Status fmi2CancelStep(fmi2Component handle)
{
    return not_there(handle, "steps are never pending");
}

fmi2Status fmi2GetStatus(fmi2Component handle, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)kind, (void)value;
    return handle != NULL ? fmi2Discard : fmi2Error;
}

fmi2Status fmi2GetRealStatus(fmi2Component handle, const fmi2StatusKind kind, fmi2Real *value)
{
    const struct component *const component = handle;
    if (component == NULL || value == NULL) {
        return fmi2Error;
    }
    if (kind != fmi2LastSuccessfulTime) {
        return fmi2Discard;
    }
    *value = component->instance.time_s;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component handle, const fmi2StatusKind kind, fmi2Integer *value)
{
    (void)kind, (void)value;
    return handle != NULL ? fmi2Discard : fmi2Error;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component handle, const fmi2StatusKind kind, fmi2Boolean *value)
{
    if (handle == NULL || value == NULL) {
        return fmi2Error;
    }
    if (kind != fmi2Terminated) {
        return fmi2Discard;
    }
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component handle, const fmi2StatusKind kind, fmi2String *value)
{
    (void)kind, (void)value;
    return handle != NULL ? fmi2Discard : fmi2Error;
}

/* ---- what FMI 2.0 has and this FMU does not ---- */

#define NO_STATE "the ECU's state is not for saving"

fmi2Status fmi2GetFMUstate(fmi2Component handle, fmi2FMUstate *state)
{
    (void)state;
    return not_there(handle, NO_STATE);
}

fmi2Status fmi2SetFMUstate(fmi2Component handle, fmi2FMUstate state)
{
    (void)state;
    return not_there(handle, NO_STATE);
}

fmi2Status fmi2FreeFMUstate(fmi2Component handle, fmi2FMUstate *state)
{
    (void)state;
    return not_there(handle, NO_STATE);
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component handle, fmi2FMUstate state, size_t *size)
{
    (void)state, (void)size;
    return not_there(handle, NO_STATE);
}

fmi2Status fmi2SerializeFMUstate(fmi2Component handle, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    (void)state, (void)bytes, (void)size;
    return not_there(handle, NO_STATE);
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component handle, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *state)
{
    (void)bytes, (void)size, (void)state;
    return not_there(handle, NO_STATE);
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component handle, const fmi2ValueReference unknowns[],
                                        size_t unknown_count, const fmi2ValueReference knowns[],
                                        size_t known_count, const fmi2Real known_d[], fmi2Real unknown_d[])
{
    (void)unknowns, (void)unknown_count, (void)knowns, (void)known_count, (void)known_d, (void)unknown_d;
    return not_there(handle, "no directional derivatives");
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component handle, const fmi2ValueReference references[],
                                       size_t count, const fmi2Integer orders[], const fmi2Real values[])
{
    (void)references, (void)count, (void)orders, (void)values;
    return not_there(handle, "inputs are sampled at the step's begin: no derivatives");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component handle, const fmi2ValueReference references[],
                                        size_t count, const fmi2Integer orders[], fmi2Real values[])
{
    (void)references, (void)count, (void)orders, (void)values;
    return not_there(handle, "no derivatives of outputs");
}
