/* The frames the ECU sends, packed from its state. Each function returns a frame ready for the bus. */
#ifndef ECU_TRANSMIT_H
#define ECU_TRANSMIT_H

#include "ecu/ecu.h"

struct can_frame_11bit transmit_sync(uint8_t sync_counter);
struct can_frame_11bit transmit_heartbeat(uint8_t nmt_state);
/* FAULT_NONE: the last fault is gone. */
struct can_frame_11bit transmit_emergency(const struct ecu *ecu, enum ecu_fault fault);

/* Hand a frame to the port; what it does not take is counted. False then. */
bool transmit_send(struct ecu *ecu, const struct ecu_port *port, struct can_frame_11bit frame);

/* These carry E2E protection; each call advances the frame's counter. */
struct can_frame_11bit transmit_valves(struct ecu *ecu);
struct can_frame_11bit transmit_estimate(struct ecu *ecu);
struct can_frame_11bit transmit_tracking(struct ecu *ecu);  /* one joint in turn */
struct can_frame_11bit transmit_parameter(struct ecu *ecu); /* one of theta in turn */
struct can_frame_11bit transmit_timing(struct ecu *ecu);    /* one page in turn */

#endif
