/* Loading the parameter image (ecu/parameters): every way it can be wrong, and the built-in one. */
#include <float.h>
#include <stddef.h>

#include "ecu/ecu.h"
#include "testing.h"

/* Relative: powers of two bring per unit, so nothing is lost. */
#define TOLERANCE BY_TYPE(1e-15, 1e-7, 0)
#define HALF_STEP BY_TYPE(0, 0, 0x1p-25) /* per unit; fixed point has no more digits */
#define HALF_STEP_GAIN BY_TYPE(0, 0, 0x1p-19)

/* The generated tables, for their ranges. */
#define FIELD(name) offsetof(struct machine, name)
static const struct {
    size_t offset;
    uint8_t quantity;
    uint8_t low, high;
} TABLE[PARAMETER_COUNT] = {
#include "ecu/generated/parameter_table.inc"
};

static const uint32_t LIMITS[] = {
#include "ecu/generated/parameter_limits.inc"
};

#define CRC_OFFSET (PARAMETER_IMAGE_BYTES - 4u)
#define UNTOUCHED 0xA5

static struct parameter_image image;
static struct machine machine;
static struct bases bases;
static uint16_t entry;

static void mark(void)
{
    memset(&machine, UNTOUCHED, sizeof machine);
    memset(&bases, UNTOUCHED, sizeof bases);
    entry = UINT16_MAX;
}

void setUp(void)
{
    image = default_parameter_image;
    mark();
}

void tearDown(void)
{
}

static void expect_untouched(void)
{
    TEST_ASSERT_EACH_EQUAL_HEX8(UNTOUCHED, &machine, (uint32_t)sizeof machine);
    TEST_ASSERT_EACH_EQUAL_HEX8(UNTOUCHED, &bases, (uint32_t)sizeof bases);
}

static void expect_refused(enum ecu_status status)
{
    mark();
    TEST_ASSERT_EQUAL_INT(status, parameters_load(&machine, &bases, &image, &entry));
    expect_untouched();
}

static void set_parameter(uint16_t k, uint32_t bits)
{
    image_set_u32(&image, IMAGE_HEADER_BYTES + 4u * k, bits);
    image_seal(&image);
}

static uint32_t get_parameter(uint16_t k)
{
    return image_u32(&image, IMAGE_HEADER_BYTES + 4u * k);
}

