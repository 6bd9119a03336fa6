/* Replays a recorded run to the ECU, tick by tick, and measures from outside how long the ECU takes from the last
 * sensor frame of a tick to its valve frame; in the pause of each tick it does the same with the echo program.
 *
 *     latency_probe INTERFACE|tcp:HOST:PORT PERIOD_US RECORD RESULT
 *
 * All times are those of the kernel, for the frame that goes in and for the one that comes out, so that it does not
 * count how soon this program runs. On an interface both are times at which the kernel handed a frame to the
 * sockets; over TCP, where this program is the socketcand server, those at which a segment left and came.
 *
 * RECORD: per tick a uint32 with the number of frames for the ECU, these, and the valve frame that the ECU is to
 * answer (id 0: none); frames as in firmware/ecu/port.h. RESULT: a line per tick, "mode same ecu_ns echo_ns". */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <linux/errqueue.h>
#include <linux/net_tstamp.h>
#include <net/if.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "can_protocol/generated/diarc.h"
#include "ecu/port.h"
#include "rounds.h"

enum {
    FRAMES_MOST = 16, /* for the ECU in a tick */
    SENSOR_FRAMES = 3,
    QUEUE_FRAMES = 256,
    TEXT_BYTES = 8192,
    BOOT_LIMIT_MS = 10000,
    TICK_LIMIT_MS = 2000,
    ROUND_LIMIT_MS = 50,
    NMT_RESET_NODE = 129,
    MODE_SHIFT = 4
};
static const int64_t NS_PER_S = 1000000000;
static const int64_t NS_PER_MS = 1000000;

enum peer { ECU, ECHO, PEERS };

struct tick {
    uint32_t count;
    struct can_frame_11bit frames[FRAMES_MOST];
    struct can_frame_11bit valves;
};

struct sample {
    int mode;
    bool same;
    int64_t ecu_ns;  /* -1: not measured */
    int64_t echo_ns; /* -1: not measured */
};

struct received {
    struct can_frame_11bit frame;
    int64_t time_ns;
};

struct text {
    size_t count;
    char bytes[TEXT_BYTES];
};

struct probe {
    int can_fd; /* -1: over TCP */
    int tcp_fd[PEERS];
    int64_t sent_ns[PEERS]; /* when the last frame of the last send went */
    struct text text[PEERS];
    unsigned syncs;      /* that have come and begin a tick that is still to be answered */
    size_t first, count; /* of `queue` */
    struct received queue[QUEUE_FRAMES];
};

static _Noreturn void give_up(const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    (void)fputs("latency_probe: ", stderr);
    (void)vfprintf(stderr, format, arguments);
    (void)fputc('\n', stderr);
    va_end(arguments);
    exit(1);
}

static void require(bool good, const char *what)
{
    if (!good) {
        give_up("%s: %s", what, strerror(errno));
    }
}

static int64_t now_ns(void)
{
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

static int64_t to_ns(struct timespec time)
{
    return (int64_t)time.tv_sec * NS_PER_S + time.tv_nsec;
}

/* The kernel's time among what came with a message; 0 if there is none. */
static int64_t kernel_time_ns(struct msghdr *header)
{
    for (struct cmsghdr *part = CMSG_FIRSTHDR(header); part != NULL; part = CMSG_NXTHDR(header, part)) {
        if (part->cmsg_level == SOL_SOCKET &&
            (part->cmsg_type == SCM_TIMESTAMPNS || part->cmsg_type == SCM_TIMESTAMPING)) {
            struct timespec time; /* the first of three, with SCM_TIMESTAMPING: by software */
            memcpy(&time, CMSG_DATA(part), sizeof time);
            return to_ns(time);
        }
    }
    return 0;
}

static void enqueue(struct probe *probe, const struct can_frame_11bit *frame, int64_t time_ns)
{
    if (frame->id == DIARC_SYNC_FRAME_ID) {
        probe->syncs++; /* whatever is waited for just now */
    }
    if (probe->count < QUEUE_FRAMES) {
        probe->queue[(probe->first + probe->count++) % QUEUE_FRAMES] =
            (struct received){.frame = *frame, .time_ns = time_ns};
    }
}

/* ---- SocketCAN ----------------------------------------------------------------------------------------- */

static void open_can(struct probe *probe, const char *interface)
{
    const int fd = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    const int on = 1;
    const int buffer_bytes = 1 << 20;
    const struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(interface)};
    require(fd >= 0 && address.can_ifindex != 0, interface);
    (void)setsockopt(fd, SOL_SOCKET, SO_RCVBUF, &buffer_bytes, sizeof buffer_bytes);
    require(setsockopt(fd, SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS, &on, sizeof on) == 0 &&
                setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on) == 0 &&
                bind(fd, (const struct sockaddr *)&address, sizeof address) == 0,
            interface);
    probe->can_fd = fd;
}

