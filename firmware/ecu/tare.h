/* Zero of the pressure sensors, found with all chambers at tank pressure. */
#ifndef ECU_TARE_H
#define ECU_TARE_H

#include "control/controller.h"
#include "ecu/parameters.h"

struct sensor_samples;

struct tare {
    uint16_t samples_left;
    uint16_t samples;
    int32_t sum[JOINTS][CHAMBERS];   /* raw */
    scalar offset[JOINTS][CHAMBERS]; /* Pa */
};

enum tare_result { TARE_GOES_ON, TARE_DONE, TARE_REFUSED /* the chambers are not at tank pressure */ };

/* The offsets stay until the new ones are found. */
void tare_start(struct tare *tare, uint32_t period_us);

/* One good sample. */
enum tare_result tare_step(struct tare *tare, const struct sensor_samples *samples,
                           const struct machine *machine, const struct bases *bases);

#endif
