#define _GNU_SOURCE
#include "ports/linux/socketcan.h"

#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#include "ports/linux/clock.h"

static void go_down(struct bus *bus, const char *what)
{
    bus->state = BUS_DOWN;
    bus->drained = true;
    (void)snprintf(bus->message, sizeof bus->message,
                   "the bus is gone while %s: %s; the valve frame cannot be sent any more", what,
                   strerror(errno));
}

static enum port_status socketcan_send(void *context, const struct can_frame_11bit *frame)
{
    struct bus *bus = context;
    if (bus->state != BUS_UP) {
        return PORT_DOWN;
    }
    struct can_frame raw = {.can_id = frame->id & CAN_SFF_MASK, .can_dlc = frame->length};
    memcpy(raw.data, frame->data, sizeof raw.data);
    ssize_t written;
    do {
        written = write(bus->fd, &raw, sizeof raw);
    } while (written < 0 && errno == EINTR);
    if (written == (ssize_t)sizeof raw) {
        return PORT_OK;
    }
    bus->stats.send_drops++;
    if (written >= 0 || errno == ENOBUFS || errno == EAGAIN) {
        return PORT_BUSY;
    }
    go_down(bus, "sending");
    return PORT_DOWN;
}

/* The kernel attaches how many frames it has dropped on this socket so far, modulo 2^32. */
static void note_drops(struct bus *bus, struct msghdr *header)
{
    for (struct cmsghdr *part = CMSG_FIRSTHDR(header); part != NULL; part = CMSG_NXTHDR(header, part)) {
        if (part->cmsg_level == SOL_SOCKET && part->cmsg_type == SO_RXQ_OVFL) {
            uint32_t drops;
            memcpy(&drops, CMSG_DATA(part), sizeof drops);
            bus->stats.receive_drops += (uint32_t)(drops - (uint32_t)bus->stats.receive_drops);
        }
    }
}

static enum port_status socketcan_receive(void *context, struct can_frame_11bit *frame)
{
    struct bus *bus = context;
    while (bus->state == BUS_UP) {
        struct can_frame raw;
        union {
            struct cmsghdr align;
            char bytes[CMSG_SPACE(sizeof(uint32_t))];
        } control;
        struct iovec part = {.iov_base = &raw, .iov_len = sizeof raw};
        struct msghdr header = {
            .msg_iov = &part, .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof control};
        const ssize_t count = recvmsg(bus->fd, &header, 0);
        if (count < 0 && errno == EINTR) {
            continue;
        }
        if (count < 0 && errno == EAGAIN) {
            bus->drained = true;
            return PORT_EMPTY;
        }
        if (count < 0) {
            go_down(bus, "receiving");
            break;
        }
        note_drops(bus, &header);
        if (count != (ssize_t)sizeof raw || raw.can_dlc > sizeof raw.data) {
            bus->stats.receive_errors++;
            continue;
        }
        *frame = (struct can_frame_11bit){.id = raw.can_id & CAN_SFF_MASK, .length = raw.can_dlc};
        memcpy(frame->data, raw.data, frame->length);
        bus->drained = false;
        return PORT_OK;
    }
    return PORT_DOWN;
}

static bool socketcan_flush(void *context)
{
    (void)context; /* each frame goes to the kernel at once */
    return true;
}

static bool socketcan_close(void *context)
{
    struct bus *bus = context;
    (void)close(bus->fd);
    bus->fd = -1;
    return bus->state == BUS_UP;
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

static bool is_virtual(const char *interface)
{
    return strncmp(interface, "vcan", 4) == 0;
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
    /* One filter: neither extended nor remote. Error frames have a mask of their own, by default empty. */
    const struct can_filter data_11bit = {.can_id = 0, .can_mask = CAN_EFF_FLAG | CAN_RTR_FLAG};
    const int off = 0;
    const int on = 1;
    const int buffer_bytes = BUS_SOCKET_BUFFER_BYTES;
    if (setsockopt(fd, SOL_SOCKET, SO_RCVBUFFORCE, &buffer_bytes, sizeof buffer_bytes) < 0) {
        (void)setsockopt(fd, SOL_SOCKET, SO_RCVBUF, &buffer_bytes, sizeof buffer_bytes);
    }
    return setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FILTER, &data_11bit, sizeof data_11bit) == 0 &&
           setsockopt(fd, SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS, &off, sizeof off) == 0 &&
           setsockopt(fd, SOL_SOCKET, SO_RXQ_OVFL, &on, sizeof on) == 0;
}

bool socketcan_open(struct bus *bus, const char *interface)
{
    *bus = (struct bus){
        .port = {.context = bus,
                 .send = socketcan_send,
                 .receive = socketcan_receive,
                 .now_us = clock_port_now_us},
        .fd = -1,
        .flush = socketcan_flush,
        .close = socketcan_close,
    };
    const int fd = socket(PF_CAN, SOCK_RAW | SOCK_NONBLOCK | SOCK_CLOEXEC, CAN_RAW);
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
