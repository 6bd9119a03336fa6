/* End-to-end protection (ecu/e2e): AUTOSAR profile 1, data id mode BOTH. */
#include "testing.h"

static const uint16_t IDS[] = {0x181, 0x182, 0x201, 0x202, 0x281, 0x282, 0x381, 0x382, 0x481};

static struct lcg noise;
static uint8_t data[8];

void setUp(void)
{
    noise = (struct lcg){11};
    memset(data, 0, sizeof data);
}

void tearDown(void)
{
}

static void random_payload(void)
{
    for (uint8_t k = 0; k < 8u; k++) {
        data[k] = (uint8_t)lcg_uniform(&noise, 0, 256);
    }
}

static void test_other_nodes_cannot_read_our_protection(void)
{
    /* GIVEN the vector that the PyPI package autosar-e2e gives WHEN protected THEN its bytes */
    uint8_t vector[8] = {0, 0, 0x11, 0x22, 0x33, 0x44, 0x55, 0x66};
    static const uint8_t expected[8] = {0x67, 0x02, 0x11, 0x22, 0x33, 0x44, 0x55, 0x66};
    e2e_protect(0x123, 2, vector);
    TEST_ASSERT_EQUAL_HEX8_ARRAY(expected, vector, 8);
    TEST_ASSERT_EQUAL_HEX8(0x67, e2e_crc(0x123, vector));
    TEST_ASSERT_TRUE(e2e_intact(0x123, vector));
}

static void test_protection_overwrites_the_status_nibble(void)
{
    /* GIVEN a payload WHEN protected THEN only byte 0 and the low nibble of byte 1 have changed */
    for (uint8_t counter = 0; counter < E2E_COUNTER_STATES; counter++) {
        random_payload();
        data[1] = 0xFA;
        uint8_t before[8];
        memcpy(before, data, sizeof before);
        e2e_protect(0x201, counter, data);
        TEST_ASSERT_EQUAL_HEX8(0xF0 | counter, data[1]);
        TEST_ASSERT_EQUAL_UINT8(counter, e2e_counter(data));
        TEST_ASSERT_EQUAL_HEX8_ARRAY(&before[2], &data[2], 6);
        TEST_ASSERT_TRUE(e2e_intact(0x201, data));
    }
}

static void test_flipped_bit_unseen(void)
{
    /* GIVEN frames of every id and counter WHEN any one bit flips THEN refused */
    for (unsigned k = 0; k < COUNT_OF(IDS); k++) {
        for (uint8_t counter = 0; counter < E2E_COUNTER_STATES; counter++) {
            random_payload();
            e2e_protect(IDS[k], counter, data);
            for (unsigned bit = 0; bit < 64u; bit++) {
                data[bit / 8u] ^= (uint8_t)(1u << (bit % 8u));
                TEST_ASSERT_FALSE(e2e_intact(IDS[k], data));
                data[bit / 8u] ^= (uint8_t)(1u << (bit % 8u));
            }
            TEST_ASSERT_TRUE(e2e_intact(IDS[k], data));
        }
    }
}

static void test_burst_of_eight_bits_unseen(void)
{
    /* GIVEN frames WHEN any pattern within eight bits in a row is disturbed THEN refused */
    random_payload();
    e2e_protect(0x182, 7, data);
    for (unsigned start = 8; start <= 56u; start++) { /* in the CRC's order, high bit first */
        for (unsigned pattern = 1; pattern < 256u; pattern++) {
            uint8_t burst[8];
            memcpy(burst, data, sizeof burst);
            for (unsigned bit = 0; bit < 8u; bit++) {
                const unsigned at = start + bit;
                if ((pattern >> bit & 1u) != 0u && at < 64u) {
                    burst[at / 8u] ^= (uint8_t)(0x80u >> (at % 8u));
                }
            }
            TEST_ASSERT_FALSE(e2e_intact(0x182, burst));
        }
    }
}

/* Eight bits cannot tell all identifiers apart: these two pairs share the start of their CRC. */
static bool alike(uint16_t a, uint16_t b)
{
    const uint16_t low = a < b ? a : b;
    const uint16_t high = a < b ? b : a;
    return a == b || (low == 0x201 && high == 0x382) || (low == 0x202 && high == 0x381);
}

static void test_frame_taken_for_another(void)
{
    /* GIVEN a good frame WHEN it comes under another of our identifiers THEN refused */
    for (unsigned k = 0; k < COUNT_OF(IDS); k++) {
        random_payload();
        e2e_protect(IDS[k], 3, data);
        for (unsigned n = 0; n < COUNT_OF(IDS); n++) {
            TEST_ASSERT_EQUAL_INT(alike(IDS[k], IDS[n]), e2e_intact(IDS[n], data));
        }
    }
}

static void test_counter_15_accepted(void)
{
    /* GIVEN a frame whose counter is 15, which is never sent WHEN its CRC is right THEN refused all the same
     * */
    e2e_protect(0x182, 15, data);
    TEST_ASSERT_EQUAL_HEX8(e2e_crc(0x182, data), data[0]);
    TEST_ASSERT_FALSE(e2e_intact(0x182, data));
}

static void test_empty_bus_looks_intact(void)
{
    /* GIVEN frames of zeros or ones, as a dead driver makes them WHEN checked THEN refused */
    for (unsigned k = 0; k < COUNT_OF(IDS); k++) {
        memset(data, 0, sizeof data);
        TEST_ASSERT_FALSE(e2e_intact(IDS[k], data));
        memset(data, 0xFF, sizeof data);
        TEST_ASSERT_FALSE(e2e_intact(IDS[k], data));
    }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_other_nodes_cannot_read_our_protection);
    RUN_TEST(test_protection_overwrites_the_status_nibble);
    RUN_TEST(test_flipped_bit_unseen);
    RUN_TEST(test_burst_of_eight_bits_unseen);
    RUN_TEST(test_frame_taken_for_another);
    RUN_TEST(test_counter_15_accepted);
    RUN_TEST(test_empty_bus_looks_intact);
    return UNITY_END();
}
