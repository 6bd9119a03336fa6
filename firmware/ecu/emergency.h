/* What the last emergencies said: object 1003h. */
#ifndef ECU_EMERGENCY_H
#define ECU_EMERGENCY_H

#include <stdint.h>

#define EMERGENCIES_KEPT 8u

struct emergency_history {
    uint32_t entry[EMERGENCIES_KEPT]; /* newest first: error code, fault code << 16 */
    uint8_t count;
};

/* An emergency has been sent. error_code 0 says that the fault is gone, and is no error to keep. */
void emergency_note(struct emergency_history *history, uint16_t error_code, uint8_t fault_code);

#endif
