/* The objects (ecu/object_dictionary): what they read, what may be written and when, and what a refused write must not
 * leave behind. All through the SDO server, as a tool does it. */
#include "can_protocol/generated/diarc_hash.h"
#include "sdo_client.h"

#define FIRST(name) ((uint16_t)(FIRST_PARAMETER + entry_named(name)))

void setUp(void)
{
    power_on();
}

void tearDown(void)
{
}

/* Everything the dictionary finds: visit(index, sub). */
static unsigned for_each_object(void (*visit)(uint16_t index, uint8_t sub, const struct object *object))
{
    unsigned count = 0;
    for (uint32_t index = 0; index <= UINT16_MAX; index++) {
        struct object object;
        enum object_abort found = object_find((uint16_t)index, 0, &object);
        if (found == ABORT_NO_OBJECT) {
            continue;
        }
        TEST_ASSERT_EQUAL_HEX32(OBJECT_DONE, found); /* sub-index 0 is always there */
        bool gap = false;
        for (unsigned sub = 0; sub <= UINT8_MAX; sub++) {
            found = object_find((uint16_t)index, (uint8_t)sub, &object);
            if (found == OBJECT_DONE) {
                TEST_ASSERT_FALSE_MESSAGE(gap, "sub-indices have a gap");
                visit((uint16_t)index, (uint8_t)sub, &object);
                count++;
            } else {
                TEST_ASSERT_EQUAL_HEX32(ABORT_NO_SUB_INDEX, found);
                gap = true;
            }
        }
    }
    return count;
}

/* ---- reading ---- */

static void check_read(uint16_t index, uint8_t sub, const struct object *object)
{
    const uint32_t expected = index == 0x1003 && sub > 0 ? (uint32_t)ABORT_NO_DATA : 0u;
    TEST_ASSERT_EQUAL_HEX32_MESSAGE(expected, read_object(index, sub), "cannot be read");
    if (expected == 0u) {
        TEST_ASSERT_EQUAL_UINT32(object_length(object), got.length);
    }
    if (sub == 0u && object_find(index, 1, &(struct object){0}) == OBJECT_DONE && index != 0x1003) {
        const uint8_t highest = got.bytes[0];
        TEST_ASSERT_EQUAL_HEX32(OBJECT_DONE, object_find(index, highest, &(struct object){0}));
        TEST_ASSERT_EQUAL_HEX32(ABORT_NO_SUB_INDEX,
                                object_find(index, (uint8_t)(highest + 1u), &(struct object){0}));
    }
}

static void test_object_that_is_there_not_readable(void)
{
    /* GIVEN every object there is WHEN read THEN there is a value as long as its type, and sub-index 0 tells how many
     * there are */
    to_standby();
    TEST_ASSERT_TRUE(for_each_object(check_read) > PARAMETER_COUNT + 100u);
}

static void test_object_that_is_not_there_read_or_written(void)
{
    /* GIVEN indices and sub-indices that are none WHEN read and written THEN the abort tells which of the two it is */
    static const uint16_t none[] = {0x0000, 0x0005, 0x1002, 0x1015, 0x1021, 0x1404,
                                    0x1805, 0x1A05, 0x200F, 0x202E, 0x204E, 0x2000 + 0x100 + PARAMETER_COUNT,
                                    0x3009, 0x6042, 0xFFFF};
    for (unsigned k = 0; k < COUNT_OF(none); k++) {
        TEST_ASSERT_EQUAL_HEX32(ABORT_NO_OBJECT, read_object(none[k], 0));
        TEST_ASSERT_EQUAL_HEX32(ABORT_NO_OBJECT, write_number(none[k], 0, 0, 4));
    }
    static const uint16_t some[] = {0x1000, 0x1003, 0x1018, 0x1400, 0x1600, 0x1800, 0x1A00,
                                    0x2000, 0x2010, 0x2020, 0x2040, 0x2100, 0x3000, 0x6040};
    for (unsigned k = 0; k < COUNT_OF(some); k++) {
        TEST_ASSERT_EQUAL_HEX32(ABORT_NO_SUB_INDEX, read_object(some[k], 200));
        TEST_ASSERT_EQUAL_HEX32(ABORT_NO_SUB_INDEX, write_number(some[k], 200, 0, 4));
    }
}