static uint32_t bits_of(float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

static float number_of(uint32_t bits)
{
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static void test_built_in_machine_refused(void)
{
    /* GIVEN the image that is built in WHEN loaded THEN no error, and its header's bases */
    TEST_ASSERT_EQUAL_INT(ECU_OK, parameters_load(&machine, &bases, &image, &entry));
    TEST_ASSERT_EQUAL_INT8((int8_t)image.bytes[8], bases.pressure);
    TEST_ASSERT_EQUAL_INT8((int8_t)image.bytes[9], bases.area);
    TEST_ASSERT_EQUAL_INT8((int8_t)image.bytes[10], bases.lever);
}

static void test_parameter_lands_in_another_field(void)
{
    /* GIVEN the built-in image WHEN loaded THEN fields of every quantity hold the named number, over its base
     * */
    TEST_ASSERT_EQUAL_INT(ECU_OK, parameters_load(&machine, &bases, &image, &entry));
    const int p = bases.pressure;
    const int A = bases.area;
    const int r = bases.lever;
    const struct {
        const char *name;
        double per_unit;
        int base_log2;
        bool is_gain;
    } expected[] = {
        {"arm.gravity_m_s2", real(machine.arm.g), 0, false},
        {"arm.swing_inertia_kgm2", real(machine.arm.I1), p + A + r, false},
        {"wrist.link_length_m", real(machine.arm.L2), 0, false},
        {"supply.tank_Pa", real(machine.supply.p_tank), p, false},
        {"wrist.bore_m", real(machine.cylinder[WRIST].bore), A / 2, false},
        {"swing.dead_volume_m3", real(machine.cylinder[SWING].dead_volume), A + r, false},
        {"wrist.crank_b_m", real(machine.cylinder[WRIST].b), r, false},
        {"swing.valve_kv", real(machine.cylinder[SWING].kv), A + r - p / 2, false},
        {"wrist.leakage_m3_s_Pa", real(machine.cylinder[WRIST].leakage), A + r - p, false},
        {"control.observer_rad_s", real_gain(machine.observer_bandwidth), 0, true},
        {"control.swing.k1_1_s", real_gain(machine.diarc[SWING].k1), 0, true},
        {"control.wrist.k3_1_s", real_gain(machine.diarc[WRIST].k3), 0, true},
        {"control.swing.w1_over_w2_m", real(machine.diarc[SWING].w1_over_w2), A - r, false},
        {"control.swing.eta1_Nm_rad_s", real(machine.diarc[SWING].eta1), p + A + r, false},
        {"control.wrist.eta2_Nm2_s", real(machine.diarc[WRIST].eta2), p + 2 * A, false},
        {"control.wrist.gamma1_max_Nm", real(machine.diarc[WRIST].gamma1_max), p + A + r, false},
        {"control.swing.gamma2_max_m2_s", real(machine.diarc[SWING].gamma2_max), A, false},
        {"control.wrist.pid_kp", real_gain(machine.pid[WRIST].kp), 0, true},
        {"estimator.filter_time_s", real(machine.estimator.filter_time), 0, false},
        {"estimator.swing.torque_noise_Nm", real(machine.estimator.torque_noise[SWING]), p + A + r, false},
        {"estimator.wrist.flow_noise_m2_s", real(machine.estimator.flow_noise[WRIST]), A, false},
        {"estimator.load_walk_kg", real(machine.estimator.load_walk), p + A + r, false},
        {"estimator.prior.m_t_kg.sd", real(machine.estimator.m[M_T].sd), p + A + r, false},
        {"estimator.prior.m_t_kg.low", real(machine.estimator.m[M_T].low), p + A + r, false},
        {"estimator.prior.fc_wrist_Nm.value", real(machine.estimator.m[FC2].value), p + A + r, false},
        {"estimator.prior.Om1_wrist_Nm.high", real(machine.estimator.m[OM2].high), p + A + r, false},
        {"estimator.prior.beta_inverse_1_Pa.value", real(machine.estimator.h[BETA_INVERSE].value), -p, false},
        {"estimator.prior.Om3_swing_m3_s.sd", real(machine.estimator.h[OM3_SWING].sd), A + r, false},
        {"estimator.prior.Om3_wrist_m3_s.high", real(machine.estimator.h[OM3_WRIST].high), A + r, false},
    };
    for (unsigned k = 0; k < COUNT_OF(expected); k++) {
        const double si = default_value(expected[k].name);
        const double half_step = expected[k].is_gain ? HALF_STEP_GAIN : HALF_STEP;
        TEST_ASSERT_DOUBLE_WITHIN_MESSAGE(TOLERANCE * fabs(si) + ldexp(half_step, expected[k].base_log2), si,
                                          ldexp(expected[k].per_unit, expected[k].base_log2),
                                          expected[k].name);
    }
}

static void test_other_bases_make_another_machine(void)
{
    /* GIVEN other bases for the same numbers WHEN loaded THEN the same machine in SI */
    image.bytes[8] = 24;
    image.bytes[9] = (uint8_t)-10;
    image.bytes[10] = (uint8_t)-2;
    image_seal(&image);
    TEST_ASSERT_EQUAL_INT(ECU_OK, parameters_load(&machine, &bases, &image, &entry));
    TEST_ASSERT_EQUAL_INT8(24 - 10 - 2, base_torque(&bases));
    TEST_ASSERT_EQUAL_INT8(-10 - 2, base_volume(&bases));
    TEST_ASSERT_DOUBLE_WITHIN(1, 100e5, si_of(machine.supply.p_supply, 24));
    TEST_ASSERT_DOUBLE_WITHIN(1e-8, 0.032, si_of(machine.cylinder[SWING].bore, -5));
    TEST_ASSERT_DOUBLE_WITHIN(1e-14, 6e-8, si_of(machine.cylinder[SWING].kv, -12 - 12));
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, 5, si_of(machine.estimator.m[M2].value, 12));
}

static void test_other_file_taken_for_an_image(void)
{
    /* GIVEN an image whose first letters are others WHEN loaded THEN refused as no image, nothing touched */
    for (uint8_t k = 0; k < 4u; k++) {
        image = default_parameter_image;
        image.bytes[k] ^= 0x20;
        image_seal(&image);
        expect_refused(ECU_IMAGE_NOT_ONE);
    }
}

static void test_image_of_another_version_taken(void)
{
    /* GIVEN an image for another list of parameters WHEN loaded THEN refused by its hash, nothing touched */
    image_set_u32(&image, 4, PARAMETER_LAYOUT_HASH ^ 1u);
    image_seal(&image);
    expect_refused(ECU_IMAGE_OTHER_LAYOUT);
    image_set_u32(&image, 4, PARAMETER_LAYOUT_HASH ^ 0x80000000u);
    image_seal(&image);
    expect_refused(ECU_IMAGE_OTHER_LAYOUT);
}

static void test_damaged_image_taken(void)
{
    /* GIVEN an image in which any one bit flipped WHEN loaded THEN refused, nothing touched */
    for (uint32_t bit = 0; bit < 8u * PARAMETER_IMAGE_BYTES; bit++) {
        image.bytes[bit / 8u] ^= (uint8_t)(1u << (bit % 8u));
        expect_refused(bit < 32u   ? ECU_IMAGE_NOT_ONE
                       : bit < 64u ? ECU_IMAGE_OTHER_LAYOUT
                                   : ECU_IMAGE_DAMAGED);
        image.bytes[bit / 8u] ^= (uint8_t)(1u << (bit % 8u));
    }
}

static void expect_bases(enum ecu_status status, int pressure, int area, int lever)
{
    image.bytes[8] = (uint8_t)pressure;
    image.bytes[9] = (uint8_t)area;
    image.bytes[10] = (uint8_t)lever;
    image_seal(&image);
    if (status == ECU_OK) {
        const enum ecu_status found = parameters_load(&machine, &bases, &image, &entry);
#if defined(DIARC_SCALAR_FIXED)
        /* the bases are taken; with some the reference arm's numbers are too large for the type */
        TEST_ASSERT_TRUE(found == ECU_OK || found == ECU_PARAMETER_RANGE);
#else
        TEST_ASSERT_EQUAL_INT(ECU_OK, found);
#endif
    } else {
        expect_refused(status);
    }
}

static void test_bases_out_of_range_taken(void)
{
    /* GIVEN bases at the ends of their ranges, beyond them, odd where a root is taken, or with a torque base
     * out of its range WHEN loaded THEN taken, and else refused with nothing touched */
    expect_bases(ECU_OK, BASE_PRESSURE_LOW, -12, -3);
    expect_bases(ECU_OK, BASE_PRESSURE_HIGH, -12, -3);
    expect_bases(ECU_IMAGE_BASES, BASE_PRESSURE_LOW - 2, -12, -3);
    expect_bases(ECU_IMAGE_BASES, BASE_PRESSURE_HIGH + 2, -12, -3);
    expect_bases(ECU_IMAGE_BASES, 23, -12, -3);
    expect_bases(ECU_OK, 26, BASE_AREA_LOW, -3);
    expect_bases(ECU_OK, 20, BASE_AREA_HIGH, -3);
    expect_bases(ECU_IMAGE_BASES, 26, BASE_AREA_LOW - 2, -3);
    expect_bases(ECU_IMAGE_BASES, 20, BASE_AREA_HIGH + 2, -3);
    expect_bases(ECU_IMAGE_BASES, 22, -11, -3);
    expect_bases(ECU_OK, 22, -12, BASE_LEVER_LOW);
    expect_bases(ECU_OK, 22, -12, BASE_LEVER_HIGH);
    expect_bases(ECU_IMAGE_BASES, 22, -12, BASE_LEVER_LOW - 1);
    expect_bases(ECU_IMAGE_BASES, 22, -12, BASE_LEVER_HIGH + 1);
    expect_bases(ECU_OK, 22, -6, -2); /* torque 14 */
    expect_bases(ECU_IMAGE_BASES, 22, -6, -1);
    expect_bases(ECU_OK, 22, -18, -4); /* torque 0 */
    expect_bases(ECU_IMAGE_BASES, 22, -18, -5);
}

/* A binary32 number next to this one. */
static uint32_t neighbour(uint32_t bits, float towards)
{
    return bits_of(nextafterf(number_of(bits), towards));
}

static void expect_out_of_range(uint16_t k, uint32_t bits)
{
    const uint32_t before = get_parameter(k);
    set_parameter(k, bits);
    expect_refused(ECU_PARAMETER_RANGE);
    TEST_ASSERT_EQUAL_UINT16(k, entry);
    set_parameter(k, before);
}

static void test_number_outside_its_range_taken(void)
{
    /* GIVEN every parameter in turn, one step below its range and one above WHEN loaded THEN refused, the
     * entry reported, nothing touched */
    for (uint16_t k = 0; k < PARAMETER_COUNT; k++) {
        expect_out_of_range(k, neighbour(LIMITS[TABLE[k].low], -INFINITY));
        expect_out_of_range(k, neighbour(LIMITS[TABLE[k].high], INFINITY));
    }
}

static void test_no_number_taken(void)
{
    /* GIVEN every parameter in turn as NaN of both kinds and signs, infinite or huge WHEN loaded THEN
     * refused, the entry reported, nothing touched */
    static const uint32_t patterns[] = {0x7FC00000u, 0xFFC00000u, 0x7F800001u, 0xFFFFFFFFu,
                                        0x7F800000u, 0xFF800000u, 0x7F7FFFFFu, 0xFF7FFFFFu};
    for (uint16_t k = 0; k < PARAMETER_COUNT; k++) {
        for (unsigned n = 0; n < COUNT_OF(patterns); n++) {
            expect_out_of_range(k, patterns[n]);
        }
    }
}

static void test_number_too_large_for_the_type_clamped_in_silence(void)
{
    /* GIVEN a bound of 1e5 N m, 781 per unit with these bases WHEN loaded
     * THEN fixed point, which has room for 32, refuses it and names it; double and float take it */
    const uint16_t k = entry_named("control.wrist.gamma1_max_Nm");
    set_parameter(k, LIMITS[TABLE[k].high]);
#if defined(DIARC_SCALAR_FIXED)
    TEST_ASSERT_EQUAL_INT(ECU_PARAMETER_RANGE, parameters_load(&machine, &bases, &image, &entry));
    TEST_ASSERT_EQUAL_UINT16(k, entry);
#else
    TEST_ASSERT_EQUAL_INT(ECU_OK, parameters_load(&machine, &bases, &image, &entry));
#endif
}

static void test_number_at_the_edge_of_its_range_refused(void)
{
    /* GIVEN plain gains at either end of their ranges, 0 and -0 among them WHEN loaded THEN taken */
    static const char *const names[] = {"arm.gravity_m_s2",        "control.swing.k1_1_s",
                                        "control.wrist.k2_1_s",    "control.swing.kappa1_1_s2",
                                        "control.wrist.pid_kp",    "estimator.gate_rate_rad_s",
                                        "estimator.filter_time_s", "estimator.load_walk_kg"};
    for (unsigned n = 0; n < COUNT_OF(names); n++) {
        const uint16_t k = entry_named(names[n]);
        set_parameter(k, LIMITS[TABLE[k].low]);
        TEST_ASSERT_EQUAL_INT_MESSAGE(ECU_OK, parameters_load(&machine, &bases, &image, &entry), names[n]);
        set_parameter(k, LIMITS[TABLE[k].high]);
        TEST_ASSERT_EQUAL_INT_MESSAGE(ECU_OK, parameters_load(&machine, &bases, &image, &entry), names[n]);
        if (LIMITS[TABLE[k].low] == 0u) {
            set_parameter(k, 0x80000000u);
            TEST_ASSERT_EQUAL_INT_MESSAGE(ECU_OK, parameters_load(&machine, &bases, &image, &entry),
                                          names[n]);
        }
    }
}

/* `lower` must be below `higher`: swapped where their ranges allow it, and equal. */
static void expect_relation(const char *lower, const char *higher)
{
    const uint16_t low = entry_named(lower);
    const uint16_t high = entry_named(higher);
    const float most = fminf(number_of(LIMITS[TABLE[low].high]), number_of(get_parameter(high)));
    const float least = fmaxf(number_of(LIMITS[TABLE[high].low]), number_of(get_parameter(low)));
    TEST_ASSERT_TRUE(most >= least);
    for (int swapped = 0; swapped < 2; swapped++) {
        set_parameter(low, bits_of(most));
        set_parameter(high, bits_of(swapped == 1 ? least : most));
        expect_refused(ECU_PARAMETER_RELATION);
        TEST_ASSERT_EQUAL_STRING(lower, parameter_name(entry));
    }
    image = default_parameter_image;
}

static void test_contradiction_taken(void)
{
    /* GIVEN pairs of parameters of which one must be below the other WHEN swapped, or equal where they must
     * not be THEN refused, the first of them reported, nothing touched */
    expect_relation("supply.tank_Pa", "supply.pressure_Pa");
    static const char *const joints[] = {"swing", "wrist"};
    for (unsigned k = 0; k < COUNT_OF(joints); k++) {
        char low[40];
        char high[40];
        (void)snprintf(low, sizeof low, "%s.rod_m", joints[k]);
        (void)snprintf(high, sizeof high, "%s.bore_m", joints[k]);
        expect_relation(low, high);
        (void)snprintf(low, sizeof low, "%s.q_min_rad", joints[k]);
        (void)snprintf(high, sizeof high, "%s.q_max_rad", joints[k]);
        expect_relation(low, high);
    }
}

static void test_prior_outside_its_bounds_taken(void)
{
    /* GIVEN every prior WHEN its bounds are swapped or leave no room, or its value is beyond one of them THEN
     * refused, the lower of the two reported; WHEN its value is at a bound THEN taken */
    unsigned priors = 0;
    for (uint16_t k = 0; k < PARAMETER_COUNT; k++) {
        const char *const name = parameter_name(k);
        const char *const end = strstr(name, ".value");
        if (strncmp(name, "estimator.prior.", 16) != 0 || end == NULL) {
            continue;
        }
        char low[80];
        char high[80];
        (void)snprintf(low, sizeof low, "%.*s.low", (int)(end - name), name);
        (void)snprintf(high, sizeof high, "%.*s.high", (int)(end - name), name);
        const uint32_t low_bits = get_parameter(entry_named(low));
        const uint32_t high_bits = get_parameter(entry_named(high));
        const uint32_t value_bits = get_parameter(k);
        const uint32_t inner_low = neighbour(low_bits, INFINITY);
        const uint32_t inner_high = neighbour(high_bits, -INFINITY);

        set_parameter(k, low_bits);
        TEST_ASSERT_EQUAL_INT_MESSAGE(ECU_OK, parameters_load(&machine, &bases, &image, &entry), name);
        set_parameter(entry_named(low), inner_low); /* one step above the value */
        expect_refused(ECU_PARAMETER_RELATION);
        TEST_ASSERT_EQUAL_STRING(low, parameter_name(entry));
        set_parameter(entry_named(low), low_bits);

        set_parameter(k, high_bits);
        TEST_ASSERT_EQUAL_INT_MESSAGE(ECU_OK, parameters_load(&machine, &bases, &image, &entry), name);
        set_parameter(entry_named(high), inner_high);
        expect_refused(ECU_PARAMETER_RELATION);
        TEST_ASSERT_EQUAL_STRING(name, parameter_name(entry));

        set_parameter(k, low_bits); /* no room: an estimator would divide by it */
        set_parameter(entry_named(high), low_bits);
        expect_refused(ECU_PARAMETER_RELATION);
        TEST_ASSERT_EQUAL_STRING(low, parameter_name(entry));
        set_parameter(entry_named(high), high_bits);
        set_parameter(k, value_bits);
        priors++;
    }
    TEST_ASSERT_EQUAL_UINT(THETA_M + THETA_H, priors);
}

static void test_crank_at_its_dead_point_taken(void)
{
    /* GIVEN a crank whose range comes near 0 or pi, where its lever arm vanishes WHEN loaded THEN refused, q0
     * reported, nothing touched; a little further off taken */
    static const char *const joints[] = {"swing", "wrist"};
    for (unsigned k = 0; k < COUNT_OF(joints); k++) {
        char name[40];
        (void)snprintf(name, sizeof name, "%s.crank_q0_rad", joints[k]);
        const uint16_t q0 = entry_named(name);
        static const float refused[] = {1.04f, 1.9f, -1.6f, 3.2f}; /* range -1..1.2 */
        static const float taken[] = {1.06f, 1.88f};
        for (unsigned n = 0; n < COUNT_OF(refused); n++) {
            set_parameter(q0, bits_of(refused[n]));
            expect_refused(ECU_PARAMETER_RELATION);
            TEST_ASSERT_EQUAL_STRING(name, parameter_name(entry));
        }
        for (unsigned n = 0; n < COUNT_OF(taken); n++) {
            set_parameter(q0, bits_of(taken[n]));
            TEST_ASSERT_EQUAL_INT(ECU_OK, parameters_load(&machine, &bases, &image, &entry));
        }
        image = default_parameter_image;
    }
}

static void test_wrong_entry_blamed(void)
{
    /* GIVEN two numbers that are wrong WHEN loaded THEN the first is reported; WHEN loaded well THEN none is
     * */
    set_parameter(40, 0x7FC00000u);
    set_parameter(77, 0x7FC00000u);
    expect_refused(ECU_PARAMETER_RANGE);
    TEST_ASSERT_EQUAL_UINT16(40, entry);
    image = default_parameter_image;
    TEST_ASSERT_EQUAL_INT(ECU_OK, parameters_load(&machine, &bases, &image, &entry));
    TEST_ASSERT_EQUAL_UINT16(0, entry);
}

static void test_parameter_without_a_name(void)
{
    /* GIVEN every number of a parameter WHEN asked for its name THEN one of its own; beyond the list a "?" */
    for (uint16_t k = 0; k < PARAMETER_COUNT; k++) {
        TEST_ASSERT_NOT_NULL(parameter_name(k));
        TEST_ASSERT_TRUE(strlen(parameter_name(k)) > 3);
        for (uint16_t n = 0; n < k; n++) {
            TEST_ASSERT_TRUE(strcmp(parameter_name(k), parameter_name(n)) != 0);
        }
    }
    TEST_ASSERT_EQUAL_STRING("?", parameter_name(PARAMETER_COUNT));
    TEST_ASSERT_EQUAL_STRING("?", parameter_name(UINT16_MAX));
}

static void test_error_without_words(void)
{
    /* GIVEN every status WHEN asked for its text THEN words of its own, for an unknown one too */
    for (int k = ECU_OK; k <= ECU_PERIOD_RANGE + 1; k++) {
        TEST_ASSERT_NOT_NULL(ecu_status_text((enum ecu_status)k));
        TEST_ASSERT_TRUE(strlen(ecu_status_text((enum ecu_status)k)) > 3);
        for (int n = ECU_OK; n < k; n++) {
            TEST_ASSERT_TRUE(
                strcmp(ecu_status_text((enum ecu_status)k), ecu_status_text((enum ecu_status)n)) != 0);
        }
    }
}

static void test_ecu_starts_with_a_period_it_cannot_hold(void)
{
    /* GIVEN periods around 250 us, and around 1 / observer bandwidth WHEN started THEN refused outside them
     * */
    static struct ecu ecu;
    TEST_ASSERT_EQUAL_INT(ECU_PERIOD_RANGE, ecu_init(&ecu, NULL, 249, &entry));
    TEST_ASSERT_EQUAL_INT(ECU_OK, ecu_init(&ecu, NULL, 250, &entry));
    set_parameter(entry_named("control.observer_rad_s"), bits_of(300));
    TEST_ASSERT_EQUAL_INT(ECU_OK, ecu_init(&ecu, &image, 3333, &entry));
    TEST_ASSERT_EQUAL_INT(ECU_PERIOD_RANGE, ecu_init(&ecu, &image, 3334, &entry));
    set_parameter(entry_named("control.observer_rad_s"), bits_of(40));
    TEST_ASSERT_EQUAL_INT(ECU_OK, ecu_init(&ecu, &image, 20000, &entry));
    TEST_ASSERT_EQUAL_INT(ECU_PERIOD_RANGE, ecu_init(&ecu, &image, 20001, &entry));
    TEST_ASSERT_EQUAL_INT(ECU_PERIOD_RANGE, ecu_init(&ecu, &image, UINT32_MAX, &entry));
    TEST_ASSERT_EQUAL_INT(ECU_PERIOD_RANGE, ecu_init(&ecu, &image, 0, &entry));
}

static void test_ecu_starts_with_a_bad_image(void)
{
    /* GIVEN an image with a wrong number WHEN the ECU is started with it THEN the status and the entry come
     * through */
    static struct ecu ecu;
    set_parameter(5, 0x7F800000u);
    TEST_ASSERT_EQUAL_INT(ECU_PARAMETER_RANGE, ecu_init(&ecu, &image, 1000, &entry));
    TEST_ASSERT_EQUAL_UINT16(5, entry);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_built_in_machine_refused);
    RUN_TEST(test_parameter_lands_in_another_field);
    RUN_TEST(test_other_bases_make_another_machine);
    RUN_TEST(test_other_file_taken_for_an_image);
    RUN_TEST(test_image_of_another_version_taken);
    RUN_TEST(test_damaged_image_taken);
    RUN_TEST(test_bases_out_of_range_taken);
    RUN_TEST(test_number_outside_its_range_taken);
    RUN_TEST(test_no_number_taken);
    RUN_TEST(test_number_too_large_for_the_type_clamped_in_silence);
    RUN_TEST(test_number_at_the_edge_of_its_range_refused);
    RUN_TEST(test_contradiction_taken);
    RUN_TEST(test_prior_outside_its_bounds_taken);
    RUN_TEST(test_crank_at_its_dead_point_taken);
    RUN_TEST(test_wrong_entry_blamed);
    RUN_TEST(test_parameter_without_a_name);
    RUN_TEST(test_error_without_words);
    RUN_TEST(test_ecu_starts_with_a_period_it_cannot_hold);
    RUN_TEST(test_ecu_starts_with_a_bad_image);
    return UNITY_END();
}