/* With one call, as a node with a queue in hardware. */
static void send_can(struct probe *probe, const struct can_frame_11bit *frames, uint32_t count)
{
    struct can_frame raw[FRAMES_MOST];
    struct iovec parts[FRAMES_MOST];
    struct mmsghdr headers[FRAMES_MOST];
    for (uint32_t i = 0; i < count; i++) {
        raw[i] = (struct can_frame){.can_id = frames[i].id, .can_dlc = frames[i].length};
        memcpy(raw[i].data, frames[i].data, sizeof raw[i].data);
        parts[i] = (struct iovec){.iov_base = &raw[i], .iov_len = sizeof raw[i]};
        headers[i] = (struct mmsghdr){.msg_hdr = {.msg_iov = &parts[i], .msg_iovlen = 1}};
    }
    require(sendmmsg(probe->can_fd, headers, count, 0) == (int)count, "send");
}

static void read_can(struct probe *probe)
{
    for (;;) {
        struct can_frame raw;
        union {
            struct cmsghdr align;
            char bytes[256];
        } control;
        struct iovec part = {.iov_base = &raw, .iov_len = sizeof raw};
        struct msghdr header = {
            .msg_iov = &part, .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof control};
        const ssize_t got = recvmsg(probe->can_fd, &header, MSG_DONTWAIT);
        if (got < 0 && errno == EAGAIN) {
            return;
        }
        require(got == (ssize_t)sizeof raw, "receive");
        const int64_t time_ns = kernel_time_ns(&header);
        if ((header.msg_flags & MSG_CONFIRM) != 0) { /* our own */
            probe->sent_ns[raw.can_id >= ROUND_ASK_ID ? ECHO : ECU] = time_ns;
            continue;
        }
        struct can_frame_11bit frame = {.id = raw.can_id, .length = raw.can_dlc};
        memcpy(frame.data, raw.data, sizeof frame.data);
        enqueue(probe, &frame, time_ns);
    }
}

/* ---- socketcand, as its server --------------------------------------------------------------------------- */

static void say(int fd, const char *text)
{
    require(send(fd, text, strlen(text), MSG_NOSIGNAL) == (ssize_t)strlen(text), "greet");
}

/* One of the two clients, whichever comes first. */
static void greet(struct probe *probe, int listener)
{
    const int on = 1;
    const int stamps = SOF_TIMESTAMPING_SOFTWARE | SOF_TIMESTAMPING_RX_SOFTWARE |
                       SOF_TIMESTAMPING_TX_SOFTWARE | SOF_TIMESTAMPING_OPT_TSONLY;
    const struct timeval limit = {.tv_sec = BOOT_LIMIT_MS / 1000};
    const int fd = accept(listener, NULL, NULL);
    require(fd >= 0 && setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on) == 0 &&
                setsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit) == 0,
            "accept");
    char text[128];
    say(fd, "< hi >");
    const ssize_t got = recv(fd, text, sizeof text - 1, 0);
    require(got > 0, "greet");
    text[got] = '\0';
    const enum peer peer = strstr(text, "< open " ROUND_CHANNEL " >") != NULL ? ECHO : ECU;
    say(fd, "< ok >");
    require(recv(fd, text, sizeof text, 0) > 0, "greet");
    say(fd, "< ok >");
    require(setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPING, &stamps, sizeof stamps) == 0, "SO_TIMESTAMPING");
    probe->tcp_fd[peer] = fd;
}

