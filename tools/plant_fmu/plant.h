/* One arm of the simulated machine as a co-simulation FMU: what both versions of FMI share. The equations are those
 * of sil_plant/plant/dynamics.py, compiled; see sil_plant/fmu/plant_object.py. Nothing here is shared between
 * instances. */
#ifndef PLANT_FMU_PLANT_H
#define PLANT_FMU_PLANT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "plant_constants.h" /* made by tools/export_fmu.py */

/* Value references; parameter k is REFERENCE_PARAMETER + k. */
enum reference {
    REFERENCE_TIME = 0,
    REFERENCE_STATE = 1, /* to PLANT_STATES */
    REFERENCE_COMMAND = 101,
    REFERENCE_LOAD = 201,
    REFERENCE_START = 202,
    REFERENCE_PARAMETER = 1000
};

enum plant_phase { PHASE_NEW, PHASE_INITIALISING, PHASE_STEPPING, PHASE_TERMINATED, PHASE_FAILED };

#define PLANT_TEXT_BYTES 160

/* Plain data: a copy is a saved state. */
struct plant {
    enum plant_phase phase;
    double time_s;
    double y[PLANT_STATES];
    double u[2];
    double load_kg;
    double start_rad[2];
    double parameters[PLANT_PARAMETERS];
    double scratch[PLANT_SCRATCH];
    bool is_rest_due;            /* y is to be computed from load, start and parameters */
    char text[PLANT_TEXT_BYTES]; /* what the last function that returned false has to say */
};

/* As after instantiation: the values that modelDescription.xml states. */
void plant_reset(struct plant *plant);

/* Each returns false with the reason in plant->text, and then has changed nothing else. */
bool plant_enter_initialisation(struct plant *plant, double start_time_s);
bool plant_exit_initialisation(struct plant *plant);
bool plant_get(struct plant *plant, uint32_t reference, double *value);
bool plant_set(struct plant *plant, uint32_t reference, double value);
bool plant_step(struct plant *plant, double time_s, double step_s);
bool plant_terminate(struct plant *plant);
/* Copies a plant's bytes into a saved state, a new one when *state is NULL. */
bool plant_save(struct plant *plant, const void *bytes, void **state);

void plant_free_saved(void **state);

#endif
