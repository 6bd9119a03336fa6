/* The ECU as FMI 2.0 sees it: a slave for co-simulation whose step is a tick. */
#include <string.h>

#include "ports/fmu/instance.h"

typedef struct instance fmu_model;

#include "ports/fmu/fmi2_slave.h"

static const char *const model_token = FMU_TOKEN;
static const char *const no_input_derivatives = "inputs are sampled at the step's begin: no derivatives";

static void model_reset(struct instance *instance)
{
    instance_reset(instance);
}

static bool model_enter_initialisation(struct instance *instance)
{
    if (instance->phase != PHASE_NEW) {
        return instance_refuse(instance, "initialisation is possible once, after instantiation or reset");
    }
    instance->phase = PHASE_INITIALISING;
    return true;
}

static bool model_exit_initialisation(struct instance *instance)
{
    return instance_start(instance);
}

static bool model_terminate(struct instance *instance)
{
    return instance_terminate(instance);
}

static bool model_may_be_set(struct instance *instance)
{
    return instance->phase != PHASE_TERMINATED ||
           instance_refuse(instance, "nothing can be set after termination");
}

static fmi2Status model_step(struct instance *instance, double time_s, double step_s)
{
    const bool is_running = instance->phase == PHASE_STEPPING;
    if (instance_step(instance, time_s, step_s)) {
        return fmi2OK;
    }
    return is_running ? fmi2Discard : fmi2Error;
}

/* ---- variables ---- */

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

VARIABLES(Real, get_real, set_real)
VARIABLES(Integer, get_integer, set_integer)
VARIABLES(Boolean, get_boolean, set_boolean)
VARIABLES(String, get_string, set_string)

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