static void open_tcp(struct probe *probe, const char *text)
{
    char host[64];
    const char *const colon = strrchr(text, ':');
    require(colon != NULL && (size_t)(colon - text) < sizeof host, text);
    (void)snprintf(host, sizeof host, "%.*s", (int)(colon - text), text);
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons((uint16_t)atoi(colon + 1))};
    socklen_t size = sizeof address;
    const int on = 1;
    const int fd = socket(AF_INET, SOCK_STREAM, 0);
    require(fd >= 0 && inet_pton(AF_INET, host, &address.sin_addr) == 1, host);
    (void)setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on);
    require(bind(fd, (const struct sockaddr *)&address, sizeof address) == 0 && listen(fd, PEERS) == 0 &&
                getsockname(fd, (struct sockaddr *)&address, &size) == 0,
            text);
    (void)printf("listening %d\n", ntohs(address.sin_port));
    for (int i = 0; i < PEERS; i++) {
        struct pollfd one = {.fd = fd, .events = POLLIN};
        require(poll(&one, 1, BOOT_LIMIT_MS) == 1, "waiting for the ECU and the echo program");
        greet(probe, fd);
    }
    (void)close(fd);
    require(probe->tcp_fd[ECU] >= 0 && probe->tcp_fd[ECHO] >= 0, "ECU and echo program");
}

/* When the last segment left, which the kernel tells on the error queue. */
static void read_sent_time(struct probe *probe, enum peer peer)
{
    for (;;) {
        union {
            struct cmsghdr align;
            char bytes[512];
        } control;
        struct msghdr header = {.msg_control = &control, .msg_controllen = sizeof control};
        if (recvmsg(probe->tcp_fd[peer], &header, MSG_ERRQUEUE | MSG_DONTWAIT) < 0) {
            return;
        }
        probe->sent_ns[peer] = kernel_time_ns(&header);
    }
}

static void send_tcp(struct probe *probe, enum peer peer, const struct can_frame_11bit *frames,
                     uint32_t count)
{
    char text[FRAMES_MOST * 64];
    size_t length = 0;
    for (uint32_t i = 0; i < count; i++) {
        length += (size_t)snprintf(text + length, sizeof text - length, "< frame %03X 1700000000.000000 ",
                                   (unsigned)frames[i].id);
        for (uint8_t k = 0; k < frames[i].length; k++) {
            length += (size_t)snprintf(text + length, sizeof text - length, "%02X", frames[i].data[k]);
        }
        length += (size_t)snprintf(text + length, sizeof text - length, " >");
    }
    require(send(probe->tcp_fd[peer], text, length, MSG_NOSIGNAL) == (ssize_t)length, "send");
    read_sent_time(probe, peer);
}

/* Queues the frames of the complete texts "< send ID LENGTH BYTES >"; the rest stays. */
static void parse_text(struct probe *probe, struct text *text, int64_t time_ns)
{
    size_t used = 0;
    const char *end;
    while ((end = memchr(text->bytes + used, '>', text->count - used)) != NULL) {
        const char *const start = text->bytes + used;
        if (strncmp(start, "< send ", 7) == 0) {
            char *next;
            struct can_frame_11bit frame = {.id = (uint32_t)strtoul(start + 7, &next, 16)};
            frame.length = (uint8_t)(strtoul(next, &next, 10) % 9);
            for (uint8_t k = 0; k < frame.length; k++) {
                frame.data[k] = (uint8_t)strtoul(next, &next, 16);
            }
            enqueue(probe, &frame, time_ns);
        }
        used = (size_t)(end - text->bytes) + 1;
    }
    text->count -= used;
    memmove(text->bytes, text->bytes + used, text->count);
}

static void read_tcp(struct probe *probe, enum peer peer)
{
    struct text *const text = &probe->text[peer];
    union {
        struct cmsghdr align;
        char bytes[256];
    } control;
    struct iovec part = {.iov_base = text->bytes + text->count, .iov_len = sizeof text->bytes - text->count};
    struct msghdr header = {
        .msg_iov = &part, .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof control};
    const ssize_t got = recvmsg(probe->tcp_fd[peer], &header, MSG_DONTWAIT);
    if (got < 0 && errno == EAGAIN) {
        return;
    }
    if (got == 0) {
        give_up("the %s has closed the connection", peer == ECU ? "ECU" : "echo program");
    }
    require(got > 0, "receive");
    text->count += (size_t)got;
    parse_text(probe, text, kernel_time_ns(&header));
}

