#include "ecu/transmit.h"

#include "can_protocol/generated/diarc.h"
#include "can_protocol/generated/diarc_hash.h"
#include "ecu/e2e.h"
#include "ecu/little_endian.h"
#include "ecu/wire.h"

#define VALVE_DISABLED DIARC_VALVES_SWING_CONTROL_DISABLED_CHOICE
#define VALVE_ACTIVE DIARC_VALVES_SWING_CONTROL_ACTIVE_CHOICE

#define THETA_FRAMES (THETA_M + THETA_H)
#define TIMING_PAGES 5
#define PAGE_TICK_TIMES 4

/* Protect a packed frame, advance its counter, and keep the data for who asks by SDO. */
static void protect(struct ecu *ecu, enum sent_frame which, struct can_frame_11bit *frame)
{
    uint8_t *const counter = &ecu->tx_counter[which];
    e2e_protect((uint16_t)frame->id, *counter, frame->data);
    *counter = *counter < E2E_COUNTER_STATES - 1u ? (uint8_t)(*counter + 1u) : 0u;
    copy_data(ecu->sent[which], frame->data);
}

struct can_frame_11bit transmit_sync(uint8_t sync_counter)
{
    return (struct can_frame_11bit){
        .id = DIARC_SYNC_FRAME_ID, .length = DIARC_SYNC_LENGTH, .data = {sync_counter}};
}

struct can_frame_11bit transmit_heartbeat(uint8_t nmt_state)
{
    return (struct can_frame_11bit){
        .id = DIARC_HEARTBEAT_ECU_FRAME_ID, .length = DIARC_HEARTBEAT_ECU_LENGTH, .data = {nmt_state}};
}

