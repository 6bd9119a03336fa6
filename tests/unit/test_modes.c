/* The table of modes (ecu/modes) against rules written down here on their own: every mode, event and combination of
 * conditions. */
#include "ecu/modes.h"
#include "testing.h"

static const enum ecu_mode MODES[] = {MODE_INIT,       MODE_STANDBY, MODE_RUN,       MODE_TARE,
                                      MODE_COMMISSION, MODE_HOLD,    MODE_SAFE_STOP, MODE_FAULT};

void setUp(void)
{
}

void tearDown(void)
{
}

struct answer {
    enum ecu_mode next;
    enum ecu_refusal refusal;
};

static struct answer go(enum ecu_mode next)
{
    return (struct answer){next, REFUSAL_NONE};
}

static struct answer stay(enum ecu_mode mode, enum ecu_refusal refusal)
{
    return (struct answer){mode, refusal};
}

static struct mode_conditions combination(unsigned bits)
{
    return (struct mode_conditions){.operational = (bits & 1u) != 0u,
                                    .sensors_good = (bits & 2u) != 0u,
                                    .fault_active = (bits & 4u) != 0u,
                                    .cause_gone = (bits & 8u) != 0u};
}

static bool under_the_law(enum ecu_mode mode)
{
    return mode == MODE_RUN || mode == MODE_COMMISSION || mode == MODE_HOLD;
}

/* A start needs the network first, then whole and good samples. */
static struct answer start(enum ecu_mode from, enum ecu_mode to, const struct mode_conditions *c)
{
    if (!c->operational) {
        return stay(from, REFUSAL_NOT_OPERATIONAL);
    }
    return c->sensors_good ? go(to) : stay(from, REFUSAL_SENSORS_NOT_FRESH);
}

/* Where a start cannot be: while the arm is being stopped, and everywhere else but in STANDBY. */
static struct answer out_of_place(enum ecu_mode mode)
{
    return stay(mode, mode == MODE_SAFE_STOP ? REFUSAL_STOPPING : REFUSAL_NOT_IN_STANDBY);
}

/* Whatever drives the valves ends in STANDBY, or in FAULT when it was a fault that stopped it. */
static struct answer end_of_motion(const struct mode_conditions *c)
{
    return go(c->fault_active ? MODE_FAULT : MODE_STANDBY);
}

static struct answer rule_of_request(enum ecu_mode mode, enum ecu_event event,
                                     const struct mode_conditions *c)
{
    const bool standby = mode == MODE_STANDBY;
    switch (event) {
    case EVENT_STANDBY: /* stopping is never refused, and never leaves FAULT or INIT */
    case EVENT_SAFE_STOP:
        if (under_the_law(mode)) {
            return go(MODE_SAFE_STOP);
        }
        return go(mode == MODE_TARE ? MODE_STANDBY : mode);
    case EVENT_RUN: /* from rest, or on from HOLD */
        return standby || mode == MODE_HOLD ? start(mode, MODE_RUN, c) : out_of_place(mode);
    case EVENT_COMMISSION:
        return standby ? start(mode, MODE_COMMISSION, c) : out_of_place(mode);
    case EVENT_HOLD: /* braking is always possible; from rest it is a start */
        if (mode == MODE_RUN || mode == MODE_HOLD) {
            return go(MODE_HOLD);
        }
        return standby ? start(mode, MODE_HOLD, c) : out_of_place(mode);
    case EVENT_TARE: /* needs the network; samples are counted as they come */
        if (!standby) {
            return out_of_place(mode);
        }
        return c->operational ? go(MODE_TARE) : stay(mode, REFUSAL_NOT_OPERATIONAL);
    default: /* RESET_FAULT: only FAULT can be reset, with good sensors and without its cause; NMT does not matter */
        if (mode != MODE_FAULT) {
            return stay(mode, REFUSAL_NO_FAULT_TO_RESET);
        }
        if (!c->sensors_good) {
            return stay(mode, REFUSAL_SENSORS_NOT_FRESH);
        }
        return c->cause_gone ? go(MODE_INIT) : stay(mode, REFUSAL_CAUSE_PERSISTS);
    }
}

