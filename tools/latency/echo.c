/* The bare minimum that a program can do on a bus: read, look at the identifier, write. What the ECU is compared
 * with (tools/latency.py). A blocking read and a write, nothing else. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sched.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <unistd.h>

#include "rounds.h"

enum { TEXT_BYTES = 4096 };

static int fail(const char *what)
{
    perror(what);
    return 1;
}

static uint32_t answer_to(uint32_t id)
{
    switch (id) {
    case ROUND_ASK_ID:
        return ROUND_BEGIN_ID;
    case ROUND_LAST_ID:
        return ROUND_ANSWER_ID;
    default:
        return 0;
    }
}

static int echo_on_can(const char *interface)
{
    const int fd = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    /* Not the ECU's frames: two programs that wake up for each other's would disturb each other. */
    const struct can_filter rounds[] = {{.can_id = ROUND_ASK_ID, .can_mask = CAN_SFF_MASK},
                                        {.can_id = ROUND_FIRST_ID, .can_mask = CAN_SFF_MASK},
                                        {.can_id = ROUND_MIDDLE_ID, .can_mask = CAN_SFF_MASK},
                                        {.can_id = ROUND_LAST_ID, .can_mask = CAN_SFF_MASK}};
    const struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(interface)};
    if (fd < 0 || address.can_ifindex == 0 ||
        setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FILTER, rounds, sizeof rounds) < 0 ||
        bind(fd, (const struct sockaddr *)&address, sizeof address) < 0) {
        return fail(interface);
    }
    (void)puts("ready");
    struct can_frame frame;
    while (read(fd, &frame, sizeof frame) == (ssize_t)sizeof frame) {
        frame.can_id = answer_to(frame.can_id);
        if (frame.can_id != 0 && write(fd, &frame, sizeof frame) != (ssize_t)sizeof frame) {
            return fail("write");
        }
    }
    return fail("read");
}

static bool expect(int fd, const char *wanted)
{
    char text[64];
    const ssize_t count = recv(fd, text, sizeof text - 1, 0);
    text[count > 0 ? count : 0] = '\0';
    return strcmp(text, wanted) == 0;
}

static bool say(int fd, const char *text)
{
    return send(fd, text, strlen(text), MSG_NOSIGNAL) == (ssize_t)strlen(text);
}

/* Answers the frames among the first `count` characters; gives how many are used up, up to the last '>'. */
static size_t answer_text(int fd, const char *text, size_t count)
{
    size_t used = 0;
    const char *end;
    while ((end = memchr(text + used, '>', count - used)) != NULL) {
        const uint32_t id = strncmp(text + used, "< frame ", 8) == 0
                                ? answer_to((uint32_t)strtoul(text + used + 8, NULL, 16))
                                : 0;
        if (id == ROUND_BEGIN_ID) {
            (void)say(fd, "< send 7F1 8 1 2 3 4 5 6 7 8 >");
        } else if (id == ROUND_ANSWER_ID) {
            (void)say(fd, "< send 7F5 8 1 2 3 4 5 6 7 8 >");
        }
        used = (size_t)(end - text) + 1;
    }
    return used;
}

static int echo_on_tcp(const char *host, const char *port)
{
    const int on = 1;
    const int fd = socket(AF_INET, SOCK_STREAM, 0);
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons((uint16_t)atoi(port))};
    if (fd < 0 || inet_pton(AF_INET, host, &address.sin_addr) != 1 ||
        setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on) < 0 ||
        connect(fd, (const struct sockaddr *)&address, sizeof address) < 0) {
        return fail(host);
    }
    if (!expect(fd, "< hi >") || !say(fd, "< open " ROUND_CHANNEL " >") || !expect(fd, "< ok >") ||
        !say(fd, "< rawmode >") || !expect(fd, "< ok >")) {
        (void)fputs("echo: no socketcand server\n", stderr);
        return 1;
    }
    (void)puts("ready");
    char text[TEXT_BYTES];
    size_t count = 0;
    ssize_t got;
    while (count < sizeof text && (got = recv(fd, text + count, sizeof text - count, 0)) > 0) {
        count += (size_t)got;
        const size_t used = answer_text(fd, text, count);
        count -= used;
        memmove(text, text + used, count);
    }
    return fail("recv");
}

/* echo INTERFACE | echo HOST PORT */
int main(int argc, char *argv[])
{
    (void)setvbuf(stdout, NULL, _IOLBF, 0);
    const struct sched_param priority = {.sched_priority = ROUND_FIFO_PRIORITY};
    (void)sched_setscheduler(0, SCHED_FIFO, &priority);
    (void)mlockall(MCL_CURRENT | MCL_FUTURE);
    if (argc == 2) {
        return echo_on_can(argv[1]);
    }
    if (argc == 3) {
        return echo_on_tcp(argv[1], argv[2]);
    }
    (void)fputs("usage: latency_echo INTERFACE | latency_echo HOST PORT\n", stderr);
    return 2;
}