static void test_communication_object_of_another_value(void)
{
    /* GIVEN an ECU just on WHEN its communication objects are read THEN they are those of node 1 */
    static const struct {
        uint16_t index;
        uint8_t sub, length;
        uint32_t value;
    } cases[] = {
        {0x1000, 0, 4, 0},
        {0x1001, 0, 1, 0},
        {0x1003, 0, 1, 0},
        {0x1005, 0, 4, 0x40000080},
        {0x1006, 0, 4, 1000},
        {0x1010, 0, 1, 1},
        {0x1010, 1, 4, 1},
        {0x1011, 1, 4, 1},
        {0x1014, 0, 4, 0x81},
        {0x1016, 0, 1, 1},
        {0x1016, 1, 4, 0x000201F4},
        {0x1017, 0, 2, 100},
        {0x1018, 0, 1, 4},
        {0x1018, 1, 4, 0},
        {0x1018, 2, 4, 0x43524144},
        {0x1018, 4, 4, 0},
        {0x1019, 0, 1, 240},
        {0x1200, 1, 4, 0x601},
        {0x1200, 2, 4, 0x581},
        {0x2001, 0, 4, DIARC_DBC_HASH},
        {0x2003, 0, 4, PARAMETER_LAYOUT_HASH},
        {0x2002, 0, 4, 0},
        {0x200E, 0, 2, 65535},
        {0x1400, 1, 4, 0x201},
        {0x1401, 1, 4, 0x182},
        {0x1800, 0, 1, 2},
        {0x1800, 1, 4, 0x40000181},
        {0x1800, 2, 1, 10},
        {0x1804, 1, 4, 0x40000202},
        {0x1804, 2, 1, 1},
        {0x1A00, 4, 4, 0x30040418},
    };
    for (unsigned k = 0; k < COUNT_OF(cases); k++) {
        char name[16];
        (void)snprintf(name, sizeof name, "%04X:%u", cases[k].index, cases[k].sub);
        TEST_ASSERT_EQUAL_HEX32_MESSAGE(cases[k].value, number(cases[k].index, cases[k].sub), name);
        TEST_ASSERT_EQUAL_UINT32_MESSAGE(cases[k].length, got.length, name);
    }
    static const struct {
        uint16_t index;
        const char *text;
    } texts[] = {{0x1008, "DIARC ECU"}, {0x1009, SCALAR_NAME}, {0x100A, SOFTWARE_VERSION}};
    for (unsigned k = 0; k < COUNT_OF(texts); k++) {
        TEST_ASSERT_EQUAL_HEX32(0, read_object(texts[k].index, 0));
        TEST_ASSERT_EQUAL_UINT32(strlen(texts[k].text), got.length);
        TEST_ASSERT_EQUAL_MEMORY(texts[k].text, got.bytes, got.length);
    }
}

static void test_state_object_of_another_value(void)
{
    /* GIVEN an ECU with a past WHEN its mode, counters and fault are read THEN they are those of its frames */
    to_standby();
    queue_request(3, 0); /* MOVE: not in RUN */
    tick();
    TEST_ASSERT_EQUAL_UINT32(MODE_STANDBY, number(0x2004, 0));
    TEST_ASSERT_EQUAL_UINT32(REFUSAL_NOT_IN_RUN, number(0x2006, 0));
    TEST_ASSERT_EQUAL_UINT32(0, number(0x2005, 0));
    TEST_ASSERT_EQUAL_UINT32(0, number(0x2007, 0));
    power_on();
    to_fault();
    TEST_ASSERT_EQUAL_UINT32(MODE_FAULT, number(0x2004, 0));
    TEST_ASSERT_EQUAL_UINT32(FAULT_SENSOR_FRAMES_LOST, number(0x2005, 0));
    TEST_ASSERT_EQUAL_UINT32(1u << FAULT_SENSOR_FRAMES_LOST, number(0x2007, 0));
    TEST_ASSERT_EQUAL_UINT32(0x11, number(0x1001, 0)); /* generic, communication */
    TEST_ASSERT_TRUE(ecu.counters.late_ticks > 5u);
    TEST_ASSERT_EQUAL_UINT32(ecu.counters.late_ticks, number(0x200A, 0));
    TEST_ASSERT_EQUAL_UINT32(3u * ecu.counters.late_ticks, number(0x200B, 0));
    TEST_ASSERT_EQUAL_UINT32(1000, number(0x2008, 0));
    ecu.counters.send_drops = 0x1234;
    ecu.receive.refused = 7;
    ecu.counters.tick_time_us = 321;
    TEST_ASSERT_EQUAL_UINT32(0x1234, number(0x200D, 0));
    TEST_ASSERT_EQUAL_UINT32(7, number(0x200C, 0));
    TEST_ASSERT_EQUAL_UINT32(0, number(0x2009, 0)); /* of the tick that answered: this clock stands */
}

