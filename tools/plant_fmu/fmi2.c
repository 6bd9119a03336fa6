/* The plant as FMI 2.0 sees it. */
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "plant.h"

struct instance {
    struct plant plant;
    const fmi2CallbackFunctions *callbacks; /* FMI keeps them valid as long as the instance */
    char name[128];
};

static void tell(const struct instance *instance, fmi2Status status, const char *text)
{
    const char *const category = status == fmi2Discard ? "logStatusDiscard" : "logStatusError";
    if (instance->callbacks->logger != NULL) {
        instance->callbacks->logger(instance->callbacks->componentEnvironment, instance->name, status,
                                    category, "%s", text);
    }
}

static fmi2Status done(const struct instance *instance, bool is_good)
{
    if (!is_good) {
        tell(instance, fmi2Error, instance->plant.text);
    }
    return is_good ? fmi2OK : fmi2Error;
}

/* For what an FMU may leave out. */
static fmi2Status not_there(fmi2Component component, const char *what)
{
    if (component != NULL) {
        tell(component, fmi2Error, what);
    }
    return fmi2Error;
}

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Status fmi2SetDebugLogging(fmi2Component component, fmi2Boolean on, size_t count,
                               const fmi2String categories[])
{
    (void)on, (void)count, (void)categories; /* errors are always told, and there is nothing else */
    return component != NULL ? fmi2OK : fmi2Error;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
                              fmi2Boolean logging)
{
    (void)resources, (void)visible, (void)logging;
    if (callbacks == NULL) {
        return NULL;
    }
    struct instance *const instance = calloc(1, sizeof *instance);
    if (instance == NULL) {
        return NULL;
    }
    instance->callbacks = callbacks;
    (void)strncpy(instance->name, name != NULL ? name : "", sizeof instance->name - 1u);
    plant_reset(&instance->plant);
    const char *wrong = NULL;
    if (type != fmi2CoSimulation) {
        wrong = "this FMU is for co-simulation";
    } else if (token == NULL || strcmp(token, PLANT_TOKEN) != 0) {
        wrong = "the GUID is not this FMU's: modelDescription.xml and binary do not belong together";
    }
    if (wrong != NULL) {
        tell(instance, fmi2Error, wrong);
        free(instance);
        return NULL;
    }
    return instance;
}

void fmi2FreeInstance(fmi2Component component)
{
    free(component);
}

fmi2Status fmi2SetupExperiment(fmi2Component component, fmi2Boolean tolerance_given, fmi2Real tolerance,
                               fmi2Real start_s, fmi2Boolean stop_given, fmi2Real stop_s)
{
    (void)tolerance_given, (void)tolerance, (void)stop_given, (void)stop_s;
    struct instance *const instance = component;
    if (instance == NULL) {
        return fmi2Error;
    }
    instance->plant.time_s = start_s;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component component)
{
    struct instance *const instance = component;
    return instance == NULL
               ? fmi2Error
               : done(instance, plant_enter_initialisation(&instance->plant, instance->plant.time_s));
}

fmi2Status fmi2ExitInitializationMode(fmi2Component component)
{
    struct instance *const instance = component;
    return instance == NULL ? fmi2Error : done(instance, plant_exit_initialisation(&instance->plant));
}

fmi2Status fmi2Terminate(fmi2Component component)
{
    struct instance *const instance = component;
    return instance == NULL ? fmi2Error : done(instance, plant_terminate(&instance->plant));
}

fmi2Status fmi2Reset(fmi2Component component)
{
    struct instance *const instance = component;
    if (instance == NULL) {
        return fmi2Error;
    }
    plant_reset(&instance->plant);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component component, const fmi2ValueReference references[], size_t count,
                       fmi2Real values[])
{
    struct instance *const instance = component;
    if (instance == NULL || (count > 0u && (references == NULL || values == NULL))) {
        return fmi2Error;
    }
    bool is_good = true;
    for (size_t k = 0; k < count && is_good; k++) {
        is_good = plant_get(&instance->plant, references[k], &values[k]);
    }
    return done(instance, is_good);
}

fmi2Status fmi2SetReal(fmi2Component component, const fmi2ValueReference references[], size_t count,
                       const fmi2Real values[])
{
    struct instance *const instance = component;
    if (instance == NULL || (count > 0u && (references == NULL || values == NULL))) {
        return fmi2Error;
    }
    bool is_good = true;
    for (size_t k = 0; k < count && is_good; k++) {
        is_good = plant_set(&instance->plant, references[k], values[k]);
    }
    return done(instance, is_good);
}

