/* The ECU: modes, frames and the law, one tick at a time. A port calls, every period:
 *
 *     ecu_tick_begin      SYNC goes out, the tick is open
 *     ecu_tick_receive    as often as frames may wait; true once all sensor frames of this tick have come
 *     ecu_tick_end        the law runs on what has come, the valve frame goes out, then the others
 *
 * Between ecu_tick_begin and ecu_tick_end nothing else happens, so the same frames give the same bits on
 * every bus. No clock but the port's, and that only for the timing frame. */
#ifndef ECU_ECU_H
#define ECU_ECU_H

#include "control/safe_stop.h"
#include "ecu/emergency.h"
#include "ecu/faults.h"
#include "ecu/modes.h"
#include "ecu/parameter_set.h"
#include "ecu/parameters.h"
#include "ecu/port.h"
#include "ecu/receive_table.h"
#include "ecu/requests.h"
#include "ecu/samples.h"
#include "ecu/sdo_server.h"
#include "ecu/store.h"
#include "ecu/supervision.h"
#include "ecu/tare.h"
#include "ecu/time_histogram.h"

#define ECU_NODE_ID 1u
#define ECU_PERIOD_LOW_US 250u
#define ECU_PERIOD_HIGH_US 20000u

enum nmt_state { NMT_STOPPED = 4, NMT_OPERATIONAL = 5, NMT_PRE_OPERATIONAL = 127 };

struct ecu_counters {
    uint32_t ticks;      /* since the restart */
    uint16_t late_ticks; /* ended without all sensor frames, or periods without a tick; stops at 65535 */
    uint16_t send_drops; /* frames the port did not take; stops at 65535 */
    uint16_t refused;    /* requests; stops at 65535 */
    enum ecu_refusal last_refusal;
    uint16_t tick_time_us;            /* last sensor frame to valve frame, of the last tick; stops at 65535 */
    struct time_histogram tick_times; /* of these */
};

/* Frames with E2E protection, by who counts them. */
enum sent_frame { TX_VALVES, TX_ESTIMATE, TX_TRACKING, TX_PARAMETERS, TX_TIMING, TX_FRAMES };

/* All of the ECU; a port owns one and looks into it only to report. */
struct ecu {
    struct parameter_image
        image; /* the set in force, from which all of machine, bases and constants follow */
    struct parameter_set_coming coming;
    struct machine machine; /* not there while a set is coming: parameter_set.h */
    struct bases bases;
    struct controller_constants constants;
    struct controller controller;
    uint32_t period_us;
    enum store_status stored; /* STORE_OK again once its fault is reset */
    enum ecu_mode mode;
    enum nmt_state nmt;
    enum ecu_fault fault;   /* the one to show: the first of the active ones */
    uint32_t active_faults; /* one bit per code */
    struct supervision supervision;
    struct receive receive;
    struct sensor_samples samples;
    struct tare tare;
    struct safe_stop stop;
    bool sampled;           /* samples hold a complete set */
    bool restart_requested; /* by NMT */
    bool reload_requested;  /* with the parameters of power-on */
    bool boot_up_due;
    bool valves_active; /* the last valve frame opened them */
    bool is_pending;    /* `pending` waits for this tick's samples */
    enum ecu_event pending;
    enum controller_kind requested_controller;
    uint16_t control_word;       /* CiA 408, as last written */
    uint32_t heartbeat_consumer; /* object 1016h: node << 16 | ms, 0: nobody */
    uint32_t master_hash;        /* of the master's DBC, object 2002h; 0: not told */
    uint8_t sync_counter;        /* 1..240 */
    uint8_t phase;               /* tick modulo the slow frames' cycle */
    uint8_t next_parameter, next_page, next_bucket, next_joint;
    uint16_t heartbeat_ms;      /* object 1017h; 0: none is sent */
    uint32_t heartbeat_ticks;   /* to the next heartbeat */
    uint16_t refused_parameter; /* object 200Eh */
    struct emergency_history emergencies;
    struct sdo_server sdo;
    uint8_t tx_counter[TX_FRAMES];
    uint8_t sent[TX_FRAMES][8]; /* data of the last frame of each */
    uint32_t complete_at_us;    /* when the last sensor frame of this tick came */
    struct ecu_counters counters;
};

/* Load the image (NULL: the reference arm, built in) and start. period_us: 250..20000. On an error *ecu is
 * not usable, and with ECU_PARAMETER_RANGE *entry is the parameter's number (parameter_name). */
enum ecu_status ecu_init(struct ecu *ecu, const struct parameter_image *image, uint32_t period_us,
                         uint16_t *entry);

/* The same from what is stored. `fallback` (NULL: the reference arm) is used when nothing is, and also when what is
 * stored is damaged or this firmware refuses it; the latter, or an older set than the last one saved, is fault
 * STORE_DAMAGED. `store` NULL: nothing survives. *buffer is overwritten. */
enum ecu_status ecu_init_stored(struct ecu *ecu, const struct store_port *store,
                                struct parameter_image *buffer, const struct parameter_image *fallback,
                                uint32_t period_us, uint16_t *entry);

void ecu_tick_begin(struct ecu *ecu, const struct ecu_port *port);
bool ecu_tick_receive(struct ecu *ecu, const struct ecu_port *port);
void ecu_tick_end(struct ecu *ecu, const struct ecu_port *port);

/* Runs the law once on a copy, for nothing: between ecu_tick_begin and the sensor frames, for a port whose caches
 * other programs use in the meantime. Neither reads frames nor sends any, and *ecu stays as it is. */
void ecu_rehearse(const struct ecu *ecu, struct controller *understudy);

/* For a port that is about to stop: SAFE_STOP where the valves are driven; go on ticking until ecu_valves_shut. */
void ecu_request_safe_stop(struct ecu *ecu);

/* The last valve frame was zero and disabled. */
bool ecu_valves_shut(const struct ecu *ecu);

/* The timer fired late: so many periods went by without a tick. They count as late ticks. */
void ecu_note_late_start(struct ecu *ecu, uint32_t missed_periods);

/* Valves to zero and disabled, once, now: for a port that cannot tick any more. */
void ecu_shutdown(struct ecu *ecu, const struct ecu_port *port);

#endif
