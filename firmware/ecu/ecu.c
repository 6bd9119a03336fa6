#include "ecu/ecu.h"

#include <stddef.h>

#include "can_protocol/generated/diarc.h"
#include "ecu/operation.h"
#include "ecu/transmit.h"

#define SYNC_COUNTER_LAST 240u /* CiA 301, 1019h */
#define SLOW_CYCLE_TICKS 10u   /* one slow frame in each of these phases, never two in a tick */
#define HEARTBEAT_MS 100u
#define US_PER_MS 1000u
#define US_PER_S 1000000u
#define NODE_ALL 0u
#define CONSUMER_DEFAULT 0x000201F4u /* the I/O node, 500 ms */

enum slow_phase {
    PHASE_ESTIMATE = 1,
    PHASE_TRACKING = 3,
    PHASE_PARAMETER = 5,
    PHASE_TIMING = 7,
    PHASE_TRACKING_2 = 8
};

static void count_u16(uint16_t *counter)
{
    if (*counter < UINT16_MAX) {
        (*counter)++;
    }
}

/* Back to the state of power-on; parameters stay, and valves_active: when the bus did not take the frame that shuts
 * them it is sent again. Field by field: a copy of the whole would need its size in stack. */
static void restart(struct ecu *ecu)
{
    ecu->mode = MODE_INIT;
    ecu->nmt = NMT_PRE_OPERATIONAL;
    ecu->fault = FAULT_NONE;
    ecu->active_faults = 0;
    ecu->receive = (struct receive){0};
    ecu->samples = (struct sensor_samples){0};
    ecu->tare = (struct tare){0};
    ecu->stop = (struct safe_stop){0};
    ecu->sampled = false;
    ecu->restart_requested = false;
    ecu->reload_requested = false;
    ecu->boot_up_due = true;
    ecu->is_pending = false;
    ecu->pending = EVENT_STANDBY;
    ecu->requested_controller = CONTROLLER_DIARC;
    ecu->control_word = 0;
    ecu->heartbeat_consumer = CONSUMER_DEFAULT;
    ecu->master_hash = 0;
    ecu->sync_counter = 0;
    ecu->phase = 0;
    ecu->next_parameter = 0;
    ecu->next_page = 0;
    ecu->next_bucket = 0;
    ecu->next_joint = 0;
    ecu->heartbeat_ms = HEARTBEAT_MS;
    /* not right behind boot-up: clients that wait for that look at the last one that came */
    ecu->heartbeat_ticks = HEARTBEAT_MS * US_PER_MS / ecu->period_us;
    ecu->refused_parameter = NO_PARAMETER;
    sdo_server_start(ecu);
    for (uint8_t k = 0; k < TX_FRAMES; k++) {
        ecu->tx_counter[k] = 0;
    }
    ecu->complete_at_us = 0;
    ecu->counters = (struct ecu_counters){0};
    supervision_start(ecu);
    controller_start(&ecu->controller, &ecu->machine, &ecu->constants);
}

enum ecu_status ecu_init(struct ecu *ecu, const struct parameter_image *image, uint32_t period_us,
                         uint16_t *entry)
{
    *ecu = (struct ecu){0};
    ecu->image = image != NULL ? *image : default_parameter_image;
    const enum ecu_status status = parameters_load(&ecu->machine, &ecu->bases, &ecu->image, entry);
    if (status != ECU_OK) {
        return status;
    }
    const scalar dt_s = quot(scalar_from_raw((int32_t)period_us, 16), scalar_from_raw((int32_t)US_PER_S, 16));
    if (period_us < ECU_PERIOD_LOW_US || period_us > ECU_PERIOD_HIGH_US ||
        amp(ecu->machine.observer_bandwidth, dt_s) >= SCALAR(1)) {
        return ECU_PERIOD_RANGE;
    }
    ecu->period_us = period_us;
    ecu->constants = controller_constants(&ecu->machine, dt_s);
    restart(ecu);
    return ECU_OK;
}

