/* The plant as FMI 2.0 sees it. */
#include <string.h>

#include "plant.h"

typedef struct plant fmu_model;

#include "../../firmware/ports/fmu/fmi2_slave.h"

static const char *const model_token = PLANT_TOKEN;
static const char *const no_input_derivatives = "inputs are held over a step: no derivatives";

static void model_reset(struct plant *plant)
{
    plant_reset(plant);
}

static bool model_enter_initialisation(struct plant *plant)
{
    return plant_enter_initialisation(plant, plant->time_s);
}

static bool model_exit_initialisation(struct plant *plant)
{
    return plant_exit_initialisation(plant);
}

static bool model_terminate(struct plant *plant)
{
    return plant_terminate(plant);
}

/* plant_set knows it of each variable. */
static bool model_may_be_set(struct plant *plant)
{
    (void)plant;
    return true;
}

static fmi2Status model_step(struct plant *plant, double time_s, double step_s)
{
    return plant_step(plant, time_s, step_s) ? fmi2OK : fmi2Error;
}

VARIABLES(Real, plant_get, plant_set)
NO_VARIABLES(Integer, "all variables are Real")
NO_VARIABLES(Boolean, "all variables are Real")
NO_VARIABLES(String, "all variables are Real")

/* ---- saved states ---- */

fmi2Status fmi2GetFMUstate(fmi2Component handle, fmi2FMUstate *state)
{
    struct component *const component = handle;
    return component == NULL || state == NULL
               ? fmi2Error
               : done(component, plant_save(&component->model, &component->model, state));
}

fmi2Status fmi2SetFMUstate(fmi2Component handle, fmi2FMUstate state)
{
    struct component *const component = handle;
    if (component == NULL || state == NULL) {
        return fmi2Error;
    }
    component->model = *(const struct plant *)state;
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component handle, fmi2FMUstate *state)
{
    (void)handle;
    plant_free_saved(state);
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component handle, fmi2FMUstate state, size_t *size)
{
    if (handle == NULL || state == NULL || size == NULL) {
        return fmi2Error;
    }
    *size = sizeof(struct plant);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component handle, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    if (handle == NULL || state == NULL || bytes == NULL || size < sizeof(struct plant)) {
        return fmi2Error;
    }
    (void)memcpy(bytes, state, sizeof(struct plant));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component handle, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *state)
{
    struct component *const component = handle;
    if (component == NULL || bytes == NULL || state == NULL || size != sizeof(struct plant)) {
        return fmi2Error;
    }
    return done(component, plant_save(&component->model, bytes, state));
}