static void test_estimate_of_another_unit(void)
{
    /* GIVEN an estimate WHEN read THEN it is the prior, in SI, and its standard deviation is the prior's */
    static const char *const priors[] = {
        "m_t_kg",         "J_kgm2",         "m2_kg",          "fv_swing_Nms_rad", "fv_wrist_Nms_rad",
        "fc_swing_Nm",    "fc_wrist_Nm",    "Om1_swing_Nm",   "Om1_wrist_Nm",     "beta_inverse_1_Pa",
        "Om2_swing_m3_s", "Om3_swing_m3_s", "Om2_wrist_m3_s", "Om3_wrist_m3_s"};
    for (uint16_t k = 0; k < COUNT_OF(priors); k++) {
        char name[64];
        (void)snprintf(name, sizeof name, "estimator.prior.%s.value", priors[k]);
        const double value = default_value(name);
        (void)snprintf(name, sizeof name, "estimator.prior.%s.sd", priors[k]);
        const double sd = default_value(name);
        (void)snprintf(name, sizeof name, "estimator.prior.%s.high", priors[k]);
        const double range = default_value(name);
        const int base = k < THETA_M                   ? base_torque(&ecu.bases)
                         : k == THETA_M + BETA_INVERSE ? -ecu.bases.pressure
                                                       : base_volume(&ecu.bases);
        const double step = ldexp(STEP, base);
        TEST_ASSERT_DOUBLE_WITHIN_MESSAGE(1e-6 * fabs(value) + step, value, real32((uint16_t)(0x2020 + k)),
                                          name);
        TEST_ASSERT_DOUBLE_WITHIN_MESSAGE(2e-3 * sd + 1e-5 * range + step, sd, real32((uint16_t)(0x2040 + k)),
                                          name);
    }
    ecu.controller.estimator.theta_m[M_T] = per_unit(3.25, base_torque(&ecu.bases));
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, 3.25, real32(0x2010));
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, 3.25, real32(0x2020));
    ecu.controller.estimator.theta_m[M_T] = per_unit(-1.5, base_torque(&ecu.bases));
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, -1.5, real32(0x2010));
    TEST_ASSERT_TRUE(real32(0x2011) == real32(0x2040));
}

static void test_signal_is_not_that_of_the_frame(void)
{
    /* GIVEN frames sent and heard WHEN their objects are read THEN they are the signals' raw values, with their sign */
    to_standby();
    ecu.controller.estimator.theta_m[M_T] = per_unit(-0.75, base_torque(&ecu.bases));
    for (int k = 0; k < 10; k++) {
        tick();
    }
    TEST_ASSERT_EQUAL_UINT32(MODE_STANDBY, number(0x3004, 3));
    TEST_ASSERT_INT_WITHIN(1, 0x1000000 - 7500, (int)number(0x3004, 4));
    TEST_ASSERT_EQUAL_UINT32(3, got.length);
    TEST_ASSERT_EQUAL_UINT32(267017, number(0x3001, 4));
    TEST_ASSERT_EQUAL_UINT32(14628, number(0x3002, 5));
    TEST_ASSERT_EQUAL_UINT32(8412, number(0x3003, 4));
    TEST_ASSERT_EQUAL_UINT32(1, number(0x3008, 6)); /* SwingControl: disabled */
    /* the mapping names each of them, and they fill the frame without a gap */
    for (uint16_t k = 0; k < OBJECT_PDOS; k++) {
        const uint16_t index = (uint16_t)(k < 4 ? 0x1600 + k : 0x1A00 + k - 4);
        const uint32_t count = number(index, 0);
        uint32_t bits = 0;
        for (uint8_t sub = 1; sub <= count; sub++) {
            const uint32_t entry = number(index, sub);
            TEST_ASSERT_EQUAL_HEX32(0x3000u + k, entry >> 16);
            TEST_ASSERT_EQUAL_UINT32(sub, entry >> 8 & 0xFFu);
            bits += entry & 0xFFu;
            TEST_ASSERT_EQUAL_HEX32(0, read_object((uint16_t)(entry >> 16), sub));
            TEST_ASSERT_TRUE(got.length * 8u >= (entry & 0xFFu));
        }
        TEST_ASSERT_TRUE(bits > 56u && bits <= 64u);
    }
}

/* ---- writing ---- */

static void check_refused(uint16_t index, uint8_t sub, const struct object *object)
{
    struct object same = *object;
    if (object_may_write(&ecu, &same) != OBJECT_DONE) {
        const uint8_t length = object_length(object) <= 4u ? (uint8_t)object_length(object) : 4u;
        TEST_ASSERT_EQUAL_HEX32(ABORT_READ_ONLY, write_number(index, sub, 0, length));
    }
}

static void test_read_only_object_written(void)
{
    /* GIVEN every object that is read only WHEN written THEN it is aborted as that; those that are not are known */
    (void)for_each_object(check_refused);
    static const uint16_t writable[] = {0x1017, 0x2000, 0x2002, 0x2100, 0x6040};
    for (unsigned k = 0; k < COUNT_OF(writable); k++) {
        struct object object;
        TEST_ASSERT_EQUAL_HEX32(OBJECT_DONE, object_find(writable[k], 0, &object));
        TEST_ASSERT_EQUAL_HEX32(OBJECT_DONE, object_may_write(&ecu, &object));
    }
}