static struct answer rule_of_own_event(enum ecu_mode mode, enum ecu_event event,
                                       const struct mode_conditions *c)
{
    const bool shut = mode == MODE_STANDBY || mode == MODE_TARE;
    switch (event) {
    case EVENT_FAULT_OFF: /* from everywhere */
        return go(MODE_FAULT);
    case EVENT_FAULT_STOP: /* only a moving arm is stopped; one that stops goes on doing so */
        return go(under_the_law(mode) ? MODE_SAFE_STOP : mode);
    case EVENT_NMT_LEFT: /* no process frames may be sent: nothing that needs them goes on */
        if (mode == MODE_SAFE_STOP) {
            return end_of_motion(c);
        }
        return go(under_the_law(mode) || mode == MODE_TARE ? MODE_STANDBY : mode);
    case EVENT_SENSORS_READY:
        if (mode == MODE_INIT) {
            return c->operational ? go(MODE_STANDBY) : stay(mode, REFUSAL_NOT_OPERATIONAL);
        }
        return go(mode);
    case EVENT_SENSORS_GONE: /* under way it is a fault, not a change of mode */
        return go(shut ? MODE_INIT : mode);
    case EVENT_TARE_DONE:
        return go(mode == MODE_TARE ? MODE_STANDBY : mode);
    default: /* STOPPED */
        return mode == MODE_SAFE_STOP ? end_of_motion(c) : go(mode);
    }
}

static struct answer table(enum ecu_mode mode, enum ecu_event event, const struct mode_conditions *c)
{
    struct answer answer = {.next = (enum ecu_mode)14};
    answer.refusal = modes_next(mode, event, c, &answer.next);
    return answer;
}

static void test_a_transition_is_none_of_the_rules(void)
{
    /* GIVEN every mode, event and combination of conditions WHEN the table is asked THEN mode and refusal are those
     * of the rules */
    unsigned asked = 0;
    for (unsigned m = 0; m < COUNT_OF(MODES); m++) {
        for (unsigned e = 0; e < EVENTS; e++) {
            for (unsigned bits = 0; bits < 16; bits++) {
                const struct mode_conditions c = combination(bits);
                const enum ecu_event event = (enum ecu_event)e;
                const struct answer rule = event <= EVENT_RESET_FAULT
                                               ? rule_of_request(MODES[m], event, &c)
                                               : rule_of_own_event(MODES[m], event, &c);
                const struct answer found = table(MODES[m], event, &c);
                char which[80];
                (void)snprintf(which, sizeof which, "mode %d event %u conditions %u", (int)MODES[m], e, bits);
                TEST_ASSERT_EQUAL_INT_MESSAGE(rule.next, found.next, which);
                TEST_ASSERT_EQUAL_INT_MESSAGE(rule.refusal, found.refusal, which);
                asked++;
            }
        }
    }
    TEST_ASSERT_EQUAL_UINT(8 * 14 * 16, asked);
}

static void test_a_refusal_changes_the_mode(void)
{
    /* GIVEN everything that can be asked WHEN it is refused THEN the mode stays */
    for (unsigned m = 0; m < COUNT_OF(MODES); m++) {
        for (unsigned e = 0; e < EVENTS; e++) {
            for (unsigned bits = 0; bits < 16; bits++) {
                const struct mode_conditions c = combination(bits);
                const struct answer found = table(MODES[m], (enum ecu_event)e, &c);
                TEST_ASSERT_TRUE(found.refusal == REFUSAL_NONE || found.next == MODES[m]);
            }
        }
    }
}

