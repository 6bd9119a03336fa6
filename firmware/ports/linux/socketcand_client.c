#define _GNU_SOURCE
#include "ports/linux/socketcand_client.h"

#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "ports/linux/clock.h"

enum { CONNECT_LIMIT_MS = 10000, RETRY_PAUSE_MS = 100, ANSWER_LIMIT_MS = 3000, CLOSE_LIMIT_MS = 200 };
enum { HEARD_BYTES = 80 };

static int ms_until(int64_t deadline_ns)
{
    const int64_t left_ns = deadline_ns - clock_now_ns();
    return left_ns <= 0 ? 0 : (int)((left_ns + NS_PER_MS - 1) / NS_PER_MS);
}

/* True when `events` came on `fd` (or an error, which the next call on it reports) before the deadline. */
static bool wait_for(int fd, short events, int64_t deadline_ns)
{
    struct pollfd one = {.fd = fd, .events = events};
    int count;
    do {
        count = poll(&one, 1, ms_until(deadline_ns));
    } while (count < 0 && errno == EINTR);
    return count > 0;
}

static void go_down(struct socketcand_client *client, enum bus_state state, const char *what,
                    const char *detail)
{
    client->bus.state = state;
    client->bus.drained = true;
    (void)snprintf(client->bus.message, sizeof client->bus.message, "%s %s%s%s", what, client->name,
                   detail[0] == '\0' ? "" : ": ", detail);
}

static bool socketcand_flush(void *context)
{
    struct socketcand_client *client = context;
    while (client->bus.state == BUS_UP && client->sent_bytes < client->queued_bytes) {
        const ssize_t count = send(client->bus.fd, client->transmit + client->sent_bytes,
                                   client->queued_bytes - client->sent_bytes, MSG_NOSIGNAL | MSG_DONTWAIT);
        if (count >= 0) {
            client->sent_bytes += (size_t)count;
        } else if (errno == EAGAIN) {
            return false;
        } else if (errno == EPIPE || errno == ECONNRESET) {
            go_down(client, BUS_DOWN, "bus closed by", "");
        } else if (errno != EINTR) {
            go_down(client, BUS_DOWN, "bus lost, sending to", strerror(errno));
        }
    }
    client->queued_bytes = 0;
    client->sent_bytes = 0;
    return true;
}

/* Room for `count` bytes behind those that wait, which move to the front for it; false when there is none. */
static bool make_room(struct socketcand_client *client, size_t count)
{
    if (client->queued_bytes + count <= sizeof client->transmit) {
        return true;
    }
    (void)socketcand_flush(client);
    const size_t waiting_bytes = client->queued_bytes - client->sent_bytes;
    memmove(client->transmit, client->transmit + client->sent_bytes, waiting_bytes);
    client->queued_bytes = waiting_bytes;
    client->sent_bytes = 0;
    return client->queued_bytes + count <= sizeof client->transmit;
}

/* The first frame after a read leaves at once: that of a tick is the valve frame. The others are collected, so that
 * those of one step of the tick leave in one segment, by socketcand_flush. */
static enum port_status socketcand_send(void *context, const struct can_frame_11bit *frame)
{
    struct socketcand_client *client = context;
    if (client->bus.state != BUS_UP) {
        return PORT_DOWN;
    }
    char text[SOCKETCAND_SEND_BYTES];
    const size_t length = socketcand_format_send(frame, text, sizeof text);
    if (length == 0 || !make_room(client, length)) {
        client->bus.stats.send_drops++;
        return client->bus.state == BUS_UP ? PORT_BUSY : PORT_DOWN;
    }
    memcpy(client->transmit + client->queued_bytes, text, length);
    client->queued_bytes += length;
    if (!client->collects) {
        client->collects = true;
        (void)socketcand_flush(client);
    }
    client->bus.came_ns = 0;
    return PORT_OK;
}

enum read_result { READ_SOME, READ_NOTHING, READ_END };

/* Replaces the parsed bytes by new ones. READ_END leaves the reason in the bus. */
static enum read_result read_more(struct socketcand_client *client)
{
    union {
        struct cmsghdr align;
        char bytes[CMSG_SPACE(sizeof(struct timespec))];
    } control;
    struct iovec part = {.iov_base = client->received, .iov_len = sizeof client->received};
    struct msghdr header = {
        .msg_iov = &part, .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof control};
    const ssize_t count = recvmsg(client->bus.fd, &header, client->bus.may_wait ? 0 : MSG_DONTWAIT);
    client->bus.may_wait = false;
    client->parsed_bytes = 0;
    client->received_bytes = count > 0 ? (size_t)count : 0;
    client->read_all = client->received_bytes < sizeof client->received;
    if (count > 0) {
        client->collects = false;
        client->bus.came_ns = bus_message_time_ns(&header);
        return READ_SOME;
    }
    if (count < 0 && (errno == EAGAIN || errno == EINTR)) {
        return READ_NOTHING;
    }
    if (count == 0 || errno == ECONNRESET) {
        go_down(client, BUS_DOWN, "bus closed by", "");
    } else {
        go_down(client, BUS_DOWN, "bus lost, receiving from", strerror(errno));
    }
    return READ_END;
}

