/* What the ECU offers to a port beside the tick (ecu/ecu) and the histogram of tick times (ecu/time_histogram): what
 * would hide a slow or late tick, or let a port change the ECU by looking at it. */
#include "can_protocol/generated/diarc.h"
#include "ecu/ecu.h"
#include "testing.h"

enum { NMT_START = 1, PAGES = 5, PAGE_TICK_TIMES = 4, TICKS_PER_PAGE = 10, TICK_TIME_US = 700 };

static struct ecu ecu;

/* A port that starts the ECU and has no sensors; its clock advances by `step_us` with every look at it. */
static struct {
    bool start_sent;
    uint32_t now_us;
    uint32_t step_us;
    struct can_frame_11bit timing; /* the last one; length 0: none since it was cleared */
} bus;

static enum port_status port_send(void *context, const struct can_frame_11bit *frame)
{
    (void)context;
    if (frame->id == DIARC_TIMING_FRAME_ID) {
        bus.timing = *frame;
    }
    return PORT_OK;
}

static enum port_status port_receive(void *context, struct can_frame_11bit *frame)
{
    (void)context;
    if (bus.start_sent) {
        return PORT_EMPTY;
    }
    bus.start_sent = true;
    *frame = (struct can_frame_11bit){.id = DIARC_NMT_FRAME_ID, .length = 2, .data = {NMT_START, 0}};
    return PORT_OK;
}

static uint32_t port_now_us(void *context)
{
    (void)context;
    bus.now_us += bus.step_us;
    return bus.now_us;
}

static const struct ecu_port port = {.send = port_send, .receive = port_receive, .now_us = port_now_us};

void setUp(void)
{
    uint16_t entry;
    memset(&bus, 0, sizeof bus);
    TEST_ASSERT_EQUAL_INT(ECU_OK, ecu_init(&ecu, NULL, 1000, &entry));
}

void tearDown(void)
{
}

static void tick(void)
{
    ecu_tick_begin(&ecu, &port);
    (void)ecu_tick_receive(&ecu, &port);
    ecu_tick_end(&ecu, &port);
}

static void test_tick_time_counted_in_the_wrong_bucket(void)
{
    /* GIVEN times at the edges of the buckets WHEN counted THEN each is in its own */
    static const struct {
        uint32_t time_us;
        int bucket;
    } cases[] = {{0, 0},    {1, 1},     {2, 2},     {3, 2},      {4, 3},          {511, 9},
                 {512, 10}, {1023, 10}, {1024, 11}, {65536, 11}, {UINT32_MAX, 11}};
    for (size_t i = 0; i < COUNT_OF(cases); i++) {
        struct time_histogram histogram = {{0}};
        time_histogram_add(&histogram, cases[i].time_us);
        for (int k = 0; k < TIME_BUCKETS; k++) {
            TEST_ASSERT_EQUAL_UINT32(k == cases[i].bucket ? 1 : 0, histogram.count[k]);
        }
    }
}

static void test_full_bucket_does_not_begin_anew(void)
{
    /* GIVEN a bucket at its limit WHEN one more is counted THEN it stays there */
    struct time_histogram histogram = {{UINT32_MAX}};
    time_histogram_add(&histogram, 0);
    TEST_ASSERT_EQUAL_UINT32(UINT32_MAX, histogram.count[0]);
}

static void test_bucket_left_out_on_the_timing_frame(void)
{
    /* GIVEN ticks of 700 us WHEN page 4 comes round THEN every bucket is told in turn, and the ticks are in theirs */
    bus.step_us = TICK_TIME_US;
    for (uint32_t k = 0; k < 2 * TIME_BUCKETS; k++) {
        for (int n = 0; n < PAGES * TICKS_PER_PAGE; n++) {
            bus.timing.length = 0;
            tick();
            if (bus.timing.length > 0 && get_bits(bus.timing.data, 16, 8) == PAGE_TICK_TIMES) {
                TEST_ASSERT_EQUAL_UINT32(k % TIME_BUCKETS, get_bits(bus.timing.data, 24, 8));
                const uint32_t count = get_bits(bus.timing.data, 32, 32);
                TEST_ASSERT_EQUAL_UINT32(k % TIME_BUCKETS == 10 ? ecu.counters.ticks : 0u, count);
            }
        }
    }
}

static void test_missed_periods_not_counted_as_late(void)
{
    /* GIVEN a timer that fires late WHEN the port tells THEN the periods count as late ticks, up to the limit */
    const uint16_t before = ecu.counters.late_ticks;
    ecu_note_late_start(&ecu, 3);
    TEST_ASSERT_EQUAL_UINT16(before + 3, ecu.counters.late_ticks);
    ecu_note_late_start(&ecu, UINT32_MAX);
    TEST_ASSERT_EQUAL_UINT16(UINT16_MAX, ecu.counters.late_ticks);
}

static void test_rehearsal_is_not_taken_for_a_tick(void)
{
    /* GIVEN an ECU with samples WHEN the law is rehearsed THEN not one byte of it changes, and the copy has run */
    static struct ecu before;
    static struct controller understudy;
    ecu.sampled = true;
    memcpy(&before, &ecu, sizeof ecu);
    memset(&understudy, 0xA5, sizeof understudy);
    ecu_rehearse(&ecu, &understudy);
    TEST_ASSERT_EQUAL_MEMORY(&before, &ecu, sizeof ecu);
    TEST_ASSERT_FALSE(understudy.armed);
}

static void test_rehearsal_without_samples_makes_some_up(void)
{
    /* GIVEN an ECU that has heard no sensor yet WHEN the law is rehearsed THEN not a byte of the copy is written */
    static struct controller before, understudy;
    memset(&before, 0xA5, sizeof before);
    memset(&understudy, 0xA5, sizeof understudy);
    TEST_ASSERT_FALSE(ecu.sampled);
    ecu_rehearse(&ecu, &understudy);
    TEST_ASSERT_EQUAL_MEMORY(&before, &understudy, sizeof understudy);
}

static void test_stop_in_standby_waits_for_nothing(void)
{
    /* GIVEN an ECU whose valves are shut WHEN a safe stop is asked for THEN the port may end at once */
    tick();
    ecu_request_safe_stop(&ecu);
    TEST_ASSERT_TRUE(ecu_valves_shut(&ecu));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_tick_time_counted_in_the_wrong_bucket);
    RUN_TEST(test_full_bucket_does_not_begin_anew);
    RUN_TEST(test_bucket_left_out_on_the_timing_frame);
    RUN_TEST(test_missed_periods_not_counted_as_late);
    RUN_TEST(test_rehearsal_is_not_taken_for_a_tick);
    RUN_TEST(test_rehearsal_without_samples_makes_some_up);
    RUN_TEST(test_stop_in_standby_waits_for_nothing);
    return UNITY_END();
}
