/* The rounds of the latency measurement that the echo program answers: as the ECU's ticks, but for the work. The
 * probe asks, the echo program begins (as the ECU does with SYNC), the probe sends as many frames as there are
 * sensor frames, and the echo program answers the last of them (as the ECU does with the valve frame). */
#ifndef TOOLS_LATENCY_ROUNDS_H
#define TOOLS_LATENCY_ROUNDS_H

/* Behind every identifier that CANopen gives to a node. */
enum {
    ROUND_ASK_ID = 0x7F0,
    ROUND_BEGIN_ID = 0x7F1,
    ROUND_FIRST_ID = 0x7F2,
    ROUND_MIDDLE_ID = 0x7F3,
    ROUND_LAST_ID = 0x7F4,
    ROUND_ANSWER_ID = 0x7F5
};

/* The priority that the ECU asks for (ports/linux/realtime.c), so that both are scheduled alike. */
enum { ROUND_FIFO_PRIORITY = 49 };

/* The channel by which a socketcand server knows the echo program. */
#define ROUND_CHANNEL "echo"

#endif
