/* Reception (ecu/receive_table): what a bus does to frames, one tick at a time. */
#include "ecu/receive_table.h"
#include "testing.h"

static struct receive receive;
static enum received_frame which;

void setUp(void)
{
    receive = (struct receive){0};
    receive_begin_tick(&receive, 1); /* expects counter 0 */
}

void tearDown(void)
{
}

static enum receive_result accept(enum received_frame row, uint8_t counter)
{
    const struct can_frame_11bit frame = protected_frame(receive_table[row].id, counter);
    which = RX_FRAMES;
    return receive_accept(&receive, &frame, &which);
}

static void accept_all(uint8_t counter)
{
    TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(RX_ENCODERS, counter));
    TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(RX_PRESSURES_SWING, counter));
    TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(RX_PRESSURES_WRIST, counter));
}

static void test_identifier_or_length_of_a_row_changed(void)
{
    /* GIVEN the table WHEN read THEN the identifiers of design/architecture.md, 8 bytes, answers to SYNC but
     * one */
    static const uint16_t ids[RX_FRAMES] = {0x182, 0x282, 0x382, 0x201};
    for (uint8_t k = 0; k < RX_FRAMES; k++) {
        TEST_ASSERT_EQUAL_HEX16(ids[k], receive_table[k].id);
        TEST_ASSERT_EQUAL_UINT8(8, receive_table[k].length);
        TEST_ASSERT_EQUAL_INT(k != RX_MOTION, receive_table[k].cyclic);
    }
}

static void test_tick_complete_before_all_frames_came(void)
{
    /* GIVEN a tick WHEN the sensor frames come in any order THEN it is complete with the last, not before; a
     * MOTION frame does not count */
    static const enum received_frame orders[6][3] = {
        {RX_ENCODERS, RX_PRESSURES_SWING, RX_PRESSURES_WRIST},
        {RX_ENCODERS, RX_PRESSURES_WRIST, RX_PRESSURES_SWING},
        {RX_PRESSURES_SWING, RX_ENCODERS, RX_PRESSURES_WRIST},
        {RX_PRESSURES_SWING, RX_PRESSURES_WRIST, RX_ENCODERS},
        {RX_PRESSURES_WRIST, RX_ENCODERS, RX_PRESSURES_SWING},
        {RX_PRESSURES_WRIST, RX_PRESSURES_SWING, RX_ENCODERS},
    };
    for (unsigned n = 0; n < COUNT_OF(orders); n++) {
        setUp();
        TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(RX_MOTION, 5));
        for (unsigned k = 0; k < 3; k++) {
            TEST_ASSERT_FALSE(receive_complete(&receive));
            TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(orders[n][k], 0));
            TEST_ASSERT_EQUAL_INT(orders[n][k], which);
        }
        TEST_ASSERT_TRUE(receive_complete(&receive));
    }
}

static void test_frames_of_the_tick_before_taken_as_fresh(void)
{
    /* GIVEN a complete tick WHEN the next begins THEN nothing is fresh, but data and counter are kept */
    struct can_frame_11bit frame = protected_frame(0x182, 0);
    frame.data[5] = 0x5A;
    e2e_protect(0x182, 0, frame.data);
    TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, receive_accept(&receive, &frame, &which));
    TEST_ASSERT_TRUE(receive.row[RX_ENCODERS].fresh);
    TEST_ASSERT_EQUAL_HEX8_ARRAY(frame.data, receive.row[RX_ENCODERS].data, 8);
    receive_end_tick(&receive);
    receive_begin_tick(&receive, 2);
    TEST_ASSERT_FALSE(receive.row[RX_ENCODERS].fresh);
    TEST_ASSERT_TRUE(receive.row[RX_ENCODERS].heard);
    TEST_ASSERT_EQUAL_HEX8(0x5A, receive.row[RX_ENCODERS].data[5]);
}

static void test_answer_to_another_sync_taken(void)
{
    /* GIVEN every SYNC counter WHEN answers come with every E2E counter THEN only (SYNC - 1) mod 15 is taken
     * */
    for (unsigned sync = 1; sync <= 240u; sync++) {
        for (uint8_t counter = 0; counter < E2E_COUNTER_STATES; counter++) {
            receive_begin_tick(&receive, (uint8_t)sync);
            const enum receive_result expected =
                counter == (sync - 1u) % 15u ? RECEIVE_GOOD : RECEIVE_COUNTER;
            TEST_ASSERT_EQUAL_INT(expected, accept(RX_PRESSURES_SWING, counter));
        }
    }
}

static void test_late_answer_taken_for_one_in_time(void)
{
    /* GIVEN a frame that missed its tick WHEN it comes in the next THEN refused and counted, and the right
     * one is still taken after it */
    accept_all(0);
    receive_begin_tick(&receive, 2);
    TEST_ASSERT_EQUAL_INT(RECEIVE_COUNTER, accept(RX_ENCODERS, 0));
    TEST_ASSERT_FALSE(receive.row[RX_ENCODERS].fresh);
    TEST_ASSERT_EQUAL_UINT8(1, receive.refused);
    TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(RX_ENCODERS, 1));
}

static void test_repeated_frame_taken_twice(void)
{
    /* GIVEN a frame WHEN it comes again in its tick THEN refused and counted, the first one stays */
    TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(RX_ENCODERS, 0));
    TEST_ASSERT_EQUAL_INT(RECEIVE_COUNTER, accept(RX_ENCODERS, 0));
    TEST_ASSERT_TRUE(receive.row[RX_ENCODERS].fresh);
    TEST_ASSERT_EQUAL_UINT8(1, receive.refused);
    /* a request is not carried out twice either, in this tick or a later one */
    TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(RX_MOTION, 4));
    TEST_ASSERT_EQUAL_INT(RECEIVE_COUNTER, accept(RX_MOTION, 4));
    receive_begin_tick(&receive, 2);
    TEST_ASSERT_EQUAL_INT(RECEIVE_COUNTER, accept(RX_MOTION, 4));
    TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(RX_MOTION, 9)); /* any other counter is a new request */
}

