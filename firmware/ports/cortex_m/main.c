/* The ECU on a Cortex-M. All of it runs here, in the main loop: SYNC, frames, law. Interrupts only move
 * bytes between the UART and its rings, and count periods; so the law never runs inside an interrupt, and
 * nothing that the law waits for is held up by it. */
#include <stddef.h>

#include "ecu/ecu.h"
#include "ports/cortex_m/clock.h"
#include "ports/cortex_m/measure.h"
#include "ports/cortex_m/registers.h"
#include "ports/cortex_m/slcan.h"
#include "ports/cortex_m/uart.h"
#include "ports/cortex_m/watchdog.h"

/* When ticks begin and how long they wait for the sensors; as on Linux. */
#define PACE_REALTIME 1 /* on the timer, and every tick waits for its sensor frames */
#define PACE_STRICT 2   /* on the timer alone: late frames are lost frames */
#define PACE_LOCKSTEP 3 /* realtime without the timer */

#define PERIOD_US 1000u
#define STALL_LIMIT_US 250000u   /* realtime and lockstep; the plant gives the ECU up after twice that */
#define STRICT_LIMIT_PERCENT 40u /* of the period after SYNC; the valve frame is due at 50 % */

static struct ecu the_ecu; /* static: too large for the stack */

static const struct ecu_port the_port = {
    .context = NULL, .send = slcan_send, .receive = slcan_receive, .now_us = clock_port_now_us};

/* Until a line has come since the caller read `lines`, or a period has begun since it read `period`. */
static void sleep(uint32_t lines, uint32_t period)
{
    while (uart_lines() == lines && clock_periods() == period) {
        interrupts_disable(); /* what comes from here on ends the sleep at once */
        if (uart_lines() == lines && clock_periods() == period) {
            wait_for_interrupt();
        }
        interrupts_enable();
    }
}

static void wait_until_open(void)
{
    while (!slcan_is_open()) {
        struct can_frame_11bit frame;
        const uint32_t lines = uart_lines();
        const uint32_t period = clock_periods();
        (void)slcan_receive(NULL, &frame);
        watchdog_feed();
        if (!slcan_is_open()) {
            sleep(lines, period);
        }
    }
}

/* Until the period after `last` has begun; frames that come meanwhile wait in the UART's ring. */
static void wait_for_timer(uint32_t last)
{
    while (clock_periods() == last) {
        sleep(uart_lines(), last);
    }
}

static void run_tick(void)
{
    const uint32_t limit_us =
        DIARC_PACE == PACE_STRICT ? PERIOD_US * STRICT_LIMIT_PERCENT / 100u : STALL_LIMIT_US;
    (void)measure_switch(STAGE_FRAMES);
    const uint32_t begin_us = clock_port_now_us(NULL);
    ecu_tick_begin(&the_ecu, &the_port);

    bool complete = false;
    bool expired = false;
    while (!complete && !expired && slcan_is_open()) {
        const uint32_t lines = uart_lines();
        const uint32_t period = clock_periods();
        expired = clock_port_now_us(NULL) - begin_us >= limit_us;
        (void)measure_switch(STAGE_RECEIVE);
        complete = ecu_tick_receive(&the_ecu, &the_port);
        (void)measure_switch(STAGE_WAIT);
        /* a period is too coarse for the strict limit */
        if (!complete && !expired && DIARC_PACE != PACE_STRICT) {
            sleep(lines, period);
        }
    }
    (void)measure_switch(STAGE_FRAMES);
    ecu_tick_end(&the_ecu, &the_port);
    (void)measure_switch(STAGE_WAIT);
    measure_end_tick();
}

/* From the opening of the channel until it closes: an ECU from power-on to power-off. */
static void run(void)
{
    uint16_t entry;
    if (ecu_init(&the_ecu, NULL, PERIOD_US, &entry) != ECU_OK) {
        for (;;) { /* the image's own parameters are wrong: no watchdog is fed */
        }
    }
    const uint32_t opening = slcan_openings();
    uint32_t period = clock_periods();
    while (slcan_is_open() && slcan_openings() == opening) {
        if (DIARC_PACE != PACE_LOCKSTEP) {
            wait_for_timer(period);
        }
        period = clock_periods();
        run_tick();
        watchdog_feed();
    }
}

int main(void)
{
    clock_start(PERIOD_US);
    measure_start();
    uart_start();
    for (;;) {
        wait_until_open();
        run();
    }
}
