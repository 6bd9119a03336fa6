#define _GNU_SOURCE
#include "ports/linux/loop.h"

#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <sys/epoll.h>
#include <sys/signalfd.h>
#include <sys/socket.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

#include "ports/linux/clock.h"

enum {
    STALL_LIMIT_MS = 100,         /* realtime and lockstep: a desktop may pause the plant that long */
    STRICT_DEADLINE_PERCENT = 40, /* of the period after SYNC; the valve frame is due at 50 % */
    SILENCE_NOTICE_S = 1,
    DEADLINE_REPEAT_NS = 500000, /* longer than a slow computer takes to deliver a signal */
    STOP_LIMIT_MS = 1000,        /* for a safe stop, from the signal on */
    SHUTDOWN_ATTEMPTS = 20,
    SHUTDOWN_PAUSE_MS = 1
};

/* What a wait may report, a bit each. */
enum { SOURCE_SIGNAL = 1, SOURCE_TIMER = 2, SOURCES_MAX = 2 };

struct loop {
    struct controller understudy; /* a copy that rehearses the law */
    enum pace pace;
    int64_t period_ns;
    struct ecu *ecu;
    struct bus *bus;
    struct loop_stats *stats;
    int signal_fd;
    int timer_fd;           /* begins ticks */
    timer_t deadline_timer; /* ends the wait inside a strict tick, by a signal */
    bool has_deadline_timer;
    int pause_epoll;         /* between ticks: signal, timer. Frames wait in the socket */
    int64_t start_ns;        /* when the present tick began or should have begun */
    bool stopping;           /* the first signal has come */
    bool stopping_at_once;   /* the second, too */
    int64_t stop_limit_ns;   /* when `stopping` ends whatever the valves do */
    bool pause_told;         /* that the bus passes no frames */
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

static bool watch(int epoll_fd, int fd, uint32_t source)
{
    struct epoll_event event = {.events = EPOLLIN, .data.u32 = source};
    return epoll_ctl(epoll_fd, EPOLL_CTL_ADD, fd, &event) == 0;
}

/* The sources that are ready in the pause between ticks, 0 after the timeout (-1: none). */
static uint32_t wait_in_pause(const struct loop *loop, int timeout_ms)
{
    struct epoll_event events[SOURCES_MAX];
    const int count = epoll_wait(loop->pause_epoll, events, SOURCES_MAX, timeout_ms);
    uint32_t sources = 0;
    for (int i = 0; i < count; i++) {
        sources |= events[i].data.u32;
    }
    return sources;
}

/* The deadline of a strict tick has no more to do than to end a read that waits. */
static void note_deadline(int number)
{
    (void)number;
}

static bool open_deadline_timer(struct loop *loop)
{
    const struct sigaction action = {.sa_handler = note_deadline}; /* no SA_RESTART */
    struct sigevent event = {.sigev_notify = SIGEV_SIGNAL, .sigev_signo = SIGALRM};
    loop->has_deadline_timer = sigaction(SIGALRM, &action, NULL) == 0 &&
                               timer_create(CLOCK_MONOTONIC, &event, &loop->deadline_timer) == 0;
    return loop->has_deadline_timer;
}

/* Again and again from the absolute time on, for the case that the read had not begun yet; 0: never. */
static void set_deadline(const struct loop *loop, int64_t deadline_ns)
{
    const struct itimerspec when = {.it_value = to_timespec(deadline_ns),
                                    .it_interval = to_timespec(DEADLINE_REPEAT_NS)};
    (void)timer_settime(loop->deadline_timer, TIMER_ABSTIME, &when, NULL);
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
    const struct timeval stall_limit = {.tv_usec = STALL_LIMIT_MS * 1000};
    loop->signal_fd = signalfd(-1, &signals, SFD_NONBLOCK | SFD_CLOEXEC);
    loop->timer_fd = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC);
    loop->pause_epoll = epoll_create1(EPOLL_CLOEXEC);
    return loop->signal_fd >= 0 && loop->timer_fd >= 0 &&
           watch(loop->pause_epoll, loop->signal_fd, SOURCE_SIGNAL) &&
           watch(loop->pause_epoll, loop->timer_fd, SOURCE_TIMER) &&
           setsockopt(loop->bus->fd, SOL_SOCKET, SO_RCVTIMEO, &stall_limit, sizeof stall_limit) == 0 &&
           (loop->pace != PACE_STRICT || open_deadline_timer(loop));
}

