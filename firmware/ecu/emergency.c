#include "ecu/emergency.h"

void emergency_note(struct emergency_history *history, uint16_t error_code, uint8_t fault_code)
{
    if (error_code == 0u) {
        return;
    }
    for (uint8_t k = EMERGENCIES_KEPT - 1u; k > 0u; k--) {
        history->entry[k] = history->entry[k - 1u];
    }
    history->entry[0] = error_code | (uint32_t)fault_code << 16;
    if (history->count < EMERGENCIES_KEPT) {
        history->count++;
    }
}