static void test_parameter_outside_its_limits_taken(void)
{
    /* GIVEN every parameter WHEN a number below, above, not finite or none is written THEN the abort tells which, and
     * neither image nor machine has changed */
    const struct machine machine = ecu.machine;
    for (uint16_t k = 0; k < PARAMETER_COUNT; k++) {
        const uint16_t index = (uint16_t)(FIRST_PARAMETER + k);
        TEST_ASSERT_EQUAL_HEX32(image_u32(&default_parameter_image, IMAGE_HEADER_BYTES + 4u * k),
                                number(index, 0));
        TEST_ASSERT_EQUAL_HEX32(ABORT_TOO_LOW, write_number(index, 0, bits_of(-3e38), 4));
        TEST_ASSERT_EQUAL_HEX32(ABORT_TOO_HIGH, write_number(index, 0, bits_of(3e38), 4));
        TEST_ASSERT_EQUAL_HEX32(ABORT_RANGE, write_number(index, 0, 0x7FC00000u, 4));
        TEST_ASSERT_EQUAL_HEX32(ABORT_RANGE, write_number(index, 0, 0x7F800000u, 4));
        TEST_ASSERT_EQUAL_HEX32(ABORT_RANGE, write_number(index, 0, 0xFF800000u, 4));
        TEST_ASSERT_EQUAL_UINT32(k, number(0x200E, 0));
    }
    TEST_ASSERT_EQUAL_MEMORY(&default_parameter_image, &ecu.image, sizeof ecu.image);
    TEST_ASSERT_EQUAL_MEMORY(&machine, &ecu.machine, sizeof machine);
}

static void test_parameters_that_contradict_taken(void)
{
    /* GIVEN a rod thicker than its bore, a prior above its bound, a crank at its dead point WHEN written THEN it is refused, and nothing has changed */
    static const struct {
        const char *name;
        double value;
    } cases[] = {{"swing.rod_m", 0.045}, {"estimator.prior.m_t_kg.value", 1e3}, {"wrist.crank_q0_rad", 3.0}};
    const struct machine machine = ecu.machine;
    for (unsigned k = 0; k < COUNT_OF(cases); k++) {
        TEST_ASSERT_EQUAL_HEX32_MESSAGE(ABORT_INCOMPATIBLE,
                                        write_number(FIRST(cases[k].name), 0, bits_of(cases[k].value), 4),
                                        cases[k].name);
        TEST_ASSERT_EQUAL_UINT32(entry_named(cases[k].name), number(0x200E, 0));
    }
    TEST_ASSERT_EQUAL_MEMORY(&default_parameter_image, &ecu.image, sizeof ecu.image);
    TEST_ASSERT_EQUAL_MEMORY(&machine, &ecu.machine, sizeof machine);
}

static void test_parameter_too_large_for_fixed_point_taken(void)
{
    /* GIVEN a bound that only floating point holds WHEN written THEN fixed point refuses it */
    TEST_ASSERT_EQUAL_HEX32(BY_TYPE(0, 0, (uint32_t)ABORT_RANGE),
                            write_number(FIRST("estimator.prior.fc_swing_Nm.high"), 0, bits_of(9e5), 4));
}

static void test_parameter_written_by_half(void)
{
    /* GIVEN an estimate that has moved WHEN a parameter is written THEN machine, bases, constants and image are those
     * of an ECU started with it, and the estimate is at the priors */
    static struct ecu fresh;
    uint16_t entry;
    to_standby();
    ecu.controller.estimator.theta_m[M_T] = per_unit(2, base_torque(&ecu.bases));
    TEST_ASSERT_EQUAL_HEX32(0, write_number(FIRST("wrist.q_max_rad"), 0, bits_of(1.0), 4));
    TEST_ASSERT_EQUAL_HEX32(0, write_number(FIRST("estimator.filter_time_s"), 0, bits_of(0.02), 4));
    TEST_ASSERT_DOUBLE_WITHIN(1e-7, 1.0, real32(FIRST("wrist.q_max_rad")));
    struct parameter_image image = default_parameter_image;
    image_set_u32(&image, IMAGE_HEADER_BYTES + 4u * entry_named("wrist.q_max_rad"), bits_of(1.0));
    image_set_u32(&image, IMAGE_HEADER_BYTES + 4u * entry_named("estimator.filter_time_s"), bits_of(0.02));
    image_seal(&image);
    TEST_ASSERT_EQUAL_INT(ECU_OK, ecu_init(&fresh, &image, 1000, &entry));
    TEST_ASSERT_EQUAL_MEMORY(&image, &ecu.image, sizeof image);
    TEST_ASSERT_EQUAL_MEMORY(&fresh.machine, &ecu.machine, sizeof fresh.machine);
    TEST_ASSERT_EQUAL_MEMORY(&fresh.constants, &ecu.constants, sizeof fresh.constants);
    TEST_ASSERT_TRUE(ecu.controller.estimator.theta_m[M_T] == ecu.machine.estimator.m[M_T].value);
    TEST_ASSERT_EQUAL_UINT32(65535, number(0x200E, 0));
}

