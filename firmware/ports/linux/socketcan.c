#define _GNU_SOURCE
#include "ports/linux/socketcan.h"

#include <errno.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>
#include <linux/sock_diag.h>
#include <net/if.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

static bool is_virtual(const char *interface)
{
    return strncmp(interface, "vcan", 4) == 0;
}

static void go_down(struct socketcan *can, const char *what)
{
    can->bus.state = BUS_DOWN;
    can->bus.drained = true;
    (void)snprintf(can->bus.message, sizeof can->bus.message,
                   "the bus is gone while %s: %s; the valve frame cannot be sent any more", what,
                   strerror(errno));
}

/* The valves' node notices by itself: it closes them at its timeout. */
static void pause_for_link(struct socketcan *can)
{
    if (can->bus.state == BUS_UP || can->is_bus_off) {
        (void)snprintf(can->bus.message, sizeof can->bus.message,
                       "the CAN interface %s went down, waiting for it; try: sudo ip link set up %s%s",
                       can->interface, can->interface,
                       is_virtual(can->interface) ? "" : " type can bitrate 1000000");
    }
    can->bus.state = BUS_PAUSED;
    can->is_bus_off = false; /* coming up again begins with a clean error count */
}

static void pause_for_bus_off(struct socketcan *can)
{
    can->bus.state = BUS_PAUSED;
    can->is_bus_off = true;
    (void)snprintf(
        can->bus.message, sizeof can->bus.message,
        "%s is bus-off after too many errors, waiting for its restart; check wiring and bit rate; "
        "now: sudo ip link set %s type can restart; by itself: sudo ip link set %s down && sudo ip "
        "link set %s up type can restart-ms 100",
        can->interface, can->interface, can->interface, can->interface);
}

static void resume(struct socketcan *can)
{
    if (can->bus.state == BUS_PAUSED) {
        can->bus.state = BUS_UP;
        can->is_bus_off = false;
        (void)snprintf(can->bus.message, sizeof can->bus.message, "%s is back", can->interface);
    }
}

static enum port_status socketcan_send(void *context, const struct can_frame_11bit *frame)
{
    struct socketcan *const can = context;
    if (can->bus.state == BUS_DOWN) {
        return PORT_DOWN;
    }
    if (can->is_bus_off) { /* the kernel would still queue some, to be sent much too late */
        can->bus.stats.send_drops++;
        return PORT_DOWN;
    }
    struct can_frame raw = {.can_id = frame->id & CAN_SFF_MASK, .can_dlc = frame->length};
    memcpy(raw.data, frame->data, sizeof raw.data);
    ssize_t written;
    do {
        written = send(can->bus.fd, &raw, sizeof raw, MSG_DONTWAIT);
    } while (written < 0 && errno == EINTR);
    can->bus.came_ns = 0;
    if (written == (ssize_t)sizeof raw) {
        resume(can);
        return PORT_OK;
    }
    can->bus.stats.send_drops++;
    if (written >= 0 || errno == ENOBUFS || errno == EAGAIN) {
        return PORT_BUSY;
    }
    if (errno == ENETDOWN) {
        pause_for_link(can);
    } else {
        go_down(can, "sending");
    }
    return PORT_DOWN;
}

/* Error frames are the kernel's messages about the controller; only these two are asked for. */
static void note_error_frame(struct socketcan *can, const struct can_frame *raw)
{
    if ((raw->can_id & CAN_ERR_BUSOFF) != 0) {
        pause_for_bus_off(can);
    } else if ((raw->can_id & CAN_ERR_RESTARTED) != 0) {
        resume(can);
    }
}

enum read_result { READ_SOME, READ_NOTHING, READ_END };