static void close_descriptors(const struct loop *loop)
{
    const int descriptors[] = {loop->signal_fd, loop->timer_fd, loop->pause_epoll};
    for (size_t i = 0; i < sizeof descriptors / sizeof descriptors[0]; i++) {
        if (descriptors[i] >= 0) {
            (void)close(descriptors[i]);
        }
    }
    if (loop->has_deadline_timer) {
        (void)timer_delete(loop->deadline_timer);
    }
}

/* Takes the signals that have come. */
static void note_signals(struct loop *loop)
{
    struct signalfd_siginfo signal;
    while (read(loop->signal_fd, &signal, sizeof signal) == (ssize_t)sizeof signal) {
        if (loop->stopping) {
            loop->stopping_at_once = true;
        } else {
            loop->stopping = true;
            loop->stop_limit_ns = clock_now_ns() + (int64_t)STOP_LIMIT_MS * NS_PER_MS;
            ecu_request_safe_stop(loop->ecu);
        }
    }
}

/* As wait_in_pause, with the signals taken. */
static uint32_t wait_and_note_signals(struct loop *loop, int timeout_ms)
{
    const uint32_t sources = wait_in_pause(loop, timeout_ms);
    if ((sources & SOURCE_SIGNAL) != 0) {
        note_signals(loop);
    }
    return sources;
}

/* The bus may come up again, or be up. */
static bool is_alive(const struct bus *bus)
{
    return bus->state == BUS_UP || bus->state == BUS_PAUSED;
}

static bool is_over(const struct loop *loop)
{
    return !is_alive(loop->bus) || loop->stopping_at_once ||
           (loop->stopping && (ecu_valves_shut(loop->ecu) || clock_now_ns() >= loop->stop_limit_ns));
}

/* Waits for the timer, or the second signal. */
static void wait_for_timer(struct loop *loop)
{
    uint32_t sources;
    do {
        sources = wait_and_note_signals(loop, -1);
    } while ((sources & SOURCE_TIMER) == 0 && !loop->stopping_at_once);
}

/* The time is that of the start, not of the end of the last period: no drift. */
static void wait_for_strict_start(struct loop *loop)
{
    uint64_t expirations = 0;
    wait_for_timer(loop);
    if (read(loop->timer_fd, &expirations, sizeof expirations) > 0) {
        const uint64_t missed = expirations - 1;
        loop->start_ns += (int64_t)expirations * loop->period_ns;
        loop->stats->late_ticks += missed;
        if (missed > 0) {
            ecu_note_late_start(loop->ecu, missed < UINT32_MAX ? (uint32_t)missed : UINT32_MAX);
        }
    }
}

/* Waits until the next tick is due. */
static void wait_for_start(struct loop *loop)
{
    if (loop->pace == PACE_STRICT) {
        wait_for_strict_start(loop);
        return;
    }
    const int64_t now_ns = clock_now_ns();
    const int64_t due_ns = loop->start_ns + loop->period_ns;
    if (loop->pace == PACE_LOCKSTEP || now_ns >= due_ns || !arm(loop->timer_fd, due_ns, 0)) {
        /* Overrun: the whole run shifts. Ticks in a burst would differ from those of a faster machine. */
        loop->stats->late_ticks += loop->pace == PACE_REALTIME && now_ns > due_ns;
        loop->start_ns = now_ns;
        (void)wait_and_note_signals(loop, 0);
        return;
    }
    loop->start_ns = due_ns;
    wait_for_timer(loop);
}

/* Hands the collected frames over. Those that the bus does not take now go with the next. */
static void flush(struct loop *loop)
{
    (void)loop->bus->flush(loop->bus->port.context);
}

/* Takes the frames that are here, or waits for some; true once the sensors of this tick are complete. */
static bool take_frames(struct loop *loop, bool may_wait)
{
    bool complete;
    loop->bus->may_wait = may_wait;
    do {
        complete = ecu_tick_receive(loop->ecu, &loop->bus->port);
    } while (!complete && !loop->bus->drained && is_alive(loop->bus));
    return complete;
}

/* Says it when the bus stops to pass frames, and when it goes on. */
static void note_bus(struct loop *loop)
{
    const bool paused = loop->bus->state == BUS_PAUSED;
    if (paused != loop->pause_told && is_alive(loop->bus)) {
        (void)fprintf(stderr, "diarc_ecu: %s\n", loop->bus->message);
        loop->pause_told = paused;
    }
}

