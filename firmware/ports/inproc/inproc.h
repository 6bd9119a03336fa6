/* The ECU as a shared library, frame by frame, with no bus and no clock: for the rig's fast path, for tests
 * and for replay. Frames are struct can_frame_11bit, 16 bytes each: id (uint32), length, data[8], padding. */
#ifndef PORTS_INPROC_H
#define PORTS_INPROC_H

#include <stdint.h>

/* Bytes of one ECU; the caller provides them, aligned to 16. */
uint32_t diarc_inproc_size(void);

/* Name of the number type this library was built with. */
const char *diarc_inproc_scalar(void);

/* image NULL: the built-in reference arm; else image_bytes must be the image's size. Returns 0, or an
 * ecu_status (diarc_inproc_status_text), -1 for a wrong image_bytes; *entry: the parameter's number. */
int32_t diarc_inproc_init(void *ecu, const uint8_t *image, uint32_t image_bytes, uint32_t period_us,
                          uint16_t *entry);
const char *diarc_inproc_status_text(int32_t status);
const char *diarc_inproc_parameter_name(uint16_t entry);

/* The first half of a tick: SYNC and what goes before it. Returns the number of frames written to tx. */
int32_t diarc_inproc_begin(void *ecu, uint8_t *tx, int32_t tx_frames);

/* The rest of the tick on rx_count frames. Returns the number of frames written to tx. */
int32_t diarc_inproc_end(void *ecu, const uint8_t *rx, int32_t rx_count, uint8_t *tx, int32_t tx_frames);

/* What the port of another platform does on its own, between ticks, when it is told to end. */
void diarc_inproc_request_safe_stop(void *ecu);

/* Valves shut. Returns the number of frames written to tx. */
int32_t diarc_inproc_shutdown(void *ecu, uint8_t *tx, int32_t tx_frames);

#endif