static void test_tare_of_another_base_kept(void)
{
    /* GIVEN tared sensors WHEN an image with another pressure base is taken THEN the tare is cleared; with the same
     * base it stays */
    struct parameter_image image = default_parameter_image;
    to_standby();
    ecu.tare.offset[SWING][BORE] = SCALAR(0.01);
    TEST_ASSERT_EQUAL_HEX32(0, write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 99));
    TEST_ASSERT_TRUE(ecu.tare.offset[SWING][BORE] == SCALAR(0.01));
    image.bytes[8] = (uint8_t)(image.bytes[8] + 2u);
    image_seal(&image);
    TEST_ASSERT_EQUAL_HEX32(0, write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 99));
    TEST_ASSERT_TRUE(ecu.tare.offset[SWING][BORE] == SCALAR(0));
}

static void test_machine_changed_under_a_moving_arm(void)
{
    /* GIVEN every mode WHEN parameters are written, saved and restored THEN only INIT, STANDBY and FAULT allow it */
    static const struct {
        enum ecu_mode mode;
        bool allowed;
    } cases[] = {
        {MODE_INIT, true}, {MODE_STANDBY, true}, {MODE_FAULT, true}, {MODE_TARE, false}, {MODE_RUN, false}};
    for (unsigned k = 0; k < COUNT_OF(cases); k++) {
        power_on();
        switch (cases[k].mode) {
        case MODE_STANDBY:
            to_standby();
            break;
        case MODE_TARE:
            to_standby();
            queue_request(5, 0);
            tick();
            break;
        case MODE_RUN:
            to_run();
            break;
        case MODE_FAULT:
            to_fault();
            break;
        case MODE_INIT:
        default:
            break;
        }
        TEST_ASSERT_EQUAL_INT(cases[k].mode, ecu.mode);
        const uint32_t expected = cases[k].allowed ? 0u : (uint32_t)ABORT_STATE;
        TEST_ASSERT_EQUAL_HEX32(expected, write_number(FIRST("wrist.q_max_rad"), 0, bits_of(1.0), 4));
        TEST_ASSERT_EQUAL_HEX32(expected, write_number(0x1010, 1, 0x65766173, 4));
        TEST_ASSERT_EQUAL_HEX32(expected, write_number(0x1011, 1, 0x64616F6C, 4));
        TEST_ASSERT_EQUAL_HEX32(0, write_number(0x1017, 0, 50, 2));
        TEST_ASSERT_EQUAL_HEX32(0, write_number(0x2002, 0, DIARC_DBC_HASH, 4));
        TEST_ASSERT_EQUAL_HEX32(DIARC_DBC_HASH, number(0x2002, 0));
        TEST_ASSERT_EQUAL_INT(cases[k].mode, ecu.mode);
        if (!cases[k].allowed) {
            TEST_ASSERT_EQUAL_MEMORY(&default_parameter_image, &ecu.image, sizeof ecu.image);
        }
    }
}

static void test_master_of_another_dbc_not_told(void)
{
    /* GIVEN a master that writes the hash of its DBC WHEN it is another THEN the ECU is in FAULT and says so */
    to_standby();
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x2002, 0, DIARC_DBC_HASH ^ 1u, 4));
    tick();
    TEST_ASSERT_EQUAL_UINT32(MODE_FAULT, number(0x2004, 0));
    TEST_ASSERT_EQUAL_UINT32(FAULT_DBC_MISMATCH, number(0x2005, 0));
    TEST_ASSERT_EQUAL_UINT32(FAULT_DBC_MISMATCH, number(0x1003, 1) >> 16);
}

static void test_parameter_written_between_request_and_run(void)
{
    /* GIVEN a request to run and a write in the same tick WHEN the tick ends THEN the write was refused */
    to_standby();
    queue_request(2, CONTROLLER_DIARC);
    TEST_ASSERT_EQUAL_HEX32(ABORT_STATE, write_number(FIRST("wrist.q_max_rad"), 0, bits_of(1.0), 4));
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
}

/* ---- memory ---- */