struct can_frame_11bit transmit_emergency(const struct ecu *ecu, enum ecu_fault fault)
{
    const struct diarc_emcy_ecu_t message = {
        .error_code = fault_table[fault].emergency,
        .error_register = fault_error_register(ecu),
        .fault_code = (uint8_t)fault,
        .fault_detail = ecu->active_faults,
    };
    struct can_frame_11bit frame = {.id = DIARC_EMCY_ECU_FRAME_ID, .length = DIARC_EMCY_ECU_LENGTH};
    (void)diarc_emcy_ecu_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

bool transmit_send(struct ecu *ecu, const struct ecu_port *port, struct can_frame_11bit frame)
{
    if (port->send(port->context, &frame) == PORT_OK) {
        return true;
    }
    if (ecu->counters.send_drops < UINT16_MAX) {
        ecu->counters.send_drops++;
    }
    return false;
}

static int16_t spool_raw(scalar u)
{
    return (int16_t)WIRE_ENCODE(u, DIARC_VALVES_SWING_SPOOL, 0, -WIRE_MAX_SPOOL, WIRE_MAX_SPOOL);
}

struct can_frame_11bit transmit_valves(struct ecu *ecu)
{
    const bool active = mode_drives(ecu->mode);
    const struct joint_output *const out = ecu->controller.output;
    const struct diarc_valves_t message = {
        .mode = (uint8_t)ecu->mode,
        .swing_spool = active ? spool_raw(out[SWING].u) : (int16_t)0,
        .wrist_spool = active ? spool_raw(out[WRIST].u) : (int16_t)0,
        .swing_control = active ? VALVE_ACTIVE : VALVE_DISABLED,
        .wrist_control = active ? VALVE_ACTIVE : VALVE_DISABLED,
        .sync_counter = ecu->sync_counter,
    };
    struct can_frame_11bit frame = {.id = DIARC_VALVES_FRAME_ID, .length = DIARC_VALVES_LENGTH};
    (void)diarc_valves_pack(frame.data, &message, sizeof frame.data);
    protect(ecu, TX_VALVES, &frame);
    return frame;
}

struct can_frame_11bit transmit_estimate(struct ecu *ecu)
{
    const struct controller *const controller = &ecu->controller;
    const struct estimator *const estimator = &controller->estimator;
    const struct prior *const load = &ecu->machine.estimator.m[M_T];
    const int8_t base = base_torque(&ecu->bases);
    const scalar m_t = estimator->theta_m[M_T];
    const scalar sd = estimator_sd_m(estimator, &ecu->constants.estimator, M_T);
    const struct joint_output *const out = controller->output;
    const struct diarc_estimate_t message = {
        .mode = (uint8_t)ecu->mode,
        .load = WIRE_ENCODE(m_t, DIARC_ESTIMATE_LOAD, base, -WIRE_MAX_S24, WIRE_MAX_S24),
        .load_sd = (uint16_t)WIRE_ENCODE(sd, DIARC_ESTIMATE_LOAD_SD, base, 0, WIRE_MAX_U16),
        .updating = estimator->updating,
        .load_used = controller->armed && controller->kind == CONTROLLER_DIARC,
        .load_at_bound = !parameter_set_coming(ecu) && (m_t <= load->low || m_t >= load->high),
        .valve_saturated = out[SWING].saturated || out[WRIST].saturated,
        .moving = controller->armed && (trajectory_moving(&controller->trajectory[SWING]) ||
                                        trajectory_moving(&controller->trajectory[WRIST])),
        .estimate_held = estimator->held,
    };
    struct can_frame_11bit frame = {.id = DIARC_ESTIMATE_FRAME_ID, .length = DIARC_ESTIMATE_LENGTH};
    (void)diarc_estimate_pack(frame.data, &message, sizeof frame.data);
    protect(ecu, TX_ESTIMATE, &frame);
    return frame;
}

struct can_frame_11bit transmit_tracking(struct ecu *ecu)
{
    const uint8_t joint = ecu->next_joint;
    ecu->next_joint = (uint8_t)((joint + 1u) % JOINTS);
    const struct joint_output *const out = &ecu->controller.output[joint];
    const int32_t error = WIRE_ENCODE(out->e1, DIARC_TRACKING_SWING_ERROR, 0, -WIRE_MAX_S20, WIRE_MAX_S20);
    const int32_t reference =
        WIRE_ENCODE(out->reference.q, DIARC_TRACKING_SWING_REFERENCE, 0, -WIRE_MAX_S24, WIRE_MAX_S24);
    const struct diarc_tracking_t message = {
        .mode = (uint8_t)ecu->mode,
        .tracking_joint = joint,
        .swing_error = error,
        .wrist_error = error,
        .swing_reference = reference,
        .wrist_reference = reference,
    };
    struct can_frame_11bit frame = {.id = DIARC_TRACKING_FRAME_ID, .length = DIARC_TRACKING_LENGTH};
    (void)diarc_tracking_pack(frame.data, &message, sizeof frame.data);
    protect(ecu, TX_TRACKING, &frame);
    return frame;
}

enum theta_base { BASE_TORQUE, BASE_COMPLIANCE, BASE_VOLUME };

struct theta_scale {
    scalar per_step, sd_per_step; /* mantissas */
    int8_t exponent, sd_exponent;
    uint8_t base; /* enum theta_base */
};

#define THETA_SCALE(SIGNAL, base)                                     \
    {                                                                 \
        SCALAR(DIARC_PARAMETERS_THETA_##SIGNAL##_PER_STEP_MANTISSA),  \
            SCALAR(DIARC_PARAMETERS_SD_##SIGNAL##_PER_STEP_MANTISSA), \
            DIARC_PARAMETERS_THETA_##SIGNAL##_PER_STEP_EXPONENT,      \
            DIARC_PARAMETERS_SD_##SIGNAL##_PER_STEP_EXPONENT, (base)  \
    }

static const struct theta_scale THETA_SCALES[THETA_FRAMES] = {
    [M_T] = THETA_SCALE(M_T, BASE_TORQUE),
    [J] = THETA_SCALE(J, BASE_TORQUE),
    [M2] = THETA_SCALE(M2, BASE_TORQUE),
    [FV1] = THETA_SCALE(FV1, BASE_TORQUE),
    [FV2] = THETA_SCALE(FV2, BASE_TORQUE),
    [FC1] = THETA_SCALE(FC1, BASE_TORQUE),
    [FC2] = THETA_SCALE(FC2, BASE_TORQUE),
    [OM1] = THETA_SCALE(OM1_SWING, BASE_TORQUE),
    [OM2] = THETA_SCALE(OM1_WRIST, BASE_TORQUE),
    [THETA_M + BETA_INVERSE] = THETA_SCALE(BETA_INVERSE, BASE_COMPLIANCE),
    [THETA_M + OM2_SWING] = THETA_SCALE(OM2_SWING, BASE_VOLUME),
    [THETA_M + OM3_SWING] = THETA_SCALE(OM3_SWING, BASE_VOLUME),
    [THETA_M + OM2_WRIST] = THETA_SCALE(OM2_WRIST, BASE_VOLUME),
    [THETA_M + OM3_WRIST] = THETA_SCALE(OM3_WRIST, BASE_VOLUME),
};

static int8_t theta_base(const struct bases *bases, enum theta_base base)
{
    switch (base) {
    case BASE_COMPLIANCE:
        return (int8_t)(-bases->pressure);
    case BASE_VOLUME:
        return base_volume(bases);
    case BASE_TORQUE:
    default:
        return base_torque(bases);
    }
}

struct can_frame_11bit transmit_parameter(struct ecu *ecu)
{
    const uint8_t k = ecu->next_parameter;
    ecu->next_parameter = (uint8_t)((k + 1u) % THETA_FRAMES);
    const struct estimator *const estimator = &ecu->controller.estimator;
    const struct estimator_constants *const constants = &ecu->constants.estimator;
    const bool mechanics = k < THETA_M;
    const uint8_t h = (uint8_t)(k - THETA_M);
    const scalar value = mechanics ? estimator->theta_m[k] : estimator->theta_h[h];
    const scalar value_sd = mechanics ? estimator_sd_m(estimator, constants, (enum theta_m)k)
                                      : estimator_sd_h(estimator, constants, (enum theta_h)h);
    const struct theta_scale *const scale = &THETA_SCALES[k];
    const int8_t base = theta_base(&ecu->bases, (enum theta_base)scale->base);
    const int32_t theta =
        wire_encode(value, scale->per_step, scale->exponent, base, -WIRE_MAX_S24, WIRE_MAX_S24);
    const uint16_t sd =
        (uint16_t)wire_encode(value_sd, scale->sd_per_step, scale->sd_exponent, base, 0, WIRE_MAX_U16);
    /* one pair of these signals is in the frame: that of `parameter` */
    const struct diarc_parameters_t message = {
        .mode = (uint8_t)ecu->mode,
        .parameter = k,
        .theta_m_t = theta,
        .sd_m_t = sd,
        .theta_j = theta,
        .sd_j = sd,
        .theta_m2 = theta,
        .sd_m2 = sd,
        .theta_fv1 = theta,
        .sd_fv1 = sd,
        .theta_fv2 = theta,
        .sd_fv2 = sd,
        .theta_fc1 = theta,
        .sd_fc1 = sd,
        .theta_fc2 = theta,
        .sd_fc2 = sd,
        .theta_om1_swing = theta,
        .sd_om1_swing = sd,
        .theta_om1_wrist = theta,
        .sd_om1_wrist = sd,
        .theta_beta_inverse = theta,
        .sd_beta_inverse = sd,
        .theta_om2_swing = theta,
        .sd_om2_swing = sd,
        .theta_om3_swing = theta,
        .sd_om3_swing = sd,
        .theta_om2_wrist = theta,
        .sd_om2_wrist = sd,
        .theta_om3_wrist = theta,
        .sd_om3_wrist = sd,
    };
    struct can_frame_11bit frame = {.id = DIARC_PARAMETERS_FRAME_ID, .length = DIARC_PARAMETERS_LENGTH};
    (void)diarc_parameters_pack(frame.data, &message, sizeof frame.data);
    protect(ecu, TX_PARAMETERS, &frame);
    return frame;
}

struct can_frame_11bit transmit_timing(struct ecu *ecu)
{
    const uint8_t page = ecu->next_page;
    ecu->next_page = (uint8_t)((page + 1u) % TIMING_PAGES);
    const struct ecu_counters *const counters = &ecu->counters;
    const uint8_t bucket = ecu->next_bucket;
    if (page == PAGE_TICK_TIMES) {
        ecu->next_bucket = (uint8_t)((bucket + 1u) % TIME_BUCKETS);
    }
    const struct diarc_timing_t message = {
        .mode = (uint8_t)ecu->mode,
        .timing_page = page,
        .tick_time = counters->tick_time_us,
        .late_ticks = counters->late_ticks,
        .fault_code = (uint8_t)ecu->fault,
        .dbc_hash = DIARC_DBC_HASH,
        .lost_frames = ecu->receive.lost,
        .e2e_errors = ecu->receive.refused,
        .send_drops = counters->send_drops,
        .refused_requests = counters->refused,
        .last_refusal = (uint8_t)counters->last_refusal,
        .period_us = (uint16_t)ecu->period_us,
        .tick_time_bucket = bucket,
        .tick_time_count = counters->tick_times.count[bucket],
    };
    struct can_frame_11bit frame = {.id = DIARC_TIMING_FRAME_ID, .length = DIARC_TIMING_LENGTH};
    (void)diarc_timing_pack(frame.data, &message, sizeof frame.data);
    protect(ecu, TX_TIMING, &frame);
    return frame;
}
