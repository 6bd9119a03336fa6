/* The ECU that starts from a store: which parameters it uses, and when it asks for confirmation first. */
#include "ecu/ecu.h"
#include "testing.h"

enum {
    REQUEST_RUN = 2,
    REQUEST_RESET_FAULT = 4,
    NMT_START = 1,
    NMT_RESET = 129,
    NMT_RESET_COMMUNICATION = 130
};

static struct ecu ecu;
static struct parameter_image buffer;
static struct parameter_image stored_set;

/* The memory: no more than what the store needs; how flash fails is test_store's. */
static uint8_t slots[STORE_SLOTS][STORE_SLOT_BYTES];

static bool memory_read(void *context, uint8_t slot, uint32_t offset, uint8_t *bytes, uint32_t length)
{
    (void)context;
    memcpy(bytes, &slots[slot][offset], length);
    return true;
}

static bool memory_erase(void *context, uint8_t slot)
{
    (void)context;
    memset(slots[slot], 0xFF, sizeof slots[slot]);
    return true;
}

static bool memory_program(void *context, uint8_t slot, uint32_t offset, const uint8_t *bytes,
                           uint32_t length)
{
    (void)context;
    memcpy(&slots[slot][offset], bytes, length);
    return true;
}

static const struct store_port STORE = {
    .context = NULL, .read = memory_read, .erase = memory_erase, .program = memory_program};

/* The bus: what waits for the ECU, and the emergencies it sent. */
static struct can_frame_11bit waiting[8];
static uint8_t waiting_count, waiting_next;
static struct can_frame_11bit emergencies[8];
static uint8_t emergency_count;
static bool valves_opened;

static enum port_status port_send(void *context, const struct can_frame_11bit *frame)
{
    (void)context;
    if (frame->id == 0x81u) {
        emergencies[emergency_count++ % COUNT_OF(emergencies)] = *frame;
    }
    valves_opened = valves_opened || (frame->id == 0x202u && get_bits(frame->data, 48, 8) != 0x11u);
    return PORT_OK;
}

static enum port_status port_receive(void *context, struct can_frame_11bit *frame)
{
    (void)context;
    if (waiting_next >= waiting_count) {
        waiting_next = waiting_count = 0;
        return PORT_EMPTY;
    }
    *frame = waiting[waiting_next++];
    return PORT_OK;
}

static uint32_t port_now_us(void *context)
{
    (void)context;
    return 0;
}

static struct ecu_port port = {.send = port_send, .receive = port_receive, .now_us = port_now_us};

static void queue(struct can_frame_11bit frame)
{
    waiting[waiting_count++] = frame;
}

static void queue_nmt(uint8_t command)
{
    queue(nmt_frame(command, 0));
}

static void queue_request(uint8_t request)
{
    static uint8_t counter;
    counter = (uint8_t)((counter + 1u) % E2E_COUNTER_STATES);
    queue(motion_frame(request, 0, 0, 0, 1, counter));
}

/* An arm that rests at 0.1 rad with 3 kg. */
static void queue_sensors(void)
{
    const uint8_t counter = (uint8_t)((ecu.sync_counter - 1u) % E2E_COUNTER_STATES);
    queue(encoders_frame(267013, 267013, 0, counter));
    for (uint8_t i = 0; i < JOINTS; i++) {
        queue(pressures_frame(i, REST_PRESSURE[i], 0, 0, counter));
    }
}

static void tick(void)
{
    ecu_tick_begin(&ecu, &port);
    queue_sensors();
    TEST_ASSERT_TRUE(ecu_tick_receive(&ecu, &port));
    ecu_tick_end(&ecu, &port);
}

static void ticks(int count)
{
    for (int k = 0; k < count; k++) {
        tick();
    }
}

static enum ecu_status power_on(const struct store_port *store, const struct parameter_image *fallback)
{
    uint16_t entry = 0;
    waiting_count = waiting_next = emergency_count = 0;
    return ecu_init_stored(&ecu, store, &buffer, fallback, 1000, &entry);
}

void setUp(void)
{
    memset(slots, 0xFF, sizeof slots);
    valves_opened = false;
    port.store = NULL;
    port.fallback = NULL;
    stored_set = default_parameter_image;
    image_set_u32(&stored_set, IMAGE_HEADER_BYTES, 0x41000000u); /* gravity 8 m/s^2 */
    image_seal(&stored_set);
}

void tearDown(void)
{
}

static void save(void)
{
    TEST_ASSERT_EQUAL_INT(STORE_OK, store_save(&STORE, &stored_set));
}

static void expect_stored(bool is_stored)
{
    const double gravity = is_stored ? 8.0 : default_value("arm.gravity_m_s2");
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, gravity, real(ecu.machine.arm.g));
}

/* In FAULT with the emergency sent once, valves shut; RESET_FAULT leads to STANDBY, and a reset does not ask again. */
static void expect_confirmation_asked(void)
{
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    TEST_ASSERT_EQUAL_INT(FAULT_STORE_DAMAGED, ecu.fault);
    queue_nmt(NMT_START);
    ticks(20);
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    TEST_ASSERT_EQUAL_UINT8(1, emergency_count);
    TEST_ASSERT_EQUAL_HEX8(0x00, emergencies[0].data[0]);
    TEST_ASSERT_EQUAL_HEX8(0x63, emergencies[0].data[1]);
    TEST_ASSERT_EQUAL_UINT8(17, emergencies[0].data[3]);
    queue_request(REQUEST_RUN);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    queue_nmt(NMT_RESET);
    tick();
    queue_nmt(NMT_START);
    ticks(5);
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode); /* not confirmed: a reset does not help */
    queue_request(REQUEST_RESET_FAULT);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    TEST_ASSERT_FALSE(valves_opened);
    queue_nmt(NMT_RESET);
    tick();
    queue_nmt(NMT_START);
    ticks(5);
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
}