/* All frames that are here, with one call. READ_END leaves the reason in the bus. */
static enum read_result read_more(struct socketcan *can)
{
    struct iovec parts[SOCKETCAN_BATCH_FRAMES];
    struct mmsghdr headers[SOCKETCAN_BATCH_FRAMES];
    union {
        struct cmsghdr align;
        char bytes[CMSG_SPACE(sizeof(struct timespec))];
    } control[SOCKETCAN_BATCH_FRAMES];
    for (size_t i = 0; i < SOCKETCAN_BATCH_FRAMES; i++) {
        parts[i] = (struct iovec){.iov_base = &can->received[i], .iov_len = sizeof can->received[i]};
        headers[i] = (struct mmsghdr){.msg_hdr = {.msg_iov = &parts[i],
                                                  .msg_iovlen = 1,
                                                  .msg_control = &control[i],
                                                  .msg_controllen = sizeof control[i]}};
    }
    const int flags = can->bus.may_wait ? MSG_WAITFORONE : MSG_DONTWAIT;
    const int count = recvmmsg(can->bus.fd, headers, SOCKETCAN_BATCH_FRAMES, flags, NULL);
    can->bus.may_wait = false;
    can->taken_count = 0;
    can->received_count = count > 0 ? (size_t)count : 0;
    can->read_all = can->received_count < SOCKETCAN_BATCH_FRAMES;
    for (size_t i = 0; i < can->received_count; i++) {
        can->received_bytes[i] = headers[i].msg_len;
    }
    if (count > 0) {
        can->bus.came_ns = bus_message_time_ns(&headers[count - 1].msg_hdr);
        return READ_SOME;
    }
    if (count < 0 && errno == ENETDOWN) {
        pause_for_link(can);
        return READ_NOTHING;
    }
    if (count < 0 && errno != EAGAIN && errno != EINTR) {
        go_down(can, "receiving");
        return READ_END;
    }
    return READ_NOTHING;
}

static enum port_status socketcan_receive(void *context, struct can_frame_11bit *frame)
{
    struct socketcan *const can = context;
    while (can->bus.state != BUS_DOWN) {
        if (can->taken_count == can->received_count) {
            /* After a read that took all, another would find nothing: that call is spared. */
            const enum read_result result = can->read_all ? READ_NOTHING : read_more(can);
            if (result == READ_NOTHING) {
                can->read_all = false;
                can->bus.drained = true;
                return PORT_EMPTY;
            }
            continue;
        }
        const struct can_frame *const raw = &can->received[can->taken_count];
        const size_t raw_bytes = can->received_bytes[can->taken_count++];
        if (raw_bytes != sizeof *raw || raw->can_dlc > sizeof raw->data) {
            can->bus.stats.receive_errors++;
        } else if ((raw->can_id & CAN_ERR_FLAG) != 0) {
            note_error_frame(can, raw);
        } else {
            *frame = (struct can_frame_11bit){.id = raw->can_id & CAN_SFF_MASK, .length = raw->can_dlc};
            memcpy(frame->data, raw->data, frame->length);
            can->bus.drained = false;
            return PORT_OK;
        }
    }
    return PORT_DOWN;
}

static bool socketcan_flush(void *context)
{
    (void)context; /* each frame goes to the kernel at once */
    return true;
}

/* Frames the kernel has dropped on this socket because its buffer was full. */
static uint64_t dropped_frames(int fd)
{
    uint32_t info[SK_MEMINFO_VARS] = {0};
    socklen_t size = sizeof info;
    return getsockopt(fd, SOL_SOCKET, SO_MEMINFO, info, &size) == 0 ? info[SK_MEMINFO_DROPS] : 0;
}

static bool socketcan_close(void *context)
{
    struct socketcan *const can = context;
    can->bus.stats.receive_drops = dropped_frames(can->bus.fd);
    (void)close(can->bus.fd);
    can->bus.fd = -1;
    return can->bus.state == BUS_UP;
}

/* Closes `fd` if it is open; gives false. */
static bool fail(struct bus *bus, int fd)
{
    if (fd >= 0) {
        (void)close(fd);
    }
    bus->fd = -1;
    bus->state = BUS_DOWN;
    return false;
}

static bool fail_without_interface(struct bus *bus, int fd, const char *interface)
{
    const char *const adapter = is_virtual(interface) ? "" : "plug in the adapter and load its driver, or ";
    (void)snprintf(bus->message, sizeof bus->message,
                   "no such CAN interface: %s; %smake a virtual one: sudo ip link add dev %s type vcan && "
                   "sudo ip link set up %s",
                   interface, adapter, interface, interface);
    return fail(bus, fd);
}