/* ---- either ---------------------------------------------------------------------------------------------- */

static void send_frames(struct probe *probe, enum peer peer, const struct can_frame_11bit *frames,
                        uint32_t count)
{
    if (probe->can_fd >= 0) {
        send_can(probe, frames, count);
    } else {
        send_tcp(probe, peer, frames, count);
    }
}

static void wait_and_read(struct probe *probe, int64_t left_ns)
{
    const struct timespec limit = {.tv_sec = (time_t)(left_ns / NS_PER_S),
                                   .tv_nsec = (long)(left_ns % NS_PER_S)};
    if (probe->can_fd >= 0) {
        struct pollfd one = {.fd = probe->can_fd, .events = POLLIN};
        if (ppoll(&one, 1, &limit, NULL) > 0) {
            read_can(probe);
        }
        return;
    }
    struct pollfd both[PEERS] = {{.fd = probe->tcp_fd[ECU], .events = POLLIN},
                                 {.fd = probe->tcp_fd[ECHO], .events = POLLIN}};
    if (ppoll(both, PEERS, &limit, NULL) > 0) {
        for (enum peer peer = ECU; peer < PEERS; peer++) {
            if ((both[peer].revents & POLLERR) != 0) {
                read_sent_time(probe, peer);
            }
            if ((both[peer].revents & (POLLIN | POLLHUP)) != 0) {
                read_tcp(probe, peer);
            }
        }
    }
}

/* The next frame from the ECU or the echo program; false at the deadline. */
static bool receive(struct probe *probe, int64_t deadline_ns, struct received *received)
{
    while (probe->count == 0) {
        const int64_t left_ns = deadline_ns - now_ns();
        if (left_ns <= 0) {
            return false;
        }
        wait_and_read(probe, left_ns);
    }
    *received = probe->queue[probe->first];
    probe->first = (probe->first + 1) % QUEUE_FRAMES;
    probe->count--;
    return true;
}

static bool await(struct probe *probe, uint32_t id, int64_t limit_ms, struct received *received)
{
    const int64_t deadline_ns = now_ns() + limit_ms * NS_PER_MS;
    while (receive(probe, deadline_ns, received)) {
        if (received->frame.id == id) {
            return true;
        }
    }
    return false;
}

/* A round with the echo program, with the sensor frames of the tick under other identifiers; its time, or -1. */
static int64_t echo_round(struct probe *probe, const struct tick *tick)
{
    struct can_frame_11bit ask = {.id = ROUND_ASK_ID, .length = 8};
    struct can_frame_11bit frames[SENSOR_FRAMES];
    struct received received;
    probe->sent_ns[ECHO] = 0;
    for (uint32_t i = 0; i < SENSOR_FRAMES; i++) {
        frames[i] = tick->frames[tick->count - SENSOR_FRAMES + i];
        frames[i].id = ROUND_FIRST_ID + i;
    }
    send_frames(probe, ECHO, &ask, 1);
    if (!await(probe, ROUND_BEGIN_ID, ROUND_LIMIT_MS, &received)) {
        return -1;
    }
    send_frames(probe, ECHO, frames, SENSOR_FRAMES);
    const bool answered = await(probe, ROUND_ANSWER_ID, ROUND_LIMIT_MS, &received);
    /* Not when the ECU has begun its next tick meanwhile, which would keep the echo program waiting. */
    const bool undisturbed = answered && probe->sent_ns[ECHO] != 0 && probe->syncs == 0;
    return undisturbed ? received.time_ns - probe->sent_ns[ECHO] : -1;
}

static void boot_ecu(struct probe *probe)
{
    const struct can_frame_11bit reset = {
        .id = DIARC_NMT_FRAME_ID, .length = DIARC_NMT_LENGTH, .data = {NMT_RESET_NODE, 1}};
    struct received received;
    if (!await(probe, DIARC_SYNC_FRAME_ID, BOOT_LIMIT_MS, &received)) {
        give_up("no SYNC from the ECU within %d s", BOOT_LIMIT_MS / 1000);
    }
    send_frames(probe, ECU, &reset, 1);
    const int64_t deadline_ns = now_ns() + BOOT_LIMIT_MS * NS_PER_MS;
    while (receive(probe, deadline_ns, &received)) {
        if (received.frame.id == DIARC_HEARTBEAT_ECU_FRAME_ID && received.frame.data[0] == 0) {
            probe->syncs = 0;
            for (size_t i = 0; i < probe->count; i++) { /* what came with it counts */
                probe->syncs +=
                    probe->queue[(probe->first + i) % QUEUE_FRAMES].frame.id == DIARC_SYNC_FRAME_ID;
            }
            return;
        }
    }
    give_up("the ECU does not restart on NMT reset");
}

