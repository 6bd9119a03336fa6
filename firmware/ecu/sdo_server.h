/* SDO server of CiA 301 on channel 1: requests on 601h, answers on 581h; expedited and segmented both ways.
 *
 * Frames are taken in when they come and worked on by sdo_server_send, so that the port's owner chooses the moment:
 * while the valves are driven after the valve frame, at most one a tick. */
#ifndef ECU_SDO_SERVER_H
#define ECU_SDO_SERVER_H

#include <stdbool.h>
#include <stdint.h>

#include "ecu/port.h"

#define SDO_REQUEST_ID 0x601u
#define SDO_ANSWER_ID 0x581u

struct ecu;

enum sdo_mail { SDO_MAIL_NONE, SDO_MAIL_REQUEST, SDO_MAIL_ANSWER };
enum sdo_transfer { SDO_IDLE, SDO_UPLOAD, SDO_DOWNLOAD };

struct sdo_server {
    enum sdo_mail mail; /* what frame holds: a request to work on, or an answer to send */
    uint8_t frame[8];
    enum sdo_transfer transfer; /* in segments */
    uint16_t index;
    uint8_t sub;
    bool toggle;     /* of the segment that comes next */
    uint32_t count;  /* bytes that have gone or come */
    uint32_t number; /* download of a number: what has come of it */
    uint16_t ticks_left;
};

/* Power-on and reset: no transfer; one that was under way is dropped. */
void sdo_server_start(struct ecu *ecu);

/* Take a request. A client waits for each answer, so the newest frame is the one that counts. */
void sdo_server_receive(struct ecu *ecu, const struct can_frame_11bit *frame);

/* Work on the request, if one waits, and send the answer; one that the port does not take is sent the next time. */
void sdo_server_send(struct ecu *ecu, const struct ecu_port *port);

/* Once a tick: give a transfer up when its client has gone. */
void sdo_server_tick(struct ecu *ecu);

#endif