/* The next message among the bytes that are here, SOCKETCAND_NOTHING when they are used up. */
static enum socketcand_kind next_message(struct socketcand_client *client, struct socketcand_message *message)
{
    client->parsed_bytes += socketcand_parse(&client->parser, client->received + client->parsed_bytes,
                                             client->received_bytes - client->parsed_bytes, message);
    return message->kind;
}

static enum port_status socketcand_receive(void *context, struct can_frame_11bit *frame)
{
    struct socketcand_client *client = context;
    struct socketcand_message message;
    while (client->bus.state == BUS_UP) {
        switch (next_message(client, &message)) {
        case SOCKETCAND_FRAME:
            *frame = message.frame;
            client->bus.drained = false;
            return PORT_OK;
        case SOCKETCAND_MALFORMED:
            client->bus.stats.receive_errors++;
            break;
        case SOCKETCAND_ERROR:
            go_down(client, BUS_REFUSED, "refused by", message.text);
            break;
        case SOCKETCAND_NOTHING:
            /* After a read that took all, another would find nothing: that call is spared. */
            if (client->read_all || read_more(client) == READ_NOTHING) {
                client->read_all = false;
                client->bus.drained = true;
                return PORT_EMPTY;
            }
            break;
        case SOCKETCAND_HI:
        case SOCKETCAND_OK:
        case SOCKETCAND_IGNORED:
            break;
        }
    }
    return PORT_DOWN;
}

static bool socketcand_close(void *context)
{
    struct socketcand_client *client = context;
    const int64_t deadline_ns = clock_now_ns() + (int64_t)CLOSE_LIMIT_MS * NS_PER_MS;
    while (!socketcand_flush(client) && wait_for(client->bus.fd, POLLOUT, deadline_ns)) {
    }
    const bool delivered = client->bus.state == BUS_UP && client->sent_bytes == client->queued_bytes;
    /* A close with unread bytes resets the connection, and the reset may overtake the last valve frame at the
     * server: half-close, read to the end, then close. */
    (void)shutdown(client->bus.fd, SHUT_WR);
    while (client->bus.state == BUS_UP && wait_for(client->bus.fd, POLLIN, deadline_ns) &&
           read_more(client) != READ_END) {
    }
    (void)close(client->bus.fd);
    client->bus.fd = -1;
    return delivered;
}