enum ecu_status ecu_init_stored(struct ecu *ecu, const struct store_port *store,
                                struct parameter_image *buffer, const struct parameter_image *fallback,
                                uint32_t period_us, uint16_t *entry)
{
    enum store_status stored = store != NULL ? store_load(store, buffer) : STORE_EMPTY;
    const bool found = stored == STORE_OK || stored == STORE_OLDER;
    enum ecu_status status = ECU_OK;
    if (found) {
        status = ecu_init(ecu, buffer, period_us, entry);
    }
    if (!found || status != ECU_OK) {
        stored = found ? STORE_FOREIGN : stored;
        status = ecu_init(ecu, fallback, period_us, entry);
    }
    ecu->stored = stored;
    return status;
}

static void send_valves(struct ecu *ecu, const struct ecu_port *port)
{
    if (transmit_send(ecu, port, transmit_valves(ecu))) {
        ecu->supervision.send_failures = 0;
        ecu->valves_active = mode_drives(ecu->mode);
    } else if (ecu->supervision.send_failures < UINT8_MAX) {
        ecu->supervision.send_failures++;
    } else {
        /* enough */
    }
}

/* One last frame that shuts the valves, when frames are about to stop with the valves open. */
static void shut_valves(struct ecu *ecu, const struct ecu_port *port)
{
    if (ecu->valves_active) {
        (void)operation_event(ecu, EVENT_NMT_LEFT);
        send_valves(ecu, port);
    }
}

/* The parameters of power-on: those stored, else those to fall back on. Without a store those in force stay. */
static void reload(struct ecu *ecu, const struct ecu_port *port)
{
    uint16_t entry = 0;
    if (port->store == NULL) {
        return;
    }
    ecu->stored = store_load(port->store, &ecu->image);
    const bool found = ecu->stored == STORE_OK || ecu->stored == STORE_OLDER;
    if (!found || parameters_check(&ecu->image, &entry) != ECU_OK ||
        !parameters_suit_period(&ecu->image, ecu->constants.dt_s)) {
        ecu->stored = found ? STORE_FOREIGN : ecu->stored;
        const struct parameter_image *const fallback =
            port->fallback != NULL ? port->fallback : &default_parameter_image;
        ecu->image = *fallback;
    }
    (void)parameters_load(&ecu->machine, &ecu->bases, &ecu->image, &entry);
    ecu->constants = controller_constants(&ecu->machine, ecu->constants.dt_s);
}

void ecu_tick_begin(struct ecu *ecu, const struct ecu_port *port)
{
    if (ecu->restart_requested) {
        shut_valves(ecu, port);
        if (ecu->reload_requested) {
            reload(ecu, port);
        }
        restart(ecu);
    }
    if (ecu->boot_up_due) {
        (void)transmit_send(ecu, port, transmit_heartbeat(0));
        ecu->boot_up_due = false;
        if (ecu->stored != STORE_OK && ecu->stored != STORE_EMPTY) {
            fault_raise(ecu, port, FAULT_STORE_DAMAGED);
        }
    }
    ecu->sync_counter = (uint8_t)(ecu->sync_counter % SYNC_COUNTER_LAST + 1u);
    receive_begin_tick(&ecu->receive, ecu->sync_counter);
    (void)transmit_send(ecu, port, transmit_sync(ecu->sync_counter));
}

