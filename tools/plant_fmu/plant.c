#include "plant.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* The compiled equations; 0: all is well. */
int32_t diarc_plant_step(void **nothing, void **error, double *y, const double *u, double load_kg,
                         const double *parameters, double duration_s, double *scratch);
int32_t diarc_plant_rest(int64_t *joint, void **error, const double *q, double load_kg,
                         const double *parameters, double *y);
/* The compiler of the equations refers to it for arrays that it owns; there are none. */
void NRT_MemInfo_call_dtor(void *info);

void NRT_MemInfo_call_dtor(void *info)
{
    (void)info;
    abort();
}

static const double PARAMETERS[PLANT_PARAMETERS] = {PLANT_PARAMETER_VALUES};
static const double START_RAD[2] = {PLANT_START_VALUES};

static bool refuse(struct plant *plant, const char *format, ...)
{
    va_list values;
    va_start(values, format);
    (void)vsnprintf(plant->text, sizeof plant->text, format, values);
    va_end(values);
    return false;
}

void plant_reset(struct plant *plant)
{
    *plant = (struct plant){.phase = PHASE_NEW, .load_kg = PLANT_LOAD_KG, .is_rest_due = true};
    for (size_t k = 0; k < PLANT_PARAMETERS; k++) {
        plant->parameters[k] = PARAMETERS[k];
    }
    for (size_t i = 0; i < 2u; i++) {
        plant->start_rad[i] = START_RAD[i];
    }
}

/* The state at rest, when what it follows from has changed. */
static bool find_rest(struct plant *plant)
{
    if (!plant->is_rest_due) {
        return true;
    }
    double y[PLANT_STATES];
    int64_t joint = -1;
    void *error = NULL;
    const int32_t failed =
        diarc_plant_rest(&joint, &error, plant->start_rad, plant->load_kg, plant->parameters, y);
    if (failed != 0) {
        return refuse(plant,
                      "the parameters make no arm: a division by zero; check lever arms, areas and volumes");
    }
    if (joint >= 0) {
        return refuse(plant, "the %s cylinder cannot hold %g kg at %g rad; lower the load or raise p_supply",
                      joint == 0 ? "swing" : "wrist", plant->load_kg, plant->start_rad[joint]);
    }
    for (size_t k = 0; k < PLANT_STATES; k++) {
        plant->y[k] = y[k];
    }
    plant->is_rest_due = false;
    return true;
}

bool plant_enter_initialisation(struct plant *plant, double start_time_s)
{
    if (plant->phase != PHASE_NEW) {
        return refuse(plant, "initialisation is possible once, after instantiation or reset");
    }
    plant->time_s = start_time_s;
    plant->phase = PHASE_INITIALISING;
    return true;
}

bool plant_exit_initialisation(struct plant *plant)
{
    if (plant->phase != PHASE_INITIALISING) {
        return refuse(plant, "initialisation mode was not entered");
    }
    if (!find_rest(plant)) {
        return false;
    }
    plant->phase = PHASE_STEPPING;
    return true;
}

bool plant_get(struct plant *plant, uint32_t reference, double *value)
{
    if (reference == REFERENCE_TIME) {
        *value = plant->time_s;
    } else if (reference < REFERENCE_STATE + (uint32_t)PLANT_STATES) {
        if (!find_rest(plant)) {
            return false;
        }
        *value = plant->y[reference - REFERENCE_STATE];
    } else if (reference - REFERENCE_COMMAND < 2u) {
        *value = plant->u[reference - REFERENCE_COMMAND];
    } else if (reference == REFERENCE_LOAD) {
        *value = plant->load_kg;
    } else if (reference - REFERENCE_START < 2u) {
        *value = plant->start_rad[reference - REFERENCE_START];
    } else if (reference - REFERENCE_PARAMETER < (uint32_t)PLANT_PARAMETERS) {
        *value = plant->parameters[reference - REFERENCE_PARAMETER];
    } else {
        return refuse(plant, "there is no variable with value reference %u", (unsigned)reference);
    }
    return true;
}

bool plant_set(struct plant *plant, uint32_t reference, double value)
{
    const bool is_fixed = plant->phase != PHASE_NEW && plant->phase != PHASE_INITIALISING;
    if (!isfinite(value)) {
        return refuse(plant, "value reference %u was set to no finite number", (unsigned)reference);
    }
    if (plant->phase == PHASE_TERMINATED) {
        return refuse(plant, "nothing can be set after termination; reset first");
    }
    if (reference - REFERENCE_COMMAND < 2u) {
        plant->u[reference - REFERENCE_COMMAND] = value;
        return true;
    }
    if (reference == REFERENCE_LOAD) {
        if (value < 0.0) {
            return refuse(plant, "a load is 0 kg or more, not %g", value);
        }
        plant->load_kg = value;
        plant->is_rest_due = plant->is_rest_due || !is_fixed;
        return true;
    }
    if (is_fixed) {
        return refuse(plant, "value reference %u cannot be set after initialisation", (unsigned)reference);
    }
    if (reference - REFERENCE_START < 2u) {
        plant->start_rad[reference - REFERENCE_START] = value;
    } else if (reference >= REFERENCE_PARAMETER &&
               reference - REFERENCE_PARAMETER < (uint32_t)PLANT_PARAMETERS) {
        plant->parameters[reference - REFERENCE_PARAMETER] = value;
    } else {
        return refuse(plant, "value reference %u is nothing that can be set", (unsigned)reference);
    }
    plant->is_rest_due = true;
    return true;
}

bool plant_step(struct plant *plant, double time_s, double step_s)
{
    if (plant->phase != PHASE_STEPPING) {
        return refuse(plant, "a step needs an initialised FMU");
    }
    if (!(step_s > 0.0) || step_s > 1e3 || !isfinite(time_s)) {
        return refuse(plant, "a step of %g s from %g s is not possible: more than 0 up to 1000 s are", step_s,
                      time_s);
    }
    void *nothing = NULL;
    void *error = NULL;
    bool is_good = diarc_plant_step(&nothing, &error, plant->y, plant->u, plant->load_kg, plant->parameters,
                                    step_s, plant->scratch) == 0;
    for (size_t k = 0; k < PLANT_STATES; k++) {
        is_good = is_good && isfinite(plant->y[k]);
    }
    plant->time_s = time_s + step_s;
    if (!is_good) {
        plant->phase = PHASE_FAILED;
        return refuse(plant, "the arm's state is no number any more at %g s; check the parameters",
                      plant->time_s);
    }
    return true;
}

bool plant_terminate(struct plant *plant)
{
    if (plant->phase != PHASE_STEPPING && plant->phase != PHASE_FAILED) {
        return refuse(plant, "there is nothing to terminate");
    }
    plant->phase = PHASE_TERMINATED;
    return true;
}

bool plant_save(struct plant *plant, const void *bytes, void **state)
{
    if (*state == NULL) {
        *state = malloc(sizeof(struct plant));
    }
    if (*state == NULL) {
        return refuse(plant, "no memory for a state");
    }
    (void)memcpy(*state, bytes, sizeof(struct plant));
    return true;
}

void plant_free_saved(void **state)
{
    if (state != NULL) {
        free(*state);
        *state = NULL;
    }
}