#define NO_VARIABLES(type, name)                                                                           \
    fmi2Status fmi2Get##name(fmi2Component component, const fmi2ValueReference references[], size_t count, \
                             type values[])                                                                \
    {                                                                                                      \
        (void)references, (void)values;                                                                    \
        return count == 0u && component != NULL ? fmi2OK : not_there(component, "all variables are Real"); \
    }                                                                                                      \
    fmi2Status fmi2Set##name(fmi2Component component, const fmi2ValueReference references[], size_t count, \
                             const type values[])                                                          \
    {                                                                                                      \
        (void)references, (void)values;                                                                    \
        return count == 0u && component != NULL ? fmi2OK : not_there(component, "all variables are Real"); \
    }

NO_VARIABLES(fmi2Integer, Integer)
NO_VARIABLES(fmi2Boolean, Boolean)
NO_VARIABLES(fmi2String, String)

fmi2Status fmi2GetFMUstate(fmi2Component component, fmi2FMUstate *state)
{
    const struct instance *const instance = component;
    if (instance == NULL || state == NULL) {
        return fmi2Error;
    }
    if (*state == NULL) {
        *state = malloc(sizeof(struct plant));
    }
    if (*state == NULL) {
        return not_there(component, "no memory for a state");
    }
    *(struct plant *)*state = instance->plant;
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component component, fmi2FMUstate state)
{
    struct instance *const instance = component;
    if (instance == NULL || state == NULL) {
        return fmi2Error;
    }
    instance->plant = *(const struct plant *)state;
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component component, fmi2FMUstate *state)
{
    (void)component;
    if (state != NULL) {
        free(*state);
        *state = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component component, fmi2FMUstate state, size_t *size)
{
    if (component == NULL || state == NULL || size == NULL) {
        return fmi2Error;
    }
    *size = sizeof(struct plant);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component component, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    if (component == NULL || state == NULL || bytes == NULL || size < sizeof(struct plant)) {
        return fmi2Error;
    }
    (void)memcpy(bytes, state, sizeof(struct plant));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component component, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *state)
{
    if (component == NULL || bytes == NULL || state == NULL || size != sizeof(struct plant)) {
        return fmi2Error;
    }
    if (*state == NULL) {
        *state = malloc(sizeof(struct plant));
    }
    if (*state == NULL) {
        return not_there(component, "no memory for a state");
    }
    (void)memcpy(*state, bytes, sizeof(struct plant));
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component component, const fmi2ValueReference unknown[],
                                        size_t unknowns, const fmi2ValueReference known[], size_t knowns,
                                        const fmi2Real known_d[], fmi2Real unknown_d[])
{
    (void)unknown, (void)unknowns, (void)known, (void)knowns, (void)known_d, (void)unknown_d;
    return not_there(component, "no directional derivatives");
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component component, const fmi2ValueReference references[],
                                       size_t count, const fmi2Integer orders[], const fmi2Real values[])
{
    (void)references, (void)count, (void)orders, (void)values;
    return not_there(component, "inputs are held over a step: no derivatives");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component component, const fmi2ValueReference references[],
                                        size_t count, const fmi2Integer orders[], fmi2Real values[])
{
    (void)references, (void)count, (void)orders, (void)values;
    return not_there(component, "no derivatives of outputs");
}

fmi2Status fmi2DoStep(fmi2Component component, fmi2Real time_s, fmi2Real step_s, fmi2Boolean no_return)
{
    (void)no_return;
    struct instance *const instance = component;
    return instance == NULL ? fmi2Error : done(instance, plant_step(&instance->plant, time_s, step_s));
}

fmi2Status fmi2CancelStep(fmi2Component component)
{
    return not_there(component, "steps are never pending");
}

fmi2Status fmi2GetStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)kind, (void)value;
    return component != NULL ? fmi2Discard : fmi2Error;
}

fmi2Status fmi2GetRealStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Real *value)
{
    const struct instance *const instance = component;
    if (instance == NULL || value == NULL) {
        return fmi2Error;
    }
    if (kind != fmi2LastSuccessfulTime) {
        return fmi2Discard;
    }
    *value = instance->plant.time_s;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Integer *value)
{
    (void)kind, (void)value;
    return component != NULL ? fmi2Discard : fmi2Error;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Boolean *value)
{
    const struct instance *const instance = component;
    if (instance == NULL || value == NULL) {
        return fmi2Error;
    }
    if (kind != fmi2Terminated) {
        return fmi2Discard;
    }
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component component, const fmi2StatusKind kind, fmi2String *value)
{
    (void)kind, (void)value;
    return component != NULL ? fmi2Discard : fmi2Error;
}