/* One tick of the ECU, then a round with the echo program half a period after SYNC. */
static struct sample measure(struct probe *probe, const struct tick *tick, int64_t half_period_ns)
{
    struct sample sample = {.mode = -1, .ecu_ns = -1, .echo_ns = -1};
    struct received received;
    const int64_t limit_ns = now_ns() + TICK_LIMIT_MS * NS_PER_MS;
    while (probe->syncs == 0) {
        if (!receive(probe, limit_ns, &received)) {
            give_up("the ECU fell silent");
        }
    }
    probe->syncs--;
    if (probe->syncs > 0) {
        return sample; /* strict pace: the ECU is already a tick further */
    }
    probe->sent_ns[ECU] = 0;
    const int64_t sync_ns = now_ns();
    send_frames(probe, ECU, tick->frames, tick->count);
    if (tick->valves.id == 0) {
        return sample;
    }
    if (!await(probe, DIARC_VALVES_FRAME_ID, ROUND_LIMIT_MS, &received)) {
        return sample;
    }
    sample.mode = received.frame.data[1] >> MODE_SHIFT;
    sample.same = memcmp(received.frame.data, tick->valves.data, sizeof tick->valves.data) == 0;
    if (probe->sent_ns[ECU] != 0 &&
        probe->syncs == 0) { /* else the time may be that of the next tick's segment */
        sample.ecu_ns = received.time_ns - probe->sent_ns[ECU];
    }
    if (probe->syncs > 0) {
        return sample; /* no pause is left */
    }
    const int64_t pause_ns = sync_ns + half_period_ns - now_ns();
    if (pause_ns > 0) {
        const struct timespec pause = {.tv_nsec = (long)pause_ns};
        (void)clock_nanosleep(CLOCK_MONOTONIC, 0, &pause, NULL);
    }
    sample.echo_ns = echo_round(probe, tick);
    return sample;
}

static bool read_tick(FILE *file, struct tick *tick)
{
    if (fread(&tick->count, sizeof tick->count, 1, file) != 1) {
        return false;
    }
    if (tick->count < SENSOR_FRAMES || tick->count > FRAMES_MOST ||
        fread(tick->frames, sizeof tick->frames[0], tick->count, file) != tick->count ||
        fread(&tick->valves, sizeof tick->valves, 1, file) != 1) {
        give_up("the record is damaged");
    }
    return true;
}

int main(int argc, char *argv[])
{
    (void)setvbuf(stdout, NULL, _IOLBF, 0);
    if (argc != 5) {
        (void)fputs("usage: latency_probe INTERFACE|tcp:HOST:PORT PERIOD_US RECORD RESULT\n", stderr);
        return 2;
    }
    static struct probe probe;
    probe.can_fd = probe.tcp_fd[ECU] = probe.tcp_fd[ECHO] = -1;
    FILE *const record = fopen(argv[3], "rb");
    require(record != NULL, argv[3]);
    FILE *const result = fopen(argv[4], "w");
    require(result != NULL, argv[4]);
    static char buffer[1 << 20]; /* written now and then, not between two ticks */
    (void)setvbuf(result, buffer, _IOFBF, sizeof buffer);
    if (strncmp(argv[1], "tcp:", 4) == 0) {
        open_tcp(&probe, argv[1] + 4);
    } else {
        open_can(&probe, argv[1]);
        (void)puts("listening");
    }
    boot_ecu(&probe);
    struct tick tick;
    while (read_tick(record, &tick)) {
        const struct sample sample = measure(&probe, &tick, atoi(argv[2]) * (int64_t)500);
        (void)fprintf(result, "%d %d %lld %lld\n", sample.mode, sample.same, (long long)sample.ecu_ns,
                      (long long)sample.echo_ns);
    }
    return fclose(result) == 0 ? 0 : 1;
}
