#include "ports/inproc/inproc.h"

#include <stddef.h>

#include "ecu/ecu.h"

_Static_assert(sizeof(struct can_frame_11bit) == 16, "the frame layout that Python relies on");

struct frame_buffers {
    const struct can_frame_11bit *rx;
    int32_t rx_count;
    int32_t rx_next;
    struct can_frame_11bit *tx;
    int32_t tx_frames;
    int32_t tx_count;
};

static enum port_status buffer_send(void *context, const struct can_frame_11bit *frame)
{
    struct frame_buffers *const buffers = context;
    if (buffers->tx_count >= buffers->tx_frames) {
        return PORT_BUSY;
    }
    buffers->tx[buffers->tx_count++] = *frame;
    return PORT_OK;
}

static enum port_status buffer_receive(void *context, struct can_frame_11bit *frame)
{
    struct frame_buffers *const buffers = context;
    if (buffers->rx_next >= buffers->rx_count) {
        return PORT_EMPTY;
    }
    *frame = buffers->rx[buffers->rx_next++];
    return PORT_OK;
}

static uint32_t no_time_us(void *context)
{
    (void)context;
    return 0;
}

static struct ecu_port port_of(struct frame_buffers *buffers)
{
    return (struct ecu_port){
        .context = buffers, .send = buffer_send, .receive = buffer_receive, .now_us = no_time_us};
}

uint32_t diarc_inproc_size(void)
{
    return (uint32_t)sizeof(struct ecu);
}

const char *diarc_inproc_scalar(void)
{
    return SCALAR_NAME;
}

int32_t diarc_inproc_init(void *ecu, const uint8_t *image, uint32_t image_bytes, uint32_t period_us,
                          uint16_t *entry)
{
    if (image != NULL && image_bytes != sizeof(struct parameter_image)) {
        return -1;
    }
    return (int32_t)ecu_init(ecu, (const struct parameter_image *)(const void *)image, period_us, entry);
}

const char *diarc_inproc_status_text(int32_t status)
{
    return status < 0 ? "has the wrong size" : ecu_status_text((enum ecu_status)status);
}

const char *diarc_inproc_parameter_name(uint16_t entry)
{
    return parameter_name(entry);
}

int32_t diarc_inproc_begin(void *ecu, uint8_t *tx, int32_t tx_frames)
{
    struct frame_buffers buffers = {.tx = (struct can_frame_11bit *)(void *)tx, .tx_frames = tx_frames};
    const struct ecu_port port = port_of(&buffers);
    ecu_tick_begin(ecu, &port);
    return buffers.tx_count;
}

int32_t diarc_inproc_end(void *ecu, const uint8_t *rx, int32_t rx_count, uint8_t *tx, int32_t tx_frames)
{
    struct frame_buffers buffers = {.rx = (const struct can_frame_11bit *)(const void *)rx,
                                    .rx_count = rx_count,
                                    .tx = (struct can_frame_11bit *)(void *)tx,
                                    .tx_frames = tx_frames};
    const struct ecu_port port = port_of(&buffers);
    while (buffers.rx_next < buffers.rx_count) {
        (void)ecu_tick_receive(ecu, &port);
    }
    ecu_tick_end(ecu, &port);
    return buffers.tx_count;
}

void diarc_inproc_request_safe_stop(void *ecu)
{
    ecu_request_safe_stop(ecu);
}

int32_t diarc_inproc_shutdown(void *ecu, uint8_t *tx, int32_t tx_frames)
{
    struct frame_buffers buffers = {.tx = (struct can_frame_11bit *)(void *)tx, .tx_frames = tx_frames};
    const struct ecu_port port = port_of(&buffers);
    ecu_shutdown(ecu, &port);
    return buffers.tx_count;
}
