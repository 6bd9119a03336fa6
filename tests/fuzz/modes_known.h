/* The modes as these tests know them, not as the firmware's table has them: which drive the valves, and which may
 * follow which. A new mode is added here and nowhere else. */
#ifndef MODES_KNOWN_H
#define MODES_KNOWN_H

#include <stdbool.h>
#include <stdint.h>

enum { INIT, STANDBY, RUN, TARE, COMMISSION, HOLD, SAFE_STOP, FAULT = 15, MODES_END };

#define TO(mode) (1u << (mode))

struct known_mode {
    bool exists;
    bool drives;
    uint32_t successors; /* TO(mode).., besides INIT after a reset of the node */
};

static const struct known_mode KNOWN_MODES[MODES_END] = {
    [INIT] = {true, false, TO(STANDBY) | TO(FAULT)},
    [STANDBY] = {true, false, TO(INIT) | TO(RUN) | TO(TARE) | TO(COMMISSION) | TO(HOLD) | TO(FAULT)},
    [TARE] = {true, false, TO(INIT) | TO(STANDBY) | TO(FAULT)},
    [RUN] = {true, true, TO(HOLD) | TO(SAFE_STOP) | TO(STANDBY) | TO(FAULT)},
    [COMMISSION] = {true, true, TO(SAFE_STOP) | TO(STANDBY) | TO(FAULT)},
    [HOLD] = {true, true, TO(RUN) | TO(SAFE_STOP) | TO(STANDBY) | TO(FAULT)},
    [SAFE_STOP] = {true, true, TO(STANDBY) | TO(FAULT)},
    [FAULT] = {true, false, TO(INIT)},
};

#endif
