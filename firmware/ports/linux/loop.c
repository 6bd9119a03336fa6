#define _GNU_SOURCE
#include "ports/linux/loop.h"

#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <sys/epoll.h>
#include <sys/signalfd.h>
#include <sys/timerfd.h>
#include <unistd.h>

#include "ports/linux/clock.h"

enum {
    STALL_LIMIT_MS = 100,         /* realtime and lockstep: a desktop may pause the plant that long */
    STRICT_DEADLINE_PERCENT = 40, /* of the period after SYNC; the valve frame is due at 50 % */
    SILENCE_NOTICE_S = 1,
    SHUTDOWN_ATTEMPTS = 20,
    SHUTDOWN_PAUSE_MS = 1
};

/* What a wait may report, a bit each. */
enum { SOURCE_SIGNAL = 1, SOURCE_TIMER = 2, SOURCE_BUS = 4, SOURCE_DEADLINE = 8, SOURCES_MAX = 4 };

struct loop {
    enum pace pace;
    int64_t period_ns;
    struct ecu *ecu;
    struct bus *bus;
    struct loop_stats *stats;
    int signal_fd;
    int timer_fd;    /* begins ticks */
    int deadline_fd; /* ends the wait inside a strict tick: epoll_wait counts in ms, too coarse for that */
    int pause_epoll; /* between ticks: signal, timer. Frames wait in the socket */
    int tick_epoll;  /* inside a tick: signal, bus, deadline */
    bool bus_writable_wanted;
    int64_t start_ns;        /* when the present tick began or should have begun */
    int64_t silent_since_ns; /* first of the ticks in a row without all sensor frames, 0: the last had all */
    bool silence_told;
};

const char *pace_name(enum pace pace)
{
    switch (pace) {
    case PACE_STRICT:
        return "strict";
    case PACE_LOCKSTEP:
        return "lockstep";
    case PACE_REALTIME:
        break;
    }
    return "realtime";
}

static struct timespec to_timespec(int64_t time_ns)
{
    return (struct timespec){.tv_sec = (time_t)(time_ns / NS_PER_S), .tv_nsec = (long)(time_ns % NS_PER_S)};
}

/* First at the absolute time, then every `interval_ns` (0: never again). */
static bool arm(int timer_fd, int64_t first_ns, int64_t interval_ns)
{
    const struct itimerspec when = {.it_value = to_timespec(first_ns),
                                    .it_interval = to_timespec(interval_ns)};
    return timerfd_settime(timer_fd, TFD_TIMER_ABSTIME, &when, NULL) == 0;
}

static bool watch(int epoll_fd, int operation, int fd, uint32_t source, uint32_t events)
{
    struct epoll_event event = {.events = events, .data.u32 = source};
    return epoll_ctl(epoll_fd, operation, fd, &event) == 0;
}

/* The sources that are ready, 0 after the timeout (-1: none). */
static uint32_t wait_for(int epoll_fd, int timeout_ms)
{
    struct epoll_event events[SOURCES_MAX];
    const int count = epoll_wait(epoll_fd, events, SOURCES_MAX, timeout_ms);
    uint32_t sources = 0;
    for (int i = 0; i < count; i++) {
        sources |= events[i].data.u32;
    }
    return sources;
}