static void test_valves_open_past_the_network_or_a_fault(void)
{
    /* GIVEN everything that can be asked WHEN valves are shut THEN nothing opens them but RUN, COMMISSION and HOLD, with
     * the network operational and good sensors, and only from STANDBY; and nothing opens them on the way to a stop */
    for (unsigned m = 0; m < COUNT_OF(MODES); m++) {
        for (unsigned e = 0; e < EVENTS; e++) {
            for (unsigned bits = 0; bits < 16; bits++) {
                const struct mode_conditions c = combination(bits);
                const struct answer found = table(MODES[m], (enum ecu_event)e, &c);
                if (!mode_drives(MODES[m]) && mode_drives(found.next)) {
                    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, MODES[m]);
                    TEST_ASSERT_TRUE(e == EVENT_RUN || e == EVENT_COMMISSION || e == EVENT_HOLD);
                    TEST_ASSERT_TRUE(c.operational && c.sensors_good);
                }
                if (MODES[m] == MODE_SAFE_STOP) {
                    TEST_ASSERT_FALSE(under_the_law(found.next));
                }
            }
        }
    }
}

static void test_a_mode_cannot_be_reached_or_left(void)
{
    /* GIVEN the ECU just on WHEN all that can come comes THEN every mode is reached from INIT, and INIT from every mode */
    for (unsigned from = 0; from < COUNT_OF(MODES); from++) {
        bool reached[16] = {false};
        reached[MODES[from]] = true;
        for (unsigned round = 0; round < COUNT_OF(MODES); round++) {
            for (unsigned m = 0; m < COUNT_OF(MODES); m++) {
                for (unsigned k = 0; reached[MODES[m]] && k < EVENTS * 16u; k++) {
                    const struct mode_conditions c = combination(k % 16u);
                    reached[table(MODES[m], (enum ecu_event)(k / 16u), &c).next] = true;
                }
            }
        }
        for (unsigned m = 0; m < COUNT_OF(MODES); m++) {
            TEST_ASSERT_TRUE(reached[MODES[m]]);
        }
    }
}

static void test_valves_driven_in_another_mode(void)
{
    /* GIVEN every value of the wire's four bits WHEN asked THEN RUN, COMMISSION, HOLD and SAFE_STOP drive, no other */
    for (unsigned mode = 0; mode < 16; mode++) {
        const bool drives = mode == 2 || mode == 4 || mode == 5 || mode == 6;
        TEST_ASSERT_EQUAL_INT(drives, mode_drives((enum ecu_mode)mode));
    }
}

static void test_status_word_names_another_device_state(void)
{
    /* GIVEN each mode WHEN its CiA 408 status is read THEN D H M as the device state has them, R but in FAULT */
    enum { D = 1, H = 2, M = 4, R = 8 };
    TEST_ASSERT_EQUAL_HEX8(R, mode_cia408_status(MODE_INIT));
    TEST_ASSERT_EQUAL_HEX8(R | D, mode_cia408_status(MODE_STANDBY));
    TEST_ASSERT_EQUAL_HEX8(R | D, mode_cia408_status(MODE_TARE));
    TEST_ASSERT_EQUAL_HEX8(R | D | H, mode_cia408_status(MODE_HOLD));
    TEST_ASSERT_EQUAL_HEX8(R | D | H | M, mode_cia408_status(MODE_RUN));
    TEST_ASSERT_EQUAL_HEX8(R | D | H | M, mode_cia408_status(MODE_COMMISSION));
    TEST_ASSERT_EQUAL_HEX8(R | D | H | M, mode_cia408_status(MODE_SAFE_STOP));
    TEST_ASSERT_EQUAL_HEX8(D, mode_cia408_status(MODE_FAULT));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_a_transition_is_none_of_the_rules);
    RUN_TEST(test_a_refusal_changes_the_mode);
    RUN_TEST(test_valves_open_past_the_network_or_a_fault);
    RUN_TEST(test_a_mode_cannot_be_reached_or_left);
    RUN_TEST(test_valves_driven_in_another_mode);
    RUN_TEST(test_status_word_names_another_device_state);
    return UNITY_END();
}
