/* What the ECU listens to: one const table, and the state of each row, aged once a tick. */
#ifndef ECU_RECEIVE_TABLE_H
#define ECU_RECEIVE_TABLE_H

#include "ecu/port.h"

enum received_frame { RX_ENCODERS, RX_PRESSURES_SWING, RX_PRESSURES_WRIST, RX_MOTION, RX_FRAMES };

struct receive_row {
    uint16_t id;
    uint8_t length;
    bool cyclic; /* an answer to SYNC: one per tick must come, and its counter says which SYNC it answers */
};
extern const struct receive_row receive_table[RX_FRAMES];

enum receive_result {
    RECEIVE_GOOD,
    RECEIVE_ALIEN, /* not in the table: not for us, no error */
    RECEIVE_LENGTH,
    RECEIVE_CRC,
    RECEIVE_COUNTER /* repeated, or an answer to another SYNC */
};

struct receive_state {
    bool heard;      /* at least once since the restart */
    bool fresh;      /* a good frame came in this tick */
    bool spoiled;    /* one that was refused did */
    uint8_t counter; /* of the last good frame */
    uint8_t data[8]; /* of the last good frame */
};

struct receive {
    struct receive_state row[RX_FRAMES];
    uint8_t came;     /* one bit for each row that is fresh */
    uint8_t expected; /* counter of the frames that answer this tick's SYNC */
    uint16_t lost;    /* cyclic frames that did not come or were refused; stops at 65535 */
    uint8_t refused;  /* by length, CRC or counter; stops at 255 */
};

/* Take a frame; *which is its row with every result but RECEIVE_ALIEN. */
enum receive_result receive_accept(struct receive *receive, const struct can_frame_11bit *frame,
                                   enum received_frame *which);

/* The tick of this SYNC counter (1..240) begins: nothing is fresh yet. A sensor frame that answers it has the
 * E2E counter (sync_counter - 1) mod 15, so that an answer that comes late is not taken for one in time. */
void receive_begin_tick(struct receive *receive, uint8_t sync_counter);

/* True when every cyclic frame is fresh. */
bool receive_complete(const struct receive *receive);

/* The tick is over: count the cyclic frames that are missing. Before the first has been heard none is. */
void receive_end_tick(struct receive *receive);

#endif
