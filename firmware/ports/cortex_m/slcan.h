/* The bus of this port: CAN frames as SLCAN text over the UART. The far end is whoever would hold a serial
 * CAN adapter, so the image answers what such an adapter answers:
 *
 *     O  open: the ECU starts     C  close: the ECU stops     S0..S8  bit rate: taken, without effect
 *     V  version                  N  serial number            an empty line: answered
 *
 * CR is yes, BEL is no. Frames are not acknowledged, and those other than data frames with 11 bit
 * identifiers are passed over. */
#ifndef PORTS_CORTEX_M_SLCAN_H
#define PORTS_CORTEX_M_SLCAN_H

#include "ecu/port.h"

/* The ECU's send and receive; the context is not used. */
enum port_status slcan_send(void *context, const struct can_frame_11bit *frame);
enum port_status slcan_receive(void *context, struct can_frame_11bit *frame);

/* Between O and C. Commands are carried out by slcan_receive. */
bool slcan_is_open(void);

/* How often the channel has been opened; wraps. */
uint32_t slcan_openings(void);

#endif
