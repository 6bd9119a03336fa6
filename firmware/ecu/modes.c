#include "ecu/modes.h"

enum mode_condition {
    ALWAYS,
    IF_OPERATIONAL,  /* else NOT_OPERATIONAL */
    IF_READY,        /* operational and sensors good, else NOT_OPERATIONAL, SENSORS_NOT_FRESH */
    IF_FAULT_ACTIVE, /* else the next row */
    IF_CAUSE_GONE    /* else SENSORS_NOT_FRESH or CAUSE_PERSISTS */
};

struct transition {
    uint8_t from; /* enum ecu_mode */
    uint8_t event;
    uint8_t condition;
    uint8_t to;
};

/* tools/generate.py makes docs/modes.md from these rows. Of two rows for the same pair the first whose condition
 * holds counts. */
static const struct transition TABLE[] = {
    /* from, event, condition, to */
    {MODE_INIT, EVENT_STANDBY, ALWAYS, MODE_INIT},
    {MODE_INIT, EVENT_SAFE_STOP, ALWAYS, MODE_INIT},
    {MODE_INIT, EVENT_SENSORS_READY, IF_OPERATIONAL, MODE_STANDBY},
    {MODE_INIT, EVENT_FAULT_OFF, ALWAYS, MODE_FAULT},

    {MODE_STANDBY, EVENT_STANDBY, ALWAYS, MODE_STANDBY},
    {MODE_STANDBY, EVENT_SAFE_STOP, ALWAYS, MODE_STANDBY},
    {MODE_STANDBY, EVENT_RUN, IF_READY, MODE_RUN},
    {MODE_STANDBY, EVENT_COMMISSION, IF_READY, MODE_COMMISSION},
    {MODE_STANDBY, EVENT_HOLD, IF_READY, MODE_HOLD},
    {MODE_STANDBY, EVENT_TARE, IF_OPERATIONAL, MODE_TARE},
    {MODE_STANDBY, EVENT_SENSORS_GONE, ALWAYS, MODE_INIT},
    {MODE_STANDBY, EVENT_FAULT_OFF, ALWAYS, MODE_FAULT},

    {MODE_TARE, EVENT_STANDBY, ALWAYS, MODE_STANDBY},
    {MODE_TARE, EVENT_SAFE_STOP, ALWAYS, MODE_STANDBY},
    {MODE_TARE, EVENT_TARE_DONE, ALWAYS, MODE_STANDBY},
    {MODE_TARE, EVENT_NMT_LEFT, ALWAYS, MODE_STANDBY},
    {MODE_TARE, EVENT_SENSORS_GONE, ALWAYS, MODE_INIT},
    {MODE_TARE, EVENT_FAULT_OFF, ALWAYS, MODE_FAULT},

    {MODE_RUN, EVENT_STANDBY, ALWAYS, MODE_SAFE_STOP},
    {MODE_RUN, EVENT_SAFE_STOP, ALWAYS, MODE_SAFE_STOP},
    {MODE_RUN, EVENT_HOLD, ALWAYS, MODE_HOLD},
    {MODE_RUN, EVENT_FAULT_STOP, ALWAYS, MODE_SAFE_STOP},
    {MODE_RUN, EVENT_FAULT_OFF, ALWAYS, MODE_FAULT},
    {MODE_RUN, EVENT_NMT_LEFT, ALWAYS, MODE_STANDBY},

    {MODE_COMMISSION, EVENT_STANDBY, ALWAYS, MODE_SAFE_STOP},
    {MODE_COMMISSION, EVENT_SAFE_STOP, ALWAYS, MODE_SAFE_STOP},
    {MODE_COMMISSION, EVENT_FAULT_STOP, ALWAYS, MODE_SAFE_STOP},
    {MODE_COMMISSION, EVENT_FAULT_OFF, ALWAYS, MODE_FAULT},
    {MODE_COMMISSION, EVENT_NMT_LEFT, ALWAYS, MODE_STANDBY},

    {MODE_HOLD, EVENT_HOLD, ALWAYS, MODE_HOLD},
    {MODE_HOLD, EVENT_RUN, IF_READY, MODE_RUN},
    {MODE_HOLD, EVENT_STANDBY, ALWAYS, MODE_SAFE_STOP},
    {MODE_HOLD, EVENT_SAFE_STOP, ALWAYS, MODE_SAFE_STOP},
    {MODE_HOLD, EVENT_FAULT_STOP, ALWAYS, MODE_SAFE_STOP},
    {MODE_HOLD, EVENT_FAULT_OFF, ALWAYS, MODE_FAULT},
    {MODE_HOLD, EVENT_NMT_LEFT, ALWAYS, MODE_STANDBY},

    {MODE_SAFE_STOP, EVENT_STANDBY, ALWAYS, MODE_SAFE_STOP},
    {MODE_SAFE_STOP, EVENT_SAFE_STOP, ALWAYS, MODE_SAFE_STOP},
    {MODE_SAFE_STOP, EVENT_STOPPED, IF_FAULT_ACTIVE, MODE_FAULT},
    {MODE_SAFE_STOP, EVENT_STOPPED, ALWAYS, MODE_STANDBY},
    {MODE_SAFE_STOP, EVENT_FAULT_OFF, ALWAYS, MODE_FAULT},
    {MODE_SAFE_STOP, EVENT_NMT_LEFT, IF_FAULT_ACTIVE, MODE_FAULT},
    {MODE_SAFE_STOP, EVENT_NMT_LEFT, ALWAYS, MODE_STANDBY},

    {MODE_FAULT, EVENT_STANDBY, ALWAYS, MODE_FAULT},
    {MODE_FAULT, EVENT_SAFE_STOP, ALWAYS, MODE_FAULT},
    {MODE_FAULT, EVENT_RESET_FAULT, IF_CAUSE_GONE, MODE_INIT},
};

