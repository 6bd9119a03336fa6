/* The sensors' raw values: unpacked, judged, replaced where they are missing or wrong, and made per unit. */
#ifndef ECU_SAMPLES_H
#define ECU_SAMPLES_H

#include "control/controller.h"
#include "ecu/faults.h"

struct ecu;

/* Raw values of this tick; of the last good tick where one is missing or wrong (angles: predicted). */
struct sensor_samples {
    int32_t angle[JOINTS];
    uint16_t pressure[JOINTS][CHAMBERS];
    int16_t spool[JOINTS];
};

/* What a raw value is judged by, raw itself: a comparison of integers instead of a conversion of each. */
struct sample_limits {
    int32_t angle_low[JOINTS], angle_high[JOINTS];
    int32_t angle_step[JOINTS]; /* most that an angle changes in a tick */
    int32_t pressure_high;
    int32_t pressure_step; /* the same of a pressure, in 1 ms or in a tick if that is shorter */
};

/* From the parameters, once. */
void samples_start(struct ecu *ecu);

/* This tick's samples from the frames that came. FAULT_NONE when all came and are good, else what was wrong: of
 * several the one that says most of the sensor. */
enum ecu_fault samples_take(struct ecu *ecu);

/* Per unit and tared; increments since `before`. */
struct measurement samples_measured(const struct ecu *ecu, const struct sensor_samples *before);

#endif