static bool open_descriptors(struct loop *loop)
{
    sigset_t signals;
    (void)sigemptyset(&signals);
    (void)sigaddset(&signals, SIGINT);
    (void)sigaddset(&signals, SIGTERM);
    (void)sigaddset(&signals, SIGHUP);
    if (sigprocmask(SIG_BLOCK, &signals, NULL) < 0) {
        return false;
    }
    loop->signal_fd = signalfd(-1, &signals, SFD_NONBLOCK | SFD_CLOEXEC);
    loop->timer_fd = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC);
    loop->deadline_fd = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC);
    loop->pause_epoll = epoll_create1(EPOLL_CLOEXEC);
    loop->tick_epoll = epoll_create1(EPOLL_CLOEXEC);
    return loop->signal_fd >= 0 && loop->timer_fd >= 0 && loop->deadline_fd >= 0 &&
           watch(loop->pause_epoll, EPOLL_CTL_ADD, loop->signal_fd, SOURCE_SIGNAL, EPOLLIN) &&
           watch(loop->pause_epoll, EPOLL_CTL_ADD, loop->timer_fd, SOURCE_TIMER, EPOLLIN) &&
           watch(loop->tick_epoll, EPOLL_CTL_ADD, loop->signal_fd, SOURCE_SIGNAL, EPOLLIN) &&
           watch(loop->tick_epoll, EPOLL_CTL_ADD, loop->deadline_fd, SOURCE_DEADLINE, EPOLLIN) &&
           watch(loop->tick_epoll, EPOLL_CTL_ADD, loop->bus->fd, SOURCE_BUS, EPOLLIN);
}

static void close_descriptors(const struct loop *loop)
{
    const int descriptors[] = {loop->signal_fd, loop->timer_fd, loop->deadline_fd, loop->pause_epoll,
                               loop->tick_epoll};
    for (size_t i = 0; i < sizeof descriptors / sizeof descriptors[0]; i++) {
        if (descriptors[i] >= 0) {
            (void)close(descriptors[i]);
        }
    }
}

/* Waits until the next tick is due. False: a signal came. */
static bool wait_for_start(struct loop *loop)
{
    if (loop->pace == PACE_LOCKSTEP) {
        return (wait_for(loop->pause_epoll, 0) & SOURCE_SIGNAL) == 0;
    }
    if (loop->pace == PACE_REALTIME) {
        const int64_t due_ns = loop->start_ns + loop->period_ns;
        const int64_t now_ns = clock_now_ns();
        if (now_ns >= due_ns) {
            /* Overrun: the whole run shifts. Ticks in a burst would differ from those of a faster machine. */
            loop->stats->late_ticks += now_ns > due_ns;
            loop->start_ns = now_ns;
            return (wait_for(loop->pause_epoll, 0) & SOURCE_SIGNAL) == 0;
        }
        loop->start_ns = due_ns;
        if (!arm(loop->timer_fd, due_ns, 0)) {
            return false;
        }
    }
    uint32_t sources;
    do {
        sources = wait_for(loop->pause_epoll, -1);
    } while (sources == 0);
    uint64_t expirations = 0;
    if (loop->pace == PACE_STRICT && read(loop->timer_fd, &expirations, sizeof expirations) > 0) {
        loop->stats->late_ticks += expirations - 1;
    }
    return (sources & SOURCE_SIGNAL) == 0;
}

/* Hands the collected frames over, and watches for room as long as some are left. */
static void flush(struct loop *loop)
{
    const bool wanted = !loop->bus->flush(loop->bus->port.context);
    if (wanted != loop->bus_writable_wanted) {
        const uint32_t events = wanted ? EPOLLIN | EPOLLOUT : EPOLLIN;
        (void)watch(loop->tick_epoll, EPOLL_CTL_MOD, loop->bus->fd, SOURCE_BUS, events);
        loop->bus_writable_wanted = wanted;
    }
}

/* Takes the frames that are here; true once the sensors of this tick are complete. The bus may hold frames
 * that its descriptor does not show, so this goes on until the bus says that it has none. */
static bool take_frames(struct loop *loop)
{
    bool complete;
    do {
        complete = ecu_tick_receive(loop->ecu, &loop->bus->port);
    } while (!complete && !loop->bus->drained && loop->bus->state == BUS_UP);
    return complete;
}

