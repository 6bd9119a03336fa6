#include "ecu/control_word.h"

enum control_request control_word_request(uint16_t word)
{
    if (word > (CONTROL_WORD_D | CONTROL_WORD_H | CONTROL_WORD_M | CONTROL_WORD_R)) {
        return CONTROL_UNKNOWN;
    }
    if ((word & CONTROL_WORD_R) != 0u) {
        return CONTROL_RESET;
    }
    switch (word) {
    case 0:
    case CONTROL_WORD_D:
        return CONTROL_STANDBY;
    case CONTROL_WORD_D | CONTROL_WORD_H:
        return CONTROL_HOLD;
    case CONTROL_WORD_D | CONTROL_WORD_H | CONTROL_WORD_M:
        return CONTROL_RUN;
    default:
        return CONTROL_UNKNOWN;
    }
}