static void test_first_request_refused(void)
{
    /* GIVEN a master that begins with any counter, 0 as well WHEN its first request comes THEN taken */
    for (uint8_t counter = 0; counter < E2E_COUNTER_STATES; counter++) {
        setUp();
        TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(RX_MOTION, counter));
    }
}

static void test_corrupted_frame_taken(void)
{
    /* GIVEN a good frame WHEN any bit of it flips THEN refused by its CRC and counted, the data of before
     * stay */
    accept_all(0);
    receive_begin_tick(&receive, 2);
    const struct receive_state before = receive.row[RX_ENCODERS];
    const struct can_frame_11bit good = protected_frame(0x182, 1);
    for (uint8_t bit = 0; bit < 64u; bit++) {
        struct can_frame_11bit frame = good;
        frame.data[bit / 8u] ^= (uint8_t)(1u << (bit % 8u));
        TEST_ASSERT_EQUAL_INT(RECEIVE_CRC, receive_accept(&receive, &frame, &which));
        TEST_ASSERT_EQUAL_INT(RX_ENCODERS, which);
        TEST_ASSERT_EQUAL_UINT8(bit + 1, receive.refused);
    }
    TEST_ASSERT_EQUAL_HEX8_ARRAY(before.data, receive.row[RX_ENCODERS].data, 8);
    TEST_ASSERT_FALSE(receive.row[RX_ENCODERS].fresh);
}

static void test_short_frame_read_past_its_end(void)
{
    /* GIVEN frames of every other length WHEN they come THEN refused and counted, though their CRC is right
     * */
    for (uint8_t length = 0; length < 8u; length++) {
        struct can_frame_11bit frame = protected_frame(0x282, 0);
        frame.length = length;
        TEST_ASSERT_EQUAL_INT(RECEIVE_LENGTH, receive_accept(&receive, &frame, &which));
        TEST_ASSERT_EQUAL_INT(RX_PRESSURES_SWING, which);
    }
    TEST_ASSERT_EQUAL_UINT8(8, receive.refused);
    TEST_ASSERT_FALSE(receive.row[RX_PRESSURES_SWING].heard);
}

static void test_alien_frames_counted_as_errors(void)
{
    /* GIVEN every identifier that is not ours WHEN such frames come THEN passed over, nothing counted */
    for (uint32_t id = 0; id <= 0x7FFu; id++) {
        if (id == 0x182u || id == 0x282u || id == 0x382u || id == 0x201u) {
            continue;
        }
        const struct can_frame_11bit frame = protected_frame((uint16_t)id, 0);
        TEST_ASSERT_EQUAL_INT(RECEIVE_ALIEN, receive_accept(&receive, &frame, &which));
    }
    TEST_ASSERT_EQUAL_UINT8(0, receive.refused);
    receive_end_tick(&receive);
    TEST_ASSERT_EQUAL_UINT16(0, receive.lost);
}

static void test_dropped_frames_not_counted(void)
{
    /* GIVEN nodes that have been heard WHEN one frame, then all three do not come THEN each is counted; none
     * before the first was heard, and a MOTION frame never */
    receive_end_tick(&receive);
    TEST_ASSERT_EQUAL_UINT16(0, receive.lost);
    receive_begin_tick(&receive, 2);
    accept_all(1);
    TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(RX_MOTION, 0));
    receive_end_tick(&receive);
    TEST_ASSERT_EQUAL_UINT16(0, receive.lost);
    receive_begin_tick(&receive, 3);
    TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(RX_ENCODERS, 2));
    TEST_ASSERT_EQUAL_INT(RECEIVE_GOOD, accept(RX_PRESSURES_WRIST, 2));
    receive_end_tick(&receive);
    TEST_ASSERT_EQUAL_UINT16(1, receive.lost);
    receive_begin_tick(&receive, 4);
    receive_end_tick(&receive);
    TEST_ASSERT_EQUAL_UINT16(4, receive.lost);
}

static void test_error_counters_wrap(void)
{
    /* GIVEN a bus gone bad for good WHEN counted THEN the counters stop at their ends */
    accept_all(0);
    for (int n = 0; n < 300; n++) {
        (void)accept(RX_ENCODERS, 3);
    }
    TEST_ASSERT_EQUAL_UINT8(255, receive.refused);
    for (int n = 0; n < 22000; n++) { /* three frames each */
        receive_begin_tick(&receive, 2);
        receive_end_tick(&receive);
    }
    TEST_ASSERT_EQUAL_UINT16(65535, receive.lost);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_identifier_or_length_of_a_row_changed);
    RUN_TEST(test_tick_complete_before_all_frames_came);
    RUN_TEST(test_frames_of_the_tick_before_taken_as_fresh);
    RUN_TEST(test_answer_to_another_sync_taken);
    RUN_TEST(test_late_answer_taken_for_one_in_time);
    RUN_TEST(test_repeated_frame_taken_twice);
    RUN_TEST(test_first_request_refused);
    RUN_TEST(test_corrupted_frame_taken);
    RUN_TEST(test_short_frame_read_past_its_end);
    RUN_TEST(test_alien_frames_counted_as_errors);
    RUN_TEST(test_dropped_frames_not_counted);
    RUN_TEST(test_error_counters_wrap);
    return UNITY_END();
}