/* One attempt at one address. 0, or an errno. */
static int connect_once(struct socketcand_client *client, const struct addrinfo *address, int64_t deadline_ns)
{
    const int fd = socket(address->ai_family, address->ai_socktype | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (fd < 0) {
        return errno;
    }
    int error = connect(fd, address->ai_addr, address->ai_addrlen) == 0 ? 0 : errno;
    if (error == EINPROGRESS) {
        socklen_t size = sizeof error;
        if (!wait_for(fd, POLLOUT, deadline_ns)) {
            error = ETIMEDOUT;
        } else if (getsockopt(fd, SOL_SOCKET, SO_ERROR, &error, &size) < 0) {
            error = errno;
        }
    }
    /* A local port in the ephemeral range can connect to itself when no server listens. */
    struct sockaddr_storage own = {0};
    struct sockaddr_storage peer = {0};
    socklen_t own_size = sizeof own;
    socklen_t peer_size = sizeof peer;
    if (error == 0 && getsockname(fd, (struct sockaddr *)&own, &own_size) == 0 &&
        getpeername(fd, (struct sockaddr *)&peer, &peer_size) == 0 && own_size == peer_size &&
        memcmp(&own, &peer, own_size) == 0) {
        error = ECONNREFUSED;
    }
    if (error != 0) {
        (void)close(fd);
        return error;
    }
    /* From here on only the loop decides what waits, call by call. */
    (void)fcntl(fd, F_SETFL, fcntl(fd, F_GETFL) & ~O_NONBLOCK);
    client->bus.fd = fd;
    return 0;
}

static bool connect_to(struct socketcand_client *client, const char *host, const char *port)
{
    const int64_t deadline_ns = clock_now_ns() + (int64_t)CONNECT_LIMIT_MS * NS_PER_MS;
    const struct addrinfo hints = {.ai_family = AF_UNSPEC, .ai_socktype = SOCK_STREAM};
    bool told = false;
    for (;;) {
        struct addrinfo *addresses = NULL;
        const int status = getaddrinfo(host, port, &hints, &addresses);
        if (status != 0 && status != EAI_AGAIN) {
            (void)snprintf(client->bus.message, sizeof client->bus.message, "cannot find the host %s: %s",
                           host, gai_strerror(status));
            return false;
        }
        const char *reason = gai_strerror(status);
        for (const struct addrinfo *address = addresses; address != NULL; address = address->ai_next) {
            const int error = connect_once(client, address, deadline_ns);
            if (error == 0) {
                freeaddrinfo(addresses);
                return true;
            }
            reason = strerror(error);
        }
        if (addresses != NULL) {
            freeaddrinfo(addresses);
        }
        if (clock_now_ns() >= deadline_ns) {
            (void)snprintf(client->bus.message, sizeof client->bus.message,
                           "no socketcand server at %s within 10 s (%s); start it first, for example "
                           "sil_plant/run.py --bus tcp:%s",
                           client->name, reason, client->name);
            return false;
        }
        if (!told) {
            (void)fprintf(stderr, "waiting for a socketcand server at %s ...\n", client->name);
            told = true;
        }
        (void)poll(NULL, 0, RETRY_PAUSE_MS);
    }
}

/* Copies what came for the message of a failed handshake; control characters become dots. */
static void note_heard(const struct socketcand_client *client, char *heard, size_t *heard_bytes)
{
    for (size_t i = 0; i < client->received_bytes && *heard_bytes < HEARD_BYTES; i++) {
        const char byte = client->received[i];
        heard[(*heard_bytes)++] = byte;
        if (byte < ' ' || byte > '~') {
            heard[*heard_bytes - 1] = '.';
        }
    }
    heard[*heard_bytes] = '\0';
}

/* Waits for the answer `wanted`. Frames and malformed text before it are none of this bus's business yet. */
static bool expect(struct socketcand_client *client, enum socketcand_kind wanted, const char *wanted_text)
{
    const int64_t deadline_ns = clock_now_ns() + (int64_t)ANSWER_LIMIT_MS * NS_PER_MS;
    char heard[HEARD_BYTES + 1] = "";
    size_t heard_bytes = 0;
    struct socketcand_message message;
    for (;;) {
        while (next_message(client, &message) != SOCKETCAND_NOTHING) {
            if (message.kind == wanted) {
                return true;
            }
            if (message.kind == SOCKETCAND_ERROR) {
                go_down(client, BUS_REFUSED, "refused by", message.text);
                return false;
            }
        }
        const char *problem = NULL;
        if (!wait_for(client->bus.fd, POLLIN, deadline_ns)) {
            problem = "within 3 s";
        } else if (read_more(client) == READ_END) {
            problem = "before it closed the connection";
        } else {
            note_heard(client, heard, &heard_bytes);
        }
        if (problem != NULL) {
            (void)snprintf(client->bus.message, sizeof client->bus.message,
                           "no \"%s\" from %s %s, heard %s%s%s; is it a socketcand server?", wanted_text,
                           client->name, problem, heard_bytes > 0 ? "\"" : "",
                           heard_bytes > 0 ? heard : "nothing", heard_bytes > 0 ? "\"" : "");
            return false;
        }
    }
}

/* Sends a command of the handshake; a new connection takes these few bytes at once. */
static bool say(struct socketcand_client *client, const char *text)
{
    const size_t length = strlen(text);
    if (length == 0 || !make_room(client, length)) {
        (void)snprintf(client->bus.message, sizeof client->bus.message,
                       "the name of the CAN channel is too long");
        return false;
    }
    memcpy(client->transmit + client->queued_bytes, text, length);
    client->queued_bytes += length;
    return socketcand_flush(client) && client->bus.state == BUS_UP;
}

static bool shake_hands(struct socketcand_client *client, const char *channel)
{
    char open[SOCKETCAND_TEXT_BYTES];
    if (socketcand_format_open(channel, open, sizeof open) == 0) {
        open[0] = '\0';
    }
    return expect(client, SOCKETCAND_HI, "< hi >") && say(client, open) &&
           expect(client, SOCKETCAND_OK, "< ok >") && say(client, "< rawmode >") &&
           expect(client, SOCKETCAND_OK, "< ok >");
}

bool socketcand_open(struct socketcand_client *client, const char *host, const char *port,
                     const char *channel)
{
    memset(client, 0, sizeof *client);
    client->bus.port = (struct ecu_port){
        .context = client, .send = socketcand_send, .receive = socketcand_receive, .now_us = bus_now_us};
    client->bus.fd = -1;
    client->bus.flush = socketcand_flush;
    client->bus.close = socketcand_close;
    (void)snprintf(client->name, sizeof client->name, "%s:%s", host, port);
    if (!connect_to(client, host, port)) {
        client->bus.state = BUS_DOWN;
        return false;
    }
    const int on = 1;
    const int receive_bytes = BUS_SOCKET_BUFFER_BYTES;
    /* The kernel would let this grow to megabytes: seconds of old frames when the server stops reading. */
    const int transmit_bytes = SOCKETCAND_TRANSMIT_BYTES;
    (void)setsockopt(client->bus.fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    (void)setsockopt(client->bus.fd, SOL_SOCKET, SO_RCVBUF, &receive_bytes, sizeof receive_bytes);
    (void)setsockopt(client->bus.fd, SOL_SOCKET, SO_SNDBUF, &transmit_bytes, sizeof transmit_bytes);
    (void)setsockopt(client->bus.fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on);
    if (!shake_hands(client, channel)) {
        (void)close(client->bus.fd);
        client->bus.fd = -1;
        client->bus.state = client->bus.state == BUS_UP ? BUS_DOWN : client->bus.state;
        return false;
    }
    return true;
}
