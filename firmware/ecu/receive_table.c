#include "ecu/receive_table.h"

#include "can_protocol/generated/diarc.h"
#include "ecu/e2e.h"
#include "ecu/little_endian.h"

#define CYCLIC_ROWS (1u << RX_ENCODERS | 1u << RX_PRESSURES_SWING | 1u << RX_PRESSURES_WRIST)

const struct receive_row receive_table[RX_FRAMES] = {
    [RX_ENCODERS] = {DIARC_ENCODERS_FRAME_ID, DIARC_ENCODERS_LENGTH, true},
    [RX_PRESSURES_SWING] = {DIARC_PRESSURES_SWING_FRAME_ID, DIARC_PRESSURES_SWING_LENGTH, true},
    [RX_PRESSURES_WRIST] = {DIARC_PRESSURES_WRIST_FRAME_ID, DIARC_PRESSURES_WRIST_LENGTH, true},
    [RX_MOTION] = {DIARC_MOTION_FRAME_ID, DIARC_MOTION_LENGTH, false},
};

static bool counter_follows(const struct receive *receive, enum received_frame which, uint8_t counter)
{
    const struct receive_state *const state = &receive->row[which];
    if (receive_table[which].cyclic) {
        return counter == receive->expected && !state->fresh;
    }
    return !state->heard || counter != state->counter;
}

enum receive_result receive_accept(struct receive *receive, const struct can_frame_11bit *frame,
                                   enum received_frame *which)
{
    uint8_t k = 0;
    while (k < RX_FRAMES && receive_table[k].id != frame->id) {
        k++;
    }
    if (k == RX_FRAMES) {
        return RECEIVE_ALIEN;
    }
    *which = (enum received_frame)k;
    const struct receive_row *const row = &receive_table[k];
    struct receive_state *const state = &receive->row[k];
    enum receive_result result = RECEIVE_GOOD;
    if (frame->length != row->length) {
        result = RECEIVE_LENGTH;
    } else if (!e2e_intact(row->id, frame->data)) {
        result = RECEIVE_CRC;
    } else if (!counter_follows(receive, *which, e2e_counter(frame->data))) {
        result = RECEIVE_COUNTER;
    }
    if (result != RECEIVE_GOOD) {
        state->spoiled = true;
        if (receive->refused < UINT8_MAX) {
            receive->refused++;
        }
        return result;
    }
    state->heard = true;
    state->fresh = true;
    receive->came |= (uint8_t)(1u << k);
    state->counter = e2e_counter(frame->data);
    copy_data(state->data, frame->data);
    return RECEIVE_GOOD;
}

void receive_begin_tick(struct receive *receive, uint8_t sync_counter)
{
    receive->expected = (uint8_t)((sync_counter - 1u) % E2E_COUNTER_STATES);
    receive->came = 0;
    for (uint8_t k = 0; k < RX_FRAMES; k++) {
        receive->row[k].fresh = false;
        receive->row[k].spoiled = false;
    }
}

bool receive_complete(const struct receive *receive)
{
    return (receive->came & CYCLIC_ROWS) == CYCLIC_ROWS;
}

void receive_end_tick(struct receive *receive)
{
    if (receive_complete(receive)) {
        return;
    }
    for (uint8_t k = 0; k < RX_FRAMES; k++) {
        const struct receive_state *const state = &receive->row[k];
        if (receive_table[k].cyclic && state->heard && !state->fresh && receive->lost < UINT16_MAX) {
            receive->lost++;
        }
    }
}