/* A run that hangs at its start because nobody answers should say so. */
static void note_completeness(struct loop *loop, bool complete)
{
    loop->stats->stalled_ticks += !complete;
    if (complete || loop->bus->state != BUS_UP) {
        loop->silent_since_ns = 0;
        loop->silence_told = false;
        return;
    }
    const int64_t now_ns = clock_now_ns();
    if (loop->silent_since_ns == 0) {
        loop->silent_since_ns = now_ns;
    }
    if (!loop->silence_told && now_ns - loop->silent_since_ns >= (int64_t)SILENCE_NOTICE_S * NS_PER_S) {
        (void)fputs("diarc_ecu: no sensor frames for 1 s, still waiting; is the plant running on this bus?\n",
                    stderr);
        loop->silence_told = true;
    }
}

/* The sensors are gone for good, and the valves still open: now time counts, and not that the run goes on. The safe
 * stop ramps at the pace of the ticks, which would otherwise all take as long as a stall may. */
static bool sensors_given_up(const struct loop *loop)
{
    return loop->pace != PACE_STRICT && !ecu_valves_shut(loop->ecu) && supervision_sensors_gone(loop->ecu);
}

/* As gather, to the deadline exactly: the time limit of the socket is as coarse as the kernel's ticks. */
static bool gather_in_time(struct loop *loop, int64_t deadline_ns)
{
    bool complete = take_frames(loop, false);
    for (int64_t left_ns = deadline_ns - clock_now_ns(); !complete && left_ns > 0 && is_alive(loop->bus);
         left_ns = deadline_ns - clock_now_ns()) {
        struct pollfd frames = {.fd = loop->bus->fd, .events = POLLIN};
        const struct timespec left = to_timespec(left_ns);
        (void)ppoll(&frames, 1, &left, NULL);
        complete = take_frames(loop, false);
        flush(loop);
    }
    return complete;
}

/* Waits for the sensor frames until the deadline; true when all are here. From the last of them to the valve frame
 * there are two calls of the kernel, as few as can be: one read that waits, and takes all frames there are, and one
 * write. A signal to stop is noticed after the tick. */
static bool gather(struct loop *loop, int64_t deadline_ns)
{
    while (!take_frames(loop, true)) {
        flush(loop); /* answers, such as an emergency */
        if (clock_now_ns() >= deadline_ns || !is_alive(loop->bus)) {
            /* Asked once more: this process may have been paused while they came. */
            return is_alive(loop->bus) && take_frames(loop, false);
        }
    }
    return true;
}

static void run_tick(struct loop *loop)
{
    const bool strict = loop->pace == PACE_STRICT;
    const int64_t now_ns = clock_now_ns();
    const int64_t limit_ns =
        strict ? loop->period_ns * STRICT_DEADLINE_PERCENT / 100 : (int64_t)STALL_LIMIT_MS * NS_PER_MS;
    if (loop->pace != PACE_LOCKSTEP) {
        time_histogram_add(&loop->stats->start_times, (uint32_t)((now_ns - loop->start_ns) / NS_PER_US));
    }
    loop->stats->ticks++;
    ecu_tick_begin(loop->ecu, &loop->bus->port);
    flush(loop);
    if (strict) {
        set_deadline(loop, now_ns + limit_ns);
    }
    if (loop->pace != PACE_LOCKSTEP) {
        ecu_rehearse(loop->ecu, &loop->understudy);
    }
    const bool complete = sensors_given_up(loop) ? gather_in_time(loop, now_ns + loop->period_ns)
                                                 : gather(loop, now_ns + limit_ns);
    if (is_alive(loop->bus)) {
        ecu_tick_end(loop->ecu, &loop->bus->port);
        flush(loop);
        note_completeness(loop, complete);
    }
    if (strict) {
        set_deadline(loop, 0);
    }
    note_bus(loop);
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
    static struct loop loop; /* one loop a process; too large for a stack */
    loop = (struct loop){
        .pace = pace,
        .period_ns = (int64_t)period_us * NS_PER_US,
        .ecu = ecu,
        .bus = bus,
        .stats = stats,
        .signal_fd = -1,
        .timer_fd = -1,
        .pause_epoll = -1,
    };
    loop.start_ns = clock_now_ns();
    if (!open_descriptors(&loop) ||
        (pace == PACE_STRICT && !arm(loop.timer_fd, loop.start_ns + loop.period_ns, loop.period_ns))) {
        const int error = errno;
        close_descriptors(&loop);
        errno = error;
        return LOOP_FAILED;
    }
    while (!is_over(&loop)) {
        wait_for_start(&loop);
        if (!is_over(&loop)) {
            run_tick(&loop);
        }
    }
    stats->shutdown_sent = shut_down(&loop);
    close_descriptors(&loop);
    return loop.stopping ? LOOP_STOPPED : LOOP_BUS_DOWN;
}
