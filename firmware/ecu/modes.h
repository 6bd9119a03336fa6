/* What the ECU may do when: one table of modes and the events that lead from one to another. Pure; what a change of
 * mode does is operation.c. */
#ifndef ECU_MODES_H
#define ECU_MODES_H

#include <stdbool.h>
#include <stdint.h>

/* The valves are driven in RUN, COMMISSION, HOLD and SAFE_STOP; else set-points are zero and disabled. */
enum ecu_mode {
    MODE_INIT = 0,       /* waits for all sensors, and for NMT start */
    MODE_STANDBY = 1,    /* sensors good, valves shut */
    MODE_RUN = 2,        /* the law drives the valves, moves are taken */
    MODE_TARE = 3,       /* averages the pressure sensors with the pump off, then STANDBY */
    MODE_COMMISSION = 4, /* as RUN, without load: the arm's own parameters are identified */
    MODE_HOLD = 5,       /* the law brakes a move and holds the arm; no moves are taken */
    MODE_SAFE_STOP = 6,  /* set-points ramp down on the model, then STANDBY or FAULT */
    MODE_FAULT = 15      /* valves off until RESET_FAULT */
};

enum ecu_event {
    /* requests of a master */
    EVENT_STANDBY,
    EVENT_RUN,
    EVENT_TARE,
    EVENT_COMMISSION,
    EVENT_HOLD,
    EVENT_SAFE_STOP,
    EVENT_RESET_FAULT,
    /* of the ECU itself */
    EVENT_SENSORS_READY, /* a whole set of good samples, the network is operational */
    EVENT_SENSORS_GONE,
    EVENT_TARE_DONE,
    EVENT_STOPPED,    /* the ramp of SAFE_STOP is over */
    EVENT_FAULT_STOP, /* a fault whose reaction is a safe stop */
    EVENT_FAULT_OFF,  /* a fault whose reaction is valves off */
    EVENT_NMT_LEFT,   /* no longer operational: no process frames may be sent */
    EVENTS
};

/* Why a request was not carried out; LastRefusal on the timing frame. */
enum ecu_refusal {
    REFUSAL_NONE,
    REFUSAL_NOT_OPERATIONAL,
    REFUSAL_NOT_IN_STANDBY,
    REFUSAL_NOT_IN_RUN,
    REFUSAL_SENSORS_NOT_FRESH,
    REFUSAL_MOVE_UNDER_WAY,
    REFUSAL_TARGET_OUT_OF_RANGE,
    REFUSAL_DURATION_TOO_SHORT,
    REFUSAL_NO_FAULT_TO_RESET,
    REFUSAL_UNKNOWN_REQUEST,
    REFUSAL_NOT_DEPRESSURISED,
    REFUSAL_STOPPING,
    REFUSAL_CAUSE_PERSISTS
};

/* What the table's conditions ask for. */
struct mode_conditions {
    bool operational;  /* NMT */
    bool sensors_good; /* this tick's samples are whole and good */
    bool fault_active; /* one whose reaction is not to degrade */
    bool cause_gone;   /* of every active fault that can be looked at */
};

/* The table's answer. With REFUSAL_NONE `*next` is the mode to be in, which may be the present one; else it is the
 * present one. Internal events that mean nothing in a mode are no refusal. */
enum ecu_refusal modes_next(enum ecu_mode mode, enum ecu_event event,
                            const struct mode_conditions *conditions, enum ecu_mode *next);

/* The law or the ramp of a safe stop drives the valves. */
bool mode_drives(enum ecu_mode mode);

/* CiA 408 device state: the low four bits of control and status word (R H M D of the maker's order are bits 3..0):
 * INIT 0, DISABLED 1, HOLD 3, ACTIVE 7; bit 3 is set without a fault. */
uint8_t mode_cia408_status(enum ecu_mode mode);

#endif
