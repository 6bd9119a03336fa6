/* What the ECU watches: the samples, the machine's limits, the bus. Each monitor raises one fault of
 * can_protocol/faults.toml; the limits are parameters. */
#ifndef ECU_SUPERVISION_H
#define ECU_SUPERVISION_H

#include "control/controller.h"
#include "ecu/faults.h"
#include "ecu/samples.h"

/* Monitors of a condition that must last: ticks it has lasted so far, stops at 65535. */
enum lasting {
    LASTING_LIMIT_SWING, /* outside the joint's range */
    LASTING_LIMIT_WRIST,
    LASTING_OVER_PRESSURE,
    LASTING_CAVITATION,
    LASTING_ERROR, /* of tracking */
    LASTING_SATURATED_SWING,
    LASTING_SATURATED_WRIST,
    LASTING_AT_BOUND,
    LASTING_SPOOL_SWING, /* far from its set-point */
    LASTING_SPOOL_WRIST,
    LASTING
};

/* Faults that leave by themselves. */
enum clearing { CLEARING_MISMATCH, CLEARING_CAVITATION, CLEARING_BOUND, CLEARING };

struct supervision {
    /* limits in ticks and counts, made once from the parameters */
    uint16_t stop_ticks, stuck_ticks, spool_ticks, persist_ticks, saturation_ticks, bound_ticks, second_ticks;
    uint8_t wrong_limit, mismatch_limit, late_limit, send_limit;

    uint8_t sensors_wrong;      /* ticks in a row that sensors were missing or wrong; stops at 255 */
    enum ecu_fault wrong_cause; /* of the last of them */
    uint16_t lasting[LASTING];
    scalar range[JOINTS][2];              /* low and high ends of the joints, rad */
    int32_t seen_angle[JOINTS];           /* the encoder's last raw value; never a predicted one */
    scalar stuck_travel[JOINTS];          /* of the reference since it changed, rad */
    uint16_t stuck_for[JOINTS][CHAMBERS]; /* ticks of motion since a pressure's raw value changed */
    scalar force[JOINTS];                 /* of the cylinder at the end of the window before */
    scalar contradiction[JOINTS];         /* rate by the encoder less that by the oil, low-passed; rad/s */
    uint16_t reopened;                    /* the estimator's count when the window began */
    uint16_t window;                      /* ticks of the window of late starts and reopened loads */
    uint16_t clear[CLEARING];             /* ticks until they leave */
    uint16_t late_starts;                 /* in the window */
    uint8_t send_failures;                /* valve frames in a row the bus did not take; stops at 255 */
    uint8_t duplicate_ticks;              /* until a frame of a second ECU is forgotten */
    uint32_t consumer_us;                 /* since the consumed heartbeat was heard; stops at 2^31 */
    bool consumer_heard;
};

/* Everything forgotten; the limits from the parameters. */
void supervision_start(struct ecu *ecu);

/* The law takes the valves at this measurement. */
void supervision_arm(struct ecu *ecu, const struct measurement *measured);

/* This tick's samples, as samples_take judged them: modes that follow, and the faults of sensors. */
void supervise_sensors(struct ecu *ecu, const struct ecu_port *port, enum ecu_fault wrong);

/* So many ticks in a row without good sensors that it is a fault. */
bool supervision_sensors_gone(const struct ecu *ecu);

/* After the law: the machine's limits. before: the samples of the tick before. */
void supervise_machine(struct ecu *ecu, const struct ecu_port *port, const struct sensor_samples *before,
                       const struct measurement *measured);

/* Once a tick, with or without samples: the bus. */
void supervise_bus(struct ecu *ecu, const struct ecu_port *port);

/* A frame came that is none of the receive table: a heartbeat, or one that only this ECU sends. */
void supervise_frame(struct ecu *ecu, const struct can_frame_11bit *frame);

/* Of every active fault that can still be looked at, the cause is gone. */
bool supervision_cause_gone(const struct ecu *ecu);

#endif