static void test_saved_set_is_not_the_one_in_force(void)
{
    /* GIVEN a changed parameter WHEN saved THEN the memory holds it; when the default is restored THEN it holds none,
     * and the set in force stays until the next start */
    struct parameter_image stored;
    TEST_ASSERT_EQUAL_HEX32(0, write_number(FIRST("wrist.q_max_rad"), 0, bits_of(1.0), 4));
    TEST_ASSERT_EQUAL_INT(STORE_EMPTY, store_load(&FLASH, &stored));
    TEST_ASSERT_EQUAL_HEX32(ABORT_NOT_STORED, write_number(0x1010, 1, 0x65766174, 4));
    TEST_ASSERT_EQUAL_HEX32(ABORT_NOT_STORED, write_number(0x1010, 1, 0x64616F6C, 4));
    TEST_ASSERT_EQUAL_HEX32(ABORT_NOT_STORED, write_number(0x1011, 1, 0x65766173, 4));
    TEST_ASSERT_EQUAL_INT(STORE_EMPTY, store_load(&FLASH, &stored));
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x1010, 1, 0x65766173, 4));
    TEST_ASSERT_EQUAL_INT(STORE_OK, store_load(&FLASH, &stored));
    TEST_ASSERT_EQUAL_MEMORY(&ecu.image, &stored, sizeof stored);
    const struct parameter_image before = ecu.image;
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x1011, 1, 0x64616F6C, 4));
    TEST_ASSERT_EQUAL_INT(STORE_EMPTY, store_load(&FLASH, &stored));
    TEST_ASSERT_EQUAL_MEMORY(&before, &ecu.image, sizeof before);
}

static void test_save_that_failed_reported_done(void)
{
    /* GIVEN a memory that fails, or none WHEN saved THEN the abort tells which, and 1010h reads 0 where there is none */
    flash.broken = true;
    TEST_ASSERT_EQUAL_HEX32(ABORT_HARDWARE, write_number(0x1010, 1, 0x65766173, 4));
    TEST_ASSERT_EQUAL_HEX32(ABORT_HARDWARE, write_number(0x1011, 1, 0x64616F6C, 4));
    the_port.store = NULL;
    TEST_ASSERT_EQUAL_HEX32(ABORT_NOT_STORED, write_number(0x1010, 1, 0x65766173, 4));
    TEST_ASSERT_EQUAL_HEX32(ABORT_NOT_STORED, write_number(0x1011, 1, 0x64616F6C, 4));
    TEST_ASSERT_EQUAL_UINT32(0, number(0x1010, 1));
    TEST_ASSERT_EQUAL_UINT32(0, number(0x1011, 1));
}

/* ---- errors, heartbeat, words ---- */

static void test_error_history_in_another_order(void)
{
    /* GIVEN ten faults of two kinds WHEN 1003h is read THEN it has the last eight, newest first; writing anything but
     * 0 is refused; 0 clears it */
    TEST_ASSERT_EQUAL_HEX32(ABORT_NO_DATA, read_object(0x1003, 1));
    to_standby();
    for (int k = 0; k < 10; k++) {
        queue_request(2, CONTROLLER_DIARC);
        tick();
        fall_silent();
        if (k == 9) {
            break;
        }
        TEST_ASSERT_EQUAL_UINT32(k < 8 ? (uint32_t)k + 1u : 8u, number(0x1003, 0));
        queue_request(4, 0);
        ticks(2);
        TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
        TEST_ASSERT_EQUAL_UINT32(0, number(0x1001, 0));
    }
    emergency_note(&ecu.emergencies, 0x5000, FAULT_SENSOR_INVALID);
    TEST_ASSERT_EQUAL_UINT32(8, number(0x1003, 0));
    TEST_ASSERT_EQUAL_HEX32(0x00025000, number(0x1003, 1));
    for (uint8_t k = 2; k <= 8; k++) {
        TEST_ASSERT_EQUAL_HEX32(0x00018100, number(0x1003, k));
    }
    TEST_ASSERT_EQUAL_UINT32(0x11, number(0x1001, 0));
    TEST_ASSERT_EQUAL_HEX32(ABORT_NO_SUB_INDEX, read_object(0x1003, 9));
    TEST_ASSERT_EQUAL_HEX32(ABORT_RANGE, write_number(0x1003, 0, 1, 1));
    TEST_ASSERT_EQUAL_UINT32(8, number(0x1003, 0));
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x1003, 0, 0, 1));
    TEST_ASSERT_EQUAL_UINT32(0, number(0x1003, 0));
    TEST_ASSERT_EQUAL_HEX32(ABORT_NO_DATA, read_object(0x1003, 1));
}

static unsigned heartbeats_in(unsigned count)
{
    unsigned heard = 0;
    for (unsigned k = 0; k < count; k++) {
        tick();
        heard += sent(0x701) != NULL ? 1u : 0u;
    }
    return heard;
}

/* ---- what the SDO server never asks ---- */