static void test_stored_set_not_used(void)
{
    /* GIVEN a saved set WHEN started THEN it is used, without a fault */
    save();
    TEST_ASSERT_EQUAL_INT(ECU_OK, power_on(&STORE, NULL));
    expect_stored(true);
    TEST_ASSERT_EQUAL_INT(MODE_INIT, ecu.mode);
    queue_nmt(NMT_START);
    ticks(2);
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    TEST_ASSERT_EQUAL_UINT8(0, emergency_count);
}

static void test_ecu_without_a_stored_set_does_not_start(void)
{
    /* GIVEN no store, or an empty one WHEN started THEN the fallback is used, else the built-in one; no fault */
    for (int has_store = 0; has_store < 2; has_store++) {
        for (int has_fallback = 0; has_fallback < 2; has_fallback++) {
            TEST_ASSERT_EQUAL_INT(
                ECU_OK, power_on(has_store == 1 ? &STORE : NULL, has_fallback == 1 ? &stored_set : NULL));
            expect_stored(has_fallback == 1);
            TEST_ASSERT_EQUAL_INT(MODE_INIT, ecu.mode);
        }
    }
}

static void test_damaged_store_passed_over_in_silence(void)
{
    /* GIVEN the only set damaged WHEN started THEN the default waits in FAULT until RESET_FAULT confirms it */
    save();
    slots[0][100] ^= 0x20u;
    TEST_ASSERT_EQUAL_INT(ECU_OK, power_on(&STORE, NULL));
    expect_stored(false);
    expect_confirmation_asked();
}

static void test_older_set_used_in_silence(void)
{
    /* GIVEN the newer of two sets damaged WHEN started THEN the older one waits for the same */
    save();
    save();
    slots[1][100] ^= 0x20u;
    TEST_ASSERT_EQUAL_INT(ECU_OK, power_on(&STORE, NULL));
    expect_stored(true);
    expect_confirmation_asked();
}

static void test_stored_set_this_firmware_refuses_stops_the_start(void)
{
    /* GIVEN a whole set with a number that is out of range here WHEN started THEN the default waits for the same */
    image_set_u32(&stored_set, IMAGE_HEADER_BYTES, 0x42000000u); /* 32 m/s^2 */
    image_seal(&stored_set);
    save();
    TEST_ASSERT_EQUAL_INT(ECU_OK, power_on(&STORE, NULL));
    expect_stored(false);
    expect_confirmation_asked();
}

static void test_wrong_fallback_started_from(void)
{
    /* GIVEN an empty store WHEN the fallback is no image THEN that is said, as without a store */
    stored_set.bytes[0] = 0;
    TEST_ASSERT_EQUAL_INT(ECU_IMAGE_NOT_ONE, power_on(&STORE, &stored_set));
}

/* What NMT makes of an ECU that runs with the defaults, with the store as it is now. */
static void reset_by(uint8_t command)
{
    queue_nmt(command);
    ticks(2);
}

static void test_reset_keeps_what_power_on_would_not(void)
{
    /* GIVEN a set saved, or restored, since power-on WHEN the node is reset THEN it has the set of the next power-on;
     * WHEN only communication is THEN the one in force */
    TEST_ASSERT_EQUAL_INT(ECU_OK, power_on(&STORE, NULL));
    port.store = &STORE;
    save();
    reset_by(NMT_RESET_COMMUNICATION);
    expect_stored(false);
    reset_by(NMT_RESET);
    expect_stored(true);
    TEST_ASSERT_EQUAL_INT(STORE_OK, store_restore_default(&STORE));
    reset_by(NMT_RESET_COMMUNICATION);
    expect_stored(true);
    queue_nmt(NMT_RESET_COMMUNICATION);
    reset_by(NMT_RESET);
    expect_stored(false);
    TEST_ASSERT_EQUAL_INT(MODE_INIT, ecu.mode);
    TEST_ASSERT_EQUAL_UINT8(0, emergency_count);
}

static void test_reset_without_a_whole_set_starts_from_the_wrong_one(void)
{
    /* GIVEN an empty store WHEN the node is reset THEN it has the set of its port to fall back on; GIVEN one that this
     * firmware refuses THEN the same, in FAULT */
    TEST_ASSERT_EQUAL_INT(ECU_OK, power_on(&STORE, NULL));
    port.store = &STORE;
    port.fallback = &stored_set;
    reset_by(NMT_RESET);
    expect_stored(true);
    struct parameter_image refused = stored_set;
    image_set_u32(&refused, IMAGE_HEADER_BYTES, 0x42000000u); /* 32 m/s^2 */
    image_seal(&refused);
    TEST_ASSERT_EQUAL_INT(STORE_OK, store_save(&STORE, &refused));
    port.fallback = NULL;
    reset_by(NMT_RESET);
    expect_stored(false);
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    TEST_ASSERT_EQUAL_INT(FAULT_STORE_DAMAGED, ecu.fault);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_stored_set_not_used);
    RUN_TEST(test_ecu_without_a_stored_set_does_not_start);
    RUN_TEST(test_damaged_store_passed_over_in_silence);
    RUN_TEST(test_older_set_used_in_silence);
    RUN_TEST(test_stored_set_this_firmware_refuses_stops_the_start);
    RUN_TEST(test_wrong_fallback_started_from);
    RUN_TEST(test_reset_keeps_what_power_on_would_not);
    RUN_TEST(test_reset_without_a_whole_set_starts_from_the_wrong_one);
    return UNITY_END();
}
