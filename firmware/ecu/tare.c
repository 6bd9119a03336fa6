#include "ecu/tare.h"

#include "ecu/samples.h"
#include "ecu/wire.h"

#define TARE_US 100000u
#define TARE_LIMIT_RAW 1000 /* 5 bar from tank pressure: more is no sensor's error, the pump is on */
#define TARE_EXTRA_BITS 4   /* the mean is kept finer than a raw step */

void tare_start(struct tare *tare, uint32_t period_us)
{
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        tare->sum[n / CHAMBERS][n % CHAMBERS] = 0;
    }
    tare->samples = (uint16_t)(TARE_US / period_us);
    tare->samples_left = tare->samples;
}

enum tare_result tare_step(struct tare *tare, const struct sensor_samples *samples,
                           const struct machine *machine, const struct bases *bases)
{
    for (uint8_t i = 0; i < JOINTS; i++) {
        tare->sum[i][BORE] += samples->pressure[i][BORE];
        tare->sum[i][ANNULUS] += samples->pressure[i][ANNULUS];
    }
    tare->samples_left--;
    if (tare->samples_left > 0u) {
        return TARE_GOES_ON;
    }
    const int8_t base = bases->pressure;
    const scalar tank = machine->supply.p_tank;
    const scalar limit_Pa = WIRE_DECODE(TARE_LIMIT_RAW, DIARC_PRESSURES_SWING_BORE_PRESSURE, base);
    scalar offset[JOINTS * CHAMBERS];
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        const int32_t sum = tare->sum[n / CHAMBERS][n % CHAMBERS];
        const int32_t mean = sum * (1 << TARE_EXTRA_BITS) / tare->samples;
        const scalar p =
            WIRE_DECODE(mean, DIARC_PRESSURES_SWING_BORE_PRESSURE, (int8_t)(base + TARE_EXTRA_BITS));
        offset[n] = p - tank;
        if (absolute(offset[n]) > limit_Pa) {
            return TARE_REFUSED; /* the offsets of the last good tare stay */
        }
    }
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        tare->offset[n / CHAMBERS][n % CHAMBERS] = offset[n];
    }
    return TARE_DONE;
}