static void nmt_command(struct ecu *ecu, const struct ecu_port *port, const struct can_frame_11bit *frame)
{
    if (frame->length != DIARC_NMT_LENGTH || (frame->data[1] != NODE_ALL && frame->data[1] != ECU_NODE_ID)) {
        return;
    }
    switch (frame->data[0]) {
    case DIARC_NMT_COMMAND_START_CHOICE:
        ecu->nmt = NMT_OPERATIONAL;
        break;
    case DIARC_NMT_COMMAND_STOP_CHOICE:
    case DIARC_NMT_COMMAND_ENTER_PREOPERATIONAL_CHOICE:
        ecu->nmt = frame->data[0] == DIARC_NMT_COMMAND_STOP_CHOICE ? NMT_STOPPED : NMT_PRE_OPERATIONAL;
        (void)request_event(ecu, port, EVENT_NMT_LEFT);
        break;
    case DIARC_NMT_COMMAND_RESET_NODE_CHOICE:
    case DIARC_NMT_COMMAND_RESET_COMMUNICATION_CHOICE:
        ecu->restart_requested = true;
        ecu->reload_requested =
            ecu->reload_requested || frame->data[0] == DIARC_NMT_COMMAND_RESET_NODE_CHOICE;
        break;
    default:
        break;
    }
}

static void receive_frame(struct ecu *ecu, const struct ecu_port *port, const struct can_frame_11bit *frame)
{
    if (frame->id == DIARC_NMT_FRAME_ID) {
        nmt_command(ecu, port, frame);
        return;
    }
    if (frame->id == SDO_REQUEST_ID) {
        sdo_server_receive(ecu, frame);
        return;
    }
    enum received_frame which = RX_FRAMES;
    const enum receive_result result = receive_accept(&ecu->receive, frame, &which);
    if (result == RECEIVE_ALIEN) {
        supervise_frame(ecu, frame);
    } else if (result == RECEIVE_GOOD && which == RX_MOTION) {
        request_motion(ecu, port);
    } else {
        /* a sensor's: taken at the tick's end */
    }
}

bool ecu_tick_receive(struct ecu *ecu, const struct ecu_port *port)
{
    struct can_frame_11bit frame;
    const bool was_complete = receive_complete(&ecu->receive);
    /* At most this many a call: a bus full of strange frames must not hold up the tick. */
    for (uint8_t n = 0; n < UINT8_MAX && port->receive(port->context, &frame) == PORT_OK; n++) {
        receive_frame(ecu, port, &frame);
    }
    if (!ecu->valves_active) {
        sdo_server_send(ecu, port); /* no valve waits for this tick */
    }
    const bool complete = receive_complete(&ecu->receive);
    if (complete && !was_complete) {
        ecu->complete_at_us = port->now_us(port->context);
    }
    return complete;
}

/* One sample of the tare; with the last one its offsets, or a refusal. */
static void tare_sample(struct ecu *ecu)
{
    const enum tare_result result = tare_step(&ecu->tare, &ecu->samples, &ecu->machine, &ecu->bases);
    if (result != TARE_GOES_ON) {
        (void)operation_event(ecu, EVENT_TARE_DONE);
    }
    if (result == TARE_REFUSED) {
        request_refused(ecu, REFUSAL_NOT_DEPRESSURISED);
    }
}

static void send_heartbeat(struct ecu *ecu, const struct ecu_port *port)
{
    const uint32_t cycle = ecu->heartbeat_ms * US_PER_MS / ecu->period_us;
    if (ecu->heartbeat_ms == 0u) {
        ecu->heartbeat_ticks = 0;
        return;
    }
    const bool shortened = ecu->heartbeat_ticks > cycle;
    if (ecu->heartbeat_ticks == 0u || shortened) {
        (void)transmit_send(ecu, port, transmit_heartbeat((uint8_t)ecu->nmt));
        ecu->heartbeat_ticks = cycle > 0u ? cycle : 1u;
    }
    ecu->heartbeat_ticks--;
}

static void send_slow_frames(struct ecu *ecu, const struct ecu_port *port)
{
    switch (ecu->phase) {
    case PHASE_ESTIMATE:
        (void)transmit_send(ecu, port, transmit_estimate(ecu));
        break;
    case PHASE_TRACKING:
    case PHASE_TRACKING_2:
        (void)transmit_send(ecu, port, transmit_tracking(ecu));
        break;
    case PHASE_PARAMETER:
        (void)transmit_send(ecu, port, transmit_parameter(ecu));
        break;
    case PHASE_TIMING:
        (void)transmit_send(ecu, port, transmit_timing(ecu));
        break;
    default:
        break;
    }
}