static bool fail_with_interface_down(struct bus *bus, int fd, const char *interface)
{
    const char *const bitrate = is_virtual(interface) ? "" : " type can bitrate 1000000";
    (void)snprintf(bus->message, sizeof bus->message,
                   "the CAN interface %s is down; try: sudo ip link set up %s%s", interface, interface,
                   bitrate);
    return fail(bus, fd);
}

static bool fail_with_errno(struct bus *bus, int fd, const char *interface, const char *what)
{
    (void)snprintf(bus->message, sizeof bus->message, "cannot %s %s: %s", what, interface, strerror(errno));
    return fail(bus, fd);
}

/* Options of the socket; the buffer size is a wish, the rest must hold. */
static bool set_options(int fd)
{
    /* One filter: neither extended nor remote. Error frames have a mask of their own. */
    const struct can_filter data_11bit = {.can_id = 0, .can_mask = CAN_EFF_FLAG | CAN_RTR_FLAG};
    const can_err_mask_t errors = CAN_ERR_BUSOFF | CAN_ERR_RESTARTED;
    const int off = 0;
    const int on = 1;
    const int buffer_bytes = BUS_SOCKET_BUFFER_BYTES;
    if (setsockopt(fd, SOL_SOCKET, SO_RCVBUFFORCE, &buffer_bytes, sizeof buffer_bytes) < 0) {
        (void)setsockopt(fd, SOL_SOCKET, SO_RCVBUF, &buffer_bytes, sizeof buffer_bytes);
    }
    return setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FILTER, &data_11bit, sizeof data_11bit) == 0 &&
           setsockopt(fd, SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS, &off, sizeof off) == 0 &&
           setsockopt(fd, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &errors, sizeof errors) == 0 &&
           setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on) == 0;
}

bool socketcan_open(struct socketcan *can, const char *interface)
{
    *can = (struct socketcan){.interface = interface};
    struct bus *const bus = &can->bus;
    *bus = (struct bus){
        .port = {.context = can, .send = socketcan_send, .receive = socketcan_receive, .now_us = bus_now_us},
        .fd = -1,
        .flush = socketcan_flush,
        .close = socketcan_close,
    };
    const int fd = socket(PF_CAN, SOCK_RAW | SOCK_CLOEXEC, CAN_RAW);
    if (fd < 0 && (errno == EAFNOSUPPORT || errno == EPROTONOSUPPORT)) {
        (void)snprintf(
            bus->message, sizeof bus->message,
            "this kernel has no CAN sockets (AF_CAN, can_raw); try: sudo modprobe -a can_raw vcan; without "
            "a CAN driver use the bus tcp:127.0.0.1:PORT (sil_plant/run.py --bus tcp:127.0.0.1:PORT) or "
            "tools/vcan_vm");
        return fail(bus, fd);
    }
    if (fd < 0) {
        return fail_with_errno(bus, fd, interface, "make a CAN socket for");
    }

    struct ifreq request = {0};
    const size_t length = strlen(interface);
    if (length >= sizeof request.ifr_name) {
        return fail_without_interface(bus, fd, interface);
    }
    memcpy(request.ifr_name, interface, length);
    if (ioctl(fd, SIOCGIFINDEX, &request) < 0) {
        return errno == ENODEV ? fail_without_interface(bus, fd, interface)
                               : fail_with_errno(bus, fd, interface, "look up");
    }
    const int index = request.ifr_ifindex;
    if (!set_options(fd)) {
        return fail_with_errno(bus, fd, interface, "set up the socket for");
    }
    const struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = index};
    if (bind(fd, (const struct sockaddr *)&address, sizeof address) < 0) {
        if (errno == ENODEV) {
            (void)snprintf(bus->message, sizeof bus->message,
                           "%s is no CAN interface; list those there are with: ip link show type can; "
                           "ip link show type vcan",
                           interface);
            return fail(bus, fd);
        }
        return fail_with_errno(bus, fd, interface, "bind to");
    }
    /* After bind, which accepts an interface that is down. */
    if (ioctl(fd, SIOCGIFFLAGS, &request) < 0) {
        return fail_with_errno(bus, fd, interface, "ask the state of");
    }
    if ((request.ifr_flags & IFF_UP) == 0) {
        return fail_with_interface_down(bus, fd, interface);
    }
    bus->fd = fd;
    return true;
}