/* A run that hangs at its start because nobody answers should say so. */
static void note_completeness(struct loop *loop, bool complete)
{
    if (complete) {
        loop->silent_since_ns = 0;
        loop->silence_told = false;
        return;
    }
    const int64_t now_ns = clock_now_ns();
    loop->stats->stalled_ticks++;
    if (loop->silent_since_ns == 0) {
        loop->silent_since_ns = now_ns;
    }
    if (!loop->silence_told && now_ns - loop->silent_since_ns >= (int64_t)SILENCE_NOTICE_S * NS_PER_S) {
        (void)fputs("diarc_ecu: no sensor frames for 1 s, still waiting; is the plant running on this bus?\n",
                    stderr);
        loop->silence_told = true;
    }
}

/* One tick. False: a signal came, and the tick was left open. */
static bool run_tick(struct loop *loop)
{
    const bool strict = loop->pace == PACE_STRICT;
    const int64_t limit_ns =
        strict ? loop->period_ns * STRICT_DEADLINE_PERCENT / 100 : (int64_t)STALL_LIMIT_MS * NS_PER_MS;
    const int64_t deadline_ns = clock_now_ns() + limit_ns;
    loop->stats->ticks++;
    ecu_tick_begin(loop->ecu, &loop->bus->port);
    flush(loop);
    if (strict) {
        (void)arm(loop->deadline_fd, deadline_ns, 0);
    }

    /* Past the deadline the frames are asked once more: this process may have been paused while they came. */
    bool complete = false;
    bool expired = false;
    while (!complete && !expired && loop->bus->state == BUS_UP) {
        const int64_t left_ns = deadline_ns - clock_now_ns();
        expired = left_ns <= 0;
        complete = take_frames(loop);
        flush(loop);
        if (!complete && !expired && loop->bus->state == BUS_UP) {
            const int timeout_ms = strict ? -1 : (int)((left_ns + NS_PER_MS - 1) / NS_PER_MS);
            if ((wait_for(loop->tick_epoll, timeout_ms) & SOURCE_SIGNAL) != 0) {
                return false;
            }
        }
    }
    if (loop->bus->state == BUS_UP) {
        note_completeness(loop, complete);
        ecu_tick_end(loop->ecu, &loop->bus->port);
        flush(loop);
    }
    return true;
}

/* Tells the valves to close. This is the one frame worth repeating when the bus is busy. */
static bool shut_down(struct loop *loop)
{
    for (int attempt = 0; attempt < SHUTDOWN_ATTEMPTS && loop->bus->state == BUS_UP; attempt++) {
        const uint64_t drops_before = loop->bus->stats.send_drops;
        ecu_shutdown(loop->ecu, &loop->bus->port);
        flush(loop);
        if (loop->bus->stats.send_drops == drops_before) {
            return true;
        }
        (void)poll(NULL, 0, SHUTDOWN_PAUSE_MS);
    }
    return false;
}

enum loop_end loop_run(enum pace pace, uint32_t period_us, struct ecu *ecu, struct bus *bus,
                       struct loop_stats *stats)
{
    *stats = (struct loop_stats){0};
    struct loop loop = {
        .pace = pace,
        .period_ns = (int64_t)period_us * NS_PER_US,
        .ecu = ecu,
        .bus = bus,
        .stats = stats,
        .signal_fd = -1,
        .timer_fd = -1,
        .deadline_fd = -1,
        .pause_epoll = -1,
        .tick_epoll = -1,
    };
    loop.start_ns = clock_now_ns();
    if (!open_descriptors(&loop) ||
        (pace == PACE_STRICT && !arm(loop.timer_fd, loop.start_ns + loop.period_ns, loop.period_ns))) {
        const int error = errno;
        close_descriptors(&loop);
        errno = error;
        return LOOP_FAILED;
    }
    while (bus->state == BUS_UP && wait_for_start(&loop) && run_tick(&loop)) {
    }
    const enum loop_end end = bus->state == BUS_UP ? LOOP_STOPPED : LOOP_BUS_DOWN;
    stats->shutdown_sent = end == LOOP_STOPPED && shut_down(&loop);
    close_descriptors(&loop);
    return end;
}