static void test_text_or_image_read_as_a_number(void)
{
    /* GIVEN an object that is no number WHEN its number is asked for all the same THEN it is 0, not what was there */
    static const uint16_t none[] = {0x1008, 0x2000};
    for (unsigned k = 0; k < COUNT_OF(none); k++) {
        struct object object;
        uint32_t value = 0xA5A5A5A5u;
        TEST_ASSERT_EQUAL_HEX32(OBJECT_DONE, object_find(none[k], 0, &object));
        TEST_ASSERT_FALSE(object_is_number(&object));
        TEST_ASSERT_EQUAL_HEX32(OBJECT_DONE, object_read(&ecu, &the_port, &object, &value));
        TEST_ASSERT_EQUAL_HEX32(0, value);
    }
}

static void test_image_written_as_a_number(void)
{
    /* GIVEN the image, all or nothing by segments WHEN written as a number THEN refused, and nothing has changed */
    static struct ecu before;
    struct object object;
    to_standby();
    TEST_ASSERT_EQUAL_HEX32(OBJECT_DONE, object_find(0x2000, 0, &object));
    TEST_ASSERT_EQUAL_HEX32(OBJECT_DONE, object_may_write(&ecu, &object));
    memcpy(&before, &ecu, sizeof ecu);
    TEST_ASSERT_EQUAL_HEX32(ABORT_READ_ONLY, object_write(&ecu, &the_port, &object, 0));
    TEST_ASSERT_EQUAL_HEX32(ABORT_RANGE, object_write(&ecu, &the_port, &object, 1));
    TEST_ASSERT_EQUAL_MEMORY(&before, &ecu, sizeof ecu);
}

static void test_write_begun_in_standby_ends_in_run(void)
{
    /* GIVEN a parameter written in segments WHEN the arm starts between request and segment THEN refused then, and
     * the parameter is as it was; and so is an object that is read only, whoever asks */
    struct object object;
    to_standby();
    const uint16_t index = FIRST("control.wrist.k1_1_s");
    const uint32_t before = number(index, 0);
    TEST_ASSERT_EQUAL_HEX8(0x60, ask_for(0x21, index, 0, 4)[0]);
    queue_request(2, CONTROLLER_DIARC);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
    const uint8_t segment[8] = {0x07, 0, 0, 0x80, 0x3F};
    const uint8_t *const answer = ask(segment);
    TEST_ASSERT_NOT_NULL(answer);
    TEST_ASSERT_EQUAL_HEX32(ABORT_STATE, abort_of(answer, index, 0));
    TEST_ASSERT_EQUAL_HEX32(before, number(index, 0));
    TEST_ASSERT_EQUAL_HEX32(OBJECT_DONE, object_find(0x2001, 0, &object));
    TEST_ASSERT_EQUAL_HEX32(ABORT_READ_ONLY, object_write(&ecu, &the_port, &object, 0));
}

static void test_heartbeat_time_ignored(void)
{
    /* GIVEN a heartbeat every 100 ms WHEN 1017h is written THEN it comes at that time, at once when that is shorter,
     * never with 0, and after a reset as before */
    TEST_ASSERT_EQUAL_UINT(10, heartbeats_in(1000));
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x1017, 0, 60000, 2));
    TEST_ASSERT_EQUAL_UINT(1, heartbeats_in(1000));
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x1017, 0, 10, 2));
    TEST_ASSERT_EQUAL_UINT(10, heartbeats_in(100));
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x1017, 0, 0, 2));
    TEST_ASSERT_EQUAL_UINT(0, heartbeats_in(1000));
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x1017, 0, 1, 2));
    TEST_ASSERT_EQUAL_UINT(100, heartbeats_in(100));
    queue_nmt(129);
    tick();
    TEST_ASSERT_EQUAL_UINT(10, heartbeats_in(1000));
    TEST_ASSERT_EQUAL_UINT32(100, number(0x1017, 0));
}

static void test_watched_node_out_of_range_taken(void)
{
    /* GIVEN 1016h WHEN node and time are written THEN they are kept; more than 127 nodes there are not */
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x1016, 1, 127u << 16 | 500u, 4));
    TEST_ASSERT_EQUAL_HEX32(127u << 16 | 500u, number(0x1016, 1));
    TEST_ASSERT_EQUAL_HEX32(127u << 16 | 500u, ecu.heartbeat_consumer);
    TEST_ASSERT_EQUAL_HEX32(ABORT_RANGE, write_number(0x1016, 1, 128u << 16 | 500u, 4));
    TEST_ASSERT_EQUAL_HEX32(ABORT_RANGE, write_number(0x1016, 1, 0x01000000u, 4));
    TEST_ASSERT_EQUAL_HEX32(127u << 16 | 500u, number(0x1016, 1));
}