/* Samples, supervision, law. */
static void work(struct ecu *ecu, const struct ecu_port *port)
{
    if (parameter_set_coming(ecu)) { /* no machine to judge samples by; the valves are shut */
        controller_gap(&ecu->controller);
        supervise_bus(ecu, port);
        return;
    }
    const struct sensor_samples before = ecu->samples;
    const enum ecu_fault wrong = samples_take(ecu);
    const bool good = wrong == FAULT_NONE;
    if (!good && !ecu->sampled) {
        supervise_bus(ecu, port);
        return;
    }
    if (!good && !ecu->controller.armed) {
        controller_gap(&ecu->controller);
    }
    const struct measurement measured = samples_measured(ecu, ecu->sampled ? &before : &ecu->samples);
    ecu->sampled = true;
    supervise_sensors(ecu, port, wrong);
    if (good && ecu->mode == MODE_TARE) {
        tare_sample(ecu);
    }
    request_pending(ecu);
    controller_step(&ecu->controller, &ecu->machine, &ecu->constants, &measured);
    supervise_machine(ecu, port, &before, &measured);
    supervise_bus(ecu, port);
    operation_step(ecu);
}

void ecu_tick_end(struct ecu *ecu, const struct ecu_port *port)
{
    if (!receive_complete(&ecu->receive)) {
        count_u16(&ecu->counters.late_ticks);
        ecu->complete_at_us = port->now_us(port->context);
    }
    receive_end_tick(&ecu->receive);
    work(ecu, port);

    if (ecu->nmt == NMT_OPERATIONAL) {
        send_valves(ecu, port);
        const uint32_t tick_time_us = port->now_us(port->context) - ecu->complete_at_us;
        ecu->counters.tick_time_us = tick_time_us < UINT16_MAX ? (uint16_t)tick_time_us : UINT16_MAX;
        time_histogram_add(&ecu->counters.tick_times, tick_time_us);
        send_slow_frames(ecu, port);
    } else {
        shut_valves(ecu, port);
    }
    send_heartbeat(ecu, port);
    sdo_server_send(ecu, port);
    sdo_server_tick(ecu);
    ecu->phase = (uint8_t)((ecu->phase + 1u) % SLOW_CYCLE_TICKS);
    ecu->counters.ticks++;
}

void ecu_request_safe_stop(struct ecu *ecu)
{
    ecu->is_pending = false;
    (void)operation_event(ecu, EVENT_SAFE_STOP);
}

bool ecu_valves_shut(const struct ecu *ecu)
{
    return !ecu->valves_active && !mode_drives(ecu->mode);
}

/* The sum, or the highest count there is. */
static uint16_t add_limited_u16(uint16_t count, uint32_t more)
{
    return more < (uint32_t)UINT16_MAX - count ? (uint16_t)(count + more) : UINT16_MAX;
}

void ecu_note_late_start(struct ecu *ecu, uint32_t missed_periods)
{
    ecu->counters.late_ticks = add_limited_u16(ecu->counters.late_ticks, missed_periods);
    ecu->supervision.late_starts = add_limited_u16(ecu->supervision.late_starts, missed_periods);
}

void ecu_shutdown(struct ecu *ecu, const struct ecu_port *port)
{
    (void)operation_event(ecu, EVENT_NMT_LEFT);
    send_valves(ecu, port);
}

void ecu_rehearse(const struct ecu *ecu, struct controller *understudy)
{
    if (!ecu->sampled) {
        return;
    }
    *understudy = ecu->controller;
    struct measurement measured = samples_measured(ecu, &ecu->samples);
    for (uint8_t i = 0; i < JOINTS; i++) {
        /* the samples are their own predecessors: at rest, to the estimator, but for this */
        measured.dq[i] = mul(ecu->controller.output[i].reference.w, ecu->constants.dt_s);
    }
    controller_step(understudy, &ecu->machine, &ecu->constants, &measured);
}
