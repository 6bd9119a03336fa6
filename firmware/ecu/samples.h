/* The sensors' raw values: unpacked, judged, replaced where they are missing or wrong, and made per unit. */
#ifndef ECU_SAMPLES_H
#define ECU_SAMPLES_H

#include "control/controller.h"
#include "ecu/faults.h"

/* Raw values of this tick; of the last good tick where one is missing or wrong (angles: predicted). */
struct sensor_samples {
    int32_t angle[JOINTS];
    int32_t pressure[JOINTS][CHAMBERS];
    int32_t spool[JOINTS];
};

/* This tick's samples from the frames that came. FAULT_NONE when all came and are good, else what was wrong: of
 * several the one that says most of the sensor. */
enum ecu_fault samples_take(struct ecu *ecu);

/* Per unit and tared; increments since `before`. */
struct measurement samples_measured(const struct ecu *ecu, const struct sensor_samples *before);

#endif