static void test_silence_of_the_node_before_blamed_on_the_next(void)
{
    /* GIVEN RUN with the I/O node watched and heard WHEN another node is watched in its place, for a shorter time THEN
     * no fault before that one was heard once */
    to_run();
    queue((struct can_frame_11bit){.id = 0x702, .length = 1, .data = {5}});
    ticks(400);
    TEST_ASSERT_TRUE(ecu.supervision.consumer_heard);
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x1016, 1, 3u << 16 | 100u, 4));
    ticks(200);
    TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
    queue((struct can_frame_11bit){.id = 0x703, .length = 1, .data = {5}});
    ticks(102);
    TEST_ASSERT_EQUAL_HEX32(1u << FAULT_HEARTBEAT_LOST, ecu.active_faults);
}

static void test_control_word_not_followed(void)
{
    /* GIVEN the control word WHEN written THEN modes follow as their requests would, or it is refused for the state
     * with the reason in 2006h; the status word mirrors the mode; a word that is none is out of range */
    TEST_ASSERT_EQUAL_HEX16(0x8, number(0x6041, 0));
    TEST_ASSERT_EQUAL_HEX32(ABORT_STATE, write_number(0x6040, 0, 0x7, 2));
    TEST_ASSERT_EQUAL_UINT32(REFUSAL_NOT_IN_STANDBY, number(0x2006, 0));
    to_standby();
    TEST_ASSERT_EQUAL_HEX16(0x9, number(0x6041, 0));
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x6040, 0, 0x7, 2));
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
    TEST_ASSERT_EQUAL_INT(CONTROLLER_DIARC, ecu.controller.kind);
    TEST_ASSERT_EQUAL_HEX16(0xF, number(0x6041, 0));
    TEST_ASSERT_EQUAL_HEX16(0x7, number(0x6040, 0));
    static const uint16_t none[] = {0x2, 0x4, 0x5, 0x6, 0x10, 0x8000, 0xFFFF};
    for (unsigned k = 0; k < COUNT_OF(none); k++) {
        TEST_ASSERT_EQUAL_HEX32(ABORT_RANGE, write_number(0x6040, 0, none[k], 2));
    }
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x6040, 0, 0x3, 2));
    tick(); /* the answer goes out after the law's work of its tick */
    TEST_ASSERT_EQUAL_INT(MODE_HOLD, ecu.mode);
    TEST_ASSERT_EQUAL_HEX16(0xB, number(0x6041, 0));
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x6040, 0, 0x1, 2));
    TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
    TEST_ASSERT_EQUAL_HEX32(ABORT_STATE, write_number(0x6040, 0, 0x7, 2));
    TEST_ASSERT_EQUAL_UINT32(REFUSAL_STOPPING, number(0x2006, 0));
    ticks(300);
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    power_on();
    to_fault();
    TEST_ASSERT_EQUAL_HEX16(0x1, number(0x6041, 0));
    TEST_ASSERT_EQUAL_HEX32(ABORT_STATE, write_number(0x6040, 0, 0x7, 2));
    TEST_ASSERT_EQUAL_HEX32(0, write_number(0x6040, 0, 0x8, 2));
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_object_that_is_there_not_readable);
    RUN_TEST(test_object_that_is_not_there_read_or_written);
    RUN_TEST(test_communication_object_of_another_value);
    RUN_TEST(test_state_object_of_another_value);
    RUN_TEST(test_estimate_of_another_unit);
    RUN_TEST(test_signal_is_not_that_of_the_frame);
    RUN_TEST(test_read_only_object_written);
    RUN_TEST(test_parameter_outside_its_limits_taken);
    RUN_TEST(test_parameters_that_contradict_taken);
    RUN_TEST(test_parameter_too_large_for_fixed_point_taken);
    RUN_TEST(test_parameter_written_by_half);
    RUN_TEST(test_tare_of_another_base_kept);
    RUN_TEST(test_machine_changed_under_a_moving_arm);
    RUN_TEST(test_master_of_another_dbc_not_told);
    RUN_TEST(test_parameter_written_between_request_and_run);
    RUN_TEST(test_saved_set_is_not_the_one_in_force);
    RUN_TEST(test_save_that_failed_reported_done);
    RUN_TEST(test_error_history_in_another_order);
    RUN_TEST(test_text_or_image_read_as_a_number);
    RUN_TEST(test_image_written_as_a_number);
    RUN_TEST(test_write_begun_in_standby_ends_in_run);
    RUN_TEST(test_heartbeat_time_ignored);
    RUN_TEST(test_watched_node_out_of_range_taken);
    RUN_TEST(test_silence_of_the_node_before_blamed_on_the_next);
    RUN_TEST(test_control_word_not_followed);
    return UNITY_END();
}
