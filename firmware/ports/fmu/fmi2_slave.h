/* The C interface of an FMI 2.0 slave for co-simulation: what is the same whatever the model. The one file of an FMU
 * that includes it has declared `fmu_model`, plain data with `time_s` and with `text`, the reason for what was refused
 * last. It then defines the functions of the first part, says with the macros of the last which variables there are,
 * and adds FMI's functions for saved states. */
#ifndef PORTS_FMU_FMI2_SLAVE_H
#define PORTS_FMU_FMI2_SLAVE_H

#include <fmi2Functions.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

/* ---- of the model ---- */

static const char *const model_token;          /* the GUID in modelDescription.xml */
static const char *const no_input_derivatives; /* why it takes none */

/* As after instantiation. */
static void model_reset(fmu_model *model);
/* Each returns false with the reason in model->text. */
static bool model_enter_initialisation(fmu_model *model);
static bool model_exit_initialisation(fmu_model *model);
static bool model_terminate(fmu_model *model);
static bool model_may_be_set(fmu_model *model);
/* fmi2OK, fmi2Error, or fmi2Discard: not done, the tool may come back with another step. */
static fmi2Status model_step(fmu_model *model, double time_s, double step_s);

/* ---- what is told ---- */

struct component {
    fmu_model model;
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
    return is_good ? fmi2OK : tell(component, fmi2Error, component->model.text);
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

/* ---- the life of an instance ---- */

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
    model_reset(&component->model);
    const char *wrong = NULL;
    if (type != fmi2CoSimulation) {
        wrong = "this FMU is for co-simulation";
    } else if (token == NULL || strcmp(token, model_token) != 0) {
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
    component->model.time_s = start_s;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component handle)
{
    struct component *const component = handle;
    return component == NULL ? fmi2Error : done(component, model_enter_initialisation(&component->model));
}

fmi2Status fmi2ExitInitializationMode(fmi2Component handle)
{
    struct component *const component = handle;
    return component == NULL ? fmi2Error : done(component, model_exit_initialisation(&component->model));
}

fmi2Status fmi2Terminate(fmi2Component handle)
{
    struct component *const component = handle;
    return component == NULL ? fmi2Error : done(component, model_terminate(&component->model));
}

fmi2Status fmi2Reset(fmi2Component handle)
{
    struct component *const component = handle;
    if (component == NULL) {
        return fmi2Error;
    }
    model_reset(&component->model);
    return fmi2OK;
}

/* ---- steps ---- */

fmi2Status fmi2DoStep(fmi2Component handle, fmi2Real time_s, fmi2Real step_s, fmi2Boolean no_return)
{
    (void)no_return;
    struct component *const component = handle;
    if (component == NULL) {
        return fmi2Error;
    }
    const fmi2Status status = model_step(&component->model, time_s, step_s);
    return status == fmi2OK ? fmi2OK : tell(component, status, component->model.text);
}

fmi2Status fmi2CancelStep(fmi2Component handle)
{
    return not_there(handle, "steps are never pending");
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
    *value = component->model.time_s;
    return fmi2OK;
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

/* For what FMI asks of pending steps only. */
#define NO_STATUS(Function, type)                                                           \
    fmi2Status Function(fmi2Component handle, const fmi2StatusKind kind, fmi2##type *value) \
    {                                                                                       \
        (void)kind, (void)value;                                                            \
        return handle != NULL ? fmi2Discard : fmi2Error;                                    \
    }

NO_STATUS(fmi2GetStatus, Status)
NO_STATUS(fmi2GetIntegerStatus, Integer)
NO_STATUS(fmi2GetStringStatus, String)

/* ---- derivatives ---- */

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
    return not_there(handle, no_input_derivatives);
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component handle, const fmi2ValueReference references[],
                                        size_t count, const fmi2Integer orders[], fmi2Real values[])
{
    (void)references, (void)count, (void)orders, (void)values;
    return not_there(handle, "no derivatives of outputs");
}

/* ---- variables ---- */

static bool is_call_whole(const struct component *component, const fmi2ValueReference references[],
                          size_t count, const void *values)
{
    return component != NULL && (count == 0u || (references != NULL && values != NULL));
}

/* The model has variables of a type: bool `get`(model, reference, value *) and `set`(model, reference, value), which
 * return false with the reason in model->text. */
#define VARIABLES(Type, get, set)                                                                       \
    fmi2Status fmi2Get##Type(fmi2Component handle, const fmi2ValueReference references[], size_t count, \
                             fmi2##Type values[])                                                       \
    {                                                                                                   \
        struct component *const component = handle;                                                     \
        if (!is_call_whole(component, references, count, values)) {                                     \
            return fmi2Error;                                                                           \
        }                                                                                               \
        bool is_good = true;                                                                            \
        for (size_t k = 0; k < count && is_good; k++) {                                                 \
            is_good = get(&component->model, references[k], &values[k]);                                \
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
        bool is_good = model_may_be_set(&component->model);                                             \
        for (size_t k = 0; k < count && is_good; k++) {                                                 \
            is_good = set(&component->model, references[k], values[k]);                                 \
        }                                                                                               \
        return done(component, is_good);                                                                \
    }

/* It has none of that type. */
#define NO_VARIABLES(Type, why)                                                                         \
    fmi2Status fmi2Get##Type(fmi2Component handle, const fmi2ValueReference references[], size_t count, \
                             fmi2##Type values[])                                                       \
    {                                                                                                   \
        (void)references, (void)values;                                                                 \
        return count == 0u && handle != NULL ? fmi2OK : not_there(handle, why);                         \
    }                                                                                                   \
    fmi2Status fmi2Set##Type(fmi2Component handle, const fmi2ValueReference references[], size_t count, \
                             const fmi2##Type values[])                                                 \
    {                                                                                                   \
        (void)references, (void)values;                                                                 \
        return count == 0u && handle != NULL ? fmi2OK : not_there(handle, why);                         \
    }

#endif
