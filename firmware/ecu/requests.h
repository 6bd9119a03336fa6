/* What a master asks for: the motion frame and the control word, turned into events and moves. */
#ifndef ECU_REQUESTS_H
#define ECU_REQUESTS_H

#include <stdint.h>

#include "ecu/modes.h"

struct ecu;
struct ecu_port;

/* The motion frame of this tick. A refusal is counted and kept for the timing frame. */
void request_motion(struct ecu *ecu, const struct ecu_port *port);

/* CiA 408 control word, object 6040h: bits 0..2 D, H, M name the device state wanted (1 DISABLED, 3 HOLD, 7 ACTIVE),
 * a rising bit 3 R resets a fault. Goes to RUN with the controller of the last request. */
enum ecu_refusal request_control_word(struct ecu *ecu, const struct ecu_port *port, uint16_t word);

/* Safe stop, or FAULT reset and the like, from the ECU's own port. */
enum ecu_refusal request_event(struct ecu *ecu, const struct ecu_port *port, enum ecu_event event);

/* At the tick's end, when its samples are there: what waited for them. */
void request_pending(struct ecu *ecu);

/* Count a refusal; nothing with REFUSAL_NONE. */
void request_refused(struct ecu *ecu, enum ecu_refusal reason);

#endif
