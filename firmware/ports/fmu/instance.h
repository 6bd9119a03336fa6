/* One ECU as a simulation tool sees it: sensors, requests and parameters in, valve commands and estimates out. The
 * ECU itself is the one of every port: its inputs become the frames of the I/O node and the master, and what it tells
 * is read from the frames that it sends. Nothing is shared between instances. */
#ifndef PORTS_FMU_INSTANCE_H
#define PORTS_FMU_INSTANCE_H

#include "ecu/ecu.h"
#include "ports/fmu/variables.h" /* made by tools/export_fmu.py from the DBC and the parameter list */

enum instance_phase {
    PHASE_NEW,          /* parameters may be set */
    PHASE_INITIALISING, /* the same */
    PHASE_STEPPING,
    PHASE_TERMINATED /* the valves are shut */
};

#define INSTANCE_TEXT_BYTES 320
#define INSTANCE_PATH_BYTES 1024
#define INSTANCE_QUEUE 8 /* NMT, a request, two moves, three sensor frames */

struct instance {
    enum instance_phase phase;
    double time_s;
    /* what the tool sets */
    double sensor[FMU_SENSOR_COUNT]; /* SI; no number: marked invalid */
    int32_t request;
    int32_t controller;
    double target_rad[JOINTS];
    double duration_s[JOINTS];
    bool move[JOINTS];
    char image_path[INSTANCE_PATH_BYTES]; /* "": the reference arm, built in */
    struct parameter_image image;
    bool is_given[PARAMETER_COUNT]; /* set one by one; these stand above the file */
    double period_s;
    /* what it reads */
    double output[FMU_OUTPUT_COUNT];
    bool valves_active;
    /* between the two */
    struct ecu ecu;
    uint8_t sync_counter;
    bool is_network_started;
    int32_t last_request;
    bool last_move[JOINTS];
    uint8_t motion_counter;
    struct can_frame_11bit queue[INSTANCE_QUEUE];
    uint8_t queued, taken;
    char text[INSTANCE_TEXT_BYTES]; /* what the last function that returned false has to say */
};

/* As after instantiation. */
void instance_reset(struct instance *instance);

/* Each returns false with the reason in instance->text, and then has changed nothing. */
bool instance_start(struct instance *instance);
bool instance_get_parameter(struct instance *instance, uint32_t entry, double *value);
bool instance_set_parameter(struct instance *instance, uint32_t entry, double value);
/* A whole number of ticks. */
bool instance_step(struct instance *instance, double time_s, double step_s);
/* The last valve frame is zero and disabled. */
bool instance_terminate(struct instance *instance);

bool instance_refuse(struct instance *instance, const char *format, ...);

#endif