/* Why a request has no row in a mode. */
static enum ecu_refusal misplaced(enum ecu_mode mode, enum ecu_event event)
{
    if (event == EVENT_RESET_FAULT) {
        return REFUSAL_NO_FAULT_TO_RESET;
    }
    return mode == MODE_SAFE_STOP ? REFUSAL_STOPPING : REFUSAL_NOT_IN_STANDBY;
}

/* Whether the row counts. When not, *refusal says why, or is NONE when the next row may. */
static bool condition_holds(enum mode_condition condition, const struct mode_conditions *conditions,
                            enum ecu_refusal *refusal)
{
    *refusal = REFUSAL_NONE;
    switch (condition) {
    case IF_OPERATIONAL:
        *refusal = conditions->operational ? REFUSAL_NONE : REFUSAL_NOT_OPERATIONAL;
        return conditions->operational;
    case IF_READY:
        if (!conditions->operational) {
            *refusal = REFUSAL_NOT_OPERATIONAL;
            return false;
        }
        *refusal = conditions->sensors_good ? REFUSAL_NONE : REFUSAL_SENSORS_NOT_FRESH;
        return conditions->sensors_good;
    case IF_FAULT_ACTIVE:
        return conditions->fault_active;
    case IF_CAUSE_GONE:
        if (!conditions->sensors_good) {
            *refusal = REFUSAL_SENSORS_NOT_FRESH;
            return false;
        }
        *refusal = conditions->cause_gone ? REFUSAL_NONE : REFUSAL_CAUSE_PERSISTS;
        return conditions->cause_gone;
    case ALWAYS:
    default:
        return true;
    }
}

enum ecu_refusal modes_next(enum ecu_mode mode, enum ecu_event event,
                            const struct mode_conditions *conditions, enum ecu_mode *next)
{
    *next = mode;
    for (uint8_t k = 0; k < sizeof TABLE / sizeof TABLE[0]; k++) {
        const struct transition *const row = &TABLE[k];
        if (row->from != (uint8_t)mode || row->event != (uint8_t)event) {
            continue;
        }
        enum ecu_refusal refusal = REFUSAL_NONE;
        if (condition_holds((enum mode_condition)row->condition, conditions, &refusal)) {
            *next = (enum ecu_mode)row->to;
            return REFUSAL_NONE;
        }
        if (refusal != REFUSAL_NONE) {
            return refusal;
        }
    }
    return event <= EVENT_RESET_FAULT ? misplaced(mode, event) : REFUSAL_NONE;
}

bool mode_drives(enum ecu_mode mode)
{
    return mode == MODE_RUN || mode == MODE_COMMISSION || mode == MODE_HOLD || mode == MODE_SAFE_STOP;
}

uint8_t mode_cia408_status(enum ecu_mode mode)
{
    switch (mode) {
    case MODE_RUN:
    case MODE_COMMISSION:
    case MODE_SAFE_STOP:
        return 0xFu; /* ready, ACTIVE */
    case MODE_HOLD:
        return 0xBu; /* ready, HOLD */
    case MODE_STANDBY:
    case MODE_TARE:
        return 0x9u; /* ready, DISABLED */
    case MODE_FAULT:
        return 0x1u; /* DISABLED, not ready */
    case MODE_INIT:
    default:
        return 0x8u;
    }
}
